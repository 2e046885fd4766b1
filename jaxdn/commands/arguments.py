"""What each command of ``jaxdn`` takes: its options, with their help; and what several commands make of theirs."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:  # --help does not wait for jax
    from jaxdn.data.foreign.classify import ChannelNaming

_PATH = tyro.conf.Positional[Path]


@dataclass
class Inspect:
    """List the effects of a scene and why it has them, what will be rendered for them, and what that saves.

    Of files of other renderers, what is read from which layer, what is missing, and which conventions their motion
    vectors may have.

    For example:

    jaxdn inspect kitchen/scene.xml --animation kitchen.json --denoiser steady-balanced

    jaxdn inspect data/test/fruit-200 --json

    jaxdn inspect "shots/*.exr" --channels albedo=diffuseFilter

    jaxdn inspect "shots/*.exr" --overlay checked
    """

    scene: tyro.conf.Positional[list[str]]
    """A Mitsuba scene (.xml), a family, the folder of a finished clip, or EXR files of any renderer: a folder, a
    pattern, or their names."""
    animation: Path | None = None
    """Animation file for a scene file."""
    denoiser: str | None = None
    """Plan for this denoiser (svgf, steady-balanced ...), or several (svgf,relax); default: for every buffer that a
    denoiser may read."""
    width: int | None = None
    """Width of a scene's frames in pixels; default: 128."""
    height: int | None = None
    """Height of a scene's frames in pixels; default: 128."""
    frames: int | None = None
    """Number of frames of a scene or clip to inspect; default: all of the animation."""
    json: bool = False
    """Print only one JSON object: {"effects": [...], "plan": {...}, "uncertain": [...]}, of a clip also "sources". Of
    files of other renderers {"frames": 8, "width": 320, "height": 180, "sources": [...], "missing": {...}, "notes":
    [...], "looked_at": [...], "unusable": {...}, "fitting_conventions": [...]}, the last null where there is nothing to
    state; with --overlay also "overlay" and "findings"; of several shots {"shots": [...]}."""
    motion_convention: str | None = None
    """Convention of the motion vectors in files of other renderers; an unknown name lists the known ones."""
    channels: list[str] = field(default_factory=list)
    """For files of other renderers: buffer=layer, if a layer is not found by its name; buffer=none leaves one out;
    "buffer=PATTERN.exr" reads it from files of its own."""
    layer: str | None = None
    """For files of other renderers: the view layer or part to look for buffers in."""
    view: str | None = None
    """For files of other renderers with several views (stereo): the only one to read; default: every view."""
    overlay: Path | None = None
    """For files of other renderers: measure every frame, and write a page (overlay.html) into this folder, with what
    is wrong and what to do, and EXR layers of motion, history, noise and fireflies."""


@dataclass
class Render:
    """Render animated clips with Mitsuba: noisy indirect light, references, G-buffers and motion vectors.

    Run the same command again to resume an interrupted rendering.

    For example:

    jaxdn render fruit --seeds 0 1 2 -o data/train

    jaxdn render kitchen/scene.xml --animation kitchen.json -o data/kitchen

    jaxdn render kitchen/scene.xml --tour --seeds 0-49 -o data/train
    """

    scene: tyro.conf.Positional[str]
    """A family (fruit, robot, pinkroom, mobile, edge, dash, glitter, parlour) or the path of a Mitsuba scene (.xml)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output folder; it gets one folder per clip."""
    animation: Path | None = None
    """Animation file (JSON: camera keys, rigid keys, inserted shapes) for a scene file."""
    tour: bool = False
    """Make an animation of the scene file for each seed: camera path, moving things, materials and lights."""
    seeds: list[str] = field(default_factory=lambda: ["0"])
    """One clip of the family, or tour of the scene, for each seed, such as 3 or 0-49; else the seeds of the noise."""
    width: int = 128
    """Width of the frames in pixels."""
    height: int = 128
    """Height of the frames in pixels."""
    frames: int = 10
    """Number of frames of each clip."""
    reference_spp: int = 256
    """Samples per pixel of the reference; 0 for none."""
    layers: list[int] = field(default_factory=lambda: [1])
    """Independent noisy layers, in samples per pixel (powers of two)."""
    draws: int = 0
    """Further noisy images of one sample each, of indirect and of direct light: training draws from them."""
    light: Literal["indirect", "reflected"] = "indirect"
    """Light with noise: indirect light, with direct light beside it, or all that is reflected, with its shadows."""
    jitter: bool = False
    """Rays go through another point of the pixels in every frame, for taa; references are means over the pixels."""
    pixel_filter: Literal["centre", "box", "gaussian", "blackman-harris"] = "centre"
    """Rays through the pixels' centres, with clean guides, or means over filtered pixels, with guides as noisy as the
    light, as Cycles and other renderers have them (blackman-harris: Cycles' default)."""
    random_optics: bool = False
    """Each seed draws a lens, a shutter and fog, or none of them, for the family or the tour; with --pixel-filter."""
    see_through: bool = False
    """Guides of flat mirrors and of glass are those of what they show, so that it stays sharp; not for trmv, reblur."""
    max_depth: int | None = None
    """Path length (1 emission, 2 direct, 3 one bounce of indirect light ...); default: as the scene needs."""
    effects: str = "auto"
    """auto: the effects that the scene has (see `jaxdn inspect`); all: every effect; or names separated by commas."""
    denoiser: str | None = None
    """Render only what this denoiser (svgf, relax ...) reads, or several (svgf,relax); default: all but what few
    denoisers read."""
    workers: int | None = None
    """Number of processes on this machine; default: the number of cores."""
    scheduler: str | None = None
    """Render on the machines of a Dask cluster that share this disk: its scheduler's address (tcp://head:8786) or
    scheduler file (.json)."""
    frames_per_task: int | None = None
    """With --scheduler: several machines render one clip, each so many of its frames; default: one renders all."""
    threads_per_clip: int | None = None
    """Renderer threads of each process, at least 2; default: 2, or all cores for one clip on this machine."""


