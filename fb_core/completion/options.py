"""Options of completing a capture: what is generated, from where, and how it takes part in the training."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fb_core.files.limits import MOST_SAMPLING_STEPS, MOST_SIDE, MOST_TRAINING_STEPS, MOST_VIEWS, require_between
from fb_core.machine.precision import Precision
from fb_core.sampling.options import Guess, SamplingConfig

_MOST_SAMPLES = 64
_MOST_ANCHORS = 24  # where the capture decides


@dataclass
class PlacementConfig:
    """Where the cameras of generated views may stand and look."""

    radius: float = 1.0
    """Radius of the anchors' cylinder, in units of the capture's own radius."""
    inner_radius: float = 0.5
    """Densified views fill the cylinder from this radius outwards (same unit)."""
    height: float = 1.0
    """Spread of the cameras' heights, in units of the capture's own."""
    max_pitch_degrees: float = 45.0
    """Steepest look up or down in captures that look outward (rooms)."""
    target_spread: float = 0.7
    """How far from the focus cameras look in captures that look inward (objects), in units of the capture's radius."""
    wider_lens: float = 1.0
    """Where the capture decides, captured cameras with a lens that is so many times wider (a ratio of focal lengths)
    are candidates, too; 1 is none.
    """
    clearance: float = 0.1
    """Least distance from seen geometry, in units of its median distance from the scene's centre; 0 allows any."""


@dataclass
class MaskedConfig:
    """Inpainting the unknown parts of captured pictures (``task`` inpaint)."""

    views: int = 32
    """Captured pictures, equally spaced, that are inpainted together; all when the capture has fewer."""
    dilate: int = 5
    """Pixels of the capture by which holes grow before they are inpainted; masks are seldom exact. The rim keeps its
    captured colours.
    """

    def __post_init__(self) -> None:
        if self.views < 1:
            raise ValueError(f"completion.masked.views: expected at least 1, got {self.views}")
        if self.dilate < 0:
            raise ValueError(f"completion.masked.dilate: expected 0 or more pixels, got {self.dilate}")


