"""Films: the frames chosen are sharp and evenly spaced along the way, upright, and decoded one at a time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from helpers.folders.films import HEIGHT, WIDTH, numbered, pan, texture, write_film
from helpers.folders.frames import as_tensor
from hypothesis import given
from hypothesis import strategies as st

from fb_core.data.photos import video
from fb_core.data.photos.video import choose_frames, read_film


def number_of(image: torch.Tensor) -> int:
    return sum(1 << bit for bit in range(10) if image[:, 8:24, bit * 16 + 4 : bit * 16 + 12].mean() > 0.5)


# ---- which frames ---------------------------------------------------------------------------------------------------


@given(
    steps=st.lists(st.floats(0, 1), min_size=2, max_size=80),
    sharpness=st.lists(st.floats(0, 10), min_size=81, max_size=81),
    most=st.integers(2, 12),
)
def test_any_film_gives_two_to_most_frames_in_order_from_different_parts_of_the_way(
    steps: list[float], sharpness: list[float], most: int
) -> None:
    travelled = np.cumsum([0.0, *steps])
    chosen = choose_frames(np.array(sharpness[: len(travelled)]), travelled, most)
    assert 2 <= len(chosen) <= most
    assert chosen == sorted(set(chosen))
    if travelled[-1] > 0 and len(travelled) > most:
        parts = [min(int(travelled[index] / (travelled[-1] / most)), most - 1) for index in chosen]
        assert len(set(parts)) == len(parts)


@given(most=st.integers(2, 20), count=st.integers(100, 300), seed=st.integers(0, 99))
def test_at_constant_speed_neighbours_are_half_a_part_to_one_and_a_half_apart(most: int, count: int, seed: int) -> None:
    sharpness = np.random.default_rng(seed).random(count)
    chosen = choose_frames(sharpness, np.arange(count) * 0.01, most)
    gaps = np.diff(chosen) * most / (count - 1)
    assert len(chosen) == most
    assert gaps.min() >= 0.5 - 2 * most / count and gaps.max() <= 1.5 + 2 * most / count


def test_units_of_motion_and_of_sharpness_do_not_matter() -> None:
    generator = np.random.default_rng(0)
    sharpness, travelled = generator.random(200) + 0.1, np.cumsum(generator.random(200))
    chosen = choose_frames(sharpness, travelled, 12)
    assert choose_frames(7.0 * sharpness, travelled, 12) == chosen
    assert choose_frames(sharpness, 3.0 * travelled + 5.0, 12) == chosen


def test_the_sharpest_frame_of_each_part_is_taken() -> None:
    sharpness = np.ones(160)
    planted = [9, 31, 48, 71, 90, 109, 132, 148]
    sharpness[planted] = 1.5
    assert choose_frames(sharpness, np.arange(160.0), 8) == planted


def test_a_frame_of_a_bare_wall_is_not_taken_for_blurred() -> None:
    """In the middle of a part the camera turns to a wall with little detail; its clearest frame beats ordinary ones of
    the bookshelf.
    """
    sharpness = np.where(np.arange(160) < 90, 100.0, 1.0)
    sharpness[92] *= 1.5
    assert 92 in choose_frames(sharpness, np.arange(160.0), 8)


def test_a_camera_at_rest_gets_one_frame_and_a_jump_none() -> None:
    rest = np.concatenate([np.arange(20.0), np.full(500, 20.0), 20 + np.arange(1, 21.0)])
    chosen = choose_frames(np.ones(len(rest)), rest, 8)
    assert len(chosen) == 8 and sum(20 <= index < 520 for index in chosen) <= 1
    jump = np.concatenate([np.full(50, 0.0), np.full(50, 1.0)])
    assert len(choose_frames(np.ones(100), jump, 8)) == 2
    assert np.diff(choose_frames(np.ones(100), np.zeros(100), 4)).tolist() == pytest.approx([25, 25, 25], abs=2)


def test_short_films_are_taken_whole() -> None:
    assert choose_frames(np.ones(5), np.arange(5.0), 8) == [0, 1, 2, 3, 4]


# ---- how far the camera has moved -----------------------------------------------------------------------------------


def way_of(frames: list[np.ndarray]) -> np.ndarray:
    odometer = video._Odometer()
    return np.array([odometer.moved(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)) for frame in frames])


@pytest.mark.parametrize("speed", [0.5, 2.0, 6.0])
def test_the_way_of_a_pan_is_its_length(speed: float) -> None:
    frames = pan([round(speed * index) for index in range(60)])
    way = way_of(frames)
    assert way[-1] == pytest.approx(speed * 59 / WIDTH, rel=0.15)
    assert (np.diff(way) >= 0).all()


def test_noise_of_a_camera_at_rest_does_not_add_up() -> None:
    still, generator = pan([0])[0].astype(float), np.random.default_rng(0)
    frames = [(still + generator.normal(0, 6, still.shape)).clip(0, 255).astype(np.uint8) for _ in range(120)]
    assert way_of(frames)[-1] < 0.02


def test_a_zoom_is_motion_too() -> None:
    wide = texture()[:288, :480]
    frames = []
    for index in range(20):
        margin = 4 * index
        frames.append(
            cv2.resize(wide[margin * 288 // 480 : 288 - margin * 288 // 480, margin : 480 - margin], (WIDTH, HEIGHT))
        )
    assert way_of(frames)[-1] > 0.05


def test_very_small_and_very_narrow_films(tmp_path: Path) -> None:
    for height, width in ((2, 2), (16, 16), (4, 64)):
        frames = [np.full((height, width, 3), 10 * index, dtype=np.uint8) for index in range(12)]
        film = read_film(write_film(tmp_path / f"{height}.mp4", frames), 4)
        assert film.size == (height, width) and len(film.frames) >= 2
        assert film.load(film.frames[-1]).shape == (3, height, width)


# ---- films from end to end ------------------------------------------------------------------------------------------


def test_blurred_frames_are_passed_over(tmp_path: Path) -> None:
    sharp = [index % 5 == 2 for index in range(80)]
    frames = [
        frame if good else cv2.GaussianBlur(frame, (0, 0), 3)
        for frame, good in zip(pan([3 * i for i in range(80)]), sharp, strict=True)
    ]
    film = read_film(write_film(tmp_path / "film.mp4", frames), 8)
    assert len(film.frames) == 8
    assert all(sharp[frame.number] for frame in film.frames)


def test_frames_follow_the_way_and_not_the_time(tmp_path: Path) -> None:
    """20 fast frames, 80 slow ones, 40 at rest: equal steps of the picture, not of the clock."""
    offsets = np.cumsum([0] + [8] * 20 + [2] * 80 + [0] * 40).tolist()
    film = read_film(write_film(tmp_path / "film.mp4", pan(offsets)), 8)
    steps = np.diff([offsets[frame.number] for frame in film.frames])
    assert len(film.frames) == 8
    assert steps.min() >= 0.4 * 320 / 8 and steps.max() <= 1.6 * 320 / 8
    blindly = np.diff([offsets[index] for index in np.linspace(0, 140, 8).round().astype(int)])
    assert blindly.max() > 2.5 * 320 / 8, "the film is uneven enough to tell the difference"


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_rotation_metadata_are_honoured(tmp_path: Path, rotation: int) -> None:
    """A phone held upright stores lying pictures and a matrix. NumPy's rotation is the oracle."""
    frames = pan([4 * index for index in range(12)])
    film = read_film(write_film(tmp_path / "film.mp4", frames, rotation=rotation), 4)
    assert film.size == ((HEIGHT, WIDTH) if rotation in (0, 180) else (WIDTH, HEIGHT))
    for frame in film.frames:
        expected = as_tensor(np.rot90(frames[frame.number], rotation // 90))
        assert (film.load(frame) - expected).abs().mean() < 0.03


def test_mirrored_films(tmp_path: Path) -> None:
    """Selfie cameras write matrices that also mirror; made here by patching the file's bytes (tkhd: 16.16 fixed point,
    big endian).
    """
    frames = pan([4 * index for index in range(6)])
    plain = write_film(tmp_path / "film.mp4", frames).read_bytes()
    one = (1 << 16).to_bytes(4, "big")
    minus = (2**32 - (1 << 16)).to_bytes(4, "big")
    place = plain.index(b"tkhd") + 4 + 40  # version, times, track, duration, reserved, layer, group, volume
    assert plain[place : place + 4] == one
    for matrix, turned in (
        ((minus, bytes(4), bytes(4), one), lambda array: array[:, ::-1]),
        ((bytes(4), one, one, bytes(4)), lambda array: array.swapaxes(0, 1)),
        ((bytes(4), minus, minus, bytes(4)), lambda array: array[::-1, ::-1].swapaxes(0, 1)),
    ):
        a, b, c, d = matrix
        (tmp_path / "film.mp4").write_bytes(plain[:place] + a + b + bytes(4) + c + d + plain[place + 20 :])
        film = read_film(tmp_path / "film.mp4", 3)
        expected = as_tensor(turned(frames[film.frames[1].number]))
        assert (film.load(film.frames[1]) - expected).abs().mean() < 0.03


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".webm", ".avi"])
def test_every_chosen_frame_is_the_one_that_was_judged(tmp_path: Path, suffix: str) -> None:
    """Frames tell their numbers; loaded backwards, across key frames, they are still themselves."""
    count = 40 if suffix == ".webm" else 70
    film = read_film(
        write_film(tmp_path / f"film{suffix}", [numbered(index) for index in range(count)], g="12", bf="2"), 10
    )
    assert len(film.frames) >= 2
    for frame in reversed(film.frames):
        assert number_of(film.load(frame)) == frame.number


