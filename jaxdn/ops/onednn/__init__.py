"""Bindings to the oneDNN library, and the layers of networks that it computes."""
