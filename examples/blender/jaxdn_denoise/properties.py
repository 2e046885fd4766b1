"""What a user sets: of each scene, how to denoise it; of the add-on, which Python has jaxdn."""

import sys
from pathlib import Path

import bpy

from .command import python_of

RESULTS = (
    ("COMPOSITOR", "Compositor", "An image node takes the place of the rendered image"),
    ("SEQUENCER", "Sequencer", "An image strip on a new channel"),
    ("NONE", "Files", "Write the files only"),
)


_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (5, 0, 0) else set()
"""Of paths that may begin with ``//``, the folder of the file."""


class SceneSettings(bpy.types.PropertyGroup):
    """Of a scene, saved in its file."""

    out: bpy.props.StringProperty(
        name="Output",
        description="Folder for the denoised frames",
        default="//denoised/",
        subtype="DIR_PATH",
        options={"ANIMATABLE"} | _RELATIVE,
    )
    method: bpy.props.StringProperty(
        name="Method", description="auto, or a name that `jaxdn denoise --method` takes", default="auto"
    )
    safe: bpy.props.BoolProperty(name="Safe Blend", description="Keep what is not recognised as noise", default=True)
    bidirectional: bpy.props.BoolProperty(
        name="Bidirectional", description="Denoise backwards too: twice the time, better first frames", default=False
    )
    result: bpy.props.EnumProperty(name="Result", description="What becomes of the denoised frames", items=RESULTS)


class Preferences(bpy.types.AddonPreferences):
    """Of the add-on, on this machine."""

    bl_idname = __package__

    python: bpy.props.StringProperty(
        name="Python",
        description="An interpreter that has jaxdn; empty: the environment that Install makes, else Blender's own",
        subtype="FILE_PATH",
    )
    package: bpy.props.StringProperty(
        name="jaxdn", description="What Install installs: the folder of jaxdn, or a wheel", subtype="FILE_PATH"
    )

    def draw(self, context):
        """The preferences' page."""
        self.layout.prop(self, "python")
        row = self.layout.row()
        row.prop(self, "package")
        row.operator("jaxdn.install", icon="IMPORT")
        self.layout.label(text=f"Denoises with {chosen_python()}")


def preferences() -> Preferences:
    """Those of the add-on."""
    return bpy.context.preferences.addons[__package__].preferences


def own_environment() -> Path:
    """The folder of the environment that Install makes."""
    return Path(bpy.utils.extension_path_user(__package__, path="python", create=True))


def chosen_python() -> str:
    """The interpreter to denoise with: the named one, the environment of Install, or Blender's own."""
    if named := preferences().python:
        return bpy.path.abspath(named)
    own = python_of(own_environment())
    return str(own) if own.is_file() else sys.executable


def register() -> None:
    """Make them known to Blender."""
    bpy.utils.register_class(SceneSettings)
    bpy.utils.register_class(Preferences)
    bpy.types.Scene.jaxdn = bpy.props.PointerProperty(type=SceneSettings)


def unregister() -> None:
    """Take them away again."""
    del bpy.types.Scene.jaxdn
    bpy.utils.unregister_class(Preferences)
    bpy.utils.unregister_class(SceneSettings)
