"""The config.yml of a run, read without running anything that it names.

``ns-train`` writes its options as YAML with tags for Python objects, and nerfstudio reads them back with a loader that
imports and calls whatever a tag names. Here a table says which classes a run of ours is made of. They are built without
calling them: an empty instance of a dataclass, filled with values. Every other tag is refused before anything is
imported for it.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import yaml

from fb_nerfstudio.earlier_names import EARLIER_NAMES

_PARSERS = "nerfstudio.data.dataparsers"
ALLOWED: dict[str, tuple[str, ...]] = {
    "fb_nerfstudio.trainer": ("FillerbusterTrainerConfig", "FillerbusterTrainer"),
    "fb_nerfstudio.datamanager": ("FillerbusterDataManagerConfig", "FillerbusterDataManager"),
    "fb_core.completion.options": ("CompletionConfig", "MaskedConfig", "PlacementConfig"),
    "fb_nerfstudio.splats.splat_model": ("FillerbusterSplatModelConfig", "FillerbusterSplatModel"),
    "fb_nerfstudio.splats.fused_adam": ("FusedAdamOptimizerConfig",),
    "fb_nerfstudio.splats.schedulers": ("FloatExponentialDecaySchedulerConfig", "FloatExponentialDecayScheduler"),
    "fb_nerfstudio.capture.dataparser": ("NerfstudioWithoutOpen3d",),
    "nerfstudio.pipelines.base_pipeline": ("VanillaPipelineConfig", "VanillaPipeline"),
    "nerfstudio.cameras.camera_optimizers": ("CameraOptimizerConfig", "CameraOptimizer"),
    "nerfstudio.configs.base_config": ("LocalWriterConfig", "LoggingConfig", "MachineConfig", "ViewerConfig"),
    "nerfstudio.engine.optimizers": ("AdamOptimizerConfig",),
    "nerfstudio.utils.writer": ("LocalWriter", "EventName"),
    f"{_PARSERS}.nerfstudio_dataparser": ("NerfstudioDataParserConfig", "Nerfstudio"),
    f"{_PARSERS}.colmap_dataparser": ("ColmapDataParserConfig", "ColmapDataParser"),
    f"{_PARSERS}.blender_dataparser": ("BlenderDataParserConfig", "Blender"),
    f"{_PARSERS}.instant_ngp_dataparser": ("InstantNGPDataParserConfig", "InstantNGP"),
    "torch.optim.adam": ("Adam",),
}
"""All that a tag may name, by modules. nerfstudio's minimal-parser is left out on purpose, since it unpickles the data
that it reads.
"""
_PATHS = (
    "pathlib.PosixPath",
    "pathlib.WindowsPath",
    "pathlib.PurePosixPath",
    "pathlib.Path",
    "pathlib._local.PosixPath",
)
_MOST_BYTES = 2**22  # a run's options have some 10 KiB
_TAG = "tag:yaml.org,2002:python/"


class _Refused(yaml.YAMLError):
    """A tag that is not on the list, or a value that does not fit its class."""


def read_run_config(path: Path) -> Any:
    """The trainer options in a run's config.yml, equal to what nerfstudio's own loader gives for a run of ours.

    Raises ValueError in one sentence for a file that is none, and for one that names anything but the classes in
    ``ALLOWED``.
    """
    from fb_nerfstudio.trainer import FillerbusterTrainerConfig

    try:
        if path.stat().st_size > _MOST_BYTES:
            raise _Refused(f"it has more than {_MOST_BYTES // 2**20} MiB, which no options have")
        config = yaml.load(
            path.read_text(encoding="utf-8"), Loader=_Loader
        )  # our loader, which builds nothing but what is listed
    except _Refused as error:
        raise ValueError(f"{path}: {error}; nothing of it was executed, so ask where this run comes from") from None
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
        yaml.YAMLError,
    ) as error:
        raise ValueError(
            f"{path}: not readable as a run's options ({' '.join(str(error).split())[:200]}); restore it"
        ) from None
    if not isinstance(config, FillerbusterTrainerConfig):
        raise ValueError(
            f"{path}: expected the options of a fillerbuster run, got {type(config).__name__}; give a run of ours"
        )
    return config


class _Loader(yaml.SafeLoader):
    """Plain YAML, tuples, paths, and the classes in ``ALLOWED``."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merged mappings (``<<``), which no run writes, are refused: a few lines of them grow without bound."""
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise _Refused("it merges mappings (<<), which no run of fillerbuster does")


