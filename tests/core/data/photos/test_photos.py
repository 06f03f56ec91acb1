"""Folders, films and captures become one list of photos; what cannot be used is named."""

from __future__ import annotations

import builtins
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.exif_photos import EXIF_OF_PHONE, as_tensor, save, scene
from helpers.folders.films import numbered, pan, write_film
from helpers.folders.photos import made
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fb_core.data import media
from fb_core.data.photos.collection import FILM_FRAMES, THUMBNAIL_SIDE, read_photos
from fb_core.geometry.viewpoints.paths import spread_subset

# ---- shrinking ------------------------------------------------------------------------------------------------------


@given(height=st.integers(1, 60), width=st.integers(1, 60), side=st.integers(1, 70))
def test_shrinking_keeps_constants_and_never_enlarges(height: int, width: int, side: int) -> None:
    image = torch.full((3, height, width), 0.3)
    small = media.shrink(image, side)
    assert max(small.shape[1:]) == min(side, max(height, width)) and min(small.shape[1:]) >= 1
    assert torch.allclose(small, torch.full_like(small, 0.3), atol=1e-6)


def test_shrinking_by_whole_factors_is_the_mean_of_blocks() -> None:
    image = torch.rand(3, 24, 36)
    assert torch.allclose(
        media.shrink(image, 9), image.unflatten(1, (6, 4)).unflatten(3, (9, 4)).mean(dim=(2, 4)), atol=1e-6
    )
    assert media.shrink(image, None) is image and media.shrink(image, 36) is image
    with pytest.raises(ValueError, match="longest_side"):
        media.shrink(image, 0)


@given(side=st.integers(3, 40))
def test_shrinking_by_any_factor_keeps_the_mean(side: int) -> None:
    image = torch.rand(1, 41, 41, generator=torch.Generator().manual_seed(side))
    assert float(media.shrink(image, side).mean()) == pytest.approx(float(image.mean()), abs=1e-5)


def test_colours_of_unknown_pixels_do_not_bleed() -> None:
    """The known half is grey, the unknown one is white: every small pixel that is known at all is grey."""
    image, mask = torch.full((3, 20, 20), 0.5), torch.ones(1, 20, 20)
    image[:, :, 9:], mask[:, :, 9:] = 1.0, 0.0
    photo = made(image, mask=mask)
    small, known = photo.load(10), photo.load_mask(10)
    assert known[0, 0].tolist() == pytest.approx([1, 1, 1, 1, 0.5, 0, 0, 0, 0, 0])
    assert torch.allclose(small[:, :, :5], torch.full((3, 10, 5), 0.5), atol=1e-6)
    assert not small[:, :, 5:].any()


# ---- folders of photos ----------------------------------------------------------------------------------------------


def test_natural_order_and_names_of_their_own(tmp_path: Path) -> None:
    for index, name in enumerate(
        ["IMG_10.png", "IMG_2.PNG", "a b.png", "IMG_2.bmp", "img_2.tif", ".hidden.png", "IMG_2_2.png"]
    ):
        save(tmp_path / name, scene(index))
    (tmp_path / "notes.txt").write_text("walked around twice")
    (tmp_path / "folder.png").mkdir()
    photos = read_photos(tmp_path)
    assert [photo.source.name for photo in photos] == [
        "a b.png",
        "IMG_2.bmp",
        "IMG_2.PNG",
        "img_2.tif",
        "IMG_2_2.png",
        "IMG_10.png",
    ]
    names = [photo.name for photo in photos]
    assert names == ["a_b", "IMG_2", "IMG_2_3", "img_2_4", "IMG_2_2", "IMG_10"]
    assert len({name.lower() for name in names}) == 6
    assert all(photo.camera is None and photo.focal_prior is None and photo.device == "" for photo in photos)


