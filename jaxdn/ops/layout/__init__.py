"""Conversions of memory layout: planes, and blocks of pixels as channels."""
