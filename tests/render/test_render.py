"""The tracers against Mitsuba's own path integrator, and clips whose rendering is interrupted."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import effects
from jaxdn.clips import ClipError, read_frame
from jaxdn.core.frame import present
from jaxdn.data.clip.folder import begun_record, is_clip, read_record
from jaxdn.render import worker_pool
from jaxdn.render.clip import render_clip
from jaxdn.render.clip_job import ClipJob, is_finished, keep_variant
from jaxdn.render.frame import RenderedFrame, render_frame
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.mitsuba.variant import choose_variant, list_llvm_candidates, use_variant
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.seeds import NOISY, REFERENCE, SampleStream, make_frame_key, make_pass_seed, tea
from jaxdn.render.tracing.tracer import choose_tracer
from tests.needs import LLVM_15, require
from tests.render.render_scenes import HEIGHT, PIXEL, SQUARE_Z, WIDTH, Stage, fast_variants, shift

SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
SAMPLES = 64


@pytest.fixture(params=fast_variants())
def variant(request: pytest.FixtureRequest) -> str:
    return use_variant(request.param)


@pytest.fixture(scope="module")
def converged() -> dict[str, RenderedFrame]:
    """One frame by every variant, with as many samples as a test has time for."""
    return {
        name: render_frame(Stage(), 0, RenderSettings(reference_spp=SAMPLES, seed=1, variant=name, **SIZE))
        for name in fast_variants()
    }


def sliding() -> Stage:
    return Stage(square=lambda frame: shift(-2 * PIXEL * frame, 0, SQUARE_Z))


def test_the_stage_is_an_animated_scene() -> None:
    assert isinstance(Stage(), AnimatedScene)


def test_the_parts_add_up_to_mitsubas_path_integrator(variant: str, converged: dict[str, RenderedFrame]) -> None:
    import mitsuba as mi

    scene, found = Stage().build(0, WIDTH, HEIGHT), converged[variant]
    film = np.zeros((2, HEIGHT, WIDTH, 3))
    for index, depth in enumerate((Stage.max_depth, 2)):
        integrator: Any = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
        render: Any = mi.render
        film[index] = np.array(render(scene, integrator=integrator, spp=SAMPLES, seed=77))
    frame = found.frame
    assert frame.direct is not None
    assert frame.emission is not None
    assert found.reference is not None
    for mine, its in ((frame.emission + frame.direct, film[1]), (found.reference, film[0] - film[1])):
        assert its.mean() > 0.01
        # Two estimates, 64 samples of 384 pixels each: the means scatter by less than a per cent.
        np.testing.assert_allclose(mine.mean(), its.mean(), rtol=0.03)


def test_the_variants_agree(converged: dict[str, RenderedFrame]) -> None:
    require("llvm")
    first, second = converged.values()
    for one, other in ((first.reference, second.reference), (first.frame.direct, second.frame.direct)):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(np.mean(one), np.mean(other), rtol=0.03)


def test_light_is_never_negative_and_always_finite(variant: str, converged: dict[str, RenderedFrame]) -> None:
    found = converged[variant]
    assert found.bad_samples == 0
    for image in (*found.layers.values(), found.reference, found.reference_half, found.frame.direct):
        assert image is not None
        assert image.dtype == np.float32
        assert np.isfinite(image).all()
        assert image.min() >= 0


def test_light_that_is_not_finite_counts_as_black(variant: str) -> None:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 3e38}}
    lamp = {"type": "sphere", "center": [0, 2, 2], "radius": 1.0, "emitter": emitter}
    found = render_frame(Stage(shapes={"lamp": lamp}), 0, RenderSettings(reference_spp=4, variant=variant, **SIZE))
    for image in (found.frame.radiance, found.frame.direct, found.frame.emission, found.reference):
        assert image is not None
        assert np.isfinite(image).all()
    # Mitsuba's own film drops such samples before they can be counted.
    assert variant == "scalar_rgb" or found.bad_samples > 0


def test_without_a_bounce_nothing_is_indirect(variant: str) -> None:
    two = render_frame(Stage(), 0, RenderSettings(max_depth=2, variant=variant, **SIZE))
    one = render_frame(Stage(), 0, RenderSettings(max_depth=1, variant=variant, **SIZE))
    assert np.all(two.frame.radiance == 0)
    assert np.any(two.frame.direct)
    assert np.all(one.frame.radiance == 0)
    assert not np.any(one.frame.direct)


def test_emission_is_what_shines_into_the_camera(variant: str) -> None:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}
    square = {"type": "sphere", "center": [0, 0, SQUARE_Z], "radius": 1.0, "emitter": emitter}
    found = render_frame(Stage(shapes={"square": square}), 0, RenderSettings(variant=variant, **SIZE)).frame
    assert found.emission is not None
    np.testing.assert_allclose(found.emission[HEIGHT // 2, WIDTH // 2], [1, 2, 3], rtol=1e-5)
    assert np.all(found.emission[0, 0] == 0)


def test_the_reference_shares_no_sample_with_the_noise(variant: str) -> None:
    found = render_frame(Stage(), 0, RenderSettings(layers=(2,), reference_spp=4, variant=variant, **SIZE))
    assert found.reference_half is not None
    assert found.reference is not None
    # Two samples each: equal images would be the same samples.
    assert not np.array_equal(found.layers[2], found.reference_half)
    # The halves differ too, and the reference is their mean.
    assert not np.array_equal(found.reference, found.reference_half)


@pytest.mark.parametrize("room", ["all at once", "one set at a time"])
def test_sets_of_samples_are_those_that_are_traced_alone(variant: str, room: str) -> None:
    tracer, scene, stream = choose_tracer(variant), Stage().build(0, WIDTH, HEIGHT), SampleStream(3, 1, REFERENCE)
    few = {} if room == "all at once" or tracer.jittered else {"max_lanes": 3 * WIDTH * HEIGHT}
    found = tracer.accumulate_sets(scene, stream, 4, 2, 3, max_depth=Stage.max_depth, **few)
    assert len(found) == 3
    for index, one in enumerate(found):
        alone = tracer.accumulate(scene, stream, 4 + 2 * index, 2, max_depth=Stage.max_depth)
        assert one.bad == alone.bad
        for mine, other in zip(one[:3], alone[:3], strict=True):
            np.testing.assert_array_equal(mine, other)
    assert np.any(found[0].indirect != found[1].indirect)


def test_half_of_the_reference_measures_its_noise(variant: str) -> None:
    """The difference of reference and half has half the variance of the half itself: as large as the reference's."""
    found = render_frame(Stage(), 0, RenderSettings(reference_spp=64, seed=3, variant=variant, **SIZE))
    truth = render_frame(
        Stage(), 0, RenderSettings(reference_spp=256 if variant != "scalar_rgb" else 128, seed=4, **SIZE)
    ).reference
    assert found.reference is not None
    assert found.reference_half is not None
    assert truth is not None
    estimated = np.mean((found.reference - found.reference_half) ** 2)
    real = np.mean((found.reference - truth) ** 2)
    assert 0.3 < estimated / real < 1.5


