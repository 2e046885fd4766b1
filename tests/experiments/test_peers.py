"""The peers compute what jaxdn computes: a comparison of speed means nothing otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.speed import peers
from experiments.speed.works import scene
from jaxdn.core.frame import Clip, frame_at
from jaxdn.denoiser.rollout import stream
from jaxdn.denoisers import ntd
from jaxdn.methods.registry import method_named
from jaxdn.ops.warp import warp
from jaxdn.training.step import clip_loss, init_state
from tests.needs import require

TINY = ((4,), (4,), (5,), (5,), (6,))
RECIPE = method_named("ntd").recipe_named(None)._replace(decay=False)


def double(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


def lively(params, key):
    """Parameters with non-zero biases."""
    return jax.tree.map(lambda leaf: 1.5 * leaf + 0.1 * jax.random.normal(key, leaf.shape), params)


PLAIN = {"kernels": "plain", "background": "filter"}
"""The version written in PyTorch is that of the shipped weights."""


def relative(a, b):
    return np.linalg.norm(np.asarray(a) - np.asarray(b)) / np.linalg.norm(np.asarray(b))


def test_pytorch_gives_the_same_images(key, x64):
    require("torch")
    import torch

    from experiments.speed.peers import pytorch

    frames = double(scene.clip(3, 16, 32).frames)
    denoiser = ntd(size=TINY, **PLAIN)
    params = lively(denoiser.init(key, frame_at(frames, 0)), key)
    forms = (pytorch.apply_kernels_loop, pytorch.apply_kernels_unfold)
    theirs = [pytorch.NTD(TINY, params, apply_kernels=form).double().eval() for form in forms]
    ours = stream(denoiser, params)
    others = [pytorch.start(pytorch.tensors(frame_at(frames, 0))["radiance"][None]) for _ in forms]
    for index in range(3):
        frame = frame_at(frames, index)
        image = ours(frame)
        buffers = {name: buffer[None] for name, buffer in pytorch.tensors(frame).items()}
        for number, step in enumerate(theirs):
            with torch.inference_mode():
                others[number], other = step(others[number], buffers)
            assert relative(other[0].movedim(0, -1), image) < 1e-6, (index, number)


@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_pytorch_has_the_same_loss_and_gradients(progress, key, x64):
    require("torch")
    from experiments.speed.peers.pytorch_training import Trainer, batch_tensors
    from experiments.speed.peers.pytorch_training import clip_loss as peer_loss

    clips = [scene.clip(3, 16, 16, seed=seed) for seed in range(2)]
    batch: Clip = double(jax.tree.map(lambda *leaves: np.stack(leaves), *clips))
    denoiser = ntd(size=TINY, **PLAIN)
    params = lively(init_state(denoiser, RECIPE, batch).params, key)

    def batch_loss(params):
        loss, psnr = jax.vmap(lambda clip: clip_loss(denoiser, params, clip, RECIPE.objective, progress=progress))(
            batch
        )
        return jnp.mean(loss), jnp.mean(psnr)

    (loss, _), gradient = jax.jit(jax.value_and_grad(batch_loss, has_aux=True))(params)
    trainer = Trainer(TINY, params, RECIPE)
    trainer.step.double()
    theirs, _ = peer_loss(trainer.step, *batch_tensors(batch), progress=progress)
    theirs.backward()
    assert relative(theirs.item(), loss) < 1e-6
    network = trainer.step.network
    pairs = [(network.head[number], gradient[f"head_{number}"]) for number in range(3)]
    for part, levels in (("encoder", network.encoder), ("decoder", network.decoder)):
        pairs += [(level.convolutions[0], gradient[f"{part}_{n}"]["convolution_0"]) for n, level in enumerate(levels)]
    for convolution, wanted in pairs:
        assert relative(convolution.weight.grad.permute(2, 3, 1, 0), wanted["kernel"]) < 1e-5
        assert relative(convolution.bias.grad, wanted["bias"]) < 1e-5


def test_pytorch_trains():
    require("torch")
    from experiments.speed.works import train_steps

    recipe = RECIPE._replace(batch=1, frames=2)
    call = train_steps.pytorch("small", 16, recipe, compiled=False)
    first, *_, last = [call() for _ in range(4)]
    assert last < first


def test_pytorch_warps_off_screen_as_jaxdn_does(rng):
    require("torch")
    from experiments.speed.peers import pytorch

    image = rng.exponential(size=(9, 12, 3)).astype(np.float32)
    motion = (6 * rng.standard_normal((9, 12, 2))).astype(np.float32)
    theirs = pytorch.warp(pytorch.tensor(image)[None], pytorch.tensor(motion)[None])[0].movedim(0, -1)
    np.testing.assert_allclose(theirs, warp(image, motion), atol=1e-5)


def test_missing_peers_are_reported(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert set(peers.missing()) == {"torch", "torch-compiled", "pyoidn"}
    assert "make bench" in peers.missing()["torch"]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    assert set(peers.missing()) == {"torch-compiled"}
    assert "g++" in peers.missing()["torch-compiled"]
