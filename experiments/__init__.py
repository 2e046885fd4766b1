"""Experiments on papers, stability and speed, one file each; run with ``python -m experiments.GROUP.NAME``."""
