"""A run's config.yml gives what nerfstudio's loader gives, and nothing that it names is executed or even imported."""

from __future__ import annotations

import copy
import importlib
import sys
from pathlib import Path

import pytest
import torch
import yaml
from helpers.folders.runs import generated_views, make_run
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.plugins.registry import discover_methods
from nerfstudio.utils.writer import EventName

from fb_nerfstudio.earlier_names import EARLIER_NAMES
from fb_nerfstudio.runs.run_config import ALLOWED, read_run_config
from fb_nerfstudio.trainer import FillerbusterTrainerConfig
from method_configs.commands import command_line as commands
from method_configs.splats import fillerbuster

OURS = {
    name: config
    for name, config in discover_methods()[0].items()
    if hasattr(getattr(config, "pipeline", None), "datamanager")
}
PYTHON = "!!python/"


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        commands.main([str(argument) for argument in arguments])
    told = capsys.readouterr().err.strip()
    assert stopped.value.code == 1 and "Traceback" not in told and "\n" not in told
    return told


@pytest.mark.parametrize("name", sorted(name for name in OURS if name.startswith(("fillerbuster", "nerfiller"))))
def test_options_of_every_method_are_read_as_by_nerfstudio(tmp_path: Path, name: str):
    config = copy.deepcopy(OURS[name])
    config.data = tmp_path / "capture with blanks"
    text = yaml.dump(config)
    (tmp_path / "config.yml").write_text(text)
    read = read_run_config(tmp_path / "config.yml")
    assert read == config == yaml.load(text, Loader=yaml.Loader) and yaml.dump(read) == text
    assert (
        type(read.data) is type(config.data)
        and read.pipeline.datamanager._target is config.pipeline.datamanager._target
    )


_APPLY = "tag:yaml.org,2002:python/object/apply:"


class ByName(yaml.Dumper):
    """Writes members of enumerations as Python 3.11.2 does."""


class ByValue(yaml.Dumper):
    """Writes them as later releases do."""


ByName.add_representer(
    EventName, lambda dumper, event: dumper.represent_sequence(f"{_APPLY}builtins.getattr", [EventName, event.name])
)
ByValue.add_representer(
    EventName,
    lambda dumper, event: dumper.represent_sequence(f"{_APPLY}nerfstudio.utils.writer.EventName", [event.value]),
)


@pytest.mark.parametrize("dumper", [ByName, ByValue])
def test_runs_of_every_release_of_python_are_read(tmp_path: Path, dumper: type[yaml.Dumper]):
    config = copy.deepcopy(OURS["fillerbuster"])
    text = yaml.dump(config, Dumper=dumper)
    assert ("builtins.getattr" in text) == (dumper is ByName) and config.logging.local_writer.stats_to_track
    (tmp_path / "config.yml").write_text(text)
    assert read_run_config(tmp_path / "config.yml") == config == yaml.load(text, Loader=yaml.Loader)


@pytest.mark.parametrize(
    "asked",
    [
        "[!!python/name:nerfstudio.utils.writer.EventName '', mro]",
        "[!!python/name:nerfstudio.utils.writer.EventName '', __init__]",
        "[!!python/name:nerfstudio.utils.writer.EventName '', [ITER_TRAIN_TIME]]",
        "[!!python/name:nerfstudio.utils.writer.EventName '']",
        "[!!python/name:torch.optim.adam.Adam '', step]",
        "[text, upper]",
    ],
)
def test_nothing_but_members_is_looked_up_by_name(tmp_path: Path, asked: str):
    text = yaml.dump(copy.deepcopy(OURS["fillerbuster"])) + f"extra: !!python/object/apply:builtins.getattr {asked}\n"
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(ValueError, match="names what is no part of a fillerbuster run; nothing of it was executed"):
        read_run_config(tmp_path / "config.yml")


