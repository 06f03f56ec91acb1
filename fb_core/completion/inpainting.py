"""Completing a capture whose pictures have unknown parts: inpaint equally spaced pictures together, once (paper,
"Completing masked 3D regions"; the protocol of NeRFiller without its depth supervision and iterations).

No new camera is placed. The inpainted copies of the pictures join the bank and supervise what was unknown; the captured
pictures keep their masks. Nothing here knows nerfstudio.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import CompletionPlan, PlannedRound, round_seed
from fb_core.completion.planning.site import shell_of, thinned_points
from fb_core.completion.results.completed_views import INPAINTED, CompletedViews, Origin
from fb_core.completion.rounds import (
    CapturedView,
    Named,
    RoundMaker,
    expectation,
    fitted_view,
    model_name,
    open_cache,
)
from fb_core.completion.samples import Inpainter
from fb_core.completion.seams import without_seams
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.square_fit import SquareFit
from fb_core.geometry.viewpoints.paths import CaptureShape, strided_subset
from fb_core.masks import grow_hole
from fb_core.views import Views


def plan_inpainting(
    cameras: list[Pinholes], points: Float[Tensor, "m 3"] | None, config: CompletionConfig, *, size: int
) -> CompletionPlan:
    """One round: ``config.masked.views`` equally spaced captured views (all where there are fewer), at their own
    cameras.

    Args:
        cameras: the captured cameras, one per entry (sizes may differ).
        points: seen surface points, for the shell.
        config: numbers of views, seed.
        size: side of the square that pictures are fitted into while they are inpainted.
    """
    cameras = [camera.to("cpu", torch.float32) for camera in cameras]
    shape = CaptureShape.of(cameras)
    chosen = tuple(strided_subset(len(cameras), config.masked.views))
    fitted = Pinholes.cat([_fitted_camera(cameras[index], size) for index in chosen])
    rounds = (
        PlannedRound(number=0, role=INPAINTED, seed=round_seed(config.seed, 0), cameras=fitted, prompt=config.prompt),
    )
    shell = shell_of(shape, thinned_points(points, shape))
    return CompletionPlan(shape=shape, shell=shell, captured=len(cameras), context=chosen, rounds=rounds, size=size)


def run_inpainting(
    plan: CompletionPlan,
    context: Sequence[CapturedView],
    model: Inpainter,
    config: CompletionConfig,
    *,
    done: CompletedViews | None = None,
    on_step: Callable[[PlannedRound, int, int], None] | None = None,
    on_found: Callable[[PlannedRound], None] | None = None,
) -> Iterator[CompletedViews]:
    """Inpaint the planned pictures in one sequence; yields their copies at the capture's own sizes.

    Known pixels are the capture's, bit for bit (at 8 bits); generated ones are scaled up from the model's size and
    shifted smoothly in colour so that they meet the known ones. A copy supervises what was unknown and the dilated rim
    (``generated_pixels`` "all": the whole picture). Pictures without a hole help the model and are not returned:
    training knows them already. Where pictures differ in size the smaller copies are padded to the right and below with
    pixels that supervise nothing.

    Args:
        plan: of :func:`plan_inpainting`.
        context: the captured views ``plan.context``, in that order, at full size.
        model: the diffusion model or a 2D inpainter.
        config: options of sampling and of the masks.
        done: views of an interrupted run; where there are any nothing is left to do.
        on_step: called with (round, steps done, steps in all).
        on_found: called with a round that is loaded from the cache.

    Raises ValueError when nothing is unknown or nothing is known in the chosen pictures, and as the model does.
    """
    if done is not None and len(done):
        return
    (planned,) = plan.rounds
    known_parts, fitted = [], []
    for view in context:  # pictures are large: one at a time
        given = _dilated(view.known, config.masked.dilate)
        known_parts.append(
            _Told(
                whole=bool((given == 1).all()),
                nothing=not bool((given == 1).any()),
                size=(given.shape[1], given.shape[2]),
            )
        )
        fitted.append(fitted_view(dataclasses.replace(view, known=given), plan.size))
    _refuse_nothing_to_do(known_parts)
    maker = RoundMaker(model=model, config=config, cache=open_cache(config), on_step=on_step, on_found=on_found)
    squares = maker.samples(Views.cat(fitted), planned).images
    origin = Origin(
        role=planned.role, round=planned.number, seed=planned.seed, prompt=planned.prompt, model_hash=model.model_hash
    )
    largest = max(one.size[0] for one in known_parts), max(one.size[1] for one in known_parts)
    copies = []
    for place in (place for place, one in enumerate(known_parts) if not one.whole):
        view = context[place]
        image = pasted(view, squares[place].permute(2, 0, 1).float() / 255)
        supervised = _dilated(view.known, config.masked.dilate) < 1
        mask = supervised if config.generated_pixels == "unseen" else torch.ones_like(supervised)
        copies.append(_copy(image, mask, view.camera, origin, largest))
    yield CompletedViews.cat(copies)


@dataclass(frozen=True, kw_only=True)
class _Told:
    """What the model is told of a picture."""

    whole: bool
    nothing: bool
    size: tuple[int, int]


def pasted(view: CapturedView, square: Float[Tensor, "3 s s"]) -> Float[Tensor, "3 h w"]:
    """A captured picture with its unknown pixels taken from what was generated for :func:`fitted_view` of it.

    The generated part is cut out of the square, scaled to the picture, and its colours are shifted smoothly to meet the
    known pixels.
    """
    _, height, width = view.image.shape
    content = SquareFit.of(height, width, square.shape[-1]).cut(square)[None]
    generated = F.interpolate(content, size=(height, width), mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 1
    )
    known = view.known > 0.5
    image = torch.where(known, view.image, torch.zeros_like(view.image)).to(generated)
    return torch.where(known, image, without_seams(generated, image[None], known)[0])


def announcement_of_inpainting(plan: CompletionPlan, config: CompletionConfig, model: Inpainter) -> str:
    """One sentence on what is about to be inpainted."""
    asked = (
        ""
        if len(plan.context) >= config.masked.views
        else f" (asked for {config.masked.views}; the capture has no more)"
    )
    sampling = config.sampling(model.recommended_sampling)
    how = (
        "without diffusion"
        if isinstance(model, Named) and model.weight_free
        else f"in one pass of {sampling.steps} steps"
    )
    windows = "" if sampling.window is None else f" in windows of {sampling.window} views"
    rim = f", holes grown by {config.masked.dilate} pixels" if config.masked.dilate else ""
    return (
        f"Inpainting {len(plan.context)} equally spaced of {plan.captured} captured views{asked} with "
        f"{model_name(config, model)} "
        f"({model.model_hash[:8]}) {how}{windows} at {plan.size}x{plan.size} pixels{rim}"
        f"{expectation([(0, len(plan.context))], plan.size, config, model)}."
    )


def _dilated(known: Float[Tensor, "1 h w"], pixels: int) -> Float[Tensor, "1 h w"]:
    """1 where the model is told what is there: known, and farther than ``pixels`` from what is not."""
    return grow_hole((known > 0.5).float()[None], pixels=pixels)[0]


def _refuse_nothing_to_do(told: Sequence[_Told]) -> None:
    pictures = f"the {len(told)} pictures that were chosen have" if len(told) > 1 else "the only picture has"
    if all(one.whole for one in told):
        raise ValueError(
            f"completion.task inpaint: {pictures} no unknown pixels; give masks that are black where something is to "
            "be inpainted, "
            "or complete the scene with new views (ns-train fillerbuster)"
        )
    if all(one.nothing for one in told):
        raise ValueError(
            f"completion.task inpaint: {pictures} no known pixels (beyond the dilated rim); masks are white where "
            "pixels are known and "
            "black where they are to be inpainted"
        )


def _fitted_camera(camera: Pinholes, size: int) -> Pinholes:
    return SquareFit.of(camera.height, camera.width, size).camera(camera)


def _copy(
    image: Tensor, mask: Bool[Tensor, "1 h w"], camera: Pinholes, origin: Origin, size: tuple[int, int]
) -> CompletedViews:
    """One view for the bank, padded to ``size`` with pixels that supervise nothing."""
    pads = (0, size[1] - image.shape[2], 0, size[0] - image.shape[1])
    stored = (F.pad(image, pads).clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0)
    return CompletedViews(
        images=stored[None].contiguous(),
        masks=F.pad(mask, pads).permute(1, 2, 0)[None].contiguous(),
        cameras=camera.to("cpu", torch.float32).cropped(0, 0, size[1], size[0]),
        origins=(origin,),
    )
