"""The error that rendering raises; this module imports no renderer, so that error handlers need none."""


class RenderError(RuntimeError):
    """A frame that could not be rendered; the message names the clip, the frame and the reason."""
