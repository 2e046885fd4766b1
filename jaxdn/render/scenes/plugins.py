"""Mitsuba's objects as a tree: a scene holds shapes, a shape a BSDF, a BSDF textures and other BSDFs."""

import functools
from collections.abc import Iterator
from typing import Any

import mitsuba as mi


def list_children(plugin: Any) -> list[tuple[str, Any]]:
    """The objects directly inside a plugin, by name."""
    walk = _walk(str(mi.variant()))()
    plugin.traverse(walk)
    return walk.found


@functools.cache
def _walk(variant: str) -> Any:
    """The class of the callback for one variant, made once.

    A class is part of a reference cycle. With one class per call, the objects that it found would live until the next
    garbage collection: scenes of finished frames, whose registered objects would cause kernels to be compiled again.
    """

    class Walk(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[tuple[str, Any]] = []

        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, mi.Object):
                self.found.append((name, value))

        def put_object(self, name: str, obj: Any, flags: int) -> None:
            self.found.append((name, obj))

    return Walk


def list_shape_groups(scene: Any) -> list[Any]:
    """The shape groups that a scene instantiates; a group is not a shape of the scene itself."""
    return [child for _, child in list_children(scene) if child.class_name() == "ShapeGroupPlugin"]


def list_materials(scene: Any) -> Iterator[Any]:
    """Every BSDF that a hit may have, once."""
    grouped = [part for group in list_shape_groups(scene) for _, part in list_children(group) if hasattr(part, "bsdf")]
    seen = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in (*scene.shapes(), *grouped)) if bsdf is not None}
    yield from seen.values()
