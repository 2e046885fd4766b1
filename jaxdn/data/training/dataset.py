"""Training data: an endless, shuffled, augmented, resumable stream of batches from folders of clips or packed sets.

Every element is one clip's random window of consecutive frames, one random crop of it (the same over all its frames, so
that history stays meaningful) under one of the eight symmetries of a square. It depends only on ``seed`` and the
position in the stream: two streams with the same arguments are equal, and one restored from ``get_state()`` resumes
exactly where the other was.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import grain
import jax
import numpy as np

from jaxdn.core.frame import BUFFERS, OF_SAMPLES, Buffer, Clip, Frame, written_out
from jaxdn.data.clip.frames import doubling_layers
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.exr import to_half
from jaxdn.data.training.cache import CachedClip, read_window
from jaxdn.data.training.light_samples import check_samples, sample_light
from jaxdn.data.training.open_clips import open_clips
from jaxdn.data.training.symmetries import transform_clip
from jaxdn.recipes.augmentation import NO_AUGMENTATION, Augmentation, DrawnClip, augment_clip, draw_variation


def training_batches(
    clips: str | Path | Sequence[str | Path],
    *,
    batch: int,
    crop: int | tuple[int, int],
    frames: int = 10,
    seed: int,
    spp: int | Sequence[int] = 1,
    buffers: Sequence[str] | frozenset[str] | None = None,
    layers: bool = False,
    augment: bool = True,
    variation: Augmentation = NO_AUGMENTATION,
    threads: int = 1,
    process: tuple[int, int] = (0, 1),
    vary_later: bool = False,
) -> grain.DatasetIterator[Clip | DrawnClip]:
    """An endless iterator over batches: a Clip of numpy arrays ``[B, T, H, W, C]``, reference included.

    Args:
      clips: a folder of clips, one clip, a packed set (:mod:`jaxdn.data.training.pack`), a set in shards
        (:mod:`jaxdn.data.training.shards`), or a list of these.
      batch: elements of a batch.
      crop: side of the square crop, or (height, width), in pixels.
      frames: consecutive frames of each element.
      seed: decides the order, windows, crops and symmetries; from 0 to 2^32 - 1.
      spp: samples per pixel of the noisy radiance (:func:`jaxdn.data.training.light_samples.sample_light`); of several
        numbers, each element takes one at random.
      buffers: Frame buffers to read, usually ``denoiser.reads`` (default: all that the clips have).
      layers: add the independent noisy layers of 1, 2, 4, ... samples that every clip has (``Clip.layers``), for a
        denoiser that requests samples; then no element has all light (``variation.beauty``), as layers have not.
      augment: flips and quarter turns (no odd turns for a crop that is not square).
      variation: of light, normals and the buffers that are there.
      threads: batches prepared in advance, each by its own thread; 0 prepares them when requested.
      process: index and number of processes that read one stream together: each gets every so many-th element of a
        batch, prepares nothing of the others', and all together have the batch of one process alone. The position is
        the same in all of them and counts whole batches, so that another number of processes may go on from it.
      vary_later: batches are :class:`jaxdn.recipes.augmentation.DrawnClip`, which the update varies on its device.

    Buffers that belong to one noisy image (:data:`jaxdn.core.frame.OF_SAMPLES`: specular light, shadows) come with that
    image, the layer with the fewest samples, instead of noise drawn anew; with all other noise they are neutral.

    Its ``get_state()`` is a small dict for a checkpoint, to be passed to ``set_state`` of an equal iterator.

    Raises ClipError, naming the clip, for clips that are broken, shorter than ``frames``, smaller than ``crop``,
    without reference, ``spp`` or ``layers``, or that do not all have the same buffers. Warns, naming the clip, of a
    reference with values that are not finite or negative, and of an interrupted clip, which is left out.
    """
    height, width = (crop, crop) if isinstance(crop, int) else crop
    for name, value in (("batch", batch), ("crop", height), ("crop", width), ("frames", frames)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}.")
    index, count = process
    if not 0 <= index < count or batch % count:
        raise ValueError(f"batch: expected a multiple of the {count} processes, got {batch}; change one of them.")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed: expected 0 to 2^32 - 1, got {seed}.")
    counts = (spp,) if isinstance(spp, int) else tuple(spp)
    if not counts:
        raise ValueError("spp: expected at least one number of samples, got none.")
    folders = [clips] if isinstance(clips, str | Path) else clips
    sources = [source for folder in folders for source in open_clips(folder)]
    if not sources:
        raise ClipError("clips: expected at least one folder, got none.")
    for source in sources:
        _check(source, (frames, height, width), counts)
    names = _common_buffers(sources, buffers)
    of_samples = names & OF_SAMPLES
    # Each clip has the first layers of 1, 2, 4, ...: the clip with the fewest decides.
    common = min((doubling_layers(source.layers, source.path) for source in sources), key=len) if layers else []

    def element(index: int, rng: np.random.Generator) -> Clip | DrawnClip:
        source = sources[index]
        starts = [int(rng.integers(0, has - wants + 1)) for has, wants in zip(source.shape, sizes, strict=True)]
        window = tuple(slice(start, start + size) for start, size in zip(starts, sizes, strict=True))
        samples = counts[int(rng.integers(len(counts)))]
        # Layers hold the noisy light alone: there is no direct light to add to theirs.
        beauty = bool(rng.random() < variation.beauty) and not layers
        if of_samples & source.buffers and samples == min(source.layers, default=0) and not beauty:
            clip = read_window(source, window, spp=samples, buffers=names, layers=layers)
        else:
            light = sample_light(source, window, samples, rng, beauty=beauty, widen=not vary_later)
            clip = read_window(
                source, window, spp=samples, light=light, buffers=names, layers=layers, widen=not vary_later
            )
        clip = clip._replace(frames=written_out(clip.frames, of_samples))
        if clip.layers is not None:
            clip = clip._replace(layers={count: clip.layers[count] for count in common})
        if vary_later:
            clip = _narrow(clip)
        if augment:
            turns = int(rng.integers(4)) if height == width else 2 * int(rng.integers(2))
            clip = transform_clip(clip, flip=bool(rng.integers(2)), turns=turns)
        if vary_later:
            return DrawnClip(clip, draw_variation(variation, sizes, rng))
        return clip if variation == NO_AUGMENTATION else augment_clip(clip, variation, rng)

    sizes = (frames, height, width)
    # A clip of 30 frames is worth three of 10: the same number of frames is seen of every clip in proportion.
    indices = [index for index, source in enumerate(sources) for _ in range(source.shape[0] // frames)]
    # `repeat` before `random_map`: its generator is seeded by the position in the endless stream.
    stream = grain.MapDataset.source(indices).seed(seed).shuffle().repeat(None).random_map(element)
    # After `random_map`: an element is the same whoever prepares it.
    own = stream[index::count] if count > 1 else stream
    # An endless stream has no incomplete last batch, but rounding its length up overflows for batches of one.
    batches = own.batch(batch // count, drop_remainder=True, batch_fn=_stack)
    # Grain's own default is to keep 500 elements ready, which are batches here.
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads)
    return iter(batches.to_iter_dataset(options))


def _narrow(clip: Clip) -> Clip:
    """The clip in the precision of files: light and guides that these have in half precision."""

    def narrow(image: Any, buffer: Buffer) -> Any:
        if image is None or buffer.stored != "half" or image.dtype == np.float16:
            return image
        with np.errstate(over="ignore"):
            half = image.astype(np.float16)
        return to_half(image) if np.isinf(half).any() else half  # rarely: what is too large, and then clamped

    light = BUFFERS["radiance"]
    return Clip(
        Frame(**{name: narrow(image, BUFFERS[name]) for name, image in clip.frames._asdict().items()}),
        narrow(clip.reference, light),
        jax.tree.map(lambda image: narrow(image, light), clip.layers),
    )


def _stack(clips: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *clips)


def _check(clip: CachedClip, sizes: tuple[int, int, int], counts: Sequence[int]) -> None:
    if clip.shape[0] < sizes[0]:
        raise ClipError(
            f"{clip.path}: expected at least {sizes[0]} frames, got {clip.shape[0]}; train on fewer "
            f"(--frames {clip.shape[0]})."
        )
    if clip.shape[1] < sizes[1] or clip.shape[2] < sizes[2]:
        raise ClipError(
            f"{clip.path}: expected at least {sizes[2]} x {sizes[1]} pixels for the crop, got {clip.shape[2]} x "
            f"{clip.shape[1]}; make it smaller (--crop {min(clip.shape[1:])})."
        )
    if "reference" not in clip.arrays:
        raise ClipError(f"{clip.path}: there is no reference to train towards; render the clip with one.")
    for count in counts:
        check_samples(clip, count)


def _common_buffers(clips: Sequence[CachedClip], wanted: Sequence[str] | frozenset[str] | None) -> frozenset[str]:
    """What every element will have: of clips rendered by a plan, what one lacks is written out where others have it."""

    def offered(clip: CachedClip) -> frozenset[str]:
        return clip.buffers if wanted is None else clip.buffers & frozenset(wanted)

    sets = [offered(clip) for clip in clips]
    ((usual, _),) = Counter(sets).most_common(1)
    union = frozenset().union(*sets)
    for expected in (usual, union):
        for clip, found in zip(clips, sets, strict=True):
            if found != expected and not clip.planned:
                raise ClipError(
                    f"{clip.path}: expected the same buffers as in the other clips, but "
                    f"{', '.join(sorted(found ^ expected))} differs; name the ones to read in `buffers`, or leave one "
                    "of the clips out."
                )
    return union
