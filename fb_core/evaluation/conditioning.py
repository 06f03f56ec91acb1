"""The same hidden views generated from more and more known ones of a capture (the paper's "flexible conditioning and
generation").
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.evaluation.capture_questions import CaptureViews
from fb_core.evaluation.metrics.image_metrics import psnr, ssim
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.views import Views


def generated_from(
    model: Fillerbuster, views: CaptureViews, *, hidden: int, known: int, sampling: SamplingConfig, seed: int
) -> Float[Tensor, "m 3 h w"]:
    """The first ``hidden`` views as the model generates them from the ``known`` ones that follow; all cameras are
    told.
    """
    asked, given = views[:hidden], views[hidden : hidden + known]
    sequence = Views.cat([Views.known(given.images, given.cameras, mask=given.truth), Views.unknown(asked.cameras)])
    return model.complete(sequence, generator=torch.Generator().manual_seed(seed), sampling=sampling).images[known:]


def scores_of(generated: Float[Tensor, "m 3 h w"], views: CaptureViews) -> dict[str, float]:
    """``psnr`` (dB, over pixels that are true) and ``ssim`` (what nobody knows counts as right), means over the
    views.
    """
    shown = torch.where(views.truth > 0, generated, views.images)
    unknown = -10 * views.truth.mean(dim=(1, 2, 3)).clamp_min(1e-6).log10()
    return {
        "psnr": float((psnr(shown, views.images) - unknown).mean()),
        "ssim": float(ssim(shown, views.images).mean()),
    }
