"""An operation with several implementations, and the choice among them.

The reference is readable jax for every platform and dtype. Faster forms are declared beside it::

    @operation
    def fill_holes(image, known): ...

    @fill_holes.implementation("numba", platforms=("cpu",), dtypes=(jnp.float32,), differentiable=False,
                               unavailable=numba_call.unavailable)
    def _fill_by_numba(image, known): ...

Positional arguments of an operation are pytrees of arrays; keywords are constants of the program. Every call takes
``implementation=None | <name>`` besides:

- A name runs that implementation, or raises ValueError with the reason and the names that run here. Its gradient is
  its own, else the reference's, for which the reference is recomputed.
- None runs the first declared implementation that is meant for this platform and takes the arguments, else the
  reference. One without a gradient of its own serves inference: under ``jax.grad`` and ``jax.vmap`` the next one
  that has a gradient computes value and gradient. Training differentiates programs of many clips at once, for which
  XLA is as fast.

The choice is made during tracing and costs nothing at run time. It depends on the :func:`platform`: on CPUs work runs
by strips of rows that fit into the cache, and their number depends on the image's size. A program that is exported
should run anywhere and for images of any size, so it is traced without all of that.

:func:`implementation` sets the default of a block, the environment variable ``JAXDN_IMPLEMENTATION`` that of a process.
"""

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, overload

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

REFERENCE = "reference"
"""The name of the implementation that every operation has."""
VARIABLE = "JAXDN_IMPLEMENTATION"
"""Environment variable: ``auto`` or ``reference``."""
DEFAULTS = ("auto", REFERENCE)

ANY = "any"
"""The platform of portable programs."""

OPERATIONS: dict[str, "Operation[..., Any]"] = {}
"""Every operation of the modules that have been imported, by name."""

# A part of the key of jax's caches: a jitted function is traced again where the default differs. (And once more if it
# was traced before this module was imported, when the key did not have that part.)
_default = jax.make_user_context(default_value=None)
_portable: ContextVar[bool] = ContextVar("portable", default=False)


class NotPortableError(ValueError):
    """What was traced inside :func:`portable` runs in this process alone."""


def platform() -> str:
    """``"cpu"``, ``"gpu"`` or ``"tpu"``, where jax computes; :data:`ANY` inside :func:`portable`."""
    return ANY if _portable.get() else jax.default_backend()


@contextmanager
def portable() -> Iterator[None]:
    """Inside, programs are traced for any platform: reference implementations, and no strips."""
    token = _portable.set(True)
    try:
        yield
    finally:
        _portable.reset(token)


def implementation(name: str) -> AbstractContextManager[None]:
    """Context manager: what ``implementation=None`` means in programs that are traced inside the block.

    ``"auto"`` is the fastest implementation of each operation, ``"reference"`` its readable form in jax, for example to
    find out whether a result depends on a faster one. Without a block the environment variable
    ``JAXDN_IMPLEMENTATION`` decides; it is ``auto`` if it is not set. Raises ValueError for another name.
    """
    return _default(_checked_default(name, "implementation"))


def default_implementation() -> str:
    """What None means, see :func:`implementation`. Raises ValueError for another value of the variable."""
    return _default.value or _checked_default(os.environ.get(VARIABLE) or "auto", VARIABLE)


def _checked_default(name: str, where: str) -> str:
    if name not in DEFAULTS:
        raise ValueError(f"{where}: expected one of {', '.join(DEFAULTS)}, got {name!r}.")
    return name


class Implementation(NamedTuple):
    """One way to compute an operation."""

    name: str
    function: Callable[..., Any]
    """Takes the operation's arguments."""
    platforms: tuple[str, ...]
    """Where ``implementation=None`` may select it: ``"cpu"``, ``"gpu"``, ``"tpu"``; elsewhere it runs on request."""
    dtypes: tuple[Any, ...]
    """Of the floating arrays that it takes; empty for all."""
    differentiable: bool
    """Whether it has a gradient of its own."""
    unavailable: Callable[[], str]
    """Why it cannot run here, and what to do; empty where it can."""
    precision: Any
    """Dtype in which it computes, where that is coarser than the arguments' dtype; else None."""

    def refuses(self, arrays: Any) -> str:
        """Why it cannot compute these arrays here; empty if it can."""
        found = {jnp.result_type(leaf) for leaf in jax.tree.leaves(arrays)}
        wrong = [dtype for dtype in found if jnp.issubdtype(dtype, jnp.inexact) and dtype not in self.dtypes]
        if self.dtypes and wrong:
            return f"takes {' or '.join(jnp.dtype(dtype).name for dtype in self.dtypes)}, got {wrong[0].name}"
        return self.unavailable()


class Example(NamedTuple):
    """A call of an operation, for its contract test and for measurements."""

    arguments: tuple[Any, ...]
    """Pytrees of NumPy arrays; floating ones are float64, to be rounded to the dtype that is wanted."""
    options: dict[str, Any] = {}  # noqa: RUF012  (never written to)


