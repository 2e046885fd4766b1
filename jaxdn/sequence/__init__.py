"""Files in, files out: denoising and rendering whole sequences."""
