"""``jaxdn export``: one recurrent step as files that other programs run."""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Literal, NamedTuple

from jaxdn.export.formats import onnx_model, stablehlo
from jaxdn.export.step import ExportedStep, exported_step
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.zoo.ready import find_model

Format = Literal["both", "stablehlo", "onnx"]


class Exported(NamedTuple):
    """What was written."""

    files: list[Path]
    step: ExportedStep


def export(
    name: str,
    out: Path,
    *,
    buffers: Collection[str] | None = None,
    size: tuple[int, int] | None = None,
    format: Format = "both",
    progress: Callable[[str], object] = lambda what: None,
) -> Exported:
    """Write the step of a method as ``NAME.stablehlo`` and ``NAME.onnx`` into the folder ``out``; both or none.

    Args:
      name: of a filter, shipped weights, or the path of a .safetensors file.
      out: a folder, made if it is missing.
      buffers: those that frames will have besides ``radiance``; None: all that the method reads
        (:func:`jaxdn.export.step.exported_step`).
      size: height and width; None: any.
      format: what is written.
      progress: called with what is being done.

    Raises ValueError for an unknown name or buffer, a size below 16, and where a step cannot be exported so.
    """
    if size is not None and min(size) < 16:
        raise ValueError(f"--width, --height: expected at least 16 pixels each, got {size[1]} x {size[0]}.")
    method = find_model(name)
    if method.denoiser is None:
        raise ValueError(f"method {name!r}: expected one that denoises, such as svgf or steady-balanced.")
    progress("tracing the step")
    try:
        step = exported_step(method.denoiser, method.params, buffers=buffers, size=size)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    contents: dict[Path, bytes | str] = {}
    if format != "stablehlo":
        progress("translating it to ONNX")
        contents[out / f"{method.label}.onnx"] = onnx_model(step, method.label)
    if format != "onnx":
        progress("lowering it to StableHLO")
        contents[out / f"{method.label}.stablehlo"] = stablehlo(step)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(contents)
    return Exported(list(contents), step)
