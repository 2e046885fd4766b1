"""What sessions of other libraries share: each belongs to the weights of its last call."""

from collections.abc import Sequence

import numpy as np


def same(new: Sequence[np.ndarray], old: Sequence[np.ndarray]) -> bool:
    """Whether two lists of weights are equal, bit for bit."""
    return len(new) == len(old) and all(
        np.array_equal(one.view(np.int32), other.view(np.int32)) for one, other in zip(new, old, strict=True)
    )
