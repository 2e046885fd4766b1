"""Put denoised frames back: as an image node of the compositor, or as a strip of the sequencer."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from .frames import without_gaps

NAME = "jaxdn"
"""Of the node and of the strip."""


def show_in_compositor(scene: bpy.types.Scene, files: Mapping[int, Path], layer: str) -> bpy.types.Node:
    """An image node of the frames in place of the rendered image; a node of an earlier call is used again.

    Whatever took the image of the view layer takes the node's. Where nothing did, the node is linked to the output.
    """
    tree = _tree(scene)
    node = tree.nodes.get(NAME) or tree.nodes.new("CompositorNodeImage")
    node.name = node.label = NAME
    image = bpy.data.images.load(str(files[min(files)]), check_existing=True)
    image.source = "SEQUENCE"
    node.image = image
    first, last = min(files), max(files)
    node.frame_start, node.frame_duration, node.frame_offset = first, last - first + 1, first - 1
    node.use_auto_refresh = True
    with contextlib.suppress(TypeError):  # a file of the beauty alone has no layers
        node.layer = layer
    picture = node.outputs.get("Combined") or node.outputs[0]
    for link in list(tree.links):
        rendered = link.from_node.type == "R_LAYERS" and link.from_node.layer == layer
        if rendered and link.from_socket.name == "Image":
            tree.links.new(picture, link.to_socket)
    if not picture.is_linked and not (target := _output(scene, tree)).is_linked:
        tree.links.new(picture, target)
    scene.render.use_compositing = True
    return node


def _tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The compositor's nodes of a scene; made where there are none."""
    if not hasattr(scene, "compositing_node_group"):  # before Blender 5.0
        scene.use_nodes = True
        return scene.node_tree
    if scene.compositing_node_group is None:
        scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
    return scene.compositing_node_group


def _output(scene: bpy.types.Scene, tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """The socket that becomes the picture; made where there is none."""
    if not hasattr(scene, "compositing_node_group"):
        nodes = [node for node in tree.nodes if node.type == "COMPOSITE"]
        return (nodes[0] if nodes else tree.nodes.new("CompositorNodeComposite")).inputs["Image"]
    if not any(item.item_type == "SOCKET" and item.in_out == "OUTPUT" for item in tree.interface.items_tree):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    nodes = [node for node in tree.nodes if node.type == "GROUP_OUTPUT"]
    return (nodes[0] if nodes else tree.nodes.new("NodeGroupOutput")).inputs[0]


def show_in_sequencer(scene: bpy.types.Scene, files: Mapping[int, Path]) -> Any:
    """A strip of the frames, where they belong in time, above all other strips; an earlier one is replaced."""
    editor = scene.sequence_editor or scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # before Blender 4.4
    if NAME in strips:
        strips.remove(strips[NAME])
    channel = max((strip.channel for strip in strips), default=0) + 1
    shown = without_gaps(dict(files))
    strip = strips.new_image(name=NAME, filepath=str(shown[0]), channel=channel, frame_start=min(files))
    for path in shown[1:]:
        strip.elements.append(path.name)
    scene.render.use_sequencer = True
    return strip
