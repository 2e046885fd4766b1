"""What each choice in ``steady``'s design and training brings, at equal time: every row takes one away.

    python -m experiments.papers.choices data/train --tests data/scenes data/families --minutes 8 --spp 1 16

The first row is ``steady-balanced`` as it is, trained from new weights; in each other row one thing is left out or done
in another way. See :mod:`experiments.papers.equal_time` for how rows are trained. What has no option in the method is
replaced in its code for the row's process. Run nothing else meanwhile.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import tyro

from experiments.papers.equal_time import Row, Settings, Study, run
from experiments.papers.other_clips import half_reference, without_draws
from jaxdn.commands.errors import plain_errors
from jaxdn.methods.steady import levels, method
from jaxdn.methods.steady.levels import Decisions
from jaxdn.recipes.augmentation import STILL
from jaxdn.recipes.objectives import indirect_illumination, pyramid_illumination, unbiased_illumination

_Shares = dict[str, jax.Array]
_Change = Callable[[], AbstractContextManager[Any]]

_AS_IT_IS, _ONE = "steady-balanced as it is", "1 sample alone"


def _quality(**changed: Any) -> _Change:
    """The quality "balanced" with other fields."""
    balanced = method.QUALITIES["balanced"]._replace(**changed)
    return functools.partial(mock.patch.dict, method.QUALITIES, balanced=balanced)


def _unguided(*names: str) -> _Change:
    """The filter does not see some of its guides, the network does."""
    plain = levels._at_level

    def at_level(guide: Any, factors: dict[str, jax.Array], index: int) -> Any:
        nothing = {name: jnp.zeros_like(factors[name]) for name in names}
        return plain(guide, {**factors, **nothing}, index)

    return functools.partial(mock.patch.object, levels, "_at_level", at_level)


def _decided(change: Callable[[Decisions, _Shares], tuple[Decisions, _Shares]]) -> _Change:
    """Some decisions are replaced by others."""
    plain = method.decisions
    return functools.partial(mock.patch.object, method, "decisions", lambda head, size: change(*plain(head, size)))


def _no_trust(decided: Decisions, shares: _Shares) -> tuple[Decisions, _Shares]:
    return decided._replace(trust=jnp.ones_like(decided.trust), half_trust=jnp.ones_like(decided.half_trust)), shares


def _levels_whole(decided: Decisions, shares: _Shares) -> tuple[Decisions, _Shares]:
    whole = [jnp.ones_like(take) for take in decided.take]
    return decided._replace(take=whole, coarse=jnp.ones_like(decided.coarse)), shares


def _one_over_n(decided: Decisions, shares: _Shares) -> tuple[Decisions, _Shares]:
    return decided, {**shares, "follow": jnp.full_like(shares["follow"], 0.5)}


def _newest_output(decided: Decisions, shares: _Shares) -> tuple[Decisions, _Shares]:
    return decided, {**shares, "blend": jnp.ones_like(shares["blend"])}


def _nothing_fed_back(decided: Decisions, shares: _Shares) -> tuple[Decisions, _Shares]:
    return decided, {**shares, "feedback": jnp.zeros_like(shares["feedback"])}


def _decided_alike() -> AbstractContextManager[Any]:
    """All pixels get the mean of what the network says."""
    plain = method.decisions

    def decisions(head: jax.Array, size: tuple[int, int]) -> Any:
        return plain(jnp.broadcast_to(head.mean((0, 1), keepdims=True), head.shape), size)

    return mock.patch.object(method, "decisions", decisions)


@contextlib.contextmanager
def _number_of_levels(number: int) -> Iterator[None]:
    with mock.patch.object(levels, "LEVELS", number), mock.patch.object(method, "LEVELS", number):
        yield


def _untested() -> AbstractContextManager[Any]:
    """Every tap of the history counts."""
    plain = method.recall

    def recall(history: jax.Array, before: Any, *rest: Any) -> Any:
        return plain(history, before._replace(depth=None, normal=None, ids=None), *rest)

    return mock.patch.object(method, "recall", recall)


def _row(name: str, change: _Change = contextlib.nullcontext, **more: Any) -> Row:
    return Row(name, _AS_IT_IS, change=change, **more)


DESIGN = (
    _row("another seed", recipe={"seed": 1}),
    _row("surfaces do not stop the filter", _unguided("albedo", "gloss", "normal", "depth")),
    _row("learned features do not stop the filter", _unguided("learned")),
    _row("gloss does not stop the filter", _unguided("gloss")),
    _row("the same decisions for all pixels", _decided_alike),
    _row("all pixels are trusted", _decided(_no_trust)),
    _row("every level is taken whole", _decided(_levels_whole)),
    _row("the newest frame counts as one of N + 1", _decided(_one_over_n)),
    _row("the last output is not blended with", _decided(_newest_output)),
    _row("nothing filtered enters the mean", _decided(_nothing_fed_back)),
    _row("taps of the history are not tested", _untested),
    _row("a mean of 8 frames at most", options={"history_max": 8.0}),
    _row("nothing is given back by regression", _quality(back=False)),
    _row("changes of light wait", _quality(at_once=False)),
    _row("one level at full resolution", _quality(full_levels=1)),
    _row("three levels at half resolution", functools.partial(_number_of_levels, 3)),
    _row("textures are not given back", functools.partial(mock.patch.object, method, "texture_left", lambda *_: None)),
    _row("light is not divided", options={"demodulate": False}),
    _row(
        "single bright pixels stay",
        functools.partial(mock.patch.object, method, "dimmed", lambda image, hit, mean: image),
    ),
    _row("the network of high", options={"quality": method.QUALITIES["high"].widths}),
    _row("the network of fast", options={"quality": method.QUALITIES["fast"].widths}),
)
"""Of the denoiser."""

TRAINING = (
    _row("the paper's loss", recipe={"objective": indirect_illumination()}),
    _row("squares", recipe={"objective": unbiased_illumination(squared_from=0.0)}),
    _row("the logarithm of the loss", recipe={"objective": pyramid_illumination(logarithm=True)}),
    _row(_ONE, recipe={"spp": (1,)}),
    _row("nothing varied", recipe={"variation": STILL}),
    _row("the newest weights, no mean", recipe={"average": 0.0}),
    Row("one noisy image a frame", _ONE, clips=without_draws),
    _row("references of half the samples", clips=half_reference, recipe={"spp": (1, 1, 1, 2, 4)}),
    _row("windows of half as many frames", batch=(2.0, 1.0, 0.5)),
    _row("a quarter as many crops, twice as wide", batch=(0.25, 2.0, 1.0)),
    _row("half batches", batch=(0.5, 1.0, 1.0)),
    _row("from shipped weights", start="steady-balanced"),
)
"""Of how it is trained."""


def study() -> Study:
    """The rows of ``steady``."""
    first = Row(_AS_IT_IS, recipe={"spp": (1, 1, 1, 2, 4, 16)})
    return Study("steady", {"quality": "balanced"}, "usual", (first, *DESIGN, *TRAINING))


if __name__ == "__main__":
    with plain_errors():
        run(study, tyro.cli(Settings, description=__doc__))
