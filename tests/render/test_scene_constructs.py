"""What scene files are made of: each construct loads, and all light together is what Mitsuba's own renderer finds."""

import json

import numpy as np
import pytest

from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from tests.needs import require_module
from tests.render.render_scenes import fast_variants

mi = require_module("mitsuba")

WIDTH, HEIGHT, DEPTH = 24, 16, 4

SENSOR = """<sensor type="perspective"><float name="fov" value="60"/>
  <transform name="to_world"><lookat origin="0, 1, 5" target="0, 1, 0" up="0, 1, 0"/></transform>{film}</sensor>"""
FILM = """<film type="hdrfilm"{id}><integer name="width" value="24"/><integer name="height" value="16"/>
  <string name="pixel_format" value="rgb"/><rfilter type="box"/>{crop}</film>"""
GREY = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf></bsdf>'
WALL = f'<shape type="rectangle"><transform name="to_world"><scale value="4"/></transform>{GREY}</shape>'
FLOOR = f"""<shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/>
  <rotate x="1" angle="-90"/><translate y="-0.5"/></transform>{GREY}</shape>"""
LAMP = """<emitter type="point"><point name="position" x="{x}" y="2" z="3"/>
  <rgb name="intensity" value="{power}"/></emitter>"""
THREE = ((-2, "9, 1, 1"), (0, "4"), (2, "1, 1, 9"))


def write(folder, body, *, film=None, before="", version="3.0.0", integrator=""):
    sensor = SENSOR.format(film=FILM.format(id="", crop="") if film is None else film)
    path = folder / "scene.xml"
    path.write_text(
        f'<scene version="{version}">{before}<integrator type="path"><integer name="max_depth" value="{DEPTH}"/>'
        f"{integrator}</integrator>{sensor}{WALL}{FLOOR}{body}</scene>"
    )
    return path


@pytest.fixture(autouse=True)
def fast():
    """The fastest variant here: what is loaded does not depend on it."""
    before = mi.variant()
    use_variant()
    yield
    if before:
        mi.set_variant(before)


def ours(scene, frame=0, samples=256):
    """Mean of emitted, direct and indirect light, as clips are made of."""
    from jaxdn.render.tracing.seeds import NOISY, SampleStream
    from jaxdn.render.tracing.tracer import choose_tracer

    accumulate = choose_tracer(mi.variant()).accumulate
    built = scene.build(frame, WIDTH, HEIGHT)
    sums = accumulate(built, SampleStream(1, frame, NOISY), 0, samples, max_depth=DEPTH)
    return np.mean([sums.emitted, sums.direct, sums.indirect], axis=(1, 2)).sum(axis=0) / samples


def mitsubas(path):
    """Mean of Mitsuba's own image of its own scene."""
    return np.array(mi.render(mi.load_file(str(path)), spp=256, seed=7), np.float64).mean(axis=(0, 1))


def box(name, x, inner=GREY):
    return (
        f'<shape type="cube" id="{name}"><transform name="to_world"><scale value="0.4"/><translate x="{x}" z="1"/>'
        f"</transform>{inner}</shape>"
    )


def instances(names=(' id="left"', ' id="right"')):
    group = f'<shape type="shapegroup" id="group"><shape type="cube">{GREY}</shape></shape>'
    places = ('<scale value="0.4"/><translate x="-1.2" z="1"/>', '<scale value="0.5"/><translate x="1.2" z="1"/>')
    return group + "".join(
        f'<shape type="instance"{name}><ref id="group"/><transform name="to_world">{place}</transform></shape>'
        for name, place in zip(names, places, strict=True)
    )


GLOW = '<emitter type="area" id="glow"><rgb name="radiance" value="9, 6, 3"/></emitter>'
BULB = """<shape type="sphere" id="bulb"><point name="center" x="0" y="2.5" z="2"/><float name="radius" value="0.3"/>
  {emitter}</shape>"""
