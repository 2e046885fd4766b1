"""Kernels predicted for each pixel: normalisation, application, softmax filters and distances of guides."""