@dataclass
class Pack:
    """Pack random windows of rendered clips, to train on machines that clips are too large for: into one compact file,
    or, exact and for sets of any size, into a folder of shards.

    For example:

    jaxdn pack data/train -o train.pack --mib 50 --crop 64 --draws 2

    jaxdn pack data/train -o shards/train --format arrayrecord --mib 200000 --crop 128

    jaxdn train train.pack -o runs/mine
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write, or with `--format arrayrecord` the folder."""
    mib: float
    """Largest size of the file or folder in MiB."""
    format: Literal["file", "arrayrecord"] = "file"
    """One file of rounded values, unpacked where it is used first; or shards of exact values (ArrayRecord, zstd), read
    where they lie. Not on Windows."""
    crop: int = 64
    """Width and height of the windows, in pixels; training may crop them further."""
    frames: int = 10
    """Consecutive frames of a window; of a shorter clip all."""
    draws: int = 2
    """Single samples to store of each window; 0: the layer of one sample instead."""
    buffers: list[str] | None = None
    """Buffers to store; default: those that every variant of ntd is trained with, with arrayrecord all."""
    indirect_only: bool = False
    """Leave out direct and emitted light: smaller, but nothing can be trained on all light."""
    without_half: bool = False
    """Leave out the reference's first half: a quarter smaller, but no inputs of half the reference's samples."""
    seed: int = 0
    """Seed of the choice of windows."""


