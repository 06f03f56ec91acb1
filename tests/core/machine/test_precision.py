"""Which precision a machine is asked to use: by a probe, or as told."""

import torch

from fb_core.conditioning import encode_frozen, encode_in_chunks
from fb_core.evaluation.completion import unseen_room
from fb_core.inpainter import Fillerbuster
from fb_core.machine import precision
from fb_core.training.run.muon import Muon, orthogonalised


def test_a_probe_measures_both_and_auto_follows_it(monkeypatch):
    assert 0 < precision.bfloat16_speed("cpu") < 100
    for speed, expected in ((2.0, torch.bfloat16), (1.0, torch.float32), (0.1, torch.float32)):
        monkeypatch.setattr(precision, "bfloat16_speed", lambda device, speed=speed: speed)
        assert precision.resolved("auto") == expected
        assert f"{speed:.1f} times" in precision.precision_in_words("auto")


def test_what_is_asked_for_is_what_one_gets():
    assert precision.resolved("float32") == torch.float32 and precision.resolved("bfloat16") == torch.bfloat16
    assert precision.precision_in_words("float32") == "float32, as asked for"
    assert precision.resolved("auto", "meta") == torch.float32


def test_muon_in_bfloat16_steps_as_in_float32():
    """Singular values end between 0.7 and 1.2 either way, in the same directions up to bfloat16's rounding."""
    matrices = torch.randn(3, 24, 40, generator=torch.Generator().manual_seed(0))
    left, _, right = torch.linalg.svd(matrices, full_matrices=False)
    for iteration in (torch.bfloat16, torch.float32):
        stepped = orthogonalised(matrices, iteration)
        assert stepped.dtype == torch.float32
        turned = left.mT @ stepped @ right.mT
        values = turned.diagonal(dim1=1, dim2=2)
        assert 0.65 < float(values.min()) and float(values.max()) < 1.25
        beside = stepped - left @ (values[:, :, None] * right)
        assert float(beside.norm() / stepped.norm()) < (0.05 if iteration == torch.bfloat16 else 1e-4)


def test_muon_steps_along_kernels_as_along_their_matrices():
    torch.manual_seed(0)
    kernel = torch.nn.Parameter(torch.randn(8, 4, 3, 3).to(memory_format=torch.channels_last))
    matrix = torch.nn.Parameter(kernel.detach().flatten(1).clone())
    gradient = torch.randn(8, 4, 3, 3)
    optimizers = [Muon([parameter], learning_rate=0.1) for parameter in (kernel, matrix)]
    for _ in range(3):
        kernel.grad, matrix.grad = gradient.clone(), gradient.flatten(1).clone()
        for optimizer in optimizers:
            optimizer.step()
    torch.testing.assert_close(kernel.detach().flatten(1), matrix.detach())


def test_a_frozen_autoencoder_in_bfloat16_tells_the_same_up_to_its_rounding():
    vae = Fillerbuster.from_pretrained().image_vae
    images = unseen_room(family="narrow", seed=0, number=0, views=3, size=32).images
    exact, rough = (encode_frozen(vae, images, 2, kind) for kind in (torch.float32, torch.bfloat16))
    assert rough.dtype == torch.float32
    assert torch.equal(exact, encode_in_chunks(vae, images, 2))
    assert float((rough - exact).norm() / exact.norm()) < 0.03
