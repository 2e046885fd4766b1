"""Sparkle: the moving still life, with flakes of metal in what rolls, turns and stands on the table.

Each flake reflects the lamp in one direction only, covers about a pixel or less, and is lit for a frame or two as its
surface moves. To a denoiser that is noise, but the reference has it too: what is real and what is a firefly cannot be
told from one pixel of one frame. The flakes are those of :mod:`jaxdn.materials.glints`, rendered as a normal map.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.materials.glints import flake_normals
from jaxdn.render.families import textures
from jaxdn.render.families.fruit import moving_still_life
from jaxdn.render.families.staging import Finish, Stage

TEXELS = 128
REPEAT = (2.0, 1.0)
"""A lathe's surface is about twice as long around as it is high."""
GLITTERING = ("vase", "stand_dish", *(f"{group}_{index}" for group in ("stand_fruit", "rolling") for index in range(3)))
FLAKES, BINS = 64, 15
"""Nearly one flake for each texel, on average."""
_flakes = jax.jit(partial(flake_normals, TEXELS, flakes=FLAKES, bins=BINS))  # once for all of them


def glitter(seed: int, *, lamp: str = "mix") -> Stage:
    """The scene of `fruit` with glitter on the vase, the stand, its fruits and those that roll."""
    stage = Stage("glitter", seed, lamp=lamp)
    moving_still_life(stage)
    for name in GLITTERING:
        stage.parts[name] = stage.parts[name]._replace(material=_glittering(stage.rng))
    return stage


def _glittering(rng: np.random.Generator) -> Finish:
    """Polished flakes of one metal in its varnish; they are inclined as the facets of a rougher surface are."""
    color = textures.hsv(rng.random(), rng.uniform(0.1, 0.8), 0.95)
    polish, inclination = rng.uniform(0.12, 0.25), rng.uniform(0.4, 0.65)
    normals = np.asarray(_flakes(jnp.float32(inclination), seed=int(rng.integers(2**31))))
    return Finish(color, float(polish), metallic=1.0, repeat=REPEAT, normals=normals)
