"""Checkpoints of a training run (Orbax): parameters, optimiser and the position in the data, always complete."""

import hashlib
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxdn.training.processes import wait_for_all, writes
from jaxdn.training.step import TrainState

_DIGEST = "sha256"
"""Key of the digest in the data stored with the state; checkpoints of earlier versions have none."""


class Checkpoints:
    """The checkpoints of one run in one folder; the newest two are kept.

    Orbax writes each under a temporary name and renames it when it is complete: a run killed while writing resumes from
    the one before. Each contains a digest of its values, which also detects damaged files that can still be parsed.
    Saving is asynchronous; :meth:`close` waits for it. Several processes do all of this together, and one writes.
    """

    def __init__(self, folder: Path):
        self._folder = folder.absolute()
        options = ocp.CheckpointManagerOptions(max_to_keep=2, cleanup_tmp_directories=True)
        self._manager = ocp.CheckpointManager(self._folder, options=options)

    def save(self, state: TrainState, data: dict[str, Any]) -> None:
        """Save the state after ``state.step`` updates with the data iterator's state (JSON)."""
        # Copies: on a CPU an array may be written from its own memory, which the next update reuses.
        values = jax.tree.map(np.array, state._asdict())
        position = {**data, _DIGEST: digest(values, data)}
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(values), data=ocp.args.JsonSave(position))
        self._manager.save(int(state.step), args=arguments, force=True)

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]] | None:
        """The newest checkpoint as a state shaped ``like`` this one, and the data's position; None if there is none.

        A checkpoint that cannot be read (incomplete after a crash of the machine, or damaged) is moved to
        ``damaged-<step>`` next to the folder, with a UserWarning, and the one before it is used. Raises ValueError
        if none of them can be read as this network's.
        """
        failed: dict[int, Exception] = {}
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                found = self._read(step, like)
            except Exception as error:  # the errors that damaged bytes cause in Orbax have no common base class
                failed[step] = error
                continue
            for damaged, reason in failed.items():
                self._put_aside(damaged, reason, continues=step)
            if failed:
                self._manager.reload()
            return found
        if failed:
            newest = max(failed)
            raise ValueError(
                f"checkpoints {self._folder}: expected the parameters of this network, and none of the checkpoints "
                f"({', '.join(map(str, sorted(failed)))}) can be read as such ({_short(failed[newest])}). If another "
                "network was trained here, give the run another name; if the files are damaged, delete the folder and "
                "start over."
            ) from failed[newest]
        return None

    def _read(self, step: int, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        template = ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like._asdict()))
        found = self._manager.restore(step, args=ocp.args.Composite(state=template, data=ocp.args.JsonRestore()))
        data = dict(found.data)
        stored = data.pop(_DIGEST, None)
        if stored is not None and stored != digest(found.state, data):
            raise ValueError("its values are not those that were written")
        return TrainState(**found.state), data

    def _put_aside(self, step: int, reason: Exception, *, continues: int) -> None:
        aside = self._folder.parent / f"damaged-{step}"
        if writes():
            shutil.rmtree(aside, ignore_errors=True)
            shutil.move(self._folder / str(step), aside)
        wait_for_all(f"damaged-{step}")
        warnings.warn(
            f"checkpoint {self._folder / str(step)} is damaged ({_short(reason)}) and was moved to {aside}; training "
            f"continues from the checkpoint after {continues} updates.",
            stacklevel=3,
        )

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._manager.wait_until_finished()
        self._manager.close()


def digest(values: Any, data: dict[str, Any]) -> str:
    """SHA-256 of the names, shapes, types and bytes of all arrays, and of the data's position."""
    found = hashlib.sha256(json.dumps(data, sort_keys=True).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(values):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {np.shape(leaf)} {array.dtype}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).splitlines()[0][:200]}" if str(error) else type(error).__name__
