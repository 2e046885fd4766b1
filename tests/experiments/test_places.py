"""Places side by side: the right pixels, enlarged."""

import numpy as np
import pytest
from PIL import Image

from experiments.papers.places import SCALE, Settings, main, parsed
from jaxdn.evaluation.report.images import save_png


def test_places_are_the_pixels_of_each_method(tmp_path, rng):
    images = {name: rng.random((20, 30, 3)) for name in ("svgf", "reference")}
    for name, image in images.items():
        (tmp_path / "room").mkdir(exist_ok=True)
        save_png(tmp_path / "room" / f"{name}.png", image)
    places = ["room:3,4,6,5", "room:0,15,6,5"]
    main(Settings([tmp_path], places, ["svgf", "reference"], tmp_path / "out.png"))
    sheet = np.asarray(Image.open(tmp_path / "out.png"))[16:]
    assert sheet.shape == (2 * 6 * SCALE, 2 * 7 * SCALE, 3)
    first = np.rint(255 * images["reference"][4:9, 3:9])
    np.testing.assert_array_equal(sheet[: 5 * SCALE : SCALE, 7 * SCALE : 13 * SCALE : SCALE], first)
    second = np.rint(255 * images["svgf"][15:20, :6])
    np.testing.assert_array_equal(sheet[6 * SCALE + 1 : 11 * SCALE : SCALE, : 6 * SCALE : SCALE], second)
    with pytest.raises(ValueError, match=r"expected a part of .*30 x 20 pixels., got .25, 0, 6, 5."):
        main(Settings([tmp_path], ["room:25,0,6,5"], ["svgf"], tmp_path / "out.png"))


def test_pictures_of_several_runs_are_rows_below_each_other(tmp_path, rng):
    images = rng.random((2, 20, 30, 3))
    for name, image in zip(("before", "after"), images, strict=True):
        (tmp_path / name / "room").mkdir(parents=True)
        save_png(tmp_path / name / "room" / "svgf.png", image)
    main(Settings([tmp_path / "before", tmp_path / "after"], ["room:3,4,6,5"], ["svgf"], tmp_path / "out.png"))
    sheet = np.asarray(Image.open(tmp_path / "out.png"))[16::SCALE, ::SCALE]
    for row, image in enumerate(images):
        np.testing.assert_array_equal(sheet[6 * row : 6 * row + 5, :6], np.rint(255 * image[4:9, 3:9]))


@pytest.mark.parametrize("place", ["room", "room:1,2,3", "room:a,b,c,d"])
def test_another_form_is_refused(place):
    with pytest.raises(ValueError, match="expected CLIP:X,Y,WIDTH,HEIGHT"):
        parsed(place)
