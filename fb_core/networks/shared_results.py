"""Results of networks that several samplings share, found again by all that decides them: the rounds of a completion
show the network the same captured pictures.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

LIMIT_BYTES = 64 * 2**20
"""Latents of 16000 views of 64 pixels, or keys and values of 10000 known tokens of the bundled model in bfloat16."""
_R = TypeVar("_R")


class SharedResults:
    """The latest results of some computations, in bounded memory.

    A result is the very tensors that were computed, so that sharing changes no bit. Whoever asks names everything that
    decides them, by content: where a single bit of it differs the result is computed anew. Results must not be written
    to.
    """

    def __init__(self, limit_bytes: int = LIMIT_BYTES):
        """Of the results together; a larger one is not kept at all."""
        self.limit_bytes = limit_bytes
        self.bytes = 0
        """What is kept now."""
        self.answered = 0
        """How often a result was there already."""
        self._results: OrderedDict[bytes, tuple[Any, int]] = OrderedDict()

    def of(self, compute: Callable[[], _R], *deciding: Tensor | str | None) -> _R:
        """What ``compute`` gives, or gave when the same tensors (values, shapes and types) and texts decided it.

        Tensors are looked for in the result itself and in the lists, tuples and dictionaries that it consists of.
        """
        key = _fingerprint(deciding)
        if key in self._results:
            self.answered += 1
            self._results.move_to_end(key)
            return self._results[key][0]
        result = compute()
        size = _bytes_of(result)
        if size <= self.limit_bytes:
            self._results[key] = result, size
            self.bytes += size
            while self.bytes > self.limit_bytes:
                self.bytes -= self._results.popitem(last=False)[1][1]
        return result

    @property
    def room_bytes(self) -> int:
        """What may still be kept."""
        return self.limit_bytes - self.bytes

    def forget(self) -> None:
        """Give all memory back."""
        self._results.clear()
        self.bytes = 0


def _fingerprint(deciding: tuple[Tensor | str | None, ...]) -> bytes:
    """SHA-256 over the parts, each told from the next by its kind, type, shape and length."""
    digest = hashlib.sha256()
    for part in deciding:
        if isinstance(part, Tensor):
            digest.update(f"{part.dtype} {tuple(part.shape)} {part.device};".encode())
            digest.update(part.detach().reshape(-1).contiguous().view(torch.uint8).cpu().numpy().tobytes())
        else:
            text = repr(part).encode()
            digest.update(f"text {len(text)};".encode() + text)
    return digest.digest()


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
