"""WebDataset shards as streams of samples that can be entered at any position, one stream for each row of a batch.

The stream of a row depends on (seed, row, rows of the batch), not on how many processes share the batch: each opens the
streams of its own rows, so the shards are split over processes and rows alike. Nothing is shuffled inside a shard, and
nothing is kept but the open files.
"""

from __future__ import annotations

import inspect
import logging
import re
import tarfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from fb_core.files.whole import found_below
from fb_core.sampling.randomness import generator_of

_logger = logging.getLogger(__name__)
_BROKEN_SHARDS = 8  # in a row, or epochs without a sample, before a stream gives up


def find_shards(place: str) -> list[str]:
    """Names of shards: the .tar files at or below a folder, or a pattern that WebDataset expands, such as
    ``URL/{000..999}.tar``.

    Raises ValueError for a folder or pattern without shards.
    """
    folder = Path(place)
    if folder.is_dir():
        shards = [str(path) for path in found_below(folder, "*.tar")]
    else:
        from braceexpand import braceexpand

        shards = list(braceexpand(place))
        if "://" not in place and not place.startswith("pipe:"):
            shards = [name for name in shards if Path(name).is_file()]
    if not shards:
        raise ValueError(f"images: expected WebDataset shards (.tar files) at {place}, found none; check the path")
    return shards


class ShardStream:
    """The endless stream of one row: its shards in an order that is drawn anew for each epoch.

    With fewer shards than rows every row reads all shards, and keeps every so many-th sample.
    """

    def __init__(self, shards: list[str], row: int, rows: int, seed: int):
        self.shards, self.row, self.rows, self.seed = shards, row, rows, seed
        self._split_samples = len(shards) < rows
        self._position = 0
        self._samples: Iterator[dict[str, Any]] | None = None
        self._latest: tuple[int, list[dict[str, Any]]] = (-1, [])

    def take(self, position: int, count: int) -> list[dict[str, Any]]:
        """``count`` samples from ``position`` on, as raw bytes by suffix, with ``__key__`` and ``__url__``.

        Going on is streaming; asking for the same again is free; a jump ahead skips whole shards where they lie on this
        machine; going back begins anew. Raises ValueError after several unreadable shards in a row.
        """
        if self._latest[0] != position or len(self._latest[1]) != count:
            if self._samples is None or position != self._position:
                self._samples = self._from(position)
            self._latest = position, [next(self._samples) for _ in range(count)]
            self._position = position + count
        return self._latest[1]

    def _from(self, position: int) -> Iterator[dict[str, Any]]:
        epoch, broken, empty, skip = 0, 0, 0, position
        while True:
            is_empty = True
            for shard in self._order(epoch):
                if skip and skip >= (length := self._length(shard)):
                    skip, is_empty = skip - length, is_empty and not length
                    continue
                try:
                    for number, sample in enumerate(self._kept(shard)):
                        if number >= skip:
                            broken, is_empty = 0, False
                            yield sample
                    skip = 0
                except (tarfile.TarError, OSError, EOFError, ValueError) as error:
                    broken, skip = broken + 1, 0
                    _logger.warning("left out the rest of shard %s: %s", shard, error)
                    if broken >= _BROKEN_SHARDS:
                        raise ValueError(
                            f"images: {broken} shards in a row could not be read, the last being {shard} ({error})"
                        ) from error
            empty = empty + 1 if is_empty else 0
            if empty >= _BROKEN_SHARDS:
                raise ValueError(
                    f"images: row {self.row} of {self.rows} finds no samples in {len(self.shards)} shards; give more "
                    "of them"
                )
            epoch += 1

    def _order(self, epoch: int) -> list[str]:
        order = torch.randperm(len(self.shards), generator=generator_of(self.seed, epoch)).tolist()
        mine = order if self._split_samples else order[self.row :: self.rows]
        return [self.shards[number] for number in mine]

    def _kept(self, shard: str) -> Iterator[dict[str, Any]]:
        for number, sample in enumerate(samples_of(shard)):
            if not self._split_samples or number % self.rows == self.row:
                yield sample

    def _length(self, shard: str) -> int:
        length = shard_length(shard)
        return len(range(self.row, length, self.rows)) if self._split_samples else length


def samples_of(shard: str) -> Iterator[dict[str, Any]]:
    """The samples of one shard, in order. Raises ValueError where webdataset is not installed."""
    try:
        from webdataset.compat import WebDataset  # not named in the package's own __init__ for type checkers
    except ImportError as error:
        raise ValueError(
            "images: shards need the package webdataset, which `pip install 'fillerbuster[train]'` installs"
        ) from error
    return iter(WebDataset(shard, shardshuffle=False, nodesplitter=_all, workersplitter=_all, empty_check=False))


def _all(shards: Iterator[Any]) -> Iterator[Any]:
    """Rows are split already."""
    return shards


@lru_cache(1_000_000)
def shard_length(shard: str) -> int:
    """Samples in a shard; of one on this machine only the headers are read. A damaged one has as many as can be
    read.
    """
    if Path(shard).is_file():
        try:
            with tarfile.open(shard, "r:") as file:
                names = [member.name for member in file if member.isreg()]
            return _count(_samples_named(names, shard))
        except (tarfile.TarError, OSError):
            pass
    return _count(samples_of(shard))


def _count(samples: Iterator[dict[str, Any]]) -> int:
    """How many come before the end, or before the first that is damaged."""
    length = 0
    try:
        for _ in samples:
            length += 1
    except (tarfile.TarError, OSError, EOFError, ValueError):
        pass
    return length


def _samples_named(names: list[str], shard: str) -> Iterator[dict[str, Any]]:
    """The samples without their data that WebDataset makes of files with these names, by its own rules: it leaves out
    names that begin with a dot or have no suffix, and what it keeps for itself, without a break between the samples
    around them.
    """
    from webdataset import tariterators

    kept_for_itself = inspect.signature(tariterators.tar_file_iterator).parameters["skip_meta"].default
    prefix, suffix = tariterators.meta_prefix, tariterators.meta_suffix
    own = [
        name
        for name in names
        if not ("/" not in name and name.startswith(prefix) and name.endswith(suffix))
        and not re.match(kept_for_itself, name)
    ]
    return tariterators.group_by_keys({"fname": name, "data": b"", "__url__": shard} for name in own)