def test_twelve_photos_of_three_sizes_portrait_and_landscape(tmp_path: Path) -> None:
    """As phones store them: lying pixels and a tag for those held upright."""
    sizes = [(60, 80), (48, 64), (90, 120)]
    for index in range(12):
        orientation = 6 if index % 2 else 1
        array = scene(index, *sizes[index % 3])
        save(tmp_path / f"p{index}.jpg", array, Orientation=orientation, **EXIF_OF_PHONE)
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == [f"p{index}" for index in range(12)]
    for index, photo in enumerate(photos):
        height, width = sizes[index % 3][::-1] if index % 2 else sizes[index % 3]
        upright = np.rot90(scene(index, *sizes[index % 3]), -1) if index % 2 else scene(index, *sizes[index % 3])
        assert photo.size == (height, width)
        assert photo.load().shape == (3, height, width) and photo.load_mask().shape == (1, height, width)
        assert (photo.load() - as_tensor(upright)).abs().mean() < 0.02
        assert max(photo.load(32).shape[1:]) == 32 and photo.load_mask(32).shape[1:] == photo.load(32).shape[1:]
        assert max(photo.thumbnail.shape[1:]) <= THUMBNAIL_SIDE
    assert len({photo.device for photo in photos}) == 3, "one lens per size, whichever way it was held"
    assert photos[0].device == photos[3].device


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".exr"])
def test_every_format_shows_the_same_picture(tmp_path: Path, suffix: str) -> None:
    array = scene(3)
    for name in "ab":
        if suffix == ".exr":  # linear light
            srgb = as_tensor(array)
            linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
            media.write_image(tmp_path / f"{name}.exr", linear)
        else:
            save(tmp_path / f"{name}{suffix}", array)
    for photo in read_photos(tmp_path):
        assert (photo.load() - as_tensor(array)).abs().mean() < (0.02 if suffix in (".jpg", ".jpeg", ".webp") else 1e-3)
        assert photo.load_mask().eq(1).all()


def test_linear_light_becomes_srgb() -> None:
    """Values of the standard (IEC 61966-2-1)."""
    srgb = media.to_srgb(torch.tensor([-1.0, 0.0, 0.0031308, 0.214041, 1.0]))
    assert srgb.tolist() == pytest.approx([0.0, 0.0, 0.04045, 0.5, 1.0], abs=1e-4)


def test_exr_with_alpha_and_with_holes(tmp_path: Path) -> None:
    """EXR colours are multiplied by alpha; what is not finite is unknown; light above 1 is white."""
    alpha = torch.full((8, 8), 0.5)
    red = torch.full((8, 8), 0.5 * 0.214041)
    red[0, 0], red[1, 1], alpha[2, 2] = torch.nan, 40.0, 0.0
    channels = {"R": red, "G": red.clone().nan_to_num(), "B": red.clone().nan_to_num(), "A": alpha}
    for name in "ab":
        media.write_exr(tmp_path / f"{name}.exr", channels)
    image, mask = read_photos(tmp_path)[0].load_with_mask()
    assert image[:, 4, 4].tolist() == pytest.approx([0.5] * 3, abs=1e-4) and float(mask[0, 4, 4]) == 0.5
    assert float(mask[0, 0, 0]) == 0 and float(mask[0, 2, 2]) == 0
    assert image[:, 1, 1].tolist() == [1, 1, 1] and torch.isfinite(image).all()


def test_alpha_is_the_mask(tmp_path: Path) -> None:
    array = np.dstack([scene(1), np.full((60, 80), 255, dtype=np.uint8)])
    array[:30, :, 3] = 0
    for name in "ab":
        save(tmp_path / f"{name}.png", array)
    photo = read_photos(tmp_path)[0]
    assert photo.load_mask()[0].mean(dim=1).tolist() == [0.0] * 30 + [1.0] * 30
    assert photo.load_mask(40)[0].mean(dim=1).tolist() == [0.0] * 15 + [1.0] * 15
    assert (photo.load()[:, 30:] - as_tensor(scene(1))[:, 30:]).abs().max() < 1e-6


def test_heic_without_its_extra_is_named_and_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real_import = builtins.__import__

    def without_heif(name: str, *args, **kwargs):
        if name == "pillow_heif":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_heif)
    for name in ("c.heic", "d.HEIC"):
        (tmp_path / name).write_bytes(b"\x00\x00\x00\x18ftypheic" + bytes(64))
    with pytest.raises(ValueError, match=r"got 0 \(2 cannot be read; the first: .*c\.heic.*fillerbuster\[heic\]"):
        read_photos(tmp_path)
    save(tmp_path / "a.png", scene(0))
    save(tmp_path / "b.png", scene(1))
    assert [photo.name for photo in read_photos(tmp_path)] == ["a", "b"]
    assert "d.HEIC" in caplog.text and "fillerbuster[heic]" in caplog.text


