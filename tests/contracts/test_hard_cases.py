"""The part of the table of hard cases that CI checks; `make hard-cases` runs all of it and writes the page."""

import inspect
import json
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import brdf, color, losses, metrics
from jaxdn.core import numerics
from jaxdn.denoiser import Core, recurrent
from jaxdn.materials import glints, microfacets
from jaxdn.methods import registry as methods_table
from jaxdn.methods.registry import method, methods
from jaxdn.ops import motion, scales, warp
from jaxdn.ops.affinity import filter
from jaxdn.ops.dispatch.operation import Operation
from jaxdn.ops.kernel_prediction import apply, softmax
from jaxdn.recipes.recipe import Recipe
from tests.compiling import SOON
from tests.hard_cases import run
from tests.hard_cases.cases import CASES
from tests.hard_cases.functions import Function, list_denoisers, list_operations
from tests.hard_cases.inputs import good
from tests.hard_cases.invariances import Deviation
from tests.hard_cases.page import write_page
from tests.hard_cases.programs import Widening
from tests.hard_cases.table import PRECISIONS, cast, rows

pytestmark = pytest.mark.usefixtures("usual_tiles")  # as `make hard-cases` runs; of tiles the operations' tests are


def shapes(case):
    return [np.shape(leaf) for leaf in jax.tree.leaves(case.make(good()))]


CONTROL = shapes(CASES["control"])
SAME_SIZE = [case for case in CASES.values() if shapes(case) == CONTROL]
SMALLEST = CASES["size 1x1"]
LONG_TO_COMPILE = ("metrics.flip", "metrics.ssim", "losses.gradient, hfen")
OPERATIONS = [one for one in list_operations() if not one.name.startswith(LONG_TO_COMPILE)]
INNER = {
    *("find_targets", "check_taps", "tap_offsets", "angles", "alpha_of", "cosine_and_sine"),
    *("albedo_table", "ggx_albedo_table", "affinity", "locate_cells", "gather_windows", "attach_mean_gradient"),
    *("draw_guide", "pad", "crop", "join_planes", "join_pixels", "to_planes", "to_pixels"),
    *("add_planes", "halve_planes"),
}  # fmt: skip
"""Helpers of operations, which are tested through them, and tables that take no image."""
PLAIN = [one for one in OPERATIONS if not one.name.endswith(", masked")]


def named(functions):
    return pytest.mark.parametrize("function", functions, ids=lambda one: one.name)


def assert_green(function, cases=SAME_SIZE, *, precisions=("float32",), direction="forward", **how):
    found = rows(cases, [function], precisions=precisions, directions=(direction,), **how)
    red = [row for row in found if row.verdict == "red"]
    assert not red, "\n".join(f"{row.case}, {row.precision}, {row.direction}: {row.reason}" for row in red)


# The reduced table. Its rule: the time goes into compiling, so what needs no further program is in it. Every function
# runs forward, on all cases of one size, in float32. Operations, whose programs are small, also run with bfloat16
# inputs where that is the same program, and on a single pixel, and their gradients on all cases of one size. Denoisers
# with bfloat16 inputs are for `make hard-cases`: sanitising, an operation, widens them, and the rest is the same
# program. To trace a denoiser once more to know that, and to run every case again, takes a fifth of its time. Denoisers
# are compiled as tests are, without fusion emitters, and a second form of one ("svgf by albedo") is not compared with
# double precision: its values have to be finite and within bounds.


@pytest.mark.slow
@named([*list_denoisers(), *list_operations()])
def test_every_function_withstands_every_case_of_one_size(function):
    if function.kind == "denoiser":
        assert_green(function, compared=function.name in methods(), compiler_options=SOON)
        return
    widens = Widening(function.run)(function.begin(), cast(good(), "bfloat16 inputs"))
    assert_green(function, precisions=PRECISIONS if widens else PRECISIONS[:1])


@pytest.mark.slow
@named(PLAIN)
def test_gradients_of_operations_withstand_every_case(function):
    assert_green(function, direction="gradient")


@pytest.mark.slow
@named(OPERATIONS)
def test_operations_withstand_a_single_pixel(function):
    assert_green(function, [SMALLEST])


def test_every_denoiser_and_every_public_operation_is_tested():
    assert {function.name.split()[0] for function in list_denoisers()} == {
        name for name, row in methods().items() if row.installed
    }
    tried = {function.name.split(",")[0].split(".")[-1] for function in list_operations()}
    modules = (
        *(brdf, color, glints, losses, metrics, microfacets, motion, numerics, scales),
        *(filter, apply, softmax, warp),
    )
    for module in modules:
        functions = inspect.getmembers(module, lambda one: inspect.isfunction(one) or isinstance(one, Operation))
        public = {name for name, one in functions if one.__module__ == module.__name__ and name[0] != "_"}
        assert public - INNER <= tried, f"{module.__name__} has functions that no hard case tests"


