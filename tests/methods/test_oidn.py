"""Open Image Denoise as a method: the library's own images, in programs, tiles and files; what it cannot do is said."""

import functools
import importlib.util
import subprocess
import sys
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn import color
from jaxdn.commands.main import main
from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.data.clip.folder import write_clip
from jaxdn.data.exr.exr import read_exr
from jaxdn.denoiser.rollout import stream
from jaxdn.denoiser.tiles import GRID, stream_tiled
from jaxdn.denoisers import demodulated, oidn
from jaxdn.export.step import exported_step
from jaxdn.methods.registry import method_named
from jaxdn.ops import oidn as binding
from jaxdn.ops.dispatch.operation import NotPortableError
from jaxdn.zoo.ready import filter_names, find_model
from tests.needs import require

SIZE = (48, 64)


@pytest.fixture
def library():
    """The package itself, without which nothing can be compared with it."""
    require("pyoidn")
    import pyoidn

    return pyoidn


def clip_of(rng, count=2, size=SIZE):
    normal = rng.normal(size=(count, *size, 3))
    return Frame(
        rng.exponential(size=(count, *size, 3)).astype(np.float32),
        albedo=rng.uniform(0.2, 0.9, (count, *size, 3)).astype(np.float32),
        normal=(normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
    )


def directly(library, frame, quality, scale=None):
    """What the library gives, by its own interface and in memory that it shares."""
    arrays = {"color": frame.radiance, "albedo": frame.albedo, "normal": frame.normal}
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items() if array is not None}
    arrays["output"] = np.zeros_like(arrays["color"])
    with library.Device(library.OIDN_DEVICE_TYPE_CPU) as device:
        device.commit()
        with library.Filter(device, "RT") as kernel:
            for name, array in arrays.items():
                kernel.set_image(name, array, library.OIDN_FORMAT_FLOAT3)
            kernel.set_bool("hdr", True)
            kernel.set_int("quality", {"high": 6, "balanced": 5, "fast": 4}[quality])
            if scale is not None:
                kernel.set_float("inputScale", scale)
            kernel.commit()
            kernel.execute()
            assert device.get_error() is None
    return arrays["output"]


def test_on_a_cpu_the_library_has_the_arrays_that_it_is_given(library, rng, monkeypatch):
    """And those of another call when that comes: the network is built once."""
    placed, real = [], library.Filter.set_image
    monkeypatch.setattr(
        library.Filter,
        "set_image",
        lambda kernel, name, image, *rest: placed.append(image) or real(kernel, name, image, *rest),
    )
    settings, frames = binding.OidnSettings(device="cpu"), clip_of(rng)
    for index in range(2):
        frame = frame_at(frames, index)
        out = np.empty((*SIZE, 3), np.float32)
        placed.clear()
        found = binding.denoise(frame.radiance, frame.albedo, frame.normal, settings=settings, scale=0.7, out=out)
        assert found is out
        np.testing.assert_array_equal(found, directly(library, frame, "high", 0.7))
        for array, wanted in zip(placed, (frame.radiance, frame.albedo, frame.normal, out), strict=False):
            assert np.shares_memory(array, wanted)


@pytest.mark.parametrize("quality", ["high", "balanced", "fast"])
def test_images_are_the_librarys_own(library, quality, rng, monkeypatch):
    """To the last bit for the numbers that it is given, and to rounding where it measures the brightness itself."""
    given, call = [], binding.denoise

    def spy(*images, settings, scale, out):
        given.append((Frame(*(image.copy() for image in images)), scale))
        return call(*images, settings=settings, scale=scale, out=out)

    monkeypatch.setattr(binding, "denoise", spy)
    frames = clip_of(rng)
    images = np.asarray(jaxdn.denoise(oidn(quality=quality, device="cpu"), {}, Clip(frames)))
    for index, (frame, scale) in enumerate(given):
        np.testing.assert_array_equal(images[index], directly(library, frame, quality, scale))
        asked = frame_at(frames, index)
        for name in ("radiance", "albedo", "normal"):
            np.testing.assert_allclose(getattr(frame, name), getattr(asked, name), atol=1e-6)
        np.testing.assert_allclose(scale, color.exposure(asked.radiance), rtol=1e-5)
        np.testing.assert_allclose(images[index], directly(library, asked, quality), atol=1e-4)


