"""The step of every shipped method is lowered for CUDA, with the kernels that are chosen there, without a GPU.

Lowering runs all of jax and Pallas down to what a compiler for GPUs gets; whether that compiles and what it computes
is seen on a GPU alone (``python -m experiments.speed.gpu``).
"""

import jax
import numpy as np
import pytest

from experiments.speed.works.on_device import only_read
from experiments.speed.works.steps import frame_of
from jaxdn.zoo.ready import find_model, ready_names

NAMES = sorted({name for name in ready_names() if not name.startswith("combiner")} | {"svgf", "relax"})
"""Without those that call Open Image Denoise: jax lowers a call of Python for the devices of this machine alone."""
KERNELS = "__gpu$xla.gpu.triton"
"""What calls a kernel of Pallas."""


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_lowered_for_cuda(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It calls nothing of the CPU's: neither compiled loops nor backends, which have no GPU's form."""
    model, size = find_model(name), (64, 96)
    assert model.denoiser is not None
    frame = only_read(model, frame_of(*size))
    state = jax.eval_shape(model.denoiser.start, model.params, frame)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    traced = jax.jit(model.denoiser.step).trace(model.params, state, frame)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    called = {line.split("custom_call @")[1].split("(")[0] for line in text.splitlines() if "custom_call @" in line}
    assert called <= {KERNELS}
    assert (KERNELS in called) == name.startswith("steady")
    image = jax.tree.leaves(traced.out_info)[-1]
    assert image.shape == (*size, 3)
    assert image.dtype == np.float32
