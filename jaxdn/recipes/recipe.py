"""Training recipes: how a method is trained, as plain data; each learned method has its own."""

from typing import Annotated, Any, NamedTuple, get_type_hints

from jaxdn.core.options import Range, check
from jaxdn.recipes.augmentation import Augmentation
from jaxdn.recipes.objectives import Objective, pyramid_illumination


class Recipe(NamedTuple):
    """The objective, the optimiser (Adam) and its batches."""

    objective: Objective
    steps: Annotated[int, Range(1)] = 2000
    """Total number of parameter updates."""
    learning_rate: Annotated[float, Range(0, without_low=True)] = 1e-3
    """Peak learning rate of Adam."""
    decay: bool = True
    """Warm-up over the first 2 % and cosine decay to a hundredth; else the rate is constant."""
    clip_norm: Annotated[float, Range(0)] = 1.0
    """Largest global norm of a gradient; 0 for no limit."""
    batch: Annotated[int, Range(1)] = 4
    crop: Annotated[int, Range(1)] = 64
    frames: Annotated[int, Range(1)] = 10
    """Frames of a clip that the gradient is propagated back through."""
    rematerialize: bool = False
    """Recompute each step in the backward pass: a quarter of the memory for 1.1 to 1.4 times the time."""
    average: Annotated[float, Range(0, 0.99999)] = 0.998
    """The weights that are kept are a running mean: this share of the mean so far (less in the first updates) and the
    rest of the newest. 0 keeps the newest."""
    spp: tuple[Annotated[int, Range(1)], ...] = (1,)
    """Samples per pixel of the noisy input; of several numbers, each element of a batch has one at random."""
    variation: Augmentation = Augmentation()
    """What each element is varied by."""
    seed: Annotated[int, Range(0)] = 0

    def check(self) -> None:
        """Raise ValueError, naming the field and what is allowed, for a value that nothing can be trained with."""
        check(self._asdict(), get_type_hints(Recipe, include_extras=True), of="recipe")
        self.variation.check()

    def scale_rate(self, batch: int, power: float) -> float:
        """The learning rate for another batch: times ``(batch / self.batch)^power``.

        1 keeps how far the weights move in one pass over the data (Goyal et al. 2017), 1/2 the noise of an update of
        Adam (Malladi et al. 2022).
        """
        return self.learning_rate * (batch / self.batch) ** power

    def record(self) -> dict[str, Any]:
        """The recipe as JSON; the objective by its name."""
        plain = {"objective": self.objective.name, "spp": list(self.spp), "variation": self.variation._asdict()}
        return {**self._asdict(), **plain}


FINISH = Recipe(
    pyramid_illumination(logarithm=True),
    steps=800,
    learning_rate=4e-4,
    batch=2,
    crop=128,
    average=0.995,
    spp=(1, 1, 1, 2, 4, 16),
    variation=Augmentation(shadow=0.2),
)
"""For weights that have been trained: whole clips, in which the widest filters have something to reach for; and
light that changes, so that histories are given up as fast."""
