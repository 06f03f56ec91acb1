"""Generated views with their cameras and where they came from: what a checkpoint stores and training draws from."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from fb_core.data.capture.captures import FrameToWrite, write_capture
from fb_core.data.capture.frames import Capture
from fb_core.files.ownership import Target
from fb_core.geometry.cameras import Pinholes

ANCHOR, DENSIFY, REQUESTED, INPAINTED, BROUGHT = "anchor", "densify", "requested", "inpainted", "brought"
FLY_THROUGH = "fly-through"
UNSAMPLED = 255
"""Deviation of a single sample, which nobody knows."""
_STATE_VERSION = 1


def round_title(role: str, number: int) -> str:
    """What a person reads for a round."""
    titles = {ANCHOR: "Anchors", INPAINTED: "Inpainted", REQUESTED: f"Requested {number}", BROUGHT: "From the capture"}
    return titles.get(role, f"Round {number}")


def views_target(folder: Path, *, inputs: tuple[Path, ...] = ()) -> Target:
    """Where a run keeps its generated views as a capture; earlier ones there are replaced."""
    return Target(folder=folder, kind="generated views", overwrite=True, inputs=inputs)


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where one generated view came from: enough to generate it again."""

    role: str
    """``anchor`` (conditioned on the capture), ``densify`` or ``requested`` in the viewer (both on the capture and the
    anchors),
    ``inpainted``: a captured picture with its unknown pixels filled, ``brought`` along by the capture, or
    ``fly-through``: a picture of a film.
    """
    round: int
    """Pass of the diffusion model, counted from 0; the views of one pass were generated together."""
    seed: int
    """Seed of that pass."""
    prompt: str
    """Text the pass was conditioned on; empty without one."""
    model_hash: str
    """Content hash of the diffusion weights."""
    aspect: float = 1.0
    """Width over height of the part of the square view that may be trained on; the rest is margin."""
    trust: float = 1.0
    """How far the view is believed, from 0 to 1: its loss counts so much of a photo's, and it is drawn so much more
    seldom.
    """

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", self.role) or not isinstance(
            self.round, int
        ):  # files are named after them
            raise ValueError(
                f"Origin: expected a role of letters and the number of a round, got {self.role[:40]!r} and "
                f"{self.round!r}"
            )
        if not 0 <= self.trust <= 1:
            raise ValueError(f"Origin: expected a trust from 0 to 1, got {self.trust}")

    def record(self) -> dict[str, Any]:
        """What a capture's frame says of where it came from; every capture that is written says it so."""
        return {"generated": True, **dataclasses.asdict(self)}

    @staticmethod
    def from_record(record: Mapping[str, Any], *, role: str, round_number: int, aspect: float) -> Origin:
        """What a frame says, as far as it does and as it makes sense; others may have written it. ``aspect`` is taken
        where it names none.
        """
        seed, own_aspect, trust = record.get("seed"), record.get("aspect"), record.get("trust")
        return Origin(
            role=role,
            round=round_number,
            seed=seed if isinstance(seed, int) else 0,
            prompt=str(record.get("prompt") or ""),
            model_hash=str(record.get("model_hash") or ""),
            aspect=float(own_aspect) if isinstance(own_aspect, int | float) else aspect,
            trust=float(trust) if isinstance(trust, int | float) and 0 <= trust <= 1 else 1.0,
        )


