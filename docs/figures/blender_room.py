"""The scene of the Blender tutorial: a room with a rolling ball and a moving camera, rendered by Cycles.

    blender -b -P docs/figures/blender_room.py -- runs/blender/noisy
    blender -b -P docs/figures/blender_room.py -- runs/blender/reference 256
    jaxdn denoise "runs/blender/noisy/*.exr" -o runs/blender/clean
    python -m docs.figures.before_after runs/blender/noisy runs/blender/clean --frame 7

Runs in Blender's own Python, or in one with ``bpy``. The passes are those that the tutorial's script sets.
"""

import math
import runpy
import sys
from pathlib import Path

import bpy

FRAMES, SIZE = 8, (320, 180)
PASSES = Path(__file__).parents[2] / "docs" / "tutorials" / "blender_passes.py"


def material(name: str, color: tuple[float, float, float], roughness: float = 0.6) -> bpy.types.Material:
    """A plain surface."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    surface = made.node_tree.nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (*color, 1.0)
    surface.inputs["Roughness"].default_value = roughness
    return made


def add(kind: str, surface: bpy.types.Material, **options: object) -> bpy.types.Object:
    """A mesh of a kind of Blender's primitives."""
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**options)
    made = bpy.context.object
    made.data.materials.append(surface)
    made.pass_index = len(bpy.data.objects)
    return made


def slide(thing: bpy.types.Object, start: float, end: float) -> None:
    """Move along x from the first to the last frame."""
    for frame, x in ((1, start), (FRAMES, end)):
        thing.location.x = x
        thing.keyframe_insert("location", frame=frame)


def build() -> None:
    """The room, its light and its camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    wall, wood = material("wall", (0.7, 0.68, 0.62)), material("wood", (0.35, 0.2, 0.1), 0.4)
    add("plane", material("floor", (0.5, 0.42, 0.33), 0.5), size=12)
    add("plane", wall, size=12, location=(0, 3, 0), rotation=(math.pi / 2, 0, 0))
    add("plane", material("side", (0.15, 0.4, 0.25)), size=12, location=(-3.4, 0, 0), rotation=(0, math.pi / 2, 0))
    add("plane", wall, size=12, location=(0, 0, 4.4))
    add("cube", material("box", (0.8, 0.3, 0.1)), size=1.2, location=(1.4, 1.4, 0.6), rotation=(0, 0, 0.5))
    for x in (-2.6, -1.4):
        add("cube", wood, size=1, location=(x, 2.4, 0.5), scale=(0.12, 0.12, 1))
    add("cube", wood, size=1, location=(-2, 2.4, 1.05), scale=(1.7, 0.7, 0.1))
    add("torus", material("ring", (0.85, 0.65, 0.2), 0.25), location=(-2, 2.3, 1.25), major_radius=0.35)
    ball = add("uv_sphere", material("ball", (0.1, 0.25, 0.8), 0.2), radius=0.55, location=(0, 0, 0.55))
    bpy.ops.object.shade_smooth()
    slide(ball, -2.4, -0.6)
    bpy.ops.object.light_add(type="AREA", location=(2.5, -1.5, 4.2))
    bpy.context.object.data.energy, bpy.context.object.data.size = 220, 1.5
    bpy.ops.object.camera_add(location=(0, -5.5, 1.9), rotation=(math.radians(82), 0, 0))
    scene.camera = bpy.context.object
    slide(scene.camera, 0.0, 0.5)
    scene.frame_start, scene.frame_end = 1, FRAMES
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100


def main(folder: str, samples: int | None = None) -> None:
    """Build the scene and render it into a folder, with the tutorial's passes, and its samples or other ones."""
    build()
    runpy.run_path(str(PASSES))
    scene = bpy.context.scene
    if samples is not None:
        scene.cycles.samples, scene.cycles.seed = samples, 1
    scene.render.filepath = str(Path(folder).absolute()) + "/"
    bpy.ops.render.render(animation=True)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :]
    main(given[0], *map(int, given[1:]))
