"""`make chart`: what every way to an image costs in time, and how good the image is, on this machine."""
