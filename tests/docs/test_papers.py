"""The pages of the papers: every setting and constant that they state is that of the code."""

import ast
import dataclasses
import functools
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from docs import hooks
from jaxdn.core.frame import Frame
from jaxdn.methods.registry import methods
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.recipe import Recipe

ROOT = Path(__file__).parents[2]
PAPERS = hooks.read_papers()
FACTS = [
    pytest.param(paper, fact, id=f"{name}: {fact['says']}") for name, paper in PAPERS.items() for fact in paper["facts"]
]


def options_of(paper: dict[str, Any], preset: str | None, method: str | None = None) -> dict[str, Any]:
    """The options of the paper's method, or of another one, of a preset or the defaults."""
    given = {} if preset is None else {"preset": preset}
    options = methods()[method or paper["method"]].parse_options(given)
    return {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}


def count_weights(paper: dict[str, Any], preset: str | None, size: str) -> list[int]:
    """How many weights each network of the paper's method has, from the smallest on."""
    denoiser = methods()[paper["method"]].factory(preset=preset, size=size)
    params = jax.eval_shape(lambda: denoiser.init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3)))))
    parts = params.values() if denoiser.samples is not None else [params]
    return sorted(sum(leaf.size for leaf in jax.tree.leaves(part)) for part in parts)


def recipe_of(recipe: Recipe) -> dict[str, Any]:
    """The fields of a recipe as the facts have them."""
    return recipe._asdict() | {
        "objective": recipe.objective.name,
        "spp": list(recipe.spp),
        "variation": "none" if recipe.variation == NO_AUGMENTATION else "some",
    }


def source_of(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@functools.cache
def names_of(module: str) -> dict[str, ast.stmt]:
    """The functions, classes and variables of a module, by name, without importing it."""
    found: dict[str, ast.stmt] = {}
    for statement in ast.parse(source_of(module).read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            found[statement.name] = statement
        elif isinstance(statement, ast.Assign):
            found |= {target.id: statement for target in statement.targets if isinstance(target, ast.Name)}
    return found


def constant(address: str) -> Any:
    """``module:NAME``, ``module:NAME.attribute`` or ``module:function(argument)``, whose default it is."""
    module, _, name = address.partition(":")
    if argument := re.fullmatch(r"(\w+)\((\w+)\)", name):
        function = getattr(importlib.import_module(module), argument[1])
        return plain(inspect.signature(function).parameters[argument[2]].default)
    if "." in name:
        base, _, attribute = name.partition(".")
        return plain(getattr(getattr(importlib.import_module(module), base), attribute))
    statement = names_of(module)[name]
    assert isinstance(statement, ast.Assign)
    try:
        return plain(ast.literal_eval(statement.value))
    except ValueError:
        return plain(getattr(importlib.import_module(module), name))


def plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.parametrize(("paper", "fact"), FACTS)
def test_a_fact_is_that_of_the_code(paper, fact):
    assert fact["status"] in hooks.STATUSES
    preset = fact.get("preset", paper.get("preset"))
    for name, value in fact.get("options", {}).items():
        assert options_of(paper, preset, fact.get("method"))[name] == value, name
        if fact["status"] == "as published":
            assert options_of(paper, None, fact.get("method"))[name] == value, f"{name}: published, but not the default"
    for size, numbers in fact.get("weights", {}).items():
        assert count_weights(paper, preset, size) == numbers, size
        for number in numbers:
            assert f"{number:,}" in fact["here"]
    recipe = fact.get("of_recipe", paper.get("recipe"))
    for name, value in fact.get("recipe", {}).items():
        assert recipe_of(methods()[paper["method"]].recipe_named(recipe))[name] == value, name
    for address, value in fact.get("constants", {}).items():
        assert constant(address) == value, address


@pytest.mark.parametrize(("paper", "fact"), FACTS)
def test_a_fact_says_where_it_stands_and_what_holds_it(paper, fact):
    module, _, name = fact["code"].partition(":")
    assert source_of(module).is_file(), module
    assert not name or name in names_of(module), fact["code"]
    if "test" in fact:
        file, _, test = fact["test"].partition("::")
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), fact["test"]
    if fact["status"] in ("as published", "preset"):
        assert fact.keys() & {"options", "recipe", "constants", "test"}, "nothing holds what is claimed"
    if fact["status"] in ("ours", "not stated"):
        assert fact["here"], "no reason is given"
    if fact["status"] == "preset":
        usual = options_of(paper, None, fact.get("method"))
        other = [value != usual[name] for name, value in fact.get("options", {}).items()]
        if "recipe" in fact:
            recipe = recipe_of(methods()[paper["method"]].recipe_named(None))
            other += [value != recipe[name] for name, value in fact["recipe"].items()]
        assert any(other), "it is the default: as published"


@pytest.mark.parametrize("name", [name for name, paper in PAPERS.items() if "preset" in paper])
def test_no_option_of_a_preset_is_left_unsaid(name):
    paper = PAPERS[name]
    row = methods()[paper["method"]]
    for preset in row.presets:
        said = {
            option
            for fact in paper["facts"]
            if fact.get("preset", paper["preset"]) == preset
            for option in fact.get("options", {})
        }
        usual, published = options_of(paper, None), options_of(paper, preset)
        assert {option for option in usual if usual[option] != published[option]} <= said
    if "recipe" in paper:
        own = [fact for fact in paper["facts"] if "of_recipe" not in fact]
        said = {option for fact in own for option in fact.get("recipe", {})}
        usual, published = (recipe_of(row.recipe_named(recipe)) for recipe in (None, paper["recipe"]))
        assert {option for option in usual if usual[option] != published[option]} <= said


@pytest.mark.parametrize("name", PAPERS)
def test_a_page_shows_every_fact(name):
    text = hooks.on_page_markdown((ROOT / "docs" / "papers" / f"{name}.md").read_text(encoding="utf-8"))
    assert "<!--" not in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + len(PAPERS[name]["facts"])
    assert all(line.count(" | ") == 4 for line in rows)
