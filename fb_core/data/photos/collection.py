"""What a person brings: a folder of photos, a film or a posed capture, read as one list of photos.

Files are looked at one after the other and only small pictures of them are kept; :meth:`Photo.load` decodes again when
pixels are needed. What cannot be read is left out and named, as long as two photos remain.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.frames import Frame
from fb_core.data.capture.layouts import layout_of
from fb_core.data.capture.own_files import lies_inside
from fb_core.data.photos import video
from fb_core.data.photos.choice import choose_by_coverage
from fb_core.data.photos.exif import read_exif
from fb_core.data.photos.panoramas import around_fault, goes_on_at_its_edge, panorama_fault
from fb_core.data.photos.photo import Photo, Pixels, shrunk

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".exr", ".bmp", *media.HEIF_SUFFIXES)
THUMBNAIL_SIDE = 96
FILM_FRAMES = 32
"""How many frames of a film are read when the caller does not say."""
_MASKS = {"mask", "masks", "mask_images", "alpha"}  # folders beside photos, as tools name them
_logger = logging.getLogger(__name__)


def read_photos(source: Path, *, most: int | None = None) -> list[Photo]:
    """The photos of a folder (in natural order of names), of a film (in order of time), or of a posed capture (in its
    order).

    Args:
        source: a folder of JPEG, PNG, WebP, TIFF, EXR, BMP or (with the extra ``heic``) HEIC files; a film; a posed
            capture in any layout, whose generated views are left out.
        most: at most so many. Photos are chosen by coverage and keep their order; frames by sharpness and even motion,
            and they are ``FILM_FRAMES`` when None.

    Raises:
        ValueError: one sentence, when fewer than two photos can be read.
    """
    source = Path(source)
    if most is not None and most < 2:
        raise ValueError(f"read_photos: expected most of at least 2 photos, got {most}")
    try:
        if not source.exists():
            raise ValueError(f"photos {source}: no such folder or film; check the path")
        if source.is_dir() and layout_of(source) is None:
            photos = _of_folder(source)
        elif source.is_dir() or source.suffix.lower() == ".json":
            photos = _of_capture(source)
        else:
            return _of_film(source, most or FILM_FRAMES)
    except PermissionError as error:
        raise ValueError(
            f"photos {source}: {error.filename or source} may not be read (permission denied); change its permissions"
        ) from error
    if most is None or len(photos) <= most:
        return photos
    return [photos[index] for index in choose_by_coverage(photos, most)]


# ---- folders --------------------------------------------------------------------------------------------------------


def _of_folder(folder: Path) -> list[Photo]:
    files = sorted(
        (path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")), key=natural_order
    )
    photos = [path for path in files if path.suffix.lower() in PHOTO_SUFFIXES]
    if not photos:
        raise ValueError(f"photos {folder}: expected at least 2 photos in the folder, got {_what_else(folder, files)}")
    if masks := [path.name for path in sorted(folder.iterdir()) if path.is_dir() and path.name.lower() in _MASKS]:
        _logger.warning(
            "%s: the folder %s is not used; give photos their masks as alpha channels, or a capture with mask_path",
            folder,
            masks[0],
        )
    names = _unique_names([path.stem for path in photos])
    return _readable(folder, [(path, partial(_still, path, name)) for path, name in zip(photos, names, strict=True)])


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sorting key of file names in which numbers count as numbers: IMG_2 before IMG_10."""
    parts = re.findall(r"\d+|\D+", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _what_else(folder: Path, files: list[Path]) -> str:
    films = [path for path in files if path.suffix.lower() in video.FILM_SUFFIXES]
    if films:
        return f"none but a film; give the film itself: {films[0]}"
    inside = [path.name for path in sorted(folder.iterdir()) if path.is_dir() and not path.name.startswith(".")]
    if inside and not files:
        return f"only folders; give the one with the photos: {folder / inside[0]}"
    suffixes = ", ".join(sorted({path.suffix.lower() or path.name for path in files})) or "an empty folder"
    return f"{suffixes}; use JPEG, PNG, WebP, TIFF, EXR or HEIC"


def _still(path: Path, name: str) -> Photo:
    def pixels() -> Pixels:
        return _still_pixels(path)

    image, mask = pixels()
    if fault := panorama_fault(path, image):
        raise ValueError(f"image {path}: {fault}")
    size = (image.shape[1], image.shape[2])
    exif = read_exif(path, size)
    return Photo(
        name=name,
        source=path,
        size=size,
        focal_prior=exif.focal_pixels,
        device=f"{exif.lens} {max(size)} x {min(size)}" if exif.lens else "",
        seconds=exif.seconds,
        camera=None,
        thumbnail=shrunk((image, mask), THUMBNAIL_SIDE)[0],
        pixels=pixels,
    )


def _still_pixels(path: Path) -> Pixels:
    image, alpha = media.read_photo(path)
    return image, torch.ones_like(image[:1]) if alpha is None else alpha


# ---- posed captures -------------------------------------------------------------------------------------------------


def _of_capture(folder: Path) -> list[Photo]:
    capture = read_capture(folder)
    frames = capture.photos.frames
    if len(frames) < len(capture):
        _logger.info("capture %s: %d generated views are left out", folder, len(capture) - len(frames))
    names = _unique_names([frame.image_path.stem for frame in frames])
    read = partial(_captured, root=capture.root)
    return _readable(
        folder, [(frame.image_path, partial(read, frame, name)) for frame, name in zip(frames, names, strict=True)]
    )


def _captured(frame: Frame, name: str, *, root: Path) -> Photo:
    for path in (frame.image_path, frame.mask_path):
        if path is not None and not lies_inside(path, root):
            raise ValueError(
                f"image {path}: outside of the capture {root}, whose pictures are copied; copy it there to have it "
                "along"
            )

    def pixels() -> Pixels:
        return frame.load_undistorted()[:2]

    image, mask, camera = frame.load_undistorted()
    intrinsics = [*camera.focal[0].tolist(), *camera.principal[0].tolist(), camera.width, camera.height]
    return Photo(
        name=name,
        source=frame.image_path,
        size=(camera.height, camera.width),
        focal_prior=float(camera.focal.mean()),
        device="capture " + " ".join(f"{value:g}" for value in intrinsics),
        seconds=None,
        camera=camera,
        thumbnail=shrunk((image, mask), THUMBNAIL_SIDE)[0],
        pixels=pixels,
    )


# ---- films ----------------------------------------------------------------------------------------------------------


def _of_film(path: Path, most: int) -> list[Photo]:
    if path.suffix.lower() in PHOTO_SUFFIXES:
        raise ValueError(
            f"photos {path}: expected a folder of at least 2 photos, or a film, got one photo; give its folder: "
            f"{path.parent}"
        )
    film = video.read_film(path, most)
    photos = [
        Photo(
            name=f"frame_{frame.number:05d}",
            source=path,
            size=film.size,
            focal_prior=None,
            device=f"film {path.name}",
            seconds=frame.seconds,
            camera=None,
            thumbnail=media.shrink(film.load(frame), THUMBNAIL_SIDE),
            pixels=lambda frame=frame: _all_known(film.load(frame)),
        )
        for frame in film.frames
    ]
    if sum(goes_on_at_its_edge(photo.thumbnail) for photo in photos) > len(photos) / 2:
        raise ValueError(f"film {path}: {around_fault(film.size, kind='video')}")
    return photos


def _all_known(image: Float[Tensor, "3 h w"]) -> Pixels:
    return image, torch.ones_like(image[:1])


# ---- what all share -------------------------------------------------------------------------------------------------


def _readable(source: Path, readers: list[tuple[Path, Callable[[], Photo]]]) -> list[Photo]:
    """The photos that can be read; the others are named in one warning each, or in the error when fewer than two
    remain.
    """
    photos, faults = [], []
    for path, read in readers:
        try:
            photos.append(read())
        except (ValueError, OSError) as error:
            faults.append(str(error))
        except Exception as error:  # libraries raise what they like for a damaged file; one photo must not end all
            faults.append(f"image {path}: not readable ({type(error).__name__}: {' '.join(str(error).split())[:200]})")
    if len(photos) < 2:
        reason = (
            f" ({len(faults)} cannot be read; the first: {faults[0]})"
            if faults
            else "; add photos that show the same scene from elsewhere"
        )
        raise ValueError(f"photos {source}: expected at least 2 photos, got {len(photos)}{reason}")
    for fault in faults:
        _logger.warning("left out: %s", fault)
    return photos


def _unique_names(stems: list[str]) -> list[str]:
    """File names for the stems, different even where the file system ignores case; a second IMG_1 becomes IMG_1_2."""
    names: list[str] = []
    taken = {_as_file_name(stem).lower() for stem in stems}
    used: set[str] = set()
    for stem in stems:
        name = base = _as_file_name(stem)
        number = 2
        while name.lower() in used or (name != base and name.lower() in taken):
            name, number = f"{base}_{number}", number + 1
        used.add(name.lower())
        names.append(name)
    return names


def _as_file_name(stem: str) -> str:
    return re.sub(r"[^\w.-]", "_", stem).strip(".") or "photo"
