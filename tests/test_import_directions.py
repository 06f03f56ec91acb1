"""The folders and who may import whom (docs/architecture.md): walked in the source, and tried in fresh interpreters."""

from __future__ import annotations

import ast
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("fb_core", "fb_nerfstudio", "method_configs")

# From first to last: a module may import its own line and those before it, whether at import time or in a function.
FLOORS = (
    "fb_core.machine",
    "fb_core.files",
    "fb_core.masks",
    "fb_core.geometry",
    "fb_core.networks",
    "fb_core.views",
    "fb_core.conditioning",
    "fb_core.flow",
    "fb_core.sampling",
    "fb_core.checkpoint",
    "fb_core.memory",
    "fb_core.given_views",
    "fb_core.inpainter",
    "fb_core.splatting",
    "fb_core.data",
    "fb_core.registration",
    "fb_core.completion",
    "fb_core.evaluation",
    "fb_core.training",
    "fb_nerfstudio.earlier_names",
    "fb_nerfstudio.bridge",
    "fb_nerfstudio.splats",
    "fb_nerfstudio.capture",
    "fb_nerfstudio.refusal",
    "fb_nerfstudio.checks",
    "fb_nerfstudio.viewer_coverage",
    "fb_nerfstudio.viewer",
    "fb_nerfstudio.generation",
    "fb_nerfstudio.trainer",
    "fb_nerfstudio.datamanager",
    "fb_nerfstudio.runs",
    "method_configs.environment",
    "method_configs.presets",
    "method_configs.splats",
    "method_configs.room_runs",
    "method_configs.benchmarks",
    "method_configs.evaluations",
    "method_configs.commands",
    "method_configs.train",
    "method_configs.entrance",
)
NEVER_IN_CORE = {"nerfstudio", "gsplat", "viser"}
HEAVY = {
    "kornia",
    "cv2",
    "trimesh",
    "pyvista",
    "OpenImageIO",
    "matplotlib",
    "transformers",
    "diffusers",
    "open3d",
    "torchvision",
}
CORE_NEEDS = {"torch", "numpy", "einops", "safetensors", "jaxtyping"}
CORE = (*FLOORS[: FLOORS.index("fb_core.splatting") + 1], "fb_core.training")


@dataclass(frozen=True, kw_only=True)
class Import:
    """One imported module as it stands in a file."""

    importer: str
    imported: str
    line: int
    at_import_time: bool

    def __str__(self) -> str:
        return f"{self.importer} line {self.line} imports {self.imported}"


def module_name(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def imports_of(tree: ast.AST, module: str, is_package: bool) -> list[Import]:
    """All imports with what runs when the module is imported told from what waits in functions (or in
    TYPE_CHECKING).
    """
    found: list[Import] = []

    def walk(node: ast.AST, at_import_time: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(
                Import(importer=module, imported=name.name, line=node.lineno, at_import_time=at_import_time)
                for name in node.names
            )
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".") if is_package else module.split(".")[:-1]
                base = ".".join([*package[: len(package) - node.level + 1], *([base] if base else [])])
            for name in node.names:  # `from fb_core import flow` imports fb_core.flow
                full = f"{base}.{name.name}"
                place = REPOSITORY / full.replace(".", "/")
                imported = full if place.is_dir() or place.with_suffix(".py").is_file() else base
                found.append(
                    Import(importer=module, imported=imported, line=node.lineno, at_import_time=at_import_time)
                )
        inside = (
            at_import_time
            and not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            and not is_type_checking(node)
        )
        for child in ast.iter_child_nodes(node):
            walk(child, inside)

    walk(tree, True)
    return found


def all_imports() -> list[Import]:
    files = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    return [
        one
        for path in files
        for one in imports_of(ast.parse(path.read_text()), module_name(path), path.name == "__init__.py")
    ]


IMPORTS = all_imports()


def floor_of(module: str) -> int | None:
    return next((number for number, package in enumerate(FLOORS) if is_within(module, package)), None)


def told(faults: list[Import]) -> str:
    return "\n" + "\n".join(str(fault) for fault in faults)


def test_every_module_has_its_floor() -> None:
    modules = {module_name(path) for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")} - set(
        PACKAGES
    )
    homeless = sorted(module for module in modules if floor_of(module) is None)
    assert not homeless, f"name their floor in this test and in docs/architecture.md: {homeless}"


def test_imports_go_one_way() -> None:
    faults = [
        one
        for one in IMPORTS
        if (floor := floor_of(one.imported)) is not None and (own := floor_of(one.importer)) is not None and floor > own
    ]
    assert not faults, told(faults)


def circles_of(imports: dict[str, set[str]]) -> list[list[str]]:
    """Modules that lead back to themselves, each circle once (Tarjan's strongly connected components)."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        order[module] = lowest[module] = len(order)
        stack.append(module)
        for other in imports.get(module, ()):
            if other not in order:
                visit(other)
                lowest[module] = min(lowest[module], lowest[other])
            elif other in stack:
                lowest[module] = min(lowest[module], order[other])
        if lowest[module] == order[module]:
            start = stack.index(module)
            circle = stack[start:]
            del stack[start:]
            if len(circle) > 1 or module in imports.get(module, ()):
                found.append(sorted(circle))

    for module in sorted(imports):
        if module not in order:
            visit(module)
    return found


def test_imports_run_in_no_circle() -> None:
    """Neither at import time, nor in a function, nor for types alone. A package's door (its __init__) leads inwards."""
    doors = {module_name(path.parent / "__init__.py") for top in PACKAGES for path in (REPOSITORY / top).rglob("*.py")}
    imports: dict[str, set[str]] = {}
    for one in IMPORTS:
        if one.imported.split(".")[0] in PACKAGES and one.importer not in doors:
            imports.setdefault(one.importer, set()).add(one.imported)
    assert circles_of(imports) == []


def test_circles_are_found() -> None:
    """The test's own test."""
    assert circles_of({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}}) == [["a", "b", "c"]]
    assert circles_of({"a": {"b"}, "b": {"c"}, "d": {"d"}}) == [["d"]]


