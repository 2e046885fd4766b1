"""What surfaces reflect, from EXR files of other renderers: real files, with the layers that each of them writes."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.brdf import directional_albedo
from jaxdn.clips import ClipError
from jaxdn.data.evidence import read_clip_properties

SIZE = (6, 8)
EYE = np.array([1.0, 2.0, 5.0])


def layer(name: str, image: np.ndarray, letters: str = "RGB") -> dict[str, np.ndarray]:
    return {f"{name}.{one}" if name else one: image[..., i] for i, one in enumerate(letters)}


def write(path: Path, *layers: dict[str, np.ndarray], **header: object) -> Path:
    channels = {name: np.ascontiguousarray(values, np.float32) for each in layers for name, values in each.items()}
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(about, channels).write(str(path))
    return path


def read(path: Path, **options: object) -> tuple[object, list[str]]:
    lines: list[str] = []
    _, frames = clips.plain_frames(path, log=lines.append, **options)
    return next(frames), lines


@pytest.fixture
def scene(rng: np.random.Generator) -> dict[str, np.ndarray]:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    place = np.stack([columns - 4, 3 - rows, -rows / 3], axis=-1)
    normal = np.array([0.1, 0.2, 1.0]) + 0.3 * rng.standard_normal((*SIZE, 3))
    return {
        "light": rng.exponential(1.0, (*SIZE, 3)),
        "diffuse": rng.uniform(0.0, 0.7, (*SIZE, 3)),
        "specular": rng.uniform(0.0, 0.6, (*SIZE, 3)),
        "roughness": rng.uniform(0.1, 0.9, (*SIZE, 1)),
        "place": place,
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
    }


PROGRAMS = {
    "Arnold": ("", "diffuse_albedo", "specular_albedo", "RGB"),
    "Blender 5.2": (
        "ViewLayer.Combined",
        "ViewLayer.Denoising Albedo",
        "ViewLayer.Denoising Specular Albedo",
        "RGB",
    ),
    "V-Ray for 3ds Max": ("", "VRayDiffuseFilter", "VRayReflectionFilter", "RGB"),
    "V-Ray for Maya": ("", "diffuseFilter", "reflectionFilter", "RGB"),
    "Falcor": ("color", "diffuseAlbedo", "specularAlbedo", "RGB"),
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_diffuse_and_specular_albedo_make_the_reflectance(tmp_path, scene, program):
    beauty, diffuse, specular, letters = PROGRAMS[program]
    layers = [layer(beauty, scene["light"]), layer(diffuse, scene["diffuse"], letters)]
    path = write(tmp_path / "a.exr", *layers, layer(specular, scene["specular"], letters))
    frame, lines = read(path)
    np.testing.assert_allclose(frame.albedo, scene["diffuse"], atol=1e-6)
    np.testing.assert_allclose(frame.specular_reflectance, scene["specular"], atol=1e-6)
    expected = np.minimum(scene["diffuse"] + scene["specular"], 1.0)
    assert np.any(expected == 1)
    np.testing.assert_allclose(frame.reflectance, expected, atol=1e-6)
    assert lines[-1] == f"derived: reflectance = {diffuse!r} + {specular!r}"
    assert read_clip_properties(path).surfaces[0].specular


def test_arnolds_total_is_not_added_to_its_part(tmp_path, scene):
    """Arnold's own "albedo" is the sum of all lobes; the diffuse part stands next to it."""
    total = layer("albedo", scene["diffuse"] + scene["specular"])
    both = [layer("", scene["light"]), total, layer("specular_albedo", scene["specular"])]
    frame, _ = read(write(tmp_path / "a.exr", *both, layer("diffuse_albedo", scene["diffuse"])))
    np.testing.assert_allclose(frame.albedo, scene["diffuse"], atol=1e-6)
    np.testing.assert_allclose(frame.reflectance, np.minimum(scene["diffuse"] + scene["specular"], 1), atol=1e-6)
    frame, lines = read(write(tmp_path / "b.exr", *both))
    assert frame.reflectance is None
    assert frame.specular_reflectance is None
    np.testing.assert_allclose(frame.albedo, np.minimum(scene["diffuse"] + scene["specular"], 1), atol=1e-6)
    (unused,) = [line for line in lines if "not used: 'specular_albedo'" in line]
    assert "--channels specular_reflectance=specular_albedo" in unused


