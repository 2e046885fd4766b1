"""Compiled loops called from inside a jitted program, tile by tile of rows, on all cores."""

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.ops.dispatch.host_call import call_host, name_of
from jaxdn.ops.dispatch.loop_compilers import compile_apart, example
from jaxdn.ops.dispatch.operation import Operation, platform
from jaxdn.runtime.cores import count_cores

TILE = 1 << 16
"""Values that a tile fills at the least: those of a small image take threads longer to take up than to fill."""

Given = jax.Array | tuple[jax.Array, ...] | None


def unavailable() -> str:
    """Why programs cannot call compiled loops, and what to do; empty if they can."""
    if platform() != "cpu":
        return f"runs on the CPU, and the program is for {platform()!r}"
    return "" if _installed() else "needs the package numba: pip install numba"


def implements(
    operation: Operation[..., Any], *, differentiable: bool = False
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: declare a function of compiled loops as the implementation ``"numba"``, for float32 on CPUs."""
    return operation.implementation(
        "numba",
        platforms=("cpu",),
        dtypes=(jnp.float32,),
        differentiable=differentiable,
        unavailable=unavailable,
    )


def call(
    loop: Callable[..., None],
    shapes: Sequence[tuple[int, ...]],
    arrays: Sequence[Given],
    *numbers: Any,
    rows: int,
    least: int = 1,
) -> list[jax.Array]:
    """Float32 arrays of ``shapes``, filled by ``loop``; one after the other under ``jax.vmap``.

    Args:
      loop: compiled without Python's lock; gets the first and the last row of a tile, the arrays, the results, and
        ``numbers``, and fills those rows of the results.
      shapes: of the results.
      arrays: what is read; None for what is absent, a tuple for what the loop gets as a tuple.
      numbers: constants of the program.
      rows: height of the image, of which tiles are made.
      least: rows of a tile, where a loop does more for its first ones.
    """

    leaves, structure = jax.tree.flatten(tuple(arrays))
    kinds = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    read_types = jax.tree.unflatten(structure, [example(leaf, written=False) for leaf in leaves])
    written_types = [example(kind, written=True) for kind in kinds]
    compiled = compile_apart(loop, (0, rows, *read_types, *written_types, *numbers))

    def work(written: list[np.ndarray], *given: np.ndarray) -> None:
        if compiled is not None:
            compiled.result()
        read = jax.tree.unflatten(structure, given)
        pool, threads = _pool()
        # Several tiles for each thread, as some take longer.
        height = max(least, -(-rows // max(1, min(4 * threads, values // TILE))))
        tops = iter(range(0, rows, height))

        def fill() -> None:
            for top in tops:  # that no other thread has taken
                loop(top, min(rows, top + height), *read, *written, *numbers)

        helpers: list[Future[None]] = []
        try:
            for _ in range(min(threads, -(-rows // height)) - 1):
                helpers.append(pool.submit(fill))
            fill()
        finally:  # after Ctrl-C, too, nothing may write into results that XLA frees
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()

    values = sum(map(math.prod, shapes))
    name = name_of(getattr(loop, "py_func", loop), str(structure), numbers, rows, least)
    return call_host(name, work, kinds, *leaves)


@functools.cache
def _installed() -> bool:
    try:
        return find_spec("numba") is not None
    except ModuleNotFoundError:  # where imports are forbidden
        return False


@functools.cache
def _pool() -> tuple[ThreadPoolExecutor, int]:
    """Threads that help the one that calls a loop, and how many fill tiles with it: one for each core to be used."""
    threads = count_cores()
    return ThreadPoolExecutor(max(1, threads - 1), "jaxdn-tiles"), threads
