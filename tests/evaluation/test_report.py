"""The report: numbers that strict JSON parsers read, and a page that works in a real browser without a network."""

import io
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxdn.evaluation.report import ClipResult, Results, Scores, TrainingCurve, mean_scores, save_png, write_report
from jaxdn.evaluation.report import film as films
from jaxdn.evaluation.report import images as pictures
from jaxdn.evaluation.report import page as page_module
from jaxdn.evaluation.report.summary import headline, sentences, show, text_table

METHODS = ["noisy", "svgf", "ntd A", "ntd B", "ntd C"]
QUALITY = {"noisy": 0.22, "svgf": 0.055, "ntd A": 0.034, "ntd B": 0.03, "ntd C": 0.026}
GHOST = {"noisy": 0.0, "svgf": 0.28, "ntd A": 0.3, "ntd B": 0.16, "ntd C": 0.07}
MS = {"noisy": math.nan, "svgf": 14.2, "ntd A": 31.5, "ntd B": 31.4, "ntd C": 31.7}


def room(height, width, shift):
    """A lit corner with a shelf and a moving ball: display values, and the crescent the ball has just uncovered."""
    y, x = np.mgrid[:height, :width].astype(float) / height
    light = 0.32 + 0.3 * np.exp(-((x - 0.35) ** 2 + (y - 0.2) ** 2) / 0.35)
    image = light[..., None] * np.where((y > 0.72)[..., None], (0.85, 0.72, 0.55), (0.95, 0.8, 0.78))
    image[(np.abs(y - 0.45) < 0.02) & (x > 0.7)] *= 0.45
    image *= (1.0 + 0.05 * np.sign(np.sin(40 * x) * np.sin(40 * y)))[..., None]

    def ball(offset):
        return (x - 0.4 - offset) ** 2 + (y - 0.6) ** 2 < 0.03

    here = ball(shift)
    shade = np.clip(1.1 - 2.5 * np.hypot(x - 0.34 - shift, y - 0.53), 0.2, 1.0)
    image[here] = (shade[..., None] * np.asarray((0.85, 0.3, 0.16)))[here]
    return np.clip(image, 0, 1), ball(shift - 0.06) & ~here


