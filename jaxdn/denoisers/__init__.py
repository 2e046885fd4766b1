"""Every denoiser is a factory that returns a :class:`jaxdn.Denoiser`; one system, one file of the factory's name."""

# Imported here and not on demand: the modules bear the factories' names and would take their place in this package.
from jaxdn.denoisers.ntd import ntd as ntd
from jaxdn.denoisers.svgf import svgf as svgf

NAMES: tuple[str, ...] = ("ntd", "svgf")
"""The factories' names, as weights and the command line know them."""
