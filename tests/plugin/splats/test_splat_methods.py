"""The nerfstudio methods: importable first, light, parsable, differing only where they say so."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest
import torch
import tyro
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from packaging.requirements import Requirement

from fb_nerfstudio.splats.schedulers import FloatExponentialDecaySchedulerConfig
from method_configs import splats
from method_configs.splats import fillerbuster, fillerbuster_none

REPOSITORY = Path(__file__).resolve().parents[3]
HEAVY = {"kornia", "trimesh", "pyvista", "OpenImageIO", "transformers", "diffusers", "open3d"}


def differences(first, second, path: str = "") -> dict[str, tuple]:
    """Dotted names of all fields in which two configs differ."""
    if dataclasses.is_dataclass(first) and not isinstance(first, type) and type(first) is type(second):
        pairs = [
            (field.name, getattr(first, field.name), getattr(second, field.name)) for field in dataclasses.fields(first)
        ]
    elif isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys():
        pairs = [(key, first[key], second[key]) for key in first]
    else:
        return {} if first == second else {path: (first, second)}
    found: dict[str, tuple] = {}
    for name, one, other in pairs:
        found |= differences(one, other, f"{path}.{name}" if path else str(name))
    return found


def test_the_baseline_differs_in_completion_only() -> None:
    assert differences(fillerbuster.config, fillerbuster_none.config) == {
        "method_name": ("fillerbuster", "fillerbuster-none"),
        "pipeline.datamanager.completion.enabled": (True, False),
    }


COMPLETION = "pipeline.datamanager.completion."
VARIANTS = {
    "fillerbuster-cat3d-size": (
        "fillerbuster",
        {"context_views": 3, "anchor_views": 0, "densify_rounds": 20, "densify_views": 6, "trust": "full"},
    ),
    "fillerbuster-masked": (
        "fillerbuster",
        {"task": "inpaint", "at_step": 0, "seed_gaussians": False, "trust": "full"},
    ),
    "nerfiller-grid": ("fillerbuster-masked", {"inpainter": "grid"}),
}


def config_of(method: str) -> TrainerConfig:
    return getattr(splats, method.replace("-", "_")).config


@pytest.mark.parametrize("method", VARIANTS)
def test_a_protocol_differs_from_its_base_in_its_completion_only(method: str) -> None:
    base, options = VARIANTS[method]
    found = differences(config_of(base), config_of(method))
    assert found.pop("method_name") == (base, method)
    assert {name: pair[1] for name, pair in found.items()} == {
        f"{COMPLETION}{name}": value for name, value in options.items()
    }


def test_the_masked_protocol_is_the_papers() -> None:
    completion = config_of("fillerbuster-masked").pipeline.datamanager.completion
    assert (completion.masked.views, completion.masked.dilate) == (32, 5) and not completion.seed_gaussians


def test_the_papers_optimisation_differs_in_what_the_paper_says() -> None:
    found = differences(fillerbuster.config, config_of("fillerbuster-paper"))
    assert found.pop("method_name")[1] == "fillerbuster-paper"
    changed = {name.rpartition(".")[2]: pair[1] for name, pair in found.items()}
    steps = fillerbuster.config.max_num_iterations
    optional = {
        "num_downscales": 0,
        "use_scale_regularization": True,
        "stop_split_at": steps,
        "stop_screen_size_at": steps,
    }
    expected = {
        **{"start_points": 0, "load_3D_points": False, "random_init": True, "sh_degree": 0, "ssim_lambda": 0.0},
        **{
            "at_step": 0,
            "context_choice": "stride",
            "anchor_views": 24,
            "trust": "full",
            "densify_rounds": 4,
            "generated_share": 0.5,
            "generated_steps": "shared",
            "generated_pixels": "all",
        },
        **{"match_colors": False, "seed_gaussians": False},
    }
    assert {name: value for name, value in changed.items() if name not in optional} == expected
    assert all(changed[name] == value for name, value in optional.items() if name in changed)


def test_every_method_is_an_entry_point_under_its_own_name() -> None:
    import tomllib

    declared = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    methods = declared["nerfstudio.method_configs"]
    assert set(methods) == {"fillerbuster", "fillerbuster-none", "fillerbuster-paper", *VARIANTS}
    for name, place in methods.items():
        assert place == f"method_configs.splats:{name.replace('-', '_')}" and config_of(name).method_name == name


def test_defaults_that_users_rely_on() -> None:
    config = fillerbuster.config
    assert config.viewer.websocket_host == "127.0.0.1" and not config.viewer.default_composite_depth
    assert config.machine.device_type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert not config.mixed_precision and not config.viewer.quit_on_train_completion
    schedulers = [group["scheduler"] for group in config.optimizers.values() if group["scheduler"] is not None]
    assert schedulers and all(isinstance(scheduler, FloatExponentialDecaySchedulerConfig) for scheduler in schedulers)
    model = config.pipeline.model
    assert (model.normal_alignment, model.normal_alignment_weight, model.ssim_lambda) == ("squared", 0.01, 0.2)


@pytest.mark.parametrize(("on_gpu", "steps", "cap"), [(True, 30000, 1_000_000), (False, 3000, 20000)])
def test_the_practical_preset(monkeypatch: pytest.MonkeyPatch, on_gpu: bool, steps: int, cap: int) -> None:
    """Points of the capture, or triangulated ones, and more where generated views show what nobody saw; SSIM,
    harmonics, a cap.
    """
    monkeypatch.setattr(splats, "_ON_GPU", on_gpu)
    model, datamanager = splats._model(), fillerbuster.config.pipeline.datamanager
    assert datamanager.dataparser.load_3D_points and datamanager.start_points == 5000 and not model.random_init
    assert datamanager.completion.seed_gaussians and datamanager.completion.max_seed_gaussians == 20000
    assert model.ssim_lambda == 0.2 and model.sh_degree == (3 if on_gpu else 1) and model.max_gaussians == cap
    assert (
        model.normal_loss_from == (10000 if on_gpu else model.stop_split_at)
        and steps / 3 <= model.normal_loss_from < steps
    )


def test_the_command_line_reaches_our_options() -> None:
    arguments = [
        "--max-num-iterations",
        "5",
        "--pipeline.model.max-gaussians",
        "100",
        "--pipeline.datamanager.completion.enabled",
        "False",
    ]
    arguments += ["--pipeline.model.normal-alignment", "absolute", "--optimizers.means.optimizer.fused", "False"]
    config = tyro.cli(tyro.conf.FlagConversionOff[TrainerConfig], default=fillerbuster.config, args=arguments)
    assert config.max_num_iterations == 5 and config.pipeline.model.max_gaussians == 100
    assert not config.pipeline.datamanager.completion.enabled and config.pipeline.model.normal_alignment == "absolute"
    assert not config.optimizers["means"]["optimizer"].fused


@pytest.mark.parametrize("method", ["fillerbuster", "fillerbuster-masked"])
def test_a_config_survives_yaml(method: str) -> None:
    """nerfstudio writes config.yml as Python objects and every later command reads it back."""
    again = yaml.load(yaml.dump(config_of(method)), Loader=yaml.Loader)
    assert differences(config_of(method), again) == {}


@pytest.mark.timeout(180)
def test_imports_first_and_adds_less_than_a_second() -> None:
    """In a fresh interpreter the entry point is imported before anything of nerfstudio, and what it loads beyond
    nerfstudio and nerfstudio's own requirements takes less than a second (on a busy machine: 5 % of the whole)."""
    script = (
        f"import sys, method_configs.splats as m; print(m.fillerbuster.config.method_name, sorted({HEAVY!r} & "
        "set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", script], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip().splitlines()[-1] == "fillerbuster []"
    own, whole = own_import_seconds(done.stderr)
    assert own < max(1.0, 0.05 * whole)


def own_import_seconds(report: str) -> tuple[float, float]:
    """Seconds of an importtime report outside nerfstudio, its requirements, the standard library and what they import;
    all seconds.
    """
    foreign = {"nerfstudio"} | {
        Requirement(line).name.replace("-", "_").lower() for line in requires("nerfstudio") or []
    }
    foreign |= {"pil", "cv2", "sklearn"} | set(sys.stdlib_module_names)
    own, whole, ancestors = 0.0, 0.0, []
    for line in reversed(report.splitlines()):  # children stand before their parent, one step further in
        parts = line.removeprefix("import time:").split("|")
        if len(parts) != 3 or not parts[0].strip().isdigit():
            continue
        depth = (len(parts[2]) - len(parts[2].lstrip()) - 1) // 2
        name = parts[2].strip()
        ancestors = [*ancestors[:depth], name.split(".")[0].lower()]
        seconds = int(parts[0]) * 1e-6
        whole += seconds
        own += 0.0 if foreign & set(ancestors) else seconds
    return own, whole
