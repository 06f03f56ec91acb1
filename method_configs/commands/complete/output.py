"""The folder that ``fillerbuster complete`` leaves: a capture for ns-train, a film, pictures to look at, raymaps and a
report.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from fb_core.completion.fly_through import FoundCameras
from fb_core.completion.results.completed_views import Origin
from fb_core.data import media
from fb_core.data.capture.captures import split_lists, write_transforms
from fb_core.data.capture.frames import Capture, Frame
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import copy_points, read_points
from fb_core.data.photos.film import write_film
from fb_core.data.photos.photo import Photo
from fb_core.evaluation.figures.camera_figure import draw_cameras
from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet
from fb_core.files.faults import is_of_the_disk
from fb_core.files.json_files import read_json
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import strided_subset

REPORT_NAME = "report.json"
COMMAND = "fillerbuster complete"
"""What the report says of its origin."""
KIND = "completed scene"
"""What the folder's mark says."""
_WRITTEN = {
    "images",
    "masks",
    "raymaps",
    "transforms.json",
    "points3D.ply",
    "fly-through.mp4",
    "sheet.png",
    "cameras.png",
    REPORT_NAME,
}
_CHANNELS = tuple(f"{kind}.{axis}" for kind in ("origin", "direction") for axis in "xyz")
_SHOWN_SIDE, _TRUST_SIDE = 256, 480
_MODEL = "PINHOLE"
_HELD_OUT_EVERY = 8  # photos; with fewer, all are trained on
_SHEET_COLUMNS, _MOST_SHOWN, _CAPTION = 8, 48, 20
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FilmFiles:
    """A film's frames as files of a folder."""

    folder: Path
    """Where they lie."""
    cameras: Pinholes
    """One for each frame, in the photos' world."""
    splats: Path
    """The Gaussians that it shows, a PLY file."""

    def picture(self, number: int) -> Path:
        """What the splats look like."""
        return self.folder / f"{number:04d}.png"

    def trust(self, number: int) -> Path:
        """What of it was seen, made up, or is empty."""
        return self.folder / f"{number:04d}-trust.png"

    def told(self, number: int) -> Path:
        """JSON file with the shares of the frame that are seen, generated and empty."""
        return self.folder / f"{number:04d}.json"

    def pictures(self, *, trust: bool = False, longest_side: int | None = None) -> Iterator[Float[Tensor, "3 h w"]]:
        """The frames (or their pictures of trust), one after the other."""
        for number in range(len(self.cameras)):
            yield media.shrink(media.read_image(self.trust(number) if trust else self.picture(number)), longest_side)


@dataclass(frozen=True, kw_only=True)
class NewViews:
    """Generated views."""

    images: Float[Tensor, "n 3 s s"]
    """RGB in [0, 1]."""
    masks: Float[Tensor, "n 1 s s"] | None = None
    """1 where the picture is to be trained on; None is everywhere."""
    cameras: Pinholes
    """Square, in the photos' world."""
    origins: tuple[Origin, ...]
    """Where each of them came from."""
    film: FilmFiles | None = None
    """The film of the scene's splats; None where the generated views are the film."""


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
    folder: Path,
    photos: list[Photo],
    left_out: dict[str, str],
    found: FoundCameras,
    new: NewViews | None,
    world: World,
    *,
    fps: float,
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
            copy_points(world.points_path, folder / "points3D.ply")
        _draw(folder / "cameras.png", photos, found, new, points)
    _write_raymaps(folder / "raymaps", photos, found)
    _write_sheet(folder / "sheet.png", photos, left_out, found, new)
    if new is not None and new.film is None:
        write_film(folder / "fly-through.mp4", new.images, frames_per_second=fps)
    elif new is not None and new.film is not None:
        write_film(folder / "fly-through.mp4", new.film.pictures(), frames_per_second=fps)
        write_film(folder / "trust.mp4", new.film.pictures(trust=True, longest_side=_TRUST_SIDE), frames_per_second=fps)
        shutil.copyfile(new.film.splats, folder / "splats.ply")


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """report.json, without values that JSON does not know."""
    (folder / REPORT_NAME).write_text(json.dumps(_plain(report), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def is_ours(folder: Path) -> bool:
    """Whether a version of this command that wrote no marks made the folder, and nobody has put anything into it
    since.
    """
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


# ---- the capture -----------------------------------------------------------------------------------------------------


def _write_capture(
    folder: Path, photos: list[Photo], found: FoundCameras, new: NewViews | None, world: World, with_points: bool
) -> None:
    (folder / "images").mkdir()
    trusted = found.trusted
    masks = [photos[index].load_mask() for index in trusted]
    masked = any(bool((mask < 1).any()) for mask in masks) or (
        new is not None and new.masks is not None and bool((new.masks < 1).any())
    )
    frames = []
    for place, (index, mask) in enumerate(zip(trusted, masks, strict=True)):
        photo, camera = photos[index], found.camera(index)
        verdict, residual = found.registration.verdicts[index], found.registration.residuals_degrees[index]
        as_it_is = photo.stored and (photo.camera is None or photo.source in world.straight)
        extra = {
            "generated": False,
            "camera": verdict,
            **({} if math.isnan(residual) else {"residual_degrees": residual}),
        }
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
    """The photo at full size: its own file, byte for byte, if that is what every tool reads as this picture, else a
    PNG.
    """
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
                mask_path=_write_mask(folder, name, _mask_of(new, index)) if masked else None,
                camera=new.cameras[index],
                camera_model=_MODEL,
                extra=origin.record(),
            )
        )
    return frames


