"""The loop around the train step: data, validation, progress and checkpoints."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from jaxdn.denoiser import Denoiser, Params
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.interrupt import Interrupt
from jaxdn.training.checkpoint import Checkpoints
from jaxdn.training.devices import divide, make_mesh, put_on_all, take_from_first
from jaxdn.training.log import Log
from jaxdn.training.processes import Stopping, writes
from jaxdn.training.progress import ProgressBar
from jaxdn.training.step import Batch, Report, TrainState, init_state, init_state_from, make_train_step
from jaxdn.training.validation import ValidationClip, make_validation


class InitialWeights(NamedTuple):
    """What training begins with instead of new parameters."""

    name: str
    """Of the weights, for the record."""
    params: Params


class ResumableBatches(Protocol):
    """Batches without end, whose position can be kept and returned to, as Grain's iterators have it."""

    def __next__(self) -> Batch: ...

    def get_state(self) -> dict[str, Any]:
        """The position, as JSON."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Go to a position."""


class Every(NamedTuple):
    """Updates between two of each; the last update has all three."""

    log: int = 20
    validation: int = 100
    checkpoint: int = 100


def fit(
    denoiser: Denoiser,
    recipe: Recipe,
    batches: ResumableBatches,
    folder: Path,
    *,
    label: str,
    start: InitialWeights | None = None,
    method: Mapping[str, Any] | None = None,
    validation: Sequence[ValidationClip] = (),
    every: Every = Every(),  # noqa: B008, immutable
    time_limit: float | None = None,
    devices: int | None = None,
) -> TrainState:
    """Train to ``recipe.steps`` updates, resuming from the newest checkpoint in ``folder`` to the same result.

    A run that was started with fewer steps goes on to ``recipe.steps``, along the schedule of that many. On Ctrl-C, or
    SIGTERM, the update is finished and saved before :class:`jaxdn.runtime.interrupt.Stopped` (a KeyboardInterrupt)
    or ``Terminated`` is raised; at the time limit the state is returned. Of several processes (:mod:`jaxdn.training.
    processes`) all stop where one is asked to, and the first writes.
    Raises ValueError for impossible values in the recipe, and, with what to change, after many updates in a row that
    changed nothing.

    Args:
      denoiser: what to train.
      recipe: objective, optimiser, number of updates.
      batches: every checkpoint keeps their position.
      folder: gets recipe.json, log.jsonl and the checkpoints.
      label: the run's name in messages.
      start: what to begin with; None draws parameters with the recipe's seed.
      method: what ``denoiser`` is, by name, as JSON has it: a run in the same folder goes on with the same alone.
      validation: see :func:`jaxdn.training.validation.load_validation`.
      every: updates between log entries, validations and checkpoints.
      time_limit: seconds after which no further update begins, counted from the call; None: no limit.
      devices: number of devices, of each process, that each batch is divided among (:func:`jaxdn.training.devices.
        make_mesh`); a run may go on with another number, and with another number of processes.
    """
    recipe.check()
    end = math.inf if time_limit is None else time.monotonic() + time_limit
    mesh = make_mesh(devices, recipe.batch)
    folder.mkdir(parents=True, exist_ok=True)
    record, extended = _match_recipe(
        folder / "recipe.json", recipe, None if start is None else start.name, dict(method or {})
    )
    run = _Run(denoiser, recipe, batches, folder, start, mesh)  # refuses checkpoints of another network
    if record is not None and writes():
        write_json(folder / "recipe.json", record)
    validate = make_validation(denoiser, validation)
    divergence = _Divergence(label, recipe, run.step, int(run.state.skipped))
    with (
        ProgressBar(label, recipe, run.step, shown=writes()) as progress,
        Interrupt(
            lambda: progress.print(f"{label}: stopping after this update; press Ctrl-C again to lose it")
        ) as stop,
    ):
        if extended is not None:
            progress.print(
                f"{label}: begun with {extended} steps, goes on to {recipe.steps} along their learning rates"
            )
        stopping, together = Stopping(stop, end), jax.process_count() == 1
        try:
            while run.step < recipe.steps and not stopping.is_agreed():
                report = run.update()
                logs = run.is_due(every.log)
                if logs:
                    psnr = float(report.validation_psnr)
                    run.write_log(step=run.step, loss=float(report.loss), last_frame_psnr=psnr)
                if validation and run.is_due(every.validation):
                    psnr = validate(take_from_first(run.state.average, mesh))
                    run.write_log(step=run.step, validation_psnr=psnr)
                    progress.validated(psnr)
                if logs:  # after the validation: the last line shows the last one
                    skipped = int(run.state.skipped)
                    progress.advance(run.step, loss=float(report.loss), skipped=skipped, waited=run.waited)
                    divergence.check(run.step, skipped=skipped, norm=float(report.gradient_norm))
                if run.is_due(every.checkpoint):
                    run.save()
            together = True  # all processes are here, after the same update
            stop.raise_if_asked()
        except KeyboardInterrupt:
            if together and run.is_between_updates():
                run.save()
            progress.print(
                f"{label}: stopped after {run.step} of {recipe.steps} steps; the same command continues there."
            )
            raise
        else:
            run.save()
            if run.step < recipe.steps:
                progress.print(
                    f"{label}: time is over after {run.step} of {recipe.steps} steps; the same command goes on."
                )
        finally:
            run.close()
    return run.state


