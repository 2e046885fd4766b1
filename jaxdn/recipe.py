"""Training recipes: how a method is trained, as plain data; each learned method has its own."""

from typing import Any, NamedTuple

from jaxdn.objectives import Objective


class Recipe(NamedTuple):
    """The objective, the optimiser (Adam) and its batches."""

    objective: Objective
    steps: int = 2000
    """Total number of parameter updates."""
    learning_rate: float = 1e-3
    """Peak learning rate of Adam."""
    decay: bool = True
    """Warm-up over the first 2 % and cosine decay to a hundredth; else the rate is constant."""
    clip_norm: float = 1.0
    """Largest global norm of a gradient; 0 for no limit."""
    batch: int = 4
    crop: int = 64
    frames: int = 10
    """Frames of a clip that the gradient is propagated back through."""
    rematerialize: bool = False
    """Recompute each step in the backward pass: a quarter of the memory for 1.1 to 1.4 times the time."""
    seed: int = 0

    def record(self) -> dict[str, Any]:
        """The recipe as JSON; the objective by its name."""
        return {**self._asdict(), "objective": self.objective.name}
