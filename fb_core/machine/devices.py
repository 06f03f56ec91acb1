"""Where to compute, as a person names it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def chosen_device(name: str | None) -> torch.device:
    """The device of this name, asked for before any work; without one the first GPU, or the CPU where there is none.

    Raises ValueError for one that torch does not have here.
    """
    import torch

    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        if device.type != "cuda":  # there it would take memory of a GPU that this process may not be meant to use
            torch.ones(1, device=device).item()  # meta holds no numbers
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # which of them depends on the backend
        raise ValueError(
            f"device: expected one that this machine has, such as cpu, cuda or cuda:N, got {name!r}; leave it out to "
            "choose"
        ) from error
    if device.type == "cuda":
        there = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= there:
            what = f"has {there} GPUs" if there else "finds no GPU on this machine"
            raise ValueError(f"device: {name!r} was asked for, but torch {what}; use cpu")
    return device
