"""Folders without a transforms.json that hold cameras all the same: COLMAP's models, Blender's splits, smaller pictures
alone.
"""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.colmap_files import POINTS, Camera, colmap_capture, poses_of, write_model
from helpers.folders.parsed import files_of, outputs
from PIL import Image

from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.capture.colmap.lenses import lens_of, projected
from fb_core.data.capture.colmap.reader import CAMERA_MODELS, ColmapCamera
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.own_files import own_points
from fb_core.data.capture.points import copy_points, read_points
from fb_core.data.capture.undistort import straight_directions
from fb_core.data.photos.collection import read_photos
from fb_core.geometry.cameras import Pinholes


def same_cameras(ours: Capture, theirs: Capture) -> None:
    place = {frame.image_path.name: frame for frame in theirs.frames}
    assert len(ours) == len(theirs)
    for frame in ours.frames:
        other = place[frame.image_path.name].camera
        assert torch.allclose(frame.camera.camera_to_world, other.camera_to_world, atol=1e-12)
        assert torch.equal(frame.camera.focal, other.focal) and torch.equal(frame.camera.principal, other.principal)
        assert (frame.camera.width, frame.camera.height) == (other.width, other.height)


# ---- COLMAP ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "sparse", "dense/sparse"])
@pytest.mark.parametrize("text", [True, False])
def test_a_colmap_model_is_the_capture_that_it_was_made_from(
    tiny_capture: Path, tmp_path: Path, place: str, text: bool
) -> None:
    theirs = read_capture(tiny_capture)
    folder = colmap_capture(tmp_path / "scene", theirs, text=text, place=place)
    before = files_of(folder)
    ours = validate_capture(folder, decode=True)
    same_cameras(ours, theirs)
    assert ours.points_path is not None
    points = read_points(ours.points_path)
    assert torch.allclose(points.positions, torch.tensor([point[:3] for point in POINTS], dtype=torch.float64))
    assert torch.allclose(points.colors * 255, torch.tensor([point[3:] for point in POINTS], dtype=torch.float64))
    parsed = outputs(folder, load_3D_points=True, eval_mode="all")
    expected = outputs(tiny_capture, eval_mode="all")
    assert torch.allclose(parsed.cameras.camera_to_worlds, expected.cameras.camera_to_worlds, atol=1e-6)
    assert parsed.metadata["points3D_rgb"].tolist() == [list(point[3:]) for point in POINTS]
    back = parsed.dataparser_transform.double()
    turned = (points.positions @ back[:, :3].T + back[:, 3]) * parsed.dataparser_scale
    assert torch.allclose(parsed.metadata["points3D_xyz"].double(), turned, atol=1e-5), (
        "the way back is COLMAP's own world"
    )
    photos = read_photos(folder)
    assert len(photos) == len(theirs) and all(photo.camera is not None for photo in photos)
    assert files_of(folder) == before, "the user's files are as they were"


def test_points_of_a_model_go_into_other_folders_as_a_ply_file(tiny_capture: Path, tmp_path: Path) -> None:
    """As complete and export copy them."""
    capture = read_capture(colmap_capture(tmp_path / "scene", read_capture(tiny_capture)))
    own = own_points(capture)
    assert own is not None and own == capture.points_path
    copy_points(own, tmp_path / "points3D.ply")
    there, here = read_points(tmp_path / "points3D.ply"), read_points(own)
    assert torch.allclose(there.positions, here.positions, atol=1e-6) and torch.allclose(
        there.colors, here.colors, atol=1e-6
    )


def test_a_model_is_read_from_its_own_folder_and_from_pictures_that_lie_beside_it(
    tiny_capture: Path, tmp_path: Path
) -> None:
    theirs = read_capture(tiny_capture)
    folder = colmap_capture(tmp_path / "scene", theirs)
    same_cameras(read_capture(folder / "sparse/0"), theirs)
    flat = tmp_path / "flat"
    shutil.copytree(folder / "images", flat)
    shutil.copytree(folder / "sparse", flat / "sparse")
    same_cameras(read_capture(flat), theirs)


def test_the_model_with_most_pictures_is_read(tiny_capture: Path, tmp_path: Path, caplog) -> None:
    theirs = read_capture(tiny_capture)
    folder = colmap_capture(tmp_path / "scene", theirs, place="sparse/1")
    names, poses = [frame.image_path.name for frame in theirs.frames[:2]], poses_of(theirs)[:2]
    write_model(folder / "sparse/0", names, poses, [("SIMPLE_PINHOLE", 48, 32, (40.0, 24.0, 16.0))], [0, 0], text=False)
    assert len(read_capture(folder)) == len(theirs)
    assert "2 COLMAP models" in caplog.text and "sparse/1 is read" in caplog.text


