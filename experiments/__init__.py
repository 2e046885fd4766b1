"""Experiments on papers, stability and speed, and clips of Cycles; run with ``python -m experiments.GROUP.NAME``."""
