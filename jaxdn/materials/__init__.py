"""Reflectance models: microfacet distributions and glints, and the kernels of :mod:`jaxdn.brdf`."""
