"""Train the second network of ``combiner`` alone: its candidates are made once, but for the last result.

    python -m experiments.cycles.combiner_choice FOLDER/train --start combiner-high --anew -o runs/chosen --minutes 10

An update takes a fifth of the time that ``jaxdn train`` needs for one of everything. The last results, which depend on
the weights, are made again every 200 updates. The loss of a pair of frames is
the mean square of the error of x / (1 + x), and that of its change, each as a share of Open Image Denoise's: of clips
and sample counts none outweighs another, and what counts is what PSNR measures. Squares have none of the references'
noise (:mod:`experiments.cycles.score`). Clips whose names end in ``--held`` are left out of training, and scored.
"""

import sys
import time
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from experiments.cycles import reference as references
from experiments.cycles.compare import find_done
from experiments.cycles.record import RECORD, read_record
from experiments.cycles.reference import compress, decibels
from experiments.cycles.training import LAYERS
from jaxdn import denoisers
from jaxdn.clips import open_frames
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame, only
from jaxdn.denoiser import Params
from jaxdn.filters.resampling import find_whole
from jaxdn.filters.sharp_history import fetch_sharply
from jaxdn.methods.combiner.candidates import CANDIDATES
from jaxdn.methods.combiner.history import Means, keep_history, start_history, tested_guides
from jaxdn.methods.combiner.method import (
    CandidateStep,
    Found,
    build_candidate_step,
    build_chooser,
    crop_planes,
    mix_candidates,
    prepare,
)
from jaxdn.methods.combiner.method import (
    Options as Settings,
)
from jaxdn.zoo.weights import load_weights, save_weights

BATCH, RATE, AVERAGE = 4, 2e-3, 0.99
"""Pairs of frames an update; Adam's largest step; the running mean of the weights."""
WARM_UP = 200
"""Updates until the largest step. Without them features of a network that begins anew may grow a hundredfold in the
first ten: one candidate gets a share of exactly 1 everywhere, and no gradient is left."""
_LEAST = 1e-5
"""Mean square below which an error is as good as none."""
UPDATES = 200
"""After so many updates the last results are made again."""
REPORTS = 4
"""How often the held clips are scored while the network is trained, the end included."""
_LAST = CANDIDATES.index("last result")

Stored = dict[str, np.ndarray]
"""Of a clip at one sample count, frame by frame [T, ...]: what :class:`Found` has, in half precision, radiance as
log(1 + gain x); the exposure ``gain``; ``targets`` [T, 3, 3, H, W]: the reference and its halves, as x / (1 + x)."""


class Sequence(NamedTuple):
    """A clip at one sample count."""

    stored: Stored
    frames: list[Frame]
    """What tells where the last result is now: motion and the guides that are tested; none if it is no candidate."""


Clips = dict[str, dict[int, Sequence]]
"""Name of a clip -> sample count -> frames."""


@dataclass
class Options:
    """Train the second network of combiner alone."""

    folder: Annotated[Path, tyro.conf.Positional]
    """A set: the folder of clips, such as FOLDER/train. The test set is refused."""
    start: Path
    """Weights of combiner, a file or the name of shipped ones; their first network stays as it is."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file of all weights, .safetensors."""
    minutes: float = 10.0
    """How long to train; what is made before does not count."""
    anew: bool = False
    """The second network begins as one that was never trained."""
    held: list[str] = field(default_factory=lambda: ["-0100"])
    """Endings of the names of clips that are scored, not trained on."""
    without: list[Literal["correction", "prior mean", "last result"]] = field(default_factory=list)
    """Candidates that are the prior instead: what they are worth. Such weights are for the scores alone."""


def main(options: Options) -> int:
    """Train, score before and after, write the weights."""
    _, params = load_weights(options.start)
    find = jax.jit(build_candidate_step(Settings()))
    clips: Clips = {}
    for clip in find_done(options.folder, []):
        record = read_record(clip / RECORD) or {}
        if record["set"] == "test":
            raise ValueError(
                f"{clip}: expected clips to train on, got one of the test set: nothing is trained on those."
            )
        clips[clip.name] = collect(clip, find, params, record["frames"], options.without)
        print(f"{clip.name}: candidates are made", flush=True)
    held = {name: clip for name, clip in clips.items() if name.endswith(tuple(options.held))}
    trained = {name: clip for name, clip in clips.items() if name not in held}
    if not trained:
        raise ValueError(f"{options.folder}: expected clips to train on, got none that does not end in {options.held}.")
    if options.anew:
        drawn = denoisers.combiner().init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3))))
        params = {**params, "choice": drawn["choice"]}
    report("before", held, params["choice"])
    chosen, updates = train(trained, held, params["choice"], options.minutes)
    record = {"start": options.start.name, "choice_updates": updates, "clips": sorted(trained)}
    if options.anew:
        record["choice_anew"] = True
    if options.without:
        record["without"] = options.without
    path = save_weights(
        options.out, {**params, "choice": chosen}, factory="combiner", options={"quality": "high"}, record=record
    )
    print(path)
    return 0


