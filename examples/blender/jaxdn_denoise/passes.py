"""What has to be set in a scene before it is rendered for jaxdn, and which of it is not set yet."""

from typing import Any, NamedTuple


class Setting(NamedTuple):
    """One setting of a scene or a view layer."""

    path: str
    """Attributes below the scene or the view layer, ``cycles.use_denoising``."""
    value: Any
    name: str
    """What the panel calls it."""
    why: str
    optional: bool = False
    """Not every version of Blender has it."""


SCENE = (
    Setting("render.engine", "CYCLES", "Engine: Cycles", "EEVEE has no Monte Carlo noise"),
    Setting("render.use_motion_blur", False, "Motion Blur off", "with it Blender writes no motion vectors"),
    Setting("render.use_compositing", False, "Compositing off", "the file has to hold the renderer's own passes"),
    Setting("render.use_sequencer", False, "Sequencer off", "the file has to hold the renderer's own passes"),
    Setting("cycles.use_adaptive_sampling", False, "Noise Threshold off", "jaxdn needs the noise unchanged"),
    Setting("cycles.use_denoising", False, "Denoise off", "jaxdn needs the noise unchanged"),
    Setting("cycles.use_animated_seed", True, "Animated Seed", "the same noise in every frame looks like texture"),
    Setting("cycles.pixel_filter_type", "BOX", "Pixel Filter: Box", "a wider filter spreads a bright sample"),
    Setting("cycles.filter_width", 1.0, "Filter Width: 1 px", "a wider filter spreads a bright sample"),
    Setting("render.image_settings.media_type", "MULTI_LAYER_IMAGE", "Multi-Layer output", "holds all passes", True),
    Setting("render.image_settings.file_format", "OPEN_EXR_MULTILAYER", "OpenEXR MultiLayer", "holds all passes"),
    Setting("render.image_settings.color_depth", "32", "Float (Full)", "half floats end at 65504"),
)
"""In the order in which they can be set: the file format follows from the media type."""

LAYER = (
    Setting("use_pass_z", True, "Z", "depth"),
    Setting("use_pass_vector", True, "Vector", "motion"),
    Setting("use_pass_object_index", True, "Object Index", "keeps touching objects apart"),
    Setting("cycles.denoising_store_passes", True, "Denoising Data", "albedo and normal"),
)
"""Of every view layer that is rendered."""


def _owner(start: Any, setting: Setting) -> tuple[Any, str]:
    """The object that has the setting, and the attribute's name."""
    *between, name = setting.path.split(".")
    for part in between:
        start = getattr(start, part)
    return start, name


def _each(scene: Any) -> list[tuple[Any, str, Setting]]:
    """All settings of a scene and its view layers that this version of Blender has."""
    pairs = [(scene, setting) for setting in SCENE]
    pairs += [(layer, setting) for layer in scene.view_layers if layer.use for setting in LAYER]
    found = [(*_owner(start, setting), setting) for start, setting in pairs]
    return [each for each in found if hasattr(each[0], each[1]) or not each[2].optional]


def unset(scene: Any) -> list[Setting]:
    """The settings that jaxdn wants otherwise, each once."""
    return list(dict.fromkeys(s for owner, name, s in _each(scene) if getattr(owner, name) != s.value))


def set_all(scene: Any) -> None:
    """Set the scene and its view layers for jaxdn. The number of samples stays as it is."""
    for owner, name, setting in _each(scene):
        setattr(owner, name, setting.value)
