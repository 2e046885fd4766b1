"""The failures that the papers on temporal denoising name, as clips, and what every method makes of them."""
