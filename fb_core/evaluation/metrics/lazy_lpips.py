"""LPIPS that is built at first use, never downloads anything, and stays out of every checkpoint."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

logger = logging.getLogger(__name__)

_SMALLEST_SIDE = 32  # AlexNet's pooling leaves nothing of smaller images


class LazyLpips:
    """LPIPS (AlexNet) of images in [0, 1], or None where its weights are not in the local torch cache.

    A plain object on purpose: as a submodule nerfstudio would put 10 MB of AlexNet into each checkpoint. torchmetrics
    fetches the weights when it is constructed, which fails or hangs without a network, so the cache is checked first.
    """

    def __init__(self) -> None:
        self._metric: Any = None
        self._unavailable = False

    def __call__(self, first: Float[Tensor, "h w 3"], second: Float[Tensor, "h w 3"]) -> float | None:
        """Distance between two images (0 = same), or None when it cannot be computed."""
        if min(first.shape[:2]) < _SMALLEST_SIDE or not self._ready():
            return None
        metric = self._metric.to(first.device)
        with torch.no_grad():
            distance = metric(first.clamp(0, 1).movedim(-1, 0)[None], second.clamp(0, 1).movedim(-1, 0)[None])
        metric.reset()
        return float(distance)

    def _ready(self) -> bool:
        if self._metric is None and not self._unavailable:
            weights = backbone_file()
            if weights.is_file():
                from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

                self._metric = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
            else:
                self._unavailable = True
                logger.warning(
                    "LPIPS is skipped: its AlexNet weights are not in the torch cache; with a network, "
                    "torchvision.models.alexnet(weights='DEFAULT') puts %s there.",
                    weights.name,
                )
        return self._metric is not None


def backbone_file() -> Path:
    """Where torchvision keeps the AlexNet weights that LPIPS is built on."""
    from torchvision.models import AlexNet_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.DEFAULT.url).name
