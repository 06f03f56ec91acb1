"""What lenses the photos may have been taken with: told or not, shared or one each, straight or bent."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fb_core.geometry.features.bundle_adjustment import Lenses, straight_places
from fb_core.geometry.features.pairs import PhotoFeatures

FOCAL_GUESS = 1.2
"""Focal length in longer sides where nothing tells more: a normal lens (43 mm on film), the customary start."""
FOCAL_GUESSED = 0.5
"""Deviation of the logarithm of focal lengths that nobody tells."""
_FOCAL_TOLD = 0.02  # the same of those that are told
ONE_LENS = 0.1
"""Logarithm of the largest over the smallest focal length of photos beyond which they were not taken with one lens."""
_GAIN = 0.015  # share of all matches
SAME_LENS = (0.25, 0.1, 0.03)
"""Logarithms within which focal lengths of photos of one lens may be found, where little fixes them; the first that
fits is taken.
"""


@dataclass(frozen=True, kw_only=True)
class LensGuess:
    """Lenses of n photos, as they are believed to be: where a reconstruction starts, or what it found."""

    lens: Int[np.ndarray, " n"]
    """Of each photo; photos of one lens share all of the following."""
    focal: Float[np.ndarray, " l"]
    """Pixels."""
    bend: Float[np.ndarray, "l 2"]
    """k1 and k2 of radial distortion."""
    told: Float[np.ndarray, " l"]
    """Focal lengths that photos tell, pixels; the customary guess where they tell none, or are not believed."""
    believed: Bool[np.ndarray, " l"]
    """Whether `told` was told, and is no lie."""
    tagged: Bool[np.ndarray, " l"]
    """Whether it was told at all."""
    family: Int[np.ndarray, " l"]
    """Lenses of photos that tell the same of theirs have the same number."""
    fixed: Bool[np.ndarray, " l"]
    """Whether photos of known cameras were taken with the lens: it is told exactly, and straight."""
    bends: int = 0
    """How many coefficients of radial distortion are looked for: none, k1, or k1 and k2."""

    @staticmethod
    def of(photos: Sequence[PhotoFeatures], *, guess: float = FOCAL_GUESS) -> LensGuess:
        """As the photos tell, and so many longer sides where they do not."""
        names = list(dict.fromkeys(photo.lens for photo in photos))
        lens = np.array([names.index(photo.lens) for photo in photos])
        members = [[photo for photo in photos if photo.lens == name] for name in names]
        first = [next((photo for photo in mine if photo.known), mine[0]) for mine in members]
        fixed = np.array([photo.known for photo in first])
        focals = [photo.focal for photo in first]
        usual = np.array([value or FOCAL_GUESS * max(photo.size) for value, photo in zip(focals, first, strict=True)])
        start = np.array([value or guess * max(photo.size) for value, photo in zip(focals, first, strict=True)])
        tagged = np.array([value is not None for value in focals])
        bend = np.zeros((len(names), 2))
        values = {"told": usual, "believed": tagged, "tagged": tagged, "family": np.arange(len(names)), "fixed": fixed}
        return LensGuess(lens=lens, focal=start, bend=bend, **values)

    def one_each(self) -> LensGuess:
        """A focal length for every photo whose camera is not known, starting from those here; none of their tags is
        believed.
        """
        groups: dict[tuple[int, int], int] = {}
        for index, number in enumerate(self.lens):
            groups.setdefault((int(number), -1 if self.fixed[number] else index), len(groups))
        lens = np.array(
            [groups[int(number), -1 if self.fixed[number] else index] for index, number in enumerate(self.lens)]
        )
        return self._regrouped(lens, believed=self.fixed)

    def freer(self, lies: Bool[np.ndarray, " l"]) -> list[LensGuess]:
        """With one thing more to be found each: focal lengths of tags that lie, another coefficient of distortion, one
        lens per photo.
        """
        options: list[LensGuess] = []
        if lies.any():
            options.append(dataclasses.replace(self, believed=self.believed & ~lies))
        if self.bends < 2 and not self.fixed.all():
            options.append(dataclasses.replace(self, bends=self.bends + 1))
        if (~self.fixed[self.lens]).sum() > (~self.fixed).sum():
            options.append(self.one_each())
        return options

    def least_gain(self, before: LensGuess) -> float:
        """The share of matches that this guess must explain beyond another one to be preferred."""
        if len(self.focal) > len(before.focal):
            spread = float(np.ptp(np.log(self.focal[~self.fixed])))
            return max(_GAIN, min(2 * _GAIN, 0.4 / len(self.lens))) if spread > ONE_LENS else math.inf
        return _GAIN if self.bends > before.bends else -_GAIN

    def merged(self, within: float) -> LensGuess:
        """Lenses of one family whose focal lengths follow one another within so much (logarithm) made one, with their
        mean.
        """
        order = np.lexsort((self.focal, self.family))
        apart = np.abs(np.diff(np.log(self.focal[order]))) > within
        apart |= np.diff(self.family[order]) != 0
        group = np.empty(len(order), dtype=int)
        group[order] = np.concatenate([[0], np.cumsum(apart)])
        return self._regrouped(np.unique(group[self.lens], return_inverse=True)[1], believed=self.believed)

    def with_photo(self, photo: int, *, lens: int | None, focal: float) -> LensGuess:
        """With another lens for one photo: one of those here, or one of its own with such a focal length (pixels),
        about which no tag is believed.
        """
        chosen, grown = self.lens.copy(), self
        if lens is None:
            rows = np.append(np.arange(len(self.focal)), self.lens[photo])
            names = ("focal", "bend", "told", "believed", "tagged", "family", "fixed")
            grown = dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in names})
            grown.focal[-1], grown.believed[-1] = focal, False
            lens = len(self.focal)
        chosen[photo] = lens
        grown = dataclasses.replace(grown, lens=chosen)
        return grown._regrouped(np.unique(chosen, return_inverse=True)[1], believed=grown.believed)

    def _regrouped(self, lens: Int[np.ndarray, " n"], *, believed: Bool[np.ndarray, " l"]) -> LensGuess:
        members = [self.lens[lens == number] for number in range(int(lens.max()) + 1)]
        first = np.array([mine[0] for mine in members])
        focal = np.array([np.exp(np.log(self.focal[mine]).mean()) for mine in members])
        bend = np.array([self.bend[mine].mean(axis=0) for mine in members])
        values = {"told": self.told[first], "believed": believed[first], "tagged": self.tagged[first]}
        values |= {"family": self.family[first], "fixed": self.fixed[first]}
        return dataclasses.replace(self, lens=lens, focal=focal, bend=bend, **values)

    def notes(self, sides: Sequence[int]) -> list[str]:
        """What is worth telling of the lenses, given the photos' longer sides in pixels: tags that lie, several lenses
        (a photo that was made smaller has no other one), bent ones.
        """
        notes = list[str]()
        side = np.array([max(np.array(sides)[self.lens == lens], default=1) for lens in range(len(self.focal))])
        lies = np.flatnonzero(self.tagged & ~self.believed & (np.abs(np.log(self.focal / self.told)) > ONE_LENS / 2))
        if len(lies):
            worst = lies[int(np.argmax(np.abs(np.log(self.focal[lies] / self.told[lies]))))]
            off = f"{self.told[worst] / side[worst]:.2f} longer sides told, {self.focal[worst] / side[worst]:.2f} found"
            notes.append(
                f"The focal length that {int(np.isin(self.lens, lies).sum())} photos tell contradicts their features "
                f"({off})."
            )
        own = np.sort((self.focal / side)[~self.fixed])
        own = own[np.append(True, np.diff(np.log(own)) > SAME_LENS[-1])[: len(own)]]
        if len(own) > 1 and not (self.believed & ~self.fixed).any():
            lengths = ", ".join(f"{value:.2f}" for value in own)
            notes.append(f"The photos were taken with {len(own)} focal lengths ({lengths} longer sides).")
        if self.bends:
            k1, k2 = self.bend[int(np.argmax(np.abs(self.bend).max(axis=1)))]
            notes.append(
                f"The lens bends straight lines (k1 = {k1:.3f}, k2 = {k2:.3f}); the photos are written straightened."
            )
        return notes

    def known(self, chosen: Int[np.ndarray, " m"] | None = None, *, focal_free: bool = True) -> Lenses:
        """What the bundle adjustment is to believe of some lenses (all when None). Without `focal_free` none of them
        changes.
        """
        chosen = np.arange(len(self.focal)) if chosen is None else chosen
        free = ~self.fixed[chosen] & focal_free
        return Lenses(
            told=self.told[chosen],
            deviation=np.where(self.believed[chosen], _FOCAL_TOLD, FOCAL_GUESSED),
            focal_free=free,
            bend_free=free[:, None] & (np.arange(2) < self.bends),
        )

    def plane(self, photo: int | Int[np.ndarray, " k"], offsets: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
        """Where the rays through places (pixels from the middle) meet the plane at depth 1; NaN where the lens pictures
        nothing.
        """
        number = self.lens[photo]
        return straight_places(offsets / np.asarray(self.focal[number])[..., None], self.bend[number])
