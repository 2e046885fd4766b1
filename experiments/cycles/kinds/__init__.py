"""The kinds of clips: one module each, with a function ``build(stage)`` that makes the scene and its camera."""
