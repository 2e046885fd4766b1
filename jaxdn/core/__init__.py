"""The vocabulary of every other package: frames, options, checks, numerics. Needs jax and numpy alone."""
