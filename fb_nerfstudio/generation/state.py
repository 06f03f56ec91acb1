"""What a training has generated so far, and what is still to come: plain values in checkpoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from fb_core.completion.requests import RegenerateRound, standing_on
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.trust import Trust
from fb_nerfstudio.generation.bank import Bank, without_requested
from fb_nerfstudio.generation.next_round import Rounds
from fb_nerfstudio.viewer import CompletionPanel


class GenerationState:
    """The bank, the trust in the model, and which rounds are still to come; changes between two iterations."""

    def __init__(self, panel: CompletionPanel, device: torch.device | str):
        """``panel`` shows the views; ``device`` is the training's."""
        self.panel, self.device = panel, device
        self.bank: Bank | None = None
        """The generated views as training draws them, None before there are any."""
        self.finished = False
        """Whether all automatic rounds are there."""
        self.trust: Trust | None = None
        """In the model on this capture, once it is measured."""
        self.rounds = Rounds()
        """How far rounds are that are planned one after the other."""
        self.outdated: list[int] = []
        """Rounds that were conditioned on anchors which have been generated anew since."""
        self.given_up: set[int] = set()
        """Those of them that could not be generated."""
        self.at_work = False
        """Whether views are being generated: Ctrl-C then ends the training at once, and not after the iteration."""

    @property
    def views(self) -> CompletedViews | None:
        """Every generated view so far, None before there are any."""
        return None if self.bank is None else self.bank.views

    @property
    def automatic_views(self) -> CompletedViews | None:
        """Those of automatic rounds, None where there are none."""
        return without_requested(self.views)[0]

    @property
    def round_numbers(self) -> list[int]:
        """Of the rounds whose views are there."""
        return [] if self.views is None else self.views.rounds

    def set_views(self, views: CompletedViews | None) -> None:
        """Put these in the place of all views, and show them."""
        self.bank = None if views is None else Bank.of(views, self.device)
        self.panel.show(views)

    def believed(self, views: CompletedViews) -> CompletedViews:
        """The views, believed as far as the model is, once that is measured."""
        return views.believed(None if self.trust is None else self.trust.value)

    def next_outdated(self) -> RegenerateRound | None:
        """A round that stands on anchors which are no more, to be generated as it was, from the new ones."""
        self.outdated = [number for number in self.outdated if number in self.round_numbers]
        waiting = [number for number in self.outdated if number not in self.given_up]
        return RegenerateRound(number=waiting[0], seed=None) if waiting else None

    def generated_anew(self, request: RegenerateRound) -> None:
        """Remember what follows from a round that was generated anew: rounds on its anchors are outdated."""
        followers = [] if request.seed is None else standing_on(self.views, request.number)
        self.outdated = sorted({*self.outdated, *followers} - {request.number})
        self.given_up -= {request.number, *followers}

    @contextmanager
    def generating(self) -> Iterator[None]:
        """Meanwhile views are generated (`at_work`)."""
        self.at_work = True
        try:
            yield
        finally:
            self.at_work = False

    def state(self) -> dict[str, Any]:
        """Plain values, for checkpoints."""
        return {
            "views": None if self.views is None else self.views.state(),
            "finished": self.finished,
            "outdated": list(self.outdated),
            "trust": None if self.trust is None else self.trust.value,
            "measured": None if self.trust is None else self.trust.state(),
            "rounds": self.rounds.state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """The inverse of :meth:`state`, of earlier versions' states too."""
        self.finished = bool(state["finished"])
        self.outdated = [int(number) for number in state.get("outdated", ())]
        self.trust = Trust.restored(state.get("measured"), state.get("trust"))
        self.set_views(None if state["views"] is None else CompletedViews.from_state(state["views"]))
        self.rounds = Rounds.from_state(state.get("rounds"), self.automatic_views)
