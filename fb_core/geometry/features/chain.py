"""Cameras of photos from their features: two views by an essential matrix, the others one after the other by the points
these give.

The pair with many matches and a wide angle begins. Its points place the photo that sees most of them
(perspective-n-point), whose matches give new points, and so on; a bundle adjustment mends all cameras, focal lengths
and points on the way and at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fb_core.geometry.features.cameras import FeatureCameras, one_place
from fb_core.geometry.features.lenses import FOCAL_GUESS, SAME_LENS, LensGuess
from fb_core.geometry.features.own_lens import LensTrial
from fb_core.geometry.features.pairs import Pair, PhotoFeatures, match_pairs, verified_pair
from fb_core.geometry.features.panorama import panorama_of
from fb_core.geometry.features.reconstruction import LEAST_ANGLE_DEGREES, Matches, Reconstruction
from fb_core.machine.parallel import in_order, workers_for

_GUESSES = (FOCAL_GUESS, 0.7)  # the second is a phone's (26 mm on film)
_PANORAMA = 0.8  # share of all matches that rotations alone explain, from which nothing else is looked for
_BYTES = 5e6  # that verifying a pair takes at most
_STARTS = 3  # pairs that may begin
_GOOD_ANGLE_DEGREES = 8.0  # of a starting pair; wider ones are no better
_OUTLIER = 3.0  # tolerances
_MOST_ROUNDS = 4  # of freeing lenses
_SHARP, _SHARPEST = (
    4.5,
    0.3,
)  # medians from which a match does not count as explained, but no less than so many tolerances
_SAME_GAIN = 0.005  # share of matches that makes no difference


def chain(
    photos: Sequence[PhotoFeatures], *, on_progress: Callable[[str, int, int], None] = lambda *_: None
) -> FeatureCameras:
    """Cameras of two or more photos. Deterministic; nothing that photos show or lack raises an error.

    Where focal lengths are not told, the chain is built from two guesses, and once more from the better result's.
    """
    matches = match_pairs(photos, lambda done, total: on_progress("matching features", done, total))
    panorama = panorama_of(photos, matches, guess=FOCAL_GUESS)
    if panorama.share >= _PANORAMA or not matches:
        return one_place(photos, panorama, sure=panorama.share >= _PANORAMA)
    untold = any(photo.focal is None for photo in photos)
    best: Reconstruction | None = None
    for guess in _GUESSES if untold else _GUESSES[:1]:
        best = _better(best, _reconstructed(photos, matches, LensGuess.of(photos, guess=guess), on_progress))
    if untold and best is not None:
        best = _better(best, _reconstructed(photos, matches, best.lenses, on_progress))
    if best is None:
        return one_place(photos, panorama, sure=panorama.share >= _PANORAMA)
    best, trials = _with_own_lenses(_with_fitting_lenses(best, matches, on_progress), matches)
    return best.concluded(matches, trials)


def _with_fitting_lenses(
    best: Reconstruction, matches: Matches, on_progress: Callable[[str, int, int], None]
) -> Reconstruction:
    """The reconstruction with the lenses that the matches ask for: as few numbers as explain them.

    Each round frees one thing more (tags that lie, k1, k2, a focal length for each photo), adjusts, and keeps what
    explains clearly more matches; with new lenses everything is built once more, since pairs were judged by the old
    ones.
    """
    photos = best.photos
    for _ in range(_MOST_ROUNDS if best.registered.sum() > 2 else 0):
        options = [best.with_lenses(lenses) for lenses in best.lenses.freer(best.bad_tags)]
        gains = [_gain(best, option, matches) for option in options]
        chosen = [index for index, option in enumerate(options) if gains[index] > option.lenses.least_gain(best.lenses)]
        if not chosen:
            break
        fitted = options[max(chosen, key=lambda index: gains[index])]
        anew = _reconstructed(photos, matches, fitted.lenses, on_progress)
        best = fitted if anew is None or _gain(fitted, anew, matches) < 0 else anew
    for within in SAME_LENS:
        lenses = best.lenses.merged(within)
        if len(lenses.focal) < len(best.lenses.focal):  # one lens, too: everything began with that, but less well
            merged = best.with_lenses(lenses)
            if _gain(best, merged, matches) > -_SAME_GAIN:
                return merged
    return best


def _with_own_lenses(best: Reconstruction, matches: Matches) -> tuple[Reconstruction, dict[int, LensTrial]]:
    """The reconstruction with another lens for every photo that clearly asks for one, the clearest first, and what
    photos say of their lenses then.
    """
    tried = set[int]()
    while best.registered.sum() > 2:
        trials = best.lens_trials()
        asking = [index for index, trial in trials.items() if trial.better is not None and index not in tried]
        if not asking:
            return best, trials
        index = max(asking, key=lambda index: trials[index].evidence)
        tried.add(index)
        other = best.with_lens_of(index, trials[index])
        if _gain(best, other, matches) >= -_SAME_GAIN:
            best = other
    return best, {}


def _gain(first: Reconstruction, second: Reconstruction, matches: Matches) -> float:
    """By which share of all matches the second explains more than the first, to the precision of the better one."""
    misses = [grown.pair_misses(matches) for grown in (first, second)]
    total = sum(map(len, matches.values()))
    limit = min(float(np.median(np.concatenate(list(one.values())))) if one else _OUTLIER for one in misses)
    limit = min(max(_SHARP * limit, _SHARPEST), 2.0)
    explained = [sum(np.maximum(1 - (miss / limit) ** 2, 0.0).sum() for miss in one.values()) / total for one in misses]
    return float(explained[1] - explained[0])


def _reconstructed(
    photos: Sequence[PhotoFeatures],
    matches: Matches,
    lenses: LensGuess,
    on_progress: Callable[[str, int, int], None],
) -> Reconstruction | None:
    """The best of a few beginnings; None if no two photos make one."""
    focal, bend = lenses.focal[lenses.lens].tolist(), lenses.bend[lenses.lens]
    verified = in_order(
        lambda match: verified_pair(photos, *match, focal, bend), matches.items(), workers_for(len(matches), _BYTES)
    )
    pairs = [pair for pair in verified if pair is not None]
    best: Reconstruction | None = None
    apart = [pair for pair in pairs if pair.parallax_degrees >= LEAST_ANGLE_DEGREES]
    for start in sorted(apart, key=_worth, reverse=True)[:_STARTS]:
        grown = Reconstruction.begun(photos, pairs, lenses, start)
        grown.grow(lambda done: on_progress("placing photos", done, len(photos)))
        best = _better(best, grown)
        if grown.registered.all():
            break
    return best


def _worth(pair: Pair) -> float:
    return len(pair.matches) * min(pair.parallax_degrees, _GOOD_ANGLE_DEGREES)


def _better(first: Reconstruction | None, second: Reconstruction | None) -> Reconstruction | None:
    if first is None or second is None:
        return first or second
    return second if second.worth > first.worth else first
