"""Designs of a training beside a base: the same batches for all, laws of those that are not the product's, scores with
a known answer.
"""

import dataclasses
import json
import math

import pytest
import torch
from helpers.tiny_models import network_of, save_tiny_model, tiny_model

from fb_core.conditioning import decode_in_chunks, split
from fb_core.data.training.sequences import PoolConfig
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.flow import at_time, velocity
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.training.kept_batches import KeptBatches, log_at_latents
from fb_core.training.recipe import dit_stage
from fb_core.training.run.loop import Run
from method_configs.evaluations.designs import command as design_evaluation
from method_configs.evaluations.designs.command import ALL, Designs, DesignTrainings, base_recipe, designs_of, windows
from method_configs.evaluations.designs.stages import LEAST_TIME, DepthTaughtStage, PredictsData
from method_configs.evaluations.designs.task import DesignTask, asked_rooms, beside, evaluate

TINY = DiTConfig(heads=2, head_dim=16, depth=1, text_width=0)
TASK = DesignTask(rooms=2, views=4, known=2, times=2, steps=2)


def tiny_base():
    base = base_recipe()
    return dataclasses.replace(
        base,
        dit=TINY,
        pool=PoolConfig(rooms=2, views=6, image_size=32, supersample=1, renewed_per_step=0),
        dit_loop=dataclasses.replace(base.dit_loop, steps=2, warmup_steps=1),
        dit_loss=dataclasses.replace(base.dit_loss, batch=2, task=dataclasses.replace(base.dit_loss.task, views=4)),
        engine=dataclasses.replace(base.engine, precision="float32"),
    )


@pytest.fixture(scope="module")
def vaes(tmp_path_factory):
    model = tiny_model(tmp_path_factory.mktemp("model"))
    return {"image_vae": model.image_vae, "raymap_vae": model.raymap_vae}


@pytest.fixture(scope="module")
def rooms(vaes):
    return asked_rooms(TASK, **vaes, size=32, patch=2)


