"""A person's camera path as the views to generate, and context chosen by overlap."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
from helpers.folders.camera_paths import write_path
from helpers.scenes.completions import MeanFiller, box_points, captured, room_cameras, small
from nerfstudio.cameras.camera_paths import get_path_from_json

from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.rounds import announcement_of_rounds, run_completion
from fb_core.data.capture.camera_path import as_camera_path, read_camera_path
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.bridge import to_pinholes


@pytest.mark.parametrize(("width", "height"), [(64, 36), (36, 64), (50, 50)])
def test_cameras_are_those_that_nerfstudio_reads(tmp_path: Path, width: int, height: int):
    """Cropped to the path's aspect and scaled to its size, the square cameras are nerfstudio's own."""
    file = write_path(tmp_path / "path.json", width=width, height=height)
    path = read_camera_path(file, size=max(width, height))
    assert path.aspect == pytest.approx(width / height)
    left, top = (max(width, height) - width) // 2, (max(width, height) - height) // 2
    cropped = path.cameras.cropped(left, top, width, height)
    theirs = get_path_from_json(json.loads(file.read_text()))
    theirs.width, theirs.height = torch.full((7, 1), width), torch.full((7, 1), height)
    expected = to_pinholes(theirs)
    for name in ("camera_to_world", "focal", "principal"):
        assert torch.allclose(getattr(cropped, name), getattr(expected, name).float(), atol=1e-4), name


@pytest.mark.parametrize(("width", "height"), [(64, 36), (36, 64), (50, 50)])
def test_a_path_that_is_written_is_read_as_it_was(tmp_path: Path, width: int, height: int):
    centers = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    cameras = Pinholes.looking_at(
        centers, centers * 2, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=55.0, width=width, height=height
    )
    (tmp_path / "path.json").write_text(json.dumps(as_camera_path(cameras)))
    read = read_camera_path(tmp_path / "path.json", size=max(width, height))
    assert read.aspect == pytest.approx(width / height)
    cropped = read.cameras.cropped((max(width, height) - width) // 2, (max(width, height) - height) // 2, width, height)
    torch.testing.assert_close(cropped.camera_to_world, cameras.camera_to_world, atol=1e-6, rtol=0)
    torch.testing.assert_close(cropped.focal, cameras.focal, atol=1e-4, rtol=0)


def test_a_path_is_generated_where_it_is_even_outside_the_walls(tmp_path: Path):
    file = write_path(tmp_path / "path.json")
    config = small(anchor_views=3, camera_path=file)
    plan = plan_completion(room_cameras(), box_points(), config, size=16)
    wanted = read_camera_path(file, size=16).cameras.camera_to_world
    assert not bool(plan.shell.contains(wanted[:, :, 3]).all())  # the collision rule would have moved some
    got = torch.cat([one.cameras.camera_to_world for one in plan.rounds])
    assert sorted(map(str, got.tolist())) == sorted(map(str, wanted.tolist()))
    assert [(one.role, len(one.cameras)) for one in plan.rounds] == [("anchor", 3), ("densify", 2), ("densify", 2)]
    assert torch.equal(plan.rounds[0].cameras.camera_to_world, wanted[[0, 3, 6]])
    assert "7 new views along path.json" in announcement_of_rounds(plan, config, MeanFiller())


def test_a_long_path_is_thinned_evenly(tmp_path: Path):
    config = small(
        anchor_views=3, densify_rounds=1, densify_views=2, camera_path=write_path(tmp_path / "path.json", 41)
    )
    plan = plan_completion(room_cameras(), None, config, size=16)
    places = torch.cat([one.cameras.centers[:, 0] for one in plan.rounds]).sort().values
    assert torch.allclose(places, torch.linspace(0, 9, 5), atol=1e-5)


def test_placed_cameras_are_kept_clear_and_a_path_is_not_looked_at(tmp_path: Path):
    plan = plan_completion(room_cameras(), box_points(), small(), size=16)
    for one in plan.rounds:
        assert bool(plan.shell.contains(one.cameras.centers).all())
        assert float(torch.cdist(one.cameras.centers, box_points()).min()) > 0.1


def test_only_the_paths_own_picture_is_trained_on(tmp_path: Path):
    config = small(anchor_views=3, camera_path=write_path(tmp_path / "path.json", 3, width=32, height=16))
    cameras = room_cameras()
    plan = plan_completion(cameras, None, config, size=16)
    views = [captured(cameras)[index] for index in plan.context]
    (bank,) = run_completion(plan, views, MeanFiller(), config)
    assert bool(bank.masks[:, 4:12].all()) and int(bank.masks.sum()) == 3 * 8 * 16


WRONG = {
    "a capture": (
        '{"frames": [], "fl_x": 3}',
        "expected a path of nerfstudio's viewer .* got the keys fl_x, frames; it is another tool's",
    ),
    "a list": ("[1, 2]", "got list"),
    "no JSON": ("keyframes: 3", "not a JSON file"),
    "binary": ("\x00\x01", "not a JSON file"),
    "no cameras": ('{"camera_path": [], "render_width": 4, "render_height": 4}', "it has no cameras"),
    "a width of nothing": ('{"camera_path": [1], "render_width": 0, "render_height": 4}', "render_width, got 0"),
    "other cameras": (
        '{"camera_path": [{"matrix": [1]}], "render_width": 4, "render_height": 4}',
        "camera 0 has no camera_to_world",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_another_tools_file_is_one_sentence(tmp_path: Path, kind: str):
    text, sentence = WRONG[kind]
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(ValueError, match=sentence) as told:
        read_camera_path(tmp_path / "path.json", size=16)
    assert "\n" not in str(told.value) and "camera path" in str(told.value)


def test_other_lenses_poses_and_fields_of_view_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="no such file"):
        read_camera_path(tmp_path / "nowhere.json", size=16)
    with pytest.raises(ValueError, match="expected camera_type perspective, got 'equirectangular'"):
        read_camera_path(write_path(tmp_path / "path.json", camera_type="equirectangular"), size=16)
    with pytest.raises(ValueError, match=r"camera 0 has a field of view \(fov\) of 180"):
        read_camera_path(write_path(tmp_path / "path.json", fov=180.0), size=16)
    content = json.loads(write_path(tmp_path / "path.json").read_text())
    for number in (2.0, math.nan):
        content["camera_path"][2]["camera_to_world"][0] = number
        (tmp_path / "path.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match="camera 2: its camera_to_world is no rotation and place"):
            read_camera_path(tmp_path / "path.json", size=16)


@pytest.mark.parametrize("scale", [0.5, 2.0, 30.0])
def test_the_scale_of_a_scaled_scene_is_divided_out(tmp_path: Path, scale: float):
    """As nerfstudio's Blender add-on writes it: rays keep their directions, places stay."""
    plain = read_camera_path(write_path(tmp_path / "plain.json"), size=16).cameras
    content = json.loads((tmp_path / "plain.json").read_text())
    for entry in content["camera_path"]:
        matrix = torch.tensor(entry["camera_to_world"], dtype=torch.float64).reshape(4, 4)
        matrix[:3, :3] *= scale
        entry["camera_to_world"] = matrix.flatten().tolist()
    (tmp_path / "scaled.json").write_text(json.dumps(content))
    scaled = read_camera_path(tmp_path / "scaled.json", size=16).cameras
    assert torch.allclose(scaled.camera_to_world, plain.camera_to_world, atol=1e-6) and torch.equal(
        scaled.focal, plain.focal
    )


def test_with_overlap_each_round_sees_the_captured_views_nearest_to_its_own():
    """A path that looks along the first captured view and one along the last want different context; anchors keep the
    spread.
    """
    cameras = room_cameras(12)
    config = small(context_views=3, context_choice="overlap", densify_views=1)
    plan = plan_completion(cameras, box_points(), config, size=16)
    spread = plan_completion(cameras, box_points(), dataclasses.replace(config, context_choice="spread"), size=16)
    assert plan.rounds[0].context == spread.context
    for one, other in zip(plan.rounds, spread.rounds, strict=True):
        assert torch.equal(one.cameras.camera_to_world, other.cameras.camera_to_world)
        assert one.context is not None and len(one.context) == 3 and set(one.context) <= set(plan.context)
    model = MeanFiller()
    views = captured(cameras)
    list(run_completion(plan, [views[index] for index in plan.context], model, config))
    for one, asked in zip(plan.rounds, model.asked, strict=True):
        assert len(asked) == 3 + len(one.cameras) + (0 if one.role == "anchor" else 5)
        greys = [round((float(asked.images[place].mean()) - 0.2) * 10) for place in range(3)]
        assert tuple(greys) == tuple(one.context)