@dataclass
class Train:
    """Train a learned method on rendered clips; run it again to resume.

    For example:

    jaxdn train data/train --validation data/validation -o runs/mine --steps 3000

    jaxdn train data/train -o runs/traditional --variant ntd-large --set motion=traditional
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips, or what `jaxdn pack` has written, to train on."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The run's folder: checkpoints, log, and finally weights.safetensors with its JSON."""
    validation: Path | None = None
    """Folder of held-out clips, or a file of `jaxdn pack`, for validation, used whole; its PSNR is free of the noise of
    references that keep one half (those of `jaxdn render` do)."""
    method: str = "ntd"
    """Method to train; an unknown name lists the available ones."""
    variant: str | None = None
    """One of the method's variants (ntd-large, ntd-small); default: the fastest."""
    set: list[str] = field(default_factory=list)
    """Options of the method as option=value, such as motion=traditional preset=paper; an unknown name lists them."""
    start: str | None = None
    """Shipped weights or a .safetensors file to continue from; default: new weights."""
    recipe: str | None = None
    """One of the method's recipes; for ntd: usual, finish, without-occlusion, paper-loss, paper-loss-without-occlusion,
    paper, paper-without-occlusion; for steady: usual, finish (goes on from trained weights, in crops of 128). Default:
    the usual one."""
    steps: int | None = None
    """Parameter updates; give more than before to go on with a finished run. Default, here and for the next seven
    options: that of the recipe."""
    batch: int | None = None
    """Clips per update."""
    crop: int | None = None
    """Width and height of the crops that are trained on, in pixels."""
    frames: int | None = None
    """Consecutive frames of a clip per update."""
    learning_rate: float | None = None
    """Peak learning rate."""
    rematerialize: bool | None = None
    """Recompute in the backward pass: a quarter of the memory for 1.1 to 1.4 times the time."""
    seed: int | None = None
    """Seed of the initial weights and of the data's order."""
    spp: list[int] | None = None
    """Samples per pixel of the noisy input; of several numbers, each clip of a batch has one at random."""
    scale_rate: Literal["no", "sqrt", "linear"] = "no"
    """Multiply the recipe's learning rate by --batch divided by the recipe's batch (linear), or by the square root of
    that (sqrt)."""
    time_limit: float | None = None
    """Minutes after which training stops and writes its weights; the same command goes on from there."""
    devices: int | None = None
    """GPUs of this machine to divide each batch among; the number of clips per update is a multiple of it. Default: 1,
    or with --distributed all that each process has."""
    distributed: bool = False
    """This process is one of several that train together, on one machine or many, which share the run's folder. Slurm,
    Open MPI and Kubernetes are recognised."""
    coordinator: str | None = None
    """With --distributed, where no such system says it: HOST:PORT of process 0."""
    processes: int | None = None
    """With --coordinator: the number of processes."""
    process: int | None = None
    """With --coordinator: which of them this is, from 0."""
    implementation: str = "auto"
    """Backend for convolutions: reference (XLA), onednn (CPU; the extra onednn); auto: the fastest available."""


@dataclass
class Denoise:
    """Denoise clips, or EXR files of any renderer; everything else in the files stays as it is. Or render and denoise a
    scene, with samples where the denoiser wants them.

    For example:

    jaxdn denoise data/test/fruit-7 -o out --preview

    jaxdn denoise "shots/*.exr" -o out --method ntd-small --motion-convention cycles --channels albedo=DiffCol

    jaxdn denoise shots/a shots/b -o out --frames 10-40 --skip-existing

    jaxdn denoise scene.xml -o out --method runs/ntasd/weights.safetensors --budget 4 --width 640 --height 360 --preview
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips, folders of EXR files, quoted patterns of EXR files, or files; one or several. Or one Mitsuba
    scene (.xml), or family of scenes, to be rendered."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the denoised frames; for a single frame, also the name of an EXR file."""
    method: str = "auto"
    """Shipped weights (combiner-best, combiner-high, ntd-large, ntd-small, relax-fitted, steady-balanced, steady-fast,
    steady-high, svgf-fitted), a method without weights (svgf, asvgf, taa, oidn), the path of a .safetensors file, or
    a method of another package (package.module:name); an unknown name lists all. auto: on other renderers' files and
    jaxdn's own clips with filtered pixels combiner-high, if the extra oidn is installed; else, and on all other clips,
    steady-balanced."""
    bidirectional: bool = False
    """Denoise backwards too, from the last frame to the first, and blend both passes: twice the time, and the first
    frames are about as good as the last."""
    safe: bool = True
    """Keep what is not recognised as noise; clean frames come back unchanged."""
    frames: list[str] | None = None
    """Numbers of the frames to denoise, such as 7 or 10-40; frames before them are read for their history. Default:
    all."""
    skip_existing: bool = False
    """Leave out frames whose result is there already."""
    strict: bool = False
    """End at an EXR file that is empty, damaged, or has another size or other passes than most; by default such files
    are left out as missing frames, and named."""
    only_beauty: bool = False
    """Of EXR files of other renderers, write the denoised beauty and its alpha alone, without the other layers."""
    max_memory: float | None = None
    """GiB of memory to take; larger frames are denoised in parts, with the same result. Default: half of the
    machine's."""
    aovs: Literal["keep", "additive"] = "keep"
    """Other layers of light in such files: keep them as they are, or (additive) denoise those that are parts of the
    beauty so that they still add up to it."""
    alpha: bool = False
    """Denoise the alpha of such files too, with weights of the denoised beauty; by default it stays as it is."""
    wrap: bool = False
    """Such files are equirectangular panoramas, whose left edge continues at the right one; their attribute envmap says
    so, too."""
    reblur: list[str] | None = None
    """Put motion blur and depth of field into the denoised frames, by motion vectors and depth, as such files say
    what the camera does, or as stated: shutter=0.5 (part of a frame), fstop=2.8 lens=50 (mm) focus=3.2 (scene units)
    sensor=36 (mm) metres=1 (of a scene unit)."""
    spp: int = 1
    """Samples per pixel to take from the clip's layers."""
    preview: bool = False
    """Write a PNG next to every EXR."""
    motion_convention: str | None = None
    """Convention of the motion vectors in files of other renderers; an unknown name lists the known ones."""
    channels: list[str] = field(default_factory=list)
    """For files of other renderers: buffer=layer, if a layer is not found by its name; buffer=none leaves one out;
    "buffer=PATTERN.exr" reads it from files of its own."""
    layer: str | None = None
    """For files of other renderers: the view layer or part to look for buffers in."""
    view: str | None = None
    """For files of other renderers with several views (stereo): the only one to read; default: every view."""
    implementation: str = "auto"
    """Backend for the network: reference (XLA), onednn-bfloat16 (CPUs with AVX-512 BF16 or AMX; the extra onednn),
    onednn-float32 (CPUs; the extra onednn), onnxruntime (CPUs; the extra onnx); auto: the fastest available."""
    budget: float | None = None
    """Samples per pixel for a method that says where they go (ntasd, dasr), and for a scene: their mean. Less than 1:
    for ntasd trained with least=0, and for a scene with steady. Default: the method's own, else 4."""
    width: int | None = None
    """For a scene: the width in pixels; default: that of `jaxdn render`."""
    height: int | None = None
    """For a scene: the height in pixels; default: that of `jaxdn render`."""
    animation: Path | None = None
    """For a scene: its animation file; default: the one next to it."""
    seed: int | None = None
    """For a scene: the seed of its noise; default: 0."""


