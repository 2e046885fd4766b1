"""Scenes: Mitsuba's files, animation, lights, materials, media, and what a scene contains."""
