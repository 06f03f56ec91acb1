"""Still images: what is written comes back, orientation tags are honoured, and damaged files are refused in one
sentence.
"""

from __future__ import annotations

import builtins
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import shared_path
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from fb_core.data import media, picture_decoders

DAMAGED = "truncated|damaged|empty|not readable"


def picture(height: int = 20, width: int = 31, channels: int = 3) -> torch.Tensor:
    return torch.rand(channels, height, width, generator=torch.Generator().manual_seed(height))


def eight_bit(image: torch.Tensor) -> np.ndarray:
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


# ---- there and back -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_lossless_eight_bit_formats_round_to_the_nearest_step(tmp_path: Path, suffix: str) -> None:
    image = picture()
    media.write_image(tmp_path / f"a{suffix}", image)
    found = media.read_image(tmp_path / f"a{suffix}")
    assert found.dtype == torch.float32
    assert torch.equal(found, (image * 255).round() / 255)
    media.write_image(tmp_path / f"b{suffix}", found)
    assert torch.equal(media.read_image(tmp_path / f"b{suffix}"), found), "writing what was read changes nothing"


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bit(tmp_path: Path, suffix: str) -> None:
    image = picture()
    media.write_image(tmp_path / f"a{suffix}", image, bits=16)
    assert (media.read_image(tmp_path / f"a{suffix}") - image).abs().max() <= 0.5 / 65535 + 1e-7


def test_all_values_of_sixteen_bit_files_read_exactly(tmp_path: Path) -> None:
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    Image.fromarray(values).save(tmp_path / "grey.png")
    found = media.read_image(tmp_path / "grey.png")
    assert found.shape == (3, 256, 256)
    assert torch.allclose(found[1], torch.from_numpy(values.astype(np.float32)) / 65535, atol=1e-7)


def test_jpeg_is_close(tmp_path: Path) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 1, 40), torch.linspace(0, 1, 60), indexing="ij")
    image = torch.stack([x, y, 1 - x])
    media.write_image(tmp_path / "a.jpg", image)
    assert (media.read_image(tmp_path / "a.jpg") - image).abs().max() < 0.03


def test_values_outside_the_range_are_clipped(tmp_path: Path) -> None:
    media.write_image(tmp_path / "a.png", torch.tensor([-1.0, 2.0]).expand(3, 1, 2))
    assert media.read_image(tmp_path / "a.png")[0].tolist() == [[0.0, 1.0]]


def test_one_channel_and_one_pixel(tmp_path: Path) -> None:
    media.write_image(tmp_path / "a.png", torch.full((1, 1, 1), 0.2))
    assert media.read_image(tmp_path / "a.png").tolist() == [[[pytest.approx(0.2)]]] * 3
    assert media.image_size(tmp_path / "a.png") == (1, 1)


@pytest.mark.parametrize("mode", ["L", "1", "P", "RGB", "CMYK"])
def test_other_kinds_of_files_become_three_channels(tmp_path: Path, mode: str) -> None:
    original = Image.fromarray(eight_bit(picture())).convert(mode)
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    original.save(path)
    expected = torch.from_numpy(np.array(original.convert("RGB"))).permute(2, 0, 1) / 255
    assert (media.read_image(path) - expected).abs().max() < 0.02
    assert media.read_image_with_alpha(path)[1] is None


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_comes_apart_and_does_not_darken_the_colours(tmp_path: Path, mode: str) -> None:
    array = eight_bit(picture(channels=len(mode)))
    bands = [Image.fromarray(np.ascontiguousarray(array[..., index])) for index in range(len(mode))]
    Image.merge(mode, bands).save(tmp_path / "a.png")
    colours, alpha = media.read_image_with_alpha(tmp_path / "a.png")
    expected = torch.from_numpy(array).permute(2, 0, 1) / 255
    assert torch.equal(alpha, expected[-1:])
    assert torch.equal(colours, expected[:-1].expand(3, -1, -1))
    assert torch.equal(media.read_image(tmp_path / "a.png"), colours)


