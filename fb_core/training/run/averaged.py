"""An average of a network's weights over its training, which is what is exported."""

from __future__ import annotations

import torch
from torch import nn

from fb_core.training.run.distributed import own_part


class Averaged:
    """Exponential average of a network's floating-point state, with the usual correction for the first steps."""

    def __init__(self, network: nn.Module, decay: float):
        self.decay, self.updates = decay, 0
        self.values = {name: value.detach().clone() for name, value in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Take the network's present state in."""
        self.updates += 1
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        state = network.state_dict()
        mine, new = ([own_part(values[name]) for name in self.values] for values in (self.values, state))
        torch._foreach_lerp_(mine, new, 1 - decay)
