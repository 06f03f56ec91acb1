"""Folders and photos that cannot be used are named, in one sentence."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest
from helpers.folders.exif_photos import save, scene
from helpers.folders.films import pan, write_film

from fb_core.data.photos.collection import read_photos

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
