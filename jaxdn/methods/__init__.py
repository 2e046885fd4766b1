"""The denoising methods, one file each, and the table of them; use them through :mod:`jaxdn.denoisers`."""
