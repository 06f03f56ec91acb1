"""What a photo's EXIF data tells about its camera: which device, its focal length in pixels, and when."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fb_core.data import media

_FILM_DIAGONAL = math.hypot(36.0, 24.0)  # millimetres; "35 mm equivalent" compares diagonals (CIPA DCG-001)
_UNITS_IN_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit


@dataclass(frozen=True, kw_only=True)
class Exif:
    """The facts of one photo's EXIF data; what is absent or nonsense is None or empty."""

    lens: str = ""
    """Maker, model, lens, and its focal length in millimetres and in pixels (which digital zoom changes), as far as
    they are known.
    """
    focal_pixels: float | None = None
    """Focal length in pixels of the picture's full size."""
    seconds: float | None = None
    """When it was taken, in seconds since 1970 by the camera's clock."""


def read_exif(path: Path, size: tuple[int, int]) -> Exif:
    """The EXIF facts of a picture of ``size`` (height, width; upright or not)."""
    tags = _tags(path)
    millimetres = _positive(tags.get("FocalLength"))
    pixels = _focal_pixels(tags, millimetres, size)
    focal = [f"{value:.4g} {unit}" for value, unit in ((millimetres, "mm"), (pixels, "px")) if value is not None]
    return Exif(lens=" ".join([*_camera(tags), *focal]), focal_pixels=pixels, seconds=_seconds(tags))


def _tags(path: Path) -> dict[str, Any]:
    """All EXIF tags by name; empty where the file has none, damaged ones, or a format that Pillow does not know
    (EXR).
    """
    from PIL import ExifTags, Image

    def numbered(exif: Image.Exif) -> dict[int, Any]:
        return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}

    try:
        with warnings.catch_warnings(action="ignore"):
            if path.suffix.lower() in media.HEIF_SUFFIXES:
                exif = Image.Exif()
                exif.load(media.opened_heif(path).info.get("exif") or b"")
                tags = numbered(exif)
            else:
                with Image.open(
                    path
                ) as image:  # not OpenImageIO, which reads none of WebP files and only some of TIFF files
                    tags = numbered(image.getexif())
    except (OSError, SyntaxError, TypeError, ValueError, KeyError, Image.DecompressionBombError):
        return {}
    return {ExifTags.TAGS[number]: value for number, value in tags.items() if number in ExifTags.TAGS}


def _focal_pixels(tags: dict[str, Any], millimetres: float | None, size: tuple[int, int]) -> float | None:
    """From the 35 mm equivalent, else from the lens's focal length and the sensor's pixels per length, else None."""
    equivalent = _positive(tags.get("FocalLengthIn35mmFilm"))
    if equivalent is not None:
        return equivalent * math.hypot(*size) / _FILM_DIAGONAL
    density = _positive(tags.get("FocalPlaneXResolution"))
    unit = _UNITS_IN_MILLIMETRES.get(int(_positive(tags.get("FocalPlaneResolutionUnit")) or 2))
    if millimetres is None or density is None or unit is None:
        return None
    taken = max(_positive(tags.get(key)) or 0.0 for key in ("ExifImageWidth", "ExifImageHeight"))
    shrunk = max(size) / taken if taken else 1.0  # a picture made smaller later keeps the tags of the sensor's pixels
    return millimetres * density / unit * shrunk


def _camera(tags: dict[str, Any]) -> list[str]:
    """Maker, model and lens, as far as they are told; a maker that stands in the model's name already is not
    repeated.
    """
    maker, model, lens = (
        " ".join(str(tags.get(key, "")).split("\0")[0].split()) for key in ("Make", "Model", "LensModel")
    )
    if maker and model.lower().startswith(maker.lower()):
        maker = ""
    return [part for part in (maker, model, lens) if part]


def _seconds(tags: dict[str, Any]) -> float | None:
    text = str(tags.get("DateTimeOriginal") or tags.get("DateTime") or "").strip("\0 ")
    try:
        whole = datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
        return whole + float(f"0.{str(tags.get('SubsecTimeOriginal', '')).strip() or 0}")
    except ValueError:
        return None


def _positive(value: Any) -> float | None:
    """A finite number above 0, else None: cameras write 0 where they do not know."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
