"""The diffusion model, loaded when it is first asked to complete something: rounds from the cache need only its
name. Its rounds share what they show the networks alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from fb_core import checkpoint
from fb_core.completion.duration import SquareSequence, seconds_of
from fb_core.inpainter import BUNDLED_MODEL, Fillerbuster, SamplingConfig
from fb_core.memory import budget as memory
from fb_core.networks.shared_results import LIMIT_BYTES, SharedResults
from fb_core.views import Views


class LazyInpainter:
    """What a completion needs of ``Fillerbuster``. Size, options and hash come from the folder, weights only when they
    must work.
    """

    def __init__(self, folder: Path | None, device: torch.device | str, *, text_encoder: Path | None = None):
        """``folder`` None is the bundled model. Raises ValueError for a folder that is no model."""
        self._folder, self._device, self._text_encoder = folder, device, text_encoder
        self._model: Fillerbuster | None = None
        path = BUNDLED_MODEL if folder is None else folder
        self._config, self._info = checkpoint.read_config(path)
        self.model_hash = checkpoint.model_hash(path)

    @property
    def size(self) -> int:
        """Image side in pixels that the model was trained at."""
        return checkpoint.image_size_of(self._info)

    @property
    def recommended_sampling(self) -> SamplingConfig:
        """How the model samples best."""
        return SamplingConfig.from_dict(self._info.get("sampling", {}))

    @property
    def loaded(self) -> bool:
        """Whether the weights have been needed so far."""
        return self._model is not None

    def expected(
        self, *, views: int, known: int, size: int, sampling: SamplingConfig, prompted: bool = False
    ) -> tuple[float, int]:
        """About how many seconds, and at most how many bytes, completing square views will take, ``known`` of which
        need no decoding.

        No weights are loaded to tell. Raises ValueError when the memory budget does not suffice.
        """
        device, dtype = torch.device(self._device), torch.float32
        needed = memory.estimate(views, (size, size), dtype, model=self._config, sampling=sampling, prompted=prompted)
        needed = needed.beside(LIMIT_BYTES, sampling.memory_budget_bytes)
        sequence = SquareSequence(views=views, known=known, side=size)
        return seconds_of(self._config, device, dtype, sequence, sampling), needed.peak

    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig,
        on_step: Callable[[int, int], None] | None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> Views:
        """``Fillerbuster.complete``; the first call loads the weights. Raises ValueError when they are broken."""
        return self._loaded().complete(
            views, generator=generator, sampling=sampling, on_step=on_step, prompt=prompt, current=current
        )

    def complete_often(
        self,
        views: Views,
        *,
        generators: Sequence[torch.Generator],
        sampling: SamplingConfig,
        on_step: Callable[[int, int], None] | None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> list[Views]:
        """``Fillerbuster.complete_often``; the first call loads the weights. Raises ValueError when they are broken."""
        return self._loaded().complete_often(
            views, generators=generators, sampling=sampling, on_step=on_step, prompt=prompt, current=current
        )

    def _loaded(self) -> Fillerbuster:
        if self._model is None:
            self._model = Fillerbuster.from_pretrained(
                self._folder, device=self._device, text_encoder=self._text_encoder
            )
            self._model.shared = SharedResults()
        return self._model
