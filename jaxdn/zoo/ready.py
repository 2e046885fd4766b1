"""The model zoo: denoisers that are ready to run. Filters, shipped weights, weights in a file, the noisy image.

The command line, comparisons, the chart, long runs and the hard cases look up names of methods here.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser, Params
from jaxdn.methods.registry import Method, is_method, method_named, methods
from jaxdn.methods.stabilised import stabilised
from jaxdn.networks.backends import Purpose
from jaxdn.zoo.weights import describe, load_weights, shipped_names

NOISY = "noisy"
"""The name of the noisy image itself."""

STABILISED = "stabilised:"
"""What stands before a name to have it stabilised (:func:`jaxdn.stabilised`)."""

DEFAULT_MODEL = "steady-balanced"
"""The shipped weights that reports open on: those that `jaxdn denoise` uses on our own clips without a pixel filter."""

BEST_ELSEWHERE = "combiner-high"
"""What is best on filtered pixels, of Cycles and of ours, that nothing here was trained on or chosen by
(``docs/results``): what `jaxdn denoise` uses there, and so on other renderers' files, if its package is installed."""

AUTO = "auto"
"""The name that leaves the choice to :func:`choose_model`."""


class Model(NamedTuple):
    """A denoiser that is ready to run."""

    label: str
    """The name in tables."""
    denoiser: Denoiser | None
    """None is the noisy image itself."""
    params: Params
    method: Method | None = None
    """Its row in the table of methods."""
    options: Mapping[str, Any] = {}
    """The options given to its factory."""

    def backend(self, purpose: Purpose = "inference") -> str | None:
        """The backend that runs it fastest here (:meth:`jaxdn.methods.registry.Method.backend`); None is XLA."""
        return None if self.method is None else self.method.backend(purpose)


class ModelChoice(NamedTuple):
    """What :func:`choose_model` chose."""

    name: str
    reason: str
    """For a person, with what to do for another choice."""


def choose_model(*, through_centres: bool) -> ModelChoice:
    """What is best for the frames at hand: with rays through the pixels' centres, as our renderer makes them unless it
    is told otherwise, or with filtered pixels, as other renderers' files and our clips of ``--pixel-filter`` have them.
    """
    if through_centres:
        return ModelChoice(DEFAULT_MODEL, "best where jaxdn renders through the pixels' centres")
    best = _method_of(BEST_ELSEWHERE)
    if best.installed:
        return ModelChoice(BEST_ELSEWHERE, f"best on filtered pixels; {DEFAULT_MODEL} is on rays through their centres")
    return ModelChoice(DEFAULT_MODEL, f"{BEST_ELSEWHERE} is better on such frames: {best.remedy}")


def find_model(name: str, **options: Any) -> Model:
    """``noisy``, a filter (``svgf``), shipped weights (``ntd-large``) or the path of a .safetensors file.

    A filter of another package may be given by its address, ``package.module:name``. ``stabilised:`` before any of them
    gives it a history (:func:`jaxdn.stabilised`).

    ``options`` are passed to the factory and replace those that the weights were saved with. Raises ValueError for any
    other name, for a learned method without weights, and for options that the method does not have, and
    ModuleNotFoundError for a method whose package is not installed.
    """
    if name.startswith(STABILISED):
        inner = find_model(name.removeprefix(STABILISED), **options)
        if inner.denoiser is None:
            raise ValueError(f"method {name!r}: expected a method that denoises after {STABILISED}, got {NOISY!r}.")
        return inner._replace(label=f"stabilised-{inner.label}", denoiser=stabilised(inner.denoiser))
    if name == NOISY:
        if options:
            raise ValueError(f"{', '.join(options)}: expected a method, got {name!r}, which has no options.")
        return Model(name, None, {})
    if not name.endswith(".safetensors") and is_method(name):
        method = method_named(name)
        if not method.filter:
            trained = [shipped for shipped in shipped_names() if _method_of(shipped).name == name]
            raise ValueError(
                f"method {name!r}: expected its weights, {', '.join([*trained, 'the path of a .safetensors file'])}; "
                "`jaxdn train` makes some."
            )
        method.require()
        return Model(name.rpartition(":")[2], method.factory(**options), {}, method, options)
    if not name.endswith(".safetensors") and name not in shipped_names():
        raise ValueError(
            f"method {name!r}: expected one of {', '.join(all_names())} or the path of a .safetensors file."
        )
    method = _method_of(name)
    method.require()
    denoiser, params = load_weights(name, **options)
    path = Path(name)
    # A run's folder is a better label than the file name, which is the same for all runs.
    label = (path.absolute().parent.name if path.stem == "weights" else "") or path.stem
    return Model(label, denoiser, params, method, describe(name)["options"] | options)


def untrained_model(method: Method, **options: Any) -> Model:
    """A learned method in its smallest variant, with initial weights."""
    given = {**method.variant_named(None), **options}
    denoiser = method.factory(**given)
    return Model(method.name, denoiser, denoiser.init(jax.random.key(0), _smallest()), method, given)


def filter_names() -> list[str]:
    """The names of the methods that denoise without training, and that can run here."""
    return [name for name, method in methods().items() if method.filter and method.installed]


def all_names() -> list[str]:
    """Every name that :func:`find_model` knows: the noisy image, filters, and shipped weights."""
    return [NOISY, *filter_names(), *ready_names()]


def ready_names() -> list[str]:
    """The names of the shipped weights whose methods can run here."""
    return [name for name in shipped_names() if _method_of(name).installed]


def all_models() -> Iterator[Model]:
    """Filters, shipped weights, and learned methods without shipped weights, with initial weights."""
    yield from (find_model(name) for name in all_names() if name != NOISY)
    trained = {_method_of(name).name for name in shipped_names()}
    untrained = (method for method in methods().values() if not method.filter and method.name not in trained)
    yield from (untrained_model(method) for method in untrained if method.installed)


def _method_of(weights: str | Path) -> Method:
    """The method of shipped weights, or of a file."""
    return method_named(describe(weights)["factory"])


def _smallest() -> Frame:
    return Frame(jnp.zeros((16, 16, 3), jnp.float32))
