"""`make chart`: time and image quality of every method on this machine."""