@pytest.mark.parametrize("name", ["fillerbuster", "fillerbuster-masked"])
def test_runs_of_earlier_versions_open_under_todays_names(tmp_path: Path, name: str):
    """By our reader and by nerfstudio's own, which imports the modules that a config.yml names."""
    config = copy.deepcopy(OURS[name])
    text = yaml.dump(config)
    for earlier, today in EARLIER_NAMES.items():
        text = text.replace(f":{today}.", f":{earlier}.")
    assert text.count("fb_nerfstudio.completion_config.") and "fb_core" not in text
    (tmp_path / "config.yml").write_text(text)
    assert read_run_config(tmp_path / "config.yml") == config == yaml.load(text, Loader=yaml.Loader)


def test_earlier_names_lead_to_modules_that_are_there():
    for earlier, today in EARLIER_NAMES.items():
        assert importlib.import_module(earlier) is importlib.import_module(today)
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("fb_nerfstudio.no_such_module")


@pytest.mark.parametrize("parser", [ColmapDataParserConfig, BlenderDataParserConfig])
def test_other_readers_of_captures_are_part_of_a_run(tmp_path: Path, parser: type):
    config = copy.deepcopy(fillerbuster.config)
    config.pipeline.datamanager.dataparser = parser(data=tmp_path)
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    assert read_run_config(tmp_path / "config.yml") == config


def test_the_table_names_classes_that_are_there():
    for module, names in ALLOWED.items():
        assert all(isinstance(vars(importlib.import_module(module))[name], type) for name in names), module


def attacks(marker: Path) -> dict[str, str]:
    """Values that nerfstudio's loader would obey: each would leave a file, or import a module."""
    return {
        "a call": f"{PYTHON}object/apply:pathlib.Path.touch [{PYTHON}object/apply:pathlib.PosixPath [{marker}]]",
        "open": f"{PYTHON}object/apply:builtins.open [{marker}, w]",
        "a new object": f"{PYTHON}object/new:subprocess.Popen [[touch, {marker}]]",
        "a call with names": f"{PYTHON}object/apply:builtins.open\nargs: [{marker}]\nkwds: {{mode: w}}",
        "a function": f"{PYTHON}name:os.system ''",
        "a method of an allowed module": f"{PYTHON}name:nerfstudio.utils.writer.setup_event_writer ''",
        "something that an allowed module imports": f"{PYTHON}name:fb_nerfstudio.trainer.os ''",
        "an attribute of an allowed class": f"{PYTHON}name:fb_nerfstudio.trainer.FillerbusterTrainer.train ''",
        "a module": f"{PYTHON}module:hostile_module",
        "an import": f"{PYTHON}name:hostile_module.thing ''",
        "an object of another class": f"{PYTHON}object:hostile_module.thing {{}}",
        "a call of an allowed class": f"{PYTHON}object/apply:nerfstudio.utils.writer.LocalWriter [{{}}]",
        "a call of options": f"{PYTHON}object/apply:nerfstudio.configs.base_config.MachineConfig []",
        "an instance of no options": f"{PYTHON}object:nerfstudio.utils.writer.LocalWriter {{}}",
        "a reader that unpickles": f"{PYTHON}object:nerfstudio.data.dataparsers.minimal_dataparser."
        "MinimalDataParserConfig {data: x}",
        "a method replaced by a value": f"{PYTHON}object:nerfstudio.configs.base_config.MachineConfig {{__class__: 1}}",
        "a member that is none": f"{PYTHON}object/apply:nerfstudio.utils.writer.EventName [{{}}]",
        "a path of other things": f"{PYTHON}object/apply:pathlib.PosixPath [[{marker}]]",
        "an unknown tag": "!surprise {}",
    }


