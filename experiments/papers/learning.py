"""What each choice in training brings, at equal time: one network per row, each row changes one thing.

    python -m experiments.papers.learning data/train --tests data/scenes data/validation --minutes 8

First each row of SMALL, the network of ``ntd``, changes the one before; the later ones each change one thing of an
earlier row. See :mod:`experiments.papers.equal_time` for how rows are trained. Run nothing else meanwhile.
"""

import tyro

from experiments.papers.equal_time import Row, Settings, Study, run
from experiments.papers.other_clips import every_other, half_reference, three_of_four, without_draws
from jaxdn.commands.errors import plain_errors
from jaxdn.recipes.augmentation import STILL, Variation
from jaxdn.recipes.objectives import indirect_illumination, pyramid_illumination, unbiased_illumination

_STEPS = (
    Row(
        "as in version 0.1",
        options={"kernels": "plain", "background": "filter", "exposure": "given", "initialization": "xavier"},
        recipe={"objective": indirect_illumination(), "variation": STILL, "average": 0.0},
    ),
    Row("guided kernels", options={"kernels": "guided"}),
    Row("background passes", options={"background": "pass"}),
    Row("initial weights by He", options={"initialization": "he"}),
    Row("mean of weights", recipe={"average": 0.98}),
    Row("exposure measured", options={"exposure": "measured"}),
    Row("varied clips", recipe={"variation": Variation()}),
    Row("1 to 16 samples", recipe={"spp": (1, 1, 1, 2, 4, 16)}),
    Row("squares without bias", recipe={"objective": unbiased_illumination(squared_from=0.0)}),
)
LADDER = (_STEPS[0], *(row._replace(on=_STEPS[index].name) for index, row in enumerate(_STEPS[1:])))
"""Each row changes the row before."""

_LAST = LADDER[-1].name
BRANCHES = (
    Row("bands of a pyramid", _LAST, recipe={"objective": pyramid_illumination()}),
    Row("hidden pixels not weighted", _LAST, recipe={"objective": unbiased_illumination(hidden=0.0, squared_from=0.0)}),
    Row("one noisy image a frame", "varied clips", clips=without_draws),
    Row("half the clips", _LAST, clips=every_other),
    Row("three quarters of the clips", _LAST, clips=three_of_four),
    Row("half the samples in references", _LAST, recipe={"spp": (1, 1, 1, 2, 4)}, clips=half_reference),
    Row("windows of half as many frames", _LAST, batch=(2.0, 1.0, 0.5)),
    Row("smaller crops", _LAST, batch=(2.0, 2 / 3, 1.0)),
    Row("half batches", _LAST, batch=(0.5, 1.0, 1.0)),
    Row("materials seen", _LAST, options={"guides": "materials"}),
    Row("from shipped weights", _LAST, start="ntd-small"),
)
"""Each changes one thing of the row that it names."""


def study() -> Study:
    """The rows of ``ntd``."""
    return Study("ntd", {"size": "small"}, "usual", (*LADDER, *BRANCHES))


if __name__ == "__main__":
    with plain_errors():
        run(study, tyro.cli(Settings, description=__doc__))
