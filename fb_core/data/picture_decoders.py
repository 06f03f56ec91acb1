"""How the kinds of picture files are decoded: pixels as they are meant to be shown, names of channels, the orientation
tag.

OpenImageIO reads all but HEIC; both are imported on first use. Source of the EXR windows: OpenEXR's technical
introduction; of the layers'
names: Blender's multi-layer files.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.files.limits import require_decodable, require_text_name

TIFF_SUFFIXES = (".tif", ".tiff")
LEAST_ALPHA = 1e-6
"""What colours are divided by at the least, where they are multiplied by alpha."""


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Whatever a decoder raises inside becomes a ValueError that names the file; what the operating system says
    stays.
    """
    try:
        yield
    except (ValueError, OSError, MemoryError):
        raise
    except Exception as error:
        kind = type(error).__name__
        raise ValueError(
            f"image {path}: not readable ({kind}: {one_line(str(error))[:200]}); copy it again or convert it"
        ) from error


def colour_channels(names: list[str], path: Path) -> tuple[list[int], int | None]:
    """(places of R, G, B, or that of grey; place of alpha) among a file's channels; of several layers, those of
    Blender's Combined.

    Raises ValueError for channels that are neither RGB nor grey.
    """
    place = {name: index for index, name in reversed(list(enumerate(names)))}
    layers = [name[:-1] for name in names if name.endswith(".R") and {f"{name[:-1]}G", f"{name[:-1]}B"} <= set(names)]
    combined = [layer for layer in layers if layer.endswith("Combined.")]
    for layer in ("", *(combined or (layers if len(layers) == 1 else []))[:1]):
        if all(f"{layer}{name}" in place for name in "RGB"):
            return [place[f"{layer}{name}"] for name in "RGB"], place.get(f"{layer}A")
    is_place = {"X", "Y", "Z"} <= set(names)  # places or normals, whose Y is no luminance
    grey = (
        []
        if is_place
        else [place[name] for name in ("Y", "I", "L") if name in place] or ([0] if len(names) == 1 else [])
    )
    if not grey:
        raise ValueError(
            f"image {path}: expected channels R, G, B or one grey channel, got {names}; read it with read_exr"
        )
    return grey[:1], place.get("A")


def opened(path: Path):
    """An OpenImageIO reader that leaves colours unmultiplied by alpha.

    Raises ValueError for a file that is no picture.
    """
    import OpenImageIO as oiio

    require_text_name(path)
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), settings)
    if reader is None:
        raise ValueError(
            f"image {path}: not readable as an image ({one_line(oiio.geterror())}); expected JPEG, PNG, TIFF, EXR or "
            "WebP"
        )
    return reader


def decode(path: Path) -> tuple[Float[Tensor, "c h w"], list[str], int]:
    """Pixels as stored (float32), the channels' names, and the orientation tag (1 = upright).

    Raises ValueError for a file that cannot be decoded.
    """
    import OpenImageIO as oiio

    reader = opened(path)
    spec = reader.spec()
    height, width = display_size(spec)
    require_decodable(f"image {path}", max(height, spec.height), max(width, spec.width), spec.nchannels)
    kind = oiio.UINT8 if spec.format == oiio.TypeUInt8 else oiio.FLOAT
    array = reader.read_image(0, 0, 0, spec.nchannels, kind)
    error = reader.geterror()
    reader.close()
    if array is None or error:
        raise ValueError(f"image {path}: damaged or truncated ({one_line(error)}); copy it again from its source")
    pixels = rearrange(torch.from_numpy(np.ascontiguousarray(array)), "h w c -> c h w")
    planes = pixels.to(torch.float32, memory_format=torch.contiguous_format)
    planes, names = planes.div_(255) if kind == oiio.UINT8 else planes, list(spec.channelnames)
    if (
        path.suffix.lower() in TIFF_SUFFIXES
        and "A" in names
        and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    ):
        planes = _unmultiplied(planes, names.index("A"))
    if (spec.x, spec.y, spec.height, spec.width) != (spec.full_x, spec.full_y, height, width):
        planes, names = _in_display_window(planes, names, spec)
    return planes, names, orientation_of(path, spec)


