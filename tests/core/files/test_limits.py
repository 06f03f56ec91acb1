"""Bounds before work: what is too large, too deep or beyond all numbers is answered at once and in one sentence."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.quick_refusals import HUGE_INTEGER, refused

from fb_core.data import media
from fb_core.data.capture.camera_path import read_camera_path
from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.photos import video
from fb_core.data.photos.collection import read_photos
from fb_core.data.training.captioned_images import caption_of, picture_of
from fb_core.files import limits
from fb_core.files.json_files import parse_json, read_json

# ---- pictures -------------------------------------------------------------------------------------------------------


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def huge_png(path: Path, width: int = 30_000, height: int = 30_000, kind: int = 2) -> Path:
    """A complete file of a few bytes that says it has so many pixels (kind 2 is RGB, 6 with alpha)."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b""))
    return path


def huge_jpeg(path: Path, side: int = 60_000) -> Path:
    """The header of a small picture with another size written into it."""
    media.write_image(path, torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)))
    data = bytearray(path.read_bytes())
    frame = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    data[frame + 5 : frame + 9] = struct.pack(">HH", side, side)
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("make", [huge_png, huge_jpeg])
@pytest.mark.parametrize("read", [media.read_image, media.read_image_with_alpha, media.image_size])
def test_a_picture_with_too_many_pixels_is_refused_by_its_header(tmp_path: Path, make: Callable, read: Callable):
    path = make(tmp_path / f"big.{'png' if make is huge_png else 'jpg'}")
    sentence = refused(lambda: read(path))
    assert path.name in sentence and "pixels are too many, expected at most 268 million" in sentence


def test_a_picture_that_memory_does_not_suffice_for_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = huge_png(tmp_path / "big.png", 10_000, 10_000)
    monkeypatch.setattr(limits, "free_memory_bytes", lambda: 2**30)
    sentence = refused(lambda: media.read_image(path))
    assert "10000 x 10000 pixels need 2.51 GiB of memory, but 1.00 GiB are free" in sentence
    small = tmp_path / "small.png"
    media.write_image(small, torch.rand(3, 20, 20))
    assert media.read_image(small).shape == (3, 20, 20)
    monkeypatch.setattr(limits, "free_memory_bytes", lambda: None)
    limits.require_decodable("x", 10_000, 10_000, 3)


