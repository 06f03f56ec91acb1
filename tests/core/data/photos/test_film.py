"""Films of generated views: what is written is what a decoder gives back."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fb_core.data.photos.film import write_film


def moving(count: int, height: int, width: int) -> list[torch.Tensor]:
    x = torch.linspace(0, 1, width).expand(height, width)
    return [torch.stack([x, torch.full_like(x, index / count), 1 - x]) for index in range(count)]


def decoded(path: Path) -> tuple[list[torch.Tensor], str, float]:
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [
            torch.from_numpy(frame.to_ndarray(format="rgb24")).movedim(-1, 0).float() / 255
            for frame in container.decode(stream)
        ]
        return frames, stream.codec_context.name, float(stream.average_rate)


@pytest.mark.parametrize(
    ("height", "width", "size"),
    [(64, 64, (512, 512)), (33, 17, (924, 476)), (600, 481, (600, 480)), (481, 800, (480, 800))],
)
def test_a_film_has_all_frames_at_even_sizes(tmp_path: Path, height, width, size):
    assert write_film(tmp_path / "film.mp4", moving(5, height, width), frames_per_second=8) == 5
    frames, codec, rate = decoded(tmp_path / "film.mp4")
    assert (len(frames), codec, rate) == (5, "h264", 8.0)
    assert all(tuple(frame.shape[1:]) == size for frame in frames)
    for index, frame in enumerate(frames):  # colours survive, in their order
        assert float(frame[1].mean()) == pytest.approx(index / 5, abs=0.04)
        assert float(frame[0, :, -20:].mean() - frame[0, :, :20].mean()) > 0.8


def test_nonsense_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="expected at least one picture, got none"):
        write_film(tmp_path / "film.mp4", [])
    with pytest.raises(ValueError, match="pictures of one size, got 704x512 after 512x512"):
        write_film(tmp_path / "film.mp4", [torch.zeros(3, 64, 64), torch.zeros(3, 64, 88)])
    with pytest.raises(ValueError, match="between 0 and 240 frames per second, got 0"):
        write_film(tmp_path / "film.mp4", moving(1, 16, 16), frames_per_second=0)
    with pytest.raises(ValueError, match="at least 2x2 pixels, got 1x1"):
        write_film(tmp_path / "film.mp4", [torch.zeros(3, 1, 1)])