def test_rigs_have_pictures_of_one_name_in_folders_of_their_own(tiny_capture: Path, tmp_path: Path) -> None:
    """COLMAP 3.12 and later write rigs.bin and frames.bin beside the model; the pictures' own poses are whole without
    them.
    """
    theirs = read_capture(tiny_capture)
    folder = tmp_path / "scene"
    names = [f"cam{index % 2}/{index // 2:04d}.png" for index in range(len(theirs))]
    for name, frame in zip(names, theirs.frames, strict=True):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(frame.image_path, folder / "images" / name)
    cameras: list[Camera] = [
        ("SIMPLE_PINHOLE", 48, 32, (40.0, 24.0, 16.0)),
        ("PINHOLE", 48, 32, (41.0, 42.0, 24.0, 16.0)),
    ]
    write_model(
        folder / "sparse/0", names, poses_of(theirs), cameras, [index % 2 for index in range(len(names))], text=False
    )
    for name in ("rigs.bin", "frames.bin"):
        (folder / "sparse/0" / name).write_bytes(struct.pack("<Q", 0))
    capture = validate_capture(folder)
    assert [str(frame.image_path.relative_to(folder / "images")) for frame in capture.frames] == sorted(names)
    assert [float(frame.camera.focal[0, 1]) for frame in capture.frames] == [40.0] * 3 + [42.0] * 3
    for name in names:
        copy = folder / "images_2" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        Image.open(folder / "images" / name).resize((24, 16)).save(copy)
    parsed = outputs(folder, downscale_factor=2, eval_mode="all")
    assert len(set(parsed.image_filenames)) == len(names), "copies of rigs lie in folders, too"
    assert int(parsed.cameras.width[0]) == 24


def test_names_with_blanks_and_pictures_that_are_gone(tiny_capture: Path, tmp_path: Path, caplog) -> None:
    theirs = read_capture(tiny_capture)
    folder = tmp_path / "scene"
    (folder / "images").mkdir(parents=True)
    names = [f"my photo {index}.png" for index in range(len(theirs))]
    for name, frame in list(zip(names, theirs.frames, strict=True))[1:]:
        shutil.copy(frame.image_path, folder / "images" / name)
    write_model(
        folder / "sparse/0",
        names,
        poses_of(theirs),
        [("PINHOLE", 48, 32, (40.0, 41.0, 24.0, 16.0))],
        [0] * 6,
        text=True,
    )
    assert len(validate_capture(folder)) == 5
    assert "1 of 6 pictures are missing, such as my photo 0.png" in caplog.text


def test_pictures_made_smaller_after_colmap_keep_their_cameras(tiny_capture: Path, tmp_path: Path) -> None:
    folder = colmap_capture(tmp_path / "scene", read_capture(tiny_capture))
    for path in (folder / "images").iterdir():
        Image.open(path).resize((24, 16)).save(path)
    camera = validate_capture(folder).frames[0].camera
    full = read_capture(tiny_capture).frames[0].camera
    assert torch.equal(camera.focal, full.focal / 2) and torch.equal(camera.principal, full.principal / 2)


def test_masks_of_colmap_and_of_nerfstudio(tiny_capture: Path, tmp_path: Path) -> None:
    theirs = read_capture(tiny_capture)
    for style in ("{name}.png", "{name}"):
        folder = colmap_capture(tmp_path / style.strip("{}").replace(".", "_").replace("}", ""), theirs)
        (folder / "masks").mkdir()
        for frame in theirs.frames:
            assert frame.mask_path is not None
            shutil.copy(frame.mask_path, folder / "masks" / style.format(name=frame.image_path.name))
        assert all(
            torch.equal(a.load_mask(), b.load_mask())
            for a, b in zip(validate_capture(folder).frames, theirs.frames, strict=True)
        )


def test_what_export_wrote_for_colmap_is_read_back_with_its_splits_and_what_is_generated(
    tiny_capture: Path, tmp_path: Path
) -> None:
    folder = colmap_capture(tmp_path / "scene", read_capture(tiny_capture))
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "train_list.txt").write_text("".join(f"{name}\n" for name in names[:4]))
    for split in ("val", "test"):
        (folder / f"{split}_list.txt").write_text("".join(f"{name}\n" for name in names[4:]))
    (folder / "frames.json").write_text(json.dumps({name: {"generated": name == names[0]} for name in names}))
    assert [path.name for path in outputs(folder).image_filenames] == names[1:4]
    assert [path.name for path in outputs(folder, "val").image_filenames] == names[4:]


