"""Held-out views of a finished run: rendered from its checkpoint as ``ns-eval`` would, beside their ground truth."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.data.captures import read_capture
from fb_core.evaluation.image_metrics import mean_quality, psnr


@dataclass(frozen=True, kw_only=True)
class HeldOutViews:
    """What a run makes of the cameras that it was not trained on. All pictures share one size."""

    renders: Float[Tensor, "n 3 h w"]
    """RGB in [0, 1]."""
    truth: Float[Tensor, "n 3 h w"]
    """What the camera would have seen."""
    accumulation: Float[Tensor, "n h w"]
    """Opacity in [0, 1]."""
    covered: Bool[Tensor, " n"]
    """True where the capture saw most of the view."""
    generated: tuple[tuple[str, Float[Tensor, "3 h w"]], ...]
    """(role, picture) of every generated view in the run's bank."""

    @property
    def psnr(self) -> Float[Tensor, " n"]:
        """Of each view, in dB."""
        return psnr(self.renders, self.truth)

    def quality(self) -> dict[str, dict[str, float]]:
        """``psnr``, ``ssim`` and ``hole_share`` of covered and of uncovered views (kinds without views are left out)."""
        groups = {"covered": self.covered, "uncovered": ~self.covered}
        return {
            name: mean_quality(self.renders[chosen], self.truth[chosen], self.accumulation[chosen])
            for name, chosen in groups.items()
            if bool(chosen.any())
        }


@torch.no_grad()
def render_held_out(run: Path, capture: Path, *, on_view: Callable[[int, int], None] | None = None) -> HeldOutViews:
    """Load the run whose folder holds config.yml and render every held-out view of its capture.

    Raises ValueError when the run has no held-out views, or when the capture does not say which of them are covered.
    """
    from nerfstudio.utils.eval_utils import eval_setup

    with contextlib.redirect_stdout(io.StringIO()):  # nerfstudio's own tables would tear our progress bars apart
        _, pipeline, _, _ = eval_setup(run / "config.yml", test_mode="test")
    pipeline.eval()
    covered = {frame.image_path.name: frame.extra.get("covered") for frame in read_capture(capture).frames}
    views = pipeline.datamanager.fixed_indices_eval_dataloader
    if len(views) == 0:
        raise ValueError(f"{run}: the run has no held-out views; capture them, or make the room with held_out above 0")
    names = pipeline.datamanager.eval_dataset.image_filenames
    renders, truth, accumulation, verdicts = [], [], [], []
    for number, (camera, batch) in enumerate(views):
        outputs = pipeline.model.get_outputs_for_camera(camera)
        renders.append(outputs["rgb"].cpu().movedim(-1, 0))
        accumulation.append(outputs["accumulation"].cpu().squeeze(-1))
        picture = batch["image"][..., :3].cpu()
        truth.append((picture.float() / 255 if picture.dtype == torch.uint8 else picture).movedim(-1, 0))
        verdict = covered[Path(names[batch["image_idx"]]).name]
        if verdict is None:
            raise ValueError(f"{capture}: held-out view {names[batch['image_idx']]} does not say whether it is 'covered'")
        verdicts.append(bool(verdict))
        if on_view is not None:
            on_view(number + 1, len(views))
    bank = pipeline.datamanager.generated_views
    pictures = () if bank is None else tuple(image.movedim(-1, 0).float() / 255 for image in bank.images)
    roles = () if bank is None else tuple(origin.role for origin in bank.origins)
    return HeldOutViews(
        renders=torch.stack(renders).clamp(0, 1),
        truth=torch.stack(truth),
        accumulation=torch.stack(accumulation),
        covered=torch.tensor(verdicts),
        generated=tuple(zip(roles, pictures, strict=True)),
    )
