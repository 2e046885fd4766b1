"""Guides of what flat mirrors and glass show: those of a scene where the mirrored things really stand there."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn import Clip, effects
from jaxdn.clips import ClipError
from jaxdn.effects import plan
from jaxdn.planning.catalogue import OF_PRIMARY_SURFACES
from jaxdn.render.clip import render_clip
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from jaxdn.render.worker_pool import render_clips
from jaxdn.sequence.render_and_denoise import SceneSettings, denoise_scene
from jaxdn.sequence.render_jobs import ClipSource, plan_jobs
from jaxdn.zoo.ready import find_model
from tests.render.render_scenes import HEIGHT, SQUARE_Z, WIDTH, Stage, grey, shift, turn

SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
FAST = choose_variant().variant
pytestmark = pytest.mark.needs("llvm")

MIRROR_Z = 2.0
FACE = np.diag([-1.0, 1.0, -1.0, 1.0])
"""A rectangle faces +z; turned, it faces the camera."""
GUIDES = ("normal", "depth", "roughness", "motion", "previous_depth", "visible")


def mirrored_at(z: float) -> np.ndarray:
    """The reflection at the plane of this z."""
    matrix = np.diag([1.0, 1.0, -1.0, 1.0])
    matrix[2, 3] = 2 * z
    return matrix


class Mirrored(Stage):
    """A mirror across the view and a square behind the camera; ``real``: its image in its place, before a grey wall.

    The floor and the lamp are seen in the mirror too, and have no copies: only the square's pixels are compared.
    """

    def __init__(self, *, real: bool, mirror: Any, square: Any, **options: Any) -> None:
        def place(frame: float) -> np.ndarray:
            return self._mirror(frame) @ square(frame) if real else square(frame)

        self._mirror = lambda frame: mirrored_at(mirror(frame))
        super().__init__(square=place, wall=False, **options)
        self._real, self._z = real, mirror

    def pose(self, frame: float) -> dict[str, np.ndarray]:
        return {**super().pose(frame), "mirror": shift(0, 0, self._z(frame))}

    def build(self, frame: float, width: int, height: int) -> Any:
        import mitsuba as mi

        place = mi.ScalarTransform4f
        bsdf = {"type": "conductor", "material": "none"} if not self._real else grey(0.1)
        at = shift(0, 0, self._z(frame) if not self._real else 30.0) @ FACE @ np.diag([90.0, 90.0, 1.0, 1.0])
        self._shapes = {"mirror": {"type": "rectangle", "to_world": place(at), "bsdf": bsdf}}
        return super().build(frame, width, height)


MOVES = {
    "nothing": ({}, lambda frame: MIRROR_Z, lambda frame: shift(0.2, 0.1, -1.0) @ turn(10)),
    "the thing": ({}, lambda frame: MIRROR_Z, lambda frame: shift(0.2 * frame, 0.1, -1.0) @ turn(10 * frame)),
    "the mirror": ({}, lambda frame: MIRROR_Z + 0.3 * frame, lambda frame: shift(0.2, 0.1, -1.0)),
    "the camera": (
        {"camera": lambda frame: shift(0.1 * frame, 0.05, 0) @ turn(3.0 * frame)},
        lambda frame: MIRROR_Z,
        lambda frame: shift(0.2, 0.1, -1.0),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", MOVES)
def test_a_mirror_shows_what_would_stand_behind_it(what):
    options, mirror, square = MOVES[what]
    image, real = (
        render_frame(
            Mirrored(real=real, mirror=mirror, square=square, **options),
            2,
            RenderSettings(see_through=not real, variant=FAST, max_depth=2, **SIZE),
        )
        for real in (False, True)
    )
    assert image.view is not None
    assert real.view is not None
    on_square = real.view.gbuffer.ids[..., 0] == real.view.gbuffer.names.index("square")
    assert on_square.sum() > 8
    assert image.view.gbuffer.replaced is not None
    shown = np.zeros(WIDTH * HEIGHT, bool)
    seen = image.view.gbuffer.replaced
    shown[seen.pixels] = seen.shapes == image.view.gbuffer.names.index("square")
    np.testing.assert_array_equal(shown.reshape(HEIGHT, WIDTH), on_square)
    for name in GUIDES:
        found, wanted = (np.asarray(getattr(one.frame, name))[on_square] for one in (image, real))
        np.testing.assert_allclose(found, wanted, atol=2e-4, err_msg=name)
    np.testing.assert_allclose(np.asarray(image.frame.albedo)[on_square], 0.5, atol=1e-3)
    np.testing.assert_allclose(np.asarray(image.frame.reflectance)[on_square], 0.5, atol=1e-3)
    moved = np.abs(np.asarray(image.frame.motion)[on_square]).max()
    assert moved == 0 if what == "nothing" else moved > 0.1


def behind_glass(kind: str, **options: Any) -> Stage:
    """The stage behind a pane: thin, or a slab of two surfaces."""
    import mitsuba as mi

    place = mi.ScalarTransform4f
    if kind == "thin":
        pane = {"type": "rectangle", "to_world": place(shift(0, 0, 1.5) @ FACE), "bsdf": {"type": "thindielectric"}}
    else:
        slab = shift(0, 0, 1.5) @ np.diag([1.0, 1.0, 0.01, 1.0])
        pane = {"type": "cube", "to_world": place(slab), "bsdf": {"type": "dielectric", "int_ior": 1.5}}
    return Stage(shapes={"pane": pane}, **options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["thin", "slab"])
def test_glass_shows_what_is_behind_it_less_what_it_reflects(kind):
    def move(frame: float) -> np.ndarray:
        return shift(0.3 * frame, 0, SQUARE_Z)

    seen = render_frame(
        behind_glass(kind, square=move), 2, RenderSettings(see_through=True, variant=FAST, max_depth=2, **SIZE)
    )
    without = render_frame(Stage(square=move), 2, RenderSettings(variant=FAST, max_depth=2, **SIZE)).frame
    assert seen.view is not None
    assert seen.view.gbuffer.replaced is not None
    through = np.zeros((HEIGHT, WIDTH), bool)
    through.reshape(-1)[seen.view.gbuffer.replaced.pixels] = True
    assert 0.2 < through.mean() < 0.8
    # Refraction shifts the view by a fraction of the slab's thickness: borders of the square may be another pixel's.
    same = through & (np.abs(np.asarray(seen.frame.depth) - np.asarray(without.depth))[..., 0] < 0.02)
    assert same.sum() > 0.95 * through.sum()
    for name, tolerance in (("normal", 1e-5), ("depth", 0.01), ("motion", 0.02), ("roughness", 1e-6)):
        found, wanted = (np.asarray(getattr(one, name))[same] for one in (seen.frame, without))
        np.testing.assert_allclose(found, wanted, atol=tolerance, err_msg=name)
    # Fresnel at a right angle: 4 % are reflected by each surface, and what goes back and forth in a thin pane passes.
    share = {"thin": 1 - 2 * 0.04 / 1.04, "slab": 0.96**2}[kind]
    middle = (HEIGHT // 2, WIDTH // 2)
    np.testing.assert_allclose(np.asarray(seen.frame.reflectance)[middle], share * 0.5, rtol=0.01)
    assert np.all(np.asarray(seen.frame.reflectance)[through] <= np.asarray(without.reflectance)[through] + 1e-6)
    names = seen.view.gbuffer.names
    images = seen.view.gbuffer.replaced
    pairs = {(names[first], names[shape]) for first, shape in zip(images.first, images.shapes, strict=True)}
    assert {("pane", "square"), ("pane", "wall")} <= pairs <= {("pane", name) for name in names}
    ids = np.asarray(seen.frame.ids)[..., 0]
    assert len(np.unique(ids[through])) == len(pairs)
    assert not set(np.unique(ids[through])) & set(np.unique(ids[~through]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        {"type": "sphere", "radius": 1.0, "bsdf": {"type": "conductor"}},
        {"type": "sphere", "radius": 1.0, "bsdf": {"type": "dielectric"}},
        {"type": "sphere", "radius": 1.0, "bsdf": {"type": "roughconductor", "alpha": 0.1}},
        {"type": "sphere", "radius": 1.0, "bsdf": {"type": "plastic"}},
    ],
    ids=["curved mirror", "glass ball", "rough metal", "plastic"],
)
def test_what_shows_no_image_in_its_place_keeps_its_own_guides(shape):
    stage = Stage(shapes={"ball": {**shape, "center": [0, 0, 2.5]}})
    plain, through = (
        render_frame(stage, 1, RenderSettings(see_through=on, variant=FAST, max_depth=2, **SIZE)).frame
        for on in (False, True)
    )
    ball = np.asarray(plain.ids)[..., 0] == 0
    assert ball.sum() > 20
    for name in ("albedo", "normal", "depth", "motion", "ids", "reflectance"):
        # One ray may go straight through the middle of the ball, where glass is a pane.
        different = np.any(np.asarray(getattr(plain, name)) != np.asarray(getattr(through, name)), axis=-1)
        assert different.sum() <= 4, name


def test_a_scene_without_mirrors_and_glass_is_the_same():
    stage = Stage(square=lambda frame: shift(0.2 * frame, 0, SQUARE_Z))
    plain, through = (
        render_frame(stage, 1, RenderSettings(see_through=on, variant=FAST, **SIZE)).frame for on in (False, True)
    )
    for name, buffer in plain._asdict().items():
        if buffer is not None and name not in OF_PRIMARY_SURFACES:
            np.testing.assert_array_equal(buffer, getattr(through, name), err_msg=name)


def test_light_is_not_changed():
    stage = behind_glass("slab")
    plain, through = (
        render_frame(stage, 1, RenderSettings(see_through=on, variant=FAST, reference_spp=2, **SIZE))
        for on in (False, True)
    )
    np.testing.assert_array_equal(plain.frame.radiance, through.frame.radiance)
    np.testing.assert_array_equal(plain.reference, through.reference)
    np.testing.assert_array_equal(plain.frame.direct, through.frame.direct)


def test_plans_leave_out_what_belongs_to_the_first_surface_and_follow_what_moves_in_mirrors():
    names = ["indirect", "mirror", "specular", "moving-reflection", "glossy"]
    reader = jaxdn.denoisers.trmv()
    found = effects.choose_effects(names, 3)
    plain, through = plan(found, reader), plan(found, reader, see_through=True)
    assert set(plain.buffers) - set(through.buffers) == {"glossy_motion", "specular", "specular_reflectance"}
    assert set(through.buffers) - set(plain.buffers) == {"motion", "dual_motion", "previous_depth"}
    with pytest.raises(ValueError, match="made to see through; pass see_through=True"):
        render_frame(Stage(), 0, RenderSettings(see_through=True, plan=plain, variant=FAST, **SIZE))


def test_the_scalar_variant_is_refused():
    with pytest.raises(ValueError, match="scalar_rgb cannot follow rays past mirrors and glass; leave it out"):
        render_frame(Stage(), 0, RenderSettings(see_through=True, variant="scalar_rgb", **SIZE))


@pytest.mark.slow
def test_a_clip_keeps_to_its_setting_and_the_command_says_what_is_left_out(tmp_path, capsys):
    settings, through = (RenderSettings(max_depth=3, see_through=on, **SIZE) for on in (False, True))
    source = ClipSource("fruit", frames=2, effects="all", denoiser="svgf")
    (job,) = plan_jobs(source._replace(denoiser="trmv"), tmp_path, through)
    assert "seen through, there is no" in capsys.readouterr().out
    (folder,) = render_clips([job], workers=1)
    (other,) = plan_jobs(source, tmp_path, settings)
    (same,) = plan_jobs(source, tmp_path, through)
    assert [one.settings.see_through for one in (job, other, same)] == [True, False, True]
    with pytest.raises(ClipError, match="see_through: True there, False wanted"):
        render_clip(Stage(), folder, RenderSettings(variant=FAST, **SIZE), frames=2)


CHECKS = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective"><float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="0, 1, 3" target="0, 1, 0" up="0, 1, 0"/></transform></sensor>
  <shape type="rectangle" id="mirror"><bsdf type="conductor"/>
    <transform name="to_world"><scale value="2"/><translate y="1"/></transform></shape>
  <shape type="rectangle" id="checks">
    <bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
      <rgb name="color0" value="0.1"/><rgb name="color1" value="0.8"/>
      <transform name="to_uv"><scale value="8"/></transform></texture></bsdf>
    <transform name="to_world"><scale value="4"/><rotate y="1" angle="180"/><translate y="1" z="5"/></transform></shape>
  <emitter type="constant"><rgb name="radiance" value="0.8"/></emitter>
</scene>"""


