"""Laws of the loop on one process: parts of a batch, kills at any step, checkpoints, full disks, and what may not
change anything.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers.tiny_training import LOOP, TOY, TinyStage, losses_of, run_in

from fb_core.data.training.named_data import TrainingData
from fb_core.networks.transformer.dit import DiT
from fb_core.training import dry_run
from fb_core.training.recipe import make_sheet, make_stage
from fb_core.training.run.checkpoints import read_state
from fb_core.training.run.distributed import ALONE
from fb_core.training.run.loop import Run
from fb_core.training.run.options import EngineConfig, LoopConfig
from fb_core.training.run.progress_log import ProgressLog
from fb_core.training.run.stage import Stage
from method_configs.commands.train_options import TrainOptions

ROOT = Path(__file__).resolve().parents[4]
SHORT = dataclasses.replace(LOOP, steps=6, save_every=2)


def weights(run: Run) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in run.stage.network.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run = Run(TinyStage(), SHORT, tmp_path_factory.mktemp("whole"))
    run.train()
    return run


@pytest.mark.parametrize("killed_after", [1, 2, 3, 4, 5])
def test_killed_at_any_step_it_repeats_bit_for_bit(whole, tmp_path, killed_after):
    def kill(done, of, losses):
        if done == killed_after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Run(TinyStage(), SHORT, tmp_path).train(on_progress=kill)
    resumed = Run(TinyStage(), SHORT, tmp_path)
    assert resumed.step == (killed_after - 1) // 2 * 2  # the last even step whose checkpoint was written
    resumed.train()
    assert losses_of(tmp_path) == losses_of(whole.folder)
    assert same(weights(resumed), weights(whole)) and same(resumed.averaged_state(), whole.averaged_state())


@pytest.mark.parametrize("changed", [{"accumulate": 2}, {"accumulate": 4}, {"recompute": True}])
def test_parts_and_recomputed_activations_change_rounding_only(whole, tmp_path, changed):
    run = run_with(tmp_path, **changed)
    assert losses_of(tmp_path) == pytest.approx(losses_of(whole.folder), abs=2e-6)
    for name, value in weights(whole).items():
        assert torch.allclose(weights(run)[name], value, atol=1e-5), name


def test_recomputed_blocks_run_twice():
    calls = []
    for recompute in (False, True):
        run = Run(TinyStage(), SHORT, None, engine=EngineConfig(recompute=recompute))
        for block in run.stage.network.blocks:
            block.attn1.register_forward_hook(lambda *_, recompute=recompute: calls.append(recompute))
        run.train(at_most=1)
    assert calls.count(True) == 2 * calls.count(False) == 4


def run_with(folder: Path, *, config: LoopConfig = SHORT, on_sheet=None, **engine) -> Run:
    run = Run(TinyStage(), config, folder, engine=EngineConfig(**engine), on_sheet=on_sheet)
    run.train()
    return run


def test_sheets_and_data_made_ahead_change_nothing(whole, tmp_path):
    drawn = []

    def sheet(path, state):
        torch.randn(3)  # a sheet may even use the global generator
        drawn.append((path.name, state["proj_out_2.weight"].clone()))
        return {"val": 1 / len(drawn)}

    run = run_with(tmp_path, on_sheet=sheet, sheet_every=3, draw_ahead=True)
    assert [name for name, _ in drawn] == ["000003.png", "000006.png"]
    assert torch.equal(drawn[-1][1], whole.averaged_state()["proj_out_2.weight"])
    assert losses_of(tmp_path) == losses_of(whole.folder) and same(weights(run), weights(whole))
    assert validation_of(tmp_path) == [{"step": 3, "val": 1.0}, {"step": 6, "val": 0.5}]


def validation_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "validation.jsonl").read_text().splitlines()]


def test_validation_of_steps_that_are_done_again_is_forgotten(tmp_path):
    log = ProgressLog(tmp_path, "tiny", from_step=0)
    for step in (2, 4):
        log.add_validation(step, {"val": float(step)})
    ProgressLog(tmp_path, "tiny", from_step=3)
    assert validation_of(tmp_path) == [{"step": 2, "val": 2.0}]


def test_the_last_checkpoints_are_kept_and_any_of_them_can_be_gone_on_from(whole, tmp_path):
    run_with(tmp_path, keep=3)
    steps = {path.name: torch.load(path, weights_only=True)["step"] for path in tmp_path.glob("*.pt")}
    assert steps == {"checkpoint.pt": 6, "checkpoint-000004.pt": 4, "checkpoint-000002.pt": 2}
    (tmp_path / "checkpoint.pt").unlink()
    resumed = Run(TinyStage(), SHORT, tmp_path)
    assert resumed.step == 4
    resumed.train()
    assert same(weights(resumed), weights(whole)) and losses_of(tmp_path) == losses_of(whole.folder)


def test_a_full_disk_leaves_the_checkpoint_whole(tmp_path, monkeypatch):
    run = Run(TinyStage(), SHORT, tmp_path)
    run.train(at_most=2)
    before = (tmp_path / "checkpoint.pt").read_bytes()

    def full(state, file):
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        run.train()
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert sorted(path.name for path in tmp_path.glob("checkpoint*")) == ["checkpoint.pt"]


def test_a_damaged_checkpoint_is_named_with_the_one_before_it(tmp_path):
    run_with(tmp_path)
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(
        ValueError, match=r"checkpoint.pt is damaged .*; delete it to go on from .*checkpoint-000004.pt"
    ):
        Run(TinyStage(), SHORT, tmp_path)


def test_a_checkpoint_of_another_preset_batch_or_optimizer_is_refused(tmp_path):
    run_in(tmp_path, ALONE).train(at_most=1)
    with pytest.raises(ValueError, match="holds preset 'tiny', expected 'other'"):
        Run(TinyStage(), LOOP, tmp_path, preset="other")
    larger = TinyStage()
    larger.batch = 8
    with pytest.raises(ValueError, match="holds batch 4, expected 8"):
        Run(larger, LOOP, tmp_path)
    with pytest.raises(ValueError, match="made with another optimizer than 'muon'"):
        Run(TinyStage(), dataclasses.replace(LOOP, optimizer="muon"), tmp_path)


def test_checkpoints_from_before_there_were_processes_can_be_resumed(whole, tmp_path):
    """They hold one optimiser's state instead of a list, and neither preset nor batch."""
    run_with(tmp_path, config=dataclasses.replace(SHORT, cooldown=0.0), keep=1)
    expected = Run(TinyStage(), SHORT, tmp_path)
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    (state["optimizer"],) = state["optimizer"]
    old = tmp_path / "old"
    old.mkdir()
    torch.save(
        {name: state[name] for name in state if name not in ("preset", "batch", "waited")}, old / "checkpoint.pt"
    )
    longer = dataclasses.replace(SHORT, steps=8)
    resumed = [Run(TinyStage(), longer, folder, preset="any") for folder in (expected.folder, old)]
    for run in resumed:
        run.train()
    assert same(*(weights(run) for run in resumed))