@dataclass(frozen=True, kw_only=True)
class CompletedViews:
    """``n`` generated views of one size, in the world of the splats."""

    images: UInt8[Tensor, "n h w 3"]
    """RGB, 8 bits."""
    masks: Bool[Tensor, "n h w 1"]
    """True where the pixel supervises the splats."""
    cameras: Pinholes
    """OpenCV axes; the images' size."""
    origins: tuple[Origin, ...]
    """One for each view."""
    trust: UInt8[Tensor, "n h w 1"] | None = None
    """How far each pixel is believed, 255 wholly (:mod:`fb_core.completion.pixel_trust`); None where only the whole
    view's trust is known.
    """
    deviation: UInt8[Tensor, "n h w 1"] | None = None
    """Standard deviation over several samples: 254 is 1 or more, 255 of a single one. None where all are single."""

    def __post_init__(self) -> None:
        count, height, width, _ = self.images.shape
        sizes = {
            "masks": tuple(self.masks.shape[:3]),
            "cameras": (len(self.cameras), self.cameras.height, self.cameras.width),
        }
        sizes["origins"] = (len(self.origins), height, width)
        sizes |= {
            name: tuple(one.shape[:3])
            for name, one in (("trust", self.trust), ("deviation", self.deviation))
            if one is not None
        }
        for name, got in sizes.items():
            if got != (count, height, width):
                raise ValueError(
                    f"CompletedViews: expected {name} for {(count, height, width)} like the images, got {got}"
                )

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: Sequence[int]) -> CompletedViews:
        """The chosen views."""
        index = list(index)
        return CompletedViews(
            images=self.images[index],
            masks=self.masks[index],
            cameras=self.cameras[index],
            origins=tuple(self.origins[i] for i in index),
            trust=None if self.trust is None else self.trust[index],
            deviation=None if self.deviation is None else self.deviation[index],
        )

    @property
    def pixel_trust(self) -> UInt8[Tensor, "n h w 1"]:
        """The trust of every pixel, that of the whole view where no other is known."""
        if self.trust is not None:
            return self.trust
        each = torch.tensor([round(255 * origin.trust) for origin in self.origins], dtype=torch.uint8)
        return each[:, None, None, None].expand(self.masks.shape).to(self.masks.device).contiguous()

    def believed(self, trust: float | None) -> CompletedViews:
        """The same views, each believed so far in all its pixels; None leaves them as they are."""
        if trust is None:
            return self
        return dataclasses.replace(
            self, trust=None, origins=tuple(dataclasses.replace(origin, trust=trust) for origin in self.origins)
        )

    @property
    def rounds(self) -> list[int]:
        """The passes that have views, ascending."""
        return sorted({origin.round for origin in self.origins})

    def of_round(self, number: int) -> CompletedViews:
        """The views that were generated together in one pass."""
        return self[[index for index, origin in enumerate(self.origins) if origin.round == number]]

    @staticmethod
    def cat(groups: Sequence[CompletedViews]) -> CompletedViews:
        """All views. Raises ValueError when the sizes differ."""
        known = any(group.trust is not None for group in groups)
        sampled = any(group.deviation is not None for group in groups)
        each = [
            torch.full_like(group.masks, UNSAMPLED, dtype=torch.uint8) if group.deviation is None else group.deviation
            for group in groups
        ]
        return CompletedViews(
            cameras=Pinholes.cat([group.cameras for group in groups]),
            images=torch.cat([group.images for group in groups]),
            masks=torch.cat([group.masks for group in groups]),
            origins=tuple(origin for group in groups for origin in group.origins),
            trust=torch.cat([group.pixel_trust for group in groups]) if known else None,
            deviation=torch.cat(each) if sampled else None,
        )

    def state(self) -> dict[str, Any]:
        """The views as tensors, numbers and strings alone, so that a checkpoint loads with ``weights_only=True``."""
        return {
            "version": _STATE_VERSION,
            "images": self.images.cpu(),
            "masks": self.masks.cpu(),
            "trust": None if self.trust is None else self.trust.cpu(),
            "deviation": None if self.deviation is None else self.deviation.cpu(),
            "camera_to_world": self.cameras.camera_to_world.cpu(),
            "focal": self.cameras.focal.cpu(),
            "principal": self.cameras.principal.cpu(),
            "width": self.cameras.width,
            "height": self.cameras.height,
            "origins": [dataclasses.asdict(origin) for origin in self.origins],
        }

    @staticmethod
    def from_state(state: dict[str, Any]) -> CompletedViews:
        """The exact inverse of :meth:`state`. Raises ValueError for a state of a newer version."""
        if state["version"] != _STATE_VERSION:
            raise ValueError(
                f"completed views: this version reads state version {_STATE_VERSION}, got {state['version']}; update "
                "fillerbuster"
            )
        cameras = Pinholes(
            camera_to_world=state["camera_to_world"],
            focal=state["focal"],
            principal=state["principal"],
            width=state["width"],
            height=state["height"],
        )
        origins = tuple(Origin(**origin) for origin in state["origins"])
        return CompletedViews(
            images=state["images"],
            masks=state["masks"],
            cameras=cameras,
            origins=origins,
            trust=state.get("trust"),  # runs of earlier versions have neither
            deviation=state.get("deviation"),
        )

    def save_capture(self, folder: Path | Target) -> Capture:
        """Write the views as a capture folder (transforms.json, images, masks where they are not whole), replacing an
        earlier one.

        Poses are in the world of the splats, so ``orientation_override`` keeps nerfstudio's reader from turning them.
        Each frame says that it was generated, and how. The folder appears whole or not at all. Raises ValueError for a
        folder of others.
        """
        target = folder if isinstance(folder, Target) else views_target(folder)
        images = self.images.cpu().permute(0, 3, 1, 2).float() / 255
        masks = self.masks.cpu().permute(0, 3, 1, 2).float()
        trust = None if self.trust is None else self.trust.cpu().permute(0, 3, 1, 2).float() / 255
        cameras = self.cameras.to("cpu", torch.float64)
        whole = bool(self.masks.all())
        frames = [
            FrameToWrite(
                name=f"{origin.role}_{origin.round:02d}_{index:04d}",
                image=images[index],
                mask=None if whole else masks[index],
                trust=None if trust is None else trust[index],
                camera=cameras[index],
                extra=origin.record(),
            )
            for index, origin in enumerate(self.origins)
        ]
        return write_capture(target, frames, extra={"orientation_override": "none"})
