"""The folder that ``fillerbuster complete`` leaves: a capture for ns-train, a film, pictures to look at, raymaps and a report."""

from __future__ import annotations

import json
import logging
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.captures import Capture, Frame, split_lists, write_transforms
from fb_core.data.film import write_film
from fb_core.data.photos import Photo
from fb_core.data.points import Points, read_points
from fb_core.evaluation.camera_figure import draw_cameras
from fb_core.evaluation.contact_sheet import Strip, write_contact_sheet
from fb_core.files.faults import is_of_the_disk
from fb_core.fly_through import FoundCameras
from fb_core.geometry.cameras import Pinholes
from fb_core.json_files import read_json

REPORT_NAME = "report.json"
COMMAND = "fillerbuster complete"
"""What the report says of its origin."""
KIND = "completed scene"
"""What the folder's mark says."""
_WRITTEN = {"images", "masks", "raymaps", "transforms.json", "points3D.ply", "fly-through.mp4", "sheet.png", "cameras.png", REPORT_NAME}
_CHANNELS = tuple(f"{kind}.{axis}" for kind in ("origin", "direction") for axis in "xyz")
_SHOWN_SIDE = 256
_MODEL = "PINHOLE"
_HELD_OUT_EVERY = 8  # photos; with fewer, all are trained on
_SHEET_COLUMNS, _MOST_SHOWN, _CAPTION = 8, 48, 20
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class NewViews:
    """Generated views."""

    images: Float[Tensor, "n 3 s s"]
    """RGB in [0, 1]."""
    cameras: Pinholes
    """Square, in the photos' world."""
    origins: list[dict[str, Any]]
    """What each frame says of where it came from."""


@dataclass(frozen=True, kw_only=True)
class World:
    """What a posed capture brings along beside its cameras."""

    extra: dict[str, Any]
    """Top-level keys of transforms.json."""
    points_path: Path | None = None
    """Its point cloud."""
    straight: frozenset[Path] = frozenset()
    """Its pictures without lens distortion."""


