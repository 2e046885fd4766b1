"""Any unit and range of light: what denoisers cannot take is set aside and comes back. Arrays and real files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from jaxdn import clips, color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.metrics import psnr
from jaxdn.sequence.light_range import (
    BRIGHTEST,
    DRIFT,
    LEVEL,
    bound_light,
    choose_exponent,
    find_lamps,
    measure_octaves,
    restore_light,
)
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.data.test_kept import box_blur
from tests.sequence.test_safe import picture
from tests.sharing import share_model

SIZE = (48, 64)
LAMP_PIXELS = np.s_[2:7, 52:57]


def grey(rng: np.random.Generator, level: float = LEVEL, samples: float = 4) -> np.ndarray:
    noise = rng.gamma(samples, 1 / samples, (*SIZE, 1))
    return np.repeat(level * noise, 3, axis=-1).astype(np.float32)


def write(folder: Path, scale: float, *, samples: int | None = 4, dtype: type = np.float32, lamp: float = 0) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(0)
    for frame in range(3):
        light = picture(frame)
        if samples is not None:
            light = light * rng.gamma(samples, 1 / samples, (*SIZE, 1))
        albedo = np.full(SIZE, 0.5, np.float32)
        albedo[LAMP_PIXELS] = 1
        if lamp:
            light[LAMP_PIXELS] = lamp
        planes = np.moveaxis((scale * light).astype(dtype), -1, 0)
        guides = {f"albedo.{letter}": albedo for letter in "RGB"}
        clips.write_exr(folder / f"a.{frame:04d}.exr", dict(zip("RGB", planes, strict=True)) | guides)
    return folder


def denoise(source: Path, *, method: str = "svgf", **settings: bool) -> tuple[list[np.ndarray], list[str]]:
    told: list[str] = []
    out = source.with_name(f"{source.name}-out{len(list(source.parent.iterdir()))}")
    files = denoise_files([source], out, share_model(method), Settings(**settings), log=told.append).files
    return [np.stack([clips.read_exr(file)[letter] for letter in "RGB"], axis=-1) for file in files], told


def decibels(image: np.ndarray, frame: int) -> float:
    return float(psnr(color.tonemap(image), color.tonemap(picture(frame))))


@pytest.mark.slow
@pytest.mark.parametrize("bidirectional", [False, True])
def test_results_scale_with_their_input(tmp_path: Path, bidirectional: bool) -> None:
    """By powers of two exactly, by others nearly; float32 files."""
    usual, _ = denoise(write(tmp_path / "usual", 1.0), bidirectional=bidirectional)
    for name, scale in (("small", 2.0**-30), ("large", 2.0**40), ("1e-9", 1e-9), ("1e12", 1e12)):
        images, _ = denoise(write(tmp_path / name, scale), bidirectional=bidirectional)
        for frame, (image, wanted) in enumerate(zip(images, usual, strict=True)):
            if name in ("small", "large"):
                np.testing.assert_allclose(image, scale * wanted, rtol=1e-6)
            assert abs(decibels(image / np.float32(scale), frame) - decibels(wanted, frame)) < 0.2


@pytest.mark.parametrize("safe", [True, False])
@pytest.mark.parametrize("method", ["oidn", "steady-balanced"])
def test_a_lamp_comes_back_and_its_brightness_does_not_matter(tmp_path: Path, method: str, safe: bool) -> None:
    """Beside the sun the rest of a frame is nearly as good as beside a bulb."""
    rest = np.ones(SIZE, bool)
    rest[LAMP_PIXELS] = False

    def measure(lamp: float) -> list[float]:
        images, _ = denoise(write(tmp_path / f"{lamp:g}", 1.0, lamp=lamp), method=method, safe=safe)
        for frame, image in enumerate(images):
            np.testing.assert_allclose(image[LAMP_PIXELS], lamp, rtol=1e-6)
            image[~rest] = picture(frame)[~rest]
        return [decibels(image, frame) for frame, image in enumerate(images)]

    bulb = measure(12.0)
    for bright in (3000.0, 2e6):
        assert all(other > one - 1.0 for one, other in zip(bulb, measure(bright), strict=True))


def test_a_lamp_lights_no_pixel_beside_it(tmp_path: Path) -> None:
    """Denoisers spread what a lamp has: of 3000, a twentieth of the bound made a ring of several times the light."""
    lamp = np.zeros(SIZE, bool)
    lamp[LAMP_PIXELS] = True
    ring = binary_dilation(lamp, np.ones((3, 3))) & ~lamp
    images, _ = denoise(write(tmp_path / "in", 1.0, lamp=3000.0), method="oidn")
    for frame, image in enumerate(images):
        wanted = picture(frame)[ring].mean()
        assert image[ring].mean() < 1.5 * wanted
        assert np.all(image[ring] < 3.5 * wanted)


def test_what_is_bright_beside_a_lamp_stays(rng: np.random.Generator) -> None:
    """A denoiser that changes nothing changes nothing there: a lit shade, a pixel between two lamps."""
    light = grey(rng)
    light[LAMP_PIXELS] = 100
    light[1, 50:60] = 1.2
    light[-9:, -5:], light[-9:, -3] = 50, 0.3
    lamps = find_lamps(light, 0)
    bounded = np.asarray(bound_light(StoredFrame(Frame(light)), 0, lamps).frame.radiance)
    np.testing.assert_allclose(restore_light(bounded, light, 0, lamps), light, rtol=1e-5)
    between = bounded.copy()
    between[-6, -3] = 2.0
    assert restore_light(between, light, 0, lamps)[-6, -3, 0] == 2.0


def test_the_pixels_beside_a_lamp_do_not_show_their_own_noise(rng: np.random.Generator) -> None:
    """A denoiser that gave them a tenth too much: what is taken back does not differ by what each pixel drew."""
    wall = np.full((48, 64, 3), 0.5, np.float32)
    wall[12:36, 20:40] = 9.0
    wall[11:37, [19, 40]] = wall[[11, 36], 19:41] = 0.6
    ring = wall[..., 0] == np.float32(0.6)
    noisy = np.where(wall == 9.0, wall, wall * rng.gamma(16, 1 / 16, (48, 64, 1))).astype(np.float32)
    lamps = find_lamps(noisy, 0)
    np.testing.assert_array_equal(lamps[..., 0], wall[..., 0] == 9.0)
    image = restore_light(np.where(ring[..., None], 1.1 * wall, wall), noisy, 0, lamps)[ring][:, 0]
    assert image.std() < 0.25 * noisy[ring][:, 0].std()
    assert abs(image.mean() - 0.6) < 0.1


def test_a_bright_floor_with_little_noise_is_no_lamp(tmp_path: Path, rng: np.random.Generator) -> None:
    """Where half of a frame is a dim sky, a lit floor is as far above the median as a lamp is elsewhere."""
    (tmp_path / "in").mkdir()
    light = np.full((3, *SIZE), 0.05, np.float32)
    floor = np.s_[SIZE[0] // 3 :]
    light[:, floor] = rng.gamma(1100, 1 / 1100, light[:, floor].shape)  # noise of 3 %
    for number, image in enumerate(light):
        assert find_lamps(np.repeat(image[..., None], 3, axis=-1), 2).mean() < 0.01
        clips.write_exr(tmp_path / "in" / f"a.{number:04d}.exr", dict.fromkeys("RGB", image))
    images, _ = denoise(tmp_path / "in", safe=False)
    inner = np.s_[SIZE[0] // 3 + 20 :, :, 0]
    assert np.mean(images[-1][inner] != light[-1][inner[:2]]) > 0.98
    assert images[-1][inner].std() < 0.5 * light[-1][inner[:2]].std()


def test_half_files_are_clamped_when_they_are_written(tmp_path: Path) -> None:
    """A denoised frame, and one that comes back."""
    images, _ = denoise(write(tmp_path / "half", 40000.0, dtype=np.float16))
    assert images[0].dtype == np.float16
    assert np.isfinite(images[0]).all()
    images, _ = denoise(write(tmp_path / "lamp", 1.0, samples=None, dtype=np.float16, lamp=RADIANCE_MAX))
    assert images[0].max() == RADIANCE_MAX


def test_negative_light_comes_back(tmp_path: Path) -> None:
    """Without noise exactly, noisy with less noise than it had."""
    turn = np.linalg.inv([[0.6131, 0.3395, 0.0474], [0.0702, 0.9164, 0.0134], [0.0206, 0.1096, 0.8698]])

    def wide(frame: int) -> np.ndarray:
        return (picture(frame) * [0.05, 0.9, 0.1]) @ turn.T

    rng = np.random.default_rng(0)
    for name, samples in (("clean", None), ("noisy", 4)):
        (tmp_path / name).mkdir()
        for frame in range(3):
            noise = 1 if samples is None else rng.gamma(samples, 1 / samples, (*SIZE, 1))
            light = (wide(frame) * noise).astype(np.float32)
            assert light.min() < -0.01
            clips.write_exr(
                tmp_path / name / f"a.{frame:04d}.exr", dict(zip("RGB", np.moveaxis(light, -1, 0), strict=True))
            )
    for image, frame in zip(denoise(tmp_path / "clean")[0], range(3), strict=True):
        np.testing.assert_allclose(image, wide(frame), rtol=1e-5, atol=1e-7)
    for safe in (True, False):
        image, wanted = denoise(tmp_path / "noisy", safe=safe)[0][-1], wide(2)
        noisy = clips.read_exr(tmp_path / "noisy" / "a.0002.exr")["R"]
        assert np.mean((image[..., 0] - wanted[..., 0]) ** 2) < 0.4 * np.mean((noisy - wanted[..., 0]) ** 2)
        assert abs(image[..., 0].mean() / wanted[..., 0].mean() - 1) < 0.1


def test_the_ringing_of_a_pixel_filter_is_no_share_of_what_a_denoiser_draws_over_it() -> None:
    """Beside an edge there is nearly no positive light of which the negative could be a share."""
    light = np.zeros((1, 9, 3), np.float32)
    light[0, :3], light[0, 3:6], light[0, 6:] = 1.0, -0.02, 1e-5
    blurred = np.maximum(light, 0)
    blurred[0, 3:8] = 0.02
    image = restore_light(blurred, light, 0, np.zeros((1, 9, 1), bool))
    assert image.min() >= -0.05


def test_the_factor_follows_the_median_and_stays(rng: np.random.Generator) -> None:
    dark = grey(rng, 1e-6)
    assert choose_exponent(np.zeros_like(dark), None) is None
    assert choose_exponent(np.full_like(dark, np.nan), 3) == 3
    exponent = choose_exponent(dark, None)
    assert exponent == round(np.log2(LEVEL / 1e-6))
    dark[LAMP_PIXELS] = 1e6
    assert choose_exponent(dark, None) == exponent
    assert choose_exponent(dark * 2.0 ** (DRIFT - 1), exponent) == exponent
    assert choose_exponent(dark * 2.0 ** (DRIFT + 1), exponent) == exponent - DRIFT - 1


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (31, 9), (32, 40), (33, 17), (75, 100)])
def test_the_median_is_that_of_blocks_of_any_size(size: tuple[int, int], rng: np.random.Generator) -> None:
    """Blocks at the border are smaller; black ones, and what is no light, tell nothing."""
    light = rng.gamma(0.3, 1, (*size, 3)).astype(np.float32)
    light[::5], light[3::7] = np.nan, -1
    light[:8, :8] *= 0 if size != (1, 1) and size != (8, 8) else 1
    usable = np.where(np.isfinite(light) & (light > 0), light, 0).astype(np.float64) @ np.asarray(color.LUMINANCE)
    rows, columns = (range(0, side, 8) for side in size)
    means = np.array([usable[y : y + 8, x : x + 8].mean() for y in rows for x in columns])
    lit = means[means > 0]
    expected = np.log2(LEVEL) - np.median(np.log2(lit)) if lit.size else None
    assert measure_octaves(light) == (None if expected is None else pytest.approx(expected, abs=1e-12))


def test_light_that_drifts_begins_the_history_anew_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for frame in range(4):
        light = np.full(SIZE, 1e-3 if frame < 2 else 1e3, np.float32)
        clips.write_exr(tmp_path / "in" / f"a.{frame:04d}.exr", dict.fromkeys("RGB", light))
    images, told = denoise(tmp_path / "in", method="taa", safe=False)
    for image, light in zip(images, (1e-3, 1e-3, 1e3, 1e3), strict=True):
        np.testing.assert_allclose(image, light, rtol=1e-5)
    assert sum("the light changes by more than a factor of 256" in line for line in told) == 1


def test_what_was_bounded_is_restored(rng: np.random.Generator) -> None:
    light = grey(rng)
    light[LAMP_PIXELS] = [3e6, 2e6, 1e6]
    light[30, 10] = 5e6  # a firefly
    light[10:20, 10:20] *= 1e7  # noisy, beyond the limit
    light[40, 40] = [-0.02, 0.3, 0.1]
    light[45, 5] = np.nan
    lamps = find_lamps(light, 0)
    assert lamps[LAMP_PIXELS].all()
    assert lamps.sum() <= 25 + 3
    bounded = np.asarray(bound_light(StoredFrame(Frame(light)), 0, lamps).frame.radiance)
    assert np.isnan(bounded[45, 5]).all()
    known = np.isfinite(bounded)
    assert bounded[known].min() >= 0
    assert bounded[known].max() <= RADIANCE_MAX
    np.testing.assert_allclose(bounded[LAMP_PIXELS] @ color.LUMINANCE, BRIGHTEST, rtol=1e-5)
    image = restore_light(np.nan_to_num(bounded), light, 0, lamps)
    np.testing.assert_allclose(image[LAMP_PIXELS], light[LAMP_PIXELS], rtol=1e-6)
    np.testing.assert_allclose(image[30, 10], RADIANCE_MAX)
    assert np.median(image[10:20, 10:20] / light[10:20, 10:20]) > 0.9
    ordinary = np.ones(SIZE, bool)
    ordinary[LAMP_PIXELS] = ordinary[10:20, 10:20] = ordinary[30, 10] = ordinary[45, 5] = False
    ordinary[39:42, 39:42] = False
    np.testing.assert_array_equal(image[ordinary], light[ordinary])
    assert -0.02 < image[40, 40, 0] < 0


def test_ordinary_frames_are_not_copied(rng: np.random.Generator) -> None:
    stored = StoredFrame(Frame(grey(rng)))
    assert bound_light(stored, 0, find_lamps(np.asarray(stored.frame.radiance), 0)) is stored


def test_lamps_are_those_of_the_definition(rng: np.random.Generator) -> None:
    """Pixel by pixel, at the borders too, with values that are no numbers and in any unit."""
    light = grey(rng, level=6 * LEVEL, samples=0.5)
    light[LAMP_PIXELS] = [30, 20, 10]
    light[0, :3] = light[:2, -1] = 9.0
    light[20:24, 20:24] = 7.0
    light[21, 21, 0], light[22, 23, 1], light[30, 30] = np.nan, np.inf, -np.inf
    luminance = np.full((SIZE[0] + 2, SIZE[1] + 2), 0.0, np.float32)
    luminance[1:-1, 1:-1] = light @ np.asarray(color.LUMINANCE, np.float32)
    steady, bright = np.zeros(luminance.shape, bool), np.zeros(luminance.shape, bool)
    for y, x in np.ndindex(*SIZE):
        own, around = luminance[y + 1, x + 1], luminance[y : y + 3, x : x + 3]
        bright[y + 1, x + 1] = np.isfinite(own) and own > 8 * LEVEL
        steady[y + 1, x + 1] = bright[y + 1, x + 1] and (np.abs(around - own) <= np.float32(0.001) * own).sum() > 3
    expected = np.zeros((*SIZE, 1), bool)
    for y, x in np.ndindex(*SIZE):
        expected[y, x] = bright[y + 1, x + 1] and steady[y : y + 3, x : x + 3].any()
    assert expected.sum() > 40
    np.testing.assert_array_equal(find_lamps(light, 0), expected)
    np.testing.assert_array_equal(find_lamps(np.ldexp(light, -9), 9), expected)


def test_a_lamp_s_pixel_without_a_number_is_no_lamp_s(tmp_path: Path) -> None:
    """It is denoised: with 0 in place of the missing colour it would be a coloured dot."""
    source = write(tmp_path / "in", 1.0, lamp=50.0)
    for path in source.iterdir():
        channels = clips.read_exr(path)
        channels["R"][4, 54] = np.nan
        clips.write_exr(path, channels)
    for safe in (True, False):
        images, _ = denoise(source, safe=safe)
        for image in images:
            assert image[4, 54, 0] > 0.5 * image[4, 54, 1]
            np.testing.assert_array_equal(image[3, 53], np.float32(50))


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_numbers_that_are_none_warn_nobody(value: float, tmp_path: Path) -> None:
    """In any channel, beside lamps, with everything that can be asked for."""
    source = write(tmp_path / "in", 1.0, lamp=50.0)
    for path in source.iterdir():
        channels = clips.read_exr(path)
        channels |= {"A": np.full(SIZE, 0.5, np.float32)}
        channels |= {f"{part}.{letter}": 0.5 * channels[letter] for part in ("diffuse", "specular") for letter in "RGB"}
        for place, (name, pixels) in enumerate(channels.items()):
            pixels[10 + place, 10:13] = value
            pixels[4, 54] = value if name == "G" else pixels[4, 54]
        channels |= {"normal.X": channels["A"], "normal.Y": channels["R"], "normal.Z": channels["B"]}
        channels |= {"depth.Z": channels["A"] + 1, "Vector.X": channels["A"], "Vector.Y": channels["R"]}
        clips.write_exr(path, channels)
    settings = Settings(
        naming=ChannelNaming("previous-current"), alpha=True, aovs="additive", preview=True, bidirectional=True
    )
    files = denoise_files([source], tmp_path / "out", box_blur(), settings).files
    assert len(files) == 3
