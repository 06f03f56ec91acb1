"""Pictures on disk with EXIF tags."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

EXIF_OF_PHONE = {"Make": "Acme", "Model": "Acme One", "FocalLength": 4.25, "FocalLengthIn35mmFilm": 26}
_TAGS = {"Make": 0x010F, "Model": 0x0110, "Orientation": 0x0112}
_IFD_TAGS = {
    "FocalLength": 0x920A,
    "FocalLengthIn35mmFilm": 0xA405,
    "FocalPlaneXResolution": 0xA20E,
    "FocalPlaneResolutionUnit": 0xA210,
    "ExifImageWidth": 0xA002,
    "ExifImageHeight": 0xA003,
    "DateTimeOriginal": 0x9003,
    "SubsecTimeOriginal": 0x9291,
    "LensModel": 0xA434,
}


def scene(number: int = 0, height: int = 60, width: int = 80) -> np.ndarray:
    """A picture unlike those of other numbers."""
    coarse = np.random.default_rng(number).random((6, 8, 3)).astype(np.float32)
    return (cv2.resize(coarse, (width, height)) * 255).astype(np.uint8)


def save(path: Path, array: np.ndarray, **tags: object) -> Path:
    """Writes a picture with EXIF tags by name."""
    exif = Image.Exif()
    inner = exif.get_ifd(0x8769)
    for name, value in tags.items():
        value = IFDRational(value) if isinstance(value, float) else value
        (exif if name in _TAGS else inner)[{**_TAGS, **_IFD_TAGS}[name]] = value
    options = {"exif": exif} if tags else {}
    Image.fromarray(array).save(
        path, **options, **({"quality": 95} if path.suffix.lower() in (".jpg", ".webp") else {})
    )
    return path


def as_tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1).float() / 255
