"""The compared methods, from the table of methods and the available weights: new ones are included automatically."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args, get_type_hints

from experiments.speed import peers
from experiments.speed.chart import of_ntd
from experiments.speed.chart.way import ALL, PLAIN, Way, all_written_out, standing_still, way
from jaxdn.methods.registry import Method, methods
from jaxdn.networks.backends import BACKENDS
from jaxdn.zoo import ready
from jaxdn.zoo.ready import Model


def chosen(*, quick: bool = False) -> list[Model]:
    """The denoisers to measure; ``quick``: only the fastest of each method.

    Those that request samples from the renderer are left out, see :func:`left_out`.
    """
    found = [each for each in ready.all_models() if not _requests_samples(each)]
    if not quick:
        return found
    fastest = {_row(each).name: each.label for each in sorted(found, key=_place)}
    return [each for each in found if each.label in fastest.values()]


def registered(denoisers: Sequence[Model]) -> Iterator[Way]:
    """Every denoiser in all its variants: the plain form, other options of its method, other sets of buffers.

    Untrained methods are timed with initial weights and not scored.
    """
    for each in denoisers:
        trained = each.label in ready.all_names()
        yield way(each, scored=trained)
        for name, options in _alternatives(_row(each)).items():
            yield way(_remade(each, options), name, scored=trained)
        yield way(each, ALL, prepare=all_written_out, scored=trained)
        yield way(each, "still scene", prepare=standing_still, scored=False)


def _row(candidate: Model) -> Method:
    assert candidate.method is not None  # only the noisy image has none, and it is not measured
    return candidate.method


def _requests_samples(candidate: Model) -> bool:
    return candidate.denoiser is not None and candidate.denoiser.samples is not None


def _place(candidate: Model) -> int:
    """Its index among the variants of its method, which are ordered from the most accurate to the fastest.

    A filter's declared constants come last: they are compiled into its program, fitted ones are not.
    """
    row = _row(candidate)
    places = [*row.variants, *([row.name] if row.filter else [])]
    return places.index(candidate.label) if candidate.label in places else -1


def _alternatives(method: Method) -> dict[str, dict[str, Any]]:
    """Variant -> options that change the step but not the weights."""
    found: dict[str, dict[str, Any]] = {}
    for name in method.backends:
        if BACKENDS[name].purpose == "inference" and BACKENDS[name].available():
            found[name] = {"implementation": name}
    if method.has_option("demodulate"):
        found["not demodulated"] = {"demodulate": "none"}
    if method.filter and method.has_option("quality"):  # weights have one quality
        usual = method.options().quality
        choices = get_args(get_type_hints(method.options)["quality"])
        found |= {quality: {"quality": quality} for quality in choices if quality != usual}
    return found


def _remade(candidate: Model, changed: Mapping[str, Any]) -> Model:
    """The same weights, run with other options."""
    options = {**candidate.options, **changed}
    return candidate._replace(denoiser=_row(candidate).factory(**options), options=options)


def ways(denoisers: Sequence[Model], *, quick: bool = False) -> list[Way]:
    """Every method that can be run here; ``quick``: only plain forms."""
    found = list(registered(denoisers))
    if quick:
        return [each for each in found if each.variant == PLAIN]
    return [*found, *of_ntd.untrained()]


def select_ways(found: Sequence[Way], names: Sequence[str]) -> list[Way]:
    """Those of these names; all for no names. Raises ValueError for an unknown one."""
    known = {each.name: each for each in found}
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"--methods: expected some of {'; '.join(known)}, got {'; '.join(unknown)}.")
    return [known[name] for name in names] or list(found)


def left_out() -> list[str]:
    """Why some rows are missing here, in sentences."""
    sentences = [why for name, why in peers.missing().items() if name == "pyoidn"]
    wanted = {name for method in methods().values() for name in method.backends}
    for name, backend in BACKENDS.items():
        if name in wanted and backend.purpose == "inference" and not backend.available():
            sentences.append(f"{name} is not installed or does not run on jax's device: its rows are left out.")
    for each in ready.all_models():
        if _requests_samples(each):
            sentences.append(
                f"{each.label} requests samples from the renderer per pixel, but the compared images have the same "
                "number in every pixel: its rows are left out."
            )
    return sentences