class Operation(Generic[P, R]):
    """A function with several implementations; see the module."""

    def __init__(self, reference: Callable[P, R], name: str) -> None:
        functools.update_wrapper(self, reference)
        self.name = name
        self.implementations: dict[str, Implementation] = {}
        self.examples: Callable[[Any, int, int], Iterator[Example]] = lambda rng, height, width: iter(())
        """(random generator, height, width) -> examples of arguments for images of that size."""
        self.implementation(REFERENCE)(reference)
        if name in OPERATIONS:
            raise ValueError(f"operation {name}: expected a new name, and there is one already.")
        OPERATIONS[name] = self

    def implementation(
        self,
        name: str,
        *,
        platforms: tuple[str, ...] = (),
        dtypes: tuple[Any, ...] = (),
        differentiable: bool = True,
        unavailable: Callable[[], str] = lambda: "",
        precision: Any = None,
    ) -> Callable[[F], F]:
        """Decorator: declare a function as the implementation ``name``; see :class:`Implementation` for the facts."""

        def declare(function: F) -> F:
            dtypes_ = tuple(map(jnp.dtype, dtypes))
            facts = name, function, platforms, dtypes_, differentiable, unavailable, precision
            self.implementations[name] = Implementation(*facts)
            return function

        return declare

    def example(self, function: F) -> F:
        """Decorator: declare :attr:`examples`."""
        self.examples = function
        return function

    @overload
    def __call__(self, *arrays: P.args, **options: P.kwargs) -> R: ...
    @overload
    def __call__(self, *arrays: Any, implementation: str | None, **options: Any) -> R: ...
    def __call__(self, *arrays: Any, implementation: str | None = None, **options: Any) -> Any:  # type: ignore[misc]
        """The result, by the named implementation, or with None by :meth:`automatic`."""

        def run(one: Implementation) -> Callable[..., Any]:
            return functools.partial(one.function, **options)

        if implementation is not None:
            named = self.named(implementation, arrays)
            if named.differentiable:
                return run(named)(*arrays)
            return with_gradient_of(run(self.implementations[REFERENCE]), run(named))(*arrays)
        fastest, differentiable = self.automatic(arrays)
        if fastest is differentiable:
            return run(fastest)(*arrays)
        return for_inference(run(fastest), run(differentiable))(*arrays)

    def named(self, name: str, arrays: Any = ()) -> Implementation:
        """The implementation of that name. Raises ValueError if there is none, or if it cannot compute these arrays."""
        if name not in self.implementations:
            known = ", ".join(map(repr, self.implementations))
            raise ValueError(f"implementation of {self.name}: expected None or one of {known}, got {name!r}.")
        if reason := self.implementations[name].refuses(arrays):
            others = (other for other, one in self.implementations.items() if not one.refuses(arrays))
            raise ValueError(
                f'implementation of {self.name}: "{name}" {reason}. These can: {", ".join(map(repr, others))}.'
            )
        return self.implementations[name]

    def automatic(self, arrays: Any = ()) -> tuple[Implementation, Implementation]:
        """What ``implementation=None`` selects: for inference, and where a gradient or a batch is asked for."""
        known = self.implementations
        chosen = [known[REFERENCE]]
        if default_implementation() != REFERENCE:
            here = platform()
            fitting = [one for one in known.values() if here in one.platforms and not one.refuses(arrays)]
            chosen = [*fitting, *chosen]
        return chosen[0], next(one for one in chosen if one.differentiable)


@overload
def operation(reference: Callable[P, R], /) -> Operation[P, R]: ...
@overload
def operation(*, name: str) -> Callable[[Callable[P, R]], Operation[P, R]]: ...
def operation(reference: Any = None, /, *, name: str | None = None) -> Any:
    """Decorator: make a function the reference of an operation of its name, or of another ``name``."""
    if reference is None:
        return lambda function: Operation(function, name or function.__name__)
    return Operation(reference, reference.__name__)


def for_inference(fast: Callable[..., Any], differentiable: Callable[..., Any]) -> Callable[..., Any]:
    """``fast``, but ``differentiable`` under ``jax.grad`` and ``jax.vmap``; both give the same within rounding."""
    single = custom_vmap(fast)

    @single.def_vmap
    def batched(size: int, mapped: Any, *arguments: Any) -> tuple[Any, Any]:
        axes = jax.tree.map(lambda is_mapped: 0 if is_mapped else None, mapped)
        results = jax.vmap(differentiable, in_axes=tuple(axes), axis_size=size)(*arguments)
        return results, jax.tree.map(lambda _: True, results)

    @jax.custom_vjp
    def run(*arguments: Any) -> Any:
        return single(*arguments)

    def forward(*arguments: Any) -> tuple[Any, Any]:
        return jax.vjp(differentiable, *arguments)

    def backward(pull_back: Any, cotangents: Any) -> Any:
        return pull_back(cotangents)

    run.defvjp(forward, backward)
    return run


def with_gradient_of(reference: Callable[..., Any], function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, with the gradient of ``reference``, which is recomputed for it."""
    run = jax.custom_vjp(function)

    def forward(*arguments: Any) -> tuple[Any, Any]:
        return run(*arguments), arguments

    def backward(arguments: Any, cotangents: Any) -> Any:
        return jax.vjp(reference, *arguments)[1](cotangents)

    run.defvjp(forward, backward)
    return run
