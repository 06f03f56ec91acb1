"""Films that are cut, damaged, of one frame or of strange sizes: what is there is used, or a sentence says why not."""

from __future__ import annotations

import logging
from pathlib import Path

import av
import numpy as np
import pytest
from helpers.folders.films import HEIGHT, WIDTH, pan, write_film
from helpers.folders.frames import as_tensor

from fb_core.data.photos.video import read_film

# ---- bad films ------------------------------------------------------------------------------------------------------


def refused(path: Path) -> str:
    with pytest.raises(ValueError) as error:
        read_film(path, 8)
    sentence = str(error.value)
    assert "\n" not in sentence and path.name in sentence
    return sentence


def test_a_film_of_one_frame(tmp_path: Path) -> None:
    assert "at least 2 frames, got 1" in refused(write_film(tmp_path / "film.mp4", pan([0])))


def test_files_that_are_no_films(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("this is no film " * 50)
    assert "not readable as a film" in refused(tmp_path / "text.mp4")
    (tmp_path / "empty.mp4").touch()
    assert "not readable as a film" in refused(tmp_path / "empty.mp4")
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), dtype=np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert "without pictures" in refused(tmp_path / "sound.mp4")


def test_a_film_without_its_end_and_index_is_refused(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", pan([3 * index for index in range(60)]))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])  # phones write the index last
    assert "copied completely" in refused(path)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_of_a_truncated_film_what_is_there_is_used(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    options = {"movflags": "faststart"} if suffix == ".mp4" else {}
    path = write_film(tmp_path / f"film{suffix}", pan([3 * index for index in range(120)]), g="10", **options)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.6 * len(whole))])
    with caplog.at_level(logging.WARNING):
        film = read_film(path, 8)
    assert len(film.frames) == 8 and 40 < film.frames[-1].number < 90
    assert len(caplog.records) == 1 and "truncated" in caplog.text and path.name in caplog.text
    for frame in film.frames:
        assert film.load(frame).shape == (3, HEIGHT, WIDTH)


def test_damage_in_the_middle_does_not_end_the_film(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_film(tmp_path / "film.mkv", pan([3 * index for index in range(120)]), g="10")
    damaged = bytearray(path.read_bytes())
    half = len(damaged) // 2
    damaged[half : half + 3000] = np.random.default_rng(0).bytes(3000)
    path.write_bytes(bytes(damaged))
    with caplog.at_level(logging.WARNING):
        film = read_film(path, 8)
    assert len(film.frames) == 8 and film.frames[-1].seconds > 3.0
    for frame in film.frames:
        film.load(frame)
    assert len(caplog.records) <= 1


def test_frames_that_the_decoder_had_to_paint_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = pan([3 * index for index in range(120)])
    path = write_film(tmp_path / "film.mp4", frames, g="10", movflags="faststart")
    damaged = bytearray(path.read_bytes())
    for place in range(len(damaged) // 2, 2 * len(damaged) // 3, 900):
        damaged[place] ^= 0x55
    path.write_bytes(bytes(damaged))
    film = read_film(path, 120)
    assert 90 < len(film.frames) < 119 and "damaged" in caplog.text
    errors = [
        float((film.load(frame) - as_tensor(frames[round(frame.seconds * 30)])).abs().mean()) for frame in film.frames
    ]
    assert max(errors) < 0.1 and np.quantile(errors, 0.9) < 0.03


def test_a_film_that_changes_after_the_choice_is_told(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", pan([3 * index for index in range(40)]))
    film = read_film(path, 4)
    write_film(path, pan([0, 3]))
    with pytest.raises(ValueError, match="no longer be decoded"):
        film.load(film.frames[-1])


def test_widths_whose_rows_have_gaps_and_the_side_that_motion_is_measured_in(tmp_path: Path) -> None:
    """120 x 90: nothing is made smaller, so that the decoder's own rows reach the optical flow."""
    for width, height in ((120, 90), (98, 66), (118, 96)):
        frames = [frame[:height, :width] for frame in pan(list(range(0, 60, 6)))]
        film = read_film(write_film(tmp_path / f"{width}.mp4", frames), 4)
        assert film.size == (height, width) and len(film.frames) >= 2


def test_black_frames_take_no_places(tmp_path: Path) -> None:
    black = [np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)] * 14
    moving = pan(list(range(0, 20 * 8, 8)))
    film = read_film(write_film(tmp_path / "intro.mp4", [*black, *moving, *black[:3]]), 16)
    assert len(film.frames) == 16 and {frame.number for frame in film.frames} <= set(range(14, 34))
    still = read_film(write_film(tmp_path / "black.mp4", black), 4)
    assert len(still.frames) == 4, "a film of nothing else is taken as it is"


def test_the_largest_of_several_streams_is_taken(tmp_path: Path) -> None:
    """Cameras put a small preview first."""
    path = tmp_path / "two.mov"
    large = pan(list(range(0, 60, 6)))
    with av.open(str(path), "w") as container:
        streams = []
        for height, width in ((48, 64), (HEIGHT, WIDTH)):
            stream = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
            streams.append(stream)
        for array in large:
            for stream in streams:
                picture = np.ascontiguousarray(array[: stream.height, : stream.width])
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode())
    film = read_film(path, 4)
    assert film.size == (HEIGHT, WIDTH) and film.load(film.frames[0]).shape == (3, HEIGHT, WIDTH)
