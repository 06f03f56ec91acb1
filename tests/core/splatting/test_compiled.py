"""The compiled compositing against the torch one: same pictures, same gradients, whatever the scene and the threads."""

from __future__ import annotations

import math
import shutil
import stat
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.scenes.rasterizer_scenes import INPUTS, backward, relative, scene, with_gradients
from torch import Tensor

from fb_core.splatting.compiled import compositing, library
from fb_core.splatting.compiled.compositing import MOST_CHANNELS
from fb_core.splatting.compiled.threads import fixed_threads, in_parts
from fb_core.splatting.rasterizer import rasterization
from fb_core.splatting.tiles.cells import slabs


def drawn(inputs: dict[str, Any], engine: str, **options: Any) -> dict[str, Tensor]:
    """Picture, alpha and all gradients."""
    leaves = with_gradients(inputs)
    images, alphas, meta = rasterization(**leaves, absgrad=True, engine=engine, **options)
    meta["means2d"].retain_grad()
    backward(images, alphas)
    gradients = {name: leaves[name].grad for name in INPUTS}
    return {
        "picture": images.detach(),
        "alpha": alphas.detach(),
        "means2d": meta["means2d"].grad,
        "absgrad": meta["means2d"].absgrad,
        **{name: torch.zeros(()) if gradient is None else gradient for name, gradient in gradients.items()},
    }


def crowded(**changes: Any) -> dict[str, Any]:
    """Opaque enough that most pixels stop, with alphas at the cap."""
    made = scene(n=400, width=40, height=24, **changes)
    made["opacities"] = made["opacities"].sqrt().clamp(max=1.0)
    made["opacities"][::7] = 1.0
    made["scales"] = made["scales"] * 2
    return made


def needles() -> dict[str, Any]:
    """A thousand times as long as they are thick."""
    made = scene(n=60)
    made["scales"] = made["scales"] * torch.tensor([10.0, 0.01, 0.01], dtype=torch.float64)
    return made


def large_and_far() -> dict[str, Any]:
    """Some fill the picture, some are behind the camera, some are off the picture, one is invisible."""
    made = scene(n=60)
    made["scales"][:5] *= 1000
    made["means"][5:15] *= 100
    made["opacities"][15] = 0.0
    return made


SCENES = {
    "a cloud": (scene(), {}),
    "one gaussian": (scene(n=1), {}),
    "one pixel": (scene(width=1, height=1), {}),
    "no multiple of a cell": (scene(width=33, height=9), {}),
    "three cameras": (scene(cameras=3), {}),
    "crowded": (crowded(), {}),
    "crowded, three cameras": (crowded(cameras=3), {}),
    "needles": (needles(), {}),
    "large and far": (large_and_far(), {}),
    "depth alone": (scene(), {"render_mode": "D"}),
    "expected depth": (scene(), {"render_mode": "RGB+ED"}),
    "15 channels": (scene(channels=MOST_CHANNELS), {}),
    "antialiased, without square boxes": (scene(), {"rasterize_mode": "antialiased", "semantics": "1.6"}),
    "cells of 4 x 4": (crowded(), {"tile_size": 4}),
}


@pytest.mark.parametrize("name", SCENES)
def test_both_engines_draw_and_differentiate_alike(compiled_library: Path, name: str) -> None:
    inputs, options = SCENES[name]
    compiled, torch_alone = (drawn(inputs, engine, **options) for engine in ("compiled", "torch"))
    for part, expected in torch_alone.items():
        assert relative(compiled[part], expected) < 1e-12 or float((compiled[part] - expected).norm()) < 1e-12, part


