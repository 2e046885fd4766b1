"""Randomised scenes: collision-free camera paths through rooms, with inserted objects."""
