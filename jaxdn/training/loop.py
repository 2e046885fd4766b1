"""The loop around the train step: data, validation, progress and checkpoints."""

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxdn.core.frame import Clip
from jaxdn.denoiser import Denoiser, Params
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.interrupt import Interrupt
from jaxdn.training.checkpoint import Checkpoints
from jaxdn.training.log import Log
from jaxdn.training.step import TrainState, begun, initial_state, make_train_step
from jaxdn.training.validation import HeldOut, make_validation


class Start(NamedTuple):
    """What training begins with instead of new parameters."""

    name: str
    """Of the weights, for the record."""
    params: Params


def fit(
    denoiser: Denoiser,
    recipe: Recipe,
    batches: Iterator[Clip],
    folder: Path,
    *,
    label: str,
    start: Start | None = None,
    validation: Sequence[HeldOut] = (),
    log_every: int = 20,
    validate_every: int = 100,
    checkpoint_every: int = 100,
    time_limit: float | None = None,
) -> TrainState:
    """Train to ``recipe.steps`` updates, resuming from the newest checkpoint in ``folder`` to the same result.

    A run that was started with fewer steps goes on to ``recipe.steps``, along the schedule of that many. On Ctrl-C the
    update is finished, logged and saved before KeyboardInterrupt is raised; at the time limit the state is returned.
    Raises ValueError for impossible values in the recipe, and, with what to change, after many updates in a row that
    changed nothing.

    Args:
      denoiser: what to train.
      recipe: objective, optimiser, number of updates.
      batches: a Grain iterator (with ``get_state`` and ``set_state``); every checkpoint keeps its position.
      folder: gets recipe.json, log.jsonl and the checkpoints.
      label: the run's name in messages.
      start: what to begin with; None draws parameters with the recipe's seed.
      validation: see :func:`jaxdn.training.validation.load_validation`.
      log_every: updates between two log entries.
      validate_every: updates between two validations.
      checkpoint_every: updates between two checkpoints.
      time_limit: seconds after which no further update begins, counted from the call; None: no limit.
    """
    recipe.check()
    end = math.inf if time_limit is None else time.monotonic() + time_limit
    folder.mkdir(parents=True, exist_ok=True)
    extended = _same_recipe(folder / "recipe.json", recipe, None if start is None else start.name)
    checkpoints = Checkpoints(folder / "checkpoints")
    first_position = batches.get_state()  # type: ignore[attr-defined]
    state = initial_state(denoiser, recipe, next(batches))
    batches.set_state(first_position)  # type: ignore[attr-defined]
    if start is not None:
        state = begun(jax.tree.map(jnp.array, start.params), recipe)
    found = checkpoints.restore(state)
    if found is not None:
        state, position = found
        batches.set_state(position)  # type: ignore[attr-defined]
    step = int(state.step)
    log = Log(folder / "log.jsonl", keep_until=step)
    train_step = make_train_step(denoiser, recipe)
    validate = make_validation(denoiser, validation)
    # An interrupt may come between the batch and its update: this position always belongs to finished updates.
    position = batches.get_state()  # type: ignore[attr-defined]
    saved = step
    watch = _Divergence(label, recipe, step, int(state.skipped))
    with (
        _Progress(label, recipe, step) as progress,
        Interrupt(lambda: progress.say(f"{label}: stopping after this update; press Ctrl-C again to lose it")) as stop,
    ):
        if extended is not None:
            progress.say(f"{label}: begun with {extended} steps, goes on to {recipe.steps} along their learning rates")
        try:
            while step < recipe.steps and time.monotonic() < end and not stop.asked:
                batch = next(batches)
                state, report = train_step(state, batch)
                step, position = step + 1, batches.get_state()  # type: ignore[attr-defined]
                logs = step % log_every == 0 or step == recipe.steps
                if logs:
                    log.write(step=step, loss=float(report.loss), last_frame_psnr=float(report.validation_psnr))
                if validation and (step % validate_every == 0 or step == recipe.steps):
                    psnr = validate(state.average)
                    log.write(step=step, validation_psnr=psnr)
                    progress.validated(psnr)
                if logs:  # after the validation: the last line shows the last one
                    skipped = int(state.skipped)
                    progress.advance(step, loss=float(report.loss), skipped=skipped)
                    watch.look(step, skipped=skipped, norm=float(report.gradient_norm))
                if step % checkpoint_every == 0 or step == recipe.steps:
                    checkpoints.save(state, position)
                    saved = step
            if stop.asked:
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            if saved < step and _is_whole(state, step):
                checkpoints.save(state, position)
            progress.say(f"{label}: stopped after {step} of {recipe.steps} steps; the same command continues there.")
            raise
        else:
            if saved < step:
                checkpoints.save(state, position)
            if step < recipe.steps:
                progress.say(f"{label}: time is over after {step} of {recipe.steps} steps; the same command goes on.")
        finally:
            checkpoints.close()
            log.close()
    return state


