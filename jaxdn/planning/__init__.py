"""The effects of a scene and the rendering plan that follows: pure functions of plain facts.

The public interface is :mod:`jaxdn.effects`.
"""
