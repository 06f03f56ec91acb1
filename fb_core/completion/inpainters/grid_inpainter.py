"""The baseline of NeRFiller (Weber et al. 2024): a 2D inpainter that knows no cameras, applied to 2x2 grids of views.

Views side by side in one picture come out alike, which is all the consistency that such a model offers. Here each view
stands in one grid, once. The 2D inpainter is a diffusers pipeline from a local folder, or OpenCV's inpainting, which
has no weights and only continues what surrounds a hole. Offered to a completion as a diffusion model is: the same
``complete``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.data.telea import telea
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views

GRID = 2
"""Views per side of a grid."""
_TELEA_RADIUS = 5  # pixels around a hole's border that OpenCV looks at
_CELL_SIZE = 256  # a grid is 512 pixels wide, the size that Stable Diffusion 2 inpaints at
_STEPS, _GUIDANCE = 20, 7.5  # customary for diffusers' inpainting pipelines
_logger = logging.getLogger(__name__)


@runtime_checkable
class PictureInpainter(Protocol):
    """What fills one picture."""

    name: str
    model_hash: str
    weight_free: bool

    def fill(
        self,
        image: Float[Tensor, "3 h w"],
        known: Float[Tensor, "1 h w"],
        *,
        seed: int,
        sampling: SamplingConfig,
        prompt: str,
    ) -> Float[Tensor, "3 h w"]:
        """The picture in [0, 1] with its unknown pixels (``known`` is 0 there) filled in."""
        ...


class GridInpainter:
    """Fills views by filling 2x2 grids of them, in an order of its own."""

    size = _CELL_SIZE

    def __init__(self, inpainter: PictureInpainter):
        self.inpainter = inpainter
        self.name = f"{inpainter.name} on {GRID}x{GRID} grids of views"
        self.weight_free = inpainter.weight_free
        self.model_hash = hashlib.sha256(f"grid {GRID} {inpainter.model_hash}".encode()).hexdigest()

    @staticmethod
    def of(weights: Path | None, device: torch.device | str) -> GridInpainter:
        """With diffusers' pipeline in a folder, or without weights. Raises ValueError with a sentence when the folder
        cannot be used.
        """
        return GridInpainter(OpenCvInpainter() if weights is None else DiffusersInpainter(weights, device))

    @property
    def recommended_sampling(self) -> SamplingConfig:
        """Steps and scale for diffusers; OpenCV has neither."""
        return SamplingConfig(steps=_STEPS, guidance_unknown=_GUIDANCE)

    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig,
        on_step: Callable[[int, int], None] | None = None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> Views:
        """Fill all unknown pixels; known ones are returned as given. Rays are taken as known, for nothing here looks at
        them.

        Args:
            views: any number; those without a hole stay out of the grids. The last grid is filled up with views that
                are done already (with the same ones again where there are fewer than four).
            generator: shuffles the views into grids and seeds the pictures.
            sampling: ``steps`` and ``guidance_unknown`` go to diffusers.
            on_step: called with (grids done, grids in all).
            prompt: for pipelines that read text.
            current: not looked at; 2D inpainters start from noise.
        """
        images = torch.where(views.image_known > 0, views.images, torch.zeros_like(views.images)).cpu().float()
        known = views.image_known.cpu().float().clone()
        grids = grids_of((known < 1).flatten(1).any(dim=1).nonzero()[:, 0], generator)
        for number, cells in enumerate(grids):
            seed = int(torch.randint(0, 2**31, (), generator=generator))
            picture, mask = _joined(images[cells]), _joined((known[cells] == 1).float())
            filled = self.inpainter.fill(picture, mask, seed=seed, sampling=sampling, prompt=prompt or "")
            for cell, content in zip(cells, _cut(filled), strict=True):
                images[cell] = known[cell] * images[cell] + (1 - known[cell]) * content.clamp(0, 1)
                known[cell] = 1.0
            if on_step is not None:
                on_step(number + 1, len(grids))
        ones = torch.ones_like(views.image_known)
        return dataclasses.replace(views, images=images.to(views.images), image_known=ones, rays_known=ones)


class OpenCvInpainter:
    """OpenCV's inpainting by fast marching (Telea 2004): no weights, nothing is imagined."""

    name = "a weight-free 2D inpainter (OpenCV, Telea)"
    model_hash = hashlib.sha256(f"opencv telea {_TELEA_RADIUS}".encode()).hexdigest()
    weight_free = True

    def fill(
        self,
        image: Float[Tensor, "3 h w"],
        known: Float[Tensor, "1 h w"],
        *,
        seed: int,
        sampling: SamplingConfig,
        prompt: str,
    ) -> Float[Tensor, "3 h w"]:
        """The picture with its unknown pixels continued from the known ones; mid-grey where nothing is known."""
        if not bool((known > 0).any()):
            return torch.full_like(image, 0.5)
        return telea(image, known[0] >= 1, radius=_TELEA_RADIUS)


