"""Clips on disk: folders of multi-layer OpenEXR frames plus one ``clip.json``."""
