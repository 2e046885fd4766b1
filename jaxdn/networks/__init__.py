"""The networks: each is an ``init`` and an ``apply`` on plain nested dicts. Flax is imported here and nowhere else."""