def test_layers_that_are_named_are_taken_at_their_word(tmp_path, scene):
    layers = [layer("albedo", scene["diffuse"]), layer("specular_albedo", scene["specular"]), layer("", scene["light"])]
    path = write(tmp_path / "a.exr", *layers, {"roughness.R": scene["roughness"][..., 0]})
    frame, lines = read(path, channels={"specular_reflectance": "specular_albedo", "roughness": "none"})
    np.testing.assert_allclose(frame.reflectance, np.minimum(scene["diffuse"] + scene["specular"], 1), atol=1e-6)
    assert frame.roughness is None
    assert lines[-1] == "derived: reflectance = 'albedo' + 'specular_albedo'"


def test_an_albedo_alone_stays_what_it_is(tmp_path, scene):
    frame, lines = read(write(tmp_path / "a.exr", layer("", scene["light"]), layer("albedo", scene["diffuse"])))
    assert frame.reflectance is None
    assert lines == []


def world_to_camera(*, transposed: bool = False) -> np.ndarray:
    """A camera at EYE, turned about y; row vectors as OpenEXR has them."""
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = turn, -EYE @ turn
    return (matrix.T if transposed else matrix).astype(np.float32)


def of_f0(scene: dict[str, np.ndarray]) -> np.ndarray:
    """The lobe's directional albedo, computed from the scene."""
    view = EYE - scene["place"]
    cosine = np.sum(scene["normal"] * view, -1, keepdims=True) / np.linalg.norm(view, axis=-1, keepdims=True)
    given = (np.zeros((*SIZE, 3)), 0.2 * scene["specular"], scene["roughness"], np.maximum(cosine, 0))
    return np.asarray(directional_albedo(*(np.float32(each) for each in given)))