class Gpu:
    """Stands for the package where there is a GPU whose memory is full at first: the image is twice the colour."""

    OIDN_DEVICE_TYPE_CPU = OIDN_DEVICE_TYPE_CUDA = OIDN_FORMAT_FLOAT3 = 0
    OIDN_QUALITY_HIGH = OIDN_QUALITY_BALANCED = OIDN_QUALITY_FAST = 0
    OIDN_FILTER_TYPE_RT = "RT"

    def __init__(self):
        gpu, self.full, self.errors, self.released = self, True, [], 0

        class Handle:
            def release(self):
                gpu.released += 1

        class Device(Handle):
            def __init__(self, kind):
                pass

            def commit(self):
                pass

            def get_error(self):
                return gpu.errors.pop(0) if gpu.errors else None

        class Buffer(Handle):
            def __init__(self, device, size):
                self.memory = None if gpu.full else np.zeros(size, np.uint8)
                gpu.errors += ["out of memory"] * gpu.full

            def write(self, start, size, array):
                self.memory[start : start + size] = array.reshape(-1).view(np.uint8)

            def read(self, start, size, array):
                array.reshape(-1).view(np.uint8)[:] = self.memory[start : start + size]

        class Filter(Handle):
            def __init__(self, device, kind):
                self.images = {}

            def set_image(self, name, buffer, *size):
                self.images[name] = buffer

            def set_quality(self, quality):
                pass

            def set_bool(self, name, value):
                pass

            def set_float(self, name, value):
                pass

            def commit(self):
                pass

            def execute(self):
                color, output = (self.images[name].memory.view(np.float32) for name in ("color", "output"))
                output[:] = 2 * color

        self.Device, self.Buffer, self.Filter = Device, Buffer, Filter


def test_on_a_gpu_images_are_copied_and_what_fails_is_made_anew(monkeypatch, rng):
    gpu, settings = Gpu(), binding.OidnSettings(device="cuda")
    monkeypatch.setattr(binding, "library", lambda: gpu)
    monkeypatch.setattr(binding, "_kernel", functools.lru_cache(4)(binding._Kernel))
    monkeypatch.setattr(binding, "_open_device", functools.cache(binding._open_device.__wrapped__))
    image = rng.random((5, 7, 3), np.float32)
    with pytest.raises(RuntimeError, match="Open Image Denoise: out of memory"):
        binding.denoise(image, settings=settings)
    gpu.full = False
    gpu.errors.clear()
    for light in (image, image[::-1]):
        np.testing.assert_array_equal(binding.denoise(light, settings=settings), 2 * light)


def test_it_removes_noise(library, rng):
    clean = np.full((*SIZE, 3), (2.0, 1.0, 0.5), np.float32)
    noisy = (clean * rng.exponential(size=clean.shape)).astype(np.float32)
    for settings in map(binding.OidnSettings, ("high", "balanced", "fast")):
        image = binding.denoise(noisy, np.full_like(clean, 0.5), np.zeros_like(clean), settings=settings)
        assert np.abs(image - clean).mean() < 0.15 * np.abs(noisy - clean).mean()


def test_a_program_can_batch_it(library, rng):
    denoiser = oidn(quality="fast", device="cpu")
    clips = [Clip(clip_of(rng)) for _ in range(2)]
    batch = jax.tree.map(lambda *each: np.stack(each), *clips)
    images = jax.jit(jax.vmap(lambda clip: jaxdn.denoise(denoiser, {}, clip)))(batch)
    for image, clip in zip(images, clips, strict=True):
        np.testing.assert_array_equal(image, jaxdn.denoise(denoiser, {}, clip))


