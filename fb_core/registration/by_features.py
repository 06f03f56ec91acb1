"""Cameras of photos by their features, expressed in the world of those whose camera is known; photos of bent lenses
straightened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch

from fb_core.data.photos.photo import Photo
from fb_core.data.photos.straight_photos import straightened
from fb_core.geometry.features.chain import FeatureCameras, chain
from fb_core.geometry.features.pairs import ALL_PAIRS, PhotoFeatures, features_of
from fb_core.geometry.similarity import Similarity
from fb_core.machine.parallel import in_order, workers_for
from fb_core.registration.by_raymaps import lens_in_words

LONGEST_SIDE = 1024
"""Pixels at which features are looked for."""
_BYTES_OF_DETECTION = 2.5e8  # of a photo of that side: pyramids of twice its size in float32
_BYTES_PER_PIXEL = 50.0  # of a photo at full size while it is read and shrunk


def recover_with_features(
    photos: Sequence[Photo], *, on_progress: Callable[[str, int, int], None] = lambda *_: None
) -> tuple[FeatureCameras, Similarity | None, dict[int, Photo]]:
    """Cameras of the whole photos, in a world of their own, the way from there to the world of the known cameras,
    straightened photos.

    The way is None where no photo has a known camera, or none of those has a camera by features. One known camera tells
    no scale; then the farthest camera is at distance 1 of the middle, in the unit of the known world. Photos whose lens
    bends are returned straightened, by their number; their cameras are those of the straight photos.
    """
    largest = max((photo.size[0] * photo.size[1] for photo in photos), default=0)
    found = in_order(
        partial(_features_of, coarse=len(photos) > ALL_PAIRS),
        photos,
        workers_for(len(photos), _BYTES_OF_DETECTION + _BYTES_PER_PIXEL * largest),
    )
    features = []
    for number, of_photo in enumerate(found):
        on_progress("looking for features", number, len(photos))
        features.append(of_photo)
    recovered = chain(features, on_progress=on_progress)
    whole = [
        camera if camera is None else camera.scaled(photo.size[1], photo.size[0])
        for camera, photo in zip(recovered.cameras, photos, strict=True)
    ]
    straight = dict[int, Photo]()
    for index, (photo, camera, bend) in enumerate(zip(photos, whole, recovered.bends, strict=True)):
        if camera is not None and any(bend):
            straight[index], whole[index] = straightened(photo, camera, {"k1": bend[0], "k2": bend[1]})
    recovered.cameras[:] = whole
    pairs = [
        (ours, photo.camera)
        for ours, photo in zip(whole, photos, strict=True)
        if ours is not None and photo.camera is not None
    ]
    if not pairs:
        return recovered, None, straight
    placed = torch.cat([camera.centers for camera in whole if camera is not None])
    extent = float((placed - placed.mean(dim=0)).norm(dim=1).max())
    first, second = (
        (torch.cat([c.rotations for c in side]), torch.cat([c.centers for c in side]))
        for side in zip(*pairs, strict=True)
    )
    return recovered, Similarity.between(first, second, scale_of_one_place=1 / extent if extent > 0 else 1.0), straight


def _features_of(photo: Photo, *, coarse: bool) -> PhotoFeatures:
    """Features of a photo that is shrunk to `LONGEST_SIDE`; the picture is not kept."""
    image, mask = photo.load_with_mask(LONGEST_SIDE)
    focal = None if photo.focal_prior is None else photo.focal_prior * (image.shape[2] / photo.size[1])
    lens = {"lens": lens_in_words(photo), "same_lens": bool(photo.device), "posed": photo.camera is not None}
    return features_of(image, mask, focal=focal, coarse=coarse, **lens)