def test_bfloat16_keeps_weights_and_their_average_in_float32(whole, tmp_path):
    run = run_with(tmp_path, precision="bfloat16")
    assert {value.dtype for value in run.averaged_state().values()} == {torch.float32}
    assert losses_of(tmp_path) != losses_of(whole.folder)
    assert losses_of(tmp_path) == pytest.approx(losses_of(whole.folder), rel=0.02)


def test_muon_takes_the_matrices_of_the_blocks_and_learns(tmp_path):
    run = run_with(tmp_path, config=dataclasses.replace(LOOP, optimizer="muon"))
    _, muon = run.optimizers
    taken = {id(parameter) for parameters in muon.param_groups for parameter in parameters["params"]}
    named = {name for name, parameter in run.stage.network.named_parameters() if id(parameter) in taken}
    assert named == {
        name
        for name, p in run.stage.network.named_parameters()
        if name.startswith("transformer_blocks.") and p.ndim == 2
    }
    assert sum(losses_of(tmp_path)[-4:]) < 0.9 * sum(losses_of(tmp_path)[:4])
    resumed = Run(TinyStage(), dataclasses.replace(LOOP, optimizer="muon"), tmp_path)
    assert resumed.step == LOOP.steps


class WithCritic(Stage):
    """A network that wants to be 1 and a critic that wants to be 2."""

    name, batch = "pair", 1

    def __init__(self):
        self.network, self.critic = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)

    def draw(self, step, rows):
        return torch.ones(1, 1)

    def losses(self, drawn):
        network, critic = (self.network(drawn) - 1).square().mean(), (self.critic(drawn) - 2).square().mean()
        return {"loss": network + critic, "network": network, "critic": critic}


