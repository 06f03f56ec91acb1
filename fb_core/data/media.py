"""Still images in and out: files on one side, float tensors (3 h w, range [0, 1]) on the other.

OpenImageIO does the decoding and is imported on first use. Orientation tags of phones (EXIF) are honoured. Every reader
raises ``ValueError`` with one sentence for a file that is missing, empty, cut short, or not an image, whatever its
decoder raises.

A picture is what its file means to show: the display window of an EXR file (pixels outside of its data window are
unknown), colours that are not multiplied by alpha.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor

from fb_core.data.picture_decoders import (
    LEAST_ALPHA,
    TIFF_SUFFIXES,
    colour_channels,
    covers_display,
    decode,
    decode_heif,
    display_size,
    one_line,
    opened,
    opened_heif,
    orientation_of,
    told,
    upright,
)
from fb_core.files.limits import require_decodable
from fb_core.files.whole import by_way_of_memory

HEIF_SUFFIXES = (".heic", ".heif")
_ONE_OF_255 = 1 / 255 + 1e-6
_MARKER_IN_JPEG_SCAN = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # stuffed zeros, fill bytes and restarts are no markers


def read_image(path: str | Path, *, apply_orientation: bool = True) -> Float[Tensor, "3 h w"]:
    """The colours of a still image, upright.

    Args:
        path: JPEG, PNG, TIFF, EXR, WebP, ... (HEIC with the extra ``heic``); grey becomes three equal channels.
        apply_orientation: turn the pixels as the EXIF tag says; False gives them as stored.

    Returns:
        RGB. Integer files (8 or 16 bit) are scaled to [0, 1]; float files come as they are stored.
    """
    return read_image_with_alpha(path, apply_orientation=apply_orientation)[0]


def read_image_with_alpha(
    path: str | Path, *, apply_orientation: bool = True
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"] | None]:
    """Like :func:`read_image`, with the alpha channel (1 = opaque) or None where the file has none.

    The colours are not multiplied by alpha (except in EXR files, whose definition wants it so).

    Raises ValueError for channels that are neither RGB nor grey.
    """
    path = _checked_file(path)
    with told(path):
        pixels, names, orientation = decode_heif(path) if path.suffix.lower() in HEIF_SUFFIXES else decode(path)
        if apply_orientation:
            pixels = upright(pixels, orientation)
        colours, opaque = colour_channels(names, path)
        alpha = None if opaque is None else pixels[opaque][None]
        if colours == [0, 1, 2]:
            return pixels[:3], alpha
        if len(colours) == 3:
            return pixels[colours], alpha
        return repeat(pixels[colours[0]], "h w -> channels h w", channels=3), alpha


def read_photo(
    path: str | Path, *, apply_orientation: bool = True
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"] | None]:
    """Like :func:`read_image_with_alpha`, as the picture is looked at: sRGB in [0, 1], whatever the file.

    Colours of EXR files, which are linear and multiplied by alpha, are converted; their pixels that are not finite are
    transparent.
    """
    image, alpha = read_image_with_alpha(path, apply_orientation=apply_orientation)
    if Path(path).suffix.lower() == ".exr":
        opaque = torch.ones_like(image[:1]) if alpha is None else alpha.clamp(0, 1)
        image = to_srgb(image / opaque.clamp(min=LEAST_ALPHA))
        finite = torch.isfinite(image).all(dim=0, keepdim=True)
        image = torch.where(finite, image, 0.0)
        alpha = alpha if alpha is None and bool(finite.all()) else opaque.nan_to_num(0.0) * finite
    return image.clamp(0, 1), None if alpha is None else alpha.clamp(0, 1)


def read_mask(path: str | Path, *, apply_orientation: bool = True) -> Float[Tensor, "1 h w"]:
    """1 where a mask's picture is lighter than half, else 0; of a picture of 0 and 1 alone (of 255), where it is 1."""
    values = read_image(path, apply_orientation=apply_orientation)[:1]
    top = float(values.max())
    return (values > 0 if 0 < top <= _ONE_OF_255 else values >= 0.5).to(values)


def has_alpha(path: str | Path) -> bool:
    """Whether a still image has an alpha channel, from the file's header (HEIC files are decoded)."""
    path = _checked_file(path)
    with told(path):
        if path.suffix.lower() in HEIF_SUFFIXES:
            return "A" in decode_heif(path)[1]
        reader = opened(path)
        spec = reader.spec()
        reader.close()
        return any(name == "A" or name.endswith("Combined.A") for name in spec.channelnames) or not covers_display(spec)