def test_variable_frame_rate_is_told_by_time_stamps(tmp_path: Path) -> None:
    times = np.cumsum([0, *([1] * 20), *([7] * 10), *([2] * 20)]).tolist()
    film = read_film(write_film(tmp_path / "film.mp4", [numbered(index) for index in range(51)], times=times), 51)
    assert [frame.number for frame in film.frames] == list(range(51))
    assert [frame.seconds for frame in film.frames] == pytest.approx([time / 30 for time in times])
    assert number_of(film.load(film.frames[25])) == 25


def test_a_film_that_does_not_begin_at_zero_counts_from_its_first_frame(tmp_path: Path) -> None:
    film = read_film(
        write_film(tmp_path / "film.mkv", [numbered(index) for index in range(10)], times=list(range(90, 100))), 10
    )
    assert film.frames[0].seconds == 0.0
    assert film.frames[9].seconds == pytest.approx(0.3, abs=0.002)
    assert number_of(film.load(film.frames[4])) == 4


def test_pixels_that_are_not_square_become_square(tmp_path: Path) -> None:
    frames = pan([4 * index for index in range(6)])
    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast", "x264-params": "sar=2/1"})
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        for array in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(array), format="rgb24")))
        container.mux(stream.encode())
    film = read_film(tmp_path / "film.mp4", 3)
    assert film.size == (HEIGHT, 2 * WIDTH)
    assert film.load(film.frames[0]).shape == (3, HEIGHT, 2 * WIDTH)


