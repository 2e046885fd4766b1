"""The performance-critical operations, forward and gradient: our implementations, PyTorch's, and the roofline.

The default implementation (``implementation=None``) is called ``xla``; the others, except the reference, keep their
names. An engine that is not installed is left out.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import peers, roofline
from experiments.speed.timing import Call
from experiments.speed.works import Work
from jaxdn.ops import onednn
from jaxdn.ops.convolution import convolve
from jaxdn.ops.registry import implementations, resolve
from jaxdn.ops.softmax_filter import softmax_filter
from jaxdn.ops.warp import warp

CONVOLUTIONS = ((1, 720, 1280, 32, 32), (1, 360, 640, 128, 64), (4, 128, 128, 96, 64), (4, 64, 64, 64, 64))
"""(images, height, width, inputs, outputs): layers of LARGE, of a 720p frame and of a training batch."""

Function = Callable[..., Any]


def forms(operation: str) -> dict[str, str | None]:
    """Name in the results -> name in the registry; the default is ``xla``."""
    engines = ["onednn"] if operation == "convolution" and onednn.available() else []
    ways = [name for name in implementations(operation) if name not in ("reference", "onednn")]
    others = [name for name in ways if resolve(operation, name) is not resolve(operation, None)]
    return {"xla": None, **{f"xla-{name}": name for name in others}, **{name: name for name in engines}}


def jitted(function: Function, *arguments: jax.Array) -> Callable[[], Call]:
    """A call of the jitted function that waits for its result."""

    def build() -> Call:
        program = jax.jit(function)
        return lambda: jax.block_until_ready(program(*arguments))

    return build


def torch_calls(
    forward: Function, arrays: list[np.ndarray], *, gradient: tuple[int, ...] = (), eager: Function | None = None
) -> dict[str, Callable[[], Call]]:
    """``forward`` of tensors in PyTorch, eager and compiled; with ``gradient``, also back to those arguments.

    ``arrays`` are [N, H, W, C] (channels-last tensors) or anything else. ``eager`` is the version that is faster there.
    """
    lacking = peers.missing()

    def build(function: Function, compiled: bool) -> Callable[[], Call]:
        def made() -> Call:
            import torch

            tensors = [torch.from_numpy(np.array(array)).movedim(-1, -3) for array in arrays]
            for index in gradient:
                tensors[index].requires_grad_()
            run = torch.compile(function, dynamic=False) if compiled else function

            def call() -> Any:
                if not gradient:
                    with torch.inference_mode():
                        return run(*tensors)
                out = run(*tensors)
                return torch.autograd.grad(out, [tensors[index] for index in gradient], torch.ones_like(out))

            return call

        return made

    calls = {}
    if "torch-compiled" not in lacking:
        calls["torch-compiled"] = build(forward, True)
    if "torch" not in lacking:
        calls["torch-eager"] = build(eager or forward, False)
    return calls


def kernel_works(height: int, width: int, title: str) -> Iterator[Work]:
    """Softmax and application of 5x5 kernels: forward, and forward with both gradients."""
    rng = np.random.default_rng(0)
    image = rng.exponential(size=(height, width, 3)).astype(np.float32)
    logits = rng.standard_normal((height, width, 25), np.float32)
    here = jnp.asarray(image), jnp.asarray(logits)

    def filtered(name: str | None) -> Function:
        return lambda image, logits: softmax_filter(image[None], logits, implementation=name)[0]

    def peer(form: str) -> Function:
        def run(image: Any, logits: Any) -> Any:
            from experiments.speed.peers import pytorch

            return getattr(pytorch, f"apply_kernels_{form}")(image, logits.softmax(1))

        return run

    for kind, gradient in (("", False), ("-gradient", True)):
        yield Work(
            f"apply-kernels-{title}{kind}",
            {
                shown: jitted(with_gradient(filtered(name), (0, 1)) if gradient else filtered(name), *here)
                for shown, name in forms("softmax_filter").items()
            },
            torch_calls(
                peer("loop"),
                [image[None], logits[None]],
                gradient=(0, 1) if gradient else (),
                eager=peer("unfold") if gradient else None,
            ),
            [roofline.kernel_application(height, width, gradient=gradient)],
        )


def with_gradient(function: Function, arguments: tuple[int, ...]) -> Function:
    """The function's gradients by some of its arguments, for a cotangent of ones."""

    def run(*values: jax.Array) -> Any:
        def of_some(*some: jax.Array) -> jax.Array:
            chosen = dict(zip(arguments, some, strict=True))
            return function(*[chosen.get(index, value) for index, value in enumerate(values)])

        out, pull = jax.vjp(of_some, *[values[index] for index in arguments])
        return out, pull(jnp.ones_like(out))

    return run


