"""The part of the table of hard cases that CI checks; `make hard-cases` makes all of it, with the page."""

import jax
import pytest

from jaxdn.denoisers import NAMES
from tests.hard_cases.cases import CASES, good
from tests.hard_cases.subjects import Subject, denoiser_subjects, operation_subjects
from tests.hard_cases.table import rows, write_page

LONG_TO_COMPILE = {"metrics.flip", "metrics.ssim", "metrics.psnr", "metrics.temporal_psnr"}


def assert_green(subject, **options):
    red = [row for row in rows(CASES.values(), [subject], **options) if row.verdict == "red"]
    assert not red, "\n".join(f"{row.case}, {row.precision}, {row.direction}: {row.told}" for row in red)


@pytest.mark.parametrize(
    "subject", [one for one in operation_subjects() if one.name not in LONG_TO_COMPILE], ids=lambda one: one.name
)
def test_operations_withstand_every_case(subject):
    assert_green(subject, precisions=("float32",), directions=("forward",))


@pytest.mark.slow
@pytest.mark.parametrize(
    "subject", [one for one in operation_subjects() if one.name not in LONG_TO_COMPILE], ids=lambda one: one.name
)
def test_gradients_of_operations_withstand_every_case(subject):
    assert_green(subject, precisions=("float32",), directions=("gradient",))


@pytest.mark.slow
@pytest.mark.parametrize("subject", denoiser_subjects(), ids=lambda one: one.name)
def test_denoisers_withstand_every_case(subject):
    assert_green(subject, precisions=("float32",), directions=("forward",))


def test_every_denoiser_is_put_to_the_test():
    assert {subject.name.split()[0] for subject in denoiser_subjects()} == set(NAMES)


def test_the_table_would_show_what_is_wrong(tmp_path):
    # A filter that divides by its input is red where there is a zero, or no number, and only there.
    careless = Subject("careless", lambda params, inputs: 1.0 / inputs.clip.frames.radiance, repairs=True)
    table = list(rows(CASES.values(), [careless], precisions=("float32",), directions=("forward",)))
    verdicts = {row.case: row.verdict for row in table}
    assert verdicts["control"] == "green"
    assert verdicts["black"] == verdicts["radiance not a number"] == "red"
    page = write_page(table, tmp_path).read_text()
    assert "values are not finite" in page
    assert page.count("class='red'") == sum(verdict == "red" for verdict in verdicts.values())


def test_cases_are_told_and_share_their_shapes():
    shapes = {name: [leaf.shape for leaf in jax.tree.leaves(made.make(good()))] for name, made in CASES.items()}
    assert all(found == shapes["control"] for found in shapes.values())
    assert all(len(made.sentence) > 10 for made in CASES.values())
