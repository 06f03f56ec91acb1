"""Pinhole cameras: camera-to-world, OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

from __future__ import annotations

import dataclasses
import numbers
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Pinholes:
    """``n`` undistorted cameras that share one image size. Lengths are in scene units, focal and principal in
    pixels.
    """

    camera_to_world: Float[Tensor, "n 3 4"]
    """Rotation (columns: the camera's right, down and forward axes in world coordinates) and centre."""
    focal: Float[Tensor, "n 2"]
    """fx, fy in pixels."""
    principal: Float[Tensor, "n 2"]
    """cx, cy in pixels; the centre of the top left pixel is (0.5, 0.5)."""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"cameras: expected pictures of at least 1x1 pixels, got {self.width}x{self.height}")

    def __len__(self) -> int:
        return self.camera_to_world.shape[0]

    def __getitem__(self, index) -> Pinholes:
        """The chosen cameras; an integer keeps the leading dimension (one camera)."""
        if isinstance(index, numbers.Integral):  # NumPy's integers too
            index = [int(index)]
        return dataclasses.replace(
            self, camera_to_world=self.camera_to_world[index], focal=self.focal[index], principal=self.principal[index]
        )

    @property
    def centers(self) -> Float[Tensor, "n 3"]:
        """Camera centres in world coordinates."""
        return self.camera_to_world[:, :, 3]

    @property
    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """Camera-to-world rotations."""
        return self.camera_to_world[:, :, :3]

    @property
    def world_to_camera(self) -> Float[Tensor, "n 4 4"]:
        """The inverse rigid motions as homogeneous matrices."""
        transposed = self.rotations.transpose(1, 2)
        top = torch.cat([transposed, -transposed @ self.centers[:, :, None]], dim=2)
        bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(self), 1, 4)
        return torch.cat([top, bottom], dim=1)

    @property
    def intrinsics(self) -> Float[Tensor, "n 3 3"]:
        """K matrices: pixel = K @ (x/z, y/z, 1) for camera coordinates (x, y, z)."""
        matrix = self.focal.new_zeros(len(self), 3, 3)
        matrix[:, 0, 0], matrix[:, 1, 1] = self.focal[:, 0], self.focal[:, 1]
        matrix[:, :2, 2] = self.principal
        matrix[:, 2, 2] = 1.0
        return matrix

    def to(self, *args, **kwargs) -> Pinholes:
        """Like ``Tensor.to`` for every tensor."""
        return dataclasses.replace(
            self,
            camera_to_world=self.camera_to_world.to(*args, **kwargs),
            focal=self.focal.to(*args, **kwargs),
            principal=self.principal.to(*args, **kwargs),
        )

    def moved(self, shift: Float[Tensor, " 3"]) -> Pinholes:
        """The same cameras ``shift`` (scene units) farther on."""
        pose = torch.cat([self.rotations, (self.centers + shift)[:, :, None]], dim=2)
        return dataclasses.replace(self, camera_to_world=pose)

    def pixel_centers(self) -> Float[Tensor, "h w 2"]:
        """(x, y) of every pixel centre."""
        like = {"device": self.focal.device, "dtype": self.focal.dtype}
        y, x = torch.meshgrid(
            torch.arange(self.height, **like) + 0.5, torch.arange(self.width, **like) + 0.5, indexing="ij"
        )
        return torch.stack([x, y], dim=-1)

    def directions(self) -> Float[Tensor, "n h w 3"]:
        """Unit ray directions through the pixel centres, in world coordinates."""
        pixels = self.pixel_centers()
        in_plane = (pixels - self.principal[:, None, None, :]) / self.focal[:, None, None, :]
        in_camera = torch.cat([in_plane, torch.ones_like(in_plane[..., :1])], dim=-1)
        in_world = torch.einsum("nij,nhwj->nhwi", self.rotations, in_camera)
        return F.normalize(in_world, dim=-1)

    def cosines(self) -> Float[Tensor, "n h w"]:
        """Of the angles between the rays and their camera's axis: z-depth over the distance along the ray."""
        return torch.einsum("nhwc,nc->nhw", self.directions(), self.rotations[:, :, 2])

    def project(self, points: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m"]]:
        """Pixel coordinates and z-depth of world points; points with depth <= 0 lie behind (their pixels mean
        nothing).
        """
        in_camera = torch.einsum("nji,nmj->nmi", self.rotations, points[None] - self.centers[:, None])
        depth = in_camera[..., 2]
        safe = torch.where(depth.abs() < 1e-12, torch.full_like(depth, 1e-12), depth)
        pixels = in_camera[..., :2] / safe[..., None] * self.focal[:, None] + self.principal[:, None]
        return pixels, depth

    def unproject(self, depth: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w 3"]:
        """World points of the pixel centres at the given z-depth (not distance). The inverse of :meth:`project`."""
        in_plane = (self.pixel_centers() - self.principal[:, None, None]) / self.focal[:, None, None]
        in_camera = torch.cat([in_plane, torch.ones_like(in_plane[..., :1])], dim=-1) * depth[..., None]
        return torch.einsum("nij,nhwj->nhwi", self.rotations, in_camera) + self.centers[:, None, None]

    def scaled(self, width: int, height: int) -> Pinholes:
        """The same cameras with images resampled to another size (focal and principal scale with it)."""
        factor = self.focal.new_tensor([width / self.width, height / self.height])
        return dataclasses.replace(
            self, focal=self.focal * factor, principal=self.principal * factor, width=width, height=height
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Pinholes:
        """The same cameras with images cut to a window; a negative corner or a larger size pads."""
        shift = self.principal.new_tensor([left, top])
        return dataclasses.replace(self, principal=self.principal - shift, width=width, height=height)

    @staticmethod
    def cat(groups: list[Pinholes]) -> Pinholes:
        """All cameras in one batch. Raises ValueError when the image sizes differ."""
        sizes = {(group.width, group.height) for group in groups}
        if len(sizes) != 1:
            raise ValueError(
                f"cameras of one batch must share one image size, got {sorted(sizes)}; rescale or crop them first"
            )
        return dataclasses.replace(
            groups[0],
            camera_to_world=torch.cat([group.camera_to_world for group in groups]),
            focal=torch.cat([group.focal for group in groups]),
            principal=torch.cat([group.principal for group in groups]),
        )

    @staticmethod
    def looking_at(
        centers: Float[Tensor, "n 3"],
        targets: Float[Tensor, "n 3"],
        *,
        up: Float[Tensor, " 3"],
        fov_degrees: float,
        width: int,
        height: int,
    ) -> Pinholes:
        """Cameras at ``centers`` that look at ``targets`` with square pixels; ``fov_degrees`` spans the image width.

        Where the view direction is (nearly) parallel to ``up``, some perpendicular axis serves as the right axis.
        Raises ValueError for a target at its camera's centre and for a field of view outside (0, 180).
        """
        if not 0.0 < fov_degrees < 180.0:
            raise ValueError(f"looking_at: expected fov_degrees between 0 and 180, got {fov_degrees}")
        if width < 1 or height < 1:
            raise ValueError(f"looking_at: expected pictures of at least 1x1 pixels, got {width}x{height}")
        toward = targets.double() - centers.double()
        distance = toward.norm(dim=-1, keepdim=True)
        if not bool((distance > 0).all() and torch.isfinite(distance).all()):
            raise ValueError(
                "looking_at: expected finite targets apart from their centers, got one at its center or not finite; "
                "move it"
            )
        forward = toward / distance
        right = torch.linalg.cross(forward, F.normalize(up.double(), dim=0).expand_as(forward))
        other = F.one_hot(forward.abs().argmin(dim=-1), 3).to(
            forward
        )  # the world axis farthest from the view direction
        parallel = right.norm(dim=-1, keepdim=True) < 1e-6
        right = F.normalize(torch.where(parallel, torch.linalg.cross(forward, other), right), dim=-1)
        down = torch.linalg.cross(forward, right)
        rotation = torch.stack([right, down, forward], dim=-1).to(centers)
        focal = 0.5 * width / torch.tan(torch.deg2rad(centers.new_tensor(fov_degrees)) / 2)
        return Pinholes(
            camera_to_world=torch.cat([rotation, centers[:, :, None]], dim=2),
            focal=focal.expand(len(centers), 2).clone(),
            principal=centers.new_tensor([width / 2, height / 2]).expand(len(centers), 2).clone(),
            width=width,
            height=height,
        )
