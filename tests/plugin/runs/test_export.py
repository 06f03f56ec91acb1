"""``fillerbuster export``: what is written is read by nerfstudio's own readers, poses survive, and a full disk leaves
nothing behind.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.runs import GENERATED, changed, export, generated_views, make_run
from helpers.plugin.exports import run_world, split_lists
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as colmap

from fb_core.data import media
from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.capture.colmap.model import ColmapImage, write_colmap
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import read_points
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import quaternions_of, rotations_of
from fb_core.geometry.similarity import Similarity, nearest_rotations


def turned(*angles: float) -> torch.Tensor:
    """A rotation by Euler angles in radians, float64."""
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(angle), math.sin(angle)) for angle in angles)
    x = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=torch.float64)
    y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=torch.float64)
    z = torch.tensor([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]], dtype=torch.float64)
    return z @ y @ x


@pytest.fixture
def run(tiny_capture: Path, tmp_path: Path) -> Path:
    """A run on six views, of which the last is held out."""
    changed(tiny_capture, lambda meta: meta.update(split_lists(meta)))
    return make_run(tmp_path / "run", tiny_capture, generated_views())


# ---- nerfstudio's format ---------------------------------------------------------------------------------------------


def test_captured_pictures_and_poses_are_those_of_the_capture_bit_for_bit(run: Path, tiny_capture: Path):
    before, after = read_capture(tiny_capture), validate_capture(export(run, "nerfstudio"), decode=True)
    captured = [frame for frame in after.frames if not frame.extra["generated"]]
    assert len(captured) == len(before) == 6
    for old, new in zip(before.frames, captured, strict=True):
        assert new.image_path.read_bytes() == old.image_path.read_bytes() and new.image_path.name == old.image_path.name
        assert torch.equal(new.camera.camera_to_world, old.camera.camera_to_world)
        assert torch.equal(new.camera.focal, old.camera.focal) and torch.equal(
            new.camera.principal, old.camera.principal
        )
        assert torch.equal(new.load_mask(), old.load_mask())


def test_generated_views_say_how_they_came_to_be(run: Path):
    views, after = generated_views(), read_capture(export(run, "nerfstudio"))
    frames = [frame for frame in after.frames if frame.extra["generated"]]
    assert len(frames) == GENERATED
    for index, (frame, origin) in enumerate(zip(frames, views.origins, strict=True)):
        assert frame.extra == {"generated": True, **dataclasses.asdict(origin)}
        assert torch.equal((frame.load_image() * 255).round().to(torch.uint8), views.images[index].movedim(-1, 0))
        assert torch.equal(frame.load_mask() > 0, views.masks[index].movedim(-1, 0))


def test_generated_poses_come_back_to_the_runs_world(run: Path):
    world, _ = run_world(run)
    frames = [frame for frame in read_capture(export(run, "nerfstudio")).frames if frame.extra["generated"]]
    back = world.cameras(Pinholes.cat([frame.camera for frame in frames]))
    bank = generated_views().cameras
    assert float((back.camera_to_world - bank.camera_to_world.double()).abs().max()) < 1e-6
    assert torch.equal(back.focal.float(), bank.focal) and torch.equal(back.principal.float(), bank.principal)


def test_nerfstudios_own_reader_takes_it(run: Path):
    folder = export(run, "nerfstudio")
    plain = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    reader = NerfstudioDataParserConfig(data=folder, **plain).setup()
    assert type(reader) is Nerfstudio
    train, held_out = reader.get_dataparser_outputs("train"), reader.get_dataparser_outputs("val")
    names = {frame.image_path.name: frame for frame in read_capture(folder).frames}
    assert len(train.image_filenames) + len(held_out.image_filenames) == 6 + GENERATED
    assert (
        {path.name for path in held_out.image_filenames}
        == {name for name, frame in names.items() if frame.extra.get("held_out")}
        != set()
    )
    assert sum(path.name.startswith("generated_") for path in train.image_filenames) == GENERATED
    for index, path in enumerate(train.image_filenames):
        pose = names[path.name].camera.camera_to_world[0] * torch.tensor([1.0, -1, -1, 1])
        assert float((train.cameras.camera_to_worlds[index].double() - pose).abs().max()) < 1e-6
        assert (int(train.cameras.width[index]), int(train.cameras.height[index])) == media.image_size(path)[::-1]
    assert train.mask_filenames is not None and all(path.is_file() for path in train.mask_filenames)
    points, own = read_points(folder / "points3D.ply"), read_capture(folder).points_path
    assert own == folder / "points3D.ply" and len(points) == 50


def test_the_datamanager_of_stock_splatfacto_serves_it(run: Path):
    config = FullImageDatamanagerConfig(
        data=export(run, "nerfstudio"), dataparser=NerfstudioDataParserConfig(load_3D_points=False)
    )
    manager: FullImageDatamanager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    sizes = [manager.next_train(step)[1]["image"].shape[:2] for step in range(len(manager.train_dataset))]
    assert sorted({tuple(size) for size in sizes}) == [(16, 16), (32, 48)]
    assert all("mask" in data for data in manager.cached_train)


# ---- COLMAP's format -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["text", "binary"])
def test_nerfstudios_colmap_reader_gives_the_same_cameras_images_and_points(run: Path, tiny_capture: Path, suffix: str):
    folder = export(run, "colmap")
    end, model = {"text": ".txt", "binary": ".bin"}[suffix], folder / "sparse" / "0"
    cameras, images, points = (
        getattr(colmap, f"read_{kind}_{suffix}")(str(model / f"{kind}{end}"))
        for kind in ("cameras", "images", "points3D")
    )
    other = {frame.image_path.name: frame for frame in read_capture(export(run, "nerfstudio")).frames}
    assert len(images) == 6 + GENERATED and {image.name for image in images.values()} == set(other)
    assert len(cameras) == 2  # one lens of the capture, one of the generated views
    for image in images.values():
        camera, frame = cameras[image.camera_id], other[image.name]
        assert camera.model == "PINHOLE" and (camera.width, camera.height) == (frame.camera.width, frame.camera.height)
        assert camera.params.tolist() == [*frame.camera.focal[0].tolist(), *frame.camera.principal[0].tolist()]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = image.qvec2rotmat(), image.tvec
        back = torch.from_numpy(np.linalg.inv(pose)[:3])
        assert float((back - frame.camera.camera_to_world[0]).abs().max()) < 1e-9
    original = read_points(tiny_capture / "points3D.ply")
    assert np.allclose(np.stack([points[index + 1].xyz for index in range(50)]), original.positions.numpy(), atol=0)
    assert np.array_equal(
        np.stack([points[index + 1].rgb for index in range(50)]), (original.colors * 255).round().numpy()
    )


def test_a_point_falls_on_the_pixel_that_colmap_says(run: Path):
    """COLMAP's and our pixel (0.5, 0.5) is the centre of the first one; no half pixel is lost on the way."""
    folder = export(run, "colmap") / "sparse" / "0"
    cameras, images = colmap.read_cameras_text(folder / "cameras.txt"), colmap.read_images_text(folder / "images.txt")
    frames = {frame.image_path.name: frame.camera for frame in read_capture(export(run, "nerfstudio")).frames}
    for image in images.values():
        camera = frames[image.name]
        corner = camera.unproject(torch.ones(1, camera.height, camera.width, dtype=torch.float64))[0, 0, 0]
        x, y, z = image.qvec2rotmat() @ corner.numpy() + image.tvec
        fx, fy, cx, cy = cameras[image.camera_id].params
        assert (fx * x / z + cx, fy * y / z + cy) == pytest.approx((0.5, 0.5), abs=1e-9)