class _Run:
    """A run in its folder: the state and the position in the data after ``step`` updates, its log and checkpoints."""

    def __init__(
        self,
        denoiser: Denoiser,
        recipe: Recipe,
        batches: ResumableBatches,
        folder: Path,
        start: InitialWeights | None,
        mesh: Mesh | None,
    ) -> None:
        self._batches, self._steps, self._mesh = batches, recipe.steps, mesh
        self._checkpoints = Checkpoints(folder / "checkpoints")
        first_position = batches.get_state()
        state = init_state(denoiser, recipe, next(batches))
        batches.set_state(first_position)
        if start is not None:
            state = init_state_from(jax.tree.map(jnp.array, start.params), recipe)
        state = put_on_all(state, mesh)
        restored = self._checkpoints.restore(state)
        if restored is not None:
            state, position = restored
            batches.set_state(position)
        self.state = state
        self.step = self._saved = int(state.step)
        self.waited = 0.0
        """Seconds in which the devices of this process had nothing to do because no batch was there."""
        self._loss: Any = None
        """Of the newest update. Any: jax's types do not know ``is_ready``."""
        self._log = Log(folder / "log.jsonl", keep_until=self.step) if writes() else None
        self._train_step = make_train_step(denoiser, recipe, mesh)
        # An interrupt may come between the batch and its update: this position always belongs to finished updates.
        self._position = batches.get_state()

    def update(self) -> Report:
        """One update with the next batch."""
        asked = time.monotonic()
        batch = next(self._batches)
        # While an update is computed, the next batch may take its time. When the update ended is not known: where it
        # has ended, all of the time counts.
        if self._loss is None or self._loss.is_ready():
            self.waited += time.monotonic() - asked
        self.state, report = self._train_step(self.state, divide(batch, self._mesh))
        self.step, self._position, self._loss = self.step + 1, self._batches.get_state(), report.loss
        return report

    def is_due(self, every: int) -> bool:
        """Whether what is done every so many updates is done now."""
        return self.step % every == 0 or self.step == self._steps

    def is_between_updates(self) -> bool:
        """Whether the state is that after ``step`` updates: a second Ctrl-C may come while one takes its memory."""
        return not any(leaf.is_deleted() for leaf in jax.tree.leaves(self.state)) and int(self.state.step) == self.step

    def write_log(self, **entry: Any) -> None:
        """One entry of the log."""
        if self._log is not None:
            self._log.write(**entry)

    def save(self) -> None:
        """A checkpoint, unless this step has one."""
        if self._saved < self.step:
            self._checkpoints.save(self.state, self._position)
            self._saved = self.step

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._checkpoints.close()
        if self._log is not None:
            self._log.close()


def _match_recipe(
    path: Path, recipe: Recipe, start: str | None, method: dict[str, Any]
) -> tuple[dict[str, Any] | None, int | None]:
    """What to write as the recipe of a new run, or of one that is made longer, and how long the latter was.

    Raises ValueError if an existing run has another recipe, or is of another method.
    """
    wanted = {**recipe.record(), "start": start, **json.loads(json.dumps(method))}
    extended: int | None = None
    if path.is_file():
        there = json.loads(path.read_text())
        differing = _find_differences(there, wanted, method.keys() - there.keys())
        if differing.keys() == {"steps"} and there["steps"] < recipe.steps:
            extended = there["steps"]
            wanted["begun_with"] = [*there.get("begun_with", []), extended]
        elif differing:
            changes = ", ".join(f"{key} {old!r} -> {new!r}" for key, (old, new) in differing.items())
            raise ValueError(
                f"{path}: expected the recipe that this run was started with, got {changes}; give the new run another "
                "name, or delete the folder to start over."
            )
        else:
            return None, None
    return wanted, extended


def _find_differences(
    there: dict[str, Any], wanted: dict[str, Any], unknown: AbstractSet[str]
) -> dict[str, tuple[Any, Any]]:
    """What differs, before and now; of options those that differ. Runs of before methods were kept have none."""
    found = {key: (there.get(key), wanted[key]) for key in wanted if key not in unknown}
    before, now = found.pop("options", ({}, {}))
    if before is not None and now is not None:
        found |= {f"option {key}": (before.get(key), now.get(key)) for key in sorted(before.keys() | now.keys())}
    return {key: (old, new) for key, (old, new) in found.items() if old != new}


def read_resumed_from(folder: Path) -> list[int]:
    """The numbers of steps that a run had before it was made longer; their schedules shaped its weights."""
    return list(json.loads((folder / "recipe.json").read_text()).get("begun_with", []))


class _Divergence:
    """Raises ValueError when training no longer learns: for 100 updates, or half of all, none changed the weights."""

    def __init__(self, label: str, recipe: Recipe, step: int, skipped: int):
        self._label, self._recipe = label, recipe
        self._patience = max(1, min(100, recipe.steps // 2))
        self._learned = self._checked = step
        self._skipped = skipped

    def check(self, step: int, *, skipped: int, norm: float) -> None:
        """Check training after ``step`` updates, ``skipped`` of them not finite, by the newest gradient's norm.

        Weights that have grown extremely large may still give finite images, but with a gradient of zero.
        """
        if skipped - self._skipped < step - self._checked and norm != 0:
            self._learned = step
        self._checked, self._skipped = step, skipped
        if step - self._learned >= self._patience:
            raise ValueError(
                f"{self._label}: nothing was learned in the updates {self._learned + 1} to {step} ({skipped} so far "
                f"were not finite, the newest gradient's norm is {norm:g}); start again under another name with a "
                f"learning rate below {self._recipe.learning_rate:g}, and look for clips that are black."
            )
