"""A Mitsuba scene file as Mitsuba's own parser reads it, of which any part can be loaded by itself.

Includes, aliases, defaults, references and the upgrade of older formats are the parser's work. It gives a list of
nodes, one for each plugin of the file, whose properties refer to other nodes by their index. The first one is the
scene; its children are the shapes, lights, sensors and materials of the file.
"""

import importlib
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from jaxdn.render.mitsuba.variant import use_variant


class SceneParser:
    """The nodes of one scene file; see :mod:`jaxdn.render.scenes.scene_parser`.

    Every shape and light of the scene has a unique name, which is also its id when it is loaded: its id in the file,
    in which a dot becomes an underscore, else ``shape_<n>``, ``group_<n>`` or ``light_<n>``, counted from 0 in the
    order of the file. Names of files are absolute. Raises ValueError for a file that cannot be read as a scene, and for
    files it needs that are missing.
    """

    def __init__(self, path: Path) -> None:
        import mitsuba as mi

        if mi.variant() is None:  # a variant may not have been chosen yet
            use_variant()
        self.path = path
        self._state = _parse(path)
        self.nodes = list(self._state.nodes)
        self.inside = cache(self._inside)
        # Child of the scene -> the property of the scene that refers to it.
        self._slots = {target: name for name, target in _find_references(self._state.nodes[0]).items()}
        self.children = list(self._slots)
        self.names = self._assign_names()

    def of_type(self, kind: str) -> list[int]:
        """The children of the scene of one of Mitsuba's object types: ``"Shape"``, ``"Emitter"``, ``"Sensor"`` ..."""
        return [child for child in self.children if self.type_of(child) == kind]

    def type_of(self, node: int) -> str:
        """The name of a node's object type."""
        return str(self.nodes[node].type.name)

    def plugin(self, node: int) -> str:
        """The name of a node's plugin, such as ``"sphere"``."""
        return str(self.nodes[node].props.plugin_name())

    def id(self, node: int) -> str:
        """The id of a node; "" if it has none."""
        return str(self.nodes[node].props.id())

    def values(self, node: int) -> dict[str, Any]:
        """The properties of a node."""
        return dict(self.nodes[node].props.items())

    def references(self, node: int) -> list[int]:
        """The nodes that a node refers to."""
        return list(_find_references(self.nodes[node]).values())

    def _inside(self, node: int) -> frozenset[int]:
        """A node and all that it refers to, directly or not."""
        return frozenset([node]).union(*(self.inside(child) for child in self.references(node)))

    def load(self, children: Iterable[int]) -> Any:
        """An ``mi.Scene`` of some of the scene's children, with everything that they refer to."""
        import mitsuba as mi

        state, kept = mi.parser.ParserState(self._state), mi.Properties("scene")
        for child in children:
            kept[self._slots[child]] = self.nodes[0].props[self._slots[child]]
        state.nodes[0].props = kept
        return _instantiate(state)

    def load_node(
        self, node: int, changes: Mapping[str, Any] | None = None, shared: Mapping[str, Any] | None = None
    ) -> Any:
        """One node as an object, with everything that it refers to.

        Args:
          node: its index.
          changes: properties to add or replace.
          shared: name -> object that is loaded already, taken instead of loading it again (shape groups).
        """
        import mitsuba as mi

        state = mi.parser.ParserState(self._state)
        alone = mi.parser.SceneNode(state.nodes[node])
        given = {
            name: (shared or {}).get(self.names.get(target, "")) for name, target in _find_references(alone).items()
        }
        for name, value in {
            **{name: value for name, value in given.items() if value is not None},
            **(changes or {}),
        }.items():
            alone.props[name] = value
        state.nodes[0] = alone
        return _instantiate(state)

    def _assign_names(self) -> dict[int, str]:
        """Give every shape and light of the scene its name; returns child -> name."""
        taken = {self.id(node) for node in range(len(self.nodes))}
        names: dict[int, str] = {}
        for kind, usual in (("Shape", "shape"), ("Emitter", "light")):
            for index, child in enumerate(self.of_type(kind)):
                group = self.plugin(child) == "shapegroup"
                own = self.id(child)
                name = own.replace(".", "_") or f"{'group' if group else usual}_{index}"
                while name != own and name in taken:
                    name += "_"
                taken.add(name)
                self.nodes[child].props.set_id(name)
                names[child] = name
        return names


def _find_references(node: Any) -> dict[str, int]:
    """The properties of a node that refer to other nodes, with these nodes."""
    import mitsuba as mi

    kind = mi.Properties.ResolvedReference
    return {name: int(value.index()) for name, value in node.props.items() if isinstance(value, kind)}


def _parse(path: Path) -> Any:
    """The parser's state of a file."""
    import mitsuba as mi

    if not path.is_file():
        raise ValueError(f"scene {path}: expected a Mitsuba scene (XML), could not read it: there is no such file.")
    config = _make_config()
    try:
        with _search_in(path.parent) as resolver:
            state = mi.parser.parse_file(config, str(path))
            mi.parser.transform_all(config, state)
    except (RuntimeError, ValueError) as error:
        reason = re.sub(r"^\[\w+\.cpp:\d+\] ", "", str(error).strip().rpartition("\n")[2])
        raise ValueError(f"scene {path}: expected a Mitsuba scene (XML), could not read it: {reason}.") from error
    if state.nodes[0].type != mi.ObjectType.Scene:
        kind = state.nodes[0].props.plugin_name()
        raise ValueError(f"scene {path}: expected <scene> as the outermost element, got a plugin {kind!r}.")
    for node in state.nodes:
        name = node.props.get("filename", None)
        if isinstance(name, str):
            found = Path(str(resolver.resolve(name)))
            if not found.is_file():
                raise ValueError(
                    f"scene {path}: it uses the file {name!r}, which is not there; put it next to the scene."
                )
            node.props["filename"] = str(found.resolve())
    return state


@contextmanager
def _search_in(folder: Path) -> Iterator[Any]:
    """Let Mitsuba look for files in a folder too, as its own loader does with that of the scene."""
    mi: Any = importlib.import_module("mitsuba")
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(folder.resolve()))
    mi.set_file_resolver(resolver)
    try:
        yield resolver  # the file's own <path> elements add to it
    finally:
        mi.set_file_resolver(before)


def _make_config() -> Any:
    """Nothing is merged: every shape keeps its id, and every material its own parameters."""
    import mitsuba as mi

    config = mi.parser.ParserConfig(str(mi.variant()))
    config.merge_equivalent = config.merge_meshes = False
    return config


def _instantiate(state: Any) -> Any:
    import mitsuba as mi

    made = mi.parser.instantiate(_make_config(), state)
    return made[0] if isinstance(made, list) else made
