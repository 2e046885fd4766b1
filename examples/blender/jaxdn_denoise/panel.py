"""The panel in Properties > Output: passes, denoising, and how far a run is."""

import bpy

from . import operators, passes


class JaxdnPanel(bpy.types.Panel):
    """Three steps, one below the other."""

    bl_idname, bl_label = "RENDER_PT_jaxdn", "jaxdn Denoise"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "output"

    def draw(self, context):
        """Draw it."""
        self.layout.use_property_split = True
        self._draw_passes(context.scene)
        self._draw_settings(context.scene.jaxdn)
        run = operators.latest
        if run is not None:
            self._draw_run(run)

    def _draw_passes(self, scene):
        missing = passes.unset(scene)
        column = self.layout.column(align=True)
        if not missing:
            column.label(text="All passes are set. Render the animation.", icon="CHECKMARK")
            return
        for setting in missing:
            column.label(text=f"{setting.name}: {setting.why}", icon="ERROR")
        column.operator("jaxdn.set_passes", icon="RENDERLAYERS")

    def _draw_settings(self, settings):
        column = self.layout.column()
        for name in ("out", "method", "safe", "bidirectional", "result"):
            column.prop(settings, name)
        column.operator("jaxdn.denoise", icon="RENDER_ANIMATION")

    def _draw_run(self, run):
        column = self.layout.column()
        if run.running:
            column.progress(factor=run.fraction, text=f"{run.title}: {run.fraction:.0%}")
            column.operator("jaxdn.cancel", icon="X")
        if run.error:
            column.alert = True
            for line in wrap(run.error):
                column.label(text=line)
        else:
            column.label(text=run.message)


def wrap(text: str, width: int = 60) -> list[str]:
    """The text in lines of about a panel's width; Blender's labels do not break."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def register() -> None:
    """Make it known to Blender."""
    bpy.utils.register_class(JaxdnPanel)


def unregister() -> None:
    """Take it away again."""
    bpy.utils.unregister_class(JaxdnPanel)