def test_heic(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Acme One", 6
    exif.get_ifd(0x8769)[0xA405] = 26
    for name in "ab":
        heif.from_pillow(Image.fromarray(scene(2))).save(tmp_path / f"{name}.heic", quality=95, exif=exif.tobytes())
    photo = read_photos(tmp_path)[0]
    assert photo.size == (photo.load().shape[1], photo.load().shape[2])
    assert photo.focal_prior == pytest.approx(26 * 100 / math.hypot(36, 24), rel=1e-6)
    assert photo.device.startswith("Acme One")


# ---- films ----------------------------------------------------------------------------------------------------------


def test_a_film_of_a_phone_held_upright(tmp_path: Path) -> None:
    frames = pan([3 * index for index in range(60)])
    photos = read_photos(write_film(tmp_path / "VID 1.mp4", frames, rotation=-90), most=8)
    assert len(photos) == 8
    assert len({photo.device for photo in photos}) == 1 and photos[0].device != ""
    for photo in photos:
        number = int(photo.name.removeprefix("frame_"))
        assert photo.name == f"frame_{number:05d}" and photo.seconds == pytest.approx(number / 30)
        assert photo.size == (160, 96) and photo.camera is None and photo.focal_prior is None
        assert (photo.load() - as_tensor(np.rot90(frames[number], -1))).abs().mean() < 0.03
        assert photo.load(40).shape == (3, 40, 24) and photo.load_mask(40).shape == (1, 40, 24)
    assert [photo.seconds for photo in photos] == sorted(photo.seconds or 0.0 for photo in photos)


def test_how_many_frames_of_a_film(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mp4", [numbered(index) for index in range(50)])
    assert len(read_photos(path)) <= FILM_FRAMES
    assert len(read_photos(path, most=2)) == 2


# ---- posed captures -------------------------------------------------------------------------------------------------


def test_a_posed_capture_keeps_cameras_order_and_masks(tiny_capture: Path) -> None:
    from fb_core.data.capture.captures import read_capture

    capture = read_capture(tiny_capture)
    photos = read_photos(tiny_capture)
    assert [photo.name for photo in photos] == [frame.image_path.stem for frame in capture.frames]
    for photo, frame in zip(photos, capture.frames, strict=True):
        assert photo.camera is not None
        assert torch.equal(photo.camera.camera_to_world, frame.camera.camera_to_world)
        assert photo.size == (photo.camera.height, photo.camera.width) and photo.focal_prior == float(
            photo.camera.focal.mean()
        )
        assert torch.equal(photo.load(), frame.load_image()) or not frame.load_mask().eq(1).all()
        assert torch.equal(photo.load_mask(), frame.load_mask())
    assert len({photo.device for photo in photos}) == 1
    assert [photo.name for photo in read_photos(tiny_capture / "transforms.json")] == [photo.name for photo in photos]
    chosen = read_photos(tiny_capture, most=3)
    expected = sorted(spread_subset([photo.camera for photo in photos if photo.camera is not None], 3))
    assert [photo.name for photo in chosen] == [photos[index].name for index in expected]


def test_generated_views_of_a_capture_are_no_photos(tiny_capture: Path) -> None:
    import json

    path = tiny_capture / "transforms.json"
    meta = json.loads(path.read_text())
    for entry in meta["frames"][3:]:
        entry["generated"] = True
    path.write_text(json.dumps(meta))
    assert len(read_photos(tiny_capture)) == 3


def test_a_bent_lens_is_straightened(tiny_capture: Path) -> None:
    import json

    path = tiny_capture / "transforms.json"
    meta = json.loads(path.read_text())
    plain = read_photos(tiny_capture)[0]
    meta["k1"] = -0.2
    path.write_text(json.dumps(meta))
    bent = read_photos(tiny_capture)[0]
    assert bent.camera is not None and plain.camera is not None
    assert not torch.equal(bent.camera.focal, plain.camera.focal)
    assert bent.load().shape == plain.load().shape and bent.device != plain.device