# ---- orientation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_all_orientations(tmp_path: Path, orientation: int, suffix: str) -> None:
    """Pillow's transposition is the oracle; the size from the header agrees; the stored pixels can be had too."""
    array = np.zeros((24, 40, 3), dtype=np.uint8)
    array[:8, :8], array[:8, 32:], array[16:, :8] = (255, 0, 0), (0, 255, 0), (0, 0, 255)  # three corners differ
    tags = Image.Exif()
    tags[0x0112] = orientation
    path = tmp_path / f"photo{suffix}"
    Image.fromarray(array).save(
        path, exif=tags, **{".jpg": {"quality": 95, "subsampling": 0}, ".webp": {"lossless": True}}.get(suffix, {})
    )
    with Image.open(path) as stored:
        expected = torch.from_numpy(np.asarray(ImageOps.exif_transpose(stored)).copy()).permute(2, 0, 1) / 255
    found = media.read_image(path)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() < 0.02
    assert media.image_size(path) == tuple(found.shape[1:]) == ((24, 40) if orientation < 5 else (40, 24))
    assert media.image_size(path, apply_orientation=False) == (24, 40)
    as_stored = media.read_image(path, apply_orientation=False)
    assert (as_stored - torch.from_numpy(array).permute(2, 0, 1) / 255).abs().max() < 0.02


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_moves_the_named_corner(orientation: int) -> None:
    """The tag's definition: which side of the picture the stored first row and first column are."""
    row_is, column_is = {
        1: ("top", "left"),
        2: ("top", "right"),
        3: ("bottom", "right"),
        4: ("bottom", "left"),
        5: ("left", "top"),
        6: ("right", "top"),
        7: ("right", "bottom"),
        8: ("left", "bottom"),
    }[orientation]
    stored = torch.zeros(2, 3, 5)
    stored[0, 0, :], stored[1, :, 0] = 1, 1
    upright = picture_decoders.upright(stored, orientation)
    sides = {"top": (0, slice(None)), "bottom": (-1, slice(None)), "left": (slice(None), 0), "right": (slice(None), -1)}
    for channel, side in ((0, row_is), (1, column_is)):
        assert (upright[channel][sides[side]] == 1).all()
        assert upright[channel].sum() == stored[channel].sum()


def test_unknown_orientation_counts_as_upright() -> None:
    image = picture()
    for orientation in (0, 9, -3):
        assert torch.equal(picture_decoders.upright(image, orientation), image)


# ---- named float channels -------------------------------------------------------------------------------------------


def test_exr_channels_are_found_by_name_whatever_their_order(tmp_path: Path) -> None:
    names = ["origin.z", "origin.x", "Z", "direction.y", "B", "R", "A"]  # the file keeps an order of its own
    channels = {name: picture(channels=1)[0] * 1000 - 500 + index for index, name in enumerate(names)}
    channels["Z"][0, 0], channels["Z"][1, 1] = torch.inf, torch.nan
    media.write_exr(tmp_path / "a.exr", channels)
    found = media.read_exr(tmp_path / "a.exr")
    assert set(found) == set(names)
    for name in names:
        assert found[name].dtype == torch.float32
        assert torch.equal(found[name].nan_to_num(7.0, posinf=8.0), channels[name].nan_to_num(7.0, posinf=8.0)), name
    assert list(media.read_exr(tmp_path / "a.exr", ["Z", "R"])) == ["Z", "R"]
    with pytest.raises(ValueError, match=r"channels \['Y'\] are not in the file"):
        media.read_exr(tmp_path / "a.exr", ["Y"])


def test_float_pictures_keep_values_above_one(tmp_path: Path) -> None:
    image = picture() * 40 - 3
    media.write_image(tmp_path / "a.exr", image)
    assert torch.equal(media.read_image(tmp_path / "a.exr"), image)
    media.write_image(tmp_path / "grey.exr", image[:1])
    assert torch.equal(media.read_image(tmp_path / "grey.exr"), image[:1].expand(3, -1, -1))


def test_exr_without_colours_is_not_a_picture(tmp_path: Path) -> None:
    media.write_exr(tmp_path / "a.exr", {"depth.Z": torch.ones(4, 4), "normal.x": torch.ones(4, 4)})
    with pytest.raises(ValueError, match="read it with read_exr"):
        media.read_image(tmp_path / "a.exr")
    with pytest.raises(ValueError, match="one size"):
        media.write_exr(tmp_path / "b.exr", {"a": torch.ones(4, 4), "b": torch.ones(4, 5)})
    with pytest.raises(ValueError, match="at least one channel"):
        media.write_exr(tmp_path / "b.exr", {})


