"""The measured path length is the theoretical one."""

import pytest

from jaxdn.render.open_scene import open_scene
from jaxdn.render.path_depth import measure_depth


def furnace(reflectance, max_depth=30):
    """The inside of a glowing sphere: every bounce adds ``reflectance`` times the one before, everywhere."""
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "film": film},
        "sphere": {
            "type": "sphere",
            "flip_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
        },
    }
    opened = open_scene(scene)
    opened.max_depth = max_depth
    return opened


@pytest.mark.parametrize(("reflectance", "depth"), [(0.08, 3), (0.2, 4), (0.45, 8), (0.55, 10), (0.7, 17)])
def test_in_a_furnace_depth_follows_from_the_reflectance(reflectance, depth):
    # After depth D the share reflectance ** (D - 1) is missing. Lengths are tried at 2, 3, 4, 5, 6, 8, 10, 13, 17, 24.
    found = measure_depth(furnace(reflectance), bound=0.01)
    assert found.max_depth == depth
    assert found.remaining == pytest.approx(reflectance ** (depth - 1), rel=0.25)


def test_a_wider_bound_is_a_shorter_path():
    assert [measure_depth(furnace(0.5), bound=bound).max_depth for bound in (0.3, 0.1, 0.03, 0.01)] == [3, 5, 8, 8]


def test_the_scene_limits_the_length_and_what_is_missing_is_known():
    found = measure_depth(furnace(0.8, max_depth=5), bound=0.01)
    assert found.max_depth == 5
    assert found.remaining == pytest.approx(0.8**4, rel=0.25)


def test_darkness_needs_no_long_paths():
    found = measure_depth(furnace(0.0), bound=0.01)
    assert found.max_depth == 3
    assert found.remaining == 0.0


@pytest.mark.parametrize("bound", [0.0, 1.0, -1.0, float("nan")])
def test_a_bound_is_a_share(bound):
    with pytest.raises(ValueError, match="bound: expected a share"):
        measure_depth(furnace(0.5), bound=bound)
