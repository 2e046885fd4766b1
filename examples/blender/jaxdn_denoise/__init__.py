"""jaxdn in Blender: a panel that sets the passes, denoises the rendered frames, and puts them back.

``command``, ``frames``, ``passes`` and ``background`` know nothing of Blender; the others need ``bpy``.
"""


def register() -> None:
    """Called by Blender when the add-on is switched on."""
    from . import operators, panel, properties

    for module in (properties, operators, panel):
        module.register()


def unregister() -> None:
    """Called by Blender when the add-on is switched off; a run in progress is stopped."""
    from . import operators, panel, properties

    for module in (panel, operators, properties):
        module.unregister()