@pytest.mark.parametrize(("guides", "auxiliary"), [*product(["both", "albedo", "none"], ["noisy"]), ("both", "clean")])
@pytest.mark.parametrize("hdr", [True, False])
def test_every_network_of_the_library_runs(library, guides, auxiliary, hdr, rng):
    frame = Frame(None, albedo=np.full((*SIZE, 3), 0.5, np.float32), normal=np.zeros((*SIZE, 3), np.float32))
    denoiser = oidn(quality="fast", guides=guides, auxiliary=auxiliary, hdr=hdr)
    assert denoiser.reads == set({"both": ("albedo", "normal"), "albedo": ("albedo",), "none": ()}[guides])
    light = 0.4 + 0.2 * rng.uniform(size=(*SIZE, 3)).astype(np.float32)
    image = stream(denoiser, {})(frame._replace(radiance=light))
    assert np.abs(image - 0.5).mean() < 0.7 * np.abs(light - 0.5).mean()


def test_prefiltered_guides_are_those_that_the_library_denoised(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)
    settings = binding.OidnSettings("fast", auxiliary="prefiltered", device="cpu")
    image = binding.denoise(frame.radiance, frame.albedo, frame.normal, settings=settings)
    filtered = [
        binding._kernel(*SIZE, settings, (name,))({name: getattr(frame, name)}) for name in ("albedo", "normal")
    ]
    assert filtered[0].std() < 0.3 * frame.albedo.std()
    np.testing.assert_array_equal(
        image, binding.denoise(frame.radiance, *filtered, settings=settings._replace(auxiliary="clean"))
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        binding.OidnSettings(device="cpu"),
        binding.OidnSettings(auxiliary="clean", device="cpu"),
        binding.OidnSettings(auxiliary="prefiltered", device="cpu"),
        binding.OidnSettings(auxiliary="prefiltered", guide_quality="fast", device="cpu"),
    ],
)
def test_a_pixel_sees_no_farther_than_the_settings_say(library, settings, rng):
    """Larger networks see farther, and prefiltered guides see twice: tiles overlap by that."""
    height, width, changed = 32, 640, 8
    images = [rng.uniform(0.1, 1.0, (height, width, 3)).astype(np.float32) for _ in range(3)]
    others = [image.copy() for image in images]
    for image in others:
        image[:, :changed] = 1.1 - image[:, :changed]
    first, second = (binding.denoise(*each, settings=settings, scale=0.5) for each in (images, others))
    differs = np.nonzero(np.any(first != second, axis=(0, 2)))[0]
    assert 64 < differs.max() - (changed - 1) <= settings.receptive_field


@pytest.mark.slow
def test_prefiltered_guides_take_hardly_more_memory(library):
    """The networks share what they compute in, and the larger ones take the image in parts."""
    code = """
import re, sys
import numpy as np
from jaxdn.ops import oidn
def peak():  # that of getrusage may be the parent's
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
height, width = 720, 1280
images = [np.full((height, width, 3), 0.5, np.float32)] * 3
before = peak()
for auxiliary in sys.argv[1:]:
    oidn.denoise(*images, settings=oidn.OidnSettings(auxiliary=auxiliary, guide_quality="fast", device="cpu"))
    print((peak() - before) / (height * width))
"""
    ended = subprocess.run(
        [sys.executable, "-c", code, "noisy", "prefiltered"], check=True, capture_output=True, text=True
    )
    plain, both = map(float, ended.stdout.split())
    assert 300 < plain < 900
    assert both < plain + 150


def test_missing_guides_are_neutral(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)._replace(albedo=None, normal=None)
    written = frame._replace(albedo=np.ones_like(frame.radiance), normal=np.zeros_like(frame.radiance))
    denoise = stream(oidn(quality="fast"), {})
    np.testing.assert_array_equal(denoise(frame), denoise(written))


def test_invalid_values_are_sanitized_and_counted(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)
    broken = frame.radiance.copy()
    broken[4, 5] = np.nan
    broken[7, 8] = np.inf
    denoise = stream(oidn(quality="fast"), {})
    image = denoise(frame._replace(radiance=broken))
    assert denoise.sanitized == 6
    np.testing.assert_array_equal(image, denoise(frame._replace(radiance=np.where(np.isfinite(broken), broken, 0))))


def test_light_may_have_any_unit(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)
    denoise = stream(oidn(quality="fast"), {})
    image = denoise(frame)
    for factor in (2.0**-16, 2.0**10):
        np.testing.assert_allclose(
            denoise(frame._replace(radiance=frame.radiance * factor)) / factor, image, rtol=1e-3, atol=1e-4
        )


