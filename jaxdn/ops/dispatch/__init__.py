"""How an operation chooses among its implementations: the registry, the inference path, Numba calls by rows."""
