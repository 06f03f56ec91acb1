"""Which places of two pictures are one place of the scene: SIFT, which needs no weights, or LoFTR with weights from a
file.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.features.triangulation import detect, mutual_matches

_RATIO = 0.8  # Lowe 2004
_FEATURES = 2500
_LEAST_SIDE = 384  # pixels; smaller pictures are doubled first: finer places, and more of them
_LOFTR_STEP = 8  # LoFTR's coarse grid


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Places of two pictures that belong together."""

    first: Float[Tensor, "m 2"]
    """(x, y) in pixels of the first picture; the centre of its top left pixel is (0.5, 0.5)."""
    second: Float[Tensor, "m 2"]
    """The same in the second one."""

    def __len__(self) -> int:
        return len(self.first)


Matcher = Callable[[Float[Tensor, "3 h w"], Float[Tensor, "3 h2 w2"]], Correspondences]
"""Two pictures, RGB in [0, 1] -> what belongs together in them."""


def sift_matches(first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h2 w2"]) -> Correspondences:
    """Mutual best matches of RootSIFT features that pass Lowe's ratio."""
    (places, descriptors), (places2, descriptors2) = _sift(first), _sift(second)
    if min(len(places), len(places2)) < 2:
        return Correspondences(first=torch.zeros(0, 2), second=torch.zeros(0, 2))
    rows, columns = mutual_matches(descriptors @ descriptors2.T, ratio=_RATIO)
    return Correspondences(first=places[rows], second=places2[columns])


def _sift(image: Float[Tensor, "3 h w"]) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k d"]]:
    factor = enlargement(image)
    places, descriptors, _ = detect(_scaled(image, factor), limit=_FEATURES)
    return places / factor, descriptors


def enlargement(image: Float[Tensor, "3 h w"]) -> int:
    """How many times larger a picture is made before features are looked for."""
    return 2 if max(image.shape[1:]) < _LEAST_SIDE else 1


def _scaled(image: Float[Tensor, "3 h w"], factor: int) -> Float[Tensor, "3 h2 w2"]:
    if factor == 1:
        return image
    return torch.nn.functional.interpolate(image[None], scale_factor=factor, mode="bicubic", antialias=True)[0].clamp(
        0, 1
    )


def loftr_matcher(weights: Path, *, device: torch.device | str = "cpu") -> Matcher:
    """LoFTR (Sun et al. 2021) as kornia builds it, with weights from a file (kornia's ``loftr_outdoor.ckpt``); nothing
    is downloaded.

    Raises ValueError for a file that is missing, cannot be read without running code, or belongs to another network.
    """
    weights = Path(weights)
    if not weights.is_file():
        raise ValueError(
            f"loftr: no file {weights}; download kornia's loftr_outdoor.ckpt and give its place with --loftr, or "
            "leave it out for SIFT"
        )
    import kornia

    network = kornia.feature.LoFTR(pretrained=None)
    try:
        stored = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"loftr: {weights} holds no weights that can be read ({error}); download loftr_outdoor.ckpt again"
        ) from error
    stored = stored.get("state_dict", stored) if isinstance(stored, dict) else {}
    try:
        network.load_state_dict(stored)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise ValueError(
            f"loftr: {weights} belongs to another network than kornia's LoFTR; give loftr_outdoor.ckpt"
        ) from error
    network = network.requires_grad_(False).eval().to(device)

    def matches(first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h2 w2"]) -> Correspondences:
        output = network({"image0": _grey(first).to(device), "image1": _grey(second).to(device)})
        pairs = zip(("keypoints0", "keypoints1"), (first, second), strict=True)
        places = [output[name].cpu().float().reshape(-1, 2) / enlargement(image) for name, image in pairs]
        shifts = [0.5 / enlargement(image) for image in (first, second)]  # kornia counts pixel centres from 0
        return Correspondences(first=places[0] + shifts[0], second=places[1] + shifts[1])

    return matches


def _grey(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "1 1 h2 w2"]:
    """Luma (Rec. 601) of the enlarged picture, padded with its border to whole cells of LoFTR's grid."""
    image = _scaled(image, enlargement(image))
    grey = torch.einsum("chw,c->hw", image, image.new_tensor([0.299, 0.587, 0.114]))[None, None]
    below, right = (-side % _LOFTR_STEP for side in grey.shape[2:])
    return torch.nn.functional.pad(grey, (0, right, 0, below), mode="replicate")