def same(first: RenderedFrame, second: RenderedFrame) -> bool:
    pairs: list[Any] = [*zip(first.frame, second.frame, strict=True), (first.reference, second.reference)]
    pairs += [(first.layers[samples], second.layers[samples]) for samples in first.layers]
    return all(np.array_equal(one, other) for one, other in pairs if one is not None)


def test_a_frame_depends_only_on_its_arguments(variant: str) -> None:
    """Rendered after its predecessor, alone, or with other layers: the same bit for bit."""
    scene = sliding()
    options: dict[str, Any] = {"reference_spp": 2, "variant": variant, **SIZE}
    first = render_frame(scene, 0, RenderSettings(**options))
    after = render_frame(scene, 1, RenderSettings(**options), previous=first.view)
    alone = render_frame(sliding(), 1, RenderSettings(**options))
    assert same(after, alone)
    more = render_frame(scene, 1, RenderSettings(layers=(1, 4), **options))
    assert np.array_equal(more.layers[1], alone.layers[1])
    assert not np.array_equal(render_frame(scene, 1, RenderSettings(seed=1, **options)).layers[1], alone.layers[1])
    still = [render_frame(Stage(), frame, RenderSettings(**options)).layers[1] for frame in (0, 1)]
    assert not np.array_equal(still[0], still[1])