def synthetic(clips=2, frames=12, height=32, width=48, methods=METHODS, training=True, disocclusion=True, seed=0):
    """Results as an evaluation would make them: scores computed from the pictures, curves that wander."""
    rng = np.random.default_rng(seed)
    results = []
    for number in range(clips):
        reference, mask = room(height, width, 0.1 + 0.5 * number / max(clips, 1))
        if not disocclusion:
            mask = np.zeros_like(mask)
        images, scores, per_frame = {"reference": reference}, {}, {}
        for method in methods:
            noise = QUALITY.get(method, 0.05) * rng.normal(size=reference.shape)
            if method != "noisy":
                noise = 0.5 * noise + 0.5 * np.repeat(np.repeat(noise[::4, ::4], 4, 0), 4, 1)[:height, :width]
            ghost = GHOST.get(method, 0.1) * (np.asarray((0.8, 0.2, 0.1)) - reference) * mask[..., None]
            image = np.clip(reference + noise + ghost, 0, 1)
            images[method] = image
            error = np.abs(image - reference)
            mse = float(np.mean(error**2))
            inside = error[mask].mean() if mask.any() else math.nan
            inside_psnr = -10 * math.log10(np.mean(error[mask] ** 2)) if mask.any() else math.nan
            psnr = -10 * math.log10(mse)
            spp = 1.0
            scores[method] = Scores(
                psnr,
                1 - 3 * mse**0.5,
                error.mean(),
                mse,
                psnr + 2,
                1.4 * error.mean(),
                inside,
                inside_psnr,
                MS.get(method, 9),
                spp,
            )
            wander = np.cumsum(rng.normal(size=frames)) * 0.12
            fade = np.exp(-np.arange(frames) / 6) * (0 if method == "noisy" else 2.5)
            per_frame[method] = {
                "psnr": list(psnr + wander - fade),
                "l1": list(error.mean() * 10 ** (-(wander - fade) / 20)),
                "disoccluded_l1": [inside if index % 5 else math.nan for index in range(frames)],
            }
        name = ["fruit, held out", "robot", "pinkroom", "mobile"][number % 4] + f" {number}"
        results.append(ClipResult(name, 37.5 + number % 3, scores, per_frame, frames // 2, images, mask))
    steps = list(range(0, 400, 2))
    curves = {
        method: TrainingCurve(
            steps,
            [0.05 + 0.3 * math.exp(-s / 80) + 0.01 * rng.random() for s in steps],
            steps[::20],
            [27 - 8 * math.exp(-s / 90) for s in steps[::20]],
        )
        for method in methods
        if method.startswith("ntd") and training
    }
    return Results(
        "ntd on procedural rooms",
        {"size": "SMALL", "steps": 400, "clip": {"width": width, "height": height, "frames": frames}, "seed": 0},
        {"cpu": "2 cores", "versions": {"jax": "0.10.2", "python": "3.11.7"}, "mitsuba variant": "scalar_rgb"},
        list(methods),
        results,
        curves,
    )


def strict(text):
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


# ---- numbers -------------------------------------------------------------------------------------


def test_metrics_hold_every_number_and_no_picture(tmp_path):
    results = synthetic()
    assert write_report(results, tmp_path / "new" / "run") == tmp_path / "new" / "run" / "report.html"
    text = (tmp_path / "new" / "run" / "metrics.json").read_text()
    numbers = strict(text)
    assert set(numbers) == {
        "format", "title", "methods", "about", "noise_floor_psnr", "mean", "clips", "training", "settings", "machine",
    }  # fmt: skip
    assert numbers["methods"] == METHODS
    assert list(numbers["mean"]) == METHODS
    for clip, saved in zip(results.clips, numbers["clips"], strict=True):
        assert saved["name"] == clip.name
        assert saved["noise_floor_psnr"] == clip.noise_floor_psnr
        assert saved["disoccluded_pixels"] == int(clip.disoccluded.sum()) > 0
        for method in METHODS:
            for field, value in clip.scores[method]._asdict().items():
                assert saved["scores"][method][field] == (None if math.isnan(value) else value)
            assert saved["per_frame"][method]["psnr"] == clip.per_frame[method]["psnr"]
    assert numbers["settings"]["clip"]["width"] == 48
    assert len(numbers["training"]["ntd C"]["loss"]) == 200
    assert "data:image" not in text
    assert len(text) < 100_000


def test_non_finite_numbers_and_foreign_types_stay_strict_json(tmp_path):
    results = synthetic(clips=1)
    clip = results.clips[0]
    broken = clip.scores["ntd A"]._replace(psnr=math.inf, mse=-math.inf, l1=math.nan, ssim=np.float32(0.5))
    clip = clip._replace(
        scores=clip.scores | {"ntd A": broken},
        per_frame={"svgf": {"psnr": np.asarray([1.0, math.nan, math.inf])}},
        noise_floor_psnr=math.nan,
    )
    settings = {"path": Path("a/b"), "sizes": (1, 2), "count": np.int64(3), "flag": True, "none": None, 5: {"z", "y"}}
    write_report(results._replace(clips=[clip], settings=settings), tmp_path)
    numbers = strict((tmp_path / "metrics.json").read_text())
    scores = numbers["clips"][0]["scores"]["ntd A"]
    assert (scores["psnr"], scores["mse"], scores["l1"], scores["ssim"]) == ("inf", "-inf", None, 0.5)
    assert numbers["clips"][0]["per_frame"]["svgf"]["psnr"] == [1.0, None, "inf"]
    assert numbers["noise_floor_psnr"] is None
    assert numbers["settings"] == {
        "path": "a/b", "sizes": [1, 2], "count": 3, "flag": True, "none": None, "5": ["y", "z"],
    }  # fmt: skip


def test_means_leave_out_clips_with_nothing_to_measure_but_never_hide_a_failure():
    results = synthetic(clips=3)
    first, second, third = results.clips
    nothing = {method: scores._replace(disoccluded_l1=math.nan) for method, scores in second.scores.items()}
    failed = third.scores | {"svgf": third.scores["svgf"]._replace(psnr=math.nan)}
    results = results._replace(clips=[first, second._replace(scores=nothing), third._replace(scores=failed)])
    means = mean_scores(results)
    wanted = (first.scores["ntd C"].disoccluded_l1 + third.scores["ntd C"].disoccluded_l1) / 2
    assert means["ntd C"].disoccluded_l1 == pytest.approx(wanted)
    assert math.isnan(means["svgf"].psnr)
    assert math.isnan(means["noisy"].ms_per_frame)
    assert means["ntd C"].psnr == pytest.approx(np.mean([clip.scores["ntd C"].psnr for clip in results.clips]))
    assert "Without a PSNR on at least one clip: svgf." in sentences(results)


def with_films(results, frames=12):
    """The same results with films: the noise moves, and in frame t the reference has a white column at x = t."""
    clips, rng = [], np.random.default_rng(1)
    for clip in results.clips:
        reference = np.repeat(np.asarray(clip.images["reference"])[None], frames, 0)
        for index in range(frames):
            reference[index, :, index * 4 % reference.shape[2]] = 1.0
        noisy = {name: reference + QUALITY.get(name, 0.1) * rng.normal(size=reference.shape) for name in clip.scores}
        made = {name: films.film(np.clip(image, 0, 1), reference) for name, image in noisy.items()}
        clips.append(clip._replace(films={**made, "reference": films.film(reference, None)}))
    return results._replace(clips=clips)


def scored(**rows):
    """Results of one clip with given scores: method -> (psnr, disoccluded l1, disoccluded psnr)."""
    results = synthetic(clips=1, methods=list(rows), training=False)
    blank = Scores(*[math.nan] * 10)
    scores = {
        method: blank._replace(psnr=a, disoccluded_l1=b, disoccluded_psnr=c) for method, (a, b, c) in rows.items()
    }
    return results._replace(clips=[results.clips[0]._replace(scores=scores, noise_floor_psnr=40.0)])


def test_headline_compares_c_with_the_a_of_its_size():
    rows = {"noisy": (15, 0.3, 12), "svgf": (24, 0.1, 20), "A LARGE": (29, 0.06, 25), "A": (28.0, 0.08, 24)}
    rows |= {"C LARGE": (31.5, 0.045, 27), "C": (30.0, 0.06, 26.5)}
    top = headline(scored(**rows))
    assert (top.best, top.svgf, top.traditional, top.occlusion) == ("C LARGE", "svgf", "A LARGE", "C LARGE")
    assert top.gain_over_svgf == pytest.approx(7.5)
    assert top.disoccluded_less == pytest.approx(0.25)
    said = " ".join(sentences(scored(**rows)))
    assert "31.50 dB on the clip" in said
    assert "7.50 dB more than svgf" in said
    assert "25% lower" in said
    assert "+2.00 dB" in said
    assert "40.00 dB" in said
    assert "of that floor" not in said


def test_headline_reports_a_loss_and_a_near_noise_floor():
    said = " ".join(sentences(scored(svgf=(39, 0.1, 20), A=(38, 0.05, 25), C=(37, 0.06, 24))))
    assert "svgf has the highest PSNR" in said
    assert "more than svgf" not in said
    assert "20% higher" in said
    assert "−1.00 dB" in said
    assert "within 3 dB of that floor" in said


def test_headline_survives_missing_methods_and_scores():
    nan = math.nan
    assert headline(scored(only=(20, nan, nan))).traditional is None
    assert "cannot be compared" in " ".join(sentences(scored(A=(20, nan, nan), C=(21, nan, nan))))
    assert "No method has a PSNR" in sentences(scored(x=(nan, nan, nan), y=(nan, nan, nan)))[0]
    both = headline(scored(svgf=(math.inf, 0.0, math.inf), A=(math.inf, 0.0, math.inf), C=(1, 0.0, math.inf)))
    assert math.isnan(both.gain_over_svgf)
    assert math.isnan(both.disoccluded_less)


def test_text_table_has_every_method_and_the_floor_in_aligned_columns():
    lines = text_table(synthetic()).splitlines()
    assert [line.split("  ")[0] for line in lines] == ["method", *METHODS, "noise floor"]
    assert "38.00" in lines[-1]
    assert max(map(len, lines)) == len(lines[1])


@pytest.mark.parametrize(
    ("value", "field", "text"),
    [
        (31.456, "psnr", "31.46"),
        (-1.5, "disoccluded_psnr", "−1.50"),
        (math.nan, "l1", "–"),
        (math.inf, "psnr", "∞"),
        (0.00087, "mse", "8.70e−4"),
        (0.00174, "mse", "0.00174"),
        (0.0, "mse", "0.0000"),
        (0.0123, "l1", "0.0123"),
        (7.86, "ms_per_frame", "7.86"),
        (31.5, "ms_per_frame", "31.5"),
        (1.0, "spp", "1"),
    ],
)
def test_scores_are_written_with_sensible_figures(value, field, text):
    assert show(value, field) == text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r._replace(clips=[]), "at least one clip"),
        (lambda r: r._replace(methods=["noisy", "reference"]), "different labels"),
        (lambda r: r._replace(methods=[*METHODS, "taa"]), "score every method"),
        (lambda r: r._replace(clips=[r.clips[0]._replace(images={})]), "add the reference"),
        (lambda r: r._replace(clips=[r.clips[0]._replace(disoccluded=np.zeros((2, 2), bool))]), "disoccluded"),
        (lambda r: r._replace(clips=[r.clips[0]._replace(per_frame={"other": {}})]), "labels out of"),
        (lambda r: r._replace(training={"x": TrainingCurve([1], [], [], [])}), "one value for each step"),
    ],
)
def test_inconsistent_results_are_refused_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        write_report(change(synthetic(clips=1)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


# ---- pictures ------------------------------------------------------------------------------------


def test_save_png_rounds_clamps_and_paints_broken_pixels(tmp_path):
    image = np.asarray([[[0.0, 0.5, 1.0], [-1.0, 2.0, 0.2], [math.nan, 0.0, 0.0]]], np.float32)
    save_png(tmp_path / "a.png", image)
    saved = np.asarray(Image.open(tmp_path / "a.png"))
    assert saved.tolist() == [[[0, 128, 255], [0, 255, 51], [255, 0, 255]]]
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    with pytest.raises(ValueError, match="expected"):
        save_png(tmp_path / "b.png", np.zeros((2, 2, 4)))


def test_error_map_and_its_scale():
    error = pictures.error_map(np.full((2, 2, 3), (0.1, 0.2, 0.6)), np.zeros((2, 2, 3)))
    np.testing.assert_allclose(error, 0.3)
    broken = pictures.error_map(np.full((1, 1, 3), math.inf), np.zeros((1, 1, 3)))
    assert np.isnan(broken).all()
    assert pictures.error_scale([broken, np.full((2, 2), 0.02)]) == pytest.approx(0.02)
    assert pictures.error_scale([broken]) == pytest.approx(1e-3)
    assert pictures.encode_error(broken, 0.5) == pictures.encode_error(np.ones((1, 1)), 0.5)
    assert pictures.worst_crop([broken], np.zeros((1, 1), bool)) == (0, 0, 1, 1)
    for top, scale in ((0.3, 0.5), (0.2, 0.2), (0.011, 0.02), (0.0, 1e-3), (7.0, 1.0)):
        assert pictures.error_scale([np.full((4, 4), top)]) == pytest.approx(scale)
    colors = np.asarray(
        Image.open(io.BytesIO(pictures.encode_error(np.asarray([[0.0, 0.5, 9.0]]), 0.5))).convert("RGB")
    )
    assert colors[0, 0].tolist() == list(pictures.ERROR_COLORS[0])
    assert colors[0, 1].tolist() == colors[0, 2].tolist() == list(pictures.ERROR_COLORS[-1])


def test_the_crop_lies_on_the_worst_disocclusion_and_inside_the_image():
    error = np.full((60, 100), 0.1)
    mask = np.zeros((60, 100), bool)
    mask[50:58, 90:98] = True
    error[10:20, 10:20] = 1.0  # worse, but not disoccluded
    x, y, width, height = pictures.worst_crop([error], mask)
    assert x <= 90
    assert x + width >= 98
    assert y <= 50
    assert y + height >= 58
    assert x + width <= 100
    assert y + height <= 60
    x, y, width, height = pictures.worst_crop([error], np.zeros_like(mask))
    assert x <= 10
    assert x + width >= 20
    assert y <= 10
    assert y + height >= 20
    mask[5, 70] = True
    x, y, width, height = pictures.worst_crop([np.where(mask, 0.0, error)], mask)
    assert mask[y : y + height, x : x + width].any()
    assert pictures.worst_crop([np.ones((1, 1))], np.ones((1, 1), bool)) == (0, 0, 1, 1)


# ---- the page ------------------------------------------------------------------------------------


class Outline(HTMLParser):
    """Tags in order, and whether all that were opened are closed."""

    VOID = frozenset(("meta", "img", "br", "input", "link"))

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes = [], [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open[-1:] == [tag]
        self.open.pop()


def outline(text):
    parser = Outline()
    parser.feed(text)
    assert not parser.open
    return parser


HOSTILE = "</script><script>alert(1)</script>\"'&<b>"


def test_the_page_is_one_closed_document_that_fetches_nothing(tmp_path):
    text = write_report(synthetic(), tmp_path).read_text()
    parsed = outline(text)
    assert not {"link", "iframe", "object", "embed", "base"} & set(parsed.tags)
    fetched = [value for name, value in parsed.attributes if name in ("src", "srcset", "action")]
    assert all(value.startswith("data:image/webp;base64,") for value in fetched)  # the stills for pages without script
    assert len(fetched) == 2 * 3
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest", text)
    # The only address in the page names a vocabulary, not a place to ask.
    assert set(re.findall(r"https?://[^\s\"']+", text)) == {"http://www.w3.org/2000/svg"}
    assert "default-src 'none'" in text


def test_all_input_is_escaped(tmp_path):
    plain = outline(write_report(synthetic(clips=1), tmp_path).read_text())
    results = synthetic(clips=1)
    clip = results.clips[0]
    rename = {method: HOSTILE + method for method in METHODS}
    clip = clip._replace(
        name=HOSTILE,
        scores={rename[key]: value for key, value in clip.scores.items()},
        per_frame={rename[key]: {HOSTILE: value["psnr"]} for key, value in clip.per_frame.items()},
        images={rename.get(key, key): value for key, value in clip.images.items()},
    )
    hostile = Results(
        HOSTILE, {HOSTILE: HOSTILE}, {HOSTILE: [HOSTILE]}, list(rename.values()), [clip],
        {HOSTILE + key: value for key, value in results.training.items()},
    )  # fmt: skip
    text = write_report(hostile, tmp_path).read_text()
    parsed = outline(text)
    assert parsed.tags.count("script") == plain.tags.count("script")
    assert "b" in plain.tags
    assert "<script>alert" not in text
    assert parsed.tags.count("b") == plain.tags.count("b")


def test_thirty_clips_of_full_size_stay_below_the_limit_and_never_lose_numbers(tmp_path, monkeypatch):
    small = synthetic(clips=30, frames=4, training=False)
    text = write_report(small, tmp_path).read_text()
    assert text.count('<details class="clip"') == 30
    assert text.count("data:image") > 300
    monkeypatch.setattr(page_module, "IMAGE_BUDGET", 60_000)
    short = write_report(small, tmp_path).read_text()
    assert short.count('<details class="clip"') == 30
    assert short.count("data:image") < 60
    assert "No pictures" in short
    assert small.clips[-1].name in short
    # White noise cannot be compressed: the worst case for one clip of the full size, times thirty.
    rng = np.random.default_rng(0)
    worst = len(pictures.data_address(pictures.encode_png(rng.random((128, 192, 3)))))
    maps = len(pictures.data_address(pictures.encode_error(rng.random((128, 192)), 1.0)))
    assert 30 * (6 * worst + 5 * maps) < 26_000_000


def test_long_training_is_drawn_with_few_points():
    steps = list(range(50_000))
    drawn = page_module._curve(TrainingCurve(steps, [float(step) for step in steps], [], []))
    assert len(drawn["step"]) == len(drawn["loss"]) == page_module.POINTS
    assert drawn["step"][0] == pytest.approx(24.5)
    assert drawn["loss"][-1] == pytest.approx(drawn["step"][-1], rel=1e-4)


ABOUT = {"ntd A": "traditional motion vectors", "ntd C": "dual motion vectors and the occlusion loss"}


def test_labels_are_explained_where_they_stand(tmp_path):
    text = write_report(synthetic()._replace(about=ABOUT), tmp_path).read_text()
    for label, about in ABOUT.items():
        assert f'{label} <small class="about">{about}</small>' in text
    assert "ntd C (dual motion vectors and the occlusion loss)" in text
    assert strict((tmp_path / "metrics.json").read_text())["about"] == ABOUT


@pytest.mark.parametrize("change", [{"about": {"x": "y"}}, {"opens_on": "x"}])
def test_explanations_of_unknown_labels_are_refused(tmp_path, change):
    with pytest.raises(ValueError, match="labels out of"):
        write_report(synthetic()._replace(**change), tmp_path)


def test_a_film_is_small_and_near_the_images_and_has_their_exact_errors():
    rng = np.random.default_rng(0)
    reference = np.repeat(np.linspace(0, 1, 64)[None, None, :, None], 3, 3).repeat(40, 1).repeat(70, 0)
    images = np.clip(reference + 0.05 * rng.normal(size=reference.shape), 0, 1)
    made = films.film(images, reference)
    assert len(made.pictures) == len(made.errors) == films.FRAMES == 60
    decoded = np.asarray(Image.open(io.BytesIO(made.pictures[7])), np.float64) / 255
    assert np.abs(decoded.mean((0, 2)) - images[7].mean((0, 2))).max() < 0.03
    grey = np.asarray(Image.open(io.BytesIO(made.errors[7])).convert("L"), np.float64) / 255
    # Grey is the root of the error, so that lossy compression of small errors stays small.
    wanted = pictures.error_map(images[7], reference[7])
    assert abs((grey**2).mean() - wanted.mean()) < 0.1 * wanted.mean()
    assert films.film(images, None).errors == []
    broken = films.film(np.full((1, 8, 8, 3), math.nan), np.zeros((1, 8, 8, 3)))
    assert np.asarray(Image.open(io.BytesIO(broken.errors[0])).convert("L")).min() > 250
    wide = Image.open(io.BytesIO(films.encode_webp(np.zeros((30, 1930, 3)))))
    assert wide.size[0] <= films.WIDTH


def test_films_stay_within_their_bytes_and_say_what_they_leave_out(tmp_path, monkeypatch):
    results = with_films(synthetic(training=False))
    whole = write_report(results, tmp_path).read_text()
    size = sum(
        4 * ((len(file) + 2) // 3) for each in results.clips[0].films.values() for files in each for file in files
    )
    assert films.frames_within(results.clips[0].films, size) == 12
    assert films.frames_within(results.clips[0].films, size - 1) == 11
    assert films.frames_within({}, 100) == 0
    monkeypatch.setattr(page_module, "FILM_BUDGET", size)  # for two clips
    half = write_report(results, tmp_path).read_text()
    assert len(half) < len(whole) - 0.8 * size
    frames = [int(found) for found in re.findall(r'"film":{"frames":(\d+),"of":12', half)]
    assert len(frames) == 2
    assert all(4 <= each <= 7 for each in frames)
    monkeypatch.setattr(page_module, "FILM_BUDGET", 10)
    assert write_report(results, tmp_path).read_text().count('"film":null') == 2
    assert re.search(r"\d\.\d MB, complete in this file", whole)


def test_films_of_different_lengths_are_refused(tmp_path):
    clip = with_films(synthetic(clips=1)).clips[0]
    cut = clip.films | {"svgf": films.Film(clip.films["svgf"].pictures[:5], clip.films["svgf"].errors[:5])}
    with pytest.raises(ValueError, match="films of one length"):
        write_report(synthetic(clips=1)._replace(clips=[clip._replace(films=cut)]), tmp_path)


# ---- in a browser --------------------------------------------------------------------------------


@pytest.fixture
def visit(browser, tmp_path):
    """Open the report of some results; afterwards there must have been no error and no request but for files."""
    complaints, requests, contexts = [], [], []

    def open_report(results, *, width=1280, height=900, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        tab = context.new_page()
        tab.set_default_timeout(180_000)  # a busy machine is no fault of the page
        tab.on("console", lambda message: complaints.append(message.text) if message.type != "log" else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(write_report(results, tmp_path).as_uri())
        return tab

    yield open_report
    for context in contexts:
        context.close()
    assert complaints == []
    assert requests
    assert [url[:80] for url in requests if not url.startswith(("file:", "data:"))] == []


def shown_label(tab, clip=0):
    return tab.locator(f"#clip-{clip} .flip img.on:not(.mask)").get_attribute("alt")


@pytest.mark.browser
def test_keys_and_clicks_flip_the_picture_in_place(visit):
    tab = visit(synthetic())
    assert shown_label(tab) == "ntd C"
    for key, label in enumerate([*METHODS, "reference"], start=1):
        tab.keyboard.press(str(key))
        assert shown_label(tab) == label
        assert tab.locator("#clip-0 .flip .tag").inner_text() == label
        assert tab.locator("#clip-0 .flip img.on").count() == 1
    tab.keyboard.press("9")  # no ninth picture: nothing happens
    assert shown_label(tab) == "reference"
    tab.locator("#clip-0 .bar button", has_text="svgf").click()
    assert shown_label(tab) == "svgf"
    tab.keyboard.press("e")
    assert shown_label(tab) == "error of svgf"
    tab.locator("#clip-0 .flip").click()
    assert shown_label(tab) == "error of ntd A"
    tab.keyboard.press("e")
    assert tab.locator("#clip-0 .flip .mask.on").count() == 0
    tab.keyboard.press("d")
    assert tab.locator("#clip-0 .flip .mask.on").count() == 1
    assert tab.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")


@pytest.mark.browser
def test_a_clip_is_unpacked_when_it_is_opened_and_then_owns_the_keys(visit):
    tab = visit(synthetic(clips=3))
    assert tab.locator("#clip-1 img").count() == 0
    tab.locator("#overview a", has_text="robot").locator("visible=true").click()
    # The link changes the address, and the page hears of that later.
    tab.wait_for_function("document.querySelectorAll('#clip-1 .flip img').length === 12")
    tab.locator("#clip-1 .flip").hover()
    tab.keyboard.press("1")
    assert shown_label(tab, 1) == "noisy"
    assert shown_label(tab, 0) == "ntd C"


@pytest.mark.browser
def test_the_split_moves_by_keyboard_and_by_pointer(visit):
    tab = visit(synthetic(clips=1))
    slider = tab.get_by_role("slider")

    def at():
        return int(slider.get_attribute("aria-valuenow"))

    assert at() == 50
    assert slider.get_attribute("aria-valuetext") == "svgf left, ntd C right"
    slider.focus()
    tab.keyboard.press("ArrowRight")
    assert at() == 52
    tab.keyboard.press("Shift+ArrowLeft")
    assert at() == 42
    tab.keyboard.press("End")
    tab.keyboard.press("ArrowRight")
    assert at() == 100
    slider.scroll_into_view_if_needed()
    area = slider.bounding_box()
    y = area["y"] + area["height"] / 2
    tab.mouse.move(area["x"] + area["width"] * 0.75, y)
    tab.mouse.down()
    assert at() == 75
    tab.mouse.move(area["x"] + area["width"] * 0.25, y)
    assert at() == 25
    edge = tab.evaluate("document.querySelector('.split .handle').getBoundingClientRect().left")
    assert edge == pytest.approx(area["x"] + area["width"] * 0.25, abs=2)
    tab.mouse.move(area["x"] - 200, y)
    assert at() == 0
    tab.mouse.up()
    tab.mouse.move(area["x"] + area["width"] * 0.5, y)
    assert at() == 0
    tab.get_by_label("left", exact=True).select_option("noisy")
    assert slider.get_attribute("aria-valuetext") == "noisy left, ntd C right"
    tab.get_by_label("left", exact=True).focus()
    tab.keyboard.press("2")  # belongs to the select now, not to the flip view
    assert shown_label(tab) == "ntd C"


@pytest.mark.browser
def test_tables_have_all_methods_and_the_floor(visit):
    results = synthetic()
    tab = visit(results)
    rows = tab.locator("#scores tbody tr")
    assert rows.locator("th").all_inner_texts() == [*METHODS, "noise floor"]
    assert rows.last.locator("td").first.inner_text() == "38.00"
    best = tab.locator("#scores tr", has_text="ntd C").locator("td.best")
    assert best.count() >= 5
    overview = tab.locator("#overview [data-metric]:visible")
    assert overview.count() == 1
    assert overview.locator("tbody tr").count() == 2
    tab.locator("#metric").select_option("disoccluded_l1")
    wanted = show(results.clips[0].scores["ntd C"].disoccluded_l1, "disoccluded_l1")
    assert wanted in overview.inner_text()
    assert tab.locator("#clip-0 tbody tr").count() == 6
    captions = [text.split("\n") for text in tab.locator("#clip-0 .crops figcaption").all_inner_texts()]
    assert [caption[0] for caption in captions[:6]] == [*METHODS, "reference"]
    clip = results.clips[0]
    captions = [text.split("\n") for text in tab.locator("#clip-0 .errors figcaption").all_inner_texts()]
    assert captions == [[method, "L1 " + show(clip.scores[method].l1, "l1")] for method in METHODS]


@pytest.mark.browser
def test_curves_respond_to_pointer_keyboard_and_legend(visit):
    tab = visit(synthetic(clips=1, frames=120))
    chart = tab.locator("#clip-0 .curves .chart").first
    assert chart.locator("path.line").count() == 4  # the input is hidden until asked for
    chart.locator("button", has_text="noisy").click()
    assert chart.locator("path.line").count() == 5
    picture = chart.locator("svg")
    picture.focus()
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("ArrowRight")
    assert "frame 1 ·" in chart.locator(".legend").inner_text()
    picture.hover(position={"x": 300, "y": 100})
    assert re.search(r"frame \d{2} ·", chart.locator(".legend").inner_text())
    assert tab.locator("#loss path.line").count() == tab.locator("#validation path.line").count() == 3


@pytest.mark.browser
@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_the_page_follows_the_color_scheme_and_is_not_blank(visit, scheme, dark):
    tab = visit(synthetic(), color_scheme=scheme)
    shot = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("L"), np.float64)
    assert (np.median(shot) < 60) == dark
    assert (np.median(shot) > 200) == (not dark)
    assert shot.std() > 10
    stage = np.asarray(Image.open(io.BytesIO(tab.locator(".flip").screenshot())).convert("RGB"), np.float64)
    assert stage.std(axis=(0, 1)).max() > 10


@pytest.mark.browser
def test_the_flip_view_shows_the_very_pixels_of_the_image(visit):
    results = synthetic(clips=1, height=96, width=144)
    tab = visit(results)
    tab.keyboard.press("6")
    stage = np.asarray(Image.open(io.BytesIO(tab.locator(".flip").screenshot())).convert("RGB"), np.float64)
    rows, columns = stage.shape[0] / 96, stage.shape[1] / 144
    wanted = results.clips[0].images["reference"] * 255
    # Away from the crop's frame and the label, which lie over the picture.
    x, y, width, height = pictures.worst_crop([np.ones((96, 144))], results.clips[0].disoccluded)
    compared = 0
    for row in range(1, 72, 9):
        for column in range(1, 144, 9):
            if not (x - 2 < column < x + width + 2 and y - 2 < row < y + height + 2):
                pixel = stage[int((row + 0.5) * rows), int((column + 0.5) * columns)]
                np.testing.assert_allclose(pixel, wanted[row, column], atol=2)
                compared += 1
    assert compared > 5


@pytest.mark.browser
def test_a_narrow_screen_never_scrolls_sideways(visit):
    tab = visit(synthetic(), width=420, height=800)
    assert tab.evaluate("document.documentElement.scrollWidth") == 420


@pytest.mark.browser
def test_hard_contents_break_nothing(visit):
    long = "a method with a very long name " * 4 + "x" * 90
    results = synthetic(clips=1, methods=["noisy", HOSTILE, long], training=False, disocclusion=False)
    clip = results.clips[0]
    nothing = Scores(math.nan, math.inf, -math.inf, *[math.nan] * 7)
    clip = clip._replace(
        scores=clip.scores | {long: nothing},
        images={**clip.images, long: np.full((32, 48, 3), math.nan)},
        per_frame={
            HOSTILE: {"psnr": [math.nan, 30.0, math.inf, 31.0, 31.0], "l1": [math.nan] * 5},
            long: {"psnr": [20.0], "flat": [1.0, 1.0]},
        },
        noise_floor_psnr=math.nan,
        name=long,
    )
    tab = visit(results._replace(clips=[clip, clip], machine={}, settings={}), width=420, height=800)
    assert tab.locator("#training").count() == 0
    assert "this frame has no disoccluded pixels" in tab.locator("#clip-0 .views").inner_text()
    assert "No finite values" in tab.locator("#clip-0 .curves").inner_text()
    assert tab.locator("#clip-0 .curves svg").count() == 2
    assert HOSTILE in tab.locator("#scores").inner_text()
    tab.keyboard.press("3")
    assert shown_label(tab) == long
    assert tab.evaluate("document.documentElement.scrollWidth") == 420


def frame_of(tab, film=0, clip=0):
    return int(tab.locator(f"#clip-{clip} .films canvas").nth(2 * film).get_attribute("data-frame"))


def drawn(tab, canvas):
    """The pixels [H, W, 3] of one of the player's canvases: pictures are even, errors odd."""
    code = """number => {
        const canvas = document.querySelectorAll("#clip-0 .films canvas")[number];
        const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        return [canvas.height, canvas.width, [...pixels.data]];
    }"""
    height, width, values = tab.evaluate(code, canvas)
    return np.asarray(values, np.float64).reshape(height, width, 4)[..., :3]


def column(tab, canvas=4):
    """Where the reference's white column stands in the frame that is drawn."""
    return int(drawn(tab, canvas)[:8].mean((0, 2)).argmax()) // 4


@pytest.mark.browser
def test_the_player_steps_and_draws_the_frames_it_names(visit):
    results = with_films(synthetic(clips=1))
    tab = visit(results)
    tab.wait_for_function("document.querySelectorAll('#clip-0 .films canvas[data-frame]').length >= 5")
    assert frame_of(tab) == results.clips[0].shown_frame == 6
    assert column(tab) == 6
    tab.keyboard.press(".")
    assert [frame_of(tab, film) for film in range(3)] == [7, 7, 7]
    assert column(tab) == 7
    tab.keyboard.press(",")
    tab.keyboard.press(",")
    assert (frame_of(tab), column(tab)) == (5, 5)
    tab.get_by_label("frame", exact=True).focus()
    tab.keyboard.press("End")
    tab.wait_for_function("document.querySelector('#clip-0 .films canvas').dataset.frame === '11'")
    assert (frame_of(tab), column(tab)) == (11, 11)
    tab.locator("#clip-0 .player button", has_text="step ▸").click()  # from the last to the first
    assert (frame_of(tab), column(tab)) == (0, 0)
    assert "frame 0 (0 to 11)" in tab.locator("#clip-0 .count").inner_text()


@pytest.mark.browser
def test_the_player_plays_ten_frames_a_second_by_key_and_by_mouse(visit):
    tab = visit(with_films(synthetic(clips=1)))
    tab.wait_for_function("document.querySelectorAll('#clip-0 .films canvas[data-frame]').length >= 5")
    watch = """() => new Promise(done => {
        const canvas = document.querySelector("#clip-0 .films canvas"), seen = [], began = performance.now();
        const timer = setInterval(() => {
            if (seen.at(-1)?.[0] !== canvas.dataset.frame) seen.push([canvas.dataset.frame, performance.now() - began]);
            if (seen.length > 13) { clearInterval(timer); done(seen); }
        }, 5);
    })"""
    tab.keyboard.press("Space")
    assert tab.locator("#clip-0 .player button", has_text="pause").count() == 1
    seen = tab.evaluate(watch)
    frames, times = np.asarray([int(frame) for frame, _ in seen]), [time for _, time in seen]
    passed = int((np.diff(frames) % 12).sum())  # a busy machine drops frames, but the film does not slow down
    assert passed / (times[-1] - times[0]) == pytest.approx(0.01, rel=0.2)
    assert len(set(frames.tolist())) >= 6
    tab.keyboard.press("Space")
    still = frame_of(tab)
    tab.wait_for_timeout(350)
    assert frame_of(tab) == still
    tab.locator("#clip-0 .films canvas").first.click()
    tab.wait_for_function(
        "frame => document.querySelector('#clip-0 .films canvas').dataset.frame != frame", arg=str(still)
    )
    tab.locator("#clip-0 > summary").click()  # a closed clip does not play on
    tab.wait_for_timeout(350)
    assert tab.locator("#clip-0 .player button", has_text="❚❚").count() == 0


@pytest.mark.browser
def test_the_player_shows_the_error_of_the_frame_in_the_colours_of_the_page(visit):
    results = with_films(synthetic(clips=1, training=False))._replace(about=ABOUT, opens_on="ntd A")
    tab = visit(results)
    assert tab.get_by_label("film 2").input_value() == "ntd A"
    assert shown_label(tab) == "ntd A"
    tab.wait_for_function("document.querySelectorAll('#clip-0 .films canvas[data-frame]').length >= 5")
    clip = results.clips[0]
    scale = json.loads(tab.locator("#page-data").text_content())["errorScale"]
    files = clip.films["ntd A"].errors[6]
    error = (np.asarray(Image.open(io.BytesIO(files)).convert("L"), np.float64) / 255) ** 2
    steps = np.linspace(0, 1, len(pictures.ERROR_COLORS))
    wanted = [np.interp(np.clip(error / scale, 0, 1), steps, color) for color in np.transpose(pictures.ERROR_COLORS)]
    np.testing.assert_allclose(drawn(tab, 3), np.stack(wanted, -1), atol=6)
    captions = tab.locator("#clip-0 .films figcaption").all_inner_texts()
    assert f"{clip.per_frame['ntd A']['l1'][6]:.3g}"[:5] in captions[1]
    assert "traditional motion vectors" in captions[1]
    assert not tab.locator("#clip-0 .films canvas").nth(5).is_visible()  # the reference has no error
    tab.get_by_label("film 2").select_option("svgf")
    before = drawn(tab, 3)
    tab.wait_for_timeout(300)
    assert np.abs(drawn(tab, 3) - np.stack(wanted, -1)).mean() > 5 or np.abs(before - drawn(tab, 3)).mean() > 5


@pytest.mark.slow
@pytest.mark.browser
def test_without_script_the_page_shows_a_still(visit):
    tab = visit(with_films(synthetic(clips=1))._replace(opens_on="ntd A"), java_script_enabled=False)
    still = tab.locator("#clip-0 .still img")
    assert [image.get_attribute("alt") for image in still.all()] == ["noisy", "ntd A", "reference"]
    shot = np.asarray(Image.open(io.BytesIO(still.nth(1).screenshot())).convert("RGB"), np.float64)
    assert shot.std(axis=(0, 1)).max() > 10
    assert tab.locator("#scores tbody tr").count() == 6


@pytest.mark.slow
@pytest.mark.browser
def test_the_player_fits_a_narrow_screen(visit):
    tab = visit(with_films(synthetic())._replace(about=ABOUT), width=420, height=800)
    assert tab.evaluate("document.documentElement.scrollWidth") == 420
    assert tab.locator("#clip-0 .films canvas").first.bounding_box()["width"] > 100
