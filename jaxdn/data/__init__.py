"""Files: OpenEXR, clips, sequences of other renderers, and training data. The public face is :mod:`jaxdn.clips`."""
