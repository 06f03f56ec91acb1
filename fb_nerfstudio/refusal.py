"""What cannot be trained on is refused with one sentence, before anything is loaded or written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from fb_core import checkpoint
from fb_core.data.camera_path import read_camera_path
from fb_core.data.captures import Capture, Frame, validate_capture
from fb_core.files.faults import CannotWrite, is_of_the_disk
from fb_core.inpainter import BUNDLED_MODEL, SIDE_MULTIPLE
from fb_nerfstudio.completion_config import CompletionConfig
from fb_nerfstudio.dataparser import smaller_copy
from fb_nerfstudio.grid_inpainter import check_weights


class Refused(SystemExit, ValueError):
    """Input that a person has to mend.

    It is a ValueError for programs. Uncaught it ends a command as SystemExit does: the sentence alone on stderr, exit code 1,
    and no traceback, which nerfstudio's commands would print for any other error.
    """


@contextmanager
def refusing_what_cannot_be_written(folder: Path) -> Iterator[None]:
    """Raises Refused with one sentence where something below a run's folder cannot be written, whoever writes it."""
    try:
        yield
    except OSError as error:
        if not isinstance(error, CannotWrite):
            named = Path(error.filename) if isinstance(error.filename, str | os.PathLike) else None
            if not is_of_the_disk(error) and (named is None or not named.absolute().is_relative_to(folder.absolute())):
                raise
            error = CannotWrite(named or folder, error)
        raise Refused(f"{error}; checkpoints that are there are whole, and --load-dir goes on from them") from None


def refuse_bad_capture(config: Any) -> None:
    """Raises Refused when the data of a datamanager's config is a capture in nerfstudio's format that is broken, or too small."""
    if not isinstance(config.dataparser, NerfstudioDataParserConfig):
        return
    try:
        capture = validate_capture(Path(config.data or config.dataparser.data))
    except ValueError as error:
        raise Refused(str(error)) from None
    if not capture.photos.frames:
        raise Refused(f"capture {capture.root}: all of its {len(capture)} frames are marked as generated; give a capture with photos")
    _refuse_missing_copies(capture.photos, config.dataparser.downscale_factor)
    scale = config.camera_res_scale_factor
    for frame in capture.photos.frames:  # generated views keep their size
        width, height = int(frame.camera.width * scale), int(frame.camera.height * scale)
        if min(width, height) < SIDE_MULTIPLE:
            scaled = "" if scale == 1 else f" after --pipeline.datamanager.camera-res-scale-factor {scale:g}"
            raise Refused(
                f"image {frame.image_path}: expected at least {SIDE_MULTIPLE} x {SIDE_MULTIPLE} pixels, got {width} x {height}{scaled}; "
                "use larger pictures"
            )
    try:
        _refuse_masks(capture.photos, config.completion)
    except ValueError as error:
        raise Refused(str(error)) from None


def _refuse_missing_copies(capture: Capture, factor: int | None) -> None:
    """Raises Refused where smaller copies are asked for that are not there."""
    if factor is None or factor <= capture.reduced:
        return
    for frame in capture.frames:
        copy = smaller_copy(frame.image_path, capture, "images_", factor)
        if not copy.is_file():
            raise Refused(
                f"nerfstudio-data --downscale-factor {factor}: expected the picture {copy}, which is missing; make the smaller copies, or "
                "use --pipeline.datamanager.camera-res-scale-factor, which needs none"
            )


def _refuse_masks(capture: Capture, completion: CompletionConfig) -> None:
    """Raises ValueError for masks that leave nothing to train on, or nothing to inpaint. They are read until one tells."""
    if not any(bool((_mask(frame) > 0).any()) for frame in capture.frames):
        raise ValueError(f"capture {capture.root}: the masks are black everywhere, but white marks pixels that are used; invert the masks")
    inpaints = completion.enabled and completion.task == "inpaint"
    if inpaints and not any(bool((_mask(frame) < 1).any()) for frame in capture.frames):
        raise ValueError(
            f"capture {capture.root}: no picture has unknown pixels to inpaint; give masks that are black there (mask_path), "
            "or complete the scene with new views (ns-train fillerbuster)"
        )


def _mask(frame: Frame) -> torch.Tensor:
    """1 where the frame is known; pictures that can have neither mask nor alpha are not opened."""
    opaque = frame.mask_path is None and frame.image_path.suffix.lower() in (".jpg", ".jpeg")
    return torch.ones(1) if opaque else frame.load_mask()


def refuse_bad_model(config: CompletionConfig) -> None:
    """Raises Refused when views are to be generated by a model folder that is missing, incomplete, truncated or of another shape, with
    a prompt that it cannot read, or along a camera path that is none.

    Weights stay on disk (mapped into memory), so that this takes a moment even for the largest model.
    """
    if not config.enabled:
        return
    try:
        if config.camera_path is not None:
            read_camera_path(config.camera_path, size=SIDE_MULTIPLE)
        if config.inpainter == "grid":
            if config.inpainter_weights is not None:
                check_weights(config.inpainter_weights)
            return
        loaded = checkpoint.load(config.model or BUNDLED_MODEL)
        _refuse_prompt(config, reads_text=bool(loaded.config.transformer.text_width))
    except ValueError as error:
        raise Refused(str(error)) from None


def _refuse_prompt(config: CompletionConfig, *, reads_text: bool) -> None:
    """Raises ValueError for a prompt that the model, or nobody here, can read."""
    if config.prompt and not reads_text:
        raise ValueError(f"completion.prompt: this model reads no text; leave the prompt out, got {config.prompt!r}")
    if config.prompt and config.text_encoder is None:
        raise ValueError(
            f"completion.prompt: {config.prompt!r} needs a text encoder; pip install 'fillerbuster[text]' and give "
            "completion.text_encoder the folder of the CLIP text model"
        )
    if config.text_encoder is not None and reads_text and not config.text_encoder.is_dir():
        raise ValueError(f"completion.text_encoder {config.text_encoder}: no such folder; give the folder of the CLIP text model")