@pytest.fixture(scope="module")
def trainings(tmp_path_factory):
    """As the command makes them, with a tiny base."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(design_evaluation, "base_recipe", tiny_base)
        yield DesignTrainings(tmp_path_factory.mktemp("designs"), 3, tiny_model(tmp_path_factory.mktemp("same")), TASK)


def stage_of(trainings, name):
    design = designs_of(tiny_base())[name]
    return trainings.stage_of(design, trainings.batches_of(design.recipe))


def test_a_network_that_knows_the_data_has_the_true_velocity_at_every_time_and_no_loss(trainings, monkeypatch):
    network = PredictsData(TINY)
    data, noise = torch.randn(2, 8, 4, 32, 4, 4, dtype=torch.float64)
    told = torch.zeros(8, 4, 34, 4, 4, dtype=torch.float64)
    monkeypatch.setattr(network, "data", lambda *_: data)
    times = torch.tensor([LEAST_TIME, 0.06, 0.1, 0.3, 0.5, 0.9, 0.999, 1.0], dtype=torch.float64)
    got = network(torch.cat([at_time(data, noise, times), told], dim=2), times)
    assert torch.allclose(got, velocity(data, noise), atol=1e-12)

    stage = stage_of(trainings, "predicts-data")
    drawn = stage.draw(0, range(2))
    drawn = dataclasses.replace(drawn, times=torch.tensor([0.01, 0.7]))
    clean = stage.encoded(0, range(2)).data
    state = at_time(clean, clean + drawn.velocity, drawn.times)
    drawn = dataclasses.replace(drawn, inputs=torch.cat([state, drawn.inputs[:, :, 32:]], dim=2))
    monkeypatch.setattr(stage.network, "data", lambda *_: clean)
    assert float(stage.losses(drawn)["loss"]) < 1e-9
    monkeypatch.setattr(
        stage.network, "data", lambda *_: clean + 1
    )  # the error of the data, weighted as the velocity's
    expected = (1 / LEAST_TIME**2 + 1 / 0.7**2) / 2
    assert float(stage.losses(drawn)["image"]) == pytest.approx(expected, rel=1e-5)


def test_what_the_data_are_is_refused_where_known_tokens_are_apart():
    with pytest.raises(ValueError, match="expected known tokens joint, got apart"):
        PredictsData(dataclasses.replace(TINY, known_tokens="apart"))


def test_a_teacher_of_depth_leaves_nothing_but_what_was_learned(trainings):
    """Its head is no part of the averaged weights, and with weight 0 it changes no bit of them."""
    recipe = tiny_base()
    states = {}
    for name, weight in (("none", None), ("without weight", 0.0), ("taught", 10.0)):
        stage = stage_of(trainings, "base")
        taught = stage if weight is None else DepthTaughtStage(stage, weight=weight)
        if isinstance(taught, DepthTaughtStage) and weight:
            torch.nn.init.normal_(taught.critic.linear.weight)
        run = Run(taught, dataclasses.replace(recipe.dit_loop, clip=1e9), None)
        run.train()
        states[name] = run.averaged_state()
    plain = states["none"]
    assert all(state.keys() == plain.keys() == DiT(recipe.dit).state_dict().keys() for state in states.values())
    assert all(torch.equal(value, states["without weight"][name]) for name, value in plain.items())
    assert any(not torch.equal(value, states["taught"][name]) for name, value in plain.items())


def test_a_head_that_knows_the_depth_has_no_loss(trainings):
    stage = stage_of(trainings, "depth-head")
    drawn = stage.draw(0, range(2))
    assert drawn.log_distance.shape == (2, 4, 1, 4, 4) and float(drawn.log_distance.std()) > 0.05
    constant = drawn._replace(log_distance=torch.full_like(drawn.log_distance, 0.7))
    stage.critic.linear.bias.data.fill_(0.7)
    assert float(stage.losses(constant)["depth"].detach()) == pytest.approx(0, abs=1e-12)
    assert float(stage.losses(drawn)["depth"].detach()) == pytest.approx(
        float((drawn.log_distance - 0.7).square().mean()), rel=1e-5
    )


def test_a_token_s_depths_lie_where_its_latents_lie(trainings):
    stage = stage_of(trainings, "depth-head")
    stage.critic.linear.bias.data.copy_(torch.arange(4.0))
    said = stage.critic(torch.zeros(1, 3 * 2 * 2, TINY.width), 3, 2)
    assert torch.equal(said[0, 2, 0], torch.tensor([[0.0, 1, 0, 1], [2, 3, 2, 3], [0, 1, 0, 1], [2, 3, 2, 3]]))
    distance = torch.ones(1, 2, 1, 16, 24)
    distance[..., 8:, :8] = math.e**2
    assert torch.allclose(log_at_latents(distance)[0, 1, 0], torch.tensor([[0.0, 0, 0], [2, 0, 0]]))


def test_all_designs_learn_from_the_same_batches(trainings):
    """Those of the same views and batch size see the same latents, masks and noise; a guess changes only what is
    told.
    """
    designs = designs_of(tiny_base())
    alike = [
        name
        for name, design in designs.items()
        if design.recipe.dit_loss.draws == 1 and design.recipe.dit_loss.pure_noise == 0
    ]
    alike = [name for name in alike if name not in ("more-views", "larger-batch")]
    assert len(alike) >= 9
    base = stage_of(trainings, "base").draw(1, range(2))
    for name in alike:
        stage = stage_of(trainings, name)
        drawn = getattr(stage, "inner", stage).draw(1, range(2))
        assert torch.equal(drawn.velocity, base.velocity) and torch.equal(drawn.times, base.times), name
        assert torch.equal(drawn.inputs[:, :, :32], base.inputs[:, :, :32]), name
        told = torch.equal(drawn.inputs, base.inputs)
        assert told or name == "guesses", name


def test_kept_batches_are_those_of_the_training_and_come_round_again(trainings, vaes):
    recipe, rows = tiny_base(), range(2)
    batches, fresh = trainings.batches_of(recipe), dit_stage(recipe, **vaes)
    for step in (0, 2):
        truth, held = fresh.encode(fresh.sequences(step, rows), step, rows), batches.get(step).encoded
        assert torch.allclose(held.data, truth.data, atol=2e-3, rtol=1e-3)
        assert torch.allclose(held.conditioning.channels, truth.conditioning.channels, atol=2e-3, rtol=1e-3)
        assert torch.equal(held.data, batches.get(step + batches.count).encoded.data)


def test_batches_are_made_once_and_never_mistaken_for_others(vaes, tmp_path, monkeypatch):
    def batches(seed=0, data="rooms", views=4):
        base = tiny_base()
        loss = dataclasses.replace(base.dit_loss, task=dataclasses.replace(base.dit_loss.task, views=views))
        framed = dataclasses.replace(base, seed=seed, dit=dataclasses.replace(TINY, ray_frames=True), dit_loss=loss)
        return KeptBatches(dit_stage(framed, **vaes), tmp_path, count=2, data=data)

    def nothing_new(*_):
        raise AssertionError("made again")

    batches().make(100)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 2
    again = batches()
    monkeypatch.setattr(again.stage, "sequences", nothing_new)
    again.make(100)
    assert again.get(1).encoded.data.shape == (2, 4, 32, 4, 4)
    for other in (batches(seed=1), batches(data="other rooms"), batches(views=3)):
        monkeypatch.setattr(other.stage, "sequences", nothing_new)
        with pytest.raises(AssertionError, match="made again"):
            other.get(0)
    with pytest.raises(ValueError, match="expected a stage whose network attends in ray frames"):
        KeptBatches(dit_stage(tiny_base(), **vaes), tmp_path, count=2, data="rooms")


def test_a_part_of_a_kept_batch_is_refused(trainings):
    with pytest.raises(ValueError, match=r"expected all rows at once, range\(0, 2\), got range\(0, 1\)"):
        stage_of(trainings, "base").draw(0, range(1))


class Oracle(DiT):
    """Knows the velocity of the rooms; of the known views it says nonsense, which must count nowhere."""

    def velocity(self, rooms):
        self.rooms = rooms
        return self

    def forward(self, sequence, time, text=None, index=None, facts=None):
        wrong = torch.zeros_like(sequence[:, :, :32])
        wrong[:, : TASK.known] = 100
        return self.rooms.noise - self.rooms.data + wrong


def test_a_network_that_knows_all_has_no_loss_and_the_autoencoder_s_error_alone(rooms, vaes):
    scores = evaluate(Oracle(TINY).velocity(rooms), rooms, TASK, image_vae=vaes["image_vae"])
    decoded = decode_in_chunks(vaes["image_vae"], split(rooms.data)[0][:, TASK.known :].flatten(0, 1))
    best = float(psnr(decoded, rooms.hidden.flatten(0, 1)).mean())
    assert scores["val"] == pytest.approx(0, abs=1e-10)
    assert scores["psnr_sample"] == pytest.approx(best, abs=1e-3) == scores["psnr_one_step"]
    assert scores["edges_sample"] == pytest.approx(scores["edges_one_step"], abs=1e-4)


def test_a_network_that_answers_nothing_has_the_velocity_s_own_size_as_loss(rooms, vaes):
    still = DiT(TINY).initialize(torch.Generator().manual_seed(0))
    wanted = split(velocity(rooms.data, rooms.noise))[0][:, TASK.known :]
    assert evaluate(still, rooms, TASK, image_vae=vaes["image_vae"])["val"] == pytest.approx(
        float(wanted.square().mean()), rel=1e-5
    )


def test_a_told_guess_is_told_to_unknown_views_alone(rooms):
    plain, guessed = rooms.conditioning, rooms.guessed
    assert torch.equal(plain.channels[:, : TASK.known], guessed.channels[:, : TASK.known])
    assert float(plain.image_known[:, TASK.known :].max()) == 0 < float(guessed.image_known[:, TASK.known :].max()) < 1
    assert torch.equal(plain.rays_known, guessed.rays_known) and torch.equal(plain.frames, guessed.frames)
    apart = dataclasses.replace(TINY, known_tokens="apart")
    assert torch.equal(plain.facts(apart).known, guessed.facts(apart).known) and bool(
        plain.facts(apart).known[:, : TASK.known].all()
    )


def test_a_difference_is_paired_by_seed():
    assert beside([3.0, 5.0], [1.0, 4.0]) == (1.5, 0.5)
    mean, half = beside([2.0, 4.0, 6.0], [1.0, 2.0, 3.0])
    assert mean == 2 and half == pytest.approx(4.302653 / 3**0.5, rel=1e-6)
    assert math.isnan(beside([1.0], [0.0])[1])


def test_losses_on_the_way_are_means_over_tenths():
    log = [{"step": step, "loss": float(step), "image": 1.0, "other": 2.0} for step in range(1, 21)]
    told = windows(log)
    assert [row["step"] for row in told] == list(range(2, 21, 2)) and told[0] == {"step": 2, "loss": 1.5, "image": 1.0}


def test_every_design_is_one_change_away_from_the_base():
    base = base_recipe()
    for name, design in designs_of(base).items():
        ours, theirs = (dataclasses.asdict(recipe) | {"name": ""} for recipe in (design.recipe, base))
        changes = _changes(ours, theirs) + [design.predicts_data, design.depth].count(True)
        assert changes == {"base": 0, "apart-4-draws": 2}.get(name, 1), name
    assert {*ALL} <= {*designs_of(base)}


def _changes(ours, theirs):
    if isinstance(ours, dict):
        return sum(_changes(value, theirs[name]) for name, value in ours.items())
    return int(ours != theirs)


def test_designs_are_trained_once_and_measured_once(tmp_path, monkeypatch):
    monkeypatch.setattr(design_evaluation, "base_recipe", tiny_base)
    monkeypatch.setattr(
        "method_configs.evaluations.designs.task.DesignTask", lambda rooms: dataclasses.replace(TASK, rooms=rooms)
    )
    names = ("guesses", "apart-4-draws", "predicts-data", "depth-head")
    options = {
        "output": tmp_path / "out",
        "model": save_tiny_model(tmp_path / "model"),
        "steps": 2,
        "batches": 2,
        "rooms": 1,
    }
    Designs(**options, designs=names, seeds=(0, 1), json=tmp_path / "first.json").run()
    monkeypatch.setattr(Run, "train", None)
    monkeypatch.setattr(KeptBatches, "get", None)
    Designs(**options, designs=names, seeds=(0, 1), json=tmp_path / "again.json").run()
    first, again = (json.loads((tmp_path / name).read_text())["rows"] for name in ("first.json", "again.json"))
    assert first == again
    rows = {
        part: {row["design"]: row for row in first if row["part"] == part} for part in ("designs", "beside the base")
    }
    assert [*rows["designs"]] == ["base", *names, "guesses, none told"] and [*rows["beside the base"]] == [
        *rows["designs"]
    ][1:]
    for name, row in rows["beside the base"].items():
        for metric in ("psnr_sample", "psnr_one_step", "edges_sample", "edges_one_step", "val"):
            gain = rows["designs"][name][metric] - rows["designs"]["base"][metric]
            assert row[f"{metric}_gain"] == pytest.approx(gain, abs=1e-6) and row[f"{metric}_spread"] >= 0
        assert row["cpu_seconds_per_step_ratio"] > 0
    assert len([row for row in first if row["part"] == "losses"]) == 2 * 2 * (1 + len(names))


def test_a_training_is_not_gone_on_with_under_other_settings(tmp_path, monkeypatch):
    monkeypatch.setattr(design_evaluation, "base_recipe", tiny_base)
    tiny, design = tiny_model(tmp_path), designs_of(tiny_base())["base"]
    first = DesignTrainings(tmp_path / "out", 2, tiny, TASK).measured(design)
    with pytest.raises(
        ValueError, match="base-2-0 holds a training with another batches; choose another output folder"
    ):
        DesignTrainings(tmp_path / "out", 1, tiny, TASK).measured(design)
    other_question = DesignTrainings(tmp_path / "out", 2, tiny, dataclasses.replace(TASK, rooms=1)).measured(design)
    assert other_question["losses"] == first["losses"] and other_question["val"] != first["val"]


def test_a_design_that_does_not_exist_is_refused_by_name():
    with pytest.raises(ValueError, match=r"expected some of base, ray-frames, .*, got taller"):
        Designs(designs=("taller",)).run()


def test_the_network_inside_is_the_product_s(trainings):
    """A design that predicts the data has the base's parameters, and answers its last layer's data as the base answers
    its velocity.
    """
    plain, other = network_of(TINY), PredictsData(TINY).double().eval()
    other.load_state_dict(plain.state_dict())
    sequence, time = torch.randn(1, 2, 66, 4, 4, dtype=torch.float64), torch.tensor([0.4], dtype=torch.float64)
    assert torch.equal(other.data(sequence, time), plain(sequence, time))