@pytest.mark.parametrize(("matrix", "tag"), [("bt709", 1), ("smpte170m", 5)])
def test_colours_are_decoded_as_they_are_tagged(tmp_path: Path, matrix: str, tag: int) -> None:
    """A strong orange differs by 0.06 between the two matrices."""
    orange = np.zeros((64, 64, 3), dtype=np.uint8)
    orange[:] = (230, 120, 20)
    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream = container.add_stream(
            "libx264", rate=30, options={"preset": "ultrafast", "qp": "4", "x264-params": f"colormatrix={matrix}"}
        )
        stream.height, stream.width, stream.pix_fmt = 64, 64, "yuv420p"
        for _ in range(4):
            frame = av.VideoFrame.from_ndarray(orange, format="rgb24").reformat(format="yuv420p", dst_colorspace=tag)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    film = read_film(tmp_path / "film.mp4", 2)
    assert film.load(film.frames[1]).mean(dim=(1, 2)).tolist() == pytest.approx(
        [230 / 255, 120 / 255, 20 / 255], abs=0.015
    )


def test_hdr_colours_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    options = {"x264-params": "transfer=arib-std-b67:colorprim=bt2020:colormatrix=bt2020nc"}
    read_film(write_film(tmp_path / "hlg.mp4", pan([0, 3, 6]), **options), 3)
    told = [
        record.getMessage() for record in caplog.records if "HDR" in record.getMessage()
    ]  # other records may be libav's own
    assert len(told) == 1 and "hlg.mp4" in told[0]


# ---- memory and work ------------------------------------------------------------------------------------------------


def counting(decoded: list[int]) -> Callable[..., Iterator]:
    """:func:`video._frames`, which also notes every frame that it gives and that nobody holds an earlier one."""
    original = video._frames

    def frames(*args, **kwargs) -> Iterator:
        for frame in original(*args, **kwargs):
            decoded.append(frame.pts)
            alone = sys.getrefcount(frame)
            yield frame
            if len(decoded) > 1:  # the first tells the film's rotation, after which PyAV itself holds it for a while
                assert sys.getrefcount(frame) <= alone + 1, "only the loop's own name may hold a frame"

    return frames


def test_frames_are_held_one_at_a_time_and_decoded_once_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_film(
        tmp_path / "film.mp4", pan([3 * index for index in range(120)]), g="30", keyint_min="30", sc_threshold="0"
    )
    decoded: list[int] = []
    monkeypatch.setattr(video, "_frames", counting(decoded))
    film = read_film(path, 12)
    assert len(decoded) == 120, "one pass"
    decoded.clear()
    images = [film.load(frame) for frame in film.frames]
    assert len(decoded) <= 120, "in order of time no frame is decoded twice"
    for frame, image in zip(film.frames, images, strict=True):
        decoded.clear()
        assert torch.equal(film.load(frame), image)
        assert len(decoded) <= 30, "any other order costs at most one group of pictures"


def test_kept_pixels_stay_within_their_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_CACHE_BYTES", 3 * HEIGHT * WIDTH * 3)  # three frames
    film = read_film(write_film(tmp_path / "film.mp4", [numbered(index) for index in range(40)]), 40)
    for frame in film.frames:
        assert number_of(film.load(frame)) == frame.number
        assert len(film._kept) <= 3
    monkeypatch.setattr(video, "_CACHE_BYTES", 1)
    assert number_of(film.load(film.frames[0])) == 0 and len(film._kept) == 1
