"""Names that are no UTF-8, as Linux allows them: read, inspected and written as any others."""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.data.test_kept import assert_same_but, box_blur
from tests.programs import layer, truth

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
FRAMES = 2


def write(folder: Path) -> Path:
    """``beauty`` and ``albedo`` files in Latin-1, in a folder of such a name."""
    place = folder / os.fsdecode(b"sh\xe4")
    place.mkdir()
    for frame in range(FRAMES):
        now = truth(frame)
        for name, image in (("beauty", now.light), ("albedo", now.albedo)):
            clips.write_exr(folder / "plain.exr", layer("", image, "RGB"))
            shutil.move(folder / "plain.exr", place / os.fsdecode(name.encode() + b"_\xe9.%04d.exr" % frame))
    return place


def test_frames_are_read_and_written_under_their_names(tmp_path: Path) -> None:
    source = write(tmp_path)
    clip = clips.read_clip(source)
    np.testing.assert_allclose(clip.frames.albedo[1], truth(1).albedo, rtol=1e-6)
    written = denoise_files([source], tmp_path / "out", box_blur(), Settings(preview=True)).files
    assert [os.fsencode(path.name) for path in written] == [b"beauty_\xe9.%04d.exr" % frame for frame in range(FRAMES)]
    assert_same_but(source / written[0].name, written[0], ("R", "G", "B"))
    assert len(list((tmp_path / "out").iterdir())) == 2 * FRAMES


def test_such_files_are_inspected(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    main.main(["inspect", str(write(tmp_path)), "--json"])
    assert '"frames": 2' in capsys.readouterr().out