@pytest.mark.parametrize("name", attacks(Path("x")))
def test_nothing_that_a_config_names_is_executed(tmp_path: Path, tiny_capture: Path, capsys, monkeypatch, name: str):
    marker = tmp_path / "executed"
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "hostile_module.py").write_text(
        f"import pathlib; pathlib.Path({str(marker)!r}).touch(); thing = dict"
    )
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    attack = attacks(marker)[name].replace("\n", "\n  ")
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(
        text.replace("max_num_iterations:", f"project_name: {attack}\nmax_num_iterations:", 1)
    )
    for arguments in (("export", run, "--format", "colmap"), ("sheet", run, "--output", tmp_path / "sheet.png")):
        told = refusal(capsys, *arguments)
        assert "the tag '" in told and "nothing of it was executed" in told and str(run / "config.yml") in told
        assert attacks(marker)[name].split()[0].removeprefix("!!python/").removeprefix("!") in told.replace(
            "tag:yaml.org,2002:python/", ""
        )
    assert not marker.exists() and "hostile_module" not in sys.modules
    assert not (run / "export-colmap").exists() and not (tmp_path / "sheet.png").exists()


def test_the_marker_would_be_left_by_nerfstudios_loader(tmp_path: Path):
    """That the attacks above are ones at all, with the most harmless of them."""
    yaml.load(attacks(tmp_path / "executed")["open"], Loader=yaml.Loader).close()
    assert (tmp_path / "executed").exists()


BROKEN_SCALARS = ("a: !!int ''", "a: !!int '_'", "a: !!bool maybe", "a: !!float ''", "a: !!timestamp soon")
"""At these PyYAML itself stumbles: errors of four kinds that are no YAMLError."""


def test_a_config_that_grows_without_bound_is_refused_at_once(tmp_path: Path):
    bomb = "a0: &a0 {k: v}\n" + "".join(
        f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12)
    )
    for text, told in ((bomb, "merges mappings"), ("a: " + "x" * 2**23, "more than 4 MiB")):
        (tmp_path / "config.yml").write_text(text)
        with pytest.raises(ValueError, match=told):
            read_run_config(tmp_path / "config.yml")


def test_options_that_a_config_leaves_out_have_their_defaults(tmp_path: Path):
    (tmp_path / "config.yml").write_text(
        "!!python/object:fb_nerfstudio.trainer.FillerbusterTrainerConfig\nmax_num_iterations: 3\n"
    )
    assert read_run_config(tmp_path / "config.yml") == FillerbusterTrainerConfig(max_num_iterations=3)


@pytest.mark.parametrize("text", ["", "[1, 2]", "a: [", "\x00", "- " * 5000, "&a [*a]", "? {}\n: 1", *BROKEN_SCALARS])
def test_what_is_no_config_is_one_sentence(tmp_path: Path, tiny_capture: Path, capsys, text: str):
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    (run / "config.yml").write_text(text)
    assert "config.yml: " in refusal(capsys, "export", run, "--format", "colmap")


def test_a_run_with_another_pipeline_is_refused_before_anything_is_built(tmp_path: Path, tiny_capture: Path, capsys):
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    config = read_run_config(run / "config.yml")
    for part in ("datamanager", "model"):
        changed = copy.deepcopy(config)
        setattr(changed.pipeline, part, config.machine)
        (run / "config.yml").write_text(yaml.dump(changed))
        for arguments in (("export", run, "--format", "colmap"), ("sheet", run)):
            assert "expected a run of fillerbuster or fillerbuster-none, got one with MachineConfig" in refusal(
                capsys, *arguments
            )


class Touch:
    """What a pickle would do when it is read."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def test_code_in_a_checkpoint_is_not_executed(tmp_path: Path, tiny_capture: Path, capsys):
    from fb_core.files.faults import Refused
    from fb_nerfstudio.trainer import FillerbusterTrainer

    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    (path,) = (run / "nerfstudio_models").iterdir()
    torch.save({"step": 7, "pipeline": Touch(tmp_path / "executed")}, path)
    for arguments in (("export", run, "--format", "colmap"), ("sheet", run)):
        assert "step-000000007.ckpt cannot be read" in refusal(capsys, *arguments)
    config = copy.deepcopy(fillerbuster.config)
    config.output_dir, config.experiment_name, config.load_dir = tmp_path, "again", run / "nerfstudio_models"
    with pytest.raises(Refused, match=r"step-000000007.ckpt: not readable as plain values"):
        FillerbusterTrainer(config)._load_checkpoint()
    assert not (tmp_path / "executed").exists()
