"""Datasets of the field and exports of other tools, made small in their own layouts: read as they are meant, or told
what they are.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.folders.colmap_files import Camera, colmap_capture, poses_of, write_model
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from fb_core.data.capture.camera_path import read_camera_path
from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.layouts import layouts_below
from fb_core.evaluation.capture_questions import capture_folders
from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d


def outputs(folder: Path, split: str = "train", **options):
    return NerfstudioWithoutOpen3d(NerfstudioDataParserConfig(data=folder, **options)).get_dataparser_outputs(split)


def edited(folder: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    meta = json.loads((folder / "transforms.json").read_text())
    change(meta)
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def scannetpp(folder: Path, capture: Capture) -> Path:
    """SCENE/dslr with resized_images, resized_anon_masks, nerfstudio/transforms.json (frames and test_frames), and
    colmap/ as text.
    """
    dslr = folder / "dslr"
    meta = json.loads((capture.root / "transforms.json").read_text())
    for kind, place in (("images", "resized_images"), ("masks", "resized_anon_masks")):
        shutil.copytree(capture.root / kind, dslr / place)
    for entry in meta["frames"]:
        entry["file_path"] = Path(entry["file_path"]).name
        entry["mask_path"] = Path(entry["mask_path"]).name
        entry["is_bad"] = entry["file_path"] == "view_001.png"
    meta["test_frames"] = meta["frames"][4:]
    meta["frames"] = meta["frames"][:4]
    meta.pop("ply_file_path", None)
    (dslr / "nerfstudio").mkdir(parents=True)
    (dslr / "nerfstudio/transforms.json").write_text(json.dumps(meta))
    names = [frame.image_path.name for frame in capture.frames]
    lens: Camera = ("OPENCV_FISHEYE", 48, 32, (40.0, 40.0, 24.0, 16.0, 0.01, 0.0, 0.0, 0.0))
    write_model(dslr / "colmap", names, poses_of(capture), [lens], [0] * len(names), text=True)
    return folder


def test_scannetpp_scenes_are_read_from_any_of_their_folders(tiny_capture: Path, tmp_path: Path) -> None:
    theirs = read_capture(tiny_capture)
    scene = scannetpp(tmp_path / "data/0a7cc12c0e", theirs)
    for folder in (scene, scene / "dslr", scene / "dslr/nerfstudio"):
        capture = validate_capture(folder, decode=True)
        assert len(capture) == 6 and torch.equal(capture.poses, theirs.poses)
        assert len(outputs(folder).image_filenames) == 3, "one of the four is bad"
        assert [path.name for path in outputs(folder, "test").image_filenames] == ["view_004.png", "view_005.png"]
        assert torch.equal(capture.frames[1].load_mask(), theirs.frames[1].load_mask())
    assert [str(path.relative_to(tmp_path)) for path in layouts_below(tmp_path / "data")] == [
        "data/0a7cc12c0e/dslr/nerfstudio"
    ]


def test_nerfillers_scenes_have_their_masks_in_alpha_and_camera_paths_beside(tiny_capture: Path) -> None:
    for frame in read_capture(tiny_capture).frames:
        pixels = np.array(Image.open(frame.image_path).convert("RGB"))
        alpha = (
            np.array(Image.open(frame.mask_path).convert("L"))
            if frame.mask_path
            else np.full(pixels.shape[:2], 255, np.uint8)
        )
        Image.fromarray(np.dstack([pixels, alpha])).save(frame.image_path)
    known = [frame.load_mask() for frame in read_capture(tiny_capture).frames]
    edited(tiny_capture, lambda meta: [frame.pop("mask_path") for frame in meta["frames"]])
    shutil.rmtree(tiny_capture / "masks")
    capture = validate_capture(tiny_capture, decode=True)
    assert all(torch.equal(frame.load_mask(), mask) for frame, mask in zip(capture.frames, known, strict=True))
    assert any(bool((mask < 1).any()) for mask in known)
    pose = torch.eye(4).reshape(-1).tolist()
    path = {
        "camera_type": "perspective",
        "render_height": 32,
        "render_width": 48,
        "seconds": 2,
        "fps": 1,
        "is_cycle": False,
    }
    path["camera_path"] = [{"camera_to_world": pose, "fov": 60.0, "aspect": 1.5}] * 3
    (tiny_capture / "camera_path.json").write_text(json.dumps(path))
    assert len(read_camera_path(tiny_capture / "camera_path.json", size=64).cameras) == 3


def test_nerfbusters_two_films_are_split_by_their_names(tiny_capture: Path) -> None:
    """ns-process-data of two films: frame_train_..., frame_eval_..."""

    def change(meta: dict[str, Any]) -> None:
        for split in ("train", "val", "test"):
            meta.pop(f"{split}_filenames", None)
        for index, frame in enumerate(meta["frames"]):
            name = f"images/frame_{'eval' if index >= 4 else 'train'}_{index:05d}.png"
            (tiny_capture / frame["file_path"]).rename(tiny_capture / name)
            frame["file_path"] = name

    edited(tiny_capture, change)
    validate_capture(tiny_capture)
    assert len(outputs(tiny_capture, eval_mode="filename").image_filenames) == 4
    assert len(outputs(tiny_capture, "val", eval_mode="filename").image_filenames) == 2


def test_mip_nerf_360_is_colmap_with_smaller_copies(tiny_capture: Path, tmp_path: Path) -> None:
    folder = colmap_capture(tmp_path / "garden", read_capture(tiny_capture))
    (folder / "poses_bounds.npy").write_bytes(b"\x93NUMPY")
    for factor in (2, 4):
        (folder / f"images_{factor}").mkdir()
        for path in (folder / "images").iterdir():
            Image.open(path).resize((48 // factor, 32 // factor)).save(folder / f"images_{factor}" / path.name)
    validate_capture(folder)
    for factor in (1, 2, 4):
        parsed = outputs(folder, downscale_factor=factor)
        assert int(parsed.cameras.width[0]) == 48 // factor
        assert Image.open(parsed.image_filenames[0]).width == 48 // factor


# ---- twenty more inputs of other tools -------------------------------------------------------------------------------

READ: dict[str, Callable[[dict[str, Any]], Any]] = {
    "instant-ngp colmap2nerf": lambda meta: meta.update(
        aabb_scale=16, scale=0.33, offset=[0.5, 0.5, 0.5], camera_angle_x=0.9
    ),
    "NeRFCapture": lambda meta: [
        frame.update(timestamp=1.5, depth_path="images/0.depth.png") for frame in meta["frames"]
    ],
    "Spectacular AI": lambda meta: [
        frame.update(
            camera_linear_velocity=[0.1, 0, 0],
            camera_angular_velocity=[0, 0, 0],
            motion_blur_score=1.2,
            colmap_im_id=index,
        )
        for index, frame in enumerate(meta["frames"])
    ],
    "Polycam by ns-process-data": lambda meta: [
        frame.update(depth_file_path=frame["file_path"]) for frame in meta["frames"]
    ],
    "Record3D by ns-process-data": lambda meta: meta.update(camera_model="OPENCV", orientation_override="none"),
    "KIRI Engine": lambda meta: [frame.update(file_path=f"./{frame['file_path']}") for frame in meta["frames"]],
    "Luma": lambda meta: meta.update(camera_model="PINHOLE", aabb=[[-1, -1, -1], [1, 1, 1]]),
    "BlenderNeRF": lambda meta: meta.update(camera_angle_y=0.6, offset=[0, 0, 0], scale=1, aabb_scale=4),
}


@pytest.mark.parametrize("tool", READ)
def test_what_other_tools_write_into_transforms_json(tiny_capture: Path, tool: str) -> None:
    theirs = read_capture(tiny_capture)
    ours = validate_capture(edited(tiny_capture, READ[tool]))
    assert torch.equal(ours.poses, theirs.poses) and torch.equal(ours.cameras.focal, theirs.cameras.focal)
    assert len(outputs(tiny_capture, eval_mode="all").image_filenames) == 6 or "train_filenames" in ours.extra


def test_text_models_without_lines_of_features(tiny_capture: Path, tmp_path: Path) -> None:
    """RealityCapture, RealityScan and Metashape export COLMAP's text without features, with empty lines or with
    none.
    """
    theirs = read_capture(tiny_capture)
    folder = colmap_capture(tmp_path / "scene", theirs, text=True)
    lines = (folder / "sparse/0/images.txt").read_text().splitlines()
    pictures = [line for line in lines if line.endswith(".png")]
    for text in (
        "\n\n".join(pictures) + "\n\n",
        "\n".join(pictures) + "\n",
        "\r\n".join(f"{line}\r\n1.5 2.5 -1" for line in pictures),
    ):
        (folder / "sparse/0/images.txt").write_bytes(text.encode())
        assert torch.allclose(read_capture(folder).poses, theirs.poses, atol=1e-12)


def test_labels_of_metashape_have_no_suffix(tiny_capture: Path, tmp_path: Path) -> None:
    theirs = read_capture(tiny_capture)
    folder = colmap_capture(tmp_path / "scene", theirs)
    names = [frame.image_path.stem for frame in theirs.frames]
    write_model(
        folder / "sparse/0",
        names,
        poses_of(theirs),
        [("PINHOLE", 48, 32, (40.0, 41.0, 24.0, 16.0))],
        [0] * 6,
        text=True,
    )
    assert [frame.image_path.name for frame in validate_capture(folder).frames] == [f"{name}.png" for name in names]


REFUSED = {
    "keyframes/cameras/1.json": "Polycam's raw data, which is not read; run ns-process-data polycam",
    "EXR_RGBD/metadata": "Record3D's data, which is not read; run ns-process-data record3d",
    "scan.r3d": "a Record3D recording",
    "poses_bounds.npy": "an LLFF capture without its COLMAP model",
    "opensfm/reconstruction.json": "an OpenDroneMap project, which is not read; run ns-process-data odm",
    "sfm_data.json": "an OpenMVG project",
    "project.psx": "a Metashape project, which is not read; export the cameras as a COLMAP text model",
    "scene.rcproj": "a RealityCapture project",
    "cfg_args": "a trained model of 3D Gaussian splatting",
    "lowres_wide.traj": "an ARKitScenes scan, which is not read; use ns-train's arkit-data subcommand",
    "database.db": "a COLMAP project without a sparse model",
    "dataset.json": "a Nerfies or HyperNeRF capture",
}


@pytest.mark.parametrize("file", REFUSED)
def test_folders_of_tools_that_are_not_read_are_named_with_what_to_do(tmp_path: Path, file: str) -> None:
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    with pytest.raises(ValueError, match=f"this is {REFUSED[file]}") as found:
        read_capture(tmp_path)
    assert "\n" not in str(found.value)
    with pytest.raises(ValueError, match="expected captures"):
        capture_folders(tmp_path)


def test_times_of_moving_scenes_are_told(tiny_capture: Path, tmp_path: Path, caplog) -> None:
    """D-NeRF: Blender's layout with a time in every frame."""
    meta = json.loads((tiny_capture / "transforms.json").read_text())
    for index, frame in enumerate(meta["frames"]):
        frame["time"] = index / 5
    (tiny_capture / "transforms.json").unlink()
    (tiny_capture / "transforms_train.json").write_text(json.dumps(meta))
    assert len(validate_capture(tiny_capture)) == 6
    assert "6 different times; what moves in them is taken as standing still" in caplog.text