@pytest.mark.slow
def test_what_a_mirror_shows_stays_sharp(tmp_path):
    """The picture of a checked wall in a mirror: svgf blurs it with the mirror's guides, and keeps it with its own."""
    (tmp_path / "checks.xml").write_text(CHECKS)
    scene, svgf, error = SceneFile(tmp_path / "checks.xml"), jaxdn.denoisers.svgf(), {}
    for on in (False, True):
        found = render_frame(
            scene,
            0,
            RenderSettings(width=48, height=48, reference_spp=256, light="reflected", see_through=on, variant=FAST),
        )
        clip = Clip(jax.tree.map(lambda buffer: jnp.asarray(buffer)[None], found.frame))
        image = np.asarray(jaxdn.denoise(svgf, {}, clip)[0])
        error[on] = float(np.mean((image - found.reference) ** 2))
    assert error[True] < 0.1 * error[False]


@pytest.mark.slow
def test_a_scene_is_denoised_with_the_guides_of_what_is_seen(tmp_path):
    (tmp_path / "checks.xml").write_text(CHECKS)
    told: dict[str, list[str]] = {"svgf": [], "trmv": []}
    (tmp_path / "svgf").mkdir()
    half = tmp_path / "svgf" / ".frame_0000.exr.elsewhere.7.1.tmp"  # of a killed run
    half.write_text("half")
    os.utime(half, (0, 0))
    for name, lines in told.items():
        settings = SceneSettings(RenderSettings(width=16, height=16), frames=[0], budget=1)
        denoise_scene(str(tmp_path / "checks.xml"), None, tmp_path / name, find_model(name), settings, log=lines.append)
    line = "guides of flat mirrors and glass are those of what they show"
    assert line in told["svgf"]
    assert line not in told["trmv"], "trmv follows reflections by the mirror's own guides"
    assert [path.name for path in (tmp_path / "svgf").iterdir()] == ["frame_0000.exr"]
