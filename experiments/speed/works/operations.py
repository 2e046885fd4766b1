"""The performance-critical operations, forward and gradient: our implementations, PyTorch's, and the roofline.

The default implementation (``implementation=None``) is called ``xla``; the others, except the reference, keep their
names. A backend that is not installed is left out.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import peers, roofline
from experiments.speed.timing import Call
from experiments.speed.works import Work
from jaxdn.ops.convolution.api import convolve
from jaxdn.ops.dispatch.operation import OPERATIONS, REFERENCE
from jaxdn.ops.kernel_prediction.softmax import softmax_filter
from jaxdn.ops.onednn import library
from jaxdn.ops.warp import warp

CONVOLUTIONS = ((1, 720, 1280, 32, 32), (1, 360, 640, 128, 64), (4, 128, 128, 96, 64), (4, 64, 64, 64, 64))
"""(images, height, width, inputs, outputs): layers of LARGE, of a 720p frame and of a training batch."""

Function = Callable[..., Any]
Arrays = Callable[[], list[np.ndarray]]
"""The arguments of an operation, made in the process that calls it."""


def forms(operation: str) -> dict[str, str | None]:
    """Name in the results -> implementation; the default is ``xla``."""
    backends = ["onednn"] if operation == "convolve" and library.available() else []
    known, default = OPERATIONS[operation].implementations, OPERATIONS[operation].automatic()[0].name
    others = [name for name in known if name not in (REFERENCE, "onednn", default)]
    return {"xla": None, **{f"xla-{name}": name for name in others}, **{name: name for name in backends}}


def jitted(function: Function, arrays: Arrays) -> Call:
    """A call of the jitted function that waits for its result."""
    program, arguments = jax.jit(function), [jnp.asarray(array) for array in arrays()]
    return lambda: jax.block_until_ready(program(*arguments))


def gradients(function: Function, chosen: tuple[int, ...], *values: jax.Array) -> Any:
    """The function's value and gradients by some of its arguments, for a cotangent of ones."""

    def of_some(*some: jax.Array) -> jax.Array:
        given = dict(zip(chosen, some, strict=True))
        return function(*[given.get(index, value) for index, value in enumerate(values)])

    out, pull = jax.vjp(of_some, *[values[index] for index in chosen])
    return out, pull(jnp.ones_like(out))


def torch_call(function: Callable[[], Function], arrays: Arrays, chosen: tuple[int, ...], *, compiled: bool) -> Call:
    """``function()`` of tensors in PyTorch; with ``chosen``, also back to those arguments.

    The arrays are [N, H, W, C] (channels-last tensors) or anything else.
    """
    import torch

    from experiments.speed.peers import pytorch

    pytorch.prepare_process()
    tensors = [torch.from_numpy(array).movedim(-1, -3) for array in arrays()]
    for index in chosen:
        tensors[index].requires_grad_()
    run = torch.compile(function(), dynamic=False) if compiled else function()

    def call() -> Any:
        if not chosen:
            with torch.inference_mode():
                return run(*tensors)
        out = run(*tensors)
        return torch.autograd.grad(out, [tensors[index] for index in chosen], torch.ones_like(out))

    return call


def torch_calls(
    forward: Callable[[], Function],
    arrays: Arrays,
    chosen: tuple[int, ...],
    *,
    eager: Callable[[], Function] | None = None,
) -> dict[str, Callable[[], Call]]:
    """PyTorch eager and compiled, where they can run; ``eager`` is the version that is faster there."""
    lacking = peers.missing()
    calls: dict[str, Callable[[], Call]] = {}
    if "torch-compiled" not in lacking:
        calls["torch-compiled"] = partial(torch_call, forward, arrays, chosen, compiled=True)
    if "torch" not in lacking:
        calls["torch-eager"] = partial(torch_call, eager or forward, arrays, chosen, compiled=False)
    return calls


def image_and_logits(height: int, width: int) -> list[np.ndarray]:
    """[1, H, W, 3] and [1, H, W, 25]."""
    rng = np.random.default_rng(0)
    image = rng.exponential(size=(1, height, width, 3)).astype(np.float32)
    return [image, rng.standard_normal((1, height, width, 25), np.float32)]


def filtered(image: jax.Array, logits: jax.Array, *, implementation: str | None) -> jax.Array:
    """One image by its kernels."""
    return softmax_filter(image, logits[0], implementation=implementation)


def torch_filtered(form: str) -> Function:
    """The same in PyTorch, by one of its ways to apply kernels."""

    def run(image: Any, logits: Any) -> Any:
        from experiments.speed.peers import pytorch

        return getattr(pytorch, f"apply_kernels_{form}")(image, logits.softmax(1))

    return run


