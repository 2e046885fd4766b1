"""Evaluation: denoisers compared on clips, and the report of it."""
