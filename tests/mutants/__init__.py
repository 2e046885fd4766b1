"""Mutants: small changes of the code, each with the tests that have to fail with it: see ``make mutants``."""
