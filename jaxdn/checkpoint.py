"""Checkpoints of a training run (Orbax): parameters, optimiser and the position in the data, all or nothing."""

from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from jaxdn.training import TrainState


class Checkpoints:
    """The checkpoints of one run in one folder; the newest two are kept.

    Orbax writes each beside its place and renames it when it is whole: a run killed while writing continues from the
    one before. Saving happens in the background; :meth:`close` waits for it.
    """

    def __init__(self, folder: Path):
        options = ocp.CheckpointManagerOptions(max_to_keep=2, cleanup_tmp_directories=True)
        self._manager = ocp.CheckpointManager(folder.absolute(), options=options)

    def save(self, state: TrainState, data: dict[str, Any]) -> None:
        """Keep the state after ``state.step`` updates with the data iterator's own state (JSON)."""
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(state._asdict()), data=ocp.args.JsonSave(data))
        self._manager.save(int(state.step), args=arguments, force=True)

    def latest(self) -> int | None:
        """The number of updates in the newest whole checkpoint; None where there is none."""
        return self._manager.latest_step()

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]] | None:
        """The newest checkpoint as a state shaped ``like`` this one, and the data's position; None where there is none.

        A checkpoint that cannot be read (torn by a crash of the machine) is passed over for the one before it.
        Raises ValueError when the newest readable one belongs to another network or recipe.
        """
        for step in sorted(self._manager.all_steps(), reverse=True):
            template = ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like._asdict()))
            try:
                found = self._manager.restore(
                    step, args=ocp.args.Composite(state=template, data=ocp.args.JsonRestore())
                )
            except (FileNotFoundError, OSError):
                continue
            except (ValueError, KeyError) as error:
                if _is_torn(error):
                    continue
                raise ValueError(
                    f"checkpoint {self._manager.directory / str(step)}: expected the parameters of this network, got "
                    f"others ({str(error).splitlines()[0]}); give the run another name or delete the folder."
                ) from error
            return TrainState(**found.state), found.data
        return None

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._manager.wait_until_finished()
        self._manager.close()


def _is_torn(error: Exception) -> bool:
    """Whether an error speaks of damaged bytes and not of another tree."""
    words = str(error).lower()
    return any(word in words for word in ("corrupt", "data_loss", "truncated", "decode", "checksum", "out_of_range"))
