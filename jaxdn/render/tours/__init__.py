"""Randomised camera paths through rooms, with objects inserted and collisions avoided."""