def _mask_of(new: NewViews, index: int) -> Float[Tensor, "1 h w"]:
    return new.images[index][:1] * 0 + 1 if new.masks is None else new.masks[index]


def _write_mask(folder: Path, name: str, mask: Float[Tensor, "1 h w"]) -> Path:
    target = folder / "masks" / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    media.write_image(target, (mask >= 0.5).to(mask))
    return target


# ---- pictures to look at, and raymaps --------------------------------------------------------------------------------


def _draw(path: Path, photos: list[Photo], found: FoundCameras, new: NewViews | None, points: Points | None) -> None:
    """A machine that cannot draw in three dimensions keeps all the rest."""
    trusted = found.trusted
    pictures = [photos[index].load(_SHOWN_SIDE) for index in trusted]
    try:
        path_of_new = None if new is None else new.cameras if new.film is None else new.film.cameras
        draw_cameras(path, [found.camera(index) for index in trusted], pictures, new=path_of_new, points=points)
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


def _write_sheet(
    path: Path, photos: list[Photo], left_out: dict[str, str], found: FoundCameras, new: NewViews | None
) -> None:
    trusted = found.trusted
    others = [index for index in range(len(photos)) if index not in trusted]
    strips = [
        _strip("Photos with a camera", [photos[index] for index in trusted], [""] * len(trusted)),
        _strip(
            "Photos left out",
            [photos[index] for index in others],
            [found.registration.verdicts[index] for index in others],
        ),
    ]
    new_part = f"{0 if new is None else len(new.images)} new views"
    if new is not None and new.film is not None:
        strips += _film_strips(new.film)
        new_part = f"a film of {len(new.film.cameras)} pictures, {new_part} generated"
    elif new is not None:
        strips.append(Strip(heading=f"New views along the path ({len(new.images)})", pictures=list(new.images)))
    title = f"{len(trusted)} of {len(photos) + len(left_out)} photos with a camera, {new_part}"
    subtitle = {"known": "cameras were given", "model": "cameras by the model", "features": "cameras by features"}[
        found.method
    ]
    write_contact_sheet(path, strips, title=title, subtitle=subtitle, columns=_SHEET_COLUMNS)


def _film_strips(film: FilmFiles) -> list[Strip]:
    """Frames with what of each photos have seen, and the pictures of that; equally spaced ones where there are many."""
    chosen = strided_subset(len(film.cameras), _MOST_SHOWN // 2)
    shares = [read_json(film.told(number)) for number in chosen]
    captions = [f"{100 * share['seen']:.0f} % seen" for share in shares]
    frames, trust = (
        [media.shrink(media.read_image(of(number)), _SHOWN_SIDE) for number in chosen]
        for of in (film.picture, film.trust)
    )
    return [
        Strip(heading=f"Film of the splats ({len(chosen)} of {len(film.cameras)})", pictures=frames, captions=captions),
        Strip(heading="The same: grey is seen, orange made up by the model, purple empty", pictures=trust),
    ]


def _strip(heading: str, photos: list[Photo], verdicts: list[str]) -> Strip:
    shown = list(zip(photos, verdicts, strict=True))[:_MOST_SHOWN]
    return Strip(
        heading=f"{heading} ({len(photos)})"
        if len(shown) == len(photos)
        else f"{heading} ({len(shown)} of {len(photos)})",
        pictures=[photo.load(_SHOWN_SIDE) for photo, _ in shown],
        captions=[f"{photo.name[: _CAPTION - len(verdict)]} {verdict}".strip() for photo, verdict in shown],
    )
