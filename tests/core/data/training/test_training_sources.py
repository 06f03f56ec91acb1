"""Sources of training data: meshes, captures, captioned shards, and mixtures of them; each row a function of (seed,
step, row).
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
import shutil

import pytest
import torch
from helpers.folders.training_sources import TASK, assert_same, cube_and_no_mesh, draws

from fb_core.data.capture.captures import read_capture
from fb_core.data.meshes.mesh_pictures import Lighting, draw_with_caster, draw_with_pyvista, read_mesh
from fb_core.data.meshes.mesh_views import MeshConfig, MeshPool, find_meshes, sphere_cameras
from fb_core.data.meshes.triangle_caster import cast_triangles
from fb_core.data.rooms.ray_caster import render
from fb_core.data.rooms.room import FAMILIES, make_room
from fb_core.data.rooms.room_cameras import training_cameras
from fb_core.data.training.capture_sequences import (
    CaptureConfig,
    CaptureSource,
    Window,
    find_captures,
    read_training_capture,
    strided,
)
from fb_core.data.training.sequences import PoolConfig, RoomPool
from fb_core.data.training.task import Source, TaskConfig

# ---- triangles and meshes ----


def test_triangles_of_a_room_are_where_its_analytic_solids_are():
    """From inside, with walls that reach behind the camera."""
    room = make_room(3, FAMILIES["narrow"])
    cameras = training_cameras(room, 1, size=32, generator=torch.Generator().manual_seed(0))
    mesh = room.mesh()
    hits = cast_triangles(torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).long(), cameras)
    assert ((hits.depth - render(room, cameras).depth[0]).abs() < 2e-3).all()
    assert torch.allclose(hits.weights.sum(dim=-1), torch.ones(32, 32)) and (hits.face >= 0).all()


def test_a_triangle_behind_the_camera_is_not_seen():
    cameras = sphere_cameras(MeshConfig(views=1, image_size=16), torch.Generator().manual_seed(0))
    center, forward = cameras.centers[0], cameras.rotations[0, :, 2]
    behind = center - forward + 0.1 * torch.eye(3)
    assert (cast_triangles(behind, torch.tensor([[0, 1, 2]]), cameras).face == -1).all()


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    return cube_and_no_mesh(tmp_path_factory.mktemp("meshes"))


def test_a_cube_is_drawn_in_its_colours_before_the_background(meshes):
    cameras = sphere_cameras(MeshConfig(views=6, image_size=32), torch.Generator().manual_seed(1))
    assert torch.allclose(cameras.centers.norm(dim=1), cameras.centers.norm(dim=1).clamp(2.6, 3.4))
    light = Lighting(background=(0.1, 0.9, 0.3), lamp=(0.0, 0.0, 1.0))
    pictures = draw_with_caster(read_mesh(meshes / "cube.ply"), cameras, light, supersample=1)
    assert torch.allclose(pictures[:, :, 0, 0], torch.tensor([0.1, 0.9, 0.3]))
    inside = pictures.permute(0, 2, 3, 1)[
        (pictures - torch.tensor([0.1, 0.9, 0.3])[:, None, None]).abs().amax(dim=1) > 1e-3
    ]
    # Every face is red, green or blue, under a light of 0.4 (away from the lamp) to 1 (towards it).
    value, others = inside.amax(dim=-1), inside.sum(dim=-1) - inside.amax(dim=-1)
    assert (others < 1e-6).all() and (value >= 0.4 * 200 / 255 - 1e-3).all() and (value <= 200 / 255 + 1e-3).all()
    # The cube's centre lies in the middle of every picture, its corners inside.
    assert len(inside) > 500 and not torch.allclose(pictures[:, :, 16, 16], torch.tensor([0.1, 0.9, 0.3]))


@pytest.mark.slow
def test_pyvista_draws_the_same_shape(meshes):
    cameras = sphere_cameras(MeshConfig(views=2, image_size=64), torch.Generator().manual_seed(1))
    light = Lighting(background=(1.0, 1.0, 1.0), lamp=(0.0, 0.0, 1.0))
    ours, theirs = (
        draw(read_mesh(meshes / "cube.ply"), cameras, light) for draw in (draw_with_caster, draw_with_pyvista)
    )
    assert ((ours.amin(dim=1) < 0.9) != (theirs.amin(dim=1) < 0.9)).float().mean() < 0.01


def test_meshes_make_sequences_and_broken_files_are_named(meshes, caplog):
    config = MeshConfig(image_size=16, views=4, meshes=3, supersample=1)
    pool = MeshPool(find_meshes(meshes), config, seed=0)
    with caplog.at_level(logging.WARNING):
        pool.advance(0)
    assert "broken.obj" in caplog.text and isinstance(pool, Source)
    batch = pool.sequences(range(2), TASK, draws())
    assert (
        batch.images.shape == (2, 3, 3, 16, 16)
        and batch.raymaps[:, :, :3].abs().max() <= 1
        and batch.images.std() > 0.05
    )
    again = MeshPool(find_meshes(meshes), config, seed=0)
    again.advance(0)
    assert_same(batch, again.sequences(range(2), TASK, draws()))
    only_broken = MeshPool([meshes / "broken.obj"], config, seed=0)
    with pytest.raises(ValueError, match=r"8 files in a row could not be drawn, the last because: mesh .*broken.obj"):
        only_broken.advance(0)


# ---- captures ----


@pytest.fixture(scope="module")
def small_rooms():
    pool = RoomPool(PoolConfig(families=("narrow",), rooms=2, views=8, image_size=16), seed=0)
    pool.advance(0)
    return pool


def axes_of(sequences):
    """The ray through each picture's middle [b, n, 3]."""
    return torch.nn.functional.normalize(sequences.raymaps[:, :, 3:].mean(dim=(3, 4)), dim=-1)


