"""OpenEXR files: reading, windows, and results written into a copy of their source."""
