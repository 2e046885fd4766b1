"""What reproduces the papers: one file for each table or figure; run with ``python -m experiments.NAME``."""