# ---- bad files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".exr", ".bmp"])
def test_truncated_files_are_refused_wherever_they_stop(tmp_path: Path, suffix: str) -> None:
    """JPEG above all: its decoder paints the missing part grey and only warns."""
    path = tmp_path / f"a{suffix}"
    media.write_image(path, picture(60, 80))
    whole = path.read_bytes()
    for size in {
        1,
        2,
        3,
        8,
        20,
        100,
        *(len(whole) * part // 8 for part in range(1, 8)),
        len(whole) - 14,
        len(whole) - 1,
    }:
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=DAMAGED) as error:
            media.read_image(path)
        assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_truncated_progressive_jpeg(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(eight_bit(picture(80, 96))).save(path, progressive=True)
    whole = path.read_bytes()
    assert media.read_image(path).shape == (3, 80, 96)
    for part in range(1, 16):
        path.write_bytes(whole[: len(whole) * part // 16])
        with pytest.raises(ValueError, match=DAMAGED):
            media.read_image(path)
        with pytest.raises(ValueError, match=DAMAGED):
            media.image_size(path)


def test_jpeg_with_something_behind_its_end_is_complete(tmp_path: Path) -> None:
    """Phones append previews, depth maps and films."""
    path = tmp_path / "a.jpg"
    Image.fromarray(eight_bit(picture())).save(path, progressive=True)
    expected = media.read_image(path)
    path.write_bytes(path.read_bytes() + b"\x00\xff\x13 film" * 1000)
    assert torch.equal(media.read_image(path), expected)


def test_jpeg_cut_after_its_embedded_preview(tmp_path: Path) -> None:
    """The preview's end marker inside the metadata must not pass for the picture's."""
    Image.fromarray(eight_bit(picture(16, 16))).save(tmp_path / "preview.jpg")
    preview = (tmp_path / "preview.jpg").read_bytes()
    path = tmp_path / "a.jpg"
    Image.fromarray(eight_bit(picture(60, 80))).save(path)
    whole = path.read_bytes()
    segment = b"\xff\xe9" + (len(preview) + 2).to_bytes(2, "big") + preview
    path.write_bytes(whole[:2] + segment + whole[2:])
    assert media.read_image(path).shape == (3, 60, 80)
    path.write_bytes((whole[:2] + segment + whole[2:])[: len(segment) + len(whole) // 2])
    with pytest.raises(ValueError, match="truncated"):
        media.read_image(path)


def test_missing_empty_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        media.read_image(tmp_path / "none.png")
    with pytest.raises(ValueError, match="no such file"):
        media.image_size(tmp_path)
    (tmp_path / "empty.png").touch()
    with pytest.raises(ValueError, match="empty"):
        media.read_image(tmp_path / "empty.png")
    (tmp_path / "text.png").write_text("this is no picture, " * 20)
    for reader in (media.read_image, media.image_size, media.read_exr):
        with pytest.raises(ValueError, match="not readable as an image") as error:
            reader(tmp_path / "text.png")
        assert "\n" not in str(error.value)


def test_writing_refuses_what_it_cannot_keep(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="NaN or infinity"):
        media.write_image(tmp_path / "a.png", torch.full((3, 4, 4), torch.nan))
    with pytest.raises(ValueError, match="shape"):
        media.write_image(tmp_path / "a.png", torch.ones(2, 4, 4))
    with pytest.raises(ValueError, match="shape"):
        media.write_image(tmp_path / "a.png", torch.ones(3, 0, 4))
    with pytest.raises(ValueError, match="bits"):
        media.write_image(tmp_path / "a.png", torch.ones(3, 4, 4), bits=12)
    with pytest.raises(ValueError, match="no image format"):
        media.write_image(tmp_path / "a.picture", torch.ones(3, 4, 4))
    with pytest.raises(OSError, match=r"none/a\.png: No such file or directory; check the path"):
        media.write_image(tmp_path / "none" / "a.png", torch.ones(3, 4, 4))
    assert list(tmp_path.iterdir()) == []


def test_heic_without_its_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photo.HEIC").write_bytes(b"\x00\x00\x00\x18ftypheic" + bytes(64))
    real_import = builtins.__import__

    def without_heif(name: str, *args, **kwargs):
        if name == "pillow_heif":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_heif)
    for reader in (media.read_image, media.image_size):
        with pytest.raises(ValueError, match=r"fillerbuster\[heic\]"):
            reader(tmp_path / "photo.HEIC")


def test_heic(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    y, x = torch.meshgrid(torch.linspace(0, 1, 48), torch.linspace(0, 1, 64), indexing="ij")
    image = torch.stack([x, y, 0.5 * (1 - x)])
    heif.from_pillow(Image.fromarray(eight_bit(image))).save(tmp_path / "a.heic", quality=95)
    assert media.image_size(tmp_path / "a.heic") == (48, 64)
    assert (media.read_image(tmp_path / "a.heic") - image).abs().max() < 0.06
    whole = (tmp_path / "a.heic").read_bytes()
    for size in (200, len(whole) // 2, len(whole) - 20):
        (tmp_path / "a.heic").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="HEIC") as error:
            media.read_image(tmp_path / "a.heic")
        assert "a.heic" in str(error.value)


# ---- resizing -------------------------------------------------------------------------------------------------------


@given(height=st.integers(1, 40), width=st.integers(1, 40), value=st.floats(0, 1))
def test_resizing_keeps_constants_and_the_range(height: int, width: int, value: float) -> None:
    flat = media.resize(torch.full((3, 13, 17), value), height, width)
    assert flat.shape == (3, height, width)
    assert torch.allclose(flat, torch.full_like(flat, value), atol=1e-6)
    busy = media.resize(picture(), height, width)
    assert busy.min() >= picture().min() - 1e-6 and busy.max() <= picture().max() + 1e-6


@given(height=st.integers(2, 30), width=st.integers(2, 30))
def test_resizing_commutes_with_mirroring(height: int, width: int) -> None:
    image = picture(16, 12).double()
    for axis in (1, 2):
        assert torch.allclose(
            media.resize(image.flip(axis), height, width), media.resize(image, height, width).flip(axis), atol=1e-12
        )


def test_resizing_keeps_pixel_centres() -> None:
    """A ramp stays the same ramp in coordinates where the image spans [0, 1]: nothing shifts by half a pixel."""
    ramp = ((torch.arange(64, dtype=torch.float64) + 0.5) / 64).expand(1, 8, 64)
    for width, pixels in ((16, 1e-10), (24, 0.02), (128, 1e-10)):
        found = media.resize(ramp, 8, width)[0, 0]
        expected = (torch.arange(width, dtype=torch.float64) + 0.5) / width
        inside = slice(2, -2)
        assert (found - expected)[inside].abs().max() * width < pixels


def test_shrinking_does_not_alias() -> None:
    """One-pixel stripes become flat grey."""
    stripes = (torch.arange(64) % 2).double().expand(1, 64, 64)
    found = media.resize(stripes, 8, 8)
    assert (found[..., 1:-1] - 0.5).abs().max() < 1e-9
    assert (found - 0.5).abs().max() < 0.02, "at the border half of the triangle is missing"


def test_resizing_to_the_same_size_is_the_identity_and_to_nothing_an_error() -> None:
    image = picture()
    assert media.resize(image, 20, 31) is image
    for size in ((0, 4), (4, -1)):
        with pytest.raises(ValueError, match="at least 1 pixel"):
            media.resize(image, *size)


# ---- real photos ----------------------------------------------------------------------------------------------------


def test_a_real_portrait_photo() -> None:
    path = shared_path("data/fox/images/0001.jpg")
    assert media.image_size(path) == (1920, 1080)
    found = media.read_image(path)
    with Image.open(path) as oracle:
        expected = torch.from_numpy(np.asarray(oracle.convert("RGB")).copy()).permute(2, 0, 1) / 255
    assert found.shape == (3, 1920, 1080)
    assert (found - expected).abs().max() < 0.03  # two JPEG decoders may differ by some steps
    assert (found - expected).abs().mean() < 0.002
