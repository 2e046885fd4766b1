"""The kinds of files of :mod:`experiments.cycles.round_trip`: how Blender is set for each, and rendered.

Runs inside of Blender (``bpy``).
"""

import math
import runpy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

ROOT = Path(__file__).parents[2]
FRAMES = 3
REFERENCE_SEED = 12345


def _nothing() -> None:
    """The multilayer files of docs/how-to/blender_passes.py."""


@dataclass(frozen=True)
class Kind:
    """How the files of a kind come about.

    Attributes:
      prepare: sets Blender for it.
      options: of ``jaxdn denoise``.
      times: the frames' times; the picture moves from 1 to :data:`FRAMES`.
      path: the file of a time; ``{}`` is the frame's number, as Blender pads it.
      light: words of layers that jaxdn may change; Blender's beauty is always one.
      lossy: whether the codec loses precision, each time that a file is written.
      recompress: a codec that OpenEXR has and this Blender has not: the rendered files are written anew. Blender and
        its OpenImageIO cannot read what comes back.
    """

    prepare: Callable[[], None] = _nothing
    options: Sequence[str] = ()
    times: Sequence[float] = (1, 2, 3)
    path: Callable[[float], str] = lambda time: f"shot.{int(time):04d}.exr"
    light: Sequence[str] = ()
    lossy: bool = False
    recompress: str = ""

    @property
    def of_files(self) -> bool:
        """Whether each pass has a file of its own."""
        return self.prepare is _nothing and "beauty" in self.path(1)


def _stereo(views_format: str) -> Callable[[], None]:
    def prepare() -> None:
        render = bpy.context.scene.render
        render.use_multiview, render.views_format = True, "STEREO_3D"
        render.image_settings.views_format = views_format

    return prepare


def _cryptomatte() -> None:
    layer = bpy.context.view_layer
    layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True


def _light_groups() -> None:
    layer = bpy.context.view_layer
    for name, light in (("key", "Light"), ("fill", "Area")):
        layer.lightgroups.add(name=name)
        bpy.data.objects[light].lightgroup = name
    layer.lightgroups.add(name="world")
    bpy.context.scene.world.lightgroup = "world"


def _panorama() -> None:
    scene = bpy.context.scene
    scene.camera.data.type, scene.camera.data.panorama_type = "PANO", "EQUIRECTANGULAR"
    scene.camera.location = (0.5, -3.0, 0.8)  # among what there is to see
    scene.camera.rotation_euler = (math.pi / 2, 0.0, math.pi)  # the cube stands where the edges meet
    bpy.ops.mesh.primitive_plane_add(size=20, location=(0, 0, -1))


def _stored(depth: str, codec: str) -> Callable[[], None]:
    def prepare() -> None:
        settings = bpy.context.scene.render.image_settings
        settings.color_depth, settings.exr_codec = depth, codec

    return prepare


def _transparent() -> None:
    bpy.context.scene.render.film_transparent = True


def _motion_blur() -> None:
    bpy.context.scene.render.use_motion_blur = True


def _number(time: float) -> str:
    """As Blender pads a number: the sign stands before four digits."""
    return f"{'-' if time < 0 else ''}{abs(int(time)):04d}"


PLAIN = Kind()
KINDS = {
    "multilayer": PLAIN,
    "files": replace(PLAIN, path=lambda time: f"beauty.{int(time):04d}.exr"),
    "stereo": replace(PLAIN, prepare=_stereo("MULTIVIEW")),
    "stereo, left and right files": replace(PLAIN, prepare=_stereo("INDIVIDUAL")),
    "cryptomatte": replace(PLAIN, prepare=_cryptomatte),
    "light groups": replace(
        PLAIN, prepare=_light_groups, options=("--aovs", "additive"), light=("key", "fill", "world")
    ),
    "panorama": replace(PLAIN, prepare=_panorama, options=("--wrap",)),  # Blender writes no envmap attribute
    "half": replace(PLAIN, prepare=_stored("16", "ZIP")),
    "half, DWAA": replace(PLAIN, prepare=_stored("16", "DWAA"), lossy=True),
    "float, PIZ": replace(PLAIN, prepare=_stored("32", "PIZ")),
    "float, HTJ2K": replace(PLAIN, recompress="HTJ2K256_COMPRESSION"),
    "transparent": replace(PLAIN, prepare=_transparent, options=("--alpha",)),
    "motion blur": replace(PLAIN, prepare=_motion_blur),
    "negative numbers": replace(PLAIN, times=(-1, 0, 1), path=lambda time: f"shot.{_number(time)}.exr"),
    "subframes": replace(
        PLAIN, times=(1, 1.5, 2), path=lambda time: f"shot.{int(time):04d}{'.50' if time % 1 else ''}.exr"
    ),
}
"""What Blender writes: multilayer files of 32 bits by ZIP, if nothing else is said; a file for each pass (File Output);
two views as parts of a file, and as files; with Cryptomatte; with light groups; equirectangular; halfs; other codecs;
with a transparent film; with motion blur, which leaves the vectors 0; frames before 0; frames between frames."""