def f0_layers(scene: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    layers = [layer("", scene["light"]), layer("albedo", scene["diffuse"]), layer("F0", 0.2 * scene["specular"])]
    return [*layers, {"roughness.R": scene["roughness"][..., 0]}]


@pytest.mark.parametrize("transposed", [False, True])
def test_f0_with_world_positions_and_the_cameras_place(tmp_path, scene, transposed):
    layers = [*f0_layers(scene), layer("N", scene["normal"], "XYZ"), layer("P", scene["place"], "XYZ")]
    path = write(tmp_path / "a.exr", *layers, worldToCamera=world_to_camera(transposed=transposed))
    frame, lines = read(path)
    np.testing.assert_allclose(frame.specular_reflectance, of_f0(scene), atol=2e-5)
    np.testing.assert_allclose(frame.reflectance, np.minimum(scene["diffuse"] + of_f0(scene), 1), atol=2e-5)
    assert "GGX lobe of F0 'F0', roughness 'roughness' and 'N' and 'P' in world space" in lines[-1]


def test_f0_with_normals_and_positions_in_camera_space(tmp_path, scene):
    matrix = world_to_camera().astype(np.float64)
    place = scene["place"] @ matrix[:3, :3] + matrix[3, :3]
    normal = scene["normal"] @ matrix[:3, :3]
    normal[0, 0] = 0  # the ray left the scene
    color = 0.2 * scene["specular"]
    color[0, 1] = 0  # no lobe
    layers = [*f0_layers(scene), layer("F0", color), layer("Ncam", normal, "XYZ"), layer("Pcam", place, "XYZ")]
    frame, lines = read(write(tmp_path / "a.exr", *layers))
    expected = of_f0(scene).copy()
    expected[0, :2] = 0
    np.testing.assert_allclose(frame.specular_reflectance, expected, atol=2e-5)
    assert "in camera space" in lines[-1]


def test_what_is_missing_is_not_guessed(tmp_path, scene):
    normal, place = layer("N", scene["normal"], "XYZ"), layer("P", scene["place"], "XYZ")
    whole = [*f0_layers(scene), normal, place]
    cases = {
        "the header has no worldToCamera": whole,
        "no normals and positions of one space": whole[:-1],
        "depends on the roughness, which is not there": [each for each in whole if "roughness.R" not in each],
    }
    # Cycles' denoising normals are in camera space, its positions are not.
    cases["no normals and positions of one space to find"] = [
        *whole[:-2], layer("ViewLayer.Denoising Normal", scene["normal"], "XYZ"), place,
    ]  # fmt: skip
    for index, (reason, layers) in enumerate(cases.items()):
        frame, lines = read(write(tmp_path / f"{index}.exr", *layers))
        assert frame.reflectance is None
        assert frame.specular_reflectance is None
        assert lines[-1].startswith("not used: 'F0'")
        assert reason in lines[-1]
    broken = write(tmp_path / "broken.exr", *whole, worldToCamera=np.zeros((4, 4), np.float32))
    assert "no worldToCamera" in read(broken)[1][-1]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "roughness",
            45.0,
            r"a\.exr: roughness: expected values in \[0, 1\] in layer 'roughness', got .* to 45; .*none",
        ),
        ("roughness", -0.5, r"got -0\.5 to .*--channels roughness=none"),
        ("specular_albedo", 7.0, r"specular_reflectance: expected values in \[0, 1\].*--channels specular_reflectance"),
        ("F0", 3.0, r"F0: expected values in \[0, 1\] in layer 'F0', got .* to 3; rename it"),
    ],
)
def test_values_of_another_kind_are_refused(tmp_path, scene, name, value, message):
    given = {
        "roughness": scene["roughness"].copy(),
        "F0": 0.2 * scene["specular"],
        "specular_albedo": scene["specular"],
    }
    given[name][2:, :, 0] = value  # not one odd pixel, which is clamped
    layers = [layer("", scene["light"]), layer("diffuse_albedo", scene["diffuse"])]
    layers += [{"roughness.R": given["roughness"][..., 0]}]
    layers += [layer("specular_albedo", given["specular_albedo"])] if name == "specular_albedo" else []
    layers += [layer("F0", given["F0"]), layer("N", scene["normal"], "XYZ"), layer("P", scene["place"], "XYZ")]
    path = write(tmp_path / "a.exr", *layers, worldToCamera=world_to_camera())
    with pytest.raises(ClipError, match=message):
        read(path)


def test_overshoot_of_a_pixel_filter_and_broken_pixels_are_no_reason_to_refuse(tmp_path, scene):
    scene["roughness"][1, 1], scene["roughness"][2, 2], scene["roughness"][3, 3] = 1.04, -0.04, np.nan
    roughness = {"specular_roughness.R": scene["roughness"][..., 0]}
    frame, _ = read(write(tmp_path / "a.exr", layer("", scene["light"]), roughness))
    assert frame.roughness[1, 1] == 1
    assert frame.roughness[2, 2] == 0
    assert np.isnan(frame.roughness[3, 3])  # sanitized, and counted, by the step


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_the_command_prints_what_it_read_and_derived(tmp_path, scene):
    folder = tmp_path / "shots"
    folder.mkdir()
    for index in range(2):
        layers = [layer("", scene["light"]), layer("diffuse_albedo", scene["diffuse"])]
        write(folder / f"shot_{index:04d}.exr", *layers, layer("specular_albedo", scene["specular"]))
    command = [sys.executable, "-m", "jaxdn.commands.main", "denoise", str(folder), "-o", str(tmp_path / "out")]
    done = subprocess.run([*command, "--method", "svgf"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("derived: reflectance = 'diffuse_albedo' + 'specular_albedo'") == 1
    rows = [line.split() for line in done.stdout.splitlines()]
    assert ["albedo", "diffuse_albedo", "R,", "G,", "B", "share", "of", "light,", "0", "to", "1"] in rows
