"""The house in figures: ``python tests/house_counts.py`` prints them; test_house.py keeps them within their bounds."""

from __future__ import annotations

import ast
import statistics
import subprocess
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("fb_core", "fb_nerfstudio", "method_configs")
COLUMNS = 120
"""Of a line, in code and in docs (tables of Markdown, which cannot be wrapped, and addresses are left out)."""
MOST_ARGUMENTS = 7
MOST_LINES = 60
"""Of a function."""


@dataclass(kw_only=True)
class Counts:
    """What was counted in the packages; files per folder and long lines in tests and docs too."""

    files_per_folder: Counter[str] = field(default_factory=Counter)
    """Python files, the ``__init__`` included."""
    lines_per_file: dict[str, int] = field(default_factory=dict)
    lines_per_function: dict[str, int] = field(default_factory=dict)
    arguments_per_function: dict[str, int] = field(default_factory=dict)
    """Without ``self`` and ``cls``."""
    fields_of_options: dict[str, int] = field(default_factory=dict)
    """Of dataclasses that somebody sets: those whose names end with Config or Options, and those of a command. Private
    classes and fields (nerfstudio's ``_target``) are nobody's to set.
    """
    without_docstring: list[str] = field(default_factory=list)
    """Public functions, methods and classes; overridden methods count too."""
    raising_in_silence: list[str] = field(default_factory=list)
    """Public functions with a ``raise ValueError`` of their own whose docstring has no word of it."""
    long_lines: list[str] = field(default_factory=list)
    """More than ``COLUMNS`` wide."""


def tracked(*endings: str) -> list[Path]:
    """Files of the repository; those of the working tree where git is not there (a downloaded archive)."""
    asked = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        paths = [ROOT / line for line in done.stdout.splitlines()]
    else:
        paths = [path for path in ROOT.rglob("*") if ".venv" not in path.parts]
    return sorted(path for path in paths if path.suffix in endings and path.is_file())


def counted() -> Counts:
    """All figures of the tree as it is."""
    counts = Counts()
    for path in tracked(".py"):
        name = str(path.relative_to(ROOT))
        counts.files_per_folder[str(path.parent.relative_to(ROOT))] += 1
        text = path.read_text(encoding="utf-8")
        if name.split("/")[0] in PACKAGES:
            counts.lines_per_file[name] = text.count("\n")
            _look_into(ast.parse(text), name.removesuffix(".py").replace("/", "."), counts)
    for path in tracked(".py", ".md", ".sh", ".toml"):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            table_or_address = path.suffix == ".md" and (line.lstrip().startswith("|") or "](http" in line)
            if len(line) > COLUMNS and not table_or_address:
                counts.long_lines.append(f"{path.relative_to(ROOT)}:{number}")
    return counts


def _look_into(tree: ast.AST, place: str, counts: Counts, public: bool = True) -> None:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            known = public and not node.name.startswith("_")
            if known and ast.get_docstring(node) is None:
                counts.without_docstring.append(f"{place}.{node.name}")
            of_command = ".commands." in f"{place}." and _is_dataclass(node) and known
            if node.name.endswith(("Config", "Options")) or of_command:
                fields = [one for one in node.body if isinstance(one, ast.AnnAssign) and _is_public(one.target)]
                if fields:
                    counts.fields_of_options[f"{place}.{node.name}"] = len(fields)
            _look_into(node, f"{place}.{node.name}", counts, known)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            name = f"{place}.{node.name}"
            counts.lines_per_function[name] = (node.end_lineno or node.lineno) - node.lineno + 1
            given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            counts.arguments_per_function[name] = len([one for one in given if one.arg not in ("self", "cls")])
            docstring = ast.get_docstring(node)
            if public and not node.name.startswith("_"):
                if docstring is None:
                    counts.without_docstring.append(name)
                elif _raises(node) and "raise" not in docstring.lower() and "ValueError" not in docstring:
                    counts.raising_in_silence.append(name)
            _look_into(node, name, counts, public=False)
        else:
            _look_into(node, place, counts, public)


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(one) for one in node.decorator_list)


def _is_public(target: ast.expr) -> bool:
    return not ast.unparse(target).startswith("_")


def _raises(node: ast.AST) -> bool:
    return any(isinstance(one, ast.Raise) and "ValueError" in ast.unparse(one) for one in ast.walk(node))


def table(counts: Counts) -> str:
    """The figures, a line each."""
    folder, files = counts.files_per_folder.most_common(1)[0]
    longest = max(counts.lines_per_file, key=counts.lines_per_file.__getitem__)
    function = max(counts.lines_per_function, key=counts.lines_per_function.__getitem__)
    many = [name for name, number in counts.arguments_per_function.items() if number > MOST_ARGUMENTS]
    tall = [name for name, number in counts.lines_per_function.items() if number > MOST_LINES]
    sizes = [number for number in counts.lines_per_file.values() if number]
    return "\n".join(
        [
            f"files in the fullest folder        {files} ({folder})",
            f"median file                        {statistics.median(sizes):.0f} lines",
            f"longest file                       {counts.lines_per_file[longest]} lines ({longest})",
            f"files over 400 lines               {sum(number > 400 for number in sizes)}",
            f"longest function                   {counts.lines_per_function[function]} lines ({function})",
            f"functions over {MOST_LINES} lines            {len(tall)}",
            f"functions with over {MOST_ARGUMENTS} arguments    {len(many)}",
            f"fields of options                  {sum(counts.fields_of_options.values())}",
            f"public names without a docstring   {len(counts.without_docstring)}",
            f"public functions that raise unsaid {len(counts.raising_in_silence)}",
            f"lines over {COLUMNS} columns             {len(counts.long_lines)}",
        ]
    )


if __name__ == "__main__":
    print(table(counted()))
