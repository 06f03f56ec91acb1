"""Going on from a checkpoint: another capture, options that change shapes, a step that is not there, a folder that
another run has.

Each is one sentence before the run has a folder; what is right goes on. The checkpoint is a real one of a run that did
not train.
"""

from __future__ import annotations

import copy
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.plugin.bad_input import Started, config_for, edit
from helpers.plugin.going_on import STEP, options, refusal
from helpers.processes.ns_train import ns_train
from helpers.tiny_models import save_tiny_model

from fb_core.files.faults import Refused
from fb_nerfstudio.checks import run_folder
from fb_nerfstudio.checks.going_on import CaptureIdentity, parsed
from fb_nerfstudio.datamanager import FillerbusterDataManager
from fb_nerfstudio.trainer import FillerbusterTrainer, FillerbusterTrainerConfig


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("model") / "model")


@pytest.fixture(scope="module")
def run(_tiny_capture_original: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with a checkpoint of step 7."""
    config = options(_tiny_capture_original, model, tmp_path_factory.mktemp("run"), "first")
    config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    config.save_config()
    trainer: Any = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.save_checkpoint(STEP)
    run_folder.release(config.get_base_dir())  # as its process would by ending
    return config.get_base_dir()


@pytest.fixture
def again(run: Path, model: Path, tiny_capture: Path, tmp_path: Path) -> FillerbusterTrainerConfig:
    """Options that go on from it, with a copy of its capture in another folder."""
    config = options(tiny_capture, model, tmp_path / "out", "second")
    config.load_dir = run / "nerfstudio_models"
    return config


@pytest.fixture
def only_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is accepted gets as far as building the pipeline, and no further."""

    def start(self, *_):
        raise Started

    monkeypatch.setattr(FillerbusterTrainer, "setup", start)


# ---- another capture -------------------------------------------------------------------------------------------------


def reorder(content: dict) -> None:
    content["frames"][1]["transform_matrix"], content["frames"][2]["transform_matrix"] = (
        content["frames"][2]["transform_matrix"],
        content["frames"][1]["transform_matrix"],
    )


def rename(folder: Path) -> None:
    (folder / "images" / "view_001.png").rename(folder / "images" / "view_001b.png")
    edit(folder, lambda content: content["frames"][1].update(file_path="images/view_001b.png"))


def lens(content: dict) -> None:
    for holder in (content, *content["frames"]):
        if "fl_x" in holder:
            holder["fl_x"] *= 1.1


OTHER_CAPTURES: dict[str, tuple[Callable[[Path], object], str]] = {
    "fewer photos": (
        lambda folder: edit(folder, lambda content: content["frames"].pop()),
        r"trained on \d photos, and here are \d",
    ),
    "another photo": (rename, "and here is images/view_001b.png"),
    "a camera moved": (lambda folder: edit(folder, reorder), "stands elsewhere than it did"),
    "another lens": (lambda folder: edit(folder, lens), "has another size or focal length"),
}


@pytest.mark.parametrize("kind", OTHER_CAPTURES)
def test_a_checkpoint_knows_its_capture(kind: str, again: FillerbusterTrainerConfig, only_starts):
    change, expected = OTHER_CAPTURES[kind]
    change(again.data)
    sentence = refusal(again)
    assert (
        re.search(expected, sentence)
        and "is of another capture than" in sentence
        and "--other-capture True" in sentence
    ), sentence


def test_options_of_the_dataparser_that_move_the_world_count_as_another_capture(
    again: FillerbusterTrainerConfig, only_starts
):
    again.pipeline.datamanager.dataparser.orientation_method = "none"
    again.pipeline.datamanager.dataparser.center_method = "none"
    assert "stands elsewhere than it did" in refusal(again)


@pytest.mark.parametrize("kind", ["a camera moved", "another lens"])
def test_who_insists_goes_on_with_another_capture(kind: str, again: FillerbusterTrainerConfig, only_starts):
    OTHER_CAPTURES[kind][0](again.data)
    again.other_capture = True
    with pytest.raises(Started):
        ns_train.main(again)


def test_a_copy_of_the_capture_and_smaller_pictures_of_it_are_the_same(again: FillerbusterTrainerConfig, only_starts):
    for scale, factor in ((1.0, None), (0.5, None), (1.0, 2)):
        config = copy.deepcopy(again)
        config.timestamp = f"{scale} {factor}"
        config.pipeline.datamanager.camera_res_scale_factor, config.pipeline.datamanager.dataparser.downscale_factor = (
            scale,
            factor,
        )
        with pytest.raises(Started):
            ns_train.main(config)


def test_checkpoints_that_know_no_capture_go_on(again: FillerbusterTrainerConfig, tmp_path: Path, only_starts):
    state = torch.load(again.load_dir / f"step-{STEP:09d}.ckpt", weights_only=True)
    del state["pipeline"]["datamanager._extra_state"]["capture"]
    again.load_dir = tmp_path / "older"
    again.load_dir.mkdir()
    torch.save(state, again.load_dir / "step-000000001.ckpt")
    with pytest.raises(Started):
        ns_train.main(again)


def test_what_a_checkpoint_knows_survives_being_saved(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out").pipeline.datamanager
    config.data = tiny_capture
    manager: FillerbusterDataManager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    torch.save(manager.get_extra_state(), tmp_path / "state.pt")
    known = CaptureIdentity.from_state(torch.load(tmp_path / "state.pt", weights_only=True)["capture"])
    assert CaptureIdentity.of(parsed(config)).difference(known) is None
    assert known.names[0] == "images/view_000.png" and len(known.names) == len(manager.train_dataset)


# ---- shapes, steps ---------------------------------------------------------------------------------------------------


def set_model(**values: Any) -> Callable[[FillerbusterTrainerConfig], None]:
    def change(config: FillerbusterTrainerConfig) -> None:
        for name, value in values.items():
            setattr(config.pipeline.model, name, value)

    return change


def no_camera_optimizer(config: FillerbusterTrainerConfig) -> None:
    config.pipeline.model.camera_optimizer.mode = "off"  # type: ignore[attr-defined]


def fewer_photos_insisted(config: FillerbusterTrainerConfig) -> None:
    edit(config.data, lambda content: content["frames"].pop())  # type: ignore[arg-type]
    config.other_capture = True


OTHER_SHAPES: dict[str, tuple[Callable[[FillerbusterTrainerConfig], object], str]] = {
    "sh degree up": (
        set_model(sh_degree=3),
        "has colours of degree 1, got sh-degree 3; give --pipeline.model.sh-degree 1",
    ),
    "sh degree 0": (set_model(sh_degree=0), "has colours of degree 1, got sh-degree 0"),
    "camera optimizer off": (no_camera_optimizer, "was trained with a camera optimizer, which is off here"),
    "bilateral grid off": (set_model(use_bilateral_grid=False), "was trained with bilateral grids, which are off here"),
    "another grid": (
        set_model(grid_shape=(8, 4, 2)),
        r"grids of 4 4 2, got 8 4 2; give --pipeline.model.grid-shape 4 4 2",
    ),
    "fewer photos": (fewer_photos_insisted, "was trained with a camera optimizer for 6 photos, here are 5"),
    "a step that is not there": (
        lambda config: setattr(config, "load_step", 3),
        "load_step 3: .* but of 7; leave it out",
    ),
}


@pytest.mark.parametrize("kind", OTHER_SHAPES)
def test_options_that_do_not_fit_the_checkpoint_are_refused(kind: str, again: FillerbusterTrainerConfig, only_starts):
    change, expected = OTHER_SHAPES[kind]
    change(again)
    sentence = refusal(again)
    assert re.search(expected, sentence), sentence


@pytest.mark.parametrize(
    "content", [b"", b"no checkpoint", {"step": 3}, {"step": 3, "pipeline": {}, "optimizers": {}, "scalers": {}}]
)
def test_files_that_are_no_checkpoint_are_refused(
    content: Any, again: FillerbusterTrainerConfig, tmp_path: Path, only_starts
):
    path = tmp_path / "given.ckpt"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    again.load_dir, again.load_checkpoint = None, path
    assert re.search("not readable as plain values|is none of ns-train|holds no Gaussians", refusal(again))


def loaded(config: FillerbusterTrainerConfig) -> Any:
    """The trainer once it has read its checkpoint."""
    config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    trainer: Any = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def test_more_may_be_trained_than_before_and_foreign_files_lie_beside(
    run: Path, model: Path, _tiny_capture_original: Path, tmp_path: Path, capsys
):
    """A run without corrections goes on with them; nerfstudio would read the step from any file's name."""
    first = options(_tiny_capture_original, model, tmp_path, "plain")
    first.pipeline.datamanager.data = first.data
    set_model(use_bilateral_grid=False)(first)
    no_camera_optimizer(first)
    trainer = loaded(first)
    trainer.save_checkpoint(STEP)
    (trainer.checkpoint_dir / "notes.txt").touch()
    second = options(_tiny_capture_original, model, tmp_path, "more")
    second.load_dir, second.pipeline.model.max_gaussians = trainer.checkpoint_dir, 20  # type: ignore[attr-defined]
    capsys.readouterr()
    assert loaded(second)._start_step == STEP + 1
    said = " ".join(capsys.readouterr().out.split())
    assert "has 60 Gaussians, more than --pipeline.model.max-gaussians 20: all of them stay, and none is added" in said


def test_what_fails_only_while_it_loads_leaves_no_folder(
    again: FillerbusterTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    """A safety net: shapes that nobody has thought of."""
    monkeypatch.setattr("fb_nerfstudio.trainer.check_shapes", lambda *_: None)
    set_model(sh_degree=3)(again)
    assert "does not fit the options" in refusal(again)


# ---- a folder of one's own -------------------------------------------------------------------------------------------


def test_a_run_never_overwrites_another(again: FillerbusterTrainerConfig, run: Path, tmp_path: Path, only_starts):
    shutil.copytree(run, tmp_path / "out" / "tiny_capture" / "fillerbuster" / "second")
    there = sorted(path.relative_to(tmp_path) for path in (tmp_path / "out").rglob("*"))
    with pytest.raises(Refused, match="it holds another run, which is never overwritten; give another --timestamp"):
        ns_train.main(copy.deepcopy(again))
    assert there == sorted(path.relative_to(tmp_path) for path in (tmp_path / "out").rglob("*"))
    again.load_dir = tmp_path / "out" / "tiny_capture" / "fillerbuster" / "second" / "nerfstudio_models"
    with pytest.raises(Started):  # its own checkpoint
        ns_train.main(again)


def test_a_config_file_is_not_mixed_with_options_that_nerfstudio_ignores(
    run: Path, _tiny_capture_original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    command = ["ns-train", "fillerbuster", "--load-config", str(run / "config.yml")]
    for more, expected in (
        (["--timestamp", "new"], "ignores --timestamp; leave it alone"),
        ([], "it holds another run"),
    ):
        monkeypatch.setattr(sys, "argv", [*command, *more])
        with pytest.raises(Refused, match=expected):
            ns_train.entrypoint()
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*")}


CLAIMING = """
import pathlib, sys
from fb_nerfstudio.checks import run_folder
run_folder.claim(pathlib.Path(sys.argv[1]), goes_on_from=None, ours=False)
print("claimed", flush=True)
sys.stdin.read()
"""


def test_two_runs_never_share_a_folder(tmp_path: Path):
    """While a run trains nobody else gets its folder, though it has no checkpoint yet; once it has ended, or was
    killed, it is free.
    """
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    command = [sys.executable, "-c", CLAIMING, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as other:
        assert other.stdout is not None and other.stdout.readline() == "claimed\n"
        with pytest.raises(ValueError, match="another run trains there right now; give this one another --timestamp"):
            run_folder.claim(tmp_path / "run", goes_on_from=None, ours=False)
        other.kill()
    run_folder.claim(tmp_path / "run", goes_on_from=None, ours=False)


def test_runs_that_start_in_one_second_get_a_folder_each(again: FillerbusterTrainerConfig, only_starts):
    folders = set()
    for _ in range(2):
        config = copy.deepcopy(again)
        config.timestamp = "{timestamp}"
        with pytest.raises(Started):
            ns_train.main(config)
        folders.add(config.get_base_dir())
    assert len(folders) == 2