def build_scene(kind: Kind, size: tuple[int, int], samples: int) -> None:
    """The moving cube and what the kind needs, with the passes of docs/how-to/blender_passes.py."""
    bpy.ops.wm.read_factory_settings(use_empty=False)
    scene = bpy.context.scene
    runpy.run_path(str(ROOT / "docs/how-to/blender_passes.py"))
    cube = bpy.data.objects["Cube"]
    cube.pass_index = 1
    for time in (kind.times[0], kind.times[-1]):
        cube.location.x = 0.4 * (1 + time - kind.times[0])
        cube.keyframe_insert("location", frame=time)
    bpy.ops.mesh.primitive_uv_sphere_add(location=(-2, 1, 0))
    bpy.context.object.pass_index = 2
    bpy.ops.object.light_add(type="AREA", location=(3, -3, 4))
    bpy.context.object.data.energy = 300
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_file_extension = False
    scene.cycles.device, scene.cycles.samples = "CPU", samples
    kind.prepare()


def render(kind: Kind, folder: Path) -> list[str]:
    """The frames of the scene into ``folder``; the names of the files with the beauty, of one view, in order."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [kind.path(time) for time in kind.times]
    if kind.of_files:
        _render_passes(folder, int(kind.times[0]), int(kind.times[-1]))
        return names
    for time in kind.times:
        _render_one(folder, kind, time)
    render = bpy.context.scene.render
    if render.use_multiview and render.image_settings.views_format == "INDIVIDUAL":
        names = [f"{name.removesuffix('.exr')}_L.exr" for name in names]
    if kind.recompress:
        for name in names:
            _recompress(folder / name, kind.recompress)
    return names


def render_reference(kind: Kind, folder: Path, samples: int) -> None:
    """The last frame once more, with other noise and many samples."""
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.seed = samples, REFERENCE_SEED
    folder.mkdir(parents=True, exist_ok=True)
    _render_one(folder, kind, kind.times[-1])


def _render_one(folder: Path, kind: Kind, time: float) -> None:
    scene = bpy.context.scene
    scene.frame_set(int(time // 1), subframe=time % 1)
    scene.render.filepath = str(folder.absolute() / kind.path(time))
    bpy.ops.render.render(write_still=True)


def _render_passes(folder: Path, first: int, last: int) -> None:
    """A file for each pass of a frame, by the compositor's nodes, which number their files as an animation does."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = first, last
    scene.render.use_compositing = scene.render.use_file_extension = True
    scene.compositing_node_group = tree = bpy.data.node_groups.new("passes", "CompositorNodeTree")
    source = tree.nodes.new("CompositorNodeRLayers")
    for passed, name, kind in (
        ("Image", "beauty", "RGBA"),
        ("Depth", "depth", "FLOAT"),
        ("Denoising Albedo", "albedo", "RGBA"),
        ("Denoising Normal", "normal", "VECTOR"),
    ):
        node = tree.nodes.new("CompositorNodeOutputFile")
        node.format.media_type = "IMAGE"
        node.format.file_format, node.format.color_depth = "OPEN_EXR", "32"
        node.directory, node.file_name = str(folder.absolute()), f"{name}."
        node.file_output_items.new(kind, "")
        tree.links.new(source.outputs[passed], node.inputs[0])
    scene.render.filepath = str(folder.absolute().parent / "unused" / "shot.####.exr")
    bpy.ops.render.render(animation=True)
    scene.render.use_compositing = scene.render.use_file_extension = False


def _recompress(path: Path, codec: str) -> None:
    """Write a file anew with another codec, all else as it is."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        parts = [OpenEXR.Part(dict(part.header), dict(part.channels)) for part in file.parts]
        for part in parts:
            part.header["compression"] = getattr(OpenEXR, codec)
        part_file = path.with_name(f".{path.name}.part")
        OpenEXR.File(parts).write(str(part_file))
    part_file.replace(path)