CONSTRUCTS = {
    "lamps without ids": "".join(LAMP.format(x=x, power=power) for x, power in THREE),
    "a lamp called as another would be": LAMP.format(x=-2, power=9)
    + LAMP.format(x=2, power=5).replace('"point">', '"point" id="light_0">', 1)
    + LAMP.format(x=0, power=5),
    "an id inside a BSDF": LAMP.format(x=0, power=20)
    + box("a", -1, '<bsdf type="twosided" id="outer"><bsdf type="diffuse" id="inner"><rgb name="reflectance" '
          'value="0.8, 0.1, 0.1"/></bsdf></bsdf>')
    + box("b", 1, '<ref id="inner"/>'),
    "an alias": LAMP.format(x=0, power=20)
    + '<bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf><alias id="red" as="rouge"/>'
    + box("a", -1, '<ref id="rouge"/>'),
    "defaults in names of files": '<default name="part" value="box"/><default name="look" value="paint"/>'
    + LAMP.format(x=0, power=20)
    + '<include filename="parts/$part.xml"/>'
    + box("a", -1, '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" '
          'value="$look.exr"/></texture></bsdf>'),
    "includes in includes": LAMP.format(x=0, power=20) + '<include filename="parts/all.xml"/>',
    "two instances of one group": LAMP.format(x=0, power=20) + instances(),
    "instances without ids": LAMP.format(x=0, power=20) + instances(("", "")),
    "an emitter beside its shape": GLOW + BULB.format(emitter='<ref id="glow"/>'),
    "a lamp with a texture": BULB.format(
        emitter='<emitter type="area"><texture type="bitmap" name="radiance">'
        '<string name="filename" value="paint.exr"/><boolean name="raw" value="true"/></texture></emitter>'
    ),
    "dots in ids": LAMP.format(x=0, power=20) + box("a.b", -1) + box("a_b", 1),
    "spectra": '<emitter type="constant"><spectrum name="radiance" value="400:1, 700:2"/></emitter>' + box("a", 0),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "parts" / "deep").mkdir(parents=True)
    (tmp_path / "parts" / "box.xml").write_text(f'<scene version="3.0.0">{box("included", 1)}</scene>')
    (tmp_path / "parts" / "all.xml").write_text('<scene version="3.0.0"><include filename="deep/more.xml"/></scene>')
    (tmp_path / "parts" / "deep" / "more.xml").write_text(f'<scene version="3.0.0">{box("deep", 1)}</scene>')
    paint = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    mi.Bitmap(paint).write(str(tmp_path / "paint.exr"))
    return tmp_path


@pytest.mark.parametrize("name", CONSTRUCTS)
def test_a_construct_gives_the_light_that_mitsuba_finds(name, folder):
    path = write(folder, CONSTRUCTS[name])
    np.testing.assert_allclose(ours(SceneFile(path)), mitsubas(path), rtol=0.03)


def test_a_film_beside_its_sensor(folder):
    path = write(folder, LAMP.format(x=0, power=20), before=FILM.format(id=' id="f"', crop=""), film='<ref id="f"/>')
    np.testing.assert_allclose(ours(SceneFile(path)), mitsubas(path), rtol=0.03)


def test_every_shape_and_light_has_a_name_of_its_own(folder):
    scene = SceneFile(write(folder, CONSTRUCTS["dots in ids"] + CONSTRUCTS["a lamp called as another would be"]))
    built = scene.build(0, WIDTH, HEIGHT)
    assert sorted(shape.id() for shape in built.shapes()) == ["a_b", "a_b_", "floor", "shape_0"]
    assert len(built.emitters()) == 4
    assert sorted(scene.lights()) == sorted(emitter.id() for emitter in built.emitters())


def animate(path, **animation):
    path.with_suffix(".json").write_text(json.dumps({"frames": 3, **animation}))
    return SceneFile(path)


def test_one_of_two_instances_moves(folder):
    path = write(folder, CONSTRUCTS["two instances of one group"])
    keys = [{"frame": 0}, {"frame": 2, "translation": [0, 2, 0]}]
    scene = animate(path, shapes={"left": {"keys": keys}})
    np.testing.assert_allclose(ours(scene), mitsubas(path), rtol=0.03)
    moved = {shape.id(): shape.bbox() for shape in scene.build(2, WIDTH, HEIGHT).shapes()}
    np.testing.assert_allclose(np.array(moved["left"].min).ravel(), [-1.6, 1.6, 0.6], atol=1e-5)
    np.testing.assert_allclose(np.array(moved["right"].min).ravel(), [0.7, -0.5, 0.5], atol=1e-5)
    text = path.read_text()
    path.write_text(text.replace('<translate x="-1.2" z="1"/>', '<translate x="-1.2" y="2" z="1"/>'))
    np.testing.assert_allclose(ours(scene, 2), mitsubas(path), rtol=0.03)