def display_size(spec) -> tuple[int, int]:
    """(height, width) of what the picture shows: the display window, where the file tells one."""
    return spec.full_height or spec.height, spec.full_width or spec.width


def covers_display(spec) -> bool:
    """Whether there are pixels for all of the display window."""
    height, width = display_size(spec)
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    return left <= 0 and top <= 0 and left + spec.width >= width and top + spec.height >= height


def _in_display_window(
    planes: Float[Tensor, "c h w"], names: list[str], spec
) -> tuple[Float[Tensor, "c2 h2 w2"], list[str]]:
    """The data window's pixels where they stand in the display window; what is beyond is cut, what is missing is
    transparent.
    """
    height, width = display_size(spec)
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    if not covers_display(spec) and "A" not in names:
        planes, names = torch.cat([planes, torch.ones_like(planes[:1])]), [*names, "A"]
    shown = planes.new_zeros(len(planes), height, width)
    rows, columns = (
        slice(max(top, 0), min(top + spec.height, height)),
        slice(max(left, 0), min(left + spec.width, width)),
    )
    if rows.start < rows.stop and columns.start < columns.stop:
        part = planes[:, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        shown[:, rows, columns] = part
    return shown, names


def _unmultiplied(planes: Float[Tensor, "c h w"], alpha: int) -> Float[Tensor, "c h w"]:
    """Colours of a file with associated alpha, divided by it; black where nothing is opaque."""
    opaque = planes[alpha : alpha + 1]
    straight = torch.where(opaque > LEAST_ALPHA, planes / opaque.clamp(min=LEAST_ALPHA), 0.0).clamp(max=1.0)
    straight[alpha] = opaque[0]
    return straight


def orientation_of(path: Path, spec) -> int:
    """The EXIF orientation (1 = upright); of WebP files, whose tags OpenImageIO does not read, by Pillow."""
    if path.suffix.lower() != ".webp":
        return spec.get_int_attribute("Orientation", 1)
    from PIL import ExifTags, Image

    with Image.open(path) as image:
        return int(image.getexif().get(ExifTags.Base.Orientation, 1))


def decode_heif(path: Path) -> tuple[Float[Tensor, "c h w"], list[str], int]:
    """Like :func:`decode` for HEIC photos; their decoder turns them upright itself.

    Raises ValueError for a file that cannot be decoded.
    """
    image = opened_heif(path)
    require_decodable(f"image {path}", image.size[1], image.size[0], 3)
    try:
        array = np.array(image)
    except (OSError, RuntimeError, SyntaxError, ValueError) as error:
        raise ValueError(
            f"image {path}: damaged or truncated HEIC ({one_line(str(error))}); copy it again from its source"
        ) from error
    planes = torch.from_numpy(array.astype(np.float32) / np.iinfo(array.dtype).max)
    pixels = planes[None] if array.ndim == 2 else rearrange(planes, "h w c -> c h w")
    return pixels, list(image.mode.split(";")[0]), 1  # modes are RGB, RGBA, L, LA, and those with ;16


def opened_heif(path: Path):
    """A photo opened by pillow-heif (its ``size`` is upright), an optional dependency.

    Raises ValueError for a file that is no picture, and where the extra heic is not installed.
    """
    try:
        import pillow_heif  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            f"image {path}: reading HEIC needs the package pillow-heif; install it with pip install "
            "'fillerbuster[heic]' or convert to JPEG"
        ) from error
    try:
        return pillow_heif.open_heif(path)
    except (OSError, RuntimeError, SyntaxError, ValueError) as error:
        raise ValueError(
            f"image {path}: not readable as HEIC ({one_line(str(error))}); copy it again or convert it to JPEG"
        ) from error


def upright(pixels: Float[Tensor, "c h w"], orientation: int) -> Float[Tensor, "c h2 w2"]:
    """The pixels turned as an EXIF orientation (1 to 8; anything else counts as 1) asks for."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 2)
    flips = {2: [2], 3: [1, 2], 4: [1], 6: [2], 7: [1, 2], 8: [1]}.get(orientation, [])
    return (pixels.flip(flips) if flips else pixels).contiguous()


def one_line(message: str) -> str:
    """A library's message in one line."""
    return " ".join(message.split()) or "no reason given"