def test_nerfstudios_colmap_dataparser_takes_masks_and_splits(run: Path):
    folder = export(run, "colmap")
    config = ColmapDataParserConfig(
        data=folder, colmap_path=Path("sparse/0"), masks_path=Path("masks"), downscale_factor=1, load_3D_points=True
    )
    train, held_out = (config.setup().get_dataparser_outputs(split) for split in ("train", "val"))
    assert len(train.image_filenames) == 5 + GENERATED and len(held_out.image_filenames) == 1
    assert train.mask_filenames is not None and all(
        path.is_file() for path in [*train.image_filenames, *train.mask_filenames]
    )
    assert train.metadata["points3D_xyz"].shape == (50, 3)
    told = json.loads((folder / "frames.json").read_text())
    assert set(told) == {path.name for path in (folder / "images").iterdir()}
    one = told["generated_densify_01_0002.png"]
    assert (one["generated"], one["seed"], one["model_hash"], one["role"], one["round"]) == (
        True,
        2**62 + 1,
        "ab" * 8,
        "densify",
        1,
    )


@given(angles=st.tuples(*[st.floats(-math.pi, math.pi)] * 3))
def test_quaternions_are_unit_and_undo_rotations(angles):
    rotation = turned(*angles)[None]
    quaternion = quaternions_of(rotation)
    assert float(quaternion.norm()) == pytest.approx(1, abs=1e-12) and float(quaternion[0, 0]) >= 0
    assert float((rotations_of(quaternion) - rotation).abs().max()) < 1e-12
    assert np.allclose(colmap.qvec2rotmat(quaternion[0].numpy()), rotation[0].numpy(), atol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, -1, 1e-9)])
