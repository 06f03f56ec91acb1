"""What the tests' shape checks hold, for every kind of function, and that they look into its code once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jaxtyping
import pytest
import shape_checks
import torch
from jaxtyping import Float
from torch import Tensor

WIDE, TALL = torch.zeros(2, 3), torch.zeros(3, 2)


def like_the_hook(thing: Callable) -> Callable:
    """What jaxtyping's import hook writes above each function and class."""
    return jaxtyping.jaxtyped(typechecker=shape_checks.checked)(thing)


@like_the_hook
def by_position(a: Float[Tensor, "h w"], b: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return a


@like_the_hook
def by_name(a: Float[Tensor, "h w"], *, b: Float[Tensor, "h w"] | None = None) -> Float[Tensor, "h w"]:
    return a


@like_the_hook
def many(*a: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return a[0]


@like_the_hook
def one_by_one(a: Float[Tensor, "h w"], b: Float[Tensor, "h w"]) -> Iterator[Tensor]:
    yield a


@like_the_hook
@dataclasses.dataclass(frozen=True, kw_only=True)
class Pair:
    a: Float[Tensor, "h w"]
    b: Float[Tensor, "h w"]


@like_the_hook
class Picture:
    height, width = 2, 3

    @like_the_hook
    def method(self, a: Float[Tensor, "h w"], b: Float[Tensor, "h w"]) -> None: ...

    @property
    @like_the_hook
    def turned(self) -> Float[Tensor, "2 3"]:
        return TALL

    @like_the_hook
    def of_this_size(self, a: Float[Tensor, "{self.height} {self.width}"]) -> None: ...


def inner(times: int = 1) -> Callable:
    @like_the_hook
    def inside(a: Float[Tensor, "h w"], *rest: Float[Tensor, "h w"], **named: Float[Tensor, "h w"]) -> Tensor:
        return times * a

    return inside


@pytest.mark.parametrize(
    "call",
    [
        lambda b: by_position(WIDE, b),
        lambda b: by_name(WIDE, b=b),
        lambda b: many(WIDE, b),
        lambda b: list(one_by_one(WIDE, b)),
        lambda b: Pair(a=WIDE, b=b),
        lambda b: Picture().method(WIDE, b),
        lambda b: Picture().of_this_size(b),
        lambda b: inner()(WIDE, b),
        lambda b: inner()(WIDE, other=b),
    ],
    ids=["position", "name", "many", "generator", "dataclass", "method", "size of self", "inner", "inner by name"],
)
def test_shapes_that_disagree_are_refused_and_those_that_agree_are_not(call: Callable) -> None:
    call(WIDE)
    with pytest.raises(jaxtyping.TypeCheckError):
        call(TALL)


@pytest.mark.parametrize("wrong", [WIDE.int(), WIDE[None], [1.0], None])
@pytest.mark.parametrize(
    "call",
    [by_position, many, lambda a, b: inner()(a, b), lambda a, b: Pair(a=a, b=b)],
    ids=["function", "many", "inner", "dataclass"],
)
def test_what_is_no_such_tensor_is_refused(call: Callable, wrong: object) -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        call(WIDE, wrong)


def test_results_are_looked_at_too() -> None:
    @like_the_hook
    def inside(a: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        return a.T

    with pytest.raises(jaxtyping.TypeCheckError, match="result"):
        inside(WIDE)
    with pytest.raises(jaxtyping.TypeCheckError):
        _ = Picture().turned


def test_a_length_holds_within_one_call_alone() -> None:
    """A function that calls another with other shapes, and itself once more."""

    @like_the_hook
    def down(a: Float[Tensor, "h w"], b: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        if len(a) > 1:
            by_position(a.T, b.T)
            down(a[1:], b[1:])
        return b

    assert down(WIDE, WIDE) is WIDE


def test_an_int_passes_for_a_float_and_a_string_does_not() -> None:
    @like_the_hook
    def inside(scale: float) -> float:
        return scale

    assert inside(2) == 2
    with pytest.raises(jaxtyping.TypeCheckError, match="scale"):
        inside("2")


def test_classes_with_fields_of_the_same_names_have_their_own_types() -> None:
    """The code of their ``__init__`` is the same."""
    named = like_the_hook(dataclasses.make_dataclass("Named", [("a", str), ("b", str)], kw_only=True, frozen=True))
    assert named(a="x", b="y").b == "y" and Pair(a=WIDE, b=WIDE).b is WIDE
    with pytest.raises(jaxtyping.TypeCheckError):
        Pair(a="x", b="y")


def test_a_function_within_a_function_is_looked_into_once() -> None:
    inner()(WIDE)
    before = len(shape_checks.CHECKS)
    assert [inner(times)(WIDE + 1).max() for times in (1, 2, 3)] == [1, 2, 3]
    assert len(shape_checks.CHECKS) == before


def test_the_core_is_checked_and_the_checks_can_be_turned_off(shapes_unchecked: None) -> None:
    from fb_core.masks import to_latent_grid

    with pytest.raises((ValueError, RuntimeError)):  # what users meet
        to_latent_grid(torch.zeros(3))
    jaxtyping.config.update("jaxtyping_disable", False)
    with pytest.raises(jaxtyping.TypeCheckError):
        to_latent_grid(torch.zeros(3))
