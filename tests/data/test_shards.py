"""Training sets in shards: exact values, the same batches for any number of processes, damage, and kills."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import chain, islice
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdn.clips import ClipError, training_batches
from jaxdn.commands import main
from jaxdn.core.frame import GUIDES, Clip
from jaxdn.data.training.cache import read_array, read_stored
from jaxdn.data.training.open_clips import open_clips
from jaxdn.data.training.shards import open_shards, write_shards
from jaxdn.data.training.windows import Packing
from jaxdn.denoisers import svgf
from jaxdn.recipes.augmentation import Augmentation
from jaxdn.training.validation import load_validation
from tests.data.test_pack import DRAWS, EVERYTHING, SIDE, SMALL, write_clip

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="ArrayRecord does not support Windows")

WHOLE = Packing(crop=SIDE, draws=DRAWS)
GIVEN = {"batch": 4, "crop": 6, "frames": 2, "seed": 3, "spp": (1, 3, 8), "variation": Augmentation()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("sharded") / "clips"
    for seed in range(5):
        write_clip(home / f"clip{seed}", seed)
    return home


@pytest.fixture(scope="module")
def sharded(folder: Path) -> Path:
    """Whole frames of all clips, two of them in a shard."""
    path = folder.parent / "whole"
    clip = open_clips(folder)[0]
    one = sum(read_stored(clip, name, EVERYTHING).nbytes for name in clip.arrays)
    write_shards(path, open_clips(folder), size=2**23, packing=WHOLE, shard_size=2 * one)
    return path


def assert_equal(one: Clip, other: Clip) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def join(parts: list[Clip]) -> Clip:
    """A batch, in the order of one process, from the parts of several: each has every so many-th element."""
    return jax.tree.map(lambda *arrays: np.stack(list(chain(*zip(*arrays, strict=True)))), *parts)


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_every_array_comes_back_bit_for_bit(folder: Path, sharded: Path) -> None:
    assert sorted(path.name for path in sharded.iterdir()) == [
        "shards.json",
        *(f"windows-0000{number}.arrayrecord" for number in range(3)),
    ]
    originals = {clip.path.name: clip for clip in open_clips(folder)}
    windows = open_clips(sharded)
    assert sorted(window.path.name[7:] for window in windows) == sorted(originals)
    for window in windows:
        clip = originals[window.path.name[7:]]
        assert window._replace(path=clip.path, store=clip.store) == clip
        for name in clip.arrays:
            wanted = read_array(clip, name, EVERYTHING)
            np.testing.assert_array_equal(read_array(window, name, EVERYTHING), wanted, strict=True)
            np.testing.assert_array_equal(read_array(window, name, (slice(1, 3),)), wanted[1:3], strict=True)


def test_batches_are_those_of_the_clips_in_the_cache(folder: Path, sharded: Path) -> None:
    order = [folder / window.path.name[7:] for window in open_clips(sharded)]
    cached, packed = training_batches(order, **GIVEN), training_batches(sharded, **GIVEN, threads=2)
    for _ in range(4):
        assert_equal(next(cached), next(packed))
    one, other = (load_validation(svgf(), [place]) for place in (order[0], sharded))
    assert_equal(one[0].clip, other[0].clip)


def test_any_number_of_processes_reads_the_same_batches_and_goes_on_from_any_other(sharded: Path) -> None:
    def begin(count: int) -> list:
        return [training_batches(sharded, **GIVEN, process=(index, count)) for index in range(count)]

    alone = training_batches(sharded, **GIVEN)
    wanted = [next(alone) for _ in range(6)]
    position, found = None, []
    for count in (2, 4, 1):
        streams = begin(count)
        for stream in streams:
            if position is not None:
                stream.set_state(json.loads(position))
        found += [join([next(stream) for stream in streams]) for _ in range(2)]
        (position,) = {json.dumps(stream.get_state()) for stream in streams}
    for one, other in zip(wanted, found, strict=True):
        assert_equal(one, other)
    assert json.loads(position) == alone.get_state()
    with pytest.raises(ValueError, match="batch: expected a multiple of the 3 processes, got 4"):
        begin(3)


def test_less_is_stored_where_less_is_asked_for(folder: Path, tmp_path: Path) -> None:
    few = WHOLE._replace(buffers=("albedo",), direct=False, half=False, draws=2)
    write_shards(tmp_path / "few", open_clips(folder), size=2**23, packing=few)
    window = open_shards(tmp_path / "few")[0]
    assert window.arrays == {"albedo", "reference", "noisy_1spp", "draws"}
    assert (window.draws, window.half_spp, window.layers) == (2, 0, (1,))
    draws = read_array(window, "draws", EVERYTHING)
    all_draws = read_array(open_clips(folder / window.path.name[7:])[0], "draws", EVERYTHING)[..., :3]
    kept = [np.flatnonzero((all_draws == one[:, None]).all((0, 2, 3, 4))) for one in np.moveaxis(draws, 1, 0)]
    assert [len(each) for each in kept] == [1, 1]
    assert kept[0] < kept[1]


def test_without_direct_light_neither_it_nor_emission_is_stored_though_all_buffers_are(
    folder: Path, tmp_path: Path
) -> None:
    stored = {}
    for direct in (True, False):
        packing = WHOLE._replace(buffers=tuple(GUIDES), direct=direct)
        write_shards(tmp_path / f"{direct}", open_clips(folder), size=2**23, packing=packing)
        stored[direct] = open_shards(tmp_path / f"{direct}")[0].arrays
    left_out = stored[True] - stored[False]
    assert {"direct", "emission"} <= left_out
    assert all(name.endswith(("direct", "emission")) for name in left_out)
    assert stored[False] < stored[True]
    assert not any(name.endswith(("direct", "emission")) for name in stored[False])


def test_the_size_is_kept_and_the_same_arguments_give_the_same_files(folder: Path, tmp_path: Path) -> None:
    sources, counts = open_clips(folder), []
    for mib in (0.5, 1, 2):
        out, size = tmp_path / f"{mib}", int(mib * 2**20)
        written = write_shards(out, sources, size=size, packing=SMALL, shard_size=2**18)
        assert size - 2**18 < sum(path.stat().st_size for path in out.iterdir()) == written.size <= size
        names = [window.path.name[7:] for window in open_shards(out)]
        per_clip = [names.count(clip.path.name) for clip in sources]
        assert max(per_clip) - min(per_clip) <= 1
        assert sum(per_clip) == written.windows
        counts.append(written.windows)
    assert counts == sorted(counts)
    write_shards(tmp_path / "again", sources, size=2**21, packing=SMALL, shard_size=2**18)
    for path in (tmp_path / "2").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
    with pytest.raises(
        ClipError, match=r"none: expected room for one window of 8 x 8 pixels, which takes up to 0\.\d+"
    ):
        write_shards(tmp_path / "none", sources, size=2**16, packing=SMALL)
    with pytest.raises(ValueError, match="again: expected a new folder, got one that exists; delete it"):
        write_shards(tmp_path / "again", sources, size=2**21, packing=SMALL)
    assert sorted(os.listdir(tmp_path)) == ["0.5", "1", "2", "again"]


def test_a_damaged_shard_is_named(folder: Path, tmp_path: Path) -> None:
    home = tmp_path / "set"
    write_shards(home, open_clips(folder), size=2**23, packing=WHOLE)
    shard = home / "windows-00000.arrayrecord"
    whole = shard.read_bytes()
    flip(shard, len(whole) // 2)
    with pytest.raises(ClipError, match=r"windows-00000\.arrayrecord: the shard is damaged: record \d+.*copy the file"):
        list(islice(training_batches(home, **GIVEN), 10))
    shard.write_bytes(whole[:-1])
    with pytest.raises(
        ClipError, match=rf"windows-00000\.arrayrecord: .*expected {len(whole)} bytes, got {len(whole) - 1}"
    ):
        open_shards(home)
    shard.unlink()
    with pytest.raises(ClipError, match=r"windows-00000\.arrayrecord: the shard is missing; copy it again"):
        training_batches(home, **GIVEN)
    index = json.loads((home / "shards.json").read_text())
    (home / "shards.json").write_text(json.dumps(index | {"format": 9}))
    with pytest.raises(ClipError, match=r"shards\.json: expected format 1, got 9"):
        open_shards(home)
    for broken in ("[", "[]", '{"format": 1}', json.dumps(index | {"windows": [[0, 0, 7, 0]]})):
        (home / "shards.json").write_text(broken)
        with pytest.raises(ClipError, match=r"shards\.json: .*; copy it again, or pack the set again\."):
            open_clips(home)


def test_a_set_whose_index_was_not_copied_is_named(folder: Path, tmp_path: Path) -> None:
    home = tmp_path / "set"
    write_shards(home, open_clips(folder), size=2**23, packing=WHOLE)
    (home / "shards.json").unlink()
    with pytest.raises(ClipError, match=r"shards\.json: the index is missing; copy it again, or pack the set again\."):
        open_clips(home)


def test_a_killed_pack_leaves_no_set_and_the_next_removes_what_is_left(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "set"
    arguments = ["pack", str(folder), "-o", str(out), "--format", "arrayrecord", "--mib", "60", "--crop", "8"]
    arguments += ["--frames", "2"]
    running = subprocess.Popen([sys.executable, "-m", "jaxdn.commands.main", *arguments])
    try:
        end = time.monotonic() + 120
        while not any(tmp_path.glob(".set.packing-*/.*.tmp")):  # small sets stay in the writer's memory to the end
            assert running.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        running.send_signal(signal.SIGKILL)
    finally:
        running.kill()
        running.wait()
    assert not out.exists()
    assert list(tmp_path.glob(".set.packing-*"))
    main.main([*arguments[:6], "--mib", "1", *arguments[8:]])
    assert os.listdir(tmp_path) == ["set"]
    assert len(open_shards(out)) > 5


@pytest.mark.slow
def test_the_command_trains_on_shards(sharded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = ["train", str(sharded), "-o", str(tmp_path / "run"), "--method", "svgf", "--steps", "2", "--batch", "2"]
    run += ["--crop", "8", "--frames", "2", "--validation", str(sharded)]
    main.main(run)
    assert (tmp_path / "run" / "weights.safetensors").is_file()
    damaged = tmp_path / "damaged"
    shutil.copytree(sharded, damaged)
    flip(damaged / "windows-00001.arrayrecord", 2**17)
    with pytest.raises(SystemExit) as ended:
        main.main(["train", str(damaged), "-o", str(tmp_path / "other"), *run[4:]])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "windows-00001.arrayrecord: the shard is damaged" in told
    assert "Traceback" not in told
