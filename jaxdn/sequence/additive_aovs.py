"""The additive layers of other renderers' files, denoised with the beauty (``jaxdn denoise --aovs additive``)."""

from collections.abc import Callable, Collection, Mapping

import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import Channels, beauty_channels, stack_channels
from jaxdn.data.foreign.lighting import find_additive_layers, find_beauty_copies
from jaxdn.sequence.aov_decomposition import DecompositionState, decompose, init_decomposition
from jaxdn.sequence.light_range import choose_exponent


class AdditiveAovs:
    """The additive layers of consecutive frames. Which layers these are is decided, and logged, in the first frame."""

    def __init__(self, naming: ChannelNaming, log: Callable[[str], None]) -> None:
        self._naming, self._log = naming, log
        self._layers: dict[str, Channels] | None = None
        self._state: DecompositionState | None = None
        self._exponent: int | None = None  # of the unit in which the history is

    def denoise(self, pixels: Mapping[str, np.ndarray], frame: Frame, image: np.ndarray) -> dict[str, np.ndarray]:
        """Layer -> denoised image [H, W, 3], of the channels of a file, its frame and its denoised beauty.

        Empty without additive layers.
        """
        if self._layers is None:
            self._layers = self._find(pixels)
        if not self._layers:
            return {}
        exponent = self._follow_light(np.asarray(frame.radiance))
        noisy = np.stack([stack_channels(pixels, channels).astype(np.float32) for channels in self._layers.values()])
        state = init_decomposition(frame, len(noisy)) if self._state is None else self._state
        # Without what the decomposition does not read, a step is compiled once for all denoisers.
        radiance, beauty, layers = (np.ldexp(light, exponent) for light in (frame.radiance, image, noisy))
        guides = Frame(radiance, depth=frame.depth, normal=frame.normal, ids=frame.ids, motion=frame.motion)
        self._state, images = decompose(state, guides, beauty, layers)
        return dict(zip(self._layers, np.ldexp(np.asarray(images), -exponent), strict=True))

    def _follow_light(self, radiance: np.ndarray) -> int:
        """The exponent for the next frame; the history is brought to its unit."""
        exponent = choose_exponent(radiance, self._exponent)
        if self._state is not None and self._exponent is not None and exponent not in (None, self._exponent):
            light, length = np.split(np.asarray(self._state.history), [-1], axis=-1)
            history = np.concatenate([np.ldexp(light, exponent - self._exponent), length], axis=-1)
            self._state = self._state._replace(history=jnp.asarray(history))
        self._exponent = exponent
        return 0 if exponent is None else exponent

    def _find(self, pixels: Mapping[str, np.ndarray]) -> dict[str, Channels]:
        names = list(pixels)
        buffers = self._naming.detect(names)
        layers = find_additive_layers(pixels, beauty_channels(names, buffers), buffers)
        copies = find_beauty_copies(pixels, buffers["radiance"], layers)
        self._log(_describe(layers, copies, pixels, buffers["radiance"]))
        return layers


def _describe(
    layers: Mapping[str, Channels], copies: Collection[str], pixels: Mapping[str, np.ndarray], radiance: Channels
) -> str:
    """Which layers are denoised, and how much of the beauty they are, as a line."""
    added = [layer for layer in layers if layer not in copies]
    again = f"{', '.join(sorted(copies))} (the beauty once more)"
    if not added:
        line = "--aovs additive: no layer is a part of the beauty; all stay as they are"
        return f"{line}, but {again}" if copies else line
    beauty = np.nansum(stack_channels(pixels, radiance).astype(np.float32))
    total = sum(np.nansum(stack_channels(pixels, layers[layer]).astype(np.float32)) for layer in added)
    line = f"denoised with the beauty: {', '.join(added)}; together they have {total / beauty:.2f} of its light"
    return f"{line}; and {again}" if copies else line
