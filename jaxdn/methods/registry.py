"""The registry of methods: what each denoising system is called, what its options are, how it is trained and run.

A method is a file. It declares its options as a frozen dataclass and decorates the function that makes a denoiser of
them with :func:`method`; the command line, training, comparisons, chart, benchmark, hard cases and documentation read
the registry and know no method by name.

The file lies in this package, or in any other. Another package names its methods as entry points of the group
:data:`ENTRY_POINTS` in its pyproject.toml, and they have their names as soon as it is installed::

    [project.entry-points."jaxdn.methods"]
    running_mean = "mypackage.denoisers:running_mean"

Without an entry point a method is called ``mypackage.denoisers:running_mean`` wherever a name of a method is wanted.
"""

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import pkgutil
import warnings
from collections.abc import Callable, Mapping
from importlib import metadata
from types import MappingProxyType
from typing import Any

from jaxdn.core import options as declared
from jaxdn.denoiser import Denoiser
from jaxdn.networks.backends import BACKENDS, Purpose
from jaxdn.ops.dispatch.operation import REFERENCE, default_implementation
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.optional import find_group, install

ENTRY_POINTS = "jaxdn.methods"
"""The group of entry points of installed packages."""
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclasses.dataclass(frozen=True)
class Method:
    """One row of the registry."""

    name: str
    """The factory's name in :mod:`jaxdn.denoisers`, and that of the method on the command line: of a method that was
    loaded from another package by its address, ``module:name``."""
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
    filter: bool
    """It denoises without training: its params are ``{}``, or move its options (``learnable_options``)."""
    requires: str = ""
    """The module of an optional package that it cannot run without."""
    differentiable: bool = True
    """Its images have gradients."""
    sparse: bool = False
    """It is given frames in which only some pixels have samples (``sample_count``), and its images are whole."""

    @property
    def learns(self) -> bool:
        """Whether it can be trained."""
        return bool(self.recipes)

    @property
    def installed(self) -> bool:
        """Whether the package that it requires is there."""
        return not self.requires or importlib.util.find_spec(self.requires) is not None

    @property
    def remedy(self) -> str:
        """What brings the package that it requires."""
        extra = find_group(self.requires)
        return install(extra) if extra else f"install the package of {self.requires}"

    def require(self) -> None:
        """Raise ModuleNotFoundError, saying what to install, unless it can run here."""
        if not self.installed:
            raise ModuleNotFoundError(
                f"{self.name}: expected the package {self.requires}, which is not installed: {self.remedy}",
                name=self.requires,
            )

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

    def parse_options(self, given: Mapping[str, Any]) -> Any:
        """The checked options, an instance of :attr:`options`, from ``given`` ones, among them ``preset``.

        Raises ValueError for an unknown option, preset or value.
        """
        given, base = dict(given), None
        if self.presets and (chosen := given.pop("preset", None)) is not None:
            if chosen not in self.presets:
                raise ValueError(f"{self.name} preset: expected one of {', '.join(self.presets)}, got {chosen!r}.")
            base = self.presets[chosen]
        return declared.make(self.options, given, method=self.name, base=base)

    def has_option(self, option: str) -> bool:
        """Whether it has an option of that name."""
        return any(field.name == option for field in dataclasses.fields(self.options))

    def backend(self, purpose: Purpose) -> str | None:
        """The backend that runs it fastest here, for the option ``implementation``; None is XLA.

        It is None too where :func:`jaxdn.implementation` or its environment variable asks for references.
        """
        if default_implementation() == REFERENCE:
            return None
        backends = (BACKENDS[name] for name in self.backends if BACKENDS[name].purpose == purpose)
        return next((backend.name for backend in backends if backend.available() and backend.faster()), None)


_METHODS: dict[str, Method] = {}