def _named(tag: str, name: str) -> type:
    """A class on the list; nothing is imported for any other name."""
    module, _, own = name.rpartition(".")
    module = EARLIER_NAMES.get(module, module)
    if own not in ALLOWED.get(module, ()):
        raise _Refused(f"the tag {tag!r} names what is no part of a fillerbuster run")
    kind = vars(importlib.import_module(module)).get(own)
    if not isinstance(kind, type):
        raise _Refused(f"the tag {tag!r} names no class that this version knows")
    return kind


def _class(loader: _Loader, name: str, node: yaml.Node) -> type:
    """``!!python/name:``, of which only classes are on the list."""
    return _named(node.tag, name)


def _object(loader: _Loader, name: str, node: yaml.Node) -> Iterator[Any]:
    """``!!python/object:``: an instance of a dataclass, filled without calling anything of it."""
    kind = _named(node.tag, name)
    if not dataclasses.is_dataclass(kind) or not isinstance(node, yaml.MappingNode):
        raise _Refused(f"the tag {node.tag!r} builds no options")
    made = object.__new__(kind)
    yield made
    values: dict[Any, Any] = loader.construct_mapping(node)
    fields = {one.name for one in dataclasses.fields(kind)}
    for key in values:
        if not isinstance(key, str) or (key not in fields and hasattr(kind, key)) or key.startswith("__"):
            raise _Refused(f"the tag {node.tag!r} gives {str(key)[:40]!r}, which is none of its options")
    vars(made).update(values)
    for one in dataclasses.fields(kind):  # options that are newer than the run, or were taken out
        if one.name not in values and not hasattr(kind, one.name):
            if one.default_factory is dataclasses.MISSING:
                raise _Refused(f"the tag {node.tag!r} lacks {one.name!r}, which has no default")
            setattr(made, one.name, one.default_factory())


def _applied(loader: _Loader, name: str, node: yaml.Node) -> Any:
    """``!!python/object/apply:``, of which only paths and the members of enumerations are taken."""
    if not isinstance(node, yaml.SequenceNode):
        raise _Refused(f"the tag {node.tag!r} calls with more than plain values")
    values = loader.construct_sequence(node, deep=True)
    if name in _PATHS:
        if not all(isinstance(value, str) for value in values):
            raise _Refused(f"the tag {node.tag!r} makes a path of other things than names")
        return Path(PurePath(*values))
    if name == "builtins.getattr":
        return _member(values, node.tag)
    kind = _named(node.tag, name)
    if not (issubclass(kind, enum.Enum) and len(values) == 1 and isinstance(values[0], str | int)):
        raise _Refused(f"the tag {node.tag!r} calls what is not to be called")
    return kind(values[0])


def _member(values: list[Any], tag: str) -> enum.Enum:
    """A member of an enumeration by its name, as the first releases of Python 3.11 write it (Debian's 3.11.2): nothing
    is looked up but the names of members.
    """
    if len(values) == 2 and isinstance(values[0], type) and issubclass(values[0], enum.Enum):
        member = values[0].__members__.get(values[1]) if isinstance(values[1], str) else None
        if member is not None:
            return member
    raise _Refused(f"the tag {tag!r} names what is no part of a fillerbuster run")


def _tuple(loader: _Loader, node: yaml.Node) -> tuple:
    if not isinstance(node, yaml.SequenceNode):
        raise _Refused(f"the tag {node.tag!r} is given other things than a list")
    return tuple(loader.construct_sequence(node, deep=True))


def _unknown(loader: _Loader, node: yaml.Node) -> Any:
    raise _Refused(f"the tag {node.tag!r} names what is no part of a fillerbuster run")


_Loader.add_multi_constructor(f"{_TAG}name:", _class)
_Loader.add_multi_constructor(f"{_TAG}object/apply:", _applied)
_Loader.add_multi_constructor(f"{_TAG}object:", _object)
_Loader.add_constructor(f"{_TAG}tuple", _tuple)
_Loader.yaml_constructors = {**_Loader.yaml_constructors, None: _unknown}