def test_the_table_shows_errors(tmp_path):
    # A filter that divides by its input is red only where there is a zero or NaN.
    careless = Function("careless", lambda params, inputs: 1.0 / inputs.clip.frames.radiance, sanitizes=True)
    chosen = [CASES[name] for name in ("control", "black", "radiance not a number", "size 1x1")]
    table = list(rows(chosen, [careless], precisions=("float32",), directions=("forward",)))
    verdicts = {row.case: row.verdict for row in table}
    assert verdicts == {"control": "green", "black": "red", "radiance not a number": "red", "size 1x1": "green"}
    page = write_page(table, tmp_path).read_text()
    assert "values are not finite" in page
    assert page.count('<td class="red"') == 2


def test_without_double_precision_values_have_to_be_finite_and_within_bounds():
    def careless(params, inputs):
        return inputs.clip.frames.radiance / inputs.clip.frames.depth

    function = Function("careless", careless, sanitizes=True, bounds=(0.0, 5.0))
    chosen = [CASES[name] for name in ("control", "depth zero", "fireflies of 65504")]
    table = list(rows(chosen, [function], precisions=("float32",), directions=("forward",), compared=False))
    assert [(row.verdict, row.error) for row in table] == [("green", None), ("red", None), ("red", None)]


def test_a_wrong_result_in_single_precision_is_red():
    def loses_digits(params, inputs):
        return jnp.log(1 + 1e-6 * inputs.clip.frames.radiance)

    table = list(rows([CASES["control"]], [Function("loses digits", loses_digits)], directions=("forward",)))
    assert [row.verdict for row in table] == ["red", "red"]
    assert all(row.error > 2e-3 for row in table)


@pytest.mark.parametrize("buffer", ["depth", "albedo"])
def test_a_case_runs_again_for_all_that_a_function_reads_and_for_nothing_else(buffer):
    runs = []

    def in_a_scan(params, inputs):
        jax.debug.callback(lambda: runs.append(1))
        return jax.lax.scan(jax.jit(lambda carry, image: (carry, image)), 0, getattr(inputs.clip.frames, buffer))[1]

    chosen = [CASES[name] for name in ("control", "depth not a number", "albedo not a number", "normal not a number")]
    table = list(rows(chosen, [Function("read", in_a_scan)], precisions=("float32",), directions=("forward",)))
    jax.effects_barrier()
    assert [row.case for row in table if row.verdict == "input"] == [f"{buffer} not a number"]
    assert len(runs) == 2 * 2, "for valid and for broken values, in single and in double precision"


def test_cells_are_linked_to_their_case_and_its_picture(tmp_path):
    double = Function("double", lambda params, inputs: 2 * inputs.clip.frames.radiance, pictured=True)
    images = {}
    table = list(rows([CASES["control"], CASES["black"]], [double], directions=("forward",), pictures=images))
    assert set(images) == {("control", "double"), ("black", "double")}
    np.testing.assert_array_equal(images["control", "double"], 2 * good().clip.frames.radiance[-1])
    pictures = {("control", "double"): run.picture(images["control", "double"], 1.0)}
    page = write_page(
        table, tmp_path, deviations=[Deviation("mirrored", "ntd", 0.02, 0.1)], pictures=pictures
    ).read_text()
    assert '<a href="#control--double">' in page
    assert '<figure id="control--double"><img src="data:image/png' in page
    assert '<a href="#black">' in page
    assert '<section id="black">' in page
    assert page.count("The light is off.") == 2, "once on hover, once below"
    record = json.loads((tmp_path / "table.json").read_text())
    assert [row["case"] for row in record["rows"]] == [row.case for row in table]
    assert record["deviations"] == [{"change": "mirrored", "method": "ntd", "difference": 0.02, "error": 0.1}]


def test_cases_have_a_sentence_and_share_their_shapes():
    assert len(SAME_SIZE) == len(CASES) - 4
    assert all(len(made.sentence) > 4 for made in CASES.values())


@dataclass(frozen=True)
class Options:
    """Options of a method outside the package."""

    size: Literal["large", "small"] = "large"


@pytest.mark.slow
def test_a_method_registered_at_run_time_has_its_rows(monkeypatch):
    monkeypatch.setattr(methods_table, "_METHODS", dict(methods()))

    @method(
        Options, title="A share of the radiance", recipes={"usual": Recipe(None)}, variants={"small": {"size": "small"}}
    )
    def newcomer(options):
        def step(params, state, frame, first, statistics):
            assert frame.hit_distance is not None, "a buffer that no method of the package reads is present too"
            near = frame.radiance / (1.0 + frame.hit_distance)
            return state, params["share"] * near, 0

        def requested(params, state, frame, first, most):
            return jnp.full_like(frame.radiance[..., :1], 3.0)

        def init(key, frame):
            return {"share": jnp.full((), 0.3 if options.size == "small" else np.nan)}

        reads = frozenset({"hit_distance", "sample_count"})
        return recurrent(Core(lambda params, frame: (), step, reads, init, requested))

    found = {function.name: function for function in list_denoisers()}
    assert [name for name in found if name.startswith("newcomer")] == ["newcomer"]
    chosen = ("control", "radiance not a number", "everything infinite")
    assert_green(found["newcomer"], [CASES[name] for name in chosen])
    assert_green(found["newcomer"], [CASES["control"]], direction="gradient")