def method(
    options: type,
    *,
    title: str,
    presets: Mapping[str, Any] = _NOTHING,
    recipes: Mapping[str, Recipe] = _NOTHING,
    variants: Mapping[str, Mapping[str, Any]] = _NOTHING,
    backends: tuple[str, ...] = (),
    filter: bool | None = None,
    requires: str = "",
    differentiable: bool = True,
    sparse: bool = False,
) -> Callable[[Callable[[Any], Denoiser]], Callable[..., Denoiser]]:
    """Decorator: enter ``build(options) -> Denoiser`` in the registry, as a factory ``(**options) -> Denoiser``.

    The factory checks what it is given (:func:`jaxdn.core.options.make`), and takes ``preset=`` where there are
    presets. The arguments are the columns of :class:`Method`; the function's name is the method's. Without recipes it
    is a filter. Raises ValueError for the name of another module's method.
    """
    ready = not recipes if filter is None else filter

    def enter(build: Callable[[Any], Denoiser]) -> Callable[..., Denoiser]:
        name = build.__name__

        def factory(**given: Any) -> Denoiser:
            return build(row.parse_options(given))

        factory.__name__ = factory.__qualname__ = name
        factory.__module__ = build.__module__
        lines = [f"* ``preset``: None or one of {', '.join(map(repr, presets))}"] if presets else []
        listed = "\n".join([*lines, declared.describe(options)])
        factory.__doc__ = f"{inspect.cleandoc(build.__doc__ or title)}\n\nOptions:\n\n{listed}"
        keyword = inspect.Parameter.KEYWORD_ONLY
        signature = [
            inspect.Parameter(field.name, keyword, default=field.default, annotation=field.type)
            for field in dataclasses.fields(options)
        ]
        if presets:
            signature.append(inspect.Parameter("preset", keyword, default=None, annotation=str | None))
        factory.__signature__ = inspect.Signature(signature, return_annotation=Denoiser)  # type: ignore[attr-defined]
        if name in _METHODS and _METHODS[name].factory.__module__ != build.__module__:
            other = _METHODS[name].factory.__module__
            raise ValueError(f"method {name!r} of {build.__module__}: expected a name of its own; {other} has it too.")
        columns = (options, presets, recipes, variants, backends, ready, requires, differentiable, sparse)
        row = Method(name, title, factory, *columns)
        _METHODS[name] = row
        return factory

    return enter


def methods() -> dict[str, Method]:
    """All methods by name, in alphabetical order: those of this package, of entry points, and others that are imported.

    An installed package whose methods cannot be imported is left out, with a warning.
    """
    package = importlib.import_module(__package__)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{__package__}.{module.name}")
    for entry in _entry_points():
        try:
            entry.load()
        except Exception as error:  # whatever another package does wrong must not stop the commands
            warnings.warn(f"method {entry.name!r} ({entry.value}) cannot be imported: {error!r}", stacklevel=2)
    return dict(sorted(_METHODS.items()))


@functools.cache
def _entry_points() -> tuple[metadata.EntryPoint, ...]:
    """Those of installed packages; the search takes some milliseconds."""
    return tuple(metadata.entry_points(group=ENTRY_POINTS))


def method_named(name: str) -> Method:
    """One row, by its name or by the address ``module:name``.

    Raises ValueError for an unknown name, naming the methods there are, and for an address without a method.
    """
    if ":" in name:
        return _method_at(name)
    known = methods()
    if name not in known:
        raise ValueError(f"method {name!r}: expected one of {', '.join(known)}, or an address package.module:name.")
    return known[name]


def is_method(name: str) -> bool:
    """Whether :func:`method_named` knows a name; every address counts as one."""
    return ":" in name or name in methods()


def _method_at(address: str) -> Method:
    """The method of an address; its row has the address as name, so that weights tell where the method is from.

    An address is an entry point that no package has declared.
    """
    module, _, name = address.partition(":")
    methods()  # before the module is imported, so that it is the one to be told that a name is taken
    try:
        factory = metadata.EntryPoint(name, address, ENTRY_POINTS).load() if module and name else None
    except AttributeError:
        factory = None
    except ImportError as error:
        raise ValueError(
            f"method {address!r}: expected a module that can be imported, got {error}; install its package, or put its "
            "folder on PYTHONPATH."
        ) from error
    for row in _METHODS.values():
        if factory is not None and row.factory is factory:
            named = module.startswith(f"{__package__}.") or any(entry.value == address for entry in _entry_points())
            return row if named else dataclasses.replace(row, name=address)
    raise ValueError(
        f"method {address!r}: expected a function of {module} that jaxdn.methods.registry.method decorates, got "
        f"{factory!r}."
    )
