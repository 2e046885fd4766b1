"""Hard cases as data, crossed with every denoiser, operation, precision and direction: see ``make hard-cases``."""