def test_a_sequence_in_sectors_knows_the_views_that_look_where_the_first_one_looks(small_rooms):
    task = TaskConfig(views=8, partial_share=0.0, dropout=0.0, ray_task=0.0, random_heading=False, sector=1.0)
    axes = axes_of(small_rooms.sequences(range(0, 6), task, draws()))
    closeness = (axes * axes[:, :1]).sum(dim=-1)
    assert (closeness[:, 1:] <= closeness[:, :-1] + 0.03).all()  # the middle of four pixels is not quite the axis
    assert closeness[:, 1].mean() > closeness[:, -1].mean() + 0.5


def test_sectors_change_the_order_of_the_views_and_nothing_else(small_rooms, tiny_capture):
    capture = CaptureSource([tiny_capture], CaptureConfig(image_size=16))
    for source in (small_rooms, capture):
        plain, sectors = (
            source.sequences(range(0, 1), TaskConfig(views=4, random_heading=False, sector=share), draws())
            for share in (0.0, 1.0)
        )
        same = {tuple(image.flatten().tolist()) for image in plain.images[0]}
        assert {tuple(image.flatten().tolist()) for image in sectors.images[0]} == same
        assert torch.equal(plain.images[0, 0], sectors.images[0, 0])


def test_odds_of_sectors_are_odds():
    with pytest.raises(ValueError, match=r"from 0 to 1, got 1\.5"):
        TaskConfig(sector=1.5)


def test_captures_become_square_sequences_with_truth_where_their_masks_say(tiny_capture):
    source = CaptureSource(find_captures(tiny_capture.parent), CaptureConfig(image_size=16, strides=(1,)))
    assert isinstance(source, Source)
    batch = source.sequences(range(4), TASK, draws())
    assert batch.images.shape == (4, 3, 3, 16, 16) and batch.raymaps[:, :, :3].abs().max() <= 1
    assert 0 < batch.image_truth.mean() < 1 and (batch.image_known <= batch.image_truth).all()
    assert not (batch.images * (1 - batch.image_truth)).any()
    assert_same(batch, CaptureSource(source.folders, source.config).sequences(range(4), TASK, draws()))
    one = source.sequences(range(2, 4, 4), TASK, draws())
    assert torch.equal(one.images[0], batch.images[2])  # a row depends on nothing but its generator
    assert torch.equal(source.raymaps(range(4), TASK, draws())[1], batch.raymaps[1, 1])
    assert source.images(range(3), draws()).shape == (3, 3, 16, 16)


