"""The devices of a training run: the clips of a batch are divided among them, everything else is on each of them.

They may belong to several processes (:mod:`jaxdn.training.processes`): then each process has its part of every batch.
"""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

CLIPS = "clips"
"""The only axis of the mesh."""
DIVIDED, ON_ALL = PartitionSpec(CLIPS), PartitionSpec()

_Tree = TypeVar("_Tree")


def make_mesh(devices: int | None, batch: int) -> Mesh | None:
    """The first ``devices`` devices of each process (None: one, or all where there are several processes).

    None for one device altogether, which needs no mesh. Raises ValueError for a number that jax does not have, for
    processes that have different numbers where none is given, and unless they divide the batch.
    """
    there, processes = jax.local_devices(), jax.process_count()
    of_each = [[one for one in jax.devices() if one.process_index == index] for index in range(processes)]
    counts = [len(some) for some in of_each]
    if devices is None:
        if len(set(counts)) > 1:
            raise ValueError(
                f"devices: expected as many in each process, got {', '.join(map(str, counts))}; give --devices "
                f"{min(counts)}, or start the processes with as many each."
            )
        devices = len(there) if processes > 1 else 1
    if not 1 <= devices <= min(counts):
        where = "here" if processes == 1 else "in one of the processes"
        raise ValueError(
            f"devices: expected 1 to {min(counts)}, as jax has {min(counts)} of {there[0].device_kind!r} {where}, got "
            f"{devices}; give another number."
        )
    count = devices * processes
    if batch % count:
        which = f"{count} devices" if processes == 1 else f"{count} devices of {processes} processes"
        raise ValueError(f"batch: expected a multiple of the {which}, got {batch}; change one of them.")
    chosen = [one for some in of_each for one in some[:devices]]
    return Mesh(np.asarray(chosen), (CLIPS,)) if count > 1 else None


def put_on_all(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """The same arrays on every device."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, ON_ALL))


def divide(batch: _Tree, mesh: Mesh | None) -> _Tree:
    """A batch whose elements are divided among the devices, in order; ``batch`` is this process's part of it."""
    if mesh is None:
        return batch
    place = NamedSharding(mesh, DIVIDED)
    return jax.tree.map(lambda part: jax.make_array_from_process_local_data(place, part), batch)


def take_from_first(tree: _Tree, mesh: Mesh | None) -> _Tree:
    """Arrays that are on all devices, as arrays of one of this process: what is computed with them is computed once."""
    return tree if mesh is None else jax.tree.map(_take_first_shard, tree)


def _take_first_shard(array: jax.Array) -> Any:
    return array.addressable_data(0)
