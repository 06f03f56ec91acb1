"""The ``fillerbuster`` command: rooms, train, convert, complete, demo, sheet, export, bench, eval, compile, check.

Only light modules are imported here, so that ``fillerbuster --help`` answers at once; each command imports what it
needs.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, Protocol

import tyro

from fb_core.files.faults import sentence_of
from fb_core.files.limits import MOST_SEED, require_between
from fb_core.files.ownership import require_own_or_new
from fb_core.machine.interruption import DEBUG_VARIABLE, ENDED_BY_USER, signals_given_back, stop_on_signals
from method_configs.benchmarks.builds import Builds
from method_configs.benchmarks.command import Networks, Precision
from method_configs.benchmarks.costs.command import Costs
from method_configs.benchmarks.fit import Fit
from method_configs.benchmarks.inference import Inference
from method_configs.benchmarks.methods import Methods
from method_configs.benchmarks.photos.command import Photos
from method_configs.benchmarks.poses.command import Poses
from method_configs.benchmarks.sampler.command import Sampler
from method_configs.benchmarks.splats.command import Splat
from method_configs.benchmarks.table_files import TableFiles
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.train_options import TrainOptions
from method_configs.commands.typed_options import TypedCompleteOptions, TypedTrainOptions, looked_at
from method_configs.evaluations.ablations import Ablations
from method_configs.evaluations.conditioning import Conditioning
from method_configs.evaluations.consistency import Consistency
from method_configs.evaluations.designs.command import Designs
from method_configs.evaluations.masked import Masked, Paper
from method_configs.evaluations.model import ModelOnCaptures
from method_configs.evaluations.rooms import Rooms
from method_configs.evaluations.scaling import Scaling
from method_configs.evaluations.scene import Scene
from method_configs.evaluations.trust import Trust
from method_configs.evaluations.uncalibrated import Uncalibrated


def rooms(
    *,
    output: Path,
    seed: int = 0,
    family: Literal["narrow", "medium", "wide"] = "narrow",
    views: int = 24,
    size: int = 128,
    held_out: int = 16,
    ground_truth: bool = False,
) -> None:
    """Make the casual capture of one procedural room, as a folder for ns-train.

    Args:
        output: New folder for the capture.
        seed: Which room (0 or more); the same seed gives the same files.
        family: How varied room and cameras are; the bundled model knows narrow rooms.
        views: Captured pictures.
        size: Width and height of the pictures in pixels.
        held_out: Further ground-truth pictures, half of them covered by the capture and half not.
        ground_truth: Also write depth and normals as EXR files.
    """
    from fb_core.data.rooms import room_captures

    room_captures.rooms(
        seed, output, family=family, views=views, size=size, held_out=held_out, ground_truth=ground_truth
    )


def train(
    preset: Annotated[str, tyro.conf.Positional],
    /,
    *,
    output: Path,
    training: tyro.conf.OmitArgPrefixes[TypedTrainOptions] = TypedTrainOptions(),
) -> None:
    """Train a model; the same command again goes on where the last one ended. Under torchrun on many devices.

    Args:
        preset: What to train, e.g. rooms-tiny (the bundled model).
        output: Folder of the training; the finished model is its subfolder "model".
        training: What is asked for instead of what the preset says.
    """
    options = looked_at(training, TrainOptions)
    from method_configs.commands.training import train_preset

    train_preset(preset, output, options)


def convert(
    checkpoints: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    output: Path,
    text_encoder: Path | None = None,
    half: bool = False,
    overwrite: bool = False,
) -> None:
    """Turn the authors' released checkpoints into a model folder.

    Args:
        checkpoints: Folder with transformer.ckpt, image-vae.ckpt and pose-vae.ckpt.
        output: New folder for the model.
        text_encoder: Folder with the CLIP text model; stores the embedding of the empty prompt, so that CLIP is needed
            no more.
        half: Store in half precision (the raymap autoencoder never is).
        overwrite: Replace an earlier model there.
    """
    import torch

    from fb_core import checkpoint

    dtype = torch.float16 if half else None
    folder = checkpoint.convert(checkpoints, output, dtype=dtype, text_encoder=text_encoder, overwrite=overwrite)
    logging.getLogger(__name__).info("wrote the model to %s", folder)


def complete(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    output: Path,
    scene: tyro.conf.OmitArgPrefixes[TypedCompleteOptions] = TypedCompleteOptions(),
    overwrite: bool = False,
) -> None:
    """Complete a scene from photos alone: cameras, splats, views of what no photo shows; leaves a film, and a capture
    for ns-train.

    Args:
        source: Folder of photos, film, or posed capture (whose cameras are then known).
        output: New folder: capture, splats.ply, fly-through.mp4, trust.mp4, sheet.png, cameras.png, raymaps,
            report.json.
        scene: How cameras are found, and what the film shows.
        overwrite: Replace an earlier output there.
    """
    options = looked_at(scene, CompleteOptions)
    from method_configs.commands.complete.command import complete_scene

    complete_scene(source, output, options, overwrite=overwrite)


def demo(
    *,
    output: Path = Path("outputs/demo"),
    seed: int = 0,
    iterations: int = 1500,
    model: Path | None = None,
) -> None:
    """Complete a small room from end to end and compare with plain splatting, on this machine.

    Args:
        output: Folder for the capture, both runs, report.png and metrics.json; an earlier demo there is replaced.
        seed: Which room.
        iterations: Training steps of each run.
        model: Model folder; by default the bundled one.
    """
    from method_configs.commands.demo import run_demo

    run_demo(output, seed=seed, iterations=iterations, model=model)


def sheet(
    run: Annotated[Path, tyro.conf.Positional], /, *, output: Path = Path("sheet.png"), before: Path | None = None
) -> None:
    """Draw what a run of ns-train was given, what it generated, and what it renders, as one picture.

    Args:
        run: Folder of the run, which holds config.yml.
        output: The picture.
        before: Folder of another run on the same capture, drawn too at the same cameras, for a picture of before and
            after.
    """
    from method_configs.commands.sheet import write_sheet

    write_sheet(run, output, before=before)


def export(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    format: Literal["nerfstudio", "colmap"],
    output: Path | None = None,
    held_out: bool = True,
    overwrite: bool = False,
) -> None:
    """Write the completed capture of a run, captured and generated views, as a dataset for other tools.

    Args:
        run: Folder of the run, which holds config.yml; finished, or killed after it had generated views.
        format: nerfstudio writes transforms.json, colmap a model in sparse/0.
        output: Folder of the dataset; by default export-nerfstudio or export-colmap in the run's folder.
        held_out: Also write the captured views that the run did not train on; lists tell them apart.
        overwrite: Replace an earlier export there.
    """
    from method_configs.commands.export import export_run

    export_run(run, format=format, output=output, held_out=held_out, overwrite=overwrite)


_FORMATS = {"figure": (".png", ".svg", ".pdf"), "sheet": (".png",)}


def bench(
    *,
    benchmark: tyro.conf.OmitArgPrefixes[
        Annotated[Networks, tyro.conf.subcommand("networks")]
        | Annotated[Precision, tyro.conf.subcommand("precision")]
        | Annotated[Sampler, tyro.conf.subcommand("sampler")]
        | Annotated[Poses, tyro.conf.subcommand("poses")]
        | Annotated[Splat, tyro.conf.subcommand("splat")]
        | Annotated[Fit, tyro.conf.subcommand("fit")]
        | Annotated[Methods, tyro.conf.subcommand("methods")]
        | Annotated[Inference, tyro.conf.subcommand("inference")]
        | Annotated[Paper, tyro.conf.subcommand("paper")]
        | Annotated[Builds, tyro.conf.subcommand("builds")]
        | Annotated[Costs, tyro.conf.subcommand("costs")]
        | Annotated[Photos, tyro.conf.subcommand("photos")]
    ],
) -> None:
    """Measure time, memory and error on this machine."""
    _measure(benchmark)


def evaluate(
    *,
    evaluation: tyro.conf.OmitArgPrefixes[
        Annotated[Rooms, tyro.conf.subcommand("rooms")]
        | Annotated[Scaling, tyro.conf.subcommand("scaling")]
        | Annotated[Uncalibrated, tyro.conf.subcommand("uncalibrated")]
        | Annotated[Ablations, tyro.conf.subcommand("ablations")]
        | Annotated[Conditioning, tyro.conf.subcommand("conditioning")]
        | Annotated[Consistency, tyro.conf.subcommand("consistency")]
        | Annotated[ModelOnCaptures, tyro.conf.subcommand("model")]
        | Annotated[Masked, tyro.conf.subcommand("masked")]
        | Annotated[Designs, tyro.conf.subcommand("designs")]
        | Annotated[Scene, tyro.conf.subcommand("scene")]
        | Annotated[Trust, tyro.conf.subcommand("trust")]
    ],
) -> None:
    """Measure how good a model is on unseen rooms, and a completed scene on photos that it was not given."""
    _measure(evaluation)


class _Measures(Protocol):
    """What ``bench`` and ``eval`` run."""

    def run(self) -> None:
        """Measure and report."""
        ...


def _measure(command: _Measures) -> None:
    """Measures; where Ctrl-C ends it, also within a training of a design, KeyboardInterrupt says what is kept."""
    _require_usable(command)
    try:
        command.run()
    except (KeyboardInterrupt, SystemExit) as error:
        if isinstance(error, SystemExit) and error.code != ENDED_BY_USER:
            raise
        raise KeyboardInterrupt(_what_is_kept(command)) from error


def _what_is_kept(command: _Measures) -> str:
    begins_anew, goes_on = "Nothing was kept; ", "the same command goes on from there."
    if isinstance(command, Methods | Paper | Ablations | Designs):
        return f"What is whole is kept in {command.output}; {goes_on}"
    if isinstance(command, Builds) or not isinstance(command, TableFiles):
        return f"{begins_anew}the same command begins anew."
    if command.keep is None:
        return f"{begins_anew}with --keep FOLDER the same command goes on where it was."
    return f"What was measured is kept in {command.keep}; {goes_on}"


def _require_usable(command: object) -> None:
    """Raises ValueError, before hours of measuring, where a result could not be written in the end (another file or
    another result of the same command has its place, no folder can be made there, figures have no such format), and for
    a seed that nothing can be drawn with.
    """
    places: dict[Path, str] = {}
    for name in ("json", "csv", "markdown", "figure", "sheet"):
        path = getattr(command, name, None)
        if isinstance(path, Path):
            require_own_or_new(path)
            _require_folder(path.parent)
            is_device = path.exists() and not path.is_file()
            if not is_device and (other := places.setdefault(path.absolute(), name)) != name:
                raise ValueError(f"{name}: {path} is the place of --{other} already; choose another name")
            if name in _FORMATS and path.suffix.lower() not in _FORMATS[name]:
                raise ValueError(
                    f"{name}: expected a name that ends with {', '.join(_FORMATS[name])}, got {path.name}; rename it"
                )
    for name in ("keep", "output"):
        if isinstance(folder := getattr(command, name, None), Path):
            _require_folder(folder)
    require_between("seed", getattr(command, "seed", 0), 0, MOST_SEED)


def _require_folder(folder: Path) -> None:
    """Raises ValueError where a folder neither is nor can be made, because a file has the place of one above it."""
    there = next((one for one in (folder, *folder.absolute().parents) if one.exists()), None)
    if there is not None and not there.is_dir():
        raise ValueError(
            f"{folder}: expected a folder, or a place for one, but {there} is a file; choose another place"
        )


def compile_() -> None:
    """Compile the drawing of splats for this machine's CPU, once (needs gcc or clang): twice as fast, same pictures."""
    from method_configs.commands.compilation import compile_splats

    compile_splats()


