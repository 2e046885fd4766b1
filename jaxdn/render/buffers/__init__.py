"""Auxiliary buffers: G-buffers, motion vectors, reflectance, and surfaces behind mirrors and glass."""
