"""Mitsuba's objects as a tree: a scene holds shapes, a shape a BSDF, a BSDF textures and other BSDFs."""

from typing import Any

import mitsuba as mi


def children(plugin: Any) -> list[tuple[str, Any]]:
    """The objects directly inside a plugin, by name."""
    found: list[tuple[str, Any]] = []

    class Walk(mi.TraversalCallback):
        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, mi.Object):
                found.append((name, value))

        def put_object(self, name: str, obj: Any, flags: int) -> None:
            found.append((name, obj))

    plugin.traverse(Walk())
    return found


def shape_groups(scene: Any) -> list[Any]:
    """The shape groups that a scene instantiates; a group is not a shape of the scene itself."""
    return [child for _, child in children(scene) if child.class_name() == "ShapeGroupPlugin"]
