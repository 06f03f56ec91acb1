"""Folders, films and captures become one list of photos; what cannot be used is named."""

from __future__ import annotations

import builtins
import logging
import math
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.folders.films import numbered, pan, write_film
from helpers.folders.photos import made
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from fb_core.data import media
from fb_core.data.photos.choice import choose_by_coverage, doubtful, require_two_views
from fb_core.data.photos.collection import FILM_FRAMES, THUMBNAIL_SIDE, read_photos
from fb_core.data.photos.exif import read_exif
from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import spread_subset

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


# ---- EXIF -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_focal_length_from_its_35_mm_equivalent(tmp_path: Path, suffix: str) -> None:
    """24 mm on 36 x 24 mm film: 36 mm are as wide as the picture. The same upright."""
    for name, orientation in (("a", 1), ("b", 8)):
        save(
            tmp_path / f"{name}{suffix}",
            scene(0, 60, 90),
            Model="One",
            FocalLengthIn35mmFilm=24,
            Orientation=orientation,
        )
    lying, upright = read_photos(tmp_path)
    assert lying.focal_prior == pytest.approx(90 * 24 / 36) and upright.focal_prior == pytest.approx(60.0)
    assert (lying.size, upright.size) == ((60, 90), (90, 60))
    assert lying.device == upright.device != ""


@pytest.mark.parametrize(("unit", "millimetres"), [(2, 25.4), (3, 10.0), (4, 1.0), (None, 25.4)])
def test_focal_length_from_the_density_of_the_sensor(tmp_path: Path, unit: int | None, millimetres: float) -> None:
    """5 mm at 20 pixels per millimetre are 100 pixels; half of that once the picture was made half as large."""
    tags = {
        "FocalLength": 5.0,
        "FocalPlaneXResolution": 20.0 * millimetres,
        **({} if unit is None else {"FocalPlaneResolutionUnit": unit}),
    }
    path = save(tmp_path / "a.jpg", scene(0), **tags)
    assert read_exif(path, (60, 80)).focal_pixels == pytest.approx(100.0, rel=1e-4)
    path = save(tmp_path / "a.jpg", scene(0), **tags, ExifImageWidth=160, ExifImageHeight=120)
    assert read_exif(path, (60, 80)).focal_pixels == pytest.approx(50.0, rel=1e-4)
    assert read_exif(path, (80, 60)).focal_pixels == pytest.approx(50.0, rel=1e-4)


def test_the_35_mm_equivalent_of_a_real_phone(tmp_path: Path) -> None:
    """A lens of 4.2 mm over pixels of 1.4 micrometres is said to be a 26 mm lens: the diagonal tells it within
    rounding.
    """
    path = save(tmp_path / "a.jpg", scene(0), FocalLengthIn35mmFilm=26)
    assert read_exif(path, (3024, 4032)).focal_pixels == pytest.approx(4.2 / 1.4e-3, rel=0.02)


@pytest.mark.parametrize(
    "tags",
    [
        {"FocalLength": 5.0},
        {"FocalLengthIn35mmFilm": 0},
        {"FocalLength": 0.0, "FocalPlaneXResolution": 700.0},
        {"FocalLength": 5.0, "FocalPlaneXResolution": 700.0, "FocalPlaneResolutionUnit": 9},
    ],
)
def test_what_the_tags_do_not_tell_is_unknown(tmp_path: Path, tags: dict) -> None:
    assert read_exif(save(tmp_path / "a.jpg", scene(0), **tags), (60, 80)).focal_pixels is None


def test_devices_differ_by_lens_and_zoom(tmp_path: Path) -> None:
    for index, changed in enumerate(
        [{}, {}, {"FocalLength": 1.5}, {"FocalLengthIn35mmFilm": 52}, {"LensModel": "front"}, {"Model": "Two"}]
    ):
        save(tmp_path / f"{index}.jpg", scene(index), **{**EXIF_OF_PHONE, **changed})
    devices = [photo.device for photo in read_photos(tmp_path)]
    assert devices[0] == devices[1] and len(set(devices)) == 5
    assert devices[0].startswith("Acme One") and "Acme Acme" not in devices[0]


