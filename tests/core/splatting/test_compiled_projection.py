"""The compiled projection against the torch one: the same rows culled, the same numbers, the same gradients."""

from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.scenes.rasterizer_scenes import INPUTS, backward, relative, scene, with_gradients
from torch import Tensor

from fb_core.splatting.compiled import compositing
from fb_core.splatting.compiled.projection import project_compiled
from fb_core.splatting.compiled.threads import fixed_threads
from fb_core.splatting.projection import SEMANTICS, Gaussians, ProjectionSettings, project_splats
from fb_core.splatting.rasterizer import rasterization

PARTS = ("means2d", "conics", "depths", "compensations")
LEAVES = ("means", "quats", "scales", "covars", "viewmats")


def covariances(inputs: dict[str, Any]) -> dict[str, Any]:
    """The same scene by covariances, symmetric and positive definite."""
    roots = torch.randn(len(inputs["means"]), 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return {**inputs, "covars": (0.01 * roots @ roots.mT).to(inputs["means"].dtype)}


def projected(inputs: dict[str, Any], engine: Callable[..., Any], settings: ProjectionSettings, parts=PARTS):
    """What lies on the screen, and the gradients of a fixed sum over the named parts of it."""
    leaves = {name: inputs[name].clone().requires_grad_() for name in LEAVES if inputs.get(name) is not None}
    shape = {name: leaves.get(name) for name in ("means", "quats", "scales", "covars")}
    splats = Gaussians(**shape, opacities=inputs["opacities"])  # type: ignore[arg-type]
    screen = engine(splats, leaves["viewmats"], inputs["Ks"], inputs.get("usable"), settings)
    generator, loss = torch.Generator().manual_seed(2), torch.zeros((), dtype=torch.float64)
    for name in parts:
        value = getattr(screen, name)
        loss = loss + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64)).sum()
    loss.backward()
    outputs = {name: getattr(screen, name).detach() for name in (*PARTS, "radii", "determinants")}
    return outputs | {f"v_{name}": leaf.grad for name, leaf in leaves.items()}


def agree(inputs: dict[str, Any], settings: ProjectionSettings, parts=PARTS) -> dict[str, Tensor]:
    """Both ways give the same; returns what they give."""
    compiled, expected = (projected(inputs, engine, settings, parts) for engine in (project_compiled, project_splats))
    assert torch.equal(compiled["radii"], expected["radii"])
    for name, value in expected.items():
        if value is not None:
            assert relative(compiled[name], value) < 1e-12 or float((compiled[name] - value).norm()) < 1e-12, name
    return compiled


def settings_of(inputs: dict[str, Any], **changes: Any) -> ProjectionSettings:
    return ProjectionSettings(width=inputs["width"], height=inputs["height"], **changes)


@pytest.mark.parametrize(("version", "antialiased", "by_axes"), product(SEMANTICS, (False, True), (False, True)))
def test_screens_and_gradients_agree(compiled_library: Path, version: str, antialiased: bool, by_axes: bool) -> None:
    inputs = scene(n=300, cameras=3)
    settings = settings_of(inputs, semantics=SEMANTICS[version], antialiased=antialiased)
    seen = agree(inputs if by_axes else covariances(inputs), settings)
    assert 0 < int((seen["radii"] > 0).sum()) < seen["radii"].numel()


@pytest.mark.parametrize("parts", [("means2d",), ("conics",), ("depths",), ("compensations",)])
@pytest.mark.parametrize("by_axes", [True, False])
def test_what_does_not_arrive_gives_nothing(compiled_library: Path, parts: tuple[str], by_axes: bool) -> None:
    inputs = scene(n=70, cameras=2)
    agree(inputs if by_axes else covariances(inputs), settings_of(inputs), parts)


def _changed(**rows: tuple[slice | int, float | Tensor]) -> dict[str, Any]:
    """A scene with some rows of the named inputs set to a value."""
    inputs = scene(n=70, cameras=2)
    for name, (at, value) in rows.items():
        inputs[name][at] = value
    return inputs


def _moved(by: float) -> dict[str, Any]:
    """A scene whose second camera looks from elsewhere, in z of its own axes."""
    inputs = scene(n=70, cameras=2)
    inputs["viewmats"][1, 2, 3] += by
    return inputs


HARD = {
    "zero quaternions": (_changed(quats=(slice(5), 0.0)), {}),
    "a quaternion that underflows": (_changed(quats=(3, 1e-200)), {}),
    "points, without blur": (_changed(scales=(slice(5), 0.0)), {"eps2d": 0.0}),
    "points, with blur": (_changed(scales=(slice(5), 0.0)), {}),
    "huge": (_changed(scales=(slice(5), 1e12)), {}),
    "larger than numbers": (_changed(scales=(slice(5), 1e200)), {}),
    "tiny": (_changed(scales=(slice(5), 1e-12)), {}),
    "one camera sees nothing": (_moved(-100.0), {}),
    "one camera is far": (_moved(100.0), {"far_plane": 50.0}),
    "in the plane of the camera": (_changed(means=(slice(5), 0.0), viewmats=(0, torch.eye(4).double())), {}),
    "a radius that clips": (_changed(), {"radius_clip": 3.0}),
    "not finite": (_changed(means=(3, math.nan), scales=(4, math.inf)), {}),
    "no gaussians": (scene(n=0, cameras=2), {}),
}


