"""Every command in the README and the guides is one that its parser accepts, with files that exist where files are
named.
"""

from __future__ import annotations

import functools
import re
import shlex
from pathlib import Path

import pytest

from method_configs.commands import command_line as commands

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    "README.md",
    "docs/quickstart.md",
    "docs/gpu.md",
    "docs/training.md",
    "docs/weights.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "records").glob("*.md")),
]


def commands_of(page: str) -> list[str]:
    """Lines of the page's bash blocks, comments left out, continued lines joined."""
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


ALL = [(page, line) for page in PAGES for line in commands_of(page)]


def test_the_example_in_python_runs():
    """As it stands, with the bundled model; what was known comes back as it was given."""
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["completed"].images.shape == (4, 3, 64, 64)
    assert (names["completed"].images[:2] == names["pictures"][:2]).all()


def test_the_pages_have_commands():
    programs = {shlex.split(line)[0] for _, line in ALL}
    assert {
        "make",
        "git",
        "fillerbuster",
        "ns-train",
        "ns-viewer",
        "ns-eval",
        "ns-render",
        "ns-export",
        "python",
        "torchrun",
    } == programs


@pytest.mark.parametrize(("page", "line"), [one for one in ALL if one[1].startswith("make ")])
def test_make_has_the_target(page, line):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert set(shlex.split(line)[1:]) <= set(targets)


@pytest.mark.parametrize(("page", "line"), [one for one in ALL if one[1].startswith("fillerbuster ")])
def test_fillerbuster_accepts(page, line, monkeypatch):
    """The command's own parser calls the subcommand, which is recorded instead of run (test_commands runs each in
    miniature).
    """
    called = []
    for name, function in commands.COMMANDS.items():
        recorder = functools.wraps(function)(lambda *args, _name=name, **options: called.append(_name))
        monkeypatch.setitem(commands.COMMANDS, name, recorder)
    arguments = shlex.split(line)[1:]
    commands.main(arguments)
    assert called == [arguments[0]]


@pytest.mark.parametrize(("page", "line"), [one for one in ALL if "-m method_configs.train " in one[1]])
def test_the_entrance_without_tyro_accepts(page, line):
    from method_configs.presets import PRESETS
    from method_configs.train import parser

    launcher, _, arguments = line.partition("-m method_configs.train ")
    assert parser().parse_args(shlex.split(arguments)).preset in PRESETS
    if launcher.startswith("torchrun"):
        from torch.distributed.run import get_args_parser

        get_args_parser().parse_args([*shlex.split(launcher)[1:], "script"])


@pytest.mark.parametrize(("page", "line"), [one for one in ALL if one[1].startswith("ns-")])
def test_nerfstudio_accepts(page, line):
    import tyro

    program, *arguments = shlex.split(line)
    config = tyro.cli(_parser_of(program), args=arguments)
    if program == "ns-train":
        assert config.method_name == arguments[0]


def _parser_of(program: str):
    """What nerfstudio's entry point of this name parses."""
    if program == "ns-train":
        from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

        return AnnotatedBaseConfigUnion
    if program == "ns-eval":
        from nerfstudio.scripts.eval import ComputePSNR

        return ComputePSNR
    if program == "ns-viewer":
        from nerfstudio.scripts.viewer.run_viewer import RunViewer

        return RunViewer
    if program == "ns-render":
        from nerfstudio.scripts import render

        return render.Commands
    # ns-export imports open3d, which needs a system library; the one subcommand we name is declared in this class.
    pytest.importorskip("open3d", reason="open3d needs libusb-1.0", exc_type=(ImportError, OSError))
    from nerfstudio.scripts.exporter import Commands

    return Commands


def test_options_of_the_table_exist():
    """The README's table of options names real fields with their real defaults."""
    from method_configs.splats import fillerbuster

    rows = re.findall(
        r"^\| `--([a-z.-]+)` \| ([^|]+) \|", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert len(rows) >= 8
    for option, default in rows:
        value = fillerbuster.config
        for name in option.replace("-", "_").split("."):
            assert hasattr(value, name), option
            value = getattr(value, name)
        if re.fullmatch(r"[0-9.]+|viewer", default.strip()):
            assert str(value) == default.strip(), option


def test_links_lead_somewhere():
    for page in ["README.md", *(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md"))]:
        text = (ROOT / page).read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#:]+)\)", text):
            assert ((ROOT / page).parent / target).exists(), f"{page} links to {target}"


def test_architecture_draws_the_tree_as_it_is():
    """Every module of the three packages stands in the drawing, and nothing else does."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    drawing = re.search(r"```\n(.*?)```", text, flags=re.DOTALL)[1]
    drawn = set(re.findall(r"[a-z_0-9]+\.py", drawing)) - {"conftest.py"}
    packages = ("fb_core", "fb_nerfstudio", "method_configs")
    real = {path.name for package in packages for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py"}
    assert drawn == real


def test_packages_are_listed_explicitly():
    """A package folder that pyproject.toml forgets would be missing from an installed wheel."""
    import tomllib

    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    found = {
        str(path.parent.relative_to(ROOT)).replace("/", ".")
        for top in ("fb_core", "fb_nerfstudio", "method_configs")
        for path in (ROOT / top).rglob("__init__.py")
    }
    assert set(listed) == found
