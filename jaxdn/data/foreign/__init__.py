"""EXR sequences of other renderers: which layer is which buffer, and what its numbers mean."""
