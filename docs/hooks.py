"""Reference pages that follow from the code, made by MkDocs (``hooks`` in mkdocs.yml).

A page asks for a part by a comment on a line of its own:

* ``<!-- api: jaxdn.filters -->``: every module of a package, or one module;
* ``<!-- options of methods -->``: every method of the registry with its options;
* ``<!-- buffers -->``: the table of buffers;
* ``<!-- help: denoise -->``: what ``jaxdn denoise --help`` prints;
* ``<!-- paper: ntd -->``: the facts of a paper, with their state here; ``<!-- papers -->``: how many there are of each.

Roles in docstrings (``:func:`jaxdn.warp```) become links where the page of that name exists.
"""

import contextlib
import io
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import tyro

from jaxdn.commands.arguments import COMMANDS
from jaxdn.core.frame import BUFFERS
from jaxdn.core.options import describe
from jaxdn.methods.registry import methods

ROOT = Path(__file__).parents[1]


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with what its comments ask for."""
    for pattern, part in PARTS.items():
        markdown = re.sub(rf"^<!-- {pattern} -->$", part, markdown, flags=re.M)
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """The page with the roles of its docstrings as links, which mkdocs-autorefs resolves.

    They may be broken after a dot, where a column of a table is narrow.
    """
    role = r":(?:mod|func|class|data|meth|attr):<code>~?([\w.]+)</code>"
    return re.sub(role, lambda found: _link(found[1], found[1]), html)


def _link(name: str, shown: str) -> str:
    return f'<autoref identifier="{name}" optional><code>{shown.replace(".", ".<wbr>")}</code></autoref>'


def modules(name: str) -> list[str]:
    """The module ``name``, or the package and all modules in it, by the names to import them by.

    Raises ValueError if there is neither.
    """
    path = ROOT / name.replace(".", "/")
    if path.with_suffix(".py").is_file():
        return [name]
    files = sorted(path.rglob("*.py"), key=lambda file: (file.parent, file.stem != "__init__", file.stem))
    if not files:
        raise ValueError(f"docs: expected a module or package of jaxdn, got {name}; mend the page that names it.")
    parts = [file.relative_to(ROOT).with_suffix("").parts for file in files]
    return [".".join(part[:-1] if part[-1] == "__init__" else part) for part in parts]


def _api(match: re.Match[str]) -> str:
    return "\n".join(f"::: {module}" for module in modules(match[1]))


def _options(_: re.Match[str]) -> str:
    parts = []
    for name, method in methods().items():
        parts.append(f"## {name}\n\n{method.title}.\n")
        for label, values in (("Variants", method.variants), ("Presets", method.presets), ("Recipes", method.recipes)):
            if values:
                parts.append(f"{label}: {', '.join(f'`{value}`' for value in values)}.\n")
        rows = re.findall(r"^\* ``(\w+)``: (.*); default (.*)$", describe(method.options), flags=re.M)
        parts.append(_table(["Option", "Values", "Default"], [[f"`{n}`", allowed, f"`{d}`"] for n, allowed, d in rows]))
    return "\n".join(parts)


def _buffers(_: re.Match[str]) -> str:
    rows = [
        [f"`{name}`", str(row.channels), row.kind, str(row.neutral), row.stored, "yes" if row.on_request else ""]
        for name, row in BUFFERS.items()
    ]
    return _table(["Buffer", "Channels", "Kind", "`None` means", "Stored as", "On request"], rows)


def _help(match: re.Match[str]) -> str:
    text = io.StringIO()
    plain = mock.patch.dict(os.environ, {"COLUMNS": "80", "NO_COLOR": "1"})
    with plain, contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(COMMANDS, prog="jaxdn", args=[match[1], "--help"])
    return f"```text\n{text.getvalue().strip()}\n```"


STATUSES = ("as published", "preset", "ours", "not stated")
"""Of a fact in ``docs/papers/facts.toml``, which says what they mean."""


def read_papers() -> dict[str, dict[str, Any]]:
    """The papers by the name of their page, as ``docs/papers/facts.toml`` has them."""
    return tomllib.loads((ROOT / "docs" / "papers" / "facts.toml").read_text(encoding="utf-8"))


def _papers(_: re.Match[str]) -> str:
    rows = []
    for name, paper in read_papers().items():
        counts = [sum(fact["status"] == status for fact in paper["facts"]) for status in STATUSES]
        rows.append([f"[{paper['title']}]({name}.md)", paper["by"], *map(str, counts)])
    return _table(["Paper", "By", "As published", "Option or preset", "Ours", "Not stated"], rows)


def _paper(match: re.Match[str]) -> str:
    paper = read_papers()[match[1]]
    rows = []
    for fact in paper["facts"]:
        settings = [f"`{name}={value!r}`" for name, value in fact.get("options", {}).items()]
        settings += [f"recipe: `{name}` {value!r}" for name, value in fact.get("recipe", {}).items()]
        here = "; ".join(part for part in (fact["here"], ", ".join(settings)) if part)
        code = fact["code"].replace(":", ".")
        rows.append([fact["says"], fact["at"], _status(fact, paper), here, _link(code, code.removeprefix("jaxdn."))])
    return _table(["Paper", "Where", "Status", "Here", "Code"], rows)


def _status(fact: Mapping[str, Any], paper: Mapping[str, Any]) -> str:
    if fact["status"] != "preset":
        return str(fact["status"])
    ways = [f"`preset={fact.get('preset', paper['preset'])!r}`"] if "options" in fact else []
    ways += [f"`--recipe {fact.get('of_recipe', paper['recipe'])}`"] if "recipe" in fact else []
    return ", ".join(ways)


def _table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows]) + "\n"


PARTS = {
    r"api: (jaxdn[\w.]*)": _api,
    r"options of methods": _options,
    r"buffers": _buffers,
    r"help: (\w+)": _help,
    r"paper: (\w+)": _paper,
    r"papers": _papers,
}
