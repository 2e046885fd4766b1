"""Clips that Cycles renders, for tests and for training: seeded scenes, noisy frames as users have them, references.

    python -m experiments.cycles render --set test train validation -o FOLDER
    python -m experiments.cycles list FOLDER

Cycles comes from the package ``bpy``, which asks for Python 3.11 and NumPy 1.26: an environment of its own
(``make cycles`` makes ``.venv-cycles``). Only the modules ``shot`` and ``fingerprint`` and the packages ``staging`` and
``kinds`` import it, in a process of their own; everything else here runs without it.

On Linux ``bpy`` loads libraries of the X window system, though nothing is shown. On Debian and Ubuntu they are
``libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libxrender1 libgl1 libegl1 libsm6 libgomp1``.
"""