def test_a_critic_is_optimised_and_resumed_beside_the_network(tmp_path):
    loop = LoopConfig(steps=200, learning_rate=0.1, weight_decay=0.0, save_every=50)
    run = Run(WithCritic(), loop, tmp_path)
    run.train(at_most=77)
    resumed = Run(WithCritic(), loop, tmp_path)
    assert torch.equal(resumed.stage.critic.weight, run.stage.critic.weight)
    resumed.train()
    assert resumed.smoothed["network"] < 0.1 and float(
        resumed.stage.critic(torch.ones(1, 1)).detach()
    ) == pytest.approx(2.0, abs=0.1)
    assert set(resumed.averaged_state()) == {"weight", "bias"}


def test_a_signal_saves_and_ends_with_a_message_and_its_number(tmp_path, monkeypatch, caplog):
    from method_configs import presets as ablations
    from method_configs.commands import training as training_command

    monkeypatch.setitem(ablations.PRESETS, "toy", TOY)

    def progress(stage, group):
        return contextlib.nullcontext(lambda done, of, losses: os.kill(os.getpid(), signal.SIGTERM))

    monkeypatch.setattr(training_command, "progress_shown", progress)
    with caplog.at_level("INFO"), pytest.raises(SystemExit) as stopped:
        training_command.train_preset("toy", tmp_path, TrainOptions(device="cpu", stage="raymap-vae"))
    assert stopped.value.code == 128 + signal.SIGTERM
    assert "raymap-vae stopped by signal 15 at step 1 of 4, which is saved" in caplog.text
    assert torch.load(tmp_path / "raymap-vae" / "checkpoint.pt", weights_only=True)["step"] == 1
    assert not (tmp_path / "raymap-vae" / "spread.json").exists()


HEAVY = (
    "kornia cv2 nerfstudio OpenImageIO matplotlib tyro rich scipy trimesh pyvista transformers torchvision "
    "gsplat viser tensorboard".split()
)