class DiffusersInpainter:
    """A pipeline of diffusers (Stable Diffusion and its kin) from a local folder; nothing is ever downloaded."""

    weight_free = False

    def __init__(self, folder: Path, device: torch.device | str):
        """Raises ValueError with one sentence when diffusers is not installed or the folder holds no pipeline that it
        can load.
        """
        self.name = f"diffusers' pipeline {folder.name}"
        self._pipeline = _load_pipeline(folder, torch.device(device))
        self.model_hash = _hash_of(folder)

    def fill(
        self,
        image: Float[Tensor, "3 h w"],
        known: Float[Tensor, "1 h w"],
        *,
        seed: int,
        sampling: SamplingConfig,
        prompt: str,
    ) -> Float[Tensor, "3 h w"]:
        """The pipeline's answer at the picture's size; what it makes of known pixels is returned too."""
        answer = self._pipeline(
            prompt=prompt,
            image=image[None],
            mask_image=1 - known[None],
            height=image.shape[1],
            width=image.shape[2],
            num_inference_steps=sampling.steps,
            guidance_scale=sampling.guidance_unknown,
            generator=torch.Generator().manual_seed(seed),
            output_type="pt",
        )
        return answer.images[0].float().cpu()


def check_weights(folder: Path) -> None:
    """Raises ValueError with one sentence when the folder holds no pipeline of diffusers, or diffusers is not
    installed.
    """
    option = f"completion.inpainter_weights {folder}"
    if not (folder / "model_index.json").is_file():
        raise ValueError(
            f"{option}: no model_index.json there; give the folder of a downloaded diffusers inpainting pipeline"
        )
    try:
        import diffusers  # noqa: F401 # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            f"{option}: diffusers is not installed; pip install 'fillerbuster[baselines]', or leave the option out "
            "for OpenCV's inpainting"
        ) from None


def grids_of(views: Tensor, generator: torch.Generator) -> list[list[int]]:
    """The views in random order, four at a time; the last group is filled up from the order's beginning, around and
    around.
    """
    order = views[torch.randperm(len(views), generator=generator)].tolist()
    cells = GRID * GRID
    return [[order[(first + offset) % len(order)] for offset in range(cells)] for first in range(0, len(order), cells)]


def _joined(views: Float[Tensor, "n c h w"]) -> Float[Tensor, "c h2 w2"]:
    return rearrange(views, "(rows columns) c h w -> c (rows h) (columns w)", rows=GRID)


def _cut(picture: Float[Tensor, "c h2 w2"]) -> Float[Tensor, "n c h w"]:
    return rearrange(picture, "c (rows h) (columns w) -> (rows columns) c h w", rows=GRID, columns=GRID)


def _load_pipeline(folder: Path, device: torch.device) -> Any:
    check_weights(folder)
    from diffusers import AutoPipelineForInpainting  # pyright: ignore[reportMissingImports]

    dtype = torch.float16 if device.type == "cuda" else torch.float32
    unsafe = (
        {"safety_checker": None}
        if "safety_checker" in (folder / "model_index.json").read_text(encoding="utf-8")
        else {}
    )
    try:  # safetensors alone: other weight files may run code while they are read
        pipeline = AutoPipelineForInpainting.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, torch_dtype=dtype, **unsafe
        )
    except (OSError, ValueError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"completion.inpainter_weights {folder}: diffusers cannot load it ({first})") from None
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(device)


def _hash_of(folder: Path) -> str:
    """SHA-256 over names and contents of the pipeline's weights and options."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.suffix in (".safetensors", ".json")):
        digest.update(str(path.relative_to(folder)).encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
