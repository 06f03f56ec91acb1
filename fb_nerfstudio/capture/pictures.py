"""The capture's pictures and masks as nerfstudio's dataset, read by this project's one reader (`fb_core.data.media`).

nerfstudio reads with Pillow and takes stored numbers for colours: palette entries for grey, 16-bit values modulo 256,
black for alpha in printers' colours, and every mask value but 0 for known. Here a picture is the same wherever it is
looked at.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.undistort import undistort
from fb_core.geometry.cameras import Pinholes

WIDE_LENSES = "wide_lenses"
"""Key of the dataparser's metadata: lenses that are straightened while pictures are read, by the names of these."""
WideLens = tuple[Pinholes, str, dict[str, float]]
"""Camera of the bent picture, model, coefficients."""


def straightened_picture(pixels: Tensor, known: Tensor, lens: WideLens) -> tuple[Tensor, Tensor]:
    """A picture [3, h, w] and its mask [1, h, w] from a lens that is too wide for nerfstudio, straight."""
    camera, model, distortion = lens
    image, mask, _ = undistort(pixels, known, camera.scaled(pixels.shape[2], pixels.shape[1]), model, distortion)
    return image, mask


SMALLER_BY = "pictures_smaller_by"
"""In a dataparser's metadata: of each picture the factor by which it is to be read smaller."""


class CapturePictures(InputDataset):
    """Pictures of 8 bits (RGB, or RGBA where the file has alpha) and masks of a capture, scaled as nerfstudio scales
    them.

    Smaller copies that were asked for and are not there are made in memory.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # nerfstudio takes names out of this list; its own is shared by all datasets of a process
        self.exclude_batch_keys_from_device = list(self.exclude_batch_keys_from_device)

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        """[h, w, 3 or 4] of the camera's size. Raises ValueError in one sentence for a file that cannot be read."""
        path = self._dataparser_outputs.image_filenames[image_idx]
        pixels, alpha = media.read_photo(path, apply_orientation=self._turned(image_idx))
        if str(path) in self._too_wide:
            pixels, alpha = self._straightened(image_idx, pixels, alpha)
        channels = pixels if alpha is None else torch.cat([pixels, alpha])
        picture = Image.fromarray((channels.clamp(0, 1) * 255).round().to(torch.uint8).movedim(0, -1).numpy())
        smaller = self._smaller_by(image_idx)
        if self.scale_factor != 1.0 or smaller != 1:
            width, height = (int(side // smaller * self.scale_factor) for side in picture.size)
            picture = picture.resize((width, height), resample=Image.Resampling.BILINEAR)
        return np.array(picture, dtype=np.uint8)

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """As in nerfstudio; ``mask`` is True where the mask is lighter than half, at the picture's size.

        Called by several threads at once.
        """
        image = self.get_image_float32(image_idx) if image_type == "float32" else self.get_image_uint8(image_idx)
        data: dict[str, Any] = {"image_idx": image_idx, "image": image}
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None and str(self._dataparser_outputs.image_filenames[image_idx]) not in self._too_wide:
            known = media.read_mask(masks[image_idx], apply_orientation=self._turned(image_idx))[0]
            picture = Image.fromarray((known.numpy() * 255).astype(np.uint8))
            if picture.size != (image.shape[1], image.shape[0]):
                picture = picture.resize((image.shape[1], image.shape[0]), resample=Image.Resampling.NEAREST)
            data["mask"] = torch.from_numpy(np.array(picture))[..., None] > 0
            if self.mask_color:
                shade = torch.tensor(self.mask_color) * (255 if image.dtype == torch.uint8 else 1)
                data["image"] = torch.where(data["mask"], image, shade.to(image.dtype))
        return data | self.get_metadata(data)

    @property
    def _too_wide(self) -> dict[str, WideLens]:
        """Lenses, by the names of their pictures, that this dataset straightens itself, for nerfstudio cannot."""
        return self._dataparser_outputs.metadata.get(WIDE_LENSES, {})

    def _straightened(self, image_idx: int, pixels: Tensor, alpha: Tensor | None) -> tuple[Tensor, Tensor]:
        """The straight picture, and what of it is known, mask included, as its alpha."""
        known = torch.ones_like(pixels[:1]) if alpha is None else (alpha >= 0.5).to(pixels)
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None:
            mask = media.read_mask(masks[image_idx], apply_orientation=self._turned(image_idx))
            known = known * F.interpolate(mask[None], size=pixels.shape[1:])[0]
        lens = self._too_wide[str(self._dataparser_outputs.image_filenames[image_idx])]
        return straightened_picture(pixels, known, lens)

    def _turned(self, image_idx: int) -> bool:
        """Whether picture and mask are turned as the picture's EXIF tag says."""
        camera = self._dataparser_outputs.cameras[image_idx]
        size = int(camera.height), int(camera.width)
        return media.fits_only_upright(
            self._dataparser_outputs.image_filenames[image_idx], size, smaller_by=self._smaller_by(image_idx)
        )

    def _smaller_by(self, image_idx: int) -> float:
        """The factor by which a picture of full size is read smaller; 1 for a copy that is small already."""
        factors = self.metadata.get(SMALLER_BY)
        return 1 if factors is None else factors[image_idx]
