"""Generated views that a capture brings along (from ``fillerbuster complete`` or ``export``), made ready for a run's
bank.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import BROUGHT, CompletedViews, Origin
from fb_core.data.capture.captures import TRUST_KEY
from fb_core.data.capture.frames import Frame
from fb_core.data.media import read_image, resize
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.square_fit import SquareFit
from fb_core.masks import wholly_known


def takes_brought(config: CompletionConfig) -> bool:
    """Whether a run trains on such views at all; one that inpaints captured pictures has no use for others."""
    return config.enabled and config.task == "new-views" and config.on_completed_capture != "ignore"


def announcement_of_brought(count: int, config: CompletionConfig) -> str:
    """One sentence on what becomes of them."""
    announcement = f"The capture brings {count} generated view{'' if count == 1 else 's'} along"
    if not takes_brought(config):
        return f"{announcement}: left out, only its photos count."
    also = (
        "others are generated beside them"
        if config.on_completed_capture == "extend"
        else "none are generated beside them"
    )
    return (
        f"{announcement}: trained on as such from step {config.at_step} on, never as photos; {also} "
        "(completion.on_completed_capture)."
    )


def brought_views(frames: Sequence[Frame], *, number: int, size: int | None = None) -> CompletedViews:
    """The frames as one round of square views.

    Args:
        frames: at least one, with cameras in the world of the splats.
        number: of the round.
        size: side of the views in pixels; None is the longest side of any frame. Frames of that size stay as they are,
            others are scaled, and padded with pixels that are not trained on.

    Raises ValueError in one sentence for a picture that cannot be read.
    """
    loaded = [frame.load_undistorted() for frame in frames]
    side = size or max(max(image.shape[1:]) for image, _, _ in loaded)
    pictures, cameras = zip(
        *(_fitted(torch.cat([image, mask]), camera, side) for image, mask, camera in loaded), strict=True
    )
    views = torch.stack(pictures)
    trusts = [_trust(frame, side) for frame in frames]
    return CompletedViews(
        images=rearrange((views[:, :3].clamp(0, 1) * 255).round().to(torch.uint8), "n c h w -> n h w c").contiguous(),
        masks=rearrange(views[:, 3:] > 0, "n 1 h w -> n h w 1").contiguous(),
        cameras=Pinholes.cat(list(cameras)),
        origins=tuple(_origin(frame, number) for frame in frames),
        trust=None
        if all(trust is None for trust, _ in trusts)
        else torch.stack([whole if trust is None else trust for trust, whole in trusts]),
    )


def _fitted(
    picture: Float[Tensor, "4 h w"], camera: Pinholes, side: int
) -> tuple[Float[Tensor, "4 side side"], Pinholes]:
    """Colours and mask in the middle of a square; the mask is 0 around them."""
    fit = SquareFit.of(camera.height, camera.width, side)
    scaled = torch.cat(wholly_known(picture[:3], picture[3:], lambda channels: resize(channels, fit.height, fit.width)))
    return fit.framed(scaled), fit.camera(camera.to(torch.float32))


def _trust(frame: Frame, side: int) -> tuple[UInt8[Tensor, "side side 1"] | None, UInt8[Tensor, "side side 1"]]:
    """The trust of each pixel where the frame names a picture of it that can be read, and that of the whole view."""
    whole = torch.full((side, side, 1), round(255 * _origin(frame, 0).trust), dtype=torch.uint8)
    name = frame.extra.get(TRUST_KEY)
    root = frame.image_path.parent.parent
    if (
        not isinstance(name, str)
        or not (root / name).resolve().is_relative_to(root.resolve())
        or not (root / name).is_file()
    ):
        return None, whole
    picture = read_image(root / name)[:1]
    fit = SquareFit.of(picture.shape[1], picture.shape[2], side)
    fitted = fit.framed(resize(picture, fit.height, fit.width).clamp(0, 1))
    return (fitted * 255).round().to(torch.uint8).movedim(0, -1).contiguous(), whole


def _origin(frame: Frame, number: int) -> Origin:
    aspect = frame.camera.width / frame.camera.height
    return Origin.from_record(frame.extra, role=BROUGHT, round_number=number, aspect=aspect)
