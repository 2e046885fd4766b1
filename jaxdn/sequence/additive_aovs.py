"""The additive layers of other renderers' files, denoised with the beauty (``jaxdn denoise --aovs additive``)."""

from collections.abc import Callable, Collection, Mapping

import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import Channels, beauty_channels, stack_channels
from jaxdn.data.foreign.lighting import coloured_layers, find_beauty_copies, is_additive
from jaxdn.sequence.aov_decomposition import DecompositionState, add_layers, decompose, init_decomposition
from jaxdn.sequence.light_range import choose_exponent


class AdditiveAovs:
    """The additive layers of consecutive frames.

    Which layers these are is decided, and logged, for each in the first frame in which it has light: a light that is
    switched on later is a part of the beauty from then on.
    """

    def __init__(self, naming: ChannelNaming, log: Callable[[str], None]) -> None:
        self._naming, self._log = naming, log
        self._layers: list[str] = []
        self._rejected: set[str] = set()
        self._begun = False
        self._state: DecompositionState | None = None
        self._exponent: int | None = None  # of the unit in which the history is

    def denoise(
        self, pixels: Mapping[str, np.ndarray], frame: Frame, image: np.ndarray, beside: Collection[str] = ()
    ) -> dict[str, np.ndarray]:
        """Layer -> denoised image [H, W, 3], of the channels of a file, its frame and its denoised beauty.

        Channels ``beside`` it, in files of their own, are not written and so not denoised. Empty without additive
        layers.
        """
        there = self._find(pixels, frame, beside)
        if not self._layers:
            return {}
        exponent = self._follow_light(np.asarray(frame.radiance))
        black = np.zeros_like(frame.radiance, np.float32)
        noisy = np.stack(
            [
                stack_channels(pixels, there[layer]).astype(np.float32) if layer in there else black
                for layer in self._layers
            ]
        )
        state = init_decomposition(frame, len(noisy)) if self._state is None else add_layers(self._state, len(noisy))
        # Without what the decomposition does not read, a step is compiled once for all denoisers.
        radiance, beauty, layers = (np.ldexp(light, exponent) for light in (frame.radiance, image, noisy))
        guides = Frame(radiance, depth=frame.depth, normal=frame.normal, ids=frame.ids, motion=frame.motion)
        self._state, images = decompose(state, guides, beauty, layers)
        images = np.ldexp(np.asarray(images), -exponent)
        return {name: one for name, one in zip(self._layers, images, strict=True) if name in there}

    def _follow_light(self, radiance: np.ndarray) -> int:
        """The exponent for the next frame; the history is brought to its unit."""
        exponent = choose_exponent(radiance, self._exponent)
        if self._state is not None and self._exponent is not None and exponent not in (None, self._exponent):
            light, length = np.split(np.asarray(self._state.history), [-1], axis=-1)
            history = np.concatenate([np.ldexp(light, exponent - self._exponent), length], axis=-1)
            self._state = self._state._replace(history=jnp.asarray(history))
        self._exponent = exponent
        return 0 if exponent is None else exponent

    def _find(self, pixels: Mapping[str, np.ndarray], frame: Frame, beside: Collection[str]) -> dict[str, Channels]:
        """Layer -> channels of all that may be parts of the beauty; those that are new parts are added and logged."""
        buffers = self._naming.detect(list(pixels))
        if frame.albedo is None:  # what its name promises may be light
            buffers = {name: channels for name, channels in buffers.items() if name != "albedo"}
        layers = coloured_layers(pixels, beauty_channels(list(pixels), buffers), buffers)
        radiance = stack_channels(pixels, buffers["radiance"])
        new, waiting = {}, False
        for layer in [layer for layer in layers if layer not in self._rejected and layer not in self._layers]:
            additive = is_additive(pixels, layers[layer], radiance)
            if additive and not set(layers[layer]).isdisjoint(beside):
                self._rejected.add(layer)
                self._log(
                    f"--aovs additive: {layer} lies in files of its own and is not denoised; render it as a layer of "
                    "the beauty's files"
                )
            elif additive:
                new[layer] = layers[layer]
            waiting |= additive is None
            if additive is False:
                self._rejected.add(layer)
        self._layers += new
        if new or not self._begun:
            copies = find_beauty_copies(pixels, buffers["radiance"], new)
            line = _describe(new, copies, pixels, buffers["radiance"])
            if self._begun:
                line = f"from here on {line}"
            elif waiting and not new:
                line = "--aovs additive: no layer has light in the first frame; they are looked at again"
            self._log(line)
        self._begun = True
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
    beauty = max(np.nansum(stack_channels(pixels, radiance).astype(np.float32)), np.finfo(np.float32).tiny)
    total = sum(np.nansum(stack_channels(pixels, layers[layer]).astype(np.float32)) for layer in added)
    line = f"denoised with the beauty: {', '.join(added)}; together they have {total / beauty:.2f} of its light"
    return f"{line}; and {again}" if copies else line