def _is_whole(state: TrainState, step: int) -> bool:
    """Whether a state is that after ``step`` updates: a second Ctrl-C may come while an update takes its memory."""
    return not any(leaf.is_deleted() for leaf in jax.tree.leaves(state)) and int(state.step) == step


def _same_recipe(path: Path, recipe: Recipe, start: str | None) -> int | None:
    """Write the recipe of a new run, or of one that is made longer, and return how long the latter was.

    Raises ValueError if an existing run has another recipe.
    """
    wanted = {**recipe.record(), "start": start}
    extended: int | None = None
    if path.is_file():
        there = json.loads(path.read_text())
        differing = {key: (there.get(key), value) for key, value in wanted.items() if there.get(key) != value}
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
            return None
    write_json(path, wanted)
    return extended


def begun_with(folder: Path) -> list[int]:
    """The numbers of steps that a run had before it was made longer; their schedules shaped its weights."""
    return list(json.loads((folder / "recipe.json").read_text()).get("begun_with", []))


class _Divergence:
    """Raises ValueError when training no longer learns: for 100 updates, or half of all, none changed the weights."""

    def __init__(self, label: str, recipe: Recipe, step: int, skipped: int):
        self._label, self._recipe = label, recipe
        self._patience = max(1, min(100, recipe.steps // 2))
        self._learned = self._seen = step
        self._skipped = skipped

    def look(self, step: int, *, skipped: int, norm: float) -> None:
        """Check training after ``step`` updates, ``skipped`` of them not finite, by the newest gradient's norm.

        Weights that have grown extremely large may still give finite images, but with a gradient of zero.
        """
        if skipped - self._skipped < step - self._seen and norm != 0:
            self._learned = step
        self._seen, self._skipped = step, skipped
        if step - self._learned >= self._patience:
            raise ValueError(
                f"{self._label}: nothing was learned in the updates {self._learned + 1} to {step} ({skipped} so far "
                f"were not finite, the newest gradient's norm is {norm:g}); start again under another name with a "
                f"learning rate below {self._recipe.learning_rate:g}, and look for clips that are black."
            )


class _Progress:
    """A bar with loss, validation PSNR, frames/s and time left; plain lines without a terminal."""

    def __init__(self, label: str, recipe: Recipe, start: int):
        self._label, self._recipe, self._first = label, recipe, start
        self._validation = float("nan")
        self._console = Console(stderr=False)
        self._began: float | None = None
        self._printed = 0.0
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} steps  {task.fields[state]}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not sys.stdout.isatty(),
        )
        self._task = self._bar.add_task(label, total=recipe.steps, completed=start, state="compiling ...")

    def __enter__(self) -> "_Progress":
        self._bar.start()
        if self._first >= self._recipe.steps:
            self.say(f"{self._label}: all {self._recipe.steps} steps are there already")
        elif self._bar.disable:
            self.say(f"{self._label}: step {self._first} of {self._recipe.steps}, compiling ...")
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, line: str) -> None:
        """Print one line above the bar."""
        self._console.print(line, highlight=False, markup=False)

    def validated(self, psnr: float) -> None:
        """Keep the newest validation PSNR."""
        self._validation = psnr

    def advance(self, step: int, *, loss: float, skipped: int) -> None:
        """Show the progress after ``step`` updates."""
        now = time.monotonic()
        if self._began is None:  # the first report comes after the compilation: measure speed from there
            self._began, self._first = now, step
        rate = (step - self._first) / max(now - self._began, 1e-9)
        state = f"loss {loss:.4f}"
        if self._validation == self._validation:
            state += f"  validation {self._validation:.2f} dB"
        if rate > 0:
            state += f"  {rate * self._recipe.batch * self._recipe.frames:.0f} frames/s"
        if skipped:
            state += f"  {skipped} skipped (gradient not finite)"
        self._bar.update(self._task, completed=step, state=state)
        if self._bar.disable and (now - self._printed > 15 or step == self._recipe.steps):
            left = f"  {(self._recipe.steps - step) / rate:.0f} s left" if rate > 0 else ""
            self.say(f"{self._label}: step {step}/{self._recipe.steps}  {state}{left}")
            self._printed = now
