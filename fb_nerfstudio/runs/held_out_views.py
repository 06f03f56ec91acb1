"""Held-out views of a finished run: rendered from its checkpoint as ``ns-eval`` would, beside their ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data.capture.captures import read_capture
from fb_core.evaluation.metrics.image_metrics import mean_quality, psnr
from fb_nerfstudio.bridge import batch_image
from fb_nerfstudio.runs.finished_run import load_run, quiet


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
        """``psnr``, ``ssim`` and ``hole_share`` of covered and of uncovered views (kinds without views are left
        out).
        """
        groups = {"covered": self.covered, "uncovered": ~self.covered}
        return {
            name: mean_quality(self.renders[chosen], self.truth[chosen], self.accumulation[chosen])
            for name, chosen in groups.items()
            if bool(chosen.any())
        }


@torch.no_grad()
@quiet()
def render_held_out(run: Path, capture: Path, *, on_view: Callable[[int, int], None] | None = None) -> HeldOutViews:
    """Load the run whose folder holds config.yml and render every held-out view of its capture.

    Raises ValueError when the run is not one of ours, has no held-out views, or when its capture does not say which are
    covered.
    """
    pipeline = load_run(run)
    manager = pipeline.datamanager
    views = manager.fixed_indices_eval_dataloader
    if len(views) == 0:
        raise ValueError(f"{run}: the run has no held-out views; make the capture with some")
    verdicts = _verdicts(capture, [Path(name).name for name in manager.eval_dataset.image_filenames])
    renders, truth, accumulation = [], [], []
    for number, (camera, batch) in enumerate(views):
        outputs = pipeline.model.get_outputs_for_camera(camera)
        renders.append(outputs["rgb"].cpu().movedim(-1, 0).clamp(0, 1))
        accumulation.append(outputs["accumulation"].cpu().squeeze(-1))
        truth.append(batch_image(batch, "cpu"))
        if on_view is not None:
            on_view(number + 1, len(views))
    bank = manager.generated_views
    return HeldOutViews(
        renders=torch.stack(renders),
        truth=torch.stack(truth),
        accumulation=torch.stack(accumulation),
        covered=torch.tensor([verdicts[batch["image_idx"]] for _, batch in views]),
        generated=() if bank is None else tuple(_pictures(bank)),
    )


def _verdicts(capture: Path, names: list[str]) -> list[bool]:
    """Whether each of these pictures of the capture is covered."""
    covered = {frame.image_path.name: frame.extra.get("covered") for frame in read_capture(capture).frames}
    unsaid = [name for name in names if covered.get(name) is None]
    if unsaid:
        raise ValueError(
            f"{capture}: held-out view {unsaid[0]} does not say whether it is 'covered'; make the capture with "
            "fillerbuster rooms"
        )
    return [bool(covered[name]) for name in names]


def _pictures(bank: CompletedViews) -> Iterator[tuple[str, Float[Tensor, "3 h w"]]]:
    for origin, image in zip(bank.origins, bank.images, strict=True):
        yield origin.role, image.movedim(-1, 0).float() / 255
