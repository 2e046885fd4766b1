"""The list of mutants: each is still one change of the code, and names tests that are there."""

import ast
import re

import pytest

from tests.mutants.__main__ import MUTANTS
from tests.mutants.mutant import ROOT


@pytest.mark.parametrize("one", MUTANTS, ids=lambda one: one.name)
def test_a_mutant_changes_the_code_in_one_place_and_names_tests_that_are_there(one):
    for edit in one.edits:
        changed = edit.applied()
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse((ROOT / edit.file).read_text(encoding="utf-8")))
    assert one.tests
    for test in one.tests:
        file, _, name = test.partition("::")
        text = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {re.escape(name.partition('[')[0])}\(", text, re.MULTILINE), test


def test_no_two_mutants_have_one_name():
    assert len({one.name for one in MUTANTS}) == len(MUTANTS)