@dataclass
class CompletionConfig:
    """What is generated, with which model, and how it takes part in the training."""

    enabled: bool = True
    """Complete the capture with generated views; without, this is plain Gaussian splatting."""
    task: Literal["new-views", "inpaint"] = "new-views"
    """Generate views from new cameras, or fill the unknown parts of captured pictures (masks, alpha) and place no
    camera.
    """
    on_completed_capture: Literal["take", "extend", "ignore"] = "take"
    """A capture that brings generated views along: take these and generate none, generate others beside them, or leave
    them out.
    """
    model: Path | None = None
    """Folder of the diffusion model (config.json and safetensors); None is the small bundled model."""
    inpainter: Literal["diffusion", "grid"] = "diffusion"
    """What fills pixels: the multi-view diffusion model, or a 2D inpainter on 2x2 grids of views (the NeRFiller
    baseline).
    """
    inpainter_weights: Path | None = None
    """Folder of a diffusers inpainting pipeline for the grids; None is OpenCV's inpainting, which has no weights."""
    prompt: str = ""
    """What is to be seen, for models that read text."""
    text_encoder: Path | None = None
    """Folder of the CLIP text model, which a prompt needs."""
    at_step: int = 500
    """Training step before which the views are generated. Splats of some hundred steps tell what is seen, and how far
    it is, better than the cameras alone.
    """
    context_views: int = 16
    """Captured views that the model is conditioned on; fewer when the capture has fewer."""
    context_choice: Literal["spread", "stride", "overlap"] = "spread"
    """Context views that differ most in place and direction, or every so many (the paper's choice); overlap: those for
    the anchors, and for each later round the views that show most of what its cameras will show.
    """
    anchor_views: int | None = None
    """Views generated together in the first round. None: the capture decides how many views it needs and where, in all
    rounds; at most 24 in the first one.
    """
    densify_rounds: int = 3
    """Rounds after the anchors, each conditioned on the context and the anchors."""
    densify_views: int = 24
    """Views generated together in each of these rounds."""
    least_gain: float = 0.003
    """Where the capture decides (`anchor_views` None): share of what it has not seen that a further view must show,
    from 0 to 1.
    """
    least_round_gain: float = 0.02
    """The same, of a whole round after the first, from 0 to 1: where it would show less, there is no further round."""
    rounds_apart: int = 100
    """Where the capture decides: training steps between two rounds, so that the next one is planned by what the splats
    show by then.
    """
    camera_path: Path | None = None
    """Camera path saved in nerfstudio's viewer (Render tab): generate these views, where they are, instead of placing
    cameras.
    """
    film_path: Path | None = None
    """Where the capture decides: a camera path like the former, of a film that is to be made; its views are candidates
    beside others.
    """
    masked: MaskedConfig = field(default_factory=MaskedConfig)
    """Which captured pictures are inpainted."""
    image_size: int | None = None
    """Side of the square views in pixels; None is the size the model was trained at."""
    steps: int | None = None
    """Denoising steps per round; None is what the model's folder recommends (24 where it says nothing). One step
    answers with the mean of what may be there, which only models learn that were trained on pure noise (the bundled
    one).
    """
    samples: int = 1
    """Samples of every generated view, of which in every neighbourhood the one nearest to their mean is taken (from 3
    on; two are equally near). They cost so many times the steps (known views only once) and tell how far they differ.
    """
    guidance_unknown: float | None = None
    """Guidance scale in unknown pixels; None is what the model's folder recommends (the paper's 7 where it says
    nothing).
    """
    guidance_known: float | None = None
    """Guidance scale in known pixels; None is what the model's folder recommends (the paper's 1.1 where it says
    nothing).
    """
    start: Literal["noise", "render", "soft"] = "render"
    """Start generation from noise alone, or, where the splats are opaque (trained for 100 steps at least), from their
    render noised to the time `strength`; soft: where they are half opaque, from half way between. What is asked for in
    the viewer starts from noise: the splats show what it is to replace.
    """
    strength: float = 0.5
    """Time from which on the render may change (``start`` render, soft): towards 0 it stays as it is, 1 is noise."""
    guess: Guess | None = None
    """How the render enters (``start`` render, soft): as the `start` of the sampling at `strength`, `told` to the model
    as a guess, or `both`; None is what the model's folder recommends (start where it says nothing). Only models that
    were trained with guesses understand them.
    """
    precision: Precision = "auto"
    """Of the model's matrix products: auto is bfloat16 where the machine is faster at it, else that of the weights
    (float32).
    """
    window: int | None = None
    """Views denoised together, averaged over random windows, for sequences longer than the model likes; None is all of
    them.
    """
    memory_budget: float | None = None
    """Most memory that a pass of the model may take, weights included, in GiB; None is what the machine has. The work
    is cut to fit.
    """
    cache_dir: Path | None = None
    """Folder where generated rounds are kept and found again by inputs, options, seed and weights; runs may share it.
    None: no cache.
    """
    seed: int = 0
    """Decides cameras, images, and which training steps draw generated views."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """Where the new cameras stand and look."""
    generated_share: float = 0.3
    """Most of the views drawn in training that may be generated ones; where these are fewer than the captured, all are
    drawn equally often.
    """
    generated_steps: Literal["added", "shared"] = "added"
    """Train on generated views beside the captured view of a step, which keep their number of steps, or (the paper)
    instead of it.
    """
    generated_pixels: Literal["all", "unseen"] = "unseen"
    """Train only on the pixels of generated views that the capture has not seen, or on all (the paper); photographs
    know better.
    """
    match_colors: bool = True
    """Shift the colours of generated views smoothly so that they meet the splats' where the capture has seen them."""
    trust: Literal["full", "measured"] = "measured"
    """Count generated views in full, or as far as the model is right about a few captured views that are hidden from it
    first.
    """
    seed_gaussians: bool = True
    """Add Gaussians for generated pixels where the capture has seen nothing."""
    max_seed_gaussians: int = 20000
    """At most this many of them."""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("at_step", 0, MOST_TRAINING_STEPS),
            ("context_views", 1, MOST_VIEWS),
            ("anchor_views", 0, MOST_VIEWS),
            ("densify_rounds", 0, MOST_VIEWS),
            ("densify_views", 0, MOST_VIEWS),
            ("rounds_apart", 0, MOST_TRAINING_STEPS),
            ("steps", 1, MOST_SAMPLING_STEPS),
            ("samples", 1, _MOST_SAMPLES),
            ("window", 1, MOST_VIEWS),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"completion.{name}: expected at least {least}, got {value}")
            require_between(f"completion.{name}", least if value is None else value, least, most)
        new = self.most_anchors + self.densify_rounds * self.densify_views
        require_between("completion: anchor_views and densify_rounds times densify_views together", new, 0, MOST_VIEWS)
        if self.inpainter == "diffusion" and self.inpainter_weights is not None:
            raise ValueError(
                "completion.inpainter_weights: weights of a 2D inpainter need completion.inpainter grid; set it, or "
                "leave them out"
            )
        if self.inpainter == "grid" and self.task != "inpaint":
            raise ValueError(
                "completion.inpainter grid: a 2D inpainter knows no cameras and cannot generate new views; set "
                "completion.task inpaint"
            )
        if self.camera_path is not None and self.task != "new-views":
            raise ValueError(
                "completion.camera_path: inpainting places no camera; set completion.task new-views, or leave the "
                "path out"
            )
        if self.image_size is not None and self.image_size < 16:
            raise ValueError(f"completion.image_size: expected at least 16 pixels, got {self.image_size}")
        require_between("completion.image_size", self.image_size or 16, 16, MOST_SIDE)
        if not 1.0 <= self.placement.wider_lens <= 2.0:
            raise ValueError(
                f"completion.placement.wider_lens: expected a ratio from 1 to 2, got {self.placement.wider_lens}"
            )
        for name in ("least_gain", "least_round_gain"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"completion.{name}: expected a share from 0 to 1, got {getattr(self, name)}")
        if not 0.0 <= self.generated_share <= 1.0:
            raise ValueError(
                f"completion.generated_share: expected a probability from 0 to 1, got {self.generated_share}"
            )
        if not 0.0 < self.strength <= 1.0:
            raise ValueError(f"completion.strength: expected a time above 0 and at most 1, got {self.strength}")
        if self.memory_budget is not None and not self.memory_budget > 0:
            raise ValueError(f"completion.memory_budget: expected a positive number of GiB, got {self.memory_budget}")
        if self.generated_steps == "added" and self.generated_share > 0.5:
            raise ValueError(
                "completion.generated_share: expected at most 0.5, one generated view beside each captured one, got "
                f"{self.generated_share}; more is possible with completion.generated_steps shared"
            )

    @property
    def most_anchors(self) -> int:
        """Views that the first round has at most."""
        return _MOST_ANCHORS if self.anchor_views is None else self.anchor_views

    def sampling(self, recommended: SamplingConfig = SamplingConfig()) -> SamplingConfig:
        """How to sample: these options where they are given, the model's recommendation elsewhere."""
        given = {
            name: getattr(self, name)
            for name in ("steps", "guidance_unknown", "guidance_known", "window", "guess", "precision")
            if getattr(self, name) is not None
        }
        if self.memory_budget is not None:
            given["memory_budget_bytes"] = int(self.memory_budget * 2**30)
        return dataclasses.replace(recommended, **given)
