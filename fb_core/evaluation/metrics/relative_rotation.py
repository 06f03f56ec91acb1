"""Relative rotation accuracy (RRA): do the pictures of a film turn as its cameras do? (paper, section 4 and appendix)

From correspondences of two frames their relative rotation follows, by the essential matrix or, where the camera hardly
moved, by a rotation alone. Its error against the cameras that the frames were rendered with tells whether the frames
show one rigid scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.evaluation.metrics.correspondences import Correspondences, Matcher, enlargement
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.two_view_rotation import two_view_rotation

THRESHOLDS = (1, 2, 5, 10, 20)
"""Degrees below which a pair counts as right; the paper names none, so that all of these are told."""
FAILED = 180.0
"""Degrees that a pair counts which could not be estimated."""
_AREA_TO = 10  # degrees; mean accuracy over the whole thresholds 1 to 10 (as in the image matching challenges)
_TOLERANCE = 1.0  # pixels of a picture of 384 or more pixels; half of it in a smaller one, which is doubled


@dataclass(frozen=True, kw_only=True)
class PairResult:
    """One pair of frames."""

    first: int
    second: int
    true_degrees: float
    """By how much the cameras turn from one to the other."""
    error_degrees: float
    """Of the estimated rotation; 180 where there is none."""
    matches: int
    inliers: int
    """Matches that agree with the estimated motion; 0 where there is none."""

    @property
    def failed(self) -> bool:
        """No motion was found."""
        return self.inliers == 0


def frame_pairs(frames: int, *, most_apart: int, count: int = 20, seed: int = 0) -> list[tuple[int, int]]:
    """Different pairs (first, second) of a film's frames, at most so many frames apart, each as likely as any other;
    sorted.

    Raises ValueError if there are not so many pairs.
    """
    every = [
        (first, second) for first in range(frames) for second in range(first + 1, min(frames, first + most_apart + 1))
    ]
    if count < 1 or len(every) < count:
        raise ValueError(
            f"pairs: expected between 1 and {len(every)} (frames of {frames} at most {most_apart} apart), got {count}; "
            "ask for fewer pairs or a longer film"
        )
    chosen = torch.randperm(len(every), generator=torch.Generator().manual_seed(seed))[:count]
    return sorted(every[index] for index in chosen.tolist())


def relative_rotation(
    found: Correspondences, first: Pinholes, second: Pinholes, *, tolerance: float = _TOLERANCE
) -> tuple[Float[np.ndarray, "3 3"] | None, int]:
    """Rotation from the first camera's axes to the second's, and how many matches agree with it; (None, 0) where too
    few do.

    Args:
        found: correspondences, pixels.
        first, second: one camera each, of which only focal length and principal point are used.
        tolerance: pixels by which a match may be off.
    """
    places = [_normalised(found.first, first), _normalised(found.second, second)]
    turn = two_view_rotation(
        *places, tolerance=tolerance / min(float(camera.focal.mean()) for camera in (first, second))
    )
    return (None, 0) if turn is None else (turn.rotation, turn.inliers)


def _normalised(places: Float[Tensor, "m 2"], camera: Pinholes) -> Float[np.ndarray, "m 2"]:
    return ((places.double() - camera.principal[0].double()) / camera.focal[0].double()).cpu().numpy()


def true_rotation(first: Pinholes, second: Pinholes) -> Float[np.ndarray, "3 3"]:
    """From the first camera's axes to the second's, float64."""
    return (second.rotations[0].double().T @ first.rotations[0].double()).cpu().numpy()


def rotation_angle_degrees(one: Float[np.ndarray, "3 3"], other: Float[np.ndarray, "3 3"]) -> float:
    """Angle between two rotations: arccos((trace - 1) / 2), computed so that small angles are exact."""
    between = one @ other.T
    sine = np.linalg.norm([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    return float(np.degrees(np.arctan2(sine, np.trace(between) - 1)))


def judge_pairs(
    pictures: Callable[[int], Float[Tensor, "3 h w"]],
    cameras: Pinholes | Sequence[Pinholes],
    pairs: Sequence[tuple[int, int]],
    matcher: Matcher,
    *,
    on_pair: Callable[[int, int], None] = lambda done, total: None,
) -> list[PairResult]:
    """Estimate each pair's rotation from its pictures and compare it with its cameras'.

    Args:
        pictures: number of a frame -> its picture, RGB in [0, 1]; asked for once for each pair that the frame is in.
        cameras: of all frames, one batch or one camera each.
        pairs: as ``frame_pairs`` gives them.
        matcher: finds correspondences.
        on_pair: told how many of all pairs are done.
    """
    results = []
    for number, (first, second) in enumerate(pairs):
        images = pictures(first), pictures(second)
        matches, truth = matcher(*images), true_rotation(cameras[first], cameras[second])
        tolerance = _TOLERANCE / enlargement(images[0])
        estimated, inliers = relative_rotation(matches, cameras[first], cameras[second], tolerance=tolerance)
        error = FAILED if estimated is None else rotation_angle_degrees(estimated, truth)
        true_degrees = rotation_angle_degrees(truth, np.eye(3))
        results.append(
            PairResult(
                first=first,
                second=second,
                true_degrees=true_degrees,
                error_degrees=error,
                matches=len(matches),
                inliers=inliers,
            )
        )
        on_pair(number + 1, len(pairs))
    return results


def accuracy(results: Sequence[PairResult]) -> dict[str, float]:
    """What is reported of a set of pairs.

    Returns:
        ``rra_1`` ... ``rra_20``: share of pairs with an error below the threshold (degrees), pairs without an estimate
        being wrong; ``rra_5_low``, ``rra_5_high``: 95 % interval of that share (Wilson 1927); ``maa_10``: mean share
        over thresholds 1, 2, ... 10; ``median_degrees``; ``failed``: pairs without an estimate; ``pairs``; ``matches``:
        their median;
        ``still_5``: what a film whose pictures never turn would score at 5 degrees.

    Raises ValueError without pairs.
    """
    if not results:
        raise ValueError("relative rotation accuracy: expected at least one pair, got none")
    errors = torch.tensor([result.error_degrees for result in results], dtype=torch.float64)
    turns = torch.tensor([result.true_degrees for result in results], dtype=torch.float64)
    matches = torch.tensor([result.matches for result in results], dtype=torch.float64)
    shares = {f"rra_{limit}": float((errors < limit).double().mean()) for limit in THRESHOLDS}
    low, high = wilson_interval(int((errors < 5).sum()), len(errors))
    area = sum(float((errors < limit).double().mean()) for limit in range(1, _AREA_TO + 1)) / _AREA_TO
    return {
        **shares,
        "rra_5_low": low,
        "rra_5_high": high,
        "maa_10": area,
        "median_degrees": float(errors.quantile(0.5)),
        "failed": sum(result.failed for result in results),
        "pairs": len(results),
        "matches": float(matches.quantile(0.5)),
        "still_5": float((turns < 5).double().mean()),
    }


def wilson_interval(right: int, count: int) -> tuple[float, float]:
    """95 % interval of a share, right for few tries and for shares of 0 and 1 (Wilson 1927)."""
    z, share = 1.959964, right / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)