def check(*, mend: bool = False) -> None:
    """Say what this machine lacks, in one sentence each.

    Args:
        mend: Install OpenCV's contrib build again if another build has replaced it.
    """
    from method_configs import environment

    environment.check(mend=mend)


COMMANDS: dict[str, Callable[..., None]] = {
    "rooms": rooms,
    "train": train,
    "convert": convert,
    "complete": complete,
    "demo": demo,
    "sheet": sheet,
    "export": export,
    "bench": bench,
    "eval": evaluate,
    "compile": compile_,
    "check": check,
}
"""Every subcommand by its name."""


def main(arguments: Sequence[str] | None = None) -> None:
    """The console script. An error that a user can mend is one sentence on stderr and a non-zero exit code."""
    _show_log()
    with signals_given_back():  # whoever calls this from Python keeps their own
        stop_on_signals()
        try:
            tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="fillerbuster",
                description=f"Complete casual captures. Set {DEBUG_VARIABLE}=1 for tracebacks.",
                args=None if arguments is None else list(arguments),
            )
        except KeyboardInterrupt as error:
            _stop(error, f"Stopped. {error}", ENDED_BY_USER)
        except (ValueError, FloatingPointError, OSError) as error:
            _stop(error, f"Error: {sentence_of(error)}", 1)


def _stop(error: BaseException, sentence: str, code: int) -> None:
    if os.environ.get(DEBUG_VARIABLE):
        raise error
    sys.stderr.write(" ".join(sentence.split()) + "\n")
    sys.exit(code)


def _show_log() -> None:
    """Our own messages from INFO upwards, other packages' from WARNING upwards, on stderr in rich's manner.

    What packages tell each other of their future (FutureWarning) is nothing that a user can mend.
    """
    import warnings

    warnings.simplefilter("ignore", FutureWarning)
    from rich.console import Console
    from rich.logging import RichHandler

    handler = RichHandler(
        console=Console(stderr=True, soft_wrap=True), show_time=False, show_path=False, show_level=False, markup=False
    )
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    for package in ("fb_core", "fb_nerfstudio", "method_configs"):
        logging.getLogger(package).setLevel(logging.INFO)


if __name__ == "__main__":
    main()
