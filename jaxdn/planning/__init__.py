"""Which effects a scene has and what follows from them: pure functions of plain facts.

The public front is :mod:`jaxdn.effects`.
"""
