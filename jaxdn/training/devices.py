"""The devices of a training run: the clips of a batch are divided among them, everything else is on each of them."""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

CLIPS = "clips"
"""The only axis of the mesh."""
DIVIDED, ON_ALL = PartitionSpec(CLIPS), PartitionSpec()

_Tree = TypeVar("_Tree")


def make_mesh(devices: int, batch: int) -> Mesh | None:
    """The first ``devices`` devices that jax has in this process; None for one, which needs no mesh.

    Raises ValueError for a number that jax does not have, and unless it divides the batch.
    """
    there = jax.local_devices()
    if not 1 <= devices <= len(there):
        raise ValueError(
            f"devices: expected 1 to {len(there)}, as jax has {len(there)} of {there[0].device_kind!r} here, got "
            f"{devices}; give another number."
        )
    if batch % devices:
        raise ValueError(f"batch: expected a multiple of the {devices} devices, got {batch}; change one of them.")
    return Mesh(np.asarray(there[:devices]), (CLIPS,)) if devices > 1 else None


def put_on_all(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """The same arrays on every device."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, ON_ALL))


def divide(batch: _Tree, mesh: Mesh | None) -> _Tree:
    """A batch whose elements are divided among the devices, in order."""
    return batch if mesh is None else jax.device_put(batch, NamedSharding(mesh, DIVIDED))


def take_from_first(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """Arrays that are on all devices, as arrays of the first: what is computed with them is computed once."""
    return tree if mesh is None else jax.tree.map(_take_first_shard, tree)


def _take_first_shard(array: jax.Array) -> Any:
    return array.addressable_data(0)