def collect(
    clip: Path, find: CandidateStep, params: Params, frames: int, without: Collection[str] = ()
) -> dict[int, Sequence]:
    """What there is to choose from in each frame of a clip, for each sample count; ``find`` is compiled.

    In place of the last results, which are not known yet, are the priors of the frames before. The prior itself stands
    for the candidates named in ``without``.
    """
    gone = [CANDIDATES.index(name) for name in without]
    reads = denoisers.combiner().reads
    halves = [references.read(clip / "reference" / f"{number:04d}.exr") for number in range(1, frames + 1)]
    targets = np.stack(
        [np.stack([compress(one) for one in (each.image, each.first, each.second)]) for each in halves]
    ).transpose(0, 1, 4, 2, 3)
    sequences = {}
    for samples in LAYERS:
        images = [only(each.frame, reads) for each in open_frames(clip / f"{samples}spp-0")[1]]
        rows, state = [], start_history(jax.tree.map(jnp.asarray, images[0]))
        for index, frame in enumerate(images):
            statistics, prepared = prepare(jax.tree.map(jnp.asarray, frame))
            found, _ = find(params, state, prepared, jnp.asarray(index == 0), statistics)
            rows.append(_pack(found, statistics.exposure, frame))
            means = crop_planes(found.means, frame.radiance.shape[:2])
            state = keep_history(prepared, means, means.prior)
        stored = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        stored["light"][:, gone] = stored["light"][:, :1]
        stored["targets"] = targets.astype(np.float32)
        size = stored["light"].shape[-2:]
        sequences[samples] = Sequence(stored, [] if _LAST in gone else [_crop_guides(frame, *size) for frame in images])
    return sequences


def _crop_guides(frame: Frame, height: int, width: int) -> Frame:
    """What :func:`fetch_result` reads of a frame."""
    few = frame._replace(radiance=frame.radiance[..., :1], albedo=None, normal=None)
    cropped: Frame = jax.tree.map(lambda each: np.asarray(each)[:height, :width], few)
    return cropped


def _pack(found: Found, gain: jax.Array, frame: Frame) -> Stored:
    """A frame of :data:`Stored` but its targets."""
    height, width = (side - side % 4 for side in frame.radiance.shape[:2])
    light = jnp.stack([*found.candidates, found.noisy])
    packed = {"light": jnp.log1p(gain * jnp.maximum(light, 0.0))} | {
        name: getattr(found.means, name) for name in ("albedo", "normal", "number")
    }
    arrays = {name: np.asarray(each, np.float16)[..., :height, :width] for name, each in packed.items()}
    return {**arrays, "gain": np.asarray(gain, np.float32)}


def unpack(row: dict[str, jax.Array]) -> Found:
    """A frame of :data:`Stored`."""
    light = jnp.expm1(row["light"].astype(jnp.float32)) / row["gain"]
    albedo, normal, number = (row[name].astype(jnp.float32) for name in ("albedo", "normal", "number"))
    zero = jnp.zeros_like(albedo)
    return Found(list(light[:-1]), light[-1], Means(zero, zero, albedo, normal, number, number))


def make_results(clips: Clips, params: Params) -> None:
    """Put the results that the network with ``params`` makes, frame by frame, in place of the last ones."""
    chooser = build_chooser(Settings(implementation="onednn-float32"))

    @jax.jit
    def mix(params: Params, row: dict[str, jax.Array]) -> jax.Array:
        return mix_candidates(chooser, params, unpack(row), row["gain"])

    for clip in clips.values():
        for sequence in clip.values():
            stored, before = sequence.stored, None
            for index, frame in enumerate(sequence.frames):
                row = {name: stored[name][index] for name in stored if name != "targets"}
                if before is not None:
                    row["light"][_LAST] = fetch_result(*before, frame, row["light"][0], row["gain"])
                before = mix(params, row), sequence.frames[index]


@jax.jit
def fetch_result(result: jax.Array, then: Frame, now: Frame, prior: jax.Array, gain: jax.Array) -> jax.Array:
    """The last result where it is now, the prior where it is not known, as :data:`Stored` has light."""
    whole = find_whole(then)[..., None].astype(result.dtype)
    history = jnp.concatenate([jnp.maximum(result, 0.0).transpose(1, 2, 0), whole], axis=-1)
    found = fetch_sharply(history, tested_guides(then), now, jnp.asarray(False), colors=3)
    light = jnp.log1p(gain * jnp.maximum(found.values[..., :3], 0.0))
    return jnp.where(found.valid, light.transpose(2, 0, 1), prior.astype(light.dtype))


