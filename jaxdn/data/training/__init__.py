"""Training data made from clips: caches, packs, batches of windows."""