def write_folder(
    folder: Path, photos: list[Photo], left_out: dict[str, str], found: FoundCameras, new: NewViews | None, world: World, *, fps: float
) -> None:
    """Everything but the report.

    Args:
        folder: exists, and is empty.
        photos: all that were registered.
        left_out: names of photos that were not, with the reason.
        found: their cameras.
        new: None when only cameras were asked for, or none could be trusted.
        world: that of the cameras.
        fps: of the film.
    """
    trusted = found.trusted
    if trusted:
        points = None if world.points_path is None else read_points(world.points_path)
        _write_capture(folder, photos, found, new, world, points is not None)
        if world.points_path is not None:
            shutil.copyfile(world.points_path, folder / "points3D.ply")
        _draw(folder / "cameras.png", photos, found, new, points)
    _write_raymaps(folder / "raymaps", photos, found)
    _write_sheet(folder / "sheet.png", photos, left_out, found, new)
    if new is not None:
        write_film(folder / "fly-through.mp4", new.images, frames_per_second=fps)


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """report.json, without values that JSON does not know."""
    (folder / REPORT_NAME).write_text(json.dumps(_plain(report), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def is_ours(folder: Path) -> bool:
    """Whether a version of this command that wrote no marks made the folder, and nobody has put anything into it since."""
    try:
        if {entry.name for entry in folder.iterdir()} - _WRITTEN:
            return False
        report = read_json(folder / REPORT_NAME)
    except (OSError, ValueError):
        return False
    return isinstance(report, dict) and report.get("command") == COMMAND


def _plain(value: Any) -> Any:
    """NaN becomes null, paths become texts."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


# ---- the capture --------------------------------------------------------------------------------------------------------------


def _write_capture(folder: Path, photos: list[Photo], found: FoundCameras, new: NewViews | None, world: World, with_points: bool) -> None:
    (folder / "images").mkdir()
    trusted = found.trusted
    masks = [photos[index].load_mask() for index in trusted]
    masked = any(bool((mask < 1).any()) for mask in masks)
    frames = []
    for place, (index, mask) in enumerate(zip(trusted, masks, strict=True)):
        photo, camera = photos[index], found.camera(index)
        verdict, residual = found.registration.verdicts[index], found.registration.residuals_degrees[index]
        as_it_is = photo.stored and (photo.camera is None or photo.source in world.straight)
        extra = {"generated": False, "camera": verdict, **({} if math.isnan(residual) else {"residual_degrees": residual})}
        extra |= {} if new is None else {"held_out": place % _HELD_OUT_EVERY == _HELD_OUT_EVERY - 1}
        frames.append(
            Frame(
                image_path=_write_photo(photo, folder / "images", as_it_is=as_it_is),
                mask_path=_write_mask(folder, photo.name, mask) if masked else None,
                camera=camera,
                camera_model=_MODEL,
                extra=extra,
            )
        )
    extra = world.extra
    if new is not None:  # lists, since a reader's own choice would hold out generated frames as well
        frames += _generated_frames(folder, new, {photo.name for photo in photos}, masked)
        extra = extra | split_lists(frames, folder)
    points_path = folder / "points3D.ply" if with_points else None
    write_transforms(Capture(root=folder, frames=tuple(frames), points_path=points_path, extra=extra), folder)


def _write_photo(photo: Photo, folder: Path, *, as_it_is: bool) -> Path:
    """The photo at full size: its own file, byte for byte, if that is what every tool reads as this picture, else a PNG."""
    if as_it_is and _is_plain(photo):
        target = folder / f"{photo.name}{photo.source.suffix.lower()}"
        shutil.copyfile(photo.source, target)
        return target
    target = folder / f"{photo.name}.png"
    media.write_image(target, photo.load())
    return target


def _is_plain(photo: Photo) -> bool:
    """JPEG or PNG of 8-bit colours, stored upright."""
    from PIL import ExifTags, Image

    if photo.source.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        return False
    with Image.open(photo.source) as stored:
        upright = stored.getexif().get(ExifTags.Base.Orientation, 1) in (0, 1)
        return upright and stored.mode == "RGB" and stored.size == (photo.size[1], photo.size[0])


def _generated_frames(folder: Path, new: NewViews, taken: set[str], masked: bool) -> list[Frame]:
    prefix = "generated"
    while any(name.startswith(prefix) for name in taken):
        prefix += "_new"
    frames = []
    for index, origin in enumerate(new.origins):
        name = f"{prefix}_{index:04d}"
        media.write_image(folder / "images" / f"{name}.png", new.images[index])
        frames.append(
            Frame(
                image_path=folder / "images" / f"{name}.png",
                mask_path=_write_mask(folder, name, new.images[index][:1] * 0 + 1) if masked else None,
                camera=new.cameras[index],
                camera_model=_MODEL,
                extra={"generated": True, **origin},
            )
        )
    return frames


def _write_mask(folder: Path, name: str, mask: Float[Tensor, "1 h w"]) -> Path:
    target = folder / "masks" / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    media.write_image(target, (mask >= 0.5).to(mask))
    return target


# ---- pictures to look at, and raymaps -----------------------------------------------------------------------------------------


def _draw(path: Path, photos: list[Photo], found: FoundCameras, new: NewViews | None, points: Points | None) -> None:
    """A machine that cannot draw in three dimensions keeps all the rest."""
    trusted = found.trusted
    pictures = [photos[index].load(_SHOWN_SIDE) for index in trusted]
    try:
        draw_cameras(path, [found.camera(index) for index in trusted], pictures, new=None if new is None else new.cameras, points=points)
    except (ImportError, RuntimeError, OSError) as error:
        if is_of_the_disk(error):
            raise
        path.unlink(missing_ok=True)
        _logger.warning("cameras.png is left out, for this machine draws nothing off-screen: %s", error)


def _write_raymaps(folder: Path, photos: list[Photo], found: FoundCameras) -> None:
    """What the model denoised, one EXR per photo, with channels origin.x to direction.z, in the model's own frame."""
    if found.raymaps is None:
        return
    folder.mkdir()
    for photo, raymap in zip(photos, found.raymaps, strict=True):
        if bool(raymap.isfinite().all()):
            media.write_exr(folder / f"{photo.name}.exr", dict(zip(_CHANNELS, raymap, strict=True)))


def _write_sheet(path: Path, photos: list[Photo], left_out: dict[str, str], found: FoundCameras, new: NewViews | None) -> None:
    trusted = found.trusted
    others = [index for index in range(len(photos)) if index not in trusted]
    strips = [
        _strip("Photos with a camera", [photos[index] for index in trusted], [""] * len(trusted)),
        _strip("Photos left out", [photos[index] for index in others], [found.registration.verdicts[index] for index in others]),
    ]
    count = 0 if new is None else len(new.images)
    if new is not None:
        strips.append(Strip(heading=f"New views along the path ({count})", pictures=list(new.images)))
    title = f"{len(trusted)} of {len(photos) + len(left_out)} photos with a camera, {count} new views"
    subtitle = {"known": "cameras were given", "model": "cameras by the model", "features": "cameras by features"}[found.method]
    write_contact_sheet(path, strips, title=title, subtitle=subtitle, columns=_SHEET_COLUMNS)


def _strip(heading: str, photos: list[Photo], verdicts: list[str]) -> Strip:
    shown = list(zip(photos, verdicts, strict=True))[:_MOST_SHOWN]
    return Strip(
        heading=f"{heading} ({len(photos)})" if len(shown) == len(photos) else f"{heading} ({len(shown)} of {len(photos)})",
        pictures=[photo.load(_SHOWN_SIDE) for photo, _ in shown],
        captions=[f"{photo.name[: _CAPTION - len(verdict)]} {verdict}".strip() for photo, verdict in shown],
    )
