"""Colours of films: what is written comes back within 2 of 255 at every size; foreign films are read as their tags
say.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fb_core.data.photos import film_colours
from fb_core.data.photos.film import write_film
from fb_core.data.photos.video import read_film

COLOURS = [
    (200, 30, 60),
    (30, 200, 60),
    (10, 20, 240),
    (255, 255, 255),
    (0, 0, 0),
    (255, 0, 0),
    (0, 255, 0),
    (255, 230, 1),
]
WEIGHTS = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}
NUMBERS = {"bt601": 6, "bt709": 1, "bt2020": 9, None: 2}
RANGES = {"limited": 1, "full": 2, None: 0}


def fields_of(columns: np.ndarray, width: int) -> np.ndarray:
    """Which colour a column has: as many fields side by side as are 8 pixels wide."""
    return (columns * min(len(COLOURS), width // 8)) // width


def stripes(height: int, width: int) -> np.ndarray:
    """Fields of the colours, uint8 [h, w, 3]."""
    which = fields_of(np.arange(width), width)
    return np.array(COLOURS, dtype=np.uint8)[which][None].repeat(height, axis=0)


def inside_fields(width: int, margin: int) -> np.ndarray:
    """Columns away from the fields' borders, where half-size colours mix."""
    which = fields_of(np.arange(-margin, width + margin), width)
    same = np.lib.stride_tricks.sliding_window_view(which, 2 * margin + 1)
    return (same == same[:, :1]).all(axis=1)


def assert_read_back(path: Path, expected: np.ndarray, columns: np.ndarray, *, within: int = 2) -> None:
    film = read_film(path, 3)
    for frame in film.frames:
        got = (film.load(frame) * 255).round().int().movedim(0, -1).numpy()
        assert got.shape == expected.shape
        worst = np.abs(got - expected.astype(int))[:, columns].max()
        assert worst <= within, f"off by {worst} of 255"


