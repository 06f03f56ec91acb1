"""Going on from a checkpoint: which file that is, whether it belongs to this capture, and whether its tensors fit these
options.
"""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.models.splatfacto import num_sh_bases

from fb_nerfstudio.capture.dataparser import without_open3d

_GAUSSIANS = "_model.gauss_params."
_CORRECTIONS = "_model.camera_optimizer.pose_adjustment"
_GRIDS = "_model.bil_grids.grids"
# Of the largest coordinate, at least of 1: far more than machines differ by, far less than another capture does
_MOVED = 1e-3
_OTHER_LENS = 1e-3  # of the focal length
_INSIST = "--other-capture True goes on all the same"


@dataclass(frozen=True, kw_only=True)
class CaptureIdentity:
    """What tells one capture from another: the photos that are trained on, their cameras and sizes, as the dataparser
    gives them.

    The dataparser's options are part of that: they decide the world that the splats stand in.
    """

    names: tuple[str, ...]
    """File names with their folder, whatever smaller copies are read."""
    poses: torch.Tensor
    """[n, 3, 4] camera-to-world in the training world, float32, OpenGL axes."""
    lenses: torch.Tensor
    """[n, 2] focal lengths, pixels, float32."""
    sizes: torch.Tensor
    """[n, 2] widths and heights, pixels, int64."""

    @staticmethod
    def of(outputs: DataparserOutputs) -> CaptureIdentity:
        """Of the photos that a dataparser has chosen for training."""
        cameras = outputs.cameras
        return CaptureIdentity(
            names=tuple(_plain_name(Path(path)) for path in outputs.image_filenames),
            poses=cameras.camera_to_worlds.float().cpu(),
            lenses=torch.cat([cameras.fx, cameras.fy], dim=-1).reshape(-1, 2).float().cpu(),
            sizes=torch.cat([cameras.width, cameras.height], dim=-1).reshape(-1, 2).long().cpu(),
        )

    def state(self) -> dict[str, Any]:
        """For checkpoints: plain values and tensors."""
        return {"names": list(self.names), "poses": self.poses, "lenses": self.lenses, "sizes": self.sizes}

    @staticmethod
    def from_state(state: dict[str, Any]) -> CaptureIdentity:
        """The inverse of :meth:`state`."""
        return CaptureIdentity(
            names=tuple(state["names"]), poses=state["poses"], lenses=state["lenses"], sizes=state["sizes"]
        )

    def difference(self, earlier: CaptureIdentity) -> str | None:
        """In what this capture differs from an ``earlier`` one, in words; None where it is the same, perhaps in another
        resolution.
        """
        if len(self.names) != len(earlier.names):
            return f"it was trained on {len(earlier.names)} photos, and here are {len(self.names)}"
        for mine, theirs in zip(self.names, earlier.names, strict=True):
            if mine != theirs:
                return f"it was trained on {theirs}, and here is {mine}"
        reach = max(1.0, float(earlier.poses[:, :, 3].abs().max()))
        moved = (self.poses - earlier.poses).abs().amax(dim=1)  # [n, 4]: three axes and the centre
        moved[:, 3] /= reach
        if not bool((moved <= _MOVED).all()):
            return f"the camera of {self.names[int(moved.amax(dim=1).argmax())]} stands elsewhere than it did"
        for name, *numbers in zip(self.names, self.lenses, self.sizes, earlier.lenses, earlier.sizes, strict=True):
            if not _same_camera(*numbers):
                return f"the camera of {name} has another size or focal length than it had"
        return None


def _plain_name(path: Path) -> str:
    """``images_2/a.png`` is the smaller copy of ``images/a.png``."""
    return f"{re.sub(r'_[0-9]+$', '', path.parent.name)}/{path.name}"