def test_the_package_itself_imports_none_of_its_parts_before_they_are_asked_for() -> None:
    faults = [
        one
        for one in IMPORTS
        if one.importer == "fb_core" and one.imported.split(".")[0] in PACKAGES and one.at_import_time
    ]
    assert not faults, told(faults)


def test_public_names_are_there() -> None:
    import fb_core

    assert all(getattr(fb_core, name).__name__ == name for name in fb_core.__all__)


def test_core_never_knows_nerfstudio() -> None:
    faults = [
        one for one in IMPORTS if is_within(one.importer, "fb_core") and one.imported.split(".")[0] in NEVER_IN_CORE
    ]
    assert not faults, told(faults)


def test_sampling_and_training_need_little() -> None:
    """Only torch, numpy, einops, safetensors and jaxtyping when imported; heavier things wait in the functions that own
    the job.
    """
    allowed = CORE_NEEDS | set(sys.stdlib_module_names) | {"fb_core"}
    faults = [
        one
        for one in IMPORTS
        if one.at_import_time
        and any(is_within(one.importer, package) for package in CORE)
        and one.imported.split(".")[0] not in allowed
    ]
    assert not faults, told(faults)


def test_heavy_libraries_wait_until_they_are_needed() -> None:
    faults = [
        one
        for one in IMPORTS
        if one.at_import_time and one.imported.split(".")[0] in HEAVY and is_within(one.importer, "fb_core")
    ]
    assert not faults, told(faults)


def test_nobody_imports_the_table_that_discovers_plugins() -> None:
    """Plugins are discovered in the middle of that module's own import."""
    faults = [one for one in IMPORTS if is_within(one.imported, "nerfstudio.configs.method_configs")]
    assert not faults, told(faults)


def test_the_composition_root_is_an_empty_package() -> None:
    assert (REPOSITORY / "method_configs" / "__init__.py").read_text().strip() == ""


def test_the_walker_sees_what_it_should() -> None:
    """The test's own test: relative imports, functions, TYPE_CHECKING, class bodies."""
    source = (
        "import a.b\nfrom c import d\nfrom . import e\nfrom ..f import g\nfrom fb_core import views, data\n"
        "class K:\n    import h\n    def m(self):\n        import i\n"
        "if TYPE_CHECKING:\n    import j\n"
    )
    found = imports_of(ast.parse(source), "fb_core.data.x", False)
    assert [(one.imported, one.at_import_time) for one in found] == [
        ("a.b", True),
        ("c", True),
        ("fb_core.data", True),
        ("fb_core.f", True),
        ("fb_core.views", True),
        ("fb_core.data", True),
        ("h", True),
        ("i", False),
        ("j", False),
    ]


def test_importing_fb_core_pulls_nothing_heavy() -> None:
    """In a fresh interpreter, through everything that the modules import in turn."""
    modules = sorted(module_name(path) for path in (REPOSITORY / "fb_core").rglob("*.py"))
    script = (
        "import importlib, sys\n"
        f"for module in {modules!r}: importlib.import_module(module)\n"
        f"print(*sorted({(HEAVY | NEVER_IN_CORE)!r} & {{name.split('.')[0] for name in sys.modules}}))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "", f"importing fb_core also imported: {done.stdout.strip()}"
