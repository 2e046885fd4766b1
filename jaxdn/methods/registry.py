"""The one table of methods: what each denoising system is called, what its options are, how it is trained and run.

A new method is one new file in this package. It declares its options as a frozen dataclass and decorates the function
that makes a denoiser of them with :func:`method`; the command line, training, comparisons, chart, benchmark, hard
cases and documentation read the table and know no method by name.
"""

import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from jaxdn.core import options as declared
from jaxdn.denoiser import Denoiser
from jaxdn.networks.backends import BACKENDS, Purpose
from jaxdn.ops.dispatch.operation import REFERENCE, default_implementation
from jaxdn.recipes.recipe import Recipe

_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclasses.dataclass(frozen=True)
class Method:
    """One row of the table."""

    name: str
    """The factory's name in :mod:`jaxdn.denoisers`, and that of the method on the command line."""
    title: str
    """What it is and who described it, in a line."""
    factory: Callable[..., Denoiser]
    """(**options) -> Denoiser."""
    options: type
    """The frozen dataclass of its options."""
    presets: Mapping[str, Any]
    """Name -> options, for the option ``preset``."""
    recipes: Mapping[str, Recipe]
    """Name -> how it is trained, the usual one first; empty if it has nothing to learn."""
    variants: Mapping[str, Mapping[str, Any]]
    """Names of weights that are or may be shipped -> options, from the most accurate to the fastest."""
    backends: tuple[str, ...]
    """Values of its option ``implementation`` besides XLA: names in :data:`jaxdn.networks.backends.BACKENDS`."""
    earlier: Mapping[str, Any]
    """Options that weights without a record of them were trained with, where the default is another today."""
    filter: bool
    """It denoises without training: its params are ``{}``, or move its options (``learnable_options``)."""

    @property
    def learns(self) -> bool:
        """Whether it can be trained."""
        return bool(self.recipes)

    def recipe_named(self, name: str | None) -> Recipe:
        """A recipe; None is the usual one. Raises ValueError, naming those there are."""
        if not self.recipes:
            raise ValueError(f"{self.name}: expected a method that learns, and this one has nothing to learn.")
        if name is not None and name not in self.recipes:
            raise ValueError(f"{self.name}: expected a recipe out of {', '.join(self.recipes)}, got {name!r}.")
        return next(iter(self.recipes.values())) if name is None else self.recipes[name]

    def variant_named(self, name: str | None) -> Mapping[str, Any]:
        """The options of a variant; None is the fastest. Raises ValueError, naming those there are."""
        if name is None:
            return list(self.variants.values())[-1] if self.variants else _NOTHING
        if name not in self.variants:
            raise ValueError(f"{self.name}: expected a variant out of {', '.join(self.variants)}, got {name!r}.")
        return self.variants[name]

    def made(self, given: Mapping[str, Any]) -> Any:
        """The checked options, an instance of :attr:`options`, from ``given`` ones, among them ``preset``.

        Raises ValueError for an unknown option, preset or value.
        """
        given, base = dict(given), None
        if self.presets and (chosen := given.pop("preset", None)) is not None:
            if chosen not in self.presets:
                raise ValueError(f"{self.name} preset: expected one of {', '.join(self.presets)}, got {chosen!r}.")
            base = self.presets[chosen]
        return declared.make(self.options, given, method=self.name, base=base)

    def knows(self, option: str) -> bool:
        """Whether it has an option of that name."""
        return any(each.name == option for each in dataclasses.fields(self.options))

    def backend(self, purpose: Purpose, options: Mapping[str, Any] = _NOTHING) -> str | None:
        """The backend that runs it fastest here, for the option ``implementation``; None is XLA.

        It is None too where :func:`jaxdn.implementation` or its environment variable asks for references.
        """
        if options.get("compute_dtype") not in (None, "float32") or default_implementation() == REFERENCE:
            return None
        fitting = (BACKENDS[name] for name in self.backends if BACKENDS[name].purpose == purpose)
        return next((each.name for each in fitting if each.available() and each.faster()), None)


_METHODS: dict[str, Method] = {}


def method(
    options: type,
    *,
    title: str,
    presets: Mapping[str, Any] = _NOTHING,
    recipes: Mapping[str, Recipe] = _NOTHING,
    variants: Mapping[str, Mapping[str, Any]] = _NOTHING,
    backends: tuple[str, ...] = (),
    earlier: Mapping[str, Any] = _NOTHING,
    filter: bool | None = None,
) -> Callable[[Callable[[Any], Denoiser]], Callable[..., Denoiser]]:
    """Decorator: enter ``build(options) -> Denoiser`` in the table and make it a factory ``(**options) -> Denoiser``.

    The factory checks what it is given (:func:`jaxdn.core.options.make`), and takes ``preset=`` where there are
    presets. The arguments are the columns of :class:`Method`; the function's name is the method's. Without recipes it
    is a filter.
    """
    ready = not recipes if filter is None else filter

    def enter(build: Callable[[Any], Denoiser]) -> Callable[..., Denoiser]:
        name = build.__name__

        def factory(**given: Any) -> Denoiser:
            return build(row.made(given))

        factory.__name__ = factory.__qualname__ = name
        factory.__module__ = build.__module__
        lines = [f"* ``preset``: None or one of {', '.join(map(repr, presets))}"] if presets else []
        listed = "\n".join([*lines, declared.describe(options)])
        factory.__doc__ = f"{inspect.cleandoc(build.__doc__ or title)}\n\nOptions:\n\n{listed}"
        keyword = inspect.Parameter.KEYWORD_ONLY
        signature = [
            inspect.Parameter(each.name, keyword, default=each.default, annotation=each.type)
            for each in dataclasses.fields(options)
        ]
        if presets:
            signature.append(inspect.Parameter("preset", keyword, default=None, annotation=str | None))
        factory.__signature__ = inspect.Signature(signature, return_annotation=Denoiser)  # type: ignore[attr-defined]
        row = Method(name, title, factory, options, presets, recipes, variants, backends, earlier, ready)
        _METHODS[name] = row
        return factory

    return enter


def methods() -> dict[str, Method]:
    """All methods by name, in alphabetical order: those of this package, and those that other modules have entered."""
    package = importlib.import_module(__package__)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{__package__}.{module.name}")
    return dict(sorted(_METHODS.items()))


def method_named(name: str) -> Method:
    """One row. Raises ValueError, naming the methods there are."""
    known = methods()
    if name not in known:
        raise ValueError(f"method {name!r}: expected one of {', '.join(known)}.")
    return known[name]
