"""One recurrent step as a function of named arrays, for programs that are not Python.

A denoiser's state and a frame are trees. Here they are dicts: ``radiance``, ``albedo`` ... are the frame's buffers,
``state.NAME`` is the state and ``next.NAME`` the state after the frame. ``first`` says that there is no history; the
state is all zeros then.
"""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxdn.core.frame import BUFFERS, GUIDES, Frame
from jaxdn.denoiser import Denoiser, Params, stages_of
from jaxdn.ops.dispatch.operation import NotPortableError, portable

Arrays = dict[str, Any]
MULTIPLES = (1, 16, 32)
"""Height and width of images of any size are multiples of one of these: of the first with which a step can be traced.
Networks halve an image several times."""
_SMALLEST = 16


class ExportedStep(NamedTuple):
    """A step that can be exported."""

    function: Callable[[Arrays], Arrays]
    """Inputs by their names -> ``image``, the next state, and ``sanitized``, how many values were no usable numbers."""
    inputs: dict[str, jax.ShapeDtypeStruct]
    """Buffers, state, ``first``; their lengths may be expressions of ``h`` and ``w``."""
    program: Any
    """Its jaxpr, whose inputs and outputs are in the order of ``inputs`` and ``outputs``."""
    outputs: tuple[str, ...]
    multiple: int | None
    """Height and width are any multiples of it; None: they are fixed."""


def exported_step(
    denoiser: Denoiser, params: Params, *, buffers: Collection[str] | None = None, size: tuple[int, int] | None = None
) -> ExportedStep:
    """The step of a denoiser with these parameters.

    Args:
      denoiser: any.
      params: its parameters, constants of the program.
      buffers: those that frames will have besides ``radiance``; None: all that the denoiser reads, without
        ``sample_count`` unless it asks for samples: every pixel of a frame that was rendered in the usual way has some.
      size: height and width; None: any.

    Raises ValueError for buffers that the denoiser does not read, and where a program for any size, or any program that
    leaves this process (NotPortableError), cannot be made.
    """
    wanted = _chosen(denoiser, buffers)
    if size is not None:
        return _traced(denoiser, params, wanted, size, None)
    for multiple in MULTIPLES:
        least = max(1, _SMALLEST // multiple)
        text = f"{multiple}*h, {multiple}*w"
        lengths: Any = export.symbolic_shape(text, constraints=[f"h >= {least}", f"w >= {least}"])
        try:
            return _traced(denoiser, params, wanted, lengths, multiple)
        except NotPortableError:
            raise
        except (TypeError, ValueError):  # a size had to be known
            continue
    raise ValueError("the step is not the same for all sizes; give --width and --height.")


def name_buffer_channels(buffer: str) -> list[str]:
    """The channels of a buffer in the files of our clips; the radiance's are ``R, G, B`` in most files."""
    return [f"{buffer}.{letter}" if buffer != "radiance" else letter for letter in BUFFERS[buffer].letters]


def _chosen(denoiser: Denoiser, buffers: Collection[str] | None) -> list[str]:
    """The buffers of the frames, in the order of the table. Raises ValueError for unknown ones."""
    usual = denoiser.reads - (frozenset() if denoiser.samples else {"sample_count"})
    chosen = usual if buffers is None else set(buffers) - {"radiance"}
    if unknown := sorted(set(chosen) - denoiser.reads):
        raise ValueError(
            f"--buffers: expected some of {', '.join(sorted(denoiser.reads))}, which this method reads, got "
            f"{', '.join(unknown)}; leave it out."
        )
    return ["radiance", *(name for name in GUIDES if name in chosen)]


def _traced(
    denoiser: Denoiser, params: Params, buffers: list[str], size: tuple[Any, Any], multiple: int | None
) -> ExportedStep:
    """The step for frames of one size, whose numbers may be symbols."""
    frame = {name: _spec((*size, BUFFERS[name].channels), BUFFERS[name].dtype) for name in buffers}
    with portable():
        stages = stages_of(denoiser)
        state = jax.eval_shape(lambda frame: stages.start(params, Frame(**frame)), frame)
        leaves, tree = jax.tree.flatten(state)
        places = ["".join(f".{_key(key)}" for key in path) for path, _ in jax.tree.leaves_with_path(state)]

        def function(inputs: Arrays) -> Arrays:
            before = jax.tree.unflatten(tree, [inputs[f"state{place}"] for place in places])
            with portable():
                statistics, prepared, replaced = stages.prepare(Frame(**{name: inputs[name] for name in buffers}))
                after, image, invalid = stages.step(params, before, prepared, inputs["first"], statistics)
            follow = dict(zip(places, jax.tree.leaves(after), strict=True))
            count = jnp.asarray(replaced + invalid, jnp.int32)
            return {"image": image, **{f"next{place}": follow[place] for place in places}, "sanitized": count}

        specs = {f"state{place}": _spec(leaf.shape, leaf.dtype) for place, leaf in zip(places, leaves, strict=True)}
        inputs = {**frame, **specs, "first": _spec((), np.dtype(bool))}
        names = list(inputs)
        outputs = ("image", *(f"next{place}" for place in places), "sanitized")

        def ordered(*values: Any) -> list[Any]:
            made = function(dict(zip(names, values, strict=True)))
            return [made[name] for name in outputs]

        program = jax.make_jaxpr(ordered)(*inputs.values())
    return ExportedStep(function, inputs, program, outputs, multiple)


def _spec(shape: tuple[Any, ...], dtype: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _key(key: Any) -> str:
    """A step of a path in a tree as a word."""
    return str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key))))
