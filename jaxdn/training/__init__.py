"""Learning to denoise: one step of back-propagation through time. Pure functions, no files.

The loop with data, progress and checkpoints is :mod:`jaxdn.training.train`.
"""
