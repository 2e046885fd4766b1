"""The systems, a file each, and the table of them; use them through :mod:`jaxdn.denoisers`."""
