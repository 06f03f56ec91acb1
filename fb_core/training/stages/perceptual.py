"""LPIPS as a training loss, from weights that lie in a file: nothing is downloaded."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn


def load_lpips(backbone: Path) -> nn.Module:
    """LPIPS on SqueezeNet 1.1: a frozen module ``(first, second, normalize=True)`` of images in [0, 1] that gives
    distances [b, 1, 1, 1].

    ``backbone`` is torchvision's file of SqueezeNet 1.1 (``squeezenet1_1-*.pth``); the weights of the distance come
    with torchmetrics. Raises ValueError for a file that is missing or holds something else.
    """
    if not backbone.is_file():
        raise ValueError(
            f"lpips: expected torchvision's weights of SqueezeNet 1.1 in the file {backbone}, which is missing; "
            "download squeezenet1_1 with torchvision, or leave the perceptual loss out"
        )
    try:
        state = torch.load(backbone, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(
            f"lpips: {backbone} is no file of weights ({str(error).splitlines()[0]}); download it again"
        ) from error
    from torchmetrics.functional.image.lpips import _NoTrainLpips

    network = _NoTrainLpips(net="squeeze", pnet_rand=True)
    own = network.net.state_dict()
    # torchmetrics cuts the backbone into slices: "slices.1.3.squeeze.weight" is torchvision's
    # "features.3.squeeze.weight".
    weights = {name: state.get("features." + name.split(".", 2)[2]) for name in own}
    if any(not isinstance(value, Tensor) or value.shape != own[name].shape for name, value in weights.items()):
        raise ValueError(
            f"lpips: {backbone} holds other weights than SqueezeNet 1.1; download squeezenet1_1 with torchvision"
        )
    network.net.load_state_dict(weights)
    return cast(nn.Module, network)
