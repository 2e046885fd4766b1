"""Affinity filters: weighted means whose weights fall with the distance of learned features, and their kernels."""
