"""What EXIF tells of a photo: focal length, device, time; broken tags do not matter."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.folders.exif_photos import EXIF_OF_PHONE, save, scene

from fb_core.data.photos.collection import read_photos
from fb_core.data.photos.exif import read_exif

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