def find_errors(image: jax.Array, row: dict[str, jax.Array]) -> jax.Array:
    """[3, 3, H, W] of x / (1 + x), against the reference and its halves."""
    light = jnp.maximum(image, 0.0)
    height, width = image.shape[-2:]
    return (light / (1.0 + light))[None] - row["targets"][..., :height, :width]


def square(errors: jax.Array) -> jax.Array:
    """The mean square of :func:`find_errors` without the references' noise."""
    return jnp.mean(2.0 * errors[0] ** 2 - 0.5 * (errors[1] ** 2 + errors[2] ** 2))


def train(clips: Clips, held: Clips, params: Params, minutes: float) -> tuple[Params, int]:
    """The running mean of the network's parameters, and how many updates there were; reports of ``held`` clips."""
    chooser, rng = build_chooser(Settings(implementation="onednn")), np.random.default_rng(0)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())

    def loss(params: Params, batch: list[list[dict[str, jax.Array]]]) -> jax.Array:
        total = jnp.zeros(())
        for rows in batch:
            found = [unpack(row) for row in rows]
            mixed = [
                find_errors(mix_candidates(chooser, params, one, row["gain"]), row)
                for one, row in zip(found, rows, strict=True)
            ]
            prior = [find_errors(one.candidates[0], row) for one, row in zip(found, rows, strict=True)]
            for measure in (_of_frames, _of_change):
                total += measure(mixed) / jnp.maximum(measure(prior), _LEAST)
        return total / len(batch)

    @jax.jit
    def update(params: Params, state: Any, mean: Params, batch: Any, rate: jax.Array) -> tuple[Params, Any, Params]:
        steps, state = optimizer.update(jax.grad(loss)(params, batch), state, params)
        params = optax.apply_updates(params, jax.tree.map(lambda step: -rate * step, steps))
        return params, state, jax.tree.map(lambda old, new: AVERAGE * old + (1 - AVERAGE) * new, mean, params)

    state, mean, updates = optimizer.init(params), params, 0
    spent, reported, begin = 0.0, 0, time.monotonic()
    while spent < 1:
        if updates % UPDATES == 0:
            make_results(clips, mean)
        batch = [draw(clips, rng) for _ in range(BATCH)]
        params, state, mean = update(params, state, mean, batch, jnp.asarray(find_rate(updates, spent), jnp.float32))
        updates += 1
        spent = (time.monotonic() - begin) / (60 * minutes) if minutes else 1.0
        if min(int(REPORTS * spent), REPORTS) > reported:
            reporting, reported = time.monotonic(), min(int(REPORTS * spent), REPORTS)
            report(f"after {updates} updates", held, mean)
            begin += time.monotonic() - reporting
    return mean, updates


def find_rate(updates: int, spent: float) -> float:
    """Adam's step after so many updates, and that share of the time: a line up, then a cosine that falls to nothing."""
    return RATE * min(1.0, (updates + 1) / WARM_UP) * 0.5 * (1 + np.cos(np.pi * spent))


def _of_frames(errors: list[jax.Array]) -> jax.Array:
    return 0.5 * (square(errors[0]) + square(errors[1]))


def _of_change(errors: list[jax.Array]) -> jax.Array:
    return square(errors[1] - errors[0])


def draw(clips: Clips, rng: np.random.Generator) -> list[Stored]:
    """Two consecutive frames of a clip, flipped and with their colours permuted at random."""
    stored = clips[sorted(clips)[rng.integers(len(clips))]][int(rng.choice(LAYERS))].stored
    first = int(rng.integers(len(stored["gain"]) - 1))
    across, down = rng.random(2) < 0.5
    colors = rng.permutation(3)

    def vary(name: str, each: np.ndarray) -> np.ndarray:
        if each.ndim < 2:
            return each
        each = each[..., :: -1 if down else 1, :: -1 if across else 1]
        # Channels of normals are directions, and of light and albedo colours.
        return np.ascontiguousarray(each if name in ("normal", "number") else np.take(each, colors, axis=-3))

    return [{name: vary(name, stored[name][index]) for name in stored} for index in (first, first + 1)]


def report(when: str, clips: Clips, params: Params) -> None:
    """Print PSNR and temporal PSNR of the held clips, means at each sample count."""
    chooser = build_chooser(Settings())
    make_results(clips, params)
    score = jax.jit(lambda params, row: find_errors(mix_candidates(chooser, params, unpack(row), row["gain"]), row))
    for samples in LAYERS if clips else ():
        found = []
        for clip in clips.values():
            stored = clip[samples].stored
            rows = [{name: stored[name][index] for name in stored} for index in range(len(stored["gain"]))]
            errors = [score(params, row) for row in rows]
            pairs = list(zip(errors[::2], errors[1::2], strict=False))
            still, change = (float(np.mean([one(list(pair)) for pair in pairs])) for one in (_of_frames, _of_change))
            found.append((decibels(still), decibels(change)))
        print(f"{when}, {samples} samples: {np.mean(found, axis=0).round(2)} dB, of frames and of changes", flush=True)


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