LIGHTS = {
    "by the name of its shape": ("an emitter beside its shape", "bulb", [0.5, 2, 1]),
    "by its own name": ("an emitter beside its shape", "glow", [0.5, 2, 1]),
    "a texture": ("a lamp with a texture", "bulb", 3),
    "a lamp without an id": ("lamps without ids", "light_1", [3, 1, 0]),
    "a spectrum": ("spectra", "light_0", 3),
}


@pytest.mark.parametrize("case", LIGHTS)
def test_a_light_is_scaled(case, folder):
    construct, light, scale = LIGHTS[case]
    path = write(folder, CONSTRUCTS[construct])
    keys = {light: [{"frame": 0, "scale": 1}, {"frame": 2, "scale": scale}]}
    scene = animate(path, lights=keys)
    before, after = ours(scene), ours(scene, 2)
    np.testing.assert_allclose(before, mitsubas(path), rtol=0.03)
    if construct == "lamps without ids":  # the others stay as they are
        others = mitsubas(write(folder, "".join(LAMP.format(x=x, power=power) for x, power in THREE[::2])))
        np.testing.assert_allclose(after, others + (before - others) * scale, rtol=0.05)
    else:
        np.testing.assert_allclose(after, before * scale, rtol=0.03)
    np.testing.assert_allclose(ours(scene), before, rtol=1e-6)  # the frame before is not changed by it


def test_what_cannot_be_scaled_is_said(folder):
    mi.set_variant("scalar_rgb")
    body = '<spectrum type="blackbody" name="radiance"><float name="temperature" value="4000"/></spectrum>'
    path = write(folder, BULB.format(emitter=f'<emitter type="area">{body}</emitter>'))
    scene = animate(path, lights={"bulb": [{"frame": 0, "scale": 2}]})
    with pytest.raises(ValueError, match="the brightness of 'bulb' is no number that can be scaled"):
        scene.build(0, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="no light 'sun'; it has bulb"):
        animate(folder / "scene.xml", lights={"sun": [{"frame": 0, "scale": 2}]})
    with pytest.raises(ValueError, match="'bulb' is not given in red, green and blue"):
        animate(write(folder, CONSTRUCTS["a lamp with a texture"]), lights={"bulb": [{"frame": 0, "scale": [1, 2, 1]}]})


@pytest.mark.slow
def test_a_crop_and_hidden_lights_are_not_ignored_in_silence(folder):
    crop = '<integer name="crop_width" value="12"/>'
    path = write(folder, LAMP.format(x=0, power=20), film=FILM.format(id="", crop=crop))
    with pytest.warns(UserWarning, match=r"scene\.xml: its film shows a crop of 12x16 pixels; the whole image"):
        SceneFile(path)
    hidden = '<boolean name="hide_emitters" value="true"/>'
    path = write(folder, '<emitter type="constant"/>', integrator=hidden)
    with pytest.warns(UserWarning, match="its integrator hides lights"):
        scene = SceneFile(path)
    from jaxdn.render.frame import render_frame

    found = render_frame(scene, 0, RenderSettings(width=WIDTH, height=HEIGHT, reference_spp=256, max_depth=DEPTH))
    kept = (found.reference + found.frame.direct).mean(axis=(0, 1))
    np.testing.assert_allclose(kept, mitsubas(path), rtol=0.03)  # without the emission, as the warning says


@pytest.mark.slow
def test_a_scene_that_begins_in_the_dark_keeps_its_light(folder):
    from jaxdn.render.path_depth import measure_depth

    # All light of the later frames is indirect: the lamp stands under a lid and shines on the wall.
    path = write(folder, BULB.format(emitter=GLOW) + box("lid", 0))
    dark = {"bulb": [{"frame": 0, "scale": 0}, {"frame": 1, "scale": 0}, {"frame": 2, "scale": 1}]}
    lit = measure_depth(SceneFile(path))
    found = measure_depth(animate(path, lights=dark), frames=3)
    assert lit.max_depth > 3
    assert (found.max_depth, found.frame) == (lit.max_depth, 2)
    assert measure_depth(animate(path, lights=dark), frames=2).max_depth == 3  # nothing is lit there
    flash = {"bulb": [{"frame": at, "scale": scale} for at, scale in ((0, 0), (3, 0), (4, 1), (5, 0))]}
    assert measure_depth(animate(path, lights=flash), frames=20).frame == 4


