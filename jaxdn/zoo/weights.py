"""Weights as safetensors plus a small JSON that names the denoiser's factory and its options; no pickle."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from jaxdn.core.frame import Frame
from jaxdn.denoiser import Denoiser, Params
from jaxdn.methods.learnable_options import learnable_values
from jaxdn.methods.registry import method_named
from jaxdn.networks.grow import grow
from jaxdn.runtime.atomic_files import write_atomically

SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the weights that come with the package."""


def shipped_names() -> list[str]:
    """The names that :func:`load_weights` accepts."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def flatten(params: Params, prefix: str = "") -> dict[str, np.ndarray]:
    """A nested dict of arrays as one level, keys joined by ``/``."""
    flat: dict[str, np.ndarray] = {}
    for key, value in params.items():
        name = f"{prefix}/{key}" if prefix else str(key)
        flat.update(flatten(value, name) if isinstance(value, dict) else {name: np.asarray(value, order="C")})
    return flat


def unflatten(flat: dict[str, np.ndarray]) -> Params:
    """The inverse of :func:`flatten`, with jax arrays as leaves."""
    params: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, leaf = name.split("/")
        place = params
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = jax.device_put(value)  # `jnp.asarray` compiles a copy for each shape
    return params


def save_weights(
    path: Path | str, params: Params, *, factory: str, options: dict[str, Any], record: dict[str, Any]
) -> Path:
    """Write ``path`` (.safetensors) and the JSON file of the same name; returns the path of the weights.

    No file is ever left incomplete.

    Args:
      path: its suffix is replaced by ``.safetensors``; its folder is created if it is missing.
      params: what to save.
      factory: the method's name in ``jaxdn.denoisers``, or its address ``module:name``.
      options: keyword arguments of the factory. The JSON records every option, those not given with their defaults,
        as a later version may have others.
      record: how the weights were made (data, recipe, scores); further entries of the JSON.

    Raises ValueError for an unknown factory or option.
    """
    options = dataclasses.asdict(method_named(factory).parse_options(options))
    path = Path(path).with_suffix(".safetensors")
    path.parent.mkdir(parents=True, exist_ok=True)
    description = json.dumps({"factory": factory, "options": options, **record}, indent=1, sort_keys=True) + "\n"
    write_atomically({path: save(flatten(params)), path.with_suffix(".json"): description})
    return path


def load_weights(name_or_path: str | Path, **options_instead: Any) -> tuple[Denoiser, Params]:
    """A denoiser and its parameters, by a shipped name (``"ntd-large"``) or the path of a .safetensors file.

    The factory and its options are read from the JSON file of the same name; ``options_instead`` replace them, such
    as ``implementation="onnxruntime"``. Raises ValueError if no weights of that name
    exist, a file cannot be read, the JSON names an unknown factory or option, or the weights are not those of the
    denoiser that it describes.
    """
    path = weights_path(name_or_path)
    description = describe(path)
    method, options = method_named(description["factory"]), description["options"]
    try:
        flat = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"weights {path}: expected a whole safetensors file, got {error}; copy it again.") from error
    try:
        denoiser = method.factory(**options)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"weights {path.with_suffix('.json')}: expected options of {method.name}, got {options} ({error}); they "
            "may come from a newer jaxdn."
        ) from error
    if options_instead:
        denoiser = method.factory(**options | options_instead)
    _check_params(flat, denoiser, path, options_instead)
    return denoiser, unflatten(flat)


def starting_params(
    name_or_path: str | Path, denoiser: Denoiser, *, factory: str, options: Mapping[str, Any]
) -> Params:
    """Parameters to continue training ``denoiser`` from: those of shipped weights or of a file.

    The denoiser may see more than the one that the weights were trained for, and its networks may be larger
    (:func:`jaxdn.networks.grow.grow`, which says by how much its first images differ). Arrays beside the networks'
    layers that the stored weights lack, such as the precisions of guided kernels, have the values that training starts
    from, and the first images differ. Without a network, weights are offsets from the values of options
    (:mod:`jaxdn.methods.learnable_options`), and these have to be the same.

    Args:
      denoiser: what is to be trained.
      factory: the name of its method, as in :func:`save_weights`.
      options: keyword arguments of that factory.

    Raises ValueError as :func:`load_weights` does, for weights of another network, and where there is no network for
    those of another method or of other values of the options that training moves.
    """
    path = weights_path(name_or_path)
    trained = flatten(load_weights(path)[1])
    initial = flatten(denoiser.init(jax.random.key(0), Frame(np.zeros((16, 16, 3), np.float32))))
    layers = {name for name in initial.keys() | trained.keys() if name.endswith(("/kernel", "/bias"))}
    if not layers:
        _check_same_values(path, factory, options)

    def network(weights: dict[str, np.ndarray], kept: bool) -> dict[str, np.ndarray]:
        return {name: array for name, array in weights.items() if (name in layers) == kept}

    try:
        grown = grow(network(trained, True), network(initial, True))
        beside = network(initial, False) | network(trained, False)
        if found := [name for name in beside if name not in initial or beside[name].shape != initial[name].shape]:
            raise ValueError(f"{found[0]} is {beside[found[0]].shape} there")
    except ValueError as error:
        raise ValueError(
            f"weights {path}: expected a network that training can continue from, but {error}; choose the same "
            "options, and the same or a larger size."
        ) from error
    return unflatten(beside | grown)


def _check_same_values(path: Path, factory: str, options: Mapping[str, Any]) -> None:
    """Raise ValueError unless stored offsets are from the same options of the same method as those to be trained."""
    description, method = describe(path), method_named(factory)
    stored = method_named(description["factory"])
    if stored.factory is not method.factory:
        raise ValueError(
            f"weights {path}: expected weights of {method.name}, as a filter's are offsets from the values of its "
            f"options, but they are those of {stored.name}; train {stored.name}, or leave --start out."
        )
    there, here = (
        learnable_values(each.parse_options(given))
        for each, given in ((stored, description["options"]), (method, options))
    )
    if differing := sorted(name for name in {*there, *here} if there.get(name) != here.get(name)):
        was, now = (" ".join(f"{name}={values.get(name)}" for name in differing) for values in (there, here))
        raise ValueError(
            f"weights {path}: expected the options that they were trained with, as they are offsets from these values, "
            f"{was}, but got {now}; choose the same (--set)."
        )


def weights_path(name_or_path: str | Path) -> Path:
    """The .safetensors file of a shipped name, or the path itself. Raises ValueError if there is no such file."""
    path = SHIPPED / f"{name_or_path}.safetensors"
    if not path.is_file():
        path = Path(name_or_path)
    if not path.is_file():
        raise ValueError(
            f"weights {str(name_or_path)!r}: expected one of {', '.join(shipped_names()) or 'none shipped'} or the "
            "path of a .safetensors file, and there is no such file."
        )
    return path


def describe(name_or_path: str | Path) -> dict[str, Any]:
    """The JSON of weights: ``factory``, ``options``, and how they were trained.

    Raises ValueError if it cannot be read or names an unknown method.
    """
    file = weights_path(name_or_path).with_suffix(".json")
    try:
        description = json.loads(file.read_text())
        factory, options = str(description["factory"]), dict(description["options"])
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"weights {file.with_suffix('.safetensors')}: expected {file.name} in the same folder with 'factory' and "
            f"'options', got {error!r}; copy both files together."
        ) from error
    try:
        method_named(factory)
    except ValueError as error:
        raise ValueError(f"weights {file}: factory: {error} They may come from a newer jaxdn.") from error
    return {**description, "factory": factory, "options": options}


def _check_params(flat: dict[str, np.ndarray], denoiser: Denoiser, path: Path, instead: dict[str, Any]) -> None:
    """Raise ValueError unless the arrays have the names, shapes and types of the denoiser's initial parameters."""
    try:
        wanted = _initial_shapes(denoiser)
    except OverflowError as error:
        raise ValueError(
            f"weights {path.with_suffix('.json')}: expected sizes of layers that fit in memory, got far larger ones "
            f"({error}); copy the file again."
        ) from error
    found = {name: (array.shape, array.dtype) for name, array in flat.items()}
    if found != wanted:
        differing = sorted(name for name in {*found, *wanted} if found.get(name) != wanted.get(name))
        first = differing[0]
        cause, advice = "its JSON describes", "copy both files together"
        if instead:
            cause = f"{' '.join(f'{option}={value}' for option, value in instead.items())} needs"
            advice = "leave the option out, or train with it from these weights (`jaxdn train --start`)"
        raise ValueError(
            f"weights {path}: expected the weights that {cause}, but {len(differing)} of them differ, such "
            f"as {first}: expected {wanted.get(first)}, got {found.get(first)}; {advice}."
        )


def _initial_shapes(denoiser: Denoiser) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Name -> shape and type of the denoiser's initial parameters."""
    frame = Frame(jax.ShapeDtypeStruct((16, 16, 3), jnp.float32))
    return _shapes(jax.eval_shape(lambda: denoiser.init(jax.random.key(0), frame)))


def _shapes(tree: dict[str, Any], prefix: str = "") -> dict[str, tuple[tuple[int, ...], Any]]:
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {}
    for key, value in tree.items():
        name = f"{prefix}/{key}" if prefix else str(key)
        shapes |= _shapes(value, name) if isinstance(value, dict) else {name: (value.shape, np.dtype(value.dtype))}
    return shapes
