"""Laws of training: it learns, it resumes bit for bit, it stops on NaN without losing anything, it ends in a model that
completes views.
"""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from helpers.tiny_training import SMALL_VAE, TOY, TOY_LOOP

from fb_core.data.training.sequences import PoolConfig, RoomPool, TaskConfig, draw_task
from fb_core.geometry.raymap import to_unit_range
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.training.recipe import STAGES, export, run_stage
from fb_core.training.run.loop import Run
from fb_core.training.run.options import LoopConfig
from fb_core.training.run.stage import Stage, row_generator
from fb_core.training.stages.dit_stage import encode_sequences
from fb_core.training.stages.linear_start import start_linear
from fb_core.training.stages.vae_stage import kl_divergence, reconstruction_error
from fb_core.views import Views
from method_configs.presets import PRESETS, ROOMS_TINY


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def trained(folder, steps: int | None = None, stages=STAGES) -> dict[str, Run]:
    return {stage: run_stage(TOY, stage, folder, steps=steps) for stage in stages}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    return folder, trained(folder)


def log_of(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_training_stopped_by_its_time_limit_goes_on_bit_for_bit(finished, tmp_path):
    whole, runs = finished
    for stage in STAGES[:2]:
        assert run_stage(TOY, stage, tmp_path, minutes=0.0).step == 0
        resumed = run_stage(TOY, stage, tmp_path)
        for name, value in runs[stage].stage.network.state_dict().items():
            assert torch.equal(resumed.stage.network.state_dict()[name], value), f"{stage}: {name}"
        assert log_of(tmp_path / stage) == log_of(whole / stage)


def test_a_run_killed_after_a_checkpoint_repeats_the_lost_steps_identically(finished, tmp_path):
    whole, runs = finished
    trained(tmp_path, stages=STAGES[:2])
    calls = []

    def kill_after_three(done, of, losses):
        calls.append(done)
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_stage(TOY, "dit", tmp_path, on_progress=kill_after_three)
    resumed = run_stage(TOY, "dit", tmp_path, on_progress=lambda done, of, losses: calls.append(done))
    assert calls == [1, 2, 3, 3, 4]  # the checkpoint was after step 2
    assert log_of(tmp_path / "dit") == log_of(whole / "dit")
    for name, value in runs["dit"].stage.network.state_dict().items():
        assert torch.equal(resumed.stage.network.state_dict()[name], value)


def test_exported_model_loads_and_completes_views(finished, tmp_path):
    folder, _ = finished
    export(TOY, folder, tmp_path / "model")
    model = Fillerbuster.from_pretrained(tmp_path / "model")
    assert model.recommended_sampling == TOY.sampling
    assert model.size == 16 and model.info["preset"] == "toy" and len(model.info["training"]) == 3
    views = Views.unposed(torch.rand(2, 3, 16, 16, generator=seeded()))
    assert torch.isfinite(model.complete(views, generator=seeded(), sampling=SamplingConfig(steps=2)).raymaps).all()


def test_latents_are_scaled_to_unit_variance(finished):
    folder, _ = finished
    for stage in STAGES[:2]:
        assert json.loads((folder / stage / "spread.json").read_text())["scaling"] > 0


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_good_state(tmp_path):
    class Broken(Stage):
        name, network, batch = "broken", torch.nn.Linear(2, 1), 4

        def draw(self, step, rows):
            return torch.tensor([float("nan") if step == 3 and row == 2 else 1.0 for row in rows])

        def losses(self, drawn):
            return {"loss": (self.network.weight.sum() * drawn).square().mean()}

    stage = Broken()
    run = Run(stage, dataclasses.replace(TOY_LOOP, steps=9), tmp_path)
    with pytest.raises(
        FloatingPointError, match=r"at step 3 \(rows 2 of the batch\); the last good state is .*checkpoint.pt"
    ):
        run.train()
    assert all(torch.isfinite(p).all() for p in stage.network.parameters())
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"] == 2


def test_a_checkpoint_of_another_stage_is_refused(finished):
    folder, runs = finished
    with pytest.raises(ValueError, match="holds stage 'dit', expected 'image-vae'"):
        Run(runs["image-vae"].stage, TOY_LOOP, folder / "dit")


def test_the_transformer_needs_its_autoencoders(tmp_path):
    with pytest.raises(ValueError, match="train that stage first"):
        run_stage(TOY, "dit", tmp_path)
    with pytest.raises(ValueError, match="expected one of"):
        run_stage(TOY, "everything", tmp_path)


def test_the_loop_learns_a_regression(tmp_path):
    class Regression(Stage):
        name, batch = "regression", 16

        def __init__(self):
            self.network = torch.nn.Linear(3, 1)

        def draw(self, step, rows):
            return torch.stack([torch.randn(3, generator=row_generator(0, step, row)) for row in rows])

        def losses(self, drawn):
            return {"loss": (self.network(drawn) - drawn.sum(dim=1, keepdim=True)).square().mean()}

    run = Run(
        Regression(), LoopConfig(steps=300, learning_rate=0.05, weight_decay=0.0, save_every=300, average=0.9), tmp_path
    )
    run.train()
    assert run.smoothed["loss"] < 0.05 and (tmp_path / "loss.png").exists()
    assert torch.allclose(run.averaged_state()["weight"], torch.ones(1, 3), atol=0.05)


@pytest.mark.parametrize("nonsense", [{"steps": 0}, {"save_every": 0}, {"cooldown": 2.0}, {"average": 1.0}])
def test_nonsense_loops_are_refused(nonsense):
    with pytest.raises(ValueError, match="training:"):
        LoopConfig(**nonsense)


def test_rate_warms_up_stays_and_cools_down():
    loop = LoopConfig(steps=100, learning_rate=1.0, warmup_steps=10, cooldown=0.2)
    assert loop.rate(0) == pytest.approx(0.1) and loop.rate(50) == 1.0 and loop.rate(99) == pytest.approx(0.05)


def test_kl_of_the_standard_normal_is_zero():
    assert kl_divergence(torch.zeros(2, 4, 3, 3), torch.zeros(2, 4, 3, 3)) == 0
    assert kl_divergence(torch.ones(2, 4, 3, 3), torch.zeros(2, 4, 3, 3)) == pytest.approx(18.0)


def test_the_pool_is_a_function_of_seed_and_step():
    config = dataclasses.replace(TOY.pool, rooms=4)
    walked, jumped = (RoomPool(config, seed=3) for _ in range(2))
    for step in range(6):
        walked.advance(step)
    jumped.advance(5)
    first, second = (pool.sequences(range(2), TOY.dit_loss.task, seeded) for pool in (walked, jumped))
    for field in ("images", "raymaps", "image_known", "rays_known"):
        assert torch.equal(getattr(first, field), getattr(second, field))
    assert first.raymaps[:, :, :3].abs().max() <= 1


def test_one_modality_is_always_whole_without_dropout():
    for seed in range(20):
        image_known, rays_known = draw_task(8, 16, TaskConfig(dropout=0.0), generator=seeded(seed))
        assert bool((image_known == 1).all()) or bool((rays_known == 1).all())


def test_kept_latents_and_shared_encodings_equal_encoding_everything():
    """The readable twin: encode every clean and every masked view on its own."""
    from fb_core.conditioning import encode_known

    torch.manual_seed(0)
    image_vae, raymap_vae = VAE(TOY.image_vae).eval(), VAE(TOY.raymap_vae).eval()
    with torch.no_grad():
        pool = RoomPool(TOY.pool, seed=1, encode=image_vae.encode)
        pool.advance(0)
        batch = pool.sequences(range(3), TaskConfig(views=5, partial_share=0.4), lambda row: seeded(20 + row))
        data, conditioning = encode_sequences(batch, image_vae=image_vae, raymap_vae=raymap_vae)
        rays01 = to_unit_range(batch.raymaps)
        for b in range(3):
            one = encode_known(
                batch.images[b],
                batch.image_known[b],
                rays01[b],
                batch.rays_known[b],
                image_vae=image_vae,
                raymap_vae=raymap_vae,
            )
            assert torch.allclose(conditioning.channels[b], one.channels, atol=1e-5)
            assert torch.allclose(data[b, :, :16], image_vae.encode(batch.images[b]), atol=1e-5)
            assert torch.allclose(data[b, :, 16:], raymap_vae.encode(rays01[b]), atol=1e-5)


def test_linear_start_nearly_reproduces_raymaps():
    network = start_linear(VAE(ROOMS_TINY.raymap_vae), seeded()).eval()
    pool = RoomPool(dataclasses.replace(TOY.pool, image_size=64), seed=1, with_images=False)
    pool.advance(0)
    errors = reconstruction_error(network, to_unit_range(pool.raymaps(range(8), TaskConfig(views=4), seeded)))
    assert errors["direction_degrees"] < 1.5 and errors["origin_error"] < 0.03


def test_linear_start_refuses_norms():
    with pytest.raises(ValueError, match="expected no norms"):
        start_linear(VAE(VAEConfig(**SMALL_VAE | {"norm": "group", "norm_groups": 4})), seeded())


def test_preset_of_the_bundled_model_is_listed_and_fits_the_network():
    assert PRESETS["rooms-tiny"] is ROOMS_TINY
    network = DiT(ROOMS_TINY.dit)
    assert sum(p.numel() for p in network.parameters()) < 12e6


@pytest.mark.parametrize("nonsense", [{"families": ("castle",)}, {"families": ()}, {"image_size": 60}])
def test_nonsense_pools_are_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        PoolConfig(**nonsense)
