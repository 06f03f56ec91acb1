"""Pictures as other tools write them: what the file means to show is read, wherever it is read."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from fb_core.data import media, picture_decoders
from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.photos.collection import read_photos
from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d
from fb_nerfstudio.capture.pictures import CapturePictures


def trained(folder: Path, index: int = 0) -> torch.Tensor:
    """What ns-train reads of a picture: [h, w, 3 or 4] in [0, 1]."""
    outputs = NerfstudioWithoutOpen3d(NerfstudioDataParserConfig(data=folder, eval_mode="all")).get_dataparser_outputs(
        "train"
    )
    return CapturePictures(outputs, 1.0).get_data(index, "uint8")["image"].float() / 255


def with_pictures(folder: Path, suffix: str, save) -> Path:
    """The capture with pictures of another kind; ``save(path, rgb)`` writes one, rgb is uint8 [h, w, 3]."""
    meta = json.loads((folder / "transforms.json").read_text())
    for frame in meta["frames"]:
        old = folder / frame["file_path"]
        new = old.with_suffix(suffix)
        save(new, np.array(Image.open(old).convert("RGB")))
        frame["file_path"] = str(new.relative_to(folder))
        frame.pop("mask_path", None)
    for split in ("train", "val", "test"):
        meta.pop(f"{split}_filenames", None)
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def write_exr(
    path: Path, pixels: np.ndarray, names: tuple[str, ...], place: tuple[int, int], full: tuple[int, int]
) -> None:
    """(h, w, c) float pixels as a data window at ``place`` (x, y) of a display window of ``full`` (width, height)."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.x, spec.y = place
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, *full
    spec.channelnames = names
    writer = oiio.ImageOutput.create(str(path))
    assert (
        writer.open(str(path), spec)
        and writer.write_image(np.ascontiguousarray(pixels.astype(np.float32)))
        and writer.close()
    )


# ---- EXR -------------------------------------------------------------------------------------------------------------


def test_a_smaller_data_window_stands_in_its_display_window(tmp_path: Path) -> None:
    """The principal point is that of the display window; pixels that the file lacks are unknown."""
    pixels = np.random.default_rng(0).random((10, 20, 3))
    write_exr(tmp_path / "a.exr", pixels, ("R", "G", "B"), (7, 5), (64, 48))
    assert media.image_size(tmp_path / "a.exr") == (48, 64) and media.has_alpha(tmp_path / "a.exr")
    image, alpha = media.read_image_with_alpha(tmp_path / "a.exr")
    assert alpha is not None and float(alpha.sum()) == 200 and bool((alpha[0, 5:15, 7:27] == 1).all())
    assert np.allclose(image[:, 5:15, 7:27].permute(1, 2, 0).numpy(), pixels, atol=1e-6)
    write_exr(tmp_path / "b.exr", pixels, ("R", "G", "B"), (7, 5), (64, 48))
    photos = read_photos(tmp_path)
    assert photos[0].size == (48, 64) and float(photos[0].load_mask().sum()) == 200


