"""What ``test_blender_addon_runs.py`` does inside of Blender: python in_blender.py ZIP PYTHON FOLDER.

It prints one JSON object as its last line.
"""

import json
import os
import sys
import time
from pathlib import Path

import bpy

ZIP, PYTHON, FOLDER = sys.argv[1], sys.argv[2], Path(sys.argv[3])
FIRST, LAST = 5, 7
told: dict[str, object] = {}


def refused(**settings: str) -> str:
    """The message of ``jaxdn.denoise``, with these settings of the panel."""
    for name, value in settings.items():
        setattr(scene.jaxdn, name, value)
    try:
        bpy.ops.jaxdn.denoise()
    except RuntimeError as error:
        return str(error)
    return "nothing"


def save(name: str) -> None:
    """The picture of the middle frame as a file of one layer."""
    scene.frame_set((FIRST + LAST) // 2)
    output = scene.render.image_settings
    if hasattr(output, "media_type"):
        output.media_type = "IMAGE"
    output.file_format, output.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(FOLDER / f"{name}.exr")
    bpy.ops.render.render(write_still=True)


class Layout:
    """Stands for the layout of a panel, which exists in a window alone: it refuses what Blender would refuse."""

    functions = bpy.types.UILayout.bl_rna.functions

    def __init__(self, texts: list[str]) -> None:
        self.texts = texts

    def __getattr__(self, name: str):
        known = self.functions[name].parameters.keys()

        def call(*words, **named):
            assert set(named) <= {*known, "text"}, (name, named)
            if "icon" in named:
                icons = self.functions["label"].parameters["icon"].enum_items
                assert named["icon"] in icons, named
            if name == "prop":
                words[0].bl_rna.properties[words[1]]  # raises KeyError for a name that is none
            if name == "operator":
                assert words[0] in {f"jaxdn.{each}" for each in dir(bpy.ops.jaxdn)}, words
            self.texts.append(f"{name} {' '.join(map(str, words[-1:]))} {named.get('text', '')}".strip())
            return self

        return call


def draw() -> list[str]:
    """The rows of the panel."""
    from bl_ext.user_default.jaxdn_denoise.panel import JaxdnPanel

    texts: list[str] = []
    layout = Layout(texts)
    names = ("_draw_passes", "_draw_settings", "_draw_run")
    panel = type("Panel", (), {"layout": layout, **{name: getattr(JaxdnPanel, name) for name in names}})()
    JaxdnPanel.draw(panel, bpy.context)
    return texts


bpy.context.preferences.view.show_developer_ui = False
bpy.ops.extensions.package_install_files(filepath=ZIP, repo="user_default", enable_on_install=True)
from bl_ext.user_default.jaxdn_denoise import operators, passes, properties, results  # noqa: E402

scene = bpy.context.scene
told["unset"] = [setting.path for setting in passes.unset(scene)]
told["panel before"] = draw()
bpy.ops.jaxdn.set_passes()
told["unset after"] = [setting.path for setting in passes.unset(scene)]
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 36, 100
scene.cycles.samples, scene.render.threads_mode, scene.render.threads = 2, "FIXED", 1
scene.frame_start, scene.frame_end = FIRST, LAST
cube = bpy.data.objects["Cube"]
for frame, x in ((FIRST, 0.0), (LAST, 0.5)):
    cube.location.x = x
    cube.keyframe_insert("location", frame=frame)
scene.render.filepath = "//noisy/shot_"
told["not saved"] = refused()
bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "shot.blend"))
told["not rendered"] = refused()
told["blender's own python"] = properties.chosen_python()
bpy.ops.render.render(animation=True)
told["no jaxdn"] = refused()
properties.preferences().python = PYTHON
told["same folder"] = refused(out="//noisy/")
told["unknown method"] = refused(out="//denoised/", method="nothing like it")
told["panel with an error"] = draw()
told["offline"] = operators.latest is not None and not bpy.app.online_access

scene.jaxdn.method = "taa"
operators.latest = operators.Denoise.start(None, bpy.context)  # as a button does, but for the window's timer
shares = []
told["panel while it runs"] = draw()
while operators.tick() is not None:
    shares.append(operators.latest.fraction)
    time.sleep(0.05)
told["shares"] = sorted({round(share, 3) for share in [*shares, operators.latest.fraction]})
told["message"], told["error"] = operators.latest.message, operators.latest.error
told["panel after"] = draw()

operators.latest = operators.Denoise.start(None, bpy.context)
bpy.ops.jaxdn.cancel()
while operators.tick() is not None:
    time.sleep(0.05)
told["cancelled"] = operators.latest.message

tree = scene.compositing_node_group if hasattr(scene, "compositing_node_group") else scene.node_tree
told["links"] = [[link.from_node.name, link.from_socket.name, link.to_node.type] for link in tree.links]
save("composited")
node = tree.nodes[results.NAME]
renders = tree.nodes.new("CompositorNodeRLayers")
blur = tree.nodes.new("CompositorNodeBlur")
tree.links.new(renders.outputs["Image"], blur.inputs["Image"])
tree.links.new(blur.outputs["Image"], node.outputs["Combined"].links[0].to_socket)
files = {frame: FOLDER / "denoised" / f"shot_{frame:04d}.exr" for frame in range(FIRST, LAST + 1)}
results.show_in_compositor(scene, files, bpy.context.view_layer.name)
told["links again"] = sorted([link.from_node.type, link.to_node.type] for link in tree.links)
told["nodes"] = sorted(each.type for each in tree.nodes)
scene.render.use_compositing = False
for _ in range(2):
    results.show_in_sequencer(scene, files)
strips = scene.sequence_editor.strips if hasattr(scene.sequence_editor, "strips") else scene.sequence_editor.sequences
told["strips"] = [[strip.name, strip.frame_final_start, strip.frame_final_end] for strip in strips]
save("sequenced")
bpy.ops.preferences.addon_disable(module="bl_ext.user_default.jaxdn_denoise")
told["left behind"] = hasattr(bpy.types.Scene, "jaxdn") or "set_passes" in dir(bpy.ops.jaxdn)
print(json.dumps(told))
sys.stdout.flush()
os._exit(0)  # bpy sometimes crashes while the interpreter ends