def test_time_of_exposure(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", scene(0), DateTimeOriginal="2023:05:01 12:33:44", SubsecTimeOriginal="25")
    save(tmp_path / "b.jpg", scene(1), DateTimeOriginal="2023:05:01 12:33:46")
    save(tmp_path / "c.jpg", scene(2), DateTimeOriginal="0000:00:00 00:00:00")
    first, second, third = (photo.seconds for photo in read_photos(tmp_path))
    assert first is not None and second is not None and third is None
    assert second - first == pytest.approx(1.75)


def test_broken_tags_do_not_matter(tmp_path: Path) -> None:
    for name in "ab":
        path = save(tmp_path / f"{name}.jpg", scene(0), **EXIF_OF_PHONE)
        data = bytearray(path.read_bytes())
        start = data.index(b"Exif\0\0") + 14
        data[start : start + 40] = bytes(range(200, 240))
        path.write_bytes(bytes(data))
    assert all(photo.focal_prior is None for photo in read_photos(tmp_path))


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


# ---- bad input ------------------------------------------------------------------------------------------------------


def refused(source: Path, **options) -> str:
    with pytest.raises(ValueError) as error:
        read_photos(source, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_folders_without_photos(tmp_path: Path) -> None:
    assert "no such folder or film" in refused(tmp_path / "none")
    assert "an empty folder" in refused(tmp_path)
    (tmp_path / "inside").mkdir()
    assert f"give the one with the photos: {tmp_path / 'inside'}" in refused(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing")
    assert ".txt" in refused(tmp_path)
    write_film(tmp_path / "walk.mp4", pan([0, 2]))
    assert "give the film itself" in refused(tmp_path) and "walk.mp4" in refused(tmp_path)


def test_one_photo(tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", scene())
    assert "at least 2 photos, got 1" in refused(tmp_path)
    assert "got one photo" in refused(path)
    assert "most" in refused(tmp_path, most=1)


def test_a_text_file_named_jpg_and_a_truncated_photo_are_left_out_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "notes.jpg").write_text("this is no picture " * 20)
    save(tmp_path / "a.jpg", scene(0))
    assert "notes.jpg" in refused(tmp_path) and "got 1 (1 cannot be read" in refused(tmp_path)
    save(tmp_path / "b.png", scene(1))
    cut = save(tmp_path / "c.png", scene(2))
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        assert [photo.name for photo in read_photos(tmp_path)] == ["a", "b"]
    assert len(caplog.records) == 2 and "notes.jpg" in caplog.text and "c.png" in caplog.text


@pytest.mark.parametrize("suffix", [b".png", b".mp4"])
def test_names_that_are_no_text(tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: bytes) -> None:
    """Names in Latin-1 out of an old archive: the decoders take UTF-8 alone, and one ended the reading of all photos
    in a TypeError.
    """
    for index in range(3):
        save(tmp_path / f"{index}.png", scene(index))
    odd = (tmp_path / "2.png").rename(tmp_path / os.fsdecode(b"caf\xe9" + suffix))
    if suffix == b".mp4":
        assert "expected a name in UTF-8" in refused(odd)
    else:
        assert [photo.name for photo in read_photos(tmp_path)] == ["0", "1"]
        assert len(caplog.records) == 1 and r"caf\udce9.png: expected a name in UTF-8" in caplog.text


def test_photos_and_folders_that_may_not_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for index in range(3):
        save(tmp_path / f"{index}.png", scene(index))
    original = Path.open

    def forbidding(path: Path, *args, **kwargs):
        if path.name == "1.png":
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *args, **kwargs)

    monkeypatch.setattr(Path, "open", forbidding)
    assert [photo.name for photo in read_photos(tmp_path)] == ["0", "2"]
    assert "1.png" in caplog.text and "Permission denied" in caplog.text

    def forbidden(path: Path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", forbidden)
    assert "permission denied" in refused(tmp_path)


def test_a_photo_that_vanishes_is_named_when_it_is_loaded(tmp_path: Path) -> None:
    for index in range(2):
        save(tmp_path / f"{index}.png", scene(index))
    photos = read_photos(tmp_path)
    (tmp_path / "1.png").unlink()
    with pytest.raises(ValueError, match=r"1\.png: no such file"):
        photos[1].load()


# ---- which photos ---------------------------------------------------------------------------------------------------


def test_photos_that_show_nothing_or_the_same_are_named(tmp_path: Path) -> None:
    save(tmp_path / "0.png", scene(0, 240, 320))
    save(tmp_path / "1.jpg", scene(0, 240, 320))  # another compression of the same
    save(tmp_path / "2.png", np.zeros_like(scene()))
    save(tmp_path / "3.png", np.full_like(scene(), 250))
    noise = np.random.default_rng(0).integers(0, 6, scene().shape).astype(np.uint8)
    save(tmp_path / "4.png", noise)
    save(tmp_path / "5.png", scene(5))
    photos = read_photos(tmp_path)
    assert doubtful(photos) == {"1": "the same picture as 0", "2": "black", "3": "of one colour", "4": "black"}
    require_two_views(photos)


@pytest.mark.parametrize(
    ("pictures", "told"),
    [(["same"] * 4, "the same picture as 0"), (["black"] * 4, "black"), (["same", "black"], "black")],
)
def test_identical_and_black_photos_cannot_tell_cameras(tmp_path: Path, pictures: list[str], told: str) -> None:
    for index, kind in enumerate(pictures):
        save(tmp_path / f"{index}.png", scene(0) if kind == "same" else np.zeros_like(scene()))
    with pytest.raises(ValueError, match=f"at least 2 different pictures.*{told}") as error:
        require_two_views(read_photos(tmp_path))
    assert "\n" not in str(error.value)


def test_a_small_step_to_the_side_is_not_the_same_picture() -> None:
    first, second = (made(as_tensor(array), name) for array, name in zip(pan([0, 2]), "ab", strict=True))
    assert doubtful([first, second]) == {}


def clusters(members: int, kinds: int) -> list[Photo]:
    """Photos of a few places, each taken often and almost alike."""
    generator = torch.Generator().manual_seed(0)
    return [
        made(
            (as_tensor(scene(kind)) + 0.05 * torch.randn(3, 60, 80, generator=generator)).clamp(0, 1), f"{kind}_{index}"
        )
        for kind in range(kinds)
        for index in range(members)
    ]


def test_every_place_is_chosen_before_any_twice() -> None:
    photos = clusters(10, 4)
    chosen = choose_by_coverage(photos, 4)
    assert [photos[index].name[0] for index in chosen] == ["0", "1", "2", "3"]


def test_the_choice_is_ascending_without_repetition_and_all_when_few() -> None:
    photos = clusters(5, 3)
    for count in (1, 2, 7, 14):
        chosen = choose_by_coverage(photos, count)
        assert len(chosen) == count and chosen == sorted(set(chosen))
    assert choose_by_coverage(photos, 15) == choose_by_coverage(photos, 99) == list(range(15))


def test_photos_alike_are_chosen_evenly_in_time() -> None:
    photos = clusters(40, 1)
    gaps = np.diff(choose_by_coverage(photos, 5))
    assert gaps.min() >= 3


def test_doubtful_photos_come_last() -> None:
    photos = [
        *clusters(1, 3),
        made(torch.zeros(3, 60, 80), "black"),
        made(as_tensor(scene(0)), "twin"),
        made(as_tensor(scene(0)), "triplet"),
    ]
    names = [photos[index].name for index in choose_by_coverage(photos, 4)]
    assert "black" not in names and "triplet" not in names
    assert len(choose_by_coverage(photos, 5)) == 5


def test_with_known_poses_place_and_direction_decide() -> None:
    angles = torch.arange(12, dtype=torch.float64) * torch.pi / 6
    centers = torch.stack([angles.cos(), angles.sin(), torch.zeros(12, dtype=torch.float64)], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cameras = Pinholes.looking_at(centers, torch.zeros_like(centers), up=up, fov_degrees=60.0, width=80, height=60)
    same = as_tensor(scene(0))
    photos = [made(same, str(index), camera=cameras[index]) for index in range(12)]
    chosen = choose_by_coverage(photos, 4)
    assert chosen == sorted(spread_subset([cameras], 4))
    assert np.diff(chosen).tolist() == [3, 3, 3], "a quarter of the circle apart, though all look alike"


def test_a_hundred_photos(tmp_path: Path) -> None:
    for index in range(100):
        save(tmp_path / f"IMG_{index}.jpg", scene(index, 24, 32))
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == [f"IMG_{index}" for index in range(100)]
    assert len(choose_by_coverage(photos, 16)) == 16


def test_the_most_photos_are_those_that_cover(tmp_path: Path) -> None:
    for index in range(8):
        save(tmp_path / f"{index}.jpg", scene(index))
    photos = read_photos(tmp_path)
    assert [photo.name for photo in read_photos(tmp_path, most=3)] == [
        photos[index].name for index in choose_by_coverage(photos, 3)
    ]


def test_real_photos(shared_path, tmp_path: Path) -> None:
    """Three portrait photos without EXIF data and without their poses."""
    for path in sorted((shared_path("data/fox") / "images").iterdir())[:3]:
        shutil.copy(path, tmp_path)
    photos = read_photos(tmp_path)
    assert [photo.size for photo in photos] == [(1920, 1080)] * 3 and doubtful(photos) == {}
    assert photos[0].load(128).shape == (3, 128, 72)


@pytest.mark.parametrize(("folder", "told"), [("masks", True), ("Mask", True), ("sorted out", False)])
def test_a_folder_of_masks_beside_photos_is_not_used_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, folder: str, told: bool
) -> None:
    for name in ("Foto ä 1.png", "Foto ä 2.png"):
        save(tmp_path / name, scene(len(name)))
    (tmp_path / folder).mkdir()
    with caplog.at_level(logging.WARNING):
        photos = read_photos(tmp_path)
    assert len(photos) == 2 and any("is not used" in line for line in caplog.messages) == told