def test_training_needs_torch_and_little_else(tmp_path):
    """In a process where all else cannot be imported: a whole training of a small preset, with sheets and TensorBoard
    asked for.
    """
    script = f"""
import sys
for name in {[*HEAVY, "tensorboard"]!r}:
    sys.modules[name] = None
sys.path.insert(0, {str(ROOT / "tests")!r})
from helpers.tiny_training import TOY
from method_configs import presets, train
presets.PRESETS["toy"] = TOY
options = ["--device", "cpu", "--sheet-every", "2", "--tensorboard", "--no-half"]
train.main(["toy", "--output", {str(tmp_path)!r}, *options])
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "no loss.png, because matplotlib is not installed" in done.stderr and "no 000002.png" in done.stderr
    assert "no TensorBoard files" in done.stderr and "dit: step 4 of 4" in done.stderr
    assert json.loads((tmp_path / "model" / "config.json").read_text())["info"]["preset"] == "toy"


def test_the_entrance_without_tyro_has_the_options_of_the_command():
    """Both give the same options for the same words, whatever is asked for."""
    import tyro

    from method_configs.commands.command_line import train as command
    from method_configs.train import options_of, parser

    own = [field.name for field in dataclasses.fields(TrainOptions) if field.name != "data"]
    names = [*own, *(field.name for field in dataclasses.fields(TrainingData))]
    words = {"stage": "dit", "precision": "auto", "steps": "3", "minutes": "0.5", "accumulate": "2", "keep": "4"}
    words |= {"sheet_every": "7"}
    given = ["toy", "--output", "there"]
    for name in names:
        default = getattr(TrainOptions(), name, False) if name in own else getattr(TrainingData(), name)
        flag = name.replace("_", "-")
        given += [f"--{'no-' if default else ''}{flag}"] if isinstance(default, bool) else [f"--{flag}"]
        given += [] if isinstance(default, bool) else [words.get(name, "place")]
    parsed = options_of(parser().parse_args(given))
    read: list[object] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("method_configs.commands.training.train_preset", lambda *told: read.extend(told))
        tyro.extras.subcommand_cli_from_dict({"train": command, "other": command}, args=["train", *given])
    assert read == ["toy", Path("there"), parsed]
    assert (parsed.steps, parsed.half, parsed.stage, parsed.data.meshes) == (3, False, "dit", Path("place"))
    defaults = TrainOptions()
    assert all(getattr(parsed, name) != getattr(defaults, name) for name in own)
    assert options_of(parser().parse_args(["toy", "--output", "there"])) == defaults


def test_a_dry_run_tells_what_a_stage_costs_and_writes_nothing(tmp_path, monkeypatch, caplog):
    from method_configs import presets as ablations
    from method_configs.commands import training as training_command

    monkeypatch.setitem(ablations.PRESETS, "toy", TOY)
    monkeypatch.setattr(training_command, "measure", partial(dry_run.measure, seconds=0.1))
    with caplog.at_level("INFO"):
        options = TrainOptions(device="cpu", stage="dit", dry_run=True)
        assert training_command.train_preset("toy", tmp_path / "new", options) is None
    assert "dit: parameters network" in caplog.text and "steps per second" in caplog.text
    assert not (tmp_path / "new").exists()


def test_the_cost_of_a_stage_counts_what_can_be_counted_by_hand():
    cost = dry_run.measure(TOY, "dit", device=torch.device("cpu"), engine=EngineConfig(), seconds=0.1)
    network = DiT(TOY.dit)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert cost.parameters["network"] == count and set(cost.parameters) == {"network", "image_vae", "raymap_vae"}
    assert cost.weight_bytes == 4 * (2 * count + cost.parameters["image_vae"] + cost.parameters["raymap_vae"])
    assert cost.step_bytes >= 4 * 3 * count  # gradients and two moments, beside activations
    tokens = TOY.dit_loss.batch * TOY.dit_loss.task.views
    in_blocks = sum(
        p.numel() for name, p in network.named_parameters() if p.ndim == 2 and ("attn" in name or "ff" in name)
    )
    assert (
        cost.flops > 6 * in_blocks * tokens
        and cost.steps_per_second > 0
        and 0 < cost.data_share < 1
        and cost.utilisation > 0
    )


@pytest.mark.parametrize("stage", ["image-vae", "raymap-vae", "dit"])
def test_sheets_show_an_unseen_room(tmp_path, stage):
    from PIL import Image

    task, _ = make_stage(TOY, stage, None)
    measured = make_sheet(TOY, task)(tmp_path / "000003.png", task.network.state_dict())
    width, height = Image.open(tmp_path / "000003.png").size
    assert width > 300 and height > 200 and task.network.training
    assert list(measured) == (["val"] if stage == "dit" else ["mean_error"]) and all(
        0 < value < 10 for value in measured.values()
    )


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04" + bytes(64)])
def test_what_is_no_checkpoint_is_one_sentence(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint.pt is damaged \(.*\); restore it"):
        read_state(path)


@pytest.mark.parametrize("content", [[1, 2], {}, {"step": "7"}, {"step": True}])
def test_a_file_of_something_else_is_one_sentence(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    torch.save(content, path)
    for mapped in (False, True):
        with pytest.raises(ValueError, match="is no checkpoint of a training: it tells no step"):
            read_state(path, mapped=mapped)