# Parameters, and where COLMAP 4.2.1 itself (pycolmap's Camera.img_from_cam) sees three points.
LENSES: dict[str, tuple[list[float], list[list[float]]]] = {
    "SIMPLE_PINHOLE": ([300, 160, 120], [[250.0, 180.0], [40.0, 195.0], [175.0, 30.0]]),
    "PINHOLE": ([300, 310, 160, 120], [[250.0, 182.0], [40.0, 197.5], [175.0, 27.0]]),
    "SIMPLE_RADIAL": ([300, 160, 120, -0.1], [[248.83, 179.22], [42.67, 193.33125], [174.86125, 30.8325]]),
    "RADIAL": ([300, 160, 120, -0.1, 0.02], [[248.86042, 179.24028], [42.551185, 193.405509], [174.863817, 30.817099]]),
    "OPENCV": (
        [300, 310, 160, 120, -0.1, 0.02, 0.001, -0.002],
        [[248.71042, 181.205656], [42.165685, 196.084085], [174.796317, 27.94741]],
    ),
    "OPENCV_FISHEYE": (
        [200, 205, 160, 120, 0.02, -0.003, 0.001, -0.0002],
        [[217.721225, 159.442837], [84.966184, 168.068538], [169.724434, 60.194731]],
    ),
    "FULL_OPENCV": (
        [300, 310, 160, 120, -0.1, 0.02, 0.001, -0.002, 0.01, 0.03, 0.01, 0.002],
        [[248.351894, 180.958672], [42.991232, 195.550919], [174.754014, 28.209687]],
    ),
    "FOV": ([300, 310, 160, 120, 0.9], [[252.965426, 184.042849], [39.13342, 198.059666], [175.66106, 22.901428]]),
    "SIMPLE_RADIAL_FISHEYE": (
        [200, 160, 120, 0.02],
        [[217.723606, 158.482404], [84.958248, 166.901095], [169.724649, 61.652106]],
    ),
    "RADIAL_FISHEYE": (
        [200, 160, 120, 0.02, -0.003],
        [[217.721129, 158.480753], [84.966711, 166.895806], [169.724428, 61.653434]],
    ),
    "THIN_PRISM_FISHEYE": (
        [200, 205, 160, 120, 0.02, -0.003, 0.001, -0.002, 0.001, -0.0002, 0.001, 0.0005],
        [[217.653061, 159.449447], [84.780653, 168.22224], [169.69946, 60.267902]],
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [
            200,
            205,
            160,
            120,
            0.02,
            -0.003,
            0.001,
            -0.0002,
            0.0001,
            0.00005,
            0.001,
            -0.002,
            0.001,
            0.0005,
            0.0002,
            0.0001,
        ],
        [[217.759692, 159.39115], [85.174983, 167.915947], [169.772481, 60.087006]],
    ),
    "SIMPLE_DIVISION": (
        [300, 160, 120, -0.1],
        [[248.859466, 179.239644], [42.557408, 193.40162], [174.863759, 30.817446]],
    ),
    "DIVISION": (
        [300, 310, 160, 120, -0.1],
        [[248.859466, 181.214299], [42.557408, 195.848341], [174.863759, 27.844694]],
    ),
    "SIMPLE_FISHEYE": ([200, 160, 120], [[217.58569, 158.39046], [85.248675, 166.719578], [169.707724, 61.753655]]),
    "FISHEYE": ([200, 205, 160, 120], [[217.58569, 159.350222], [85.248675, 167.887568], [169.707724, 60.297496]]),
    "EUCM": (
        [300, 310, 160, 120, 0.6, 1.1],
        [[246.416559, 179.531407], [47.788613, 192.469854], [174.566138, 29.689946]],
    ),
    "EQUIRECTANGULAR": ([320, 240], []),
}
SEEN = np.array([[0.3, 0.2, 1.0], [-0.4, 0.25, 1.0], [0.05, -0.3, 1.0]])
REFUSED = ("THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "EQUIRECTANGULAR")  # with these coefficients


def test_every_model_that_colmap_writes_today_is_known() -> None:
    assert tuple(sorted(LENSES)) == tuple(sorted(CAMERA_MODELS))


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_sees_what_colmap_sees_or_is_refused(model: str) -> None:
    """By our own undistortion, from COLMAP's pixels back to the points: within a fifth of a pixel of the angle."""
    params, pixels = LENSES[model]
    camera = ColmapCamera(model=model, width=320, height=240, params=tuple(map(float, params)))
    if pixels and model in (
        "FULL_OPENCV",
        "FOV",
        "THIN_PRISM_FISHEYE",
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "DIVISION",
        "EUCM",
    ):
        assert np.allclose(projected(camera, SEEN), pixels, atol=1e-5)
    if model in REFUSED:
        with pytest.raises(ValueError, match=r"image_undistorter|cut its pictures into perspective views"):
            lens_of(camera, "here")
        return
    lens = lens_of(camera, "here")
    pinhole = Pinholes(
        camera_to_world=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.tensor([lens.focal], dtype=torch.float64),
        principal=torch.tensor([lens.principal], dtype=torch.float64),
        width=320,
        height=240,
    )
    directions = straight_directions(
        torch.tensor(pixels, dtype=torch.float64), pinhole, lens.camera_model, lens.distortion
    ).numpy()
    expected = SEEN / np.linalg.norm(SEEN, axis=1, keepdims=True)
    assert np.abs(directions - expected).max() < 0.2 / 200


@pytest.mark.parametrize("model", ["THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_a_fisheye_whose_prism_is_next_to_nothing_is_a_fisheye(model: str) -> None:
    params = [200.0, 205.0, 160.0, 120.0, 0.02, -0.003, *([0.0] * (6 if model.startswith("THIN") else 10))]
    lens = lens_of(ColmapCamera(model=model, width=320, height=240, params=tuple(params)), "here")
    assert lens.camera_model == "OPENCV_FISHEYE" and lens.focal == pytest.approx((200, 205), rel=1e-6)
    assert lens.distortion["k1"] == pytest.approx(0.02, abs=1e-6) and lens.distortion["k2"] == pytest.approx(
        -0.003, abs=1e-6
    )


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


NEWER = struct.pack("<QiiQQ", 1, 1, 99, 48, 32)
DAMAGE = {
    "cut short": (lambda folder: cut(folder / "images.bin"), "ends too early|promises"),
    "too many": (lambda folder: (folder / "cameras.bin").write_bytes(struct.pack("<Q", 2**60)), "promises"),
    "a newer model": (lambda folder: (folder / "cameras.bin").write_bytes(NEWER), "number 99 is not known"),
    "no camera": (lambda folder: (folder / "cameras.bin").write_bytes(struct.pack("<Q", 0)), "which the model lacks"),
    "no pictures": (lambda folder: (folder / "images.bin").write_bytes(struct.pack("<Q", 0)), "at least one image"),
    "points cut short": (
        lambda folder: (folder / "points3D.bin").write_bytes(struct.pack("<QQ", 1, 1)),
        "ends too early|promises",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_models_are_one_sentence(tiny_capture: Path, tmp_path: Path, name: str) -> None:
    folder = colmap_capture(tmp_path / "scene", read_capture(tiny_capture))
    change, said = DAMAGE[name]
    change(folder / "sparse/0")
    with pytest.raises(ValueError, match=said) as found:
        validate_capture(folder)
        outputs(folder, load_3D_points=True)
    assert "\n" not in str(found.value)


def test_text_of_another_kind_and_a_model_without_its_pictures_are_one_sentence(
    tiny_capture: Path, tmp_path: Path
) -> None:
    folder = colmap_capture(tmp_path / "scene", read_capture(tiny_capture), text=True)
    shutil.rmtree(folder / "images")
    with pytest.raises(ValueError, match="put the model's folder sparse beside images"):
        read_capture(folder)
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 48\n")
    with pytest.raises(ValueError, match="not a line of COLMAP's text format"):
        read_capture(folder)
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 48 32 nan 1 2 3\n")
    with pytest.raises(ValueError, match="4 finite numbers"):
        read_capture(folder)


def test_what_pycolmap_writes(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, camera_width=64, camera_height=48
    )
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write(str(tmp_path / "sparse/0"))
    (tmp_path / "images").mkdir()
    for image in model.images.values():
        Image.new("RGB", (64, 48)).save(tmp_path / "images" / image.name)
    capture = read_capture(tmp_path)
    centers = {image.name: torch.from_numpy(image.projection_center()) for image in model.images.values()}
    assert len(capture) == 6
    assert all(torch.allclose(frame.camera.centers[0], centers[frame.image_path.name]) for frame in capture.frames)