def test_tiles_give_the_image_of_the_whole(library, rng):
    denoiser = oidn(quality="fast", device="cpu")
    side = 2 * (denoiser.receptive_field + 1 + GRID) + GRID
    size = (40, side + 3 * GRID + 5)
    frames = clip_of(rng, 1, size)
    frames.radiance[:, :, : size[1] // 2] *= 8  # tiles have other means than the whole
    tiled, whole = stream_tiled(denoiser, {}, side, size), stream(denoiser, {})
    np.testing.assert_allclose(tiled(frame_at(frames, 0)), whole(frame_at(frames, 0)), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_files_are_denoised_by_name(library, rng, tmp_path, capsys):
    """Demodulation and the safe blend are the command's: here the image is the denoiser's own."""
    frames = clip_of(rng)
    write_clip(Clip(frames), tmp_path / "noisy")
    main(["denoise", str(tmp_path / "noisy"), "-o", str(tmp_path / "out"), "--method", "oidn", "--no-safe"])
    assert "denoised by oidn" in capsys.readouterr().out
    stored = jaxdn.read_clip(tmp_path / "noisy")
    expected = jaxdn.denoise(oidn(), {}, stored)
    for index in range(2):
        layers = read_exr(tmp_path / "out" / f"frame_{index:04}.exr")
        image = np.stack([layers[f"denoised.{channel}"] for channel in "RGB"], axis=-1)
        np.testing.assert_allclose(image, expected[index], rtol=2e-3, atol=1e-3)


def test_wrappers_take_it(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)
    image = stream(demodulated(oidn(quality="fast"), by="albedo"), {})(frame)
    divided = stream(oidn(quality="fast"), {})(frame._replace(radiance=frame.radiance / frame.albedo))
    np.testing.assert_allclose(image, divided * frame.albedo, rtol=1e-5)


def test_a_gradient_is_refused(library, rng):
    frame = frame_at(clip_of(rng, 1), 0)
    denoiser = oidn(quality="fast")
    with pytest.raises(TypeError, match="expected no gradient to be asked for"):
        jax.grad(lambda light: denoiser.step({}, denoiser.start({}, frame), frame._replace(radiance=light))[1].sum())(
            jnp.asarray(frame.radiance)
        )
    assert not method_named("oidn").differentiable
    with pytest.raises(ValueError, match="oidn: expected a method that learns"):
        method_named("oidn").recipe_named(None)


@pytest.mark.parametrize("size", [None, SIZE])
def test_an_export_is_refused(library, size):
    with pytest.raises(NotPortableError, match="oidn: expected a method whose step is a program of its own"):
        exported_step(oidn(), {}, size=size)


def test_options_and_images_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="quality: expected one of 'high', 'balanced', 'fast', got 'best'"):
        oidn(quality="best")
    with pytest.raises(ValueError, match="guides: expected 'both' with auxiliary='clean'"):
        oidn(guides="none", auxiliary="clean")
    image = np.zeros((4, 5, 3), np.float32)
    with pytest.raises(ValueError, match=r"albedo: expected \(4, 5, 3\) as the colour, got \(5, 4, 3\)"):
        binding.denoise(image, image.transpose(1, 0, 2))


def test_without_the_package_it_says_what_to_install(monkeypatch, tmp_path, capsys, rng):
    write_clip(Clip(clip_of(rng)), tmp_path / "noisy")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pyoidn" else find_spec(name))
    monkeypatch.setitem(__import__("sys").modules, "pyoidn", None)
    assert "oidn" not in filter_names()
    with pytest.raises(ModuleNotFoundError, match="pip install pyoidn"):
        find_model("oidn")
    frame = frame_at(clip_of(rng, 1), 0)
    with pytest.raises(ModuleNotFoundError, match="pip install pyoidn"):
        stream(oidn(), {})(frame)
    with pytest.raises(SystemExit) as ended:
        main(["denoise", str(tmp_path / "noisy"), "-o", str(tmp_path / "out"), "--method", "oidn"])
    assert ended.value.code == 2
    assert "pip install pyoidn" in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*"))
