"""Draws of the fuzz of the public functions: any valid input, and every fault that has the right shape.

None, one, all alike, on one line, tiny, huge, far away, not finite, in odd layouts and precisions. Where a draw is
valid the answer has to be finite; where it is not, an answer or a ValueError with a message is right, and no other
exception ever is.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

FAST, ALL = 150, 600
"""Draws of each case in the suite, and in the whole fuzz."""


class Dice:
    """Seeded draws; `valid` becomes False as soon as one of them is nothing that a caller may hope for an answer
    from.
    """

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)
        self.valid = True

    def of(self, *choices: Any) -> Any:
        return choices[int(torch.randint(len(choices), (), generator=self.generator))]

    def number(self, low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=self.generator))

    def chance(self, share: float) -> bool:
        return float(torch.rand((), generator=self.generator)) < share

    def bad(self, good: Any, *wrong: Any) -> Any:
        """Nearly always the good value."""
        if not self.chance(0.08):
            return good
        self.valid = False
        return self.of(*wrong)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def unit(self, *shape: int) -> Tensor:
        return F.normalize(self.normal(*shape, 3), dim=-1)

    def dtype(self) -> torch.dtype:
        return self.of(torch.float32, torch.float64)

    def layout(self, values: Tensor) -> Tensor:
        """The same values, perhaps in another layout; or one of them is not finite."""
        if values.numel() and self.chance(0.06):
            self.valid = False
            values = values.clone()
            values.view(-1)[self.number(0, values.numel() - 1)] = self.of(math.nan, math.inf, -math.inf)
        if values.ndim > 1 and self.chance(0.2):
            return values.transpose(0, 1).contiguous().transpose(0, 1)
        return values

    def places(self, count: int) -> Tensor:
        """Points anywhere: spread, on a line, in one place, tiny, huge, far away."""
        places = self.of(1.0, 1.0, 1e-4, 1e4) * self.normal(count, 3)
        if count and self.chance(0.25):
            places = places[:1].expand(count, 3).clone()
        if self.chance(0.15):
            places = places * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        return places + self.of(0.0, 0.0, 1e3) * torch.ones(3, dtype=torch.float64)

    def cameras(self, some: int | None = None, *, side: int | None = None) -> Pinholes:
        """Any cameras: turned anyhow, level, all one way, around something."""
        count: int = self.of(1, 1, 2, 3, 6, 12) if some is None else some
        centers = self.places(count)
        rotations = torch.linalg.qr(self.normal(count, 3, 3)).Q if count else torch.zeros(0, 3, 3, dtype=torch.float64)
        rotations = rotations * torch.linalg.det(rotations).sign()[:, None, None]
        if count and self.chance(0.3):
            rotations = rotations[:1].expand(count, 3, 3)
        width, height = (side or self.number(1, 24), side or self.number(1, 24))
        focal = width * torch.exp(0.5 * self.normal(count, 2))
        principal = torch.tensor([width / 2, height / 2], dtype=torch.float64) + self.of(0.0, 1.0, 30.0) * self.normal(
            count, 2
        )
        pose = self.layout(torch.cat([rotations, centers[:, :, None]], dim=2))
        cameras = Pinholes(camera_to_world=pose, focal=focal, principal=principal, width=width, height=height)
        if count > 1 and self.chance(0.3):
            up = self.unit()
            ring = centers + 2 * (1 + centers.norm(dim=1, keepdim=True)) * F.normalize(self.normal(count, 3), dim=1)
            cameras = Pinholes.looking_at(
                ring, torch.zeros_like(ring), up=up, fov_degrees=60.0, width=width, height=height
            )
        return cameras.to(self.dtype())

    def mask(self, *shape: int) -> Tensor:
        """0 and 1, fractions, all or nothing."""
        drawn = torch.rand(*shape, generator=self.generator, dtype=torch.float64)
        return self.of(drawn.round(), drawn, torch.ones_like(drawn), torch.zeros_like(drawn), (drawn > 0.9).double())


def numbers(answer: Any) -> list[Tensor]:
    """All floating-point numbers of an answer."""
    if isinstance(answer, Tensor):
        return [answer] if answer.is_floating_point() else []
    if isinstance(answer, float):
        return [torch.tensor(answer)]
    if isinstance(answer, (tuple, list)):
        return [one for part in answer for one in numbers(part)]
    if isinstance(answer, dict):
        return numbers(list(answer.values()))
    if dataclasses.is_dataclass(answer):
        return numbers([getattr(answer, field.name) for field in dataclasses.fields(answer)])
    return []


def faults(case: Callable[[Dice], Any], seeds: range) -> list[str]:
    """What is wrong with the answers to these draws."""
    found = []
    for seed in seeds:
        dice = Dice(seed)
        try:
            answer = case(dice)
        except ValueError as error:
            sentence = str(error)
            if len(sentence) < 20 or " " not in sentence or dice.valid:
                found.append(
                    f"{case.__name__}, seed {seed}: {'valid input refused' if dice.valid else 'no sentence'}: "
                    f"{sentence!r}"
                )
        except Exception as error:
            found.append(f"{case.__name__}, seed {seed}: {type(error).__name__}: {str(error)[:200]}")
        else:
            broken = [index for index, one in enumerate(numbers(answer)) if not bool(torch.isfinite(one).all())]
            if broken and dice.valid:
                found.append(f"{case.__name__}, seed {seed}: parts {broken} of the answer are not finite")
    return found
