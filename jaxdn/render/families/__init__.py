"""Procedural animated scenes: every seed gives a different scene, and always the same one.

`FAMILIES` maps a family's name to its function of a seed. Clips record ``{"family": name, "seed": seed}``, so the scene
of a seed must not change once clips have been rendered from it: add a new family instead of changing one.
"""

from collections.abc import Callable

from jaxdn.render.families.dash import dash
from jaxdn.render.families.edge import edge
from jaxdn.render.families.fruit import fruit
from jaxdn.render.families.glitter import glitter
from jaxdn.render.families.mobile import mobile
from jaxdn.render.families.parlour import parlour
from jaxdn.render.families.pinkroom import pinkroom
from jaxdn.render.families.robot import robot
from jaxdn.render.families.staging import Stage

FAMILIES: dict[str, Callable[..., Stage]] = {
    "fruit": fruit,
    "robot": robot,
    "pinkroom": pinkroom,
    "mobile": mobile,
    "edge": edge,
    "dash": dash,
    "glitter": glitter,
    "parlour": parlour,
}
