"""Gaussian splats as a file that other viewers and tools read: the PLY layout of 3D Gaussian Splatting (Kerbl et al.
2023).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.models.splatfacto import RGB2SH
from torch import Tensor

from fb_core.geometry.similarity import Similarity

_STRAIGHT = 1e-6  # most that a rotation may differ from none
_HEADER_BYTES = 2**14
_PLACES, _CONSTANT, _SCALES, _TURNS = ("x", "y", "z"), tuple(f"f_dc_{i}" for i in range(3)), "scale_", "rot_"


@dataclass(frozen=True, kw_only=True)
class Splats:
    """``m`` Gaussians in one world, in the parametrization of the file; float32."""

    means: Float[Tensor, "m 3"]
    """Centres, scene units."""
    log_scales: Float[Tensor, "m 3"]
    """Natural logarithms of the standard deviations."""
    quats: Float[Tensor, "m 4"]
    """Rotations (w, x, y, z), of any length but 0."""
    logits: Float[Tensor, " m"]
    """Opacities before the sigmoid."""
    harmonics: Float[Tensor, "m k 3"]
    """Coefficients of the colours' spherical harmonics, (degree + 1)^2 of them; the first is the constant one."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the harmonics."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @staticmethod
    def of_parameters(parameters: Mapping[str, Tensor], *, sh_degree: int) -> Splats:
        """Of splatfacto's parameters (``means``, ``features_dc``, ...); Gaussians with values that are not finite are
        left out.
        """
        given = {name: values.detach().to("cpu", torch.float32) for name, values in parameters.items()}
        constant = given["features_dc"] if sh_degree > 0 else RGB2SH(given["features_dc"].sigmoid())
        harmonics = torch.cat([constant[:, None], given["features_rest"].reshape(len(constant), -1, 3)], dim=1)
        splats = Splats(
            means=given["means"],
            log_scales=given["scales"],
            quats=given["quats"],
            logits=given["opacities"].reshape(-1),
            harmonics=harmonics[:, : (sh_degree + 1) ** 2],
        )
        return splats.chosen(_table(splats).isfinite().all(dim=1))

    def to(self, device: torch.device | str) -> Splats:
        """The same on another device."""
        return Splats(**{field.name: getattr(self, field.name).to(device) for field in dataclasses.fields(self)})

    def chosen(self, which: Tensor) -> Splats:
        """Some of them, by a mask or by indices."""
        return Splats(**{field.name: getattr(self, field.name)[which] for field in dataclasses.fields(self)})

    def moved(self, to: Similarity) -> Splats:
        """The same splats in another world that is not turned against this one (harmonics would have to be turned too).

        Raises ValueError for a similarity that turns.
        """
        off = float((to.rotation - torch.eye(3, dtype=torch.float64)).abs().max())
        if off > _STRAIGHT:
            raise ValueError(
                f"splats: expected a world that is shifted and scaled only, got one that is turned (by {off:.3g})"
            )
        return dataclasses.replace(
            self,
            means=to.points(self.means).float(),
            log_scales=(self.log_scales.double() + math.log(to.scale)).float(),
        )


def write_splats(path: Path, splats: Splats) -> None:
    """A binary PLY file with the properties that viewers of splats look for."""
    table = _table(splats)
    names = _names(splats.harmonics.shape[1])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(splats)}",
        *(f"property float {name}" for name in names),
    ]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    path.write_bytes(header + np.ascontiguousarray(table.numpy(), dtype="<f4").tobytes())


def read_splats(path: Path) -> Splats:
    """Splats as :func:`write_splats` and other trainers write them, to the same bits.

    Raises ValueError in one sentence for a file that holds something else.
    """
    content = path.read_bytes()
    start, end, body = content[:_HEADER_BYTES].partition(b"end_header\n")
    words = [line.split() for line in start.decode("ascii", errors="replace").splitlines()]
    counts = [
        int(line[2]) for line in words if line[:2] == ["element", "vertex"] and len(line) == 3 and line[2].isdecimal()
    ]
    properties = [line for line in words if line[:1] == ["property"]]
    names = [line[-1] for line in properties]
    plain = (
        words[:1] == [["ply"]] and ["format", "binary_little_endian", "1.0"] in words and len(counts) == 1 and bool(end)
    )
    rest = sum(name.startswith("f_rest_") for name in names)
    bases = 1 + rest // 3
    needed = set(_names(bases)) - {"nx", "ny", "nz"}
    if (
        not plain
        or not needed <= set(names)
        or {line[1] for line in properties} != {"float"}
        or math.isqrt(bases) ** 2 != bases
        or rest % 3
    ):
        raise ValueError(
            f"splats {path}: expected a binary PLY file of Gaussian splats, got something else; export the splats again"
        )
    body = content[len(start) + len(end) :]
    if len(body) < 4 * len(names) * counts[0]:
        raise ValueError(
            f"splats {path}: its header promises {counts[0]:,} Gaussians, more than its bytes hold; copy it again"
        )
    values = np.frombuffer(body, dtype="<f4", count=len(names) * counts[0]).reshape(counts[0], len(names))
    table = torch.from_numpy(values.astype(np.float32))

    def columns(*wanted: str) -> Tensor:
        return table[:, [names.index(name) for name in wanted]].contiguous()

    others = (
        columns(*(f"f_rest_{i}" for i in range(rest))).reshape(-1, 3, rest // 3).transpose(1, 2)
        if rest
        else table.new_zeros(len(table), 0, 3)
    )
    return Splats(
        means=columns(*_PLACES),
        log_scales=columns(*(f"{_SCALES}{i}" for i in range(3))),
        quats=columns(*(f"{_TURNS}{i}" for i in range(4))),
        logits=columns("opacity")[:, 0],
        harmonics=torch.cat([columns(*_CONSTANT)[:, None], others], dim=1),
    )


def _names(bases: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (bases - 1))]
    return [
        *(*_PLACES, "nx", "ny", "nz", *_CONSTANT, *rest, "opacity"),
        *(*(f"{_SCALES}{i}" for i in range(3)), *(f"{_TURNS}{i}" for i in range(4))),
    ]


def _table(splats: Splats) -> Float[Tensor, "m columns"]:
    """One row for each Gaussian in the order of the file; coefficients of one colour lie together there."""
    rest = splats.harmonics[:, 1:].transpose(1, 2).reshape(len(splats), -1)
    parts = [
        splats.means,
        torch.zeros_like(splats.means),
        splats.harmonics[:, 0],
        rest,
        splats.logits[:, None],
        splats.log_scales,
        splats.quats,
    ]
    return torch.cat(parts, dim=1)
