"""Convolutions with gradients: XLA, and oneDNN for training on CPUs."""
