"""Programs of hard cases: one for both precisions where the inputs are widened first, and only there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.denoiser.sanitize import sanitize
from tests.hard_cases import table
from tests.hard_cases.cases import CASES
from tests.hard_cases.functions import Function
from tests.hard_cases.inputs import good
from tests.hard_cases.programs import Program, Widening
from tests.hard_cases.table import cast, rows

NARROW = cast(good(), "bfloat16 inputs")
CONSTANT = np.linspace(0.0, 1.0, 3)[None, None, None]


def light(inputs):
    return inputs.clip.frames.radiance


def scanned(params, inputs):
    """Sliced, widened inside a scan, then summed."""
    first = jnp.asarray(light(inputs)[0], jnp.float32)
    return jax.lax.scan(lambda mean, image: (0.7 * mean + 0.3 * image.astype(jnp.float32), mean), first, light(inputs))


def sanitized(params, inputs):
    frames = sanitize(inputs.clip.frames)[0]
    return jnp.where(jnp.isnan(frames.motion[..., :1]), jnp.nan, frames.radiance / (1e-3 + frames.depth))


def multiplied(image, factor):
    """By a callback, whose function each trace makes anew, as those of the package's loops in Numba are."""

    def work(context, out, given):
        np.asarray(out)[...] = factor * np.asarray(given)

    return buffer_callback(work, jax.ShapeDtypeStruct(image.shape, image.dtype))(image)


@jax.custom_vjp
def doubled(image):
    return 2 * image


doubled.defvjp(lambda image: (2 * image, None), lambda _, cotangent: (2 * cotangent,))

WIDENING = {
    "scanned": scanned,
    "called back": lambda params, inputs: multiplied(light(inputs).astype(jnp.float32), 2.0),
    "sanitized": sanitized,
    "an operation with its own derivative": lambda params, inputs: doubled(light(inputs).astype(jnp.float32)),
    "moved first": lambda params, inputs: light(inputs)[:, ::2].transpose(1, 0, 2, 3).astype(jnp.float32) + CONSTANT,
    "asked first": lambda params, inputs: jnp.where(
        jnp.isfinite(light(inputs)), light(inputs).astype(jnp.float32), 0.0
    ),
}
OTHERS = {
    "computes in bfloat16": lambda params, inputs: (light(inputs) * 1.7).astype(jnp.float32),
    "adds two inputs in bfloat16": lambda params, inputs: (light(inputs) + inputs.clip.reference).astype(jnp.float32),
    "computes in bfloat16 inside a scan": lambda params, inputs: jax.lax.scan(
        lambda mean, image: (mean + jnp.sum(image * 1.7).astype(jnp.float32), mean), jnp.float32(0), light(inputs)
    ),
    "returns bfloat16": lambda params, inputs: light(inputs)[:1],
    "computes otherwise by type": lambda params, inputs: (
        light(inputs).astype(jnp.float32) * float(jnp.finfo(light(inputs).dtype).eps)
    ),
    "has another constant by type": lambda params, inputs: (
        light(inputs).astype(jnp.float32) + (CONSTANT if light(inputs).dtype == jnp.float32 else CONSTANT[..., ::-1])
    ),
    "computes more in float32": lambda params, inputs: (
        jnp.sqrt(light(inputs)) if light(inputs).dtype == jnp.float32 else light(inputs).astype(jnp.float32)
    ),
    "exchanges two operands": lambda params, inputs: jnp.subtract(
        *(x.astype(jnp.float32) for x in (light(inputs), inputs.clip.reference)[:: _step(inputs)])
    ),
    "has a callback that holds something else": lambda params, inputs: multiplied(
        light(inputs).astype(jnp.float32), 2.0 if light(inputs).dtype == jnp.float32 else 3.0
    ),
    "has another operation with its own derivative": lambda params, inputs: (
        doubled(light(inputs)).astype(jnp.float32) if light(inputs).dtype == jnp.bfloat16 else 3 * light(inputs)
    ),
}


def _step(inputs):
    return 1 if light(inputs).dtype == jnp.float32 else -1


@pytest.mark.parametrize("name", WIDENING)
def test_a_function_that_widens_its_inputs_first_is_known(name):
    function = WIDENING[name]
    assert Widening(function)((), NARROW)
    # As it promises: the compiled programs give the same numbers.
    wide = table.widen(NARROW)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6),
        *(Program(function, lambda _: {})((), inputs) for inputs in (NARROW, wide)),
    )


@pytest.mark.parametrize("name", OTHERS)
def test_a_function_that_computes_otherwise_with_bfloat16_inputs_is_compiled_for_them(name):
    assert not Widening(OTHERS[name])((), NARROW)


def test_inputs_without_bfloat16_are_not_widened():
    assert not Widening(scanned)((), good())


def test_cells_are_those_of_a_program_of_their_own(monkeypatch):
    chosen = [CASES[name] for name in ("control", "everything not a number", "fireflies of 65504", "size 1x1")]
    function = Function(
        "sanitized", lambda params, inputs: sanitize(inputs.clip.frames)[0].radiance ** 2, sanitizes=True
    )
    compiled = []

    class Counted(Program):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            compiled.append(self)

    monkeypatch.setattr(table, "Program", Counted)
    shared = list(rows(chosen, [function]))
    programs = sum(len(program._compiled) for program in compiled)
    compiled.clear()
    monkeypatch.setattr(table, "Widening", lambda function: lambda params, inputs: False)
    own = list(rows(chosen, [function]))
    assert programs == 2 * 2 * 2, "two sizes, two directions, single and double precision"
    assert sum(len(program._compiled) for program in compiled) == 3 * 2 * 2
    assert len(shared) == len(own) == 4 * 2 * 2
    for one, other in zip(shared, own, strict=True):
        assert one._replace(largest=0, error=0) == other._replace(largest=0, error=0)
        np.testing.assert_allclose((one.largest, one.error), (other.largest, other.error), rtol=1e-6, atol=1e-9)