def _same_camera(
    lens: torch.Tensor, size: torch.Tensor, earlier_lens: torch.Tensor, earlier_size: torch.Tensor
) -> bool:
    """The same camera, perhaps read from copies that are smaller by a whole factor."""
    if int(size[0]) < int(earlier_size[0]):
        lens, size, earlier_lens, earlier_size = earlier_lens, earlier_size, lens, size
    factor = max(1, round(int(size[0]) / max(1, int(earlier_size[0]))))
    same_size = bool((size // factor == earlier_size).all())
    return same_size and bool(((lens / factor - earlier_lens).abs() <= _OTHER_LENS * earlier_lens.abs()).all())


def check_options_beside_a_file(arguments: Sequence[str]) -> None:
    """Raises ValueError in one sentence for a command line with --load-config and further options, all of which
    nerfstudio ignores.
    """
    options = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    ignored = [option for option in options if option != "--load-config"]
    if "--load-config" in options and ignored:
        raise ValueError(
            f"--load-config: nerfstudio takes every option from that file and ignores {', '.join(ignored[:4])}; leave "
            "it alone, or write "
            "what you want into a copy of the file"
        )


def parsed(datamanager: Any) -> DataparserOutputs:
    """What the dataparser of a datamanager's config gives to train on, without its points; the config stays as it is.

    Raises ValueError in one sentence for whatever the dataparser cannot read, and for files that it names and that are
    not there.
    """
    parser = copy.deepcopy(datamanager.dataparser)
    data = Path(datamanager.data or parser.data)
    parser.data = data
    if hasattr(parser, "load_3D_points"):
        parser.load_3D_points = False
    try:
        outputs = without_open3d(parser).setup().get_dataparser_outputs(split="train")
    except Exception as error:  # whatever a dataparser of nerfstudio's raises
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(
            f"data {data}: {type(parser).__name__} cannot read it ({reason}); mend the data or the dataparser's options"
        ) from None
    if len(outputs.image_filenames) == 0:
        raise ValueError(f"data {data}: the dataparser's options leave no photo to train on; change the split")
    for path in [*outputs.image_filenames, *(outputs.mask_filenames or ())]:
        if not Path(path).is_file():
            raise ValueError(
                f"data {data}: no file {path}, which the dataparser's options ask for; make it, or leave the option out"
            )
    return outputs


def checkpoint_of(config: Any) -> Path | None:
    """The checkpoint that a trainer's options go on from, None for a new run. Raises ValueError in one sentence where
    it is not there.
    """
    folder, step = config.load_dir, config.load_step
    if folder is None:
        if config.load_checkpoint is not None and not config.load_checkpoint.is_file():
            raise ValueError(f"load_checkpoint {config.load_checkpoint}: no such file; check the path")
        return config.load_checkpoint
    there = sorted(folder.glob("step-*.ckpt"))
    if not there:
        raise ValueError(f"load_dir {folder}: no checkpoint (step-*.ckpt) there; give a run's folder nerfstudio_models")
    if step is None:
        return there[-1]
    if (wanted := folder / f"step-{step:09d}.ckpt") not in there:
        steps = ", ".join(str(int(path.stem.removeprefix("step-"))) for path in there[-5:] if path.stem[5:].isdecimal())
        raise ValueError(
            f"load_step {step}: {folder} has no checkpoint of this step, but of {steps}; leave it out for the latest"
        )
    return wanted


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint of ns-train holds, mapped into memory. Raises ValueError for one that is broken or holds more
    than plain values.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        message = " ".join(str(error).split())[:200]
        raise ValueError(
            f"checkpoint {path}: not readable as plain values ({message}); give one that ns-train has saved"
        ) from None
    parts = ("pipeline", "optimizers", "scalers") if isinstance(state, dict) else ()
    if (
        not parts
        or not all(isinstance(state.get(part), dict) for part in parts)
        or not isinstance(state.get("step"), int)
    ):
        raise ValueError(f"checkpoint {path}: it is none of ns-train; give one that ns-train has saved")
    return state


def check_capture(config: Any, path: Path, state: dict[str, Any], outputs: DataparserOutputs) -> None:
    """Raises ValueError in one sentence where a checkpoint was trained on another capture. Older ones know nothing of
    theirs.
    """
    known = (state["pipeline"].get("datamanager._extra_state") or {}).get("capture")
    if known is None or config.other_capture:
        return
    try:
        difference = CaptureIdentity.of(outputs).difference(CaptureIdentity.from_state(known))
    except (KeyError, TypeError, AttributeError, RuntimeError, IndexError):
        difference = "what it says about its own cannot be read"
    if difference is not None:
        data = config.pipeline.datamanager.data or config.pipeline.datamanager.dataparser.data
        raise ValueError(
            f"checkpoint {path} is of another capture than {data}: {difference}; give its own --data ({_INSIST})"
        )


def check_shapes(config: Any, path: Path, state: dict[str, Any], photos: int) -> None:
    """Raises ValueError in one sentence where a checkpoint's tensors do not fit the options of a trainer.

    Args:
        config: the trainer's options.
        path: the checkpoint's.
        state: what it holds.
        photos: how many photos are trained on.
    """
    model, tensors = config.pipeline.model, state["pipeline"]

    def shape(name: str) -> tuple[int, ...] | None:
        value = tensors.get(name)
        return tuple(value.shape) if isinstance(value, torch.Tensor) else None

    def fails(said: str, advice: str) -> ValueError:
        return ValueError(f"checkpoint {path} {said}; {advice}")

    rest = shape(f"{_GAUSSIANS}features_rest") or shape("_model.features_rest")
    if rest is None:
        raise fails("holds no Gaussians", "it is of another method; give one of fillerbuster or splatfacto")
    if rest[1] != num_sh_bases(model.sh_degree) - 1:
        degree = round((rest[1] + 1) ** 0.5) - 1
        raise fails(
            f"has colours of degree {degree}, got sh-degree {model.sh_degree}",
            f"give --pipeline.model.sh-degree {degree}",
        )
    corrections, grids = shape(_CORRECTIONS), shape(_GRIDS)
    if corrections is not None and model.camera_optimizer.mode == "off":
        raise fails(
            "was trained with a camera optimizer, which is off here",
            "give --pipeline.model.camera-optimizer.mode as it was",
        )
    if grids is not None and not model.use_bilateral_grid:
        raise fails(
            "was trained with bilateral grids, which are off here", "give --pipeline.model.use-bilateral-grid True"
        )
    x, y, w = model.grid_shape
    if grids is not None and grids[2:] != (w, y, x):
        shape_then = " ".join(str(side) for side in reversed(grids[2:]))
        raise fails(
            f"has bilateral grids of {shape_then}, got {x} {y} {w}", f"give --pipeline.model.grid-shape {shape_then}"
        )
    for name, saved in {"a camera optimizer": corrections, "bilateral grids": grids}.items():
        if saved is not None and saved[0] != photos:
            raise fails(f"was trained with {name} for {saved[0]} photos, here are {photos}", "give its own --data")
