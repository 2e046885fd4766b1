"""Loops for CPUs, compiled by Numba: what XLA:CPU would write to memory between operations stays in the cache.

They are faster forms of operations that exist in jax, whose results they give within rounding; :mod:`jaxdn.ops.faster`
puts them in their place, the affinity filter does so itself, as it has a loop for its gradient too. Only this package
imports Numba, and only once one of its loops is wanted. :mod:`jaxdn.compiled.affinities_gpu` is the same for GPUs.
"""
