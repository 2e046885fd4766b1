"""What the panel's buttons do. From scripts and in ``blender -b``, an operator ends when its work has ended."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from . import passes, results
from .background import Background
from .command import denoise_command, explain_failure, install_commands, read_progress
from .frames import find_rendered, find_results
from .properties import chosen_python, own_environment, preferences

_EVERY = 0.2
"""Seconds between two looks at a run."""
_KEPT = 400
"""Lines that are kept of a run, to explain a failure."""


class Run:
    """A command that runs beside Blender, and what the panel shows of it."""

    def __init__(self, title: str, commands: Sequence[Sequence[str]], then: Callable[[], str]) -> None:
        """``then`` is called after success; it returns what to tell, and raises ValueError for what is missing."""
        self.title, self.fraction, self.message, self.error = title, 0.0, "starting ...", ""
        self.lines: list[str] = []
        self._then = then
        self._background: Background | None = Background(commands)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._background is not None

    def update(self) -> list[str]:
        """Take what was printed since the last call, and end the run if its command has ended; returns the lines."""
        if self._background is None:
            return []
        lines, code = self._background.poll()
        for line in lines:
            fraction = read_progress(line)
            self.fraction = self.fraction if fraction is None else fraction
            self.message = line or self.message
        self.lines = (self.lines + lines)[-_KEPT:]
        if code is not None:
            cancelled, self._background = self._background.cancelled, None
            self._end(code, cancelled)
        return lines

    def cancel(self) -> None:
        """Stop the command; :meth:`update` then ends the run."""
        if self._background is not None:
            self._background.cancel()

    def wait(self) -> None:
        """Wait a moment."""
        if self._background is not None:
            self._background.wait(_EVERY)

    def _end(self, code: int, cancelled: bool) -> None:
        if cancelled:
            self.message = "cancelled; finished frames are kept"
        elif code:
            self.error = explain_failure(code, self.lines)
        else:
            try:
                self.message, self.fraction = self._then(), 1.0
            except ValueError as error:
                self.error = str(error)


latest: Run | None = None
"""The run that the panel shows."""


def tick() -> float | None:
    """Look at the run, and redraw what shows it; returns the seconds to the next look, None after the end."""
    if latest is None:
        return None
    latest.update()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("PROPERTIES", "PREFERENCES"):
                area.tag_redraw()
    return _EVERY if latest.running else None


class _Starts:
    """An operator that starts a run: beside Blender from a button, until its end from a script."""

    @classmethod
    def poll(cls, context):
        """One run at a time."""
        return latest is None or not latest.running

    def start(self, context: bpy.types.Context) -> Run:
        """The run. Raises ValueError, with what to do, where it cannot start."""
        raise NotImplementedError

    def invoke(self, context, event):
        """From a button."""
        return self._begin(context, lambda run: bpy.app.timers.register(tick, first_interval=_EVERY))

    def execute(self, context):
        """From a script."""
        return self._begin(context, self._finish)

    def _begin(self, context, go_on):
        global latest
        try:
            latest = self.start(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        go_on(latest)
        if latest.error:
            self.report({"ERROR"}, latest.error)
            return {"CANCELLED"}
        return {"FINISHED"}

    def _finish(self, run: Run) -> None:
        while run.running:
            run.wait()
            for line in run.update():
                print(line, flush=True)


class SetPasses(bpy.types.Operator):
    """Set the passes, the sampling and the file format that jaxdn needs; samples stay as they are"""

    bl_idname, bl_label, bl_options = "jaxdn.set_passes", "Set Passes", {"REGISTER", "UNDO"}

    def execute(self, context):
        """Set them in the scene of the context."""
        passes.set_all(context.scene)
        return {"FINISHED"}


class Denoise(_Starts, bpy.types.Operator):
    """Denoise the rendered frames of this scene"""

    bl_idname, bl_label = "jaxdn.denoise", "Denoise Frames"

    def start(self, context):
        """Denoise the files that the scene's output names, of the scene's frames."""
        scene, settings, layer = context.scene, context.scene.jaxdn, context.view_layer.name
        if not bpy.data.filepath and any(path.startswith("//") for path in (scene.render.filepath, settings.out)):
            raise ValueError("// is the folder of the .blend file, which is not saved yet; save it first.")
        rendered = find_rendered(
            lambda frame: bpy.path.abspath(scene.render.frame_path(frame=frame)),
            range(scene.frame_start, scene.frame_end + 1, scene.frame_step),
        )
        out = Path(bpy.path.abspath(settings.out)).absolute()
        if out == rendered.pattern.parent.absolute():
            raise ValueError(f"{out}: expected another folder than that of the rendered frames; set Output.")
        several = sum(each.use for each in scene.view_layers) > 1
        words = denoise_command(
            chosen_python(),
            rendered.pattern,
            out,
            rendered.files,
            method=settings.method,
            safe=settings.safe,
            bidirectional=settings.bidirectional,
            layer=layer if several else None,
        )
        name, result = scene.name, settings.result

        def then() -> str:
            files = find_results(rendered, out)
            if not files:
                raise ValueError(f"{out}: expected denoised frames, found none; look at what jaxdn printed.")
            target = bpy.data.scenes.get(name)
            if target is not None and result == "COMPOSITOR":
                results.show_in_compositor(target, files, layer)
            elif target is not None and result == "SEQUENCER":
                results.show_in_sequencer(target, files)
            return f"{len(files)} of {len(rendered.files)} frames in {out}"

        return Run("Denoise", [words], then)


class Install(_Starts, bpy.types.Operator):
    """Make an environment for jaxdn beside the add-on, and install jaxdn and what it needs with pip"""

    bl_idname, bl_label = "jaxdn.install", "Install"

    def start(self, context):
        """Make the environment of the add-on."""
        package = preferences().package
        if not package:
            raise ValueError("jaxdn: expected its folder or a wheel, got nothing; name it beside Install.")
        if not bpy.app.online_access:
            raise ValueError("Blender is offline: switch on Preferences > System > Allow Online Access.")
        commands = install_commands(sys.executable, own_environment(), bpy.path.abspath(package))
        return Run("Install", commands, lambda: f"jaxdn is installed in {own_environment()}")


class Cancel(bpy.types.Operator):
    """Stop; finished frames are kept"""

    bl_idname, bl_label = "jaxdn.cancel", "Cancel"

    @classmethod
    def poll(cls, context):
        """Only while something runs."""
        return latest is not None and latest.running

    def execute(self, context):
        """Stop the run."""
        assert latest is not None
        latest.cancel()
        return {"FINISHED"}


_CLASSES = (SetPasses, Denoise, Install, Cancel)


def register() -> None:
    """Make them known to Blender."""
    for each in _CLASSES:
        bpy.utils.register_class(each)


def unregister() -> None:
    """Take them away again; a run is stopped."""
    if latest is not None:
        latest.cancel()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
