"""How an operation chooses among its implementations, and what these share: row tiles in XLA, Numba loops by rows."""