GLASS = """<shape type="sphere" id="glass"><point name="center" x="{x}" y="1" z="1.5"/>
  <float name="radius" value="0.8"/><bsdf type="{bsdf}"/>
  <medium type="homogeneous" name="interior"><rgb name="albedo" value="0"/>
  <rgb name="sigma_t" value="0.05, 0.3, 1"/><float name="scale" value="3"/></medium>
</shape>"""


def volpath(path, samples):
    """Mitsuba's image with its integrator for media."""
    integrator = mi.load_dict({"type": "volpath", "max_depth": DEPTH, "rr_depth": 1000})
    return np.array(mi.render(mi.load_file(str(path)), integrator=integrator, spp=samples, seed=7)).mean(axis=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("bsdf", ["dielectric", "roughdielectric"])
@pytest.mark.parametrize("variant", fast_variants())
def test_glass_that_absorbs_has_the_light_of_mitsubas_integrator_for_media(variant, bsdf, folder):
    mi.set_variant(variant)
    bulb = BULB.format(emitter=GLOW)
    inside = (
        '<shape type="sphere"><point name="center" x="-1" y="1" z="1.5"/><float name="radius" value="0.4"/></shape>'
    )
    path = write(folder, bulb + GLASS.format(x=-1, bsdf=bsdf) + inside)
    # The scalar variant draws whether light is absorbed, and needs more samples.
    found = ours(SceneFile(path), samples=2048)
    np.testing.assert_allclose(found, volpath(path, 8192), rtol=0.03)
    clear = path.read_text().replace("0.05, 0.3, 1", "0")
    path.write_text(clear)
    assert np.all(ours(SceneFile(path)) > 1.02 * found)


def test_fog_without_filtered_pixels_is_refused_by_the_name_of_what_bounds_it(folder):
    from jaxdn.render.buffers.gbuffer import check_scene

    fog = GLASS.format(x=0, bsdf="dielectric").replace('name="albedo" value="0"', 'name="albedo" value="0.5"')
    scene = SceneFile(write(folder, LAMP.format(x=0, power=20) + fog))
    with pytest.raises(ValueError, match=r"fog \('glass' has it\) needs filtered pixels"):
        check_scene(scene.build(0, WIDTH, HEIGHT))
    check_scene(scene.build(0, WIDTH, HEIGHT), filtered=True)


def test_media_on_both_sides_of_a_shape_are_seen(folder):
    from jaxdn.effects import inspect
    from jaxdn.render.buffers.gbuffer import check_scene
    from jaxdn.render.tracing.volume_path_tracer import scatters

    smoke = GLASS.format(x=0, bsdf="null").replace('name="albedo" value="0"', 'name="albedo" value="0.5"')
    around = """<medium type="homogeneous" name="exterior"><rgb name="albedo" value="0"/>
      <rgb name="sigma_t" value="0.1"/></medium></shape>"""
    scene = SceneFile(write(folder, LAMP.format(x=0, power=20) + smoke.replace("</shape>", around)))
    built = scene.build(0, WIDTH, HEIGHT)
    assert scatters(built)
    with pytest.raises(ValueError, match=r"fog \('glass' has it\)"):
        check_scene(built)
    assert "media" in inspect(scene, width=WIDTH, height=HEIGHT)


@pytest.mark.slow
def test_a_medium_around_the_camera_is_kept(folder):
    medium = """<medium type="homogeneous" id="air"><rgb name="albedo" value="{albedo}"/>
      <rgb name="sigma_t" value="0.05, 0.1, 0.2"/></medium>"""
    film = FILM.format(id="", crop="") + '<ref id="air"/>'
    path = write(folder, BULB.format(emitter=GLOW), before=medium.format(albedo=0), film=film)
    np.testing.assert_allclose(ours(SceneFile(path)), volpath(path, 256), rtol=0.03)
