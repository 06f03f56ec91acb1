"""The bounds that keep the house walkable (docs/architecture.md): folders, files, functions, docstrings, columns."""

from __future__ import annotations

import functools
import statistics

import house_counts
import pytest
from house_counts import Counts

# Not yet within the bounds; these may only go down.
TALL_FUNCTIONS = 0
MANY_ARGUMENTS = 9


@pytest.fixture(name="counts", scope="module")
def _counts() -> Counts:
    return _once()


@functools.cache
def _once() -> Counts:
    return house_counts.counted()


def test_folders_hold_twelve_files_at_most(counts: Counts):
    assert {folder: files for folder, files in counts.files_per_folder.items() if files > 12} == {}


def test_files_are_of_a_size_to_read(counts: Counts):
    assert {name for name, lines in counts.lines_per_file.items() if lines > 400} == set()
    assert 60 <= statistics.median(lines for lines in counts.lines_per_file.values() if lines) <= 160


def test_functions_fit_a_screen(counts: Counts):
    tall = {name: lines for name, lines in counts.lines_per_function.items() if lines > house_counts.MOST_LINES}
    assert len(tall) <= TALL_FUNCTIONS, tall


def test_few_functions_have_many_arguments(counts: Counts):
    many = {name: n for name, n in counts.arguments_per_function.items() if n > house_counts.MOST_ARGUMENTS}
    assert len(many) <= MANY_ARGUMENTS, many


def test_options_are_few(counts: Counts):
    assert sum(counts.fields_of_options.values()) <= 250


def test_every_public_name_says_what_it_is(counts: Counts):
    assert counts.without_docstring == []


def test_functions_say_what_they_refuse(counts: Counts):
    assert counts.raising_in_silence == []


def test_lines_have_120_columns(counts: Counts):
    assert counts.long_lines == []
