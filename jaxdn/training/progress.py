"""How far training is, in a terminal or in the log of a batch system."""

import sys
import time

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.terminal import plain_console


class ProgressBar:
    """A bar with loss, validation PSNR, frames/s, waiting and time left; plain lines without a terminal."""

    def __init__(self, label: str, recipe: Recipe, start: int, *, shown: bool = True):
        self._label, self._recipe, self._first, self._shown = label, recipe, start, shown
        self._validation = float("nan")
        self._console = plain_console()
        self._began: float | None = None
        self._waited_before = 0.0
        self._printed = 0.0
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} steps  {task.fields[state]}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not (shown and sys.stdout.isatty()),
        )
        self._task = self._bar.add_task(label, total=recipe.steps, completed=start, state="compiling ...")

    def __enter__(self) -> "ProgressBar":
        self._bar.start()
        if self._first >= self._recipe.steps:
            self.print(f"{self._label}: all {self._recipe.steps} steps are there already")
        elif self._bar.disable:
            self.print(f"{self._label}: step {self._first} of {self._recipe.steps}, compiling ...")
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def print(self, line: str) -> None:
        """Print one line above the bar."""
        if self._shown:
            self._console.print(line)

    def validated(self, psnr: float) -> None:
        """Keep the newest validation PSNR."""
        self._validation = psnr

    def advance(self, step: int, *, loss: float, skipped: int, waited: float) -> None:
        """Show the progress after ``step`` updates, between which the devices waited for input for so many seconds."""
        now = time.monotonic()
        if self._began is None:  # the first report comes after the compilation: measure speed from there
            self._began, self._first, self._waited_before = now, step, waited
        passed = max(now - self._began, 1e-9)
        rate = (step - self._first) / passed
        state = f"loss {loss:.4f}"
        if self._validation == self._validation:
            state += f"  validation {self._validation:.2f} dB"
        if rate > 0:
            state += f"  {rate * self._recipe.batch * self._recipe.frames:.0f} frames/s"
            state += f"  waiting for input {100 * (waited - self._waited_before) / passed:.0f} %"
        if skipped:
            state += f"  {skipped} skipped (gradient not finite)"
        self._bar.update(self._task, completed=step, state=state)
        if self._bar.disable and (now - self._printed > 15 or step == self._recipe.steps):
            left = f"  {(self._recipe.steps - step) / rate:.0f} s left" if rate > 0 else ""
            self.print(f"{self._label}: step {step}/{self._recipe.steps}  {state}{left}")
            self._printed = now
