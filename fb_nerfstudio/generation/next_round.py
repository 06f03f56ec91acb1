"""One round after the other: what the rounds before have left unseen, and when the next one is due.

A later round is planned when the former one is in the splats: some steps of training after it was generated. Then what
these splats show of trusted generated pixels counts as seen, and the next cameras look at what is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch.nn.functional as F

from fb_core.completion.options import CompletionConfig
from fb_core.completion.pixel_trust import LEAST
from fb_core.completion.planning.plan import CompletionPlan
from fb_core.completion.planning.site import Former
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.trust import Trust
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.capture.splat_renders import TrainedSplats, coarse, render_geometry

_BELIEVED = 2 * LEAST  # trust from which a pixel counts as seen: better than the simple baselines at all


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """How far the rounds of a training are that are planned one after the other; plain values, for checkpoints."""

    number: int = 0
    """Of the next round, from 0."""
    due: int = 0
    """Training step before which it is planned."""
    record: tuple[dict[str, Any], ...] = ()
    """Of each round so far: its number, step and views, and the share of the surroundings that was seen before and is
    after it.
    """

    def after(self, plan: CompletionPlan, *, step: int, due: int) -> Rounds:
        """When the planned round has been generated at a step."""
        covered = (None, None) if plan.covered is None else plan.covered
        entry = {
            "round": self.number,
            "step": step,
            "views": plan.new_views,
            "seen_before": covered[0],
            "seen_after": covered[1],
        }
        return Rounds(number=self.number + 1, due=due, record=(*self.record, entry))

    def state(self) -> dict[str, Any]:
        """Plain values."""
        return {"number": self.number, "due": self.due, "record": [dict(one) for one in self.record]}

    @staticmethod
    def from_state(state: dict[str, Any] | None, done: CompletedViews | None) -> Rounds:
        """The inverse of :meth:`state`; a run of an earlier version (None) has generated the rounds that are in its
        bank.
        """
        if state is None:
            return Rounds(number=0 if done is None else 1 + max(done.rounds))
        return Rounds(number=int(state["number"]), due=int(state["due"]), record=tuple(state["record"]))


def report_of(trust: Trust | None, rounds: Rounds, views: CompletedViews | None) -> dict[str, Any]:
    """What a run's report holds of its completion: how far the model is believed and why, the rounds, and every view's
    mean trust.
    """
    each = (
        [] if views is None else [{"round": one.round, "role": one.role, "trust": one.trust} for one in views.origins]
    )
    measured = None
    if trust is not None:
        measured = {"value": trust.value}
        if trust.curve is not None or not trust.hidden:  # else a run of an earlier version, which kept the value alone
            measured |= {"in_words": trust.in_words, **trust.state()}
    return {"trust": measured, "rounds": [dict(one) for one in rounds.record], "views": each}


def in_turn(config: CompletionConfig) -> bool:
    """Whether rounds are planned one after the other: where the capture decides what is generated."""
    return config.task == "new-views" and config.anchor_views is None and config.camera_path is None


def due_after(
    config: CompletionConfig, rounds: Rounds, plan: CompletionPlan, trust: Trust | None, *, step: int, last: int | None
) -> int | None:
    """The step before which the round after this one is due; None where there is none.

    There is none after the last one, after one that found nothing to do, and where the model knows nothing of the
    capture: it would guess ever more of what it cannot know.

    Args:
        config: how many rounds there may be, and how far apart.
        rounds: before the one that has been generated.
        plan: of that one.
        trust: in the model, if it was measured.
        step: of the training.
        last: step with which the training ends, where it is known; what would be due later is due at once.
    """
    hopeless = trust is not None and trust.hidden > 0 and trust.value <= LEAST
    if rounds.number >= config.densify_rounds or not plan.rounds or hopeless:
        return None
    later = step + config.rounds_apart
    return step if last is not None and later >= last else later


def former_of(done: CompletedViews | None, splats: TrainedSplats | None, number: int) -> Former:
    """What the views before round ``number`` show: their pixels that are believed, and that the splats show once they
    are trained (None before).
    """
    if done is None or number == 0:
        return Former(number=number)
    small = coarse(done.cameras)
    trust = F.interpolate(
        done.pixel_trust.movedim(-1, 1).cpu().float() / 255, size=(small.height, small.width), mode="area"
    )[:, 0]
    shown = trust > _BELIEVED
    if splats is not None:
        shown &= render_geometry(splats, small).solid
    return Former(number=number, cameras=tuple(_single(small)), shown=tuple(shown))


def _single(cameras: Pinholes) -> list[Pinholes]:
    return [cameras[index] for index in range(len(cameras))]