def warp_works(height: int, width: int, title: str) -> Iterator[Work]:
    """A bilinear fetch of RGB compared with ``grid_sample``, and with its gradient by the image."""
    rng = np.random.default_rng(0)
    image = rng.exponential(size=(height, width, 3)).astype(np.float32)
    motion = 3 * rng.standard_normal((height // 8, width // 8, 2), np.float32)
    motion = np.repeat(np.repeat(motion, 8, 0), 8, 1)  # neighbours move together
    here = jnp.asarray(image), jnp.asarray(motion)

    def warped(name: str | None) -> Function:
        return lambda image, motion: warp(image, motion, implementation=name)

    def peer(image: Any, motion: Any) -> Any:
        from experiments.speed.peers import pytorch

        return pytorch.warp(image, motion)

    for kind, gradient in (("", False), ("-gradient", True)):
        yield Work(
            f"warp-{title}{kind}",
            {
                shown: jitted(with_gradient(warped(name), (0,)) if gradient else warped(name), *here)
                for shown, name in forms("warp").items()
            },
            torch_calls(peer, [image[None], motion[None]], gradient=(0,) if gradient else ()),
            [roofline.bilinear_warp(height, width, gradient=gradient)],
        )


def convolution_works(shape: tuple[int, int, int, int, int]) -> Iterator[Work]:
    """One 3x3 convolution: forward, gradient by the image, gradient by the kernel (only the backward passes)."""
    count, height, width, inputs, outputs = shape
    rng = np.random.default_rng(0)
    x = rng.standard_normal((count, height, width, inputs), np.float32)
    kernel = rng.standard_normal((3, 3, inputs, outputs), np.float32) / 24
    cotangent = rng.standard_normal((count, height, width, outputs), np.float32)
    here = jnp.asarray(x), jnp.asarray(kernel), jnp.asarray(cotangent)

    def function(kind: str, name: str | None) -> Function:
        def run(x: jax.Array, kernel: jax.Array, cotangent: jax.Array) -> jax.Array:
            if kind == "forward":
                return convolve(x, kernel, implementation=name)
            if kind == "image":
                return jax.vjp(lambda x: convolve(x, kernel, implementation=name), x)[1](cotangent)[0]
            return jax.vjp(lambda kernel: convolve(x, kernel, implementation=name), kernel)[1](cotangent)[0]

        return run

    def peer(kind: str) -> Callable[[], Call]:
        def made() -> Call:
            import torch

            image, gradient = (torch.from_numpy(array).movedim(-1, -3) for array in (x, cotangent))
            weights = torch.from_numpy(kernel).permute(3, 2, 0, 1).contiguous(memory_format=torch.channels_last)
            wanted = [kind == "image", kind == "kernel", False]

            def call() -> Any:
                with torch.inference_mode():
                    if kind == "forward":
                        return torch.conv2d(image, weights, padding=1)
                    return torch.ops.aten.convolution_backward(
                        gradient, image, weights, None, [1, 1], [1, 1], [1, 1], False, [0, 0], 1, wanted
                    )

            return call

        return made

    for kind in ("forward", "image", "kernel"):
        title = f"convolution-{count}x{height}x{width}-{inputs}-{outputs}"
        yield Work(
            title if kind == "forward" else f"{title}-gradient-by-{kind}",
            {shown: jitted(function(kind, name), *here) for shown, name in forms("convolution").items()},
            {} if "torch" in peers.missing() else {"torch-eager": peer(kind)},
            [roofline.convolution(*shape)],
        )


def works(*, height: int = 720, width: int = 1280, title: str = "720p") -> Iterator[Work]:
    """Kernel application, warp and convolutions."""
    yield from kernel_works(height, width, title)
    yield from warp_works(height, width, title)
    for shape in CONVOLUTIONS:
        yield from convolution_works(shape)
