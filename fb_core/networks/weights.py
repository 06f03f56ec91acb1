"""Strict weights: a network takes a set of tensors exactly as named and shaped, or says which one does not fit."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


def require_names(where: str, expected: Iterable[str], got: Iterable[str]) -> None:
    """Raise a ValueError that begins with `where` and names what is missing and what is unknown, unless there is
    neither.
    """
    expected, got = set(expected), set(got)
    problems = [
        f"{kind} {', '.join(sorted(names)[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''}"
        for kind, names in (("missing", expected - got), ("unknown", got - expected))
        if names
    ]
    if problems:
        raise ValueError(
            f"{where}: expected exactly the {len(expected)} names of this architecture, got {'; '.join(problems)}."
        )


def require_shapes(where: str, module: nn.Module, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise a ValueError that begins with `where` and names the first misfit, unless `shapes` are those of the module's
    state.
    """
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    require_names(where, expected, shapes)
    for name, shape in expected.items():
        if tuple(shapes[name]) != shape:
            raise ValueError(f"{where}: expected {name} of shape {list(shape)}, got {list(shapes[name])}.")


def without_weights(build: Callable[[], Network]) -> Network:
    """The module that `build` makes, in evaluation mode and with parameters that occupy no memory until `adopt` gives
    them some.

    Built in a thread of its own, where no Ctrl-C arrives: one that comes while torch initializes a parameter can leave
    its thread's default device at "meta" for good (findings/torch_device_outlives_an_interruption.sh).
    """

    def built() -> Network:
        with torch.device("meta"):
            return build().eval()

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(built).result()


def require_plain(where: str, tensors: Mapping[str, Tensor]) -> None:
    """Raise a ValueError that begins with `where` and names the first tensor that holds no weights as they are used
    here.

    Weights are dense tensors of real floating-point numbers, each with memory of its own.
    """
    for name, value in tensors.items():
        if value.layout != torch.strided or value.is_quantized:
            kind = "quantized" if value.is_quantized else str(value.layout).removeprefix("torch.")
            raise ValueError(
                f"{where}: expected {name} to be a dense tensor, got a {kind} one; save the weights as plain tensors."
            )
        if not value.is_floating_point():
            raise ValueError(
                f"{where}: expected {name} to hold floating-point numbers, got "
                f"{str(value.dtype).removeprefix('torch.')}."
            )
        if value.device.type == "meta":
            raise ValueError(
                f"{where}: {name} has a shape but no numbers; save the weights after they have been loaded."
            )
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise ValueError(
                f"{where}: {name} repeats the same numbers over {list(value.shape)}; save the weights as plain tensors."
            )


def adopt(where: str, module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Make `tensors` (not copies of them) the module's parameters. Raises ValueError as `require_plain` and
    `require_shapes` do.
    """
    require_plain(where, tensors)
    require_shapes(where, module, {name: tuple(value.shape) for name, value in tensors.items()})
    module.load_state_dict(dict(tensors), strict=True, assign=True)
