"""Colours that depend on the viewing direction: real spherical harmonics up to degree 4 (Sloan's basis, gsplat's
signs).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 4


def basis(degree: int, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """The k = (degree + 1)^2 basis functions at unit directions, ordered by band l and then m = -l .. l."""
    x, y, z = directions.unbind(-1)
    columns = [torch.full_like(x, 0.2820947917738781)]
    if degree >= 1:
        columns += [-0.48860251190291987 * y, 0.48860251190291987 * z, -0.48860251190291987 * x]
    if degree >= 2:
        xy, yz, xz, zz = x * y, y * z, x * z, z * z
        difference = x * x - y * y
        columns += [
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.94617469575755997 * zz - 0.31539156525251999,
            -1.0925484305920792 * xz,
            0.54627421529603959 * difference,
        ]
    if degree >= 3:
        cubic_x, cubic_y = x * (x * x - 3 * y * y), y * (3 * x * x - y * y)
        columns += [
            -0.59004358992664352 * cubic_y,
            2.8906114426405538 * xy * z,
            y * (0.45704579946446572 - 2.2852289973223288 * zz),
            z * (1.865881662950577 * zz - 1.1195289977703462),
            x * (0.45704579946446572 - 2.2852289973223288 * zz),
            1.4453057213202769 * z * difference,
            -0.59004358992664352 * cubic_x,
        ]
    if degree >= 4:
        columns += [
            2.5033429417967046 * xy * difference,
            -1.7701307697799304 * z * cubic_y,
            xy * (6.62322287030292 * zz - 0.94617469575756),
            yz * (2.0071396306718676 - 4.6833258049010242 * zz),
            zz * (3.7024941420321507 * zz - 3.1735664074561294) + 0.31735664074561293,
            xz * (2.0071396306718676 - 4.6833258049010242 * zz),
            difference * (3.31161143515146 * zz - 0.47308734787878),
            -1.7701307697799304 * z * cubic_x,
            0.62583573544917614 * (x * cubic_x - y * cubic_y),
        ]
    return torch.stack(columns, dim=-1)


def sh_colors(
    degree: int, directions: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3"]:
    """max(0, 0.5 + sum of coefficient times basis): colours >= 0, without an upper limit.

    `directions` need not have unit length (a zero direction stays zero); coefficients above `degree` are not used and
    get a zero gradient.
    """
    unit = directions / directions.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    weights = basis(degree, unit)
    used = coefficients[:, : weights.shape[-1]]
    return ((weights[..., None] * used).sum(dim=1) + 0.5).clamp(min=0.0)