def test_a_crop_shows_what_its_camera_sees(tiny_capture):
    """The capture's colours are a function of direction, so colours tell whether rays and pixels belong together."""
    frame = read_capture(tiny_capture).frames[0]
    window = Window.of(frame, (0.7, 0.2), CaptureConfig(image_size=16, zoom=2.0))
    picture, _ = window.read()
    directions = window.camera.directions()[0].permute(2, 0, 1)
    wanted = 0.5 + 0.5 * torch.sin(3 * directions + torch.arange(3)[:, None, None])
    assert (picture - wanted.float()).abs().mean() < 0.01


def test_the_camera_of_a_bent_picture_is_that_of_its_undistorted_one(tiny_capture):
    frame = read_capture(tiny_capture).frames[0]
    bent = dataclasses.replace(frame, camera_model="OPENCV_FISHEYE", distortion={"k1": 0.05, "k2": 0.01})
    window = Window.of(bent, (0.5, 0.5), CaptureConfig(image_size=16))
    assert torch.equal(window.camera.focal, bent.load_undistorted()[2].scaled(window.width, window.height).focal)


def test_scannetpp_folders_are_read_without_bad_frames(tiny_capture, tmp_path):
    dslr = tmp_path / "data/0a7cc12c0e/dslr"
    shutil.copytree(tiny_capture / "images", dslr / "resized_images")
    meta = json.loads((tiny_capture / "transforms.json").read_text())
    for number, entry in enumerate(meta["frames"]):
        entry["file_path"] = entry["file_path"].rsplit("/", 1)[1]
        entry["is_bad"] = number == 2
        entry.pop("mask_path", None)
    (dslr / "nerfstudio").mkdir()
    (dslr / "nerfstudio/transforms.json").write_text(json.dumps(meta))
    (folder,) = find_captures(tmp_path / "data")
    capture = read_training_capture(folder)
    assert len(capture.frames) == 5 and all(frame.image_path.is_file() for frame in capture.frames)
    centers = capture.normalized(dataclasses.replace(capture.frames[0].camera)).centers
    assert centers.abs().max() <= 1


def test_an_unreadable_picture_is_named_and_another_sequence_drawn(tiny_capture, caplog):
    (tiny_capture / "images/view_003.png").write_bytes(b"")
    source = CaptureSource([tiny_capture], CaptureConfig(image_size=16, retries=40))
    with caplog.at_level(logging.WARNING):
        assert torch.isfinite(source.sequences(range(3), dataclasses.replace(TASK, views=2), draws()).images).all()
    assert "view_003.png" in caplog.text
    shutil.rmtree(tiny_capture / "images")
    with pytest.raises(ValueError, match=r"40 sequences in a row could not be read, the last because: image .*view_00"):
        source.sequences(range(1), TASK, draws())


def test_strides_are_kept_where_they_fit():
    generator = torch.Generator().manual_seed(0)
    for stride in (1, 2, 4, 8):
        chosen = sorted(strided(100, 5, stride, generator=generator))
        assert [b - a for a, b in itertools.pairwise(chosen)] == [stride] * 4
    halved = sorted(strided(10, 5, 8, generator=generator))  # 8 and 4 do not fit into 10 frames, 2 does
    assert [b - a for a, b in itertools.pairwise(halved)] == [2] * 4
    assert len(strided(3, 5, 1, generator=generator)) == 5


def test_no_captures_and_no_meshes_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"expected folders with a transforms\.json"):
        find_captures(tmp_path)
    with pytest.raises(ValueError, match=r"expected files of \.glb"):
        find_meshes(tmp_path)
