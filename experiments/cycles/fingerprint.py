"""A mark of a built scene, so that a clip begun with other scene code is never finished with this one."""

import hashlib
from pathlib import Path
from typing import Any

import bpy
import numpy as np

FILE = "scene.sha256"


def check_scene(folder: Path, frames: int) -> None:
    """Note the scene's mark in a clip's folder, or compare with the one that is there: ``SystemExit`` if it differs."""
    path = folder / FILE
    mark = fingerprint(frames)
    if not path.exists():
        part = path.with_name(f".{path.name}.part")
        part.write_text(mark + "\n")
        part.replace(path)
    elif path.read_text().strip() != mark:
        raise SystemExit(
            f"error: {folder} holds frames of another version of this scene; go on with the code that began it, "
            "or delete the folder to render it anew"
        )


def fingerprint(frames: int) -> str:
    """A hash of what is seen: places in the first and last frame, meshes, lamps, materials, the camera."""
    scene = bpy.context.scene
    hashed = hashlib.sha256()
    for frame in (1, frames):
        scene.frame_set(frame)
        for thing in scene.objects:
            _add(hashed, [list(row) for row in thing.matrix_world])
    for mesh in bpy.data.meshes:
        vertices = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", vertices)
        _add(hashed, vertices)
    for curves in bpy.data.hair_curves:
        points = np.empty(3 * len(curves.points), np.float32)
        curves.points.foreach_get("position", points)
        _add(hashed, points)
    for light in bpy.data.lights:
        _add(hashed, [light.energy, *light.color])
    for camera in bpy.data.cameras:
        _add(hashed, [camera.lens, camera.dof.focus_distance, camera.dof.aperture_fstop])
    for tree in [scene.world.node_tree, *(material.node_tree for material in bpy.data.materials)]:
        for node in tree.nodes:
            hashed.update(node.bl_idname.encode())
            for given in node.inputs:
                value = getattr(given, "default_value", None)
                if isinstance(value, float | int):
                    _add(hashed, [value])
                elif value is not None and not isinstance(value, str):
                    _add(hashed, list(value))
    return hashed.hexdigest()


def _add(hashed: Any, values: Any) -> None:
    """Numbers to four digits after the point: what differs by rounding alone is the same."""
    hashed.update(np.round(np.asarray(values, np.float64), 4).astype(np.float32).tobytes())
