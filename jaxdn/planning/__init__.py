"""The effects of a scene and the rendering plan that follows: pure functions of a scene's properties.

The public interface is :mod:`jaxdn.effects`.
"""