def kernel_works(height: int, width: int, title: str) -> Iterator[Work]:
    """Softmax and application of 5x5 kernels: forward, and forward with both gradients."""
    arrays = partial(image_and_logits, height, width)
    for kind, chosen in (("", ()), ("-gradient", (0, 1))):
        yield Work(
            f"apply-kernels-{title}{kind}",
            ours(filtered, "softmax_filter", arrays, chosen),
            torch_calls(
                partial(torch_filtered, "loop"),
                arrays,
                chosen,
                eager=partial(torch_filtered, "unfold") if chosen else None,
            ),
            [roofline.kernel_application(height, width, gradient=bool(chosen))],
        )


def image_and_motion(height: int, width: int) -> list[np.ndarray]:
    """[1, H, W, 3] and [1, H, W, 2]; neighbours move together."""
    rng = np.random.default_rng(0)
    image = rng.exponential(size=(1, height, width, 3)).astype(np.float32)
    motion = 3 * rng.standard_normal((1, height // 8, width // 8, 2), np.float32)
    return [image, np.repeat(np.repeat(motion, 8, 1), 8, 2)]


def warped(image: jax.Array, motion: jax.Array, *, implementation: str | None) -> jax.Array:
    """A bilinear fetch."""
    return warp(image[0], motion[0], implementation=implementation)


def torch_warped() -> Function:
    """The same in PyTorch."""

    def run(image: Any, motion: Any) -> Any:
        from experiments.speed.peers import pytorch

        return pytorch.warp(image, motion)

    return run


def warp_works(height: int, width: int, title: str) -> Iterator[Work]:
    """A bilinear fetch of RGB compared with ``grid_sample``, and with its gradient by the image."""
    arrays = partial(image_and_motion, height, width)
    for kind, chosen in (("", ()), ("-gradient", (0,))):
        yield Work(
            f"warp-{title}{kind}",
            ours(warped, "warp", arrays, chosen),
            torch_calls(torch_warped, arrays, chosen),
            [roofline.bilinear_warp(height, width, gradient=bool(chosen))],
        )


def ours(function: Function, operation: str, arrays: Arrays, chosen: tuple[int, ...]) -> dict[str, Callable[[], Call]]:
    """The operation in each of its implementations, with its gradient by the arguments ``chosen``."""
    ways = {shown: partial(function, implementation=name) for shown, name in forms(operation).items()}
    return {
        shown: partial(jitted, partial(gradients, way, chosen) if chosen else way, arrays)
        for shown, way in ways.items()
    }


def layer(count: int, height: int, width: int, inputs: int, outputs: int) -> list[np.ndarray]:
    """Images, a kernel and a cotangent."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((count, height, width, inputs), np.float32)
    kernel = rng.standard_normal((3, 3, inputs, outputs), np.float32) / 24
    return [x, kernel, rng.standard_normal((count, height, width, outputs), np.float32)]


def convolved(
    x: jax.Array, kernel: jax.Array, cotangent: jax.Array, *, direction: str, implementation: str | None
) -> jax.Array:
    """One direction of a convolution; backward only that."""
    if direction == "forward":
        return convolve(x, kernel, implementation=implementation)
    if direction == "image":
        return jax.vjp(lambda x: convolve(x, kernel, implementation=implementation), x)[1](cotangent)[0]
    return jax.vjp(lambda kernel: convolve(x, kernel, implementation=implementation), kernel)[1](cotangent)[0]


def torch_convolved(direction: str, arrays: Arrays) -> Call:
    """The same in PyTorch."""
    import torch

    from experiments.speed.peers import pytorch

    pytorch.prepare_process()
    x, kernel, cotangent = arrays()
    image, gradient = (torch.from_numpy(array).movedim(-1, -3) for array in (x, cotangent))
    weights = torch.from_numpy(kernel).permute(3, 2, 0, 1).contiguous(memory_format=torch.channels_last)
    wanted = [direction == "image", direction == "kernel", False]

    def call() -> Any:
        with torch.inference_mode():
            if direction == "forward":
                return torch.conv2d(image, weights, padding=1)
            return torch.ops.aten.convolution_backward(
                gradient, image, weights, None, [1, 1], [1, 1], [1, 1], False, [0, 0], 1, wanted
            )

    return call


def convolution_works(shape: tuple[int, int, int, int, int]) -> Iterator[Work]:
    """One 3x3 convolution: forward, gradient by the image, gradient by the kernel (only the backward passes)."""
    count, height, width, inputs, outputs = shape
    title, arrays = f"convolution-{count}x{height}x{width}-{inputs}-{outputs}", partial(layer, *shape)
    for direction in ("forward", "image", "kernel"):
        yield Work(
            title if direction == "forward" else f"{title}-gradient-by-{direction}",
            ours(partial(convolved, direction=direction), "convolve", arrays, ()),
            {} if "torch" in peers.missing() else {"torch-eager": partial(torch_convolved, direction, arrays)},
            [roofline.convolution(*shape)],
        )


def works(*, height: int = 720, width: int = 1280, title: str = "720p") -> Iterator[Work]:
    """Kernel application, warp and convolutions."""
    yield from kernel_works(height, width, title)
    yield from warp_works(height, width, title)
    for shape in CONVOLUTIONS:
        yield from convolution_works(shape)
