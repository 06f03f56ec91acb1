"""The capture as a full-image datamanager: alpha as part of the masks, an order of draws that resumes, pictures for the
diffusion model.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.data.datasets.base_dataset import InputDataset

from fb_core.completion.rounds import CapturedView
from fb_core.geometry.cameras import Pinholes
from fb_core.masks import WHOLLY
from fb_nerfstudio.bridge import batch_image, batch_known, to_pinhole_list
from fb_nerfstudio.capture.pictures import CapturePictures
from fb_nerfstudio.capture.unseen import coarse_mask


@contextmanager
def _known_as_alpha(dataset: InputDataset) -> Iterator[None]:
    """Meanwhile pictures of a dataset that have alpha, or a mask and a lens that bends, tell by alpha alone what is
    known.

    So whatever resamples a picture resamples its mask alike. What stands in unknown pixels of a bent picture is black
    then.
    """
    read = dataset.get_data

    def get_data(image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        data = read(image_idx, image_type)
        lens, image = dataset.cameras[image_idx].distortion_params, data["image"]
        bent = lens is not None and bool((lens != 0).any())
        if image.shape[-1] != 4 and not (bent and "mask" in data):
            return data
        known = batch_known(data).movedim(0, -1) >= 0.5
        data.pop("mask", None)
        rgb = image[..., :3] * known if bent else image[..., :3]
        alpha = known.to(image.dtype) * (255 if image.dtype == torch.uint8 else 1)
        return data | {"image": torch.cat([rgb, alpha], dim=-1)}

    dataset.get_data = get_data
    try:
        yield
    finally:
        del dataset.get_data


class CapturedViewsDatamanager(FullImageDatamanager[CapturePictures]):
    """Captured views as in nerfstudio, whose sequence of draws is decided by how many there have been."""

    captured_draws = 0
    """Captured views that training has drawn so far."""
    _epoch: tuple[int, list[int]] = (-1, [])

    def next_captured(self, step: int) -> tuple[Cameras, dict]:
        """A captured view: every one once per epoch, in an order of the epoch's own, so that a resumed run goes on
        where it was.
        """
        if self.config.train_cameras_sampling_strategy != "random":
            return super().next_train(step)
        _ = self.cached_train  # loads images on first use, and with them train_cameras
        epoch, place = divmod(self.captured_draws, len(self.train_dataset))
        if self._epoch[0] != epoch:
            order = list(range(len(self.train_dataset)))
            random.Random(self.config.train_cameras_sampling_seed * 1_000_003 + epoch).shuffle(order)
            self._epoch = (epoch, order)
        self.captured_draws += 1
        return self._captured_batch(self._epoch[1][place])

    def _captured_batch(self, index: int) -> tuple[Cameras, dict]:
        data: dict[str, Any] = self.cached_train[index].copy()
        data["image"] = data["image"].to(self.device)
        camera = self.train_cameras[index : index + 1].to(self.device)
        camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
        return camera, data

    def _load_images(
        self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]
    ) -> list[dict[str, torch.Tensor]]:
        """As in nerfstudio, but alpha becomes part of the mask (transparent is unknown), for training, evaluation and
        context alike.

        Where a lens is undistorted, pixels that unknown ones were mixed into are unknown too; nerfstudio calls them
        known. Without CUDA images stay in ordinary memory, where nerfstudio would pin them and crash.
        """
        if cache_images_device == "cpu" and torch.device(self.device).type != "cuda":
            cache_images_device = "gpu"  # means "on self.device"
        with _known_as_alpha(self.train_dataset if split == "train" else self.eval_dataset):
            loaded = super()._load_images(split, cache_images_device)
        for data in loaded:
            if data["image"].shape[-1] == 4:
                data["mask"] = batch_known(data).movedim(0, -1) >= WHOLLY
                data["image"] = data["image"][..., :3].contiguous()
        return loaded

    def captured_cameras(self) -> list[Pinholes]:
        """Of all captured views, on the CPU."""
        _ = self.cached_train  # undistortion changes the cameras, so it must come first
        return [camera.to("cpu") for camera in to_pinhole_list(self.train_cameras)]

    def captured_view(self, index: int, camera: Pinholes) -> CapturedView:
        """One picture, on the CPU, with its camera."""
        data = self.cached_train[index]
        return CapturedView(image=batch_image(data, "cpu"), known=batch_known(data, "cpu"), camera=camera)

    @cached_property
    def known_parts(self) -> list[torch.Tensor | None]:
        """Of each captured picture a small mask of what is known there, None where all is."""
        return [coarse_mask(batch_known(data, "cpu")) if "mask" in data else None for data in self.cached_train]