@pytest.mark.parametrize("version", SEMANTICS)
@pytest.mark.parametrize("name", HARD)
def test_hard_cases_agree(compiled_library: Path, name: str, version: str) -> None:
    inputs, changes = HARD[name]
    settings = settings_of(inputs, semantics=SEMANTICS[version], **changes)
    if name != "not finite":
        agree(inputs, settings)
        return
    usable = torch.ones(70, dtype=torch.bool)
    usable[3:5] = False
    seen = agree({**inputs, "usable": usable}, settings)
    assert not seen["radii"][:, 3:5].any() and all(value.isfinite().all() for value in seen.values())


def test_single_precision_culls_as_torch(compiled_library: Path) -> None:
    """Not one row of 20,000 is drawn by one and not by the other, and radii are the same but where they round."""
    inputs = scene(n=20_000, dtype=torch.float32)
    for version in SEMANTICS:
        settings = settings_of(inputs, semantics=SEMANTICS[version], antialiased=True)
        compiled, expected = (projected(inputs, engine, settings) for engine in (project_compiled, project_splats))
        assert torch.equal(compiled["radii"] > 0, expected["radii"] > 0)
        assert int((compiled["radii"] != expected["radii"]).sum()) <= 2
        for name in (*PARTS, *(f"v_{name}" for name in ("means", "quats", "scales", "viewmats"))):
            assert relative(compiled[name], expected[name]) < 1e-4, name


def _drawn(inputs: dict[str, Any], **options: Any) -> list[Tensor]:
    leaves = with_gradients(inputs)
    images, alphas, meta = rasterization(**leaves, engine="compiled", absgrad=True, **options)
    backward(images, alphas)
    return [images.detach(), alphas.detach(), meta["means2d"].absgrad, *(leaves[name].grad for name in INPUTS)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_to_eight_threads_give_the_same_bits(compiled_library: Path, dtype: torch.dtype) -> None:
    """Of two pictures of several bands, and of Gaussians of several chunks, some of which are in many bands."""
    inputs = scene(n=5000, cameras=2, width=300, height=260, dtype=dtype)
    inputs["scales"][::100] *= 10
    results = []
    for number in range(1, 9):
        with fixed_threads(number):
            results.append(_drawn(inputs))
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(other, results[0], strict=True))


def test_several_bands_agree_with_torch(compiled_library: Path) -> None:
    inputs = scene(n=500, cameras=2, width=300, height=261)
    compiled = _drawn(inputs)
    leaves = with_gradients(inputs)
    images, alphas, _ = rasterization(**leaves, engine="torch")
    backward(images, alphas)
    expected = [images, alphas, *(leaves[name].grad for name in INPUTS)]
    for got, wanted in zip([*compiled[:2], *compiled[3:]], expected, strict=True):
        assert relative(got, wanted) < 1e-12


@pytest.mark.parametrize("name", ["none", "behind the camera"])
def test_a_scene_with_nothing_to_see_is_empty(compiled_library: Path, name: str) -> None:
    inputs = scene(n=0 if name == "none" else 20, cameras=2)
    inputs["viewmats"][:, 2, 3] -= 100.0
    images, alphas, *gradients = _drawn(inputs)
    assert not images.any() and not alphas.any() and not any(gradient.any() for gradient in gradients)


def test_precision_and_gradients_follow_the_caller(compiled_library: Path) -> None:
    inputs = scene(n=70, dtype=torch.float32)
    plain = _drawn(inputs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(torch.equal(one, two) for one, two in zip(_drawn(inputs), plain, strict=True))
    with torch.inference_mode():
        assert torch.equal(rasterization(**inputs, engine="compiled")[0], plain[0])
    for name in INPUTS:
        leaves = with_gradients(inputs, names=(name,))
        backward(*rasterization(**leaves, engine="compiled")[:2])
        assert torch.equal(leaves[name].grad, plain[3 + INPUTS.index(name)]), name


def test_a_second_way_back_says_that_it_is_one(compiled_library: Path) -> None:
    leaves = with_gradients(scene(n=70))
    loss = rasterization(**leaves, engine="compiled")[0].sum()
    loss.backward()
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()


def test_pictures_without_a_way_back_are_freed(compiled_library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, without the garbage collector: nothing that the graph holds holds the graph."""
    tables: list[weakref.ref[Tensor]] = []

    def part(*given: Any) -> Any:
        run = original(*given)
        tables.append(weakref.ref(run.held["table"]))
        return run

    original = compositing._part
    monkeypatch.setattr(compositing, "_part", part)
    gc.disable()
    try:
        drawn = rasterization(**with_gradients(scene(n=70)), engine="compiled")
        assert tables[0]() is not None
        del drawn
        assert tables[0]() is None
    finally:
        gc.enable()