def image_size(path: str | Path, *, apply_orientation: bool = True) -> tuple[int, int]:
    """(height, width) in pixels, upright, from the file's header and its end; nothing is decoded.

    A file cut short is refused, and one that could not be decoded here because it is too large.
    """
    path = _checked_file(path)
    with told(path):
        if path.suffix.lower() in HEIF_SUFFIXES:
            width, height = opened_heif(path).size
            require_decodable(f"image {path}", height, width, 3)
            return height, width
        reader = opened(path)
        spec = reader.spec()
        height, width = display_size(spec)
        orientation = orientation_of(path, spec)
        reader.close()
        require_decodable(f"image {path}", max(height, spec.height), max(width, spec.width), spec.nchannels)
        return (width, height) if apply_orientation and orientation in (5, 6, 7, 8) else (height, width)


def posed_size(path: str | Path) -> tuple[int, int]:
    """(height, width) of a posed picture as nerfstudio counts: stored pixels, but TIFF files upright, for Pillow turns
    these alone.
    """
    return image_size(path, apply_orientation=Path(path).suffix.lower() in TIFF_SUFFIXES)


def fits_only_upright(path: str | Path, size: tuple[int, int], *, smaller_by: float = 1) -> bool:
    """Whether a posed picture of (height, width) must be turned as its EXIF tag says: such pictures are counted in
    stored pixels, unless only the upright size fits; TIFF files the other way round. Headers alone are read.
    ``smaller_by``: the size is that of a copy, by this factor smaller than the file.
    """
    sizes = (image_size(path, apply_orientation=turned) for turned in (False, True))
    as_stored, as_upright = (
        (int(height // smaller_by), int(width // smaller_by)) == tuple(size) for height, width in sizes
    )
    if Path(path).suffix.lower() in TIFF_SUFFIXES:
        return as_upright or not as_stored
    return as_upright and not as_stored


def write_image(path: str | Path, image: Float[Tensor, "c h w"], *, bits: int = 8) -> None:
    """Writes colours (3 channels) or grey (1 channel); the suffix chooses the format.

    Values are clipped to [0, 1] and rounded to ``bits`` (8 or 16; JPEG knows 8 only). EXR keeps float32 as given.

    Raises ValueError for other shapes and bits, and for NaN and infinity.
    """
    path = Path(path)
    if image.shape[0] not in (1, 3) or image.shape[1] == 0 or image.shape[2] == 0:
        raise ValueError(
            f"write_image {path}: expected an image of shape (3 or 1, height, width), got {tuple(image.shape)}"
        )
    if bits not in (8, 16):
        raise ValueError(f"write_image {path}: expected bits 8 or 16, got {bits}")
    if path.suffix.lower() == ".exr":
        names = "RGB" if image.shape[0] == 3 else "Y"
        write_exr(path, {name: image[index] for index, name in enumerate(names)})
        return
    if not bool(torch.isfinite(image).all()):
        raise ValueError(
            f"write_image {path}: the image holds NaN or infinity, expected values in [0, 1]; write an .exr to keep "
            "them"
        )
    top = 2**bits - 1
    attributes = (
        {"Compression": "jpeg:95", "jpeg:subsampling": "4:4:4"} if path.suffix.lower() in (".jpg", ".jpeg") else {}
    )
    integers = (
        (image.detach().cpu().double().clamp(0, 1) * top).round().numpy().astype(np.uint8 if bits == 8 else np.uint16)
    )
    _encode(path, rearrange(integers, "c h w -> h w c"), None, attributes)


def write_exr(path: str | Path, channels: Mapping[str, Float[Tensor, "h w"]]) -> None:
    """Writes named float32 channels of one size, losslessly compressed (for raymaps, depth, normals). Raises ValueError
    for channels of different sizes, and for none.
    """
    sizes = {tuple(channel.shape) for channel in channels.values()}
    if len(sizes) != 1:
        raise ValueError(
            f"write_exr {path}: expected at least one channel and one size for all of them, got sizes {sorted(sizes)}"
        )
    stacked = torch.stack([channel.detach().cpu().float() for channel in channels.values()], dim=-1).numpy()
    _encode(Path(path), stacked, list(channels), {"Compression": "zip"})


def read_exr(path: str | Path, names: list[str] | None = None) -> dict[str, Float[Tensor, "h w"]]:
    """The named float channels of an EXR file (all of them by default). The order inside the file does not matter.
    Raises ValueError for channels that the file does not have.
    """
    path = _checked_file(path)
    with told(path):
        pixels, stored, _ = decode(path)
    missing = [name for name in names or [] if name not in stored]
    if missing:
        raise ValueError(f"read_exr {path}: channels {missing} are not in the file, which has {stored}; ask for those")
    return {name: pixels[stored.index(name)] for name in (stored if names is None else names)}


def to_srgb(linear: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Linear light to sRGB values (IEC 61966-2-1); negative light is black, light above 1 stays above 1."""
    linear = linear.clamp(min=0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def to_linear(srgb: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """sRGB values to linear light: the inverse of :func:`to_srgb`."""
    srgb = srgb.clamp(min=0)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def resize(image: Float[Tensor, "c h w"], height: int, width: int) -> Float[Tensor, "c height width"]:
    """The image at another size, antialiased (a triangle as wide as the larger of both pixels); corners stay corners.

    Constants stay constant and no value leaves the input's range. The camera that belongs to the result is
    ``camera.scaled(width, height)``.

    Raises ValueError for sides below 1 pixel.
    """
    if height < 1 or width < 1:
        raise ValueError(f"resize: expected a height and a width of at least 1 pixel, got {height} and {width}")
    if tuple(image.shape[1:]) == (height, width):
        return image
    return F.interpolate(image[None], size=(height, width), mode="bilinear", antialias=True, align_corners=False)[0]


def shrink(image: Float[Tensor, "c h w"], longest_side: int | None) -> Float[Tensor, "c h2 w2"]:
    """The image made smaller, so that its longer side has at most ``longest_side`` pixels: a new pixel is the mean of
    the area it covers.

    An image that is small enough already, or None, comes back as it is. No side becomes shorter than one pixel.

    Raises ValueError for a side below 1 pixel.
    """
    if longest_side is None or max(image.shape[1:]) <= longest_side:
        return image
    if longest_side < 1:
        raise ValueError(f"shrink: expected longest_side of at least 1 pixel, got {longest_side}")
    import cv2

    scale = longest_side / max(image.shape[1:])
    height, width = (max(1, round(side * scale)) for side in image.shape[1:])
    planes = [cv2.resize(plane.numpy(), (width, height), interpolation=cv2.INTER_AREA) for plane in image]
    return torch.from_numpy(np.stack(planes))


# ---- decoding -------------------------------------------------------------------------------------------------------


def _checked_file(path: str | Path) -> Path:
    """The path of a file that exists, is not empty, and does not stop in the middle (as far as its container tells)."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"image {path}: no such file; check the path")
    if path.stat().st_size == 0:
        raise ValueError(f"image {path}: the file is empty (0 bytes), expected an image; copy it again from its source")
    with path.open("rb") as file:
        start = file.read(16)
        complete = True
        if start[:3] == b"\xff\xd8\xff":
            complete = _jpeg_is_complete(file)
        elif start[:8] == b"\x89PNG\r\n\x1a\n":
            complete = _png_is_complete(file)
        elif start[:4] == b"RIFF" and start[8:12] == b"WEBP":
            complete = path.stat().st_size >= 8 + int.from_bytes(start[4:8], "little")
    if not complete:
        raise ValueError(
            f"image {path}: the file is truncated (it ends before the image does); copy it again from its source"
        )
    return path


def _jpeg_is_complete(file) -> bool:
    """Whether the first image's end marker is there. Decoders only warn and paint the missing part grey.

    A file that ends with the marker is taken at its word; others (phones append previews and films) are walked through.
    """
    file.seek(-2, os.SEEK_END)
    if file.read(2) == b"\xff\xd9":
        return True
    file.seek(0)
    data, position = file.read(), 2
    while position + 4 <= len(data):
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if data[position] != 0xFF:
            return True  # not the structure we know: the decoder shall judge
        if marker == 0xD9:
            return True
        if marker == 0xFF:  # a fill byte before a marker
            position += 1
            continue
        position += 2 + length
        if marker == 0xDA:  # entropy-coded data follows this header, up to the next marker
            next_marker = _MARKER_IN_JPEG_SCAN.search(data, position)
            if next_marker is None:
                return False
            position = next_marker.start()
    return data[position : position + 2] == b"\xff\xd9"


def _png_is_complete(file) -> bool:
    """Whether the chunks follow each other up to the end chunk; only their headers are read."""
    size = file.seek(0, os.SEEK_END)
    position = 8
    while position + 12 <= size:
        file.seek(position)
        header = file.read(8)
        position += 12 + int.from_bytes(header[:4], "big")  # length, name, data, checksum
        if header[4:] == b"IEND":
            return True
    return False


# ---- encoding -------------------------------------------------------------------------------------------------------


def _encode(path: Path, array: np.ndarray, names: list[str] | None, attributes: dict[str, str]) -> None:
    """Writes (h, w, c) integers or floats as they are."""
    import OpenImageIO as oiio

    height, width, count = array.shape
    writer = oiio.ImageOutput.create(str(path))
    if writer is None:
        oiio.geterror()  # taken off its list, or it is printed at exit
        raise ValueError(f"cannot write {path}: no image format has the suffix {path.suffix!r}; use .png, .jpg or .exr")
    kinds = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}
    spec = oiio.ImageSpec(width, height, count, kinds[array.dtype.name])
    if names is not None:
        spec.channelnames = tuple(names)
    for key, value in attributes.items():
        spec.attribute(key, value)
    # On a full disk OpenImageIO's PNG writer cuts the file short without a word, and its JPEG writer ends the whole
    # process.
    with by_way_of_memory(path) as place:
        done = writer.open(place, spec) and writer.write_image(np.ascontiguousarray(array)) and writer.close()
        if not done:
            raise ValueError(
                f"cannot write {path} ({one_line(writer.geterror())}); check that the folder exists and has room"
            )
