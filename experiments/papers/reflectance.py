"""What surfaces reflect, as the renderer finds it, against independent Monte Carlo averages.

``python -m experiments.papers.reflectance`` prints, for every material of :func:`materials`, the mean and the largest
error of F_b over the pixels that show it, and how far a white furnace is from 1: constant light of radiance 1 from all
around, of which every pixel divided by F_b should be 1 (Zhuang et al. 2021, eq. 12).
"""

from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.mitsuba.variant import use_variant

SIZE = 24
"""Width and height of the picture in pixels: a ball that nearly fills it."""
SAMPLES = 4096


def _rgb(red: float, green: float, blue: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [red, green, blue]}


def _picture(*, channels: int = 3, upright: bool = False) -> dict[str, Any]:
    """A texture of smooth random values in [0.05, 0.95], or, ``upright``, of normals that lean a little."""
    import mitsuba as mi

    values = np.random.default_rng(3).uniform(0.05, 0.95, (8, 8, channels))
    if upright:
        values = np.concatenate([0.4 + 0.2 * values[..., :2], np.ones((8, 8, 1))], axis=-1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}


def materials() -> dict[str, dict[str, Any]]:
    """Name -> Mitsuba's dict; needs a variant."""
    red, gold = _rgb(0.7, 0.1, 0.05), {"material": "Au"}
    plastic = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": red}
    return {
        "diffuse": {"type": "diffuse", "reflectance": red},
        "diffuse, textured": {"type": "diffuse", "reflectance": _picture()},
        "conductor": {"type": "conductor", **gold},
        "roughconductor, GGX": {"type": "roughconductor", "distribution": "ggx", "alpha": 0.3, **gold},
        "roughconductor, Beckmann": {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.3, **gold},
        "roughconductor, anisotropic": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4, **gold},
        "roughconductor, textured": {"type": "roughconductor", "alpha": _picture(channels=1), **gold},
        "plastic": {"type": "plastic", "diffuse_reflectance": red, "nonlinear": True},
        "roughplastic": plastic,
        "roughplastic, textured": {**plastic, "diffuse_reflectance": _picture()},
        "principled": {"type": "principled", "base_color": red, "roughness": 0.4, "metallic": 0.3},
        "principled, textured": {"type": "principled", "base_color": _picture(), "roughness": 0.4},
        "principled, clearcoat": {"type": "principled", "base_color": red, "clearcoat": 1.0, "sheen": 0.5},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.3, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
        "blendbsdf, textured": {
            "type": "blendbsdf", "weight": _picture(channels=1), "a": {"type": "diffuse"}, "b": plastic
        },
        "mask": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse", "reflectance": red}},
        "bumpmap": {"type": "bumpmap", "scale": 0.3, "bumps": _picture(channels=1), "nested": plastic},
        "normalmap": {"type": "normalmap", "normalmap": _picture(upright=True), "nested": plastic},
        "twosided": {"type": "twosided", "a": plastic, "b": {"type": "diffuse"}},
        "dielectric": {"type": "dielectric"},
        "thindielectric": {"type": "thindielectric"},
        "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    }  # fmt: skip


def ball(material: dict[str, Any]) -> Any:
    """A ball of a material in white light from all around, before a camera."""
    import mitsuba as mi

    camera = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 31, "to_world": camera, "film": film},
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": {"type": "sphere", "bsdf": material},
        },
        optimize=False,
    )


def monte_carlo(scene: Any, samples: int = SAMPLES) -> np.ndarray:
    """[H, W, 3] the mean of independent samples of the BSDF at every pixel's hit, lossless where light passes through.

    In a vectorised variant; other random numbers in every pixel.
    """
    import drjit as dr
    import mitsuba as mi

    from jaxdn.render.tracing.camera_rays import make_camera_rays

    lane = dr.arange(mi.UInt32, SIZE * SIZE * samples)
    pixel = lane // samples
    hit = scene.ray_intersect(make_camera_rays(scene.sensors()[0], pixel % SIZE, pixel // SIZE))
    pcg: Any = mi.PCG32
    numbers = pcg(size=SIZE * SIZE * samples, initstate=5)
    lobe = numbers.next_float32()
    place = mi.Point2f(numbers.next_float32(), numbers.next_float32())
    valid = hit.is_valid()
    sampled, weight = hit.bsdf().sample(mi.BSDFContext(), hit, lobe, place, valid)
    scale = dr.select(mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Transmission), dr.square(sampled.eta), 1.0)
    weight = dr.select(valid, mi.Color3f(weight) * scale, 1.0)
    dr.eval(weight)
    return np.array(weight, np.float64).T.reshape(SIZE, SIZE, samples, 3).mean(axis=2)


class Found(NamedTuple):
    """One row of the table."""

    mean: float
    worst: float
    furnace: float
    """Mean of |radiance / F_b - 1|; not a number where light that passes through is lost."""


def measure(material: dict[str, Any], *, furnace_samples: int = 1024) -> Found:
    """How far the renderer's F_b is from Monte Carlo's on a ball of a material, and the furnace from 1."""
    from jaxdn.render.buffers.gbuffer import trace_gbuffer
    from jaxdn.render.tracing.seeds import NOISY, SampleStream
    from jaxdn.render.tracing.vectorised_path_tracer import accumulate

    scene = ball(material)
    there = trace_gbuffer(scene, reflectance=True)
    inside = there.ids[..., 0] >= 0
    assert there.reflectance is not None
    error = np.abs(there.reflectance - np.clip(monte_carlo(scene), 0, 1))[inside]
    clear = "dielectric" in material["type"]
    depth = 24 if clear else 2  # through the ball, and about in it, before light is outside again
    light = accumulate(scene, SampleStream(1, 0, NOISY), 0, furnace_samples, max_depth=depth)
    radiance = (light.direct + light.indirect) / furnace_samples
    furnace = float(np.mean(np.abs(radiance / np.maximum(there.reflectance, 1e-3) - 1)[inside]))
    # The inside of a mask's ball is black.
    return Found(float(error.mean()), float(error.max()), float("nan") if material["type"] == "mask" else furnace)


def main() -> None:
    use_variant()
    print(f"| material | mean error | worst | furnace |\n|{'---|' * 4}")
    for name, material in materials().items():
        found = measure(material)
        print(f"| {name} | {found.mean:.4f} | {found.worst:.4f} | {found.furnace:.4f} |", flush=True)


if __name__ == "__main__":
    main()
