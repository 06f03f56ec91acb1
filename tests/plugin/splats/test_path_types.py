"""Camera paths that are not perspective, their crops and scales: drawn as they are meant, or refused in one
sentence.
"""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from helpers.plugin.splat_models import make_model
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components import renderers

from fb_nerfstudio.refusal import Refused
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel

_COUNT = 300


@pytest.fixture(scope="module")
def model() -> FillerbusterSplatModel:
    """Soft Gaussians all around the origin, small enough that perspective bends none of them much, and hardly one
    before another: splats are sorted by z-depth, so that the order of neighbours depends on where a view's axis points.
    """
    made = make_model(_COUNT, sh_degree=0, background_color="black").eval()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        made.means.copy_(F.normalize(torch.randn(_COUNT, 3, generator=generator), dim=1) * 3)
        made.scales.fill_(math.log(0.1))
        made.opacities.fill_(2.0)
        made.features_dc.copy_(torch.randn(_COUNT, 3, generator=generator) * 2)
    return made


def along(
    kind: str, *, pose: torch.Tensor | None = None, width: int = 128, height: int = 64, fov: float = 90.0, **more
) -> Cameras:
    """One camera of a path, as ns-render reads it from the viewer's file."""
    pose = torch.eye(4) if pose is None else pose
    camera = {"camera_to_world": pose.reshape(-1).tolist(), "fov": fov, "aspect": width / height}
    path = {
        "camera_type": kind,
        "render_width": width,
        "render_height": height,
        "seconds": 1,
        "camera_path": [camera],
        **more,
    }
    return get_path_from_json(path)[0:1]


def turned(degrees: float) -> torch.Tensor:
    """About the upward axis, to the left."""
    angle = math.radians(degrees)
    pose = torch.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    return pose


@pytest.mark.parametrize("heading", [0.0, 90.0, 137.0])
def test_a_panorama_shows_along_its_rays_what_perspective_views_show(
    model: FillerbusterSplatModel, heading: float
) -> None:
    panorama = model.get_outputs_for_camera(along("equirectangular", width=512, height=256))
    assert set(panorama) == {"rgb", "accumulation", "background", "depth", "normal", "surface_normal"}
    assert panorama["rgb"].shape == (256, 512, 3) and panorama["depth"].shape == (256, 512, 1)
    straight = along("perspective", pose=turned(heading), width=96, height=96, fov=60.0)
    view = model.get_outputs_for_camera(straight)
    directions = F.normalize(straight.generate_rays(camera_indices=0, keep_shape=True).directions, dim=-1)
    places = torch.stack(
        [torch.atan2(directions[..., 0], -directions[..., 2]) / math.pi, -torch.asin(directions[..., 1]) / math.pi * 2],
        dim=-1,
    )
    for name in ("rgb", "accumulation"):
        looked_up = F.grid_sample(panorama[name].movedim(-1, 0)[None], places[None], align_corners=False)[0].movedim(
            0, -1
        )
        inside = (places[..., 0].abs() < 0.99)[..., None].expand_as(looked_up)
        assert float((looked_up - view[name])[inside].abs().mean()) < 0.02, name
    opaque = panorama["accumulation"] > 0.5
    assert float((panorama["depth"][opaque] - 3).abs().median()) < 0.05, "all Gaussians are as far away"
    assert float(view["rgb"].std()) > 0.05


def test_turning_a_panorama_shifts_it(model: FillerbusterSplatModel) -> None:
    outputs = model.get_outputs_for_camera(along("equirectangular"))
    quarter = model.get_outputs_for_camera(along("equirectangular", pose=turned(90.0)))
    for name in ("rgb", "accumulation", "depth"):
        error = (quarter[name] - outputs[name].roll(32, dims=1)).abs()
        assert float(error.mean()) < 1e-3 and float((error > 1e-3).float().mean()) < 0.02, (
            name
        )  # rays along edges of the cube
    here, there = (2 * one["normal"] - 1 for one in (outputs, quarter))  # right, up, towards the camera
    back = there @ turned(90.0)[:3, :3].T  # normals are told in the camera's axes
    assert float((back - here.roll(32, dims=1)).abs().mean()) < 0.01


def test_a_fisheye_path_shows_along_its_rays_what_a_panorama_shows(model: FillerbusterSplatModel) -> None:
    panorama = model.get_outputs_for_camera(along("equirectangular", width=512, height=256))["rgb"]
    fisheye = along("fisheye", width=96, height=96, fov=60.0)
    view = model.get_outputs_for_camera(fisheye)["rgb"]
    directions = F.normalize(fisheye.generate_rays(camera_indices=0, keep_shape=True).directions, dim=-1)
    places = torch.stack(
        [torch.atan2(directions[..., 0], -directions[..., 2]) / math.pi, -torch.asin(directions[..., 1]) / math.pi * 2],
        dim=-1,
    )
    looked_up = F.grid_sample(panorama.movedim(-1, 0)[None], places[None], align_corners=False)[0].movedim(0, -1)
    assert float((looked_up - view).abs().mean()) < 0.02
    perspective = model.get_outputs_for_camera(along("perspective", width=96, height=96, fov=60.0))["rgb"]
    assert float((perspective - view).abs().mean()) > 0.03, "and no perspective picture"


@pytest.mark.parametrize("kind", ["omnidirectional", "vr180"])
def test_stereo_paths_are_refused_in_one_sentence(model: FillerbusterSplatModel, kind: str) -> None:
    with pytest.raises(Refused, match="save the path as perspective, fisheye or equirectangular") as found:
        model.get_outputs_for_camera(along(kind))
    assert "\n" not in str(found.value)


def test_straightened_fisheye_cameras_of_a_capture_stay_pinholes(model: FillerbusterSplatModel) -> None:
    """nerfstudio straightens pictures and intrinsics and leaves the type and the coefficients."""
    camera = along("perspective", width=64, height=64)
    captured = along("perspective", width=64, height=64)
    captured.camera_type[:] = CameraType.FISHEYE.value
    captured.distortion_params = torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.0, 0.0]])
    expected = model.get_outputs_for_camera(camera)["rgb"]
    assert torch.equal(model.get_outputs_for_camera(captured)["rgb"], expected)


@pytest.mark.parametrize("kind", ["perspective", "equirectangular"])
def test_scaled_scenes_and_the_background_of_a_crop(model: FillerbusterSplatModel, kind: str) -> None:
    scaled = torch.eye(4)
    scaled[:3, :3] *= 2
    expected = model.get_outputs_for_camera(along(kind))["rgb"]
    assert torch.allclose(model.get_outputs_for_camera(along(kind, pose=scaled))["rgb"], expected, atol=1e-5)
    nothing = OrientedBox.from_params((50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    with renderers.background_color_override_context(torch.tensor([1.0, 0.0, 0.0])):
        cropped = model.get_outputs_for_camera(along(kind), obb_box=nothing)["rgb"]
    assert torch.allclose(cropped, torch.tensor([1.0, 0.0, 0.0]).expand_as(cropped), atol=1e-6)
    uncropped = model.get_outputs_for_camera(along(kind))["rgb"]
    assert torch.allclose(uncropped, expected, atol=1e-6)