def test_narrow_vectors_give_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As on a processor without 512-bit vectors."""
    wrapper = tmp_path / "narrow-cc"
    wrapper.write_text(f'#!/bin/sh\nexec {shutil.which("cc") or "cc"} "$@" -mno-avx512f\n')
    wrapper.chmod(0o700)
    monkeypatch.setenv("CC", str(wrapper))
    monkeypatch.setenv(library.CACHE_VARIABLE, str(tmp_path / "cache"))
    try:
        library.compile_libraries()
    except library.NoCompiler as error:
        pytest.skip(f"this compiler knows no narrower vectors: {error}")
    for name in ("crowded", "cells of 4 x 4", "15 channels"):
        inputs, options = SCENES[name]
        compiled, torch_alone = (drawn(inputs, engine, **options) for engine in ("compiled", "torch"))
        single = {key: value.float() if isinstance(value, Tensor) else value for key, value in inputs.items()}
        rounded = drawn(single, "compiled", **options)
        for part, expected in torch_alone.items():
            assert relative(compiled[part], expected) < 1e-12, (name, part)
            assert relative(rounded[part], expected) < 1e-3, (name, part)
    library.loaded.cache_clear()


@pytest.mark.parametrize("seed", range(20))
def test_single_precision_is_as_near_to_the_truth_as_torch(compiled_library: Path, seed: int) -> None:
    """On pairs away from thresholds; where one is on the edge, single pixels differ by up to 1/255 in both."""
    exact = scene(n=80, seed=seed)
    single = {key: value.float() if isinstance(value, Tensor) else value for key, value in exact.items()}
    truth, compiled, torch_alone = drawn(exact, "torch"), drawn(single, "compiled"), drawn(single, "torch")
    for part, expected in truth.items():
        assert relative(compiled[part], expected) < max(3 * relative(torch_alone[part], expected), 1e-5), part


def test_runs_of_gaussians_do_not_change_the_result(compiled_library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lists are made run by run where they would not fit into memory; pixels that have stopped stay so."""
    whole = drawn(crowded(), "compiled")
    monkeypatch.setattr(compositing, "slabs", lambda cells, budget: slabs(cells, 300))
    parts = drawn(crowded(), "compiled")
    for name, expected in whole.items():
        assert relative(parts[name], expected) < 1e-12, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_threads_gives_the_same_bits(compiled_library: Path, dtype: torch.dtype) -> None:
    inputs = {key: value.to(dtype) if isinstance(value, Tensor) else value for key, value in crowded().items()}
    results = []
    for threads in (1, 2, 5, 64):
        with fixed_threads(threads):
            results.append(drawn(inputs, "compiled"))
    for other in results[1:]:
        assert all(torch.equal(other[name], value) for name, value in results[0].items())


def test_parts_are_all_of_the_cells_once() -> None:
    starts = torch.tensor([0, 0, 50, 50, 51, 400, 400], dtype=torch.int32)
    for threads in (1, 2, 3, 100):
        seen: list[int] = []
        in_parts(lambda first, last, seen=seen: seen.extend(range(first, last)), starts, threads)
        assert sorted(seen) == list(range(6)), threads
    with pytest.raises(ValueError, match="1 thread"), fixed_threads(0):
        pass


def test_a_gaussian_that_is_not_finite_reaches_no_pixel(compiled_library: Path) -> None:
    inputs = scene()
    clean = drawn({**inputs, **{name: inputs[name][1:] for name in INPUTS[:5]}}, "compiled")
    for name in INPUTS[:4]:
        broken = {key: value.clone() if isinstance(value, Tensor) else value for key, value in inputs.items()}
        broken[name][0] = math.nan
        assert torch.equal(drawn(broken, "compiled")["picture"], clean["picture"]), name


def test_without_a_library_auto_is_torch_and_compiled_says_what_to_do() -> None:
    library.loaded.cache_clear()
    inputs = scene()
    assert torch.equal(drawn(inputs, "auto")["picture"], drawn(inputs, "torch")["picture"])
    with pytest.raises(ValueError, match="fillerbuster compile"):
        drawn(inputs, "compiled")


def test_with_a_library_auto_is_compiled_up_to_its_channels(compiled_library: Path) -> None:
    inputs = scene()
    assert torch.equal(drawn(inputs, "auto")["picture"], drawn(inputs, "compiled")["picture"])
    many = scene(channels=MOST_CHANNELS + 1)
    assert torch.equal(drawn(many, "auto")["picture"], drawn(many, "torch")["picture"])
    with pytest.raises(ValueError, match="16 channels"):
        drawn(many, "compiled")


def test_a_library_that_others_may_write_is_not_loaded(compiled_library: Path) -> None:
    path = library.library_path(torch.float64)
    path.chmod(path.stat().st_mode | stat.S_IWOTH)
    library.loaded.cache_clear()
    try:
        assert library.loaded(torch.float64) is None
    finally:
        path.chmod(0o700)


def test_a_file_that_is_no_library_is_said_and_torch_draws(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(library.CACHE_VARIABLE, str(tmp_path))
    library.library_path(torch.float64).write_bytes(b"no library")
    library.loaded.cache_clear()
    inputs = scene()
    assert torch.equal(drawn(inputs, "auto")["picture"], drawn(inputs, "torch")["picture"])
    assert caplog.text.count("`fillerbuster compile` makes it anew") == 1
    library.loaded.cache_clear()


def test_without_a_compiler_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(library.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(library.NoCompiler, match="found no program no-such-compiler"):
        library.compile_libraries()
    monkeypatch.setenv("CC", "false")  # a program that fails
    with pytest.raises(library.NoCompiler, match="ended with code 1"):
        library.compile_libraries()
    assert not list((tmp_path / "cache").iterdir())
