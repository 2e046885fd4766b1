"""Regression tests for broken files that the fuzzer found."""

import json
import time

import numpy as np
import pytest

from jaxdn.clips import ClipError, read_clip, write_clip
from jaxdn.core.frame import Clip, Frame
from jaxdn.data.evidence import read_clip_properties
from jaxdn.data.training.cache import open_cached
from jaxdn.render.scenes.animation import check_animation, read_animation
from jaxdn.zoo.weights import load_weights

DEEP = "[" * 20_000 + "]" * 20_000


@pytest.fixture
def clip(tmp_path):
    light = np.ones((2, 4, 6, 3), np.float32)
    write_clip(Clip(Frame(light, depth=light[..., :1]), light), tmp_path / "clip")
    return tmp_path / "clip"


def rewrite(clip, **entries):
    record = json.loads((clip / "clip.json").read_bytes())
    (clip / "clip.json").write_text(json.dumps(record | entries))


@pytest.mark.parametrize("read", [read_clip, open_cached])
def test_a_record_that_claims_endless_frames_is_refused_at_once(clip, read):
    rewrite(clip, frames=10**15)
    began = time.monotonic()
    with pytest.raises(ClipError, match=r"missing|No such file"):
        read(clip)
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("read", [read_clip, open_cached, read_clip_properties])
@pytest.mark.parametrize(
    "plan",
    [
        {"frames": [[3], ["depth"]], "held": [0, 1], "effects": []},
        {"frames": [[["depth"]], ["depth"]], "held": [0, 1], "effects": []},
        {"frames": [7, ["depth"]], "held": [0, 1], "effects": []},
        {"frames": ["depth", ["depth"]], "held": [0, 1], "effects": []},
        {"frames": [["colour"], ["depth"]], "held": [0, 1], "effects": []},
        {"frames": [["depth"], ["depth"]], "held": [0, 2]},
        {"frames": [["depth"]], "held": [0]},
        {"held": [0, 1]},
        {"frames": [["depth"], ["depth"]], "held": [0, 1]},
        {"frames": [["depth"], ["depth"]], "held": [0, 1], "effects": 3},
        ["frames"],
    ],
)
def test_an_invalid_plan_is_refused(clip, read, plan):
    rewrite(clip, plan=plan)
    with pytest.raises(ClipError, match="plan: expected"):
        read(clip)


def test_a_record_with_fewer_cameras_than_frames_is_refused(clip):
    rewrite(clip, cameras=[{"x_fov": 60.0}])
    with pytest.raises(ClipError, match="cameras: expected"):
        read_clip_properties(clip)


@pytest.mark.parametrize("number", [10**400, -(10**400)])
def test_a_number_too_large_for_a_float_is_refused(number):
    with pytest.raises(ValueError, match="finite"):
        check_animation({"lights": {"lamp": [{"frame": 0, "scale": number}]}}, [])


def test_an_animation_nested_without_end_is_refused(tmp_path):
    (tmp_path / "animation.json").write_text(DEEP)
    with pytest.raises(ValueError, match="expected JSON"):
        read_animation(tmp_path / "animation.json")


def test_a_description_of_weights_nested_without_end_is_refused(tmp_path):
    (tmp_path / "weights.safetensors").write_bytes(b"")
    (tmp_path / "weights.json").write_text(DEEP)
    with pytest.raises(ValueError, match=r"expected weights\.json in the same folder"):
        load_weights(tmp_path / "weights.safetensors")
