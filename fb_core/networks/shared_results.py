"""Results of networks that several samplings share, found again by all that decides them: the rounds of a completion
show the network the same captured pictures.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

LIMIT_BYTES = 64 * 2**20
"""Latents of 16000 views of 64 pixels, or keys and values of 10000 known tokens of the bundled model in bfloat16."""
_R = TypeVar("_R")
_numbers: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()  # ids of networks that are gone are given again
_next_number = itertools.count()
_one_at_a_time = Lock()  # of all together, for a copy of a lock cannot be made, and nobody holds it for long


class SharedResults:
    """The latest results of some computations, in bounded memory.

    A result is the very tensors that were computed, so that sharing changes no bit. Whoever asks names everything that
    decides them, by content: where a single bit of it differs the result is computed anew. Results must not be written
    to. Several threads may ask; what two of them ask at once may be computed twice.
    """

    def __init__(self, limit_bytes: int = LIMIT_BYTES):
        """Of the results together; a larger one is not kept at all."""
        self.limit_bytes = limit_bytes
        self.answered = 0
        """How often a result was there already."""
        self._results: OrderedDict[bytes, tuple[Any, int]] = OrderedDict()

    @property
    def bytes(self) -> int:
        """What is kept now."""
        return sum(size for _, size in list(self._results.values()))

    def of(self, compute: Callable[[], _R], *deciding: Tensor | nn.Module | str | None) -> _R:
        """What ``compute`` gives, or gave when the same tensors (values, shapes and types), networks (the very ones,
        with the weights that they had) and texts decided it.

        Tensors are looked for in the result itself and in the lists, tuples and dictionaries that it consists of.
        """
        key = _fingerprint(deciding)
        with _one_at_a_time:
            found = self._results.get(key)
            if found is not None:
                self.answered += 1
                self._results.move_to_end(key)
                return found[0]
        result = compute()
        size = _bytes_of(result)
        if size <= self.limit_bytes:
            with _one_at_a_time:
                self._results[key] = result, size
                while self.bytes > self.limit_bytes:
                    self._results.popitem(last=False)
        return result

    @property
    def room_bytes(self) -> int:
        """What may still be kept."""
        return self.limit_bytes - self.bytes

    def forget(self) -> None:
        """Give all memory back."""
        self._results.clear()


def _fingerprint(deciding: tuple[Tensor | nn.Module | str | None, ...]) -> bytes:
    """SHA-256 over the parts, each told from the next by its kind, type, shape and length."""
    digest = hashlib.sha256()
    for part in deciding:
        if isinstance(part, Tensor):
            digest.update(f"{part.dtype} {tuple(part.shape)} {part.device};".encode())
            digest.update(part.detach().reshape(-1).contiguous().view(torch.uint8).cpu().numpy().tobytes())
        else:
            text = (_state_of(part) if isinstance(part, nn.Module) else repr(part)).encode()
            digest.update(f"text {len(text)};".encode() + text)
    return digest.digest()


def _state_of(network: nn.Module) -> str:
    """Which network it is, and where its weights lie and how often they were written to: another text when they are
    others. (To read them all would take longer than what is shared.)
    """
    number = _numbers.setdefault(network, next(_next_number))
    weights = [
        (weight.data_ptr(), 0 if weight.is_inference() else weight._version)
        for weight in itertools.chain(network.parameters(), network.buffers())
    ]
    return f"network {number} {weights}"


def _bytes_of(result: Any) -> int:
    """Of all memory that its tensors keep alive, each piece once."""
    storages: dict[int, int] = {}

    def walk(part: Any) -> None:
        if isinstance(part, Tensor):
            storage = part.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
        elif isinstance(part, dict):
            walk(list(part.values()))
        elif isinstance(part, list | tuple):
            for one in part:
                walk(one)

    walk(result)
    return sum(storages.values())