def test_overscan_is_cut_to_the_display_window(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((56, 72, 3))
    write_exr(tmp_path / "a.exr", pixels, ("R", "G", "B"), (-4, -4), (64, 48))
    image, alpha = media.read_image_with_alpha(tmp_path / "a.exr")
    assert (
        alpha is None and not media.has_alpha(tmp_path / "a.exr") and media.image_size(tmp_path / "a.exr") == (48, 64)
    )
    assert np.allclose(image.permute(1, 2, 0).numpy(), pixels[4:52, 4:68], atol=1e-6)


def test_places_are_no_luminance_and_blenders_layers_have_colours(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((6, 8, 3))
    write_exr(tmp_path / "a.exr", pixels, ("X", "Y", "Z"), (0, 0), (8, 6))
    with pytest.raises(ValueError, match="read it with read_exr"):
        media.read_image(tmp_path / "a.exr")
    layers = np.concatenate([pixels, np.ones((6, 8, 1)), 1 - pixels], axis=2)
    names = tuple(f"ViewLayer.Combined.{name}" for name in "RGBA") + tuple(
        f"ViewLayer.Diffuse.{name}" for name in "RGB"
    )
    write_exr(tmp_path / "b.exr", layers, names, (0, 0), (8, 6))
    image, alpha = media.read_image_with_alpha(tmp_path / "b.exr")
    assert (
        np.allclose(image.permute(1, 2, 0).numpy(), pixels, atol=1e-6)
        and alpha is not None
        and bool((alpha == 1).all())
    )


def test_exr_pictures_of_a_capture_are_seen_as_a_folder_of_them_is(tiny_capture: Path, tmp_path: Path) -> None:
    """Linear light becomes sRGB in training, in complete and in export alike."""
    rgb = read_capture(tiny_capture).frames[0].load_image()

    def save(path: Path, pixels: np.ndarray) -> None:
        linear = (pixels / 255.0) ** 2.2
        write_exr(path, linear, ("R", "G", "B"), (0, 0), (pixels.shape[1], pixels.shape[0]))

    with_pictures(tiny_capture, ".exr", save)
    capture = validate_capture(tiny_capture, decode=True)
    assert torch.allclose(capture.frames[0].load_image(), rgb, atol=0.03)
    assert torch.allclose(trained(tiny_capture).movedim(-1, 0), capture.frames[0].load_image(), atol=0.5 / 255 + 1e-6)
    alone = read_photos(tiny_capture / "images")
    photo = next(one for one in alone if one.source == capture.frames[0].image_path)
    assert torch.equal(photo.load(), capture.frames[0].load_image())


# ---- TIFF ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("associated", [True, False])
def test_colours_of_tiff_files_are_not_multiplied_by_alpha(tmp_path: Path, associated: bool) -> None:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(8, 6, 4, "uint8")
    spec.channelnames, spec.alpha_channel = ("R", "G", "B", "A"), 3
    if not associated:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    pixels = np.full((6, 8, 4), (100, 60, 20, 128), np.uint8)
    pixels[0] = 0
    writer = oiio.ImageOutput.create(str(tmp_path / "a.tif"))
    assert writer.open(str(tmp_path / "a.tif"), spec) and writer.write_image(pixels) and writer.close()
    image, alpha = media.read_image_with_alpha(tmp_path / "a.tif")
    expected = np.array([100, 60, 20]) / (128 if associated else 255)
    assert alpha is not None and float(alpha[0, 1, 0]) == pytest.approx(128 / 255)
    assert np.allclose(image[:, 1:].mean(dim=(1, 2)).numpy(), expected, atol=1e-6) and not bool(image[:, 0].any())


@pytest.mark.parametrize("orientation", [3, 6])
def test_posed_tiff_files_stand_as_nerfstudio_reads_them(tiny_capture: Path, orientation: int) -> None:
    """Pillow, and with it nerfstudio, turns TIFF files upright and no others; with 180 degrees no size tells."""

    def save(path: Path, pixels: np.ndarray) -> None:
        exif = Image.Exif()
        exif[0x112] = orientation
        stored = np.rot90(pixels, {3: 2, 6: 1}[orientation])
        Image.fromarray(np.ascontiguousarray(stored)).save(path, exif=exif.tobytes())

    expected = read_capture(tiny_capture).frames[0].load_image()
    with_pictures(tiny_capture, ".tif", save)
    frame = validate_capture(tiny_capture, decode=True).frames[0]
    pillow = torch.from_numpy(np.array(Image.open(frame.image_path))).movedim(-1, 0) / 255
    assert torch.equal(frame.load_image(), pillow) and torch.allclose(pillow, expected, atol=1e-6)
    assert torch.equal(trained(tiny_capture).movedim(-1, 0), pillow)


# ---- HEIC ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["L", "I;16", "RGB", "RGBA"])
def test_heic_of_every_kind(tmp_path: Path, mode: str) -> None:
    heif = pytest.importorskip("pillow_heif", reason="the extra heic is not installed")
    grey = np.full((48, 64), 200, np.uint8)
    arrays = {
        "L": grey,
        "I;16": grey.astype(np.uint16) * 257,
        "RGB": np.dstack([grey] * 3),
        "RGBA": np.dstack([grey] * 4),
    }
    heif.register_heif_opener()
    Image.fromarray(arrays[mode]).save(tmp_path / "a.heic")
    check_grey(tmp_path / "a.heic", transparent=mode == "RGBA")


@pytest.mark.parametrize("kind", ["L", "I;16", "RGB", "RGBA"])
def test_what_heics_decoder_gives_is_read_whatever_its_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """The decoder's arrays have no axis of channels where they are grey, and 16 bits where the file has more than
    eight.
    """
    grey = np.full((48, 64), 200, np.uint8)
    array = {
        "L": grey,
        "I;16": grey.astype(np.uint16) * 257,
        "RGB": np.dstack([grey] * 3),
        "RGBA": np.dstack([grey] * 4),
    }[kind]

    class Decoded(SimpleNamespace):
        def __array__(self, dtype=None, copy=None) -> np.ndarray:
            return array

    (tmp_path / "a.heic").write_bytes(b"0" * 100)
    monkeypatch.setattr(picture_decoders, "opened_heif", lambda path: Decoded(size=(64, 48), mode=kind))
    check_grey(tmp_path / "a.heic", transparent=kind == "RGBA")


def check_grey(path: Path, *, transparent: bool) -> None:
    image, alpha = media.read_image_with_alpha(path)
    assert image.shape == (3, 48, 64) and torch.allclose(image, torch.tensor(200 / 255), atol=2 / 255)
    assert (alpha is not None) == transparent == media.has_alpha(path)


# ---- one that cannot be read -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error", [SyntaxError("broken"), KeyError("x"), TypeError("no"), RuntimeError("bad\nworse"), ZeroDivisionError()]
)
def test_one_unreadable_photo_is_named_whatever_its_reader_raises(
    tiny_capture: Path, monkeypatch: pytest.MonkeyPatch, caplog, error: Exception
) -> None:
    decode = media.decode

    def broken(path: Path):
        if path.name == "view_002.png":
            raise error
        return decode(path)

    monkeypatch.setattr(media, "decode", broken)
    for source in (tiny_capture / "images", tiny_capture):
        caplog.clear()
        assert len(read_photos(source)) == 5
        assert sum("view_002.png" in record.message for record in caplog.records) == 1
        assert "\n" not in caplog.records[-1].message
    with pytest.raises(ValueError, match=r"view_002\.png: not readable"):
        validate_capture(tiny_capture, decode=True)


def test_an_error_outside_of_the_decoders_is_named_too(
    tiny_capture: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    from fb_core.data.photos import collection as photos

    read = photos.read_exif

    def broken(path: Path, size):
        if path.name == "view_002.png":
            raise IndexError("of an EXIF block")
        return read(path, size)

    monkeypatch.setattr(photos, "read_exif", broken)
    assert len(read_photos(tiny_capture / "images")) == 5
    assert "view_002.png: not readable (IndexError: of an EXIF block)" in caplog.text
