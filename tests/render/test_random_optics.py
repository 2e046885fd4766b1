"""Random optics of training clips: what is drawn, how blurred it is, and that a record builds it again."""

from pathlib import Path

import numpy as np
import pytest

from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.open_scene import open_family, scene_from_record
from jaxdn.render.scenes.optics import read_optics
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import ClipSource, plan_jobs
from tests.render.render_scenes import Stage

FRAMES, SEEDS = 3, range(4)


@pytest.mark.slow
def test_the_same_seed_draws_the_same_and_records_build_it_again():
    use_variant()
    from jaxdn.render.camera_paths.random_optics import randomise_optics

    found = [randomise_optics(open_family("edge", 1), seed, FRAMES) for seed in SEEDS]
    assert found[3].record == randomise_optics(open_family("edge", 1), SEEDS[3], FRAMES).record
    for scene in found:
        again = scene_from_record(scene.record)
        assert again.record == scene.record
        assert again.camera(1)[1:] == scene.camera(1)[1:]
        assert read_optics(scene.record, "record") == again.optics  # type: ignore[attr-defined]


def test_blur_and_fog_are_what_the_ranges_say():
    use_variant()
    from jaxdn.render.camera_paths.random_optics import _BLUR, _LEFT, draw_for_depths

    depth = np.random.default_rng(0).uniform(1.0, 9.0, 2000)
    drawn = [draw_for_depths(depth, 50.0, seed) for seed in range(400)]
    lenses = [optics.lens for optics in drawn if optics.lens is not None]
    fogs = [optics.fog for optics in drawn if optics.fog is not None]
    shutters = [optics.shutter for optics in drawn if optics.shutter]
    for found, chance in ((lenses, 0.4), (shutters, 0.4), (fogs, 0.2)):
        assert abs(len(found) / 400 - chance) < 4.5 * np.sqrt(chance * (1 - chance) / 400)
    for lens in lenses:
        # In image widths: the aperture's diameter, seen from the point, projected to the film.
        slope = np.tan(np.radians(25.0))
        blur = 2 * lens.aperture_radius * np.abs(1 / lens.focus_distance - 1 / depth) / (2 * slope)
        assert np.quantile(blur, 0.9) < _BLUR[1] * 1.001
        assert depth.min() <= lens.focus_distance <= depth.max()
    for fog in fogs:
        left = np.exp(-fog.density * np.median(depth))
        assert _LEFT[0] - 1e-3 < left < _LEFT[1] + 1e-3
        assert all(0.5 <= share <= 0.98 for share in fog.albedo)
    assert all(0.2 <= shutter <= 1 for shutter in shutters)


@pytest.mark.slow
def test_jobs_have_the_optics_of_their_seeds(tmp_path: Path):
    settings = RenderSettings(width=16, height=12, pixel_filter="box", max_depth=3)
    source = ClipSource("edge", seeds=SEEDS, frames=FRAMES, effects="all", random_optics=True)
    jobs = plan_jobs(source, tmp_path, settings)
    from jaxdn.render.camera_paths.random_optics import draw_optics

    for job in jobs:
        scene = open_family("edge", job.settings.seed)
        assert job.scene == scene.record | draw_optics(scene, job.settings.seed, FRAMES).record()
    assert any("lens" in job.scene for job in jobs)
    with pytest.raises(ValueError, match="random optics: expected filtered pixels"):
        plan_jobs(source, tmp_path, RenderSettings(width=16, height=12))
    with pytest.raises(ValueError, match=r"random optics of 'room.xml': expected a family, or --tour"):
        plan_jobs(source._replace(scene="room.xml"), tmp_path, settings)


def test_other_scenes_have_no_random_optics():
    use_variant()
    from jaxdn.render.camera_paths.random_optics import randomise_optics

    with pytest.raises(ValueError, match="expected a family or a scene file, got 'stage'"):
        randomise_optics(Stage(), 0, 2)
