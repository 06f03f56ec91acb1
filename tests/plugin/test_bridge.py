"""Laws of the bridge between nerfstudio's cameras and ours."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import flip_axes
from fb_nerfstudio.bridge import batch_image, batch_known, to_nerfstudio, to_pinhole_list, to_pinholes


def some_pinholes(count: int = 3, width: int = 20, height: int = 14) -> Pinholes:
    generator = torch.Generator().manual_seed(0)
    cameras = Pinholes.looking_at(
        torch.randn(count, 3, generator=generator) * 2,
        torch.randn(count, 3, generator=generator) * 0.1,
        up=torch.tensor([0.0, 0.0, 1.0]),
        fov_degrees=70.0,
        width=width,
        height=height,
    )
    focal = cameras.focal * torch.tensor([1.0, 1.1])
    principal = cameras.principal + torch.rand(count, 2, generator=generator)
    return Pinholes(
        camera_to_world=cameras.camera_to_world, focal=focal, principal=principal, width=width, height=height
    )


def test_round_trip_is_exact() -> None:
    pinholes = some_pinholes()
    back = to_pinholes(to_nerfstudio(pinholes))
    for name in ("camera_to_world", "focal", "principal"):
        assert torch.equal(getattr(back, name), getattr(pinholes, name)), name
    assert (back.width, back.height) == (pinholes.width, pinholes.height)


def test_round_trip_from_nerfstudio_is_exact() -> None:
    cameras = to_nerfstudio(some_pinholes())
    again = to_nerfstudio(to_pinholes(cameras))
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height", "camera_type"):
        assert torch.equal(getattr(again, name), getattr(cameras, name)), name
    assert cameras.metadata is None or "cam_idx" not in cameras.metadata


def test_rays_agree_with_nerfstudio() -> None:
    """Law: both libraries see the same world through the same pixel."""
    pinholes = some_pinholes()
    cameras = to_nerfstudio(pinholes)
    for index in range(len(pinholes)):
        rays = cameras.generate_rays(camera_indices=index)
        assert torch.allclose(rays.directions, pinholes.directions()[index], atol=1e-6)
        assert torch.allclose(rays.origins[0, 0], pinholes.centers[index], atol=1e-6)


def test_camera_at_identity_looks_along_minus_z() -> None:
    """Closed form: an OpenGL identity pose looks along -z with y up, so OpenCV's down axis is -y and forward is -z."""
    pose = torch.eye(4)[None, :3]
    flipped = flip_axes(pose)
    assert torch.equal(flipped[0, :, 2], torch.tensor([0.0, 0.0, -1.0]))
    assert torch.equal(flipped[0, :, 1], torch.tensor([0.0, -1.0, 0.0]))
    assert torch.equal(flip_axes(flipped), pose)


@pytest.mark.parametrize("kind", [torch.float64, torch.float32, torch.float16])
def test_intrinsics_of_another_precision_follow_the_poses(kind: torch.dtype) -> None:
    """nerfstudio's Blender dataparser gives float64 ones beside float32 poses."""
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    lens = torch.full((2, 1), 12.5, dtype=kind)
    found = to_pinholes(Cameras(poses, lens, lens, lens, lens, width=25, height=25))
    assert {found.focal.dtype, found.principal.dtype, found.camera_to_world.dtype} == {torch.float32}
    assert found.directions().dtype == torch.float32 and float(found.focal[0, 0]) == 12.5


def test_mixed_sizes_need_the_list() -> None:
    mixed = Cameras(
        camera_to_worlds=torch.eye(4)[None, :3].repeat(2, 1, 1),
        fx=torch.tensor([10.0, 20.0]),
        fy=torch.tensor([10.0, 20.0]),
        cx=torch.tensor([8.0, 16.0]),
        cy=torch.tensor([6.0, 12.0]),
        width=torch.tensor([16, 32]),
        height=torch.tensor([12, 24]),
    )
    with pytest.raises(ValueError, match="to_pinhole_list"):
        to_pinholes(mixed)
    single = to_pinhole_list(mixed)
    assert [(p.width, p.height, p.focal[0, 0].item()) for p in single] == [(16, 12, 10.0), (32, 24, 20.0)]


def test_unbatched_camera_becomes_a_batch_of_one() -> None:
    cameras = to_nerfstudio(some_pinholes())
    assert len(to_pinholes(cameras[1].reshape(()))) == 1


def test_panorama_is_refused() -> None:
    cameras = to_nerfstudio(some_pinholes())
    cameras.camera_type[1] = CameraType.EQUIRECTANGULAR.value
    with pytest.raises(ValueError, match="EQUIRECTANGULAR"):
        to_pinholes(cameras)


def test_batch_image_and_known() -> None:
    image = torch.randint(0, 256, (5, 7, 4), dtype=torch.uint8)
    image[..., 3] = 255
    image[0, :, 3] = 0
    mask = torch.ones(5, 7, 1, dtype=torch.bool)
    mask[:, 0] = False
    rgb = batch_image({"image": image})
    assert rgb.shape == (3, 5, 7)
    assert torch.equal((rgb * 255).round().to(torch.uint8), image[..., :3].permute(2, 0, 1))
    known = batch_known({"image": image, "mask": mask})
    assert known.shape == (1, 5, 7)
    assert known[0, 0].sum() == 0 and known[0, :, 0].sum() == 0 and known.sum() == 4 * 6
    floats = torch.rand(5, 7, 3)
    assert torch.equal(batch_image({"image": floats}), floats.permute(2, 0, 1))
    assert torch.equal(batch_known({"image": floats}), torch.ones(1, 5, 7))


def test_batch_errors_name_the_field() -> None:
    with pytest.raises(ValueError, match="image"):
        batch_image({"image": torch.zeros(4, 4)})
    with pytest.raises(ValueError, match="mask"):
        batch_known({"image": torch.zeros(4, 4, 3), "mask": torch.zeros(5, 4, 1)})
    with pytest.raises(ValueError, match="int64"):
        batch_image({"image": torch.zeros(4, 4, 3, dtype=torch.int64)})
