"""Loops by tiles of rows: the calling thread fills them with others, and waits for no thread that is busy."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops.dispatch import numba_call

HEIGHT, WIDTH = 64, 8
THREADS = 3


class Counting(ThreadPoolExecutor):
    """Counts what it is given."""

    given = 0

    def submit(self, *arguments: Any, **options: Any) -> Any:
        self.given += 1
        return super().submit(*arguments, **options)


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counting]:
    """As on a machine with three cores, where tiles may be small."""
    with Counting(THREADS - 1) as threads:
        monkeypatch.setattr(numba_call, "_pool", lambda: (threads, THREADS))
        monkeypatch.setattr(numba_call, "TILE", 1)
        yield threads


def run(loop: Callable[..., None], image: np.ndarray) -> np.ndarray:
    program = jax.jit(lambda x: numba_call.call(loop, [x.shape], [x], rows=x.shape[0])[0])
    return np.asarray(program(jnp.asarray(image)))


def double(top: int, bottom: int, read: np.ndarray, written: np.ndarray) -> None:
    """Without Numba: what counts is who calls it."""
    written[top:bottom] = 2 * read[top:bottom]


def test_all_rows_are_filled_and_few_threads_are_asked(pool: Counting, rng: np.random.Generator) -> None:
    """Each that is asked takes tiles until there is none: asking takes as long as a tile of a small image."""
    image = rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32)
    np.testing.assert_array_equal(run(double, image), 2 * image)
    assert pool.given == THREADS - 1


def test_no_thread_that_is_busy_is_waited_for(pool: Counting, rng: np.random.Generator) -> None:
    """Two loops of one program may run at the same time."""
    image = rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32)
    free = threading.Event()
    for _ in range(THREADS - 1):
        ThreadPoolExecutor.submit(pool, free.wait)
    late = threading.Timer(20, free.set)
    late.start()
    try:
        np.testing.assert_array_equal(run(double, image), 2 * image)
        assert not free.is_set()
    finally:
        late.cancel()
        free.set()


@pytest.mark.parametrize("here", [True, False])
def test_an_error_of_any_thread_arrives_when_all_have_ended(here: bool, pool: Counting) -> None:
    ended, entered = [], threading.Barrier(THREADS)

    def fail(top: int, bottom: int, read: np.ndarray, written: np.ndarray) -> None:
        entered.wait(20)  # each thread has one
        helps = threading.current_thread().name.startswith(pool._thread_name_prefix)
        if helps != here:
            raise ValueError("nine lives")
        ended.append(top)

    with pytest.raises(jax.errors.JaxRuntimeError, match="nine lives"):
        run(fail, np.zeros((THREADS, WIDTH), np.float32))
    assert len(ended) == (THREADS - 1 if here else 1)