def test_half_turns_keep_their_axis(axis):
    unit = torch.nn.functional.normalize(torch.tensor([axis], dtype=torch.float64), dim=1)
    rotation = 2 * unit[:, :, None] * unit[:, None, :] - torch.eye(3, dtype=torch.float64)
    assert float((rotations_of(quaternions_of(rotation)) - rotation).abs().max()) < 1e-12


def test_names_with_blanks_are_refused_by_the_text_format(tmp_path: Path):
    cameras = generated_views().cameras
    empty = Points(positions=torch.zeros(0, 3), colors=torch.zeros(0, 3))
    for name in ("a b.png", "", "a\tb"):
        with pytest.raises(ValueError, match="without blanks"):
            write_colmap(tmp_path, [ColmapImage(name=name, camera=cameras[0])], empty)


# ---- similarities ----------------------------------------------------------------------------------------------------


@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3), scale=st.floats(0.01, 100), shift=st.tuples(*[st.floats(-10, 10)] * 3)
)
def test_a_similarity_is_found_from_cameras_and_undone_by_its_inverse(angles, scale, shift):
    world = Similarity(rotation=turned(*angles), scale=scale, shift=torch.tensor(shift, dtype=torch.float64))
    cameras = generated_views().cameras
    exact = dataclasses.replace(
        cameras.to(torch.float64),
        camera_to_world=torch.cat(
            [nearest_rotations(cameras.rotations.double()), cameras.centers.double()[:, :, None]], dim=2
        ),
    )
    there = world.cameras(exact)
    found = Similarity.between((exact.rotations, exact.centers), (there.rotations, there.centers))
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert torch.allclose(found.rotation, world.rotation, atol=1e-9) and torch.allclose(
        found.shift, world.shift, atol=1e-8 * (1 + scale)
    )
    assert torch.allclose(world.inverse.cameras(there).camera_to_world, exact.camera_to_world, atol=1e-9)
    points = torch.randn(5, 3, dtype=torch.float64)
    assert torch.allclose(exact.project(points)[0], there.project(world.points(points))[0], rtol=1e-6, atol=1e-6)


def test_cameras_in_one_place_tell_a_rotation_and_no_scale():
    rotations = torch.stack([turned(0.1 * i, 0.2, 0) for i in range(3)])
    world = Similarity(rotation=turned(1, 2, 3), scale=2.0, shift=torch.tensor([1.0, 2, 3], dtype=torch.float64))
    centers = torch.full((3, 3), 0.7, dtype=torch.float64)
    found = Similarity.between(
        (rotations, centers), (world.rotation @ rotations, world.points(centers)), scale_of_one_place=2.0
    )
    assert torch.allclose(found.points(centers), world.points(centers)) and torch.allclose(
        found.rotation, world.rotation
    )
