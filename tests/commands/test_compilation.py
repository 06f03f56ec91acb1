"""``fillerbuster compile``: what it says, and that a library that draws something else is not kept."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from fb_core.splatting.compiled import library
from method_configs.commands.compilation import compile_splats


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv(library.CACHE_VARIABLE, str(tmp_path / "cache"))
    library.loaded.cache_clear()
    yield tmp_path / "cache"
    library.loaded.cache_clear()


def test_a_library_is_made_tried_and_told(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    try:
        compile_splats()
    except library.NoCompiler as error:
        pytest.skip(str(error))
    assert library.loaded(torch.float32) is not None and library.loaded(torch.float64) is not None
    assert [path.suffix for path in cache.iterdir()] == [".so", ".so"]
    assert "10000 Gaussians at 256x256" in caplog.text and str(cache) in caplog.text


def test_a_library_that_draws_something_else_is_removed(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a compiler with a fault would make it; here the source says that pixels stop earlier."""
    if library.compiler_here() is None:
        pytest.skip("no C compiler here")
    for source in library.SOURCES:
        text = source.read_text(encoding="utf-8")
        changed = text.replace("#define STOP ((real)1e-4)", "#define STOP ((real)0.3)")
        assert (changed != text) == (source.name == "compositing.c")
        (tmp_path / source.name).write_text(changed, encoding="utf-8")
    monkeypatch.setattr(library, "SOURCES", tuple(tmp_path / source.name for source in library.SOURCES))
    with pytest.raises(library.NoCompiler, match="draws what torch draws"):
        compile_splats()
    library.loaded.cache_clear()
    assert library.loaded(torch.float32) is None and not list(cache.iterdir())
