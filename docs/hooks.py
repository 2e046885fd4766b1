"""Pages that follow from the table of methods: run by MkDocs (``hooks`` in mkdocs.yml)."""

from typing import Any

from jaxdn.methods.registry import methods

PLACE = "<!-- the table of methods -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Every method with its title, variants, recipes and options, in the page that asks for them."""
    if PLACE not in markdown:
        return markdown
    parts = []
    for name, method in methods().items():
        parts.append(f"## {name}: {method.title}\n")
        if method.learns:
            variants, recipes = ", ".join(method.variants) or "none", ", ".join(method.recipes)
            parts.append(f"Learns. Variants: {variants}; recipes: {recipes}.\n")
        parts.append(f"::: {method.factory.__module__}\n")
    return markdown.replace(PLACE, "\n".join(parts))
