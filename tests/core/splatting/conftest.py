"""A compiled library for the tests that ask for one, made once for each run of them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fb_core.splatting.compiled import library


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("libraries")
    before = os.environ.get(library.CACHE_VARIABLE)
    os.environ[library.CACHE_VARIABLE] = str(folder)
    try:
        library.compile_libraries()
    except library.NoCompiler as error:
        pytest.skip(str(error))
    finally:
        if before is None:
            del os.environ[library.CACHE_VARIABLE]
        else:
            os.environ[library.CACHE_VARIABLE] = before
    return folder


@pytest.fixture
def compiled_library(_made: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a library for both precisions, which is found inside the test."""
    monkeypatch.setenv(library.CACHE_VARIABLE, str(_made))
    library.loaded.cache_clear()
    yield _made
    library.loaded.cache_clear()