@dataclass
class Compare:
    """Score methods on clips with references; writes metrics.json and report.html, and prints a table.

    For example:

    jaxdn compare data/test -o runs/compare --methods noisy svgf ntd-small steady-balanced
    """

    clips: _PATH
    """Folder of clips, or one clip."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    methods: list[str] | None = None
    """noisy, methods (also of other packages, as package.module:name), shipped weights or .safetensors files; default:
    all that come with the package."""
    spp: int = 1
    """Samples per pixel to take from the clips' layers."""


@dataclass
class Export:
    """Write one recurrent step of a method as StableHLO and as ONNX, for programs that are not Python.

    For example:

    jaxdn export steady-balanced -o exported

    jaxdn export svgf -o exported --width 1920 --height 1080 --buffers albedo normal depth motion
    """

    method: tyro.conf.Positional[str]
    """A method without weights (svgf, taa), shipped weights (steady-balanced, ntd-large), the path of a .safetensors
    file, or a method of another package (package.module:name)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for METHOD.stablehlo and METHOD.onnx."""
    width: int | None = None
    """Of the images, with --height; default: any, a multiple of 16 or 32 for networks."""
    height: int | None = None
    """Of the images, with --width."""
    buffers: list[str] | None = None
    """Buffers that the frames will have besides radiance; default: all that the method reads."""
    format: Literal["both", "stablehlo", "onnx"] = "both"
    """What to write; some methods have operations that are not translated to ONNX."""


@dataclass
class Doctor:
    """Show what this machine computes, denoises, trains and renders with, and what to install for more."""

    warm: bool = False
    """Compile what `jaxdn denoise` runs on other renderers' frames, and keep it: for container images and farms."""
    method: str = "auto"
    """With --warm: the method, as of `jaxdn denoise`."""
    width: int = 1920
    """With --warm: the width of the frames in pixels."""
    height: int = 1080
    """With --warm: the height."""


COMMANDS = Inspect | Render | Pack | Train | Denoise | Compare | Export | Doctor
"""All of them, as tyro reads them from a command line."""


def check_folder(out: Path, option: str = "-o") -> Path:
    """The folder that an option names. Raises ValueError for a file, and for what is plainly the name of one."""
    names = (".exr", ".png", ".safetensors", ".json", ".html", ".onnx", ".mlir", ".stablehlo")
    if out.is_file() or out.suffix.lower() in names:
        raise ValueError(f"{option} {out}: expected a folder, got the name of a file; name another.")
    return out


def make_channel_naming(options: Inspect | Denoise) -> "ChannelNaming":
    """What is stated about the channels of other renderers' files."""
    from jaxdn.core.options import parse
    from jaxdn.data.foreign.classify import ChannelNaming

    return ChannelNaming(
        options.motion_convention,
        parse(options.channels, option="--channels", words=True),
        options.layer,
        options.view,
    )