def test_good_photos_stay_beside_one_that_is_too_large(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    for number in range(3):
        media.write_image(tmp_path / f"good_{number}.png", torch.rand(3, 24, 32))
    huge_png(tmp_path / "huge.png")
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == ["good_0", "good_1", "good_2"]
    assert "left out" in caplog.text and "huge.png" in caplog.text


def test_a_capture_with_such_a_picture_is_refused_before_a_training(tiny_capture: Path):
    content = json.loads((tiny_capture / "transforms.json").read_text())
    huge_png(tiny_capture / content["frames"][2]["file_path"])
    assert "too many" in refused(lambda: validate_capture(tiny_capture))


def test_a_captioned_picture_that_is_too_large_is_left_out(tmp_path: Path):
    data = huge_png(tmp_path / "big.png").read_bytes()
    assert "too many pixels" in refused(lambda: picture_of({"png": data}))


# ---- films ----------------------------------------------------------------------------------------------------------


def film(path: Path, options: dict[str, str]) -> Path:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options=options)
        stream.height, stream.width, stream.pix_fmt = 96, 160, "yuv420p"
        for number in range(3):
            frame = av.VideoFrame(160, 96, "yuv420p")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_a_film_whose_frames_are_too_large_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As it is shown: pixels may be wider than high."""
    wide = film(tmp_path / "wide.mp4", {"x264-params": "sar=20/1"})
    monkeypatch.setattr(video, "MOST_FILM_PIXELS", 200_000)
    assert "3200 x 96 pixels are too many" in refused(lambda: video.read_film(wide, 4))
    plain = film(tmp_path / "plain.mp4", {})
    assert len(video.read_film(plain, 4).frames) >= 2
    monkeypatch.setattr(video, "MOST_FILM_PIXELS", 1000)
    monkeypatch.setattr(video, "_frames", lambda *args, **kwargs: pytest.fail("nothing may be decoded"))
    assert "160 x 96 pixels are too many" in refused(lambda: video.read_film(plain, 4))
    monkeypatch.setattr(video, "MOST_FILM_PIXELS", 10**9)
    monkeypatch.setattr(limits, "free_memory_bytes", lambda: 2**18)
    assert "GiB are free" in refused(lambda: video.read_film(plain, 4))


# ---- JSON -----------------------------------------------------------------------------------------------------------


DEEP = "[" * 200_000 + "]" * 200_000


def test_numbers_beyond_doubles_become_infinite():
    found = parse_json(
        b'{"a": 1e400, "b": -1e400, "c": %s, "d": -%s, "e": %s}' % ((HUGE_INTEGER.encode(),) * 2 + (b"9" * 5000,))
    )
    assert [abs(value) for value in found.values()] == [float("inf")] * 5
    assert parse_json(b"[12345678901234567, 1.5, -3]") == [12345678901234567, 1.5, -3]
    assert parse_json(b'\xef\xbb\xbf{"a": 1}') == {"a": 1}, "a byte order mark is no fault"


def test_deep_and_large_files(tmp_path: Path):
    assert refused(lambda: parse_json(DEEP.encode())) == "it is nested too deeply"
    assert refused(lambda: parse_json(('{"a":' * 100_000 + "1" + "}" * 100_000).encode())) == "it is nested too deeply"
    (tmp_path / "large.json").write_bytes(b"[" + b"1," * 1000 + b"1]")
    assert "expected at most" in refused(lambda: read_json(tmp_path / "large.json", most_bytes=1000))
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate(2**40)  # takes no room on the disk
    assert "it has 1048576 MiB" in refused(lambda: read_json(tmp_path / "huge.json"))


@pytest.mark.parametrize("key", ["fl_x", "w", "cx", "k1"])
@pytest.mark.parametrize("number", ["1e400", "-1e400", "NaN", "Infinity", HUGE_INTEGER, "9" * 5000])
def test_a_capture_with_such_numbers(tiny_capture: Path, key: str, number: str):
    content = json.loads((tiny_capture / "transforms.json").read_text())
    content = {**{name: content[name] for name in content if name != key}, key: 12345678}
    for frame in content["frames"]:
        frame.pop(key, None)
    text = json.dumps(content).replace("12345678", number)
    (tiny_capture / "transforms.json").write_text(text)
    assert f"expected a finite number for {key}" in refused(lambda: read_capture(tiny_capture))


@pytest.mark.parametrize("matrix", ["1e400", HUGE_INTEGER, "NaN", "[" * 500 + "]" * 500, '"a"'])
def test_a_capture_with_such_a_pose(tiny_capture: Path, matrix: str):
    content = json.loads((tiny_capture / "transforms.json").read_text())
    content["frames"][1]["transform_matrix"] = [[12345678, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (tiny_capture / "transforms.json").write_text(json.dumps(content).replace("12345678", matrix))
    sentence = refused(lambda: read_capture(tiny_capture))
    assert "frame 1" in sentence


def test_a_capture_that_is_nested_too_deeply(tiny_capture: Path):
    (tiny_capture / "transforms.json").write_text(DEEP)
    assert "nested too deeply" in refused(lambda: read_capture(tiny_capture))


def path_of(cameras: str, width: str = "640") -> str:
    return f'{{"camera_path": {cameras}, "render_width": {width}, "render_height": 480}}'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (path_of("[" + "{}," * 999_999 + "{}]"), "at most 10000 cameras, got 1000000"),
        (DEEP, "nested too deeply"),
        (path_of(DEEP), "nested too deeply"),
        (path_of("[" + HUGE_INTEGER + "]"), "camera 0 has no camera_to_world"),
        (path_of(f'[{{"camera_to_world": {[int(HUGE_INTEGER)] * 16}, "fov": 50}}]'), "no rotation and place"),
        (path_of('[{"camera_to_world": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "fov": 1e400}]'), "fov"),
        (path_of("[{}]", "1e400"), "render_width"),
        (path_of("[{}]", HUGE_INTEGER), "render_width"),
    ],
)
def test_camera_paths(tmp_path: Path, text: str, told: str):
    (tmp_path / "path.json").write_text(text)
    assert told in refused(lambda: read_camera_path(tmp_path / "path.json", size=64))


def test_a_caption_s_json_and_a_report(tmp_path: Path):
    from method_configs.commands.complete.output import is_ours

    assert "nested" in refused(lambda: caption_of({"json": DEEP.encode()}))
    (tmp_path / "report.json").write_text(DEEP)
    assert not is_ours(tmp_path)