SIZES = [
    (64, 64),
    (33, 17),
    (97, 161),
    (480, 640),
    (481, 641),
    (718, 1278),
    (719, 1279),
    (720, 1280),
    (721, 1281),
    (1280, 720),
    (544, 1280),
]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_what_is_written_comes_back(tmp_path: Path, height: int, width: int):
    """At odd and even sizes, small ones that are enlarged, and on both sides of the border between SD and HD."""
    import av

    picture = stripes(height, width)
    tensor = torch.from_numpy(picture).movedim(-1, 0).float() / 255
    write_film(tmp_path / "film.mp4", [tensor] * 3)
    with av.open(str(tmp_path / "film.mp4")) as container:
        frame = next(container.decode(video=0))
        assert (
            int(frame.colorspace) == film_colours.usual_matrix(frame.height, frame.width)
            and int(frame.color_range) == 1
        )
        scale = max(1, round(480 / min(height, width)))
        assert (frame.height, frame.width) == (scale * height // 2 * 2, scale * width // 2 * 2)
        plain = frame.to_ndarray(format="rgb24").astype(
            int
        )  # FFmpeg's own reading of the tags, with its coarser integers
    expected = picture.repeat(scale, axis=0).repeat(scale, axis=1)[: frame.height, : frame.width]
    columns = np.repeat(inside_fields(width, max(2, 9 // scale)), scale)[: frame.width]
    assert columns.sum() >= 4
    assert_read_back(tmp_path / "film.mp4", expected, columns)
    assert np.abs(plain - expected)[:, columns].max() <= 5


@pytest.mark.parametrize(("height", "width"), [(2, 1000), (1000, 2), (2, 1280), (1280, 2)])
def test_all_colours_survive_the_coding(height: int, width: int):
    """Eight bits of luma and differences, with the matrix of either size, tell every colour within 2 of 255."""
    matrix = film_colours.usual_matrix(height, width)
    assert matrix == (1 if max(height, width) == 1280 else 6)
    axis = np.array([0, 1, 60, 128, 200, 254, 255], dtype=np.uint8)
    colours = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    pixels = np.resize(colours, (max(height, width) // 2, 3)).repeat(
        2, axis=0
    )  # a pair of equal pixels shares one difference
    pixels = np.broadcast_to(pixels[None] if height == 2 else pixels[:, None], (height, width, 3))
    planes = film_colours.to_yuv420(np.ascontiguousarray(pixels)).reshape(-1).astype(np.float64)
    count = height * width
    luma = planes[:count].reshape(height, width)
    differences = planes[count:].reshape(2, height // 2, width // 2)
    blue, red = (one.repeat(2, axis=0).repeat(2, axis=1) for one in differences)
    yuv = (np.stack([luma, blue, red], axis=-1) - [16, 128, 128]) / [219, 224, 224]
    rgb = np.rint((yuv @ film_colours._to_rgb(matrix).T).clip(0, 1) * 255)
    assert np.abs(rgb - pixels).max() <= 2


# ---- foreign films --------------------------------------------------------------------------------------------------


def coded(picture: np.ndarray, matrix: str, span: str, bits: int = 8) -> np.ndarray:
    """By the definition (ITU-T H.273): luma and two differences [h, w, 3], in the integers of a range."""
    red, blue = WEIGHTS[matrix]
    r, g, b = np.moveaxis(picture / 255, -1, 0)
    luma = red * r + (1 - red - blue) * g + blue * b
    differences = (b - luma) / (2 * (1 - blue)), (r - luma) / (2 * (1 - red))
    unit = 2 ** (bits - 8)
    if span == "limited":
        planes = [unit * (16 + 219 * luma), *(unit * (128 + 224 * one) for one in differences)]
    else:
        top = 2**bits - 1
        planes = [top * luma, *(128 * unit + top * one for one in differences)]
    return np.rint(np.stack(planes, axis=-1)).clip(0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)


def write_foreign(
    path: Path, yuv: np.ndarray, *, matrix: str | None, span: str | None, pixels: str = "yuv420p", codec: str = "ffv1"
) -> None:
    """A lossless film of three frames with these tags."""
    import av

    height, width = yuv.shape[:2]
    down, across = (2, 2) if "420" in pixels else (1, 1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width, stream.pix_fmt = height, width, pixels
        stream.codec_context.colorspace, stream.codec_context.color_range = NUMBERS[matrix], RANGES[span]
        for number in range(3):
            frame = av.VideoFrame(width, height, pixels)
            for plane, channel in zip(frame.planes, range(3), strict=True):
                values = yuv[:, :, channel] if channel == 0 else yuv[::down, ::across, channel]
                rows = np.zeros((plane.height, plane.line_size // values.itemsize), dtype=values.dtype)
                rows[:, : values.shape[1]] = values
                plane.update(rows.tobytes())
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("matrix", ["bt601", "bt709", "bt2020", None])
@pytest.mark.parametrize("span", ["limited", "full", None])
@pytest.mark.parametrize(("height", "width"), [(480, 640), (97, 161), (720, 1280), (543, 1281)])
def test_foreign_films_are_read_by_their_tags_else_by_their_size(
    tmp_path: Path, matrix: str | None, span: str | None, height: int, width: int
):
    usual = "bt709" if min(height, width) >= 720 or max(height, width) >= 1280 else "bt601"
    picture = stripes(height, width)
    write_foreign(tmp_path / "film.mkv", coded(picture, matrix or usual, span or "limited"), matrix=matrix, span=span)
    assert_read_back(tmp_path / "film.mkv", picture, inside_fields(width, 4))


@pytest.mark.parametrize(
    ("pixels", "bits"), [("yuv444p", 8), ("yuv420p10le", 10), ("yuv444p10le", 10), ("yuv444p16le", 16)]
)
@pytest.mark.parametrize("span", ["limited", "full"])
def test_depths_and_samplings(tmp_path: Path, pixels: str, bits: int, span: str):
    picture = stripes(66, 170)
    write_foreign(tmp_path / "film.mkv", coded(picture, "bt709", span, bits), matrix="bt709", span=span, pixels=pixels)
    assert_read_back(tmp_path / "film.mkv", picture, inside_fields(170, 4))


def test_motion_jpeg_has_the_full_range(tmp_path: Path):
    import av

    picture = stripes(96, 160)
    with av.open(str(tmp_path / "film.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=30, options={"qmin": "1", "qmax": "1"})
        stream.height, stream.width, stream.pix_fmt = 96, 160, "yuvj444p"
        yuv = coded(picture, "bt601", "full")
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.moveaxis(yuv, -1, 0)), format="yuvj444p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert_read_back(tmp_path / "film.avi", picture, inside_fields(160, 9), within=3)


@pytest.mark.parametrize("pixels", ["bgr0", "gray"])
def test_films_without_a_matrix(tmp_path: Path, pixels: str):
    import av

    picture = stripes(66, 170)
    if pixels == "gray":
        picture = picture[:, :, :1].repeat(3, axis=-1)
    with av.open(str(tmp_path / "film.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width, stream.pix_fmt = 66, 170, pixels
        for _ in range(3):
            array = np.ascontiguousarray(picture[:, :, 0] if pixels == "gray" else picture)
            frame = av.VideoFrame.from_ndarray(array, format="gray" if pixels == "gray" else "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert_read_back(tmp_path / "film.mkv", picture, np.ones(170, dtype=bool))