def test_motion_in_a_frame_is_that_of_the_geometry(variant: str) -> None:
    first = render_frame(sliding(), 0, RenderSettings(variant=variant, **SIZE)).frame
    assert np.all(first.motion == 0)
    assert np.all(first.dual_motion == 0)
    assert np.all(first.visible)
    frame = render_frame(sliding(), 1, RenderSettings(variant=variant, **SIZE)).frame
    assert frame.motion is not None
    assert frame.dual_motion is not None
    assert frame.visible is not None
    difference = np.linalg.norm(frame.dual_motion - frame.motion, axis=-1)
    np.testing.assert_array_equal(difference > 0.5, ~frame.visible[..., 0])
    assert (difference > 0.5).sum() == 12


def test_a_clip_is_written_and_resumes_where_it_was_interrupted(variant: str, tmp_path: Path) -> None:
    settings = RenderSettings(layers=(1, 2), reference_spp=2, variant=variant, **SIZE)
    whole = render_clip(sliding(), tmp_path / "whole", settings, frames=3)

    def interrupt(frame: int) -> None:
        if frame == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_clip(sliding(), tmp_path / "parts", settings, frames=3, progress=interrupt)
    parts = tmp_path / "parts"
    names = ["clip.unfinished.json", "frame_0000.exr", "frame_0001.exr"]
    assert sorted(path.name for path in parts.iterdir()) == names
    assert not is_clip(parts)
    # A truncated frame is rendered again, a complete one is not.
    damaged = (parts / "frame_0001.exr").read_bytes()
    (parts / "frame_0001.exr").write_bytes(damaged[: len(damaged) // 2])
    stamp = (parts / "frame_0000.exr").stat().st_mtime_ns
    seen: list[int] = []
    render_clip(sliding(), parts, settings, frames=3, progress=seen.append)
    assert seen == [0, 1, 2]
    assert is_clip(parts)
    assert not (parts / "clip.unfinished.json").exists()
    assert (parts / "frame_0000.exr").stat().st_mtime_ns == stamp
    for index in range(3):
        name = f"frame_{index:04d}.exr"
        one: Any = read_frame(whole / name, spp=3)
        other: Any = read_frame(parts / name, spp=3)
        assert all(np.array_equal(mine, its) for mine, its in zip(one.frame, other.frame, strict=True))
        assert np.array_equal(one.reference, other.reference)
    record = json.loads((whole / "clip.json").read_text())
    assert record["variant"] == variant
    assert record["frames"] == 3
    assert len(record["cameras"]) == 3
    assert record["jittered"] is (variant == "scalar_rgb")
    assert record["bad_samples"] == 0


KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[2])
from tests.render.render_scenes import HEIGHT, WIDTH, Stage
from jaxdn.render.clip import render_clip
from jaxdn.render.settings import RenderSettings
def kill(frame):
    if frame == 1:
        os.kill(os.getpid(), signal.SIGKILL)
settings = RenderSettings(width=WIDTH, height=HEIGHT, reference_spp=2, variant="scalar_rgb")
render_clip(Stage(), sys.argv[1], settings, frames=3, progress=kill)
"""


@pytest.mark.slow
def test_a_killed_rendering_leaves_no_clip_and_resumes(tmp_path: Path) -> None:
    settings = RenderSettings(reference_spp=2, variant="scalar_rgb", **SIZE)
    parts = tmp_path / "parts"
    done = subprocess.run([sys.executable, "-c", KILLED, str(parts), str(Path(__file__).parents[2])], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (parts / "frame_0001.exr").exists()
    assert not is_clip(parts)
    with pytest.raises(ClipError):
        read_record(parts)
    render_clip(Stage(), parts, settings, frames=3)
    assert is_clip(parts)
    whole = render_clip(Stage(), tmp_path / "whole", settings, frames=3)
    assert read_record(parts) == read_record(whole)
    for index in range(3):
        name = f"frame_{index:04d}.exr"
        assert (parts / name).read_bytes() == (whole / name).read_bytes()


def test_a_second_renderer_of_a_finished_clip_that_is_killed_leaves_the_clip(tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    render_clip(Stage(), clip, RenderSettings(reference_spp=2, variant="scalar_rgb", **SIZE), frames=3)
    before = {path.name: path.read_bytes() for path in clip.iterdir()}
    done = subprocess.run([sys.executable, "-c", KILLED, str(clip), str(Path(__file__).parents[2])], check=False)
    assert done.returncode == -signal.SIGKILL
    assert {path.name: path.read_bytes() for path in clip.iterdir()} == before
    assert is_clip(clip)


def test_a_finished_clip_that_gets_more_frames_is_unfinished_until_it_has_them(tmp_path: Path) -> None:
    options: dict[str, Any] = {"variant": "scalar_rgb", **SIZE}
    render_clip(Stage(), tmp_path, RenderSettings(**options), frames=1)
    assert is_clip(tmp_path)

    def interrupt(frame: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_clip(Stage(), tmp_path, RenderSettings(**options), frames=2, progress=interrupt)
    assert not is_clip(tmp_path)
    render_clip(Stage(), tmp_path, RenderSettings(**options), frames=2)
    assert read_record(tmp_path)["frames"] == 2


def test_a_clip_does_not_lose_frames(tmp_path: Path) -> None:
    settings = RenderSettings(variant="scalar_rgb", **SIZE)
    render_clip(Stage(), tmp_path, settings, frames=2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ClipError, match="2 frames there, 1 wanted"):
        render_clip(Stage(), tmp_path, settings, frames=1)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_frames_of_an_edited_scene_file_are_not_added_to_a_clip(tmp_path: Path) -> None:
    file, clip = tmp_path / "scene.xml", tmp_path / "clip"
    file.write_text("a red wall")
    scene, settings = Stage(), RenderSettings(variant="scalar_rgb", **SIZE)
    scene.record = {"file": str(file)}
    job = ClipJob(scene.record, str(clip), 1, settings)
    render_clip(scene, clip, settings, frames=1)
    assert is_finished(job)
    file.write_text("a blue wall")
    assert not is_finished(job)
    for frames in (1, 2):
        with pytest.raises(ClipError, match=r"the scene file .*scene\.xml has been edited"):
            render_clip(scene, clip, settings, frames=frames)
    # Clips of earlier versions do not say what their scene file held.
    record = json.loads((clip / "clip.json").read_text())
    del record["scene_file_sha256"]
    (clip / "clip.json").write_text(json.dumps(record))
    assert is_finished(job)
    render_clip(scene, clip, settings, frames=2)
    assert read_record(clip)["frames"] == 2


def test_frames_of_a_scene_whose_parts_are_edited_are_not_added_to_a_clip(tmp_path: Path) -> None:
    """Of a file that is included, and of one that this one reads."""
    files = {
        "scene.xml": '<scene version="3.0.0"><include filename="parts/walls.xml"/></scene>',
        "parts/walls.xml": '<scene version="3.0.0"><texture type="bitmap"><string name="filename" value="red.png"/>'
        '<string name="filename" value="$given"/></texture></scene>',
        "parts/red.png": "red",
    }
    (tmp_path / "parts").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    clip, scene, settings = tmp_path / "clip", Stage(), RenderSettings(variant="scalar_rgb", **SIZE)
    scene.record = {"file": str(tmp_path / "scene.xml")}
    job = ClipJob(scene.record, str(clip), 1, settings)
    render_clip(scene, clip, settings, frames=1)
    assert set(read_record(clip)["scene_parts_sha256"]) == {"parts/walls.xml", "red.png"}
    assert is_finished(job)
    for part, name in (("parts/red.png", "red.png"), ("parts/walls.xml", "parts/walls.xml")):
        (tmp_path / part).write_text(files[part] + " ")
        assert not is_finished(job)
        with pytest.raises(ClipError, match=rf"; {name}, which the scene file .*scene\.xml reads, has been edited\)"):
            render_clip(scene, clip, settings, frames=2)
        (tmp_path / part).write_text(files[part])
    (tmp_path / "parts/red.png").unlink()
    with pytest.raises(ClipError, match=r"red\.png, which"):
        render_clip(scene, clip, settings, frames=2)
    (tmp_path / "parts/red.png").write_text("red")
    # Clips of earlier versions do not say what the other files held.
    record = json.loads((clip / "clip.json").read_text())
    del record["scene_parts_sha256"]
    (clip / "clip.json").write_text(json.dumps(record))
    (tmp_path / "parts/red.png").write_text("blue")
    assert is_finished(job)


def test_without_a_plan_every_buffer_of_every_effect_is_rendered() -> None:
    frame = render_frame(Stage(), 0, RenderSettings(variant="scalar_rgb", **SIZE)).frame
    assert set(present(frame)) == set(effects.plan(effects.choose_all_effects(1)).buffers)


def test_a_clip_is_finished_with_all_its_frames_and_the_same_settings_alone(tmp_path: Path) -> None:
    scene = {"family": "fruit", "seed": 0}
    settings = RenderSettings(plan=effects.plan(effects.choose_effects(["indirect"], 2)), **SIZE)
    render_clip(scene_from_record(scene), tmp_path, replace(settings, variant="scalar_rgb"), frames=2)
    job = ClipJob(scene, str(tmp_path), 2, settings)
    assert is_finished(job)
    (tmp_path / "frame_0001.exr").unlink()
    assert not is_finished(job)
    render_clip(scene_from_record(scene), tmp_path, replace(settings, variant="scalar_rgb"), frames=2)
    assert is_finished(job)
    for change in ({"seed": 1}, {"plan": None}, {"max_depth": 2}, {"variant": "llvm_ad_rgb"}, {"draws": 1}):
        assert not is_finished(job._replace(settings=replace(settings, **change)))


def test_other_settings_in_the_same_folder_raise(tmp_path: Path) -> None:
    settings = RenderSettings(variant="scalar_rgb", **SIZE)
    render_clip(Stage(), tmp_path, settings, frames=1)
    with pytest.raises(ClipError, match="seed: 0 there, 5 wanted"):
        render_clip(Stage(), tmp_path, replace(settings, seed=5), frames=1)
    with pytest.raises(ClipError, match="another camera path"):
        render_clip(Stage(camera=lambda frame: shift(0.1, 0, 0)), tmp_path, settings, frames=1)
    render_clip(Stage(), tmp_path, settings, frames=2)  # more frames with the same settings are allowed
    assert (tmp_path / "frame_0001.exr").exists()


def test_a_scene_that_fails_is_named_with_its_frame(tmp_path: Path) -> None:
    def breaks(frame: float) -> np.ndarray:
        if frame == 1:
            raise ArithmeticError("no pose here")
        return shift(0, 0, SQUARE_Z)

    with pytest.raises(RenderError, match=r"'stage'.*frame 1: ArithmeticError: no pose here"):
        render_clip(Stage(square=breaks), tmp_path, RenderSettings(variant="scalar_rgb", **SIZE), frames=2)
    assert (tmp_path / "frame_0000.exr").exists()
    assert not is_clip(tmp_path)


UNSUPPORTED: dict[str, dict[str, Any]] = {
    "fog": {
        "mist": {
            "type": "sphere",
            "center": [0, 0, 4],
            "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous", "albedo": 0.5},
        }
    },
    "depth of field": {"sensor": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}},
    "without a shutter": {"sensor": {"type": "perspective", "shutter_open": 0.0, "shutter_close": 1.0}},
}


@pytest.mark.parametrize("effect", UNSUPPORTED)
def test_effects_that_need_filtered_pixels_or_are_not_supported_raise(variant: str, effect: str) -> None:
    extra = UNSUPPORTED[effect]
    if "sensor" in extra:
        film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
        extra = {"sensor": {**extra["sensor"], "film": film}}
    with pytest.raises(ValueError, match=effect):
        render_frame(Stage(extra=extra), 0, RenderSettings(variant=variant, **SIZE))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": (3,)}, "powers of two"),
        ({"layers": ()}, "powers of two"),
        ({"layers": (1, 1)}, "powers of two"),
        ({"reference_spp": 1}, "reference_spp"),
        ({"max_depth": 0}, "max_depth"),
        ({"width": 0}, "width"),
        ({"variant": "fastest"}, "variant"),
    ],
)
def test_options_out_of_range_raise(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render_frame(Stage(), 0, RenderSettings(**{"variant": "scalar_rgb", **SIZE, **options}))


def test_a_record_without_a_known_family_raises() -> None:
    with pytest.raises(ValueError, match="family"):
        scene_from_record({"seed": 1})
    with pytest.raises(ValueError, match="'nothing'"):
        scene_from_record({"family": "nothing"})


def test_the_kernel_is_not_compiled_again_for_another_frame() -> None:
    require("llvm")
    fast = choose_variant().variant
    use_variant(fast)
    import drjit as dr

    def kernels(frame: int, seed: int) -> set[Any]:
        dr.kernel_history_clear()
        render_frame(sliding(), frame, RenderSettings(layers=(4,), reference_spp=8, seed=seed, variant=fast, **SIZE))
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    # Objects are numbered in the order of creation; the numbers are constant after two frames.
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        known = kernels(1, 0) | kernels(2, 0)
        assert kernels(3, 5) <= known
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


def test_seeds_are_all_different() -> None:
    keys = {make_frame_key(seed, frame, stream) for seed in range(8) for frame in range(64) for stream in (0, 1)}
    assert len(keys) == 8 * 64 * 2
    assert len({tea(first, second) for first in range(64) for second in range(64)}) == 64 * 64
    # At 128 x 128 Mitsuba uses only its low 18 bits.
    passes = {make_pass_seed(3, 7, stream, index) % 2**18 for stream in (NOISY, REFERENCE) for index in range(4096)}
    assert len(passes) == 2 * 4096


SAY = "from jaxdn.render.mitsuba.variant import choose_variant; print(*choose_variant(), sep='|')"


def chosen(**environment: str) -> str:
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("_JAXDN", "DRJIT", "JAXDN"))}
    command = [sys.executable, "-c", SAY]
    home = str(Path(__file__).parents[1])
    found = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True, cwd=home)
    return found.stdout.strip()


def test_without_llvm_the_scalar_variant_is_chosen_with_advice() -> None:
    variant, library, reason = chosen(DRJIT_LIBLLVM_PATH="/nonexistent/libLLVM.so").split("|")
    assert variant in ("scalar_rgb", "cuda_ad_rgb")
    assert library == ""
    if variant == "scalar_rgb":
        assert "libllvm19" in reason
        assert "DRJIT_LIBLLVM_PATH" in reason


def test_an_llvm_that_aborts_the_process_is_survived() -> None:
    require("LLVM 15")
    assert chosen(DRJIT_LIBLLVM_PATH=str(LLVM_15)).split("|")[0] != "llvm_ad_rgb"


def test_the_users_choice_wins_and_old_libraries_are_not_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(JAXDN_VARIANT="scalar_rgb").startswith("scalar_rgb|")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert not any(f"LLVM-{old}" in path for path in list_llvm_candidates() for old in (14, 15, 16))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/somewhere")
    assert list_llvm_candidates() == ["/somewhere"]


def test_a_worker_that_dies_is_reported_with_its_clip(tmp_path: Path) -> None:
    job = ClipJob({"family": "fruit", "seed": 0}, str(tmp_path / "lost"), 4, RenderSettings(**SIZE))
    worker = worker_pool._start_worker(job, threads=1)
    worker.process.kill()
    deadline, failure, ended = time.monotonic() + 60, "", False
    while not ended and time.monotonic() < deadline:
        _, failure, ended = worker_pool._read_messages(worker)
    assert ended
    assert "lost" in failure
    assert "frame 0" in failure
    assert "SIGKILL" in failure


def begin(folder: Path, scene: dict[str, Any], variant: str) -> None:
    """Render the first of two frames and stop."""

    def interrupt(frame: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_clip(
            scene_from_record(scene), folder, RenderSettings(variant=variant, **SIZE), frames=2, progress=interrupt
        )


@pytest.mark.slow
def test_a_job_keeps_the_variant_that_its_clip_was_started_with(tmp_path: Path) -> None:
    scene = {"family": "fruit", "seed": 0}
    begin(tmp_path, scene, "scalar_rgb")
    job = ClipJob(scene, str(tmp_path), 2, RenderSettings(**SIZE))
    assert keep_variant(job).settings.variant == "scalar_rgb"
    assert (
        keep_variant(job._replace(settings=replace(job.settings, variant="llvm_ad_rgb"))).settings.variant
        == "llvm_ad_rgb"
    )
    assert keep_variant(job._replace(folder=str(tmp_path / "new"))).settings.variant is None


def test_a_clip_started_with_a_variant_that_does_not_run_here_is_named(tmp_path: Path) -> None:
    scene = {"family": "fruit", "seed": 0}
    begin(tmp_path, scene, "scalar_rgb")
    file = tmp_path / "clip.unfinished.json"
    file.write_text(file.read_text().replace("scalar_rgb", "vulkan_rgb"))
    job = ClipJob(scene, str(tmp_path), 2, RenderSettings(**SIZE))
    with pytest.raises(ValueError, match=rf"{tmp_path.name}.*vulkan_rgb"):
        worker_pool.render_clips([job], progress=False)


@pytest.mark.slow
def test_an_interrupted_clip_is_finished_with_the_variant_it_was_started_with(tmp_path: Path) -> None:
    scene = {"family": "fruit", "seed": 0}
    begin(tmp_path, scene, "scalar_rgb")
    worker_pool.render_clips([ClipJob(scene, str(tmp_path), 2, RenderSettings(**SIZE))], progress=False)
    assert is_clip(tmp_path)
    record = begun_record(tmp_path)
    assert record is not None
    assert record["variant"] == "scalar_rgb"


@pytest.mark.slow
def test_clips_are_rendered_in_parallel_and_failures_do_not_stop_the_others(tmp_path: Path) -> None:
    good = ClipJob({"family": "fruit", "seed": 0}, str(tmp_path / "good"), 2, RenderSettings(**SIZE))
    bad = ClipJob({"family": "nothing"}, str(tmp_path / "bad"), 2, RenderSettings(**SIZE))
    steps: list[tuple[int, int]] = []
    with pytest.raises(RenderError, match=r"1 of 2(.|\n)*bad(.|\n)*'nothing'"):
        worker_pool.render_clips([bad, good], workers=2, progress=lambda done, total: steps.append((done, total)))
    assert steps[-1] == (2, 4)
    assert len(list((tmp_path / "good").glob("frame_*.exr"))) == 2
    assert is_clip(tmp_path / "good")
    assert not is_clip(tmp_path / "bad")
    with pytest.raises(ValueError, match="a different folder for every clip"):
        worker_pool.render_clips([good, good], progress=False)


@pytest.mark.slow
def test_a_finished_clip_needs_no_process(tmp_path, monkeypatch):
    job = ClipJob(
        {"family": "fruit", "seed": 0},
        str(tmp_path / "c"),
        2,
        RenderSettings(width=16, height=12, reference_spp=2, variant="scalar_rgb"),
    )
    worker_pool.render_clips([job], progress=False)
    started = []
    start = worker_pool._start_worker
    monkeypatch.setattr(worker_pool, "_start_worker", lambda *a, **k: started.append(a) or start(*a, **k))
    seen = []
    worker_pool.render_clips([job], progress=lambda done, total: seen.append((done, total)))
    assert not started
    assert seen == [(2, 2)]
    (tmp_path / "c" / "frame_0001.exr").unlink()
    worker_pool.render_clips([job], progress=False)
    assert len(started) == 1
    assert (tmp_path / "c" / "frame_0001.exr").is_file()
