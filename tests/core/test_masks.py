"""Laws of the known-masks."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from twins.rectangles import partly_known_slowly, rotated_rectangle

from fb_core.masks import (
    drop_conditioning,
    grow_hole,
    partly_known,
    to_latent_grid,
    training_mixture,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@given(st.integers(1, 24), st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_mixture_has_a_quarter_known_and_half_unknown(count, seed):
    masks = training_mixture(count, 16, 24, generator=seeded(seed))
    means = masks.flatten(1).mean(dim=1)
    assert masks.shape == (count, 1, 16, 24) and set(masks.unique().tolist()) <= {0.0, 1.0}
    assert int((means == 0).sum()) >= count // 2 and int((means == 1).sum()) >= count // 4


def test_mixture_refuses_more_views_than_there_are():
    with pytest.raises(ValueError, match="do not fit into 4"):
        training_mixture(4, 16, 16, generator=seeded(), known=3, unknown=2)


def test_unrotated_rectangle_has_its_exact_area():
    mask = rotated_rectangle(20, 30, center=(10, 15), size=(6, 8), angle_radians=0.0)
    assert mask.sum() == 48 and mask[7:13, 11:19].all()


@given(st.floats(0, 7))
@settings(max_examples=20, deadline=None)
def test_rotation_keeps_the_area(angle):
    mask = rotated_rectangle(100, 100, center=(50, 50), size=(30, 50), angle_radians=angle)
    assert abs(float(mask.sum()) - 1500) < 80


@pytest.mark.parametrize("seed", range(20))
def test_all_rectangles_at_once_are_the_rectangles_one_by_one(seed: int):
    """Pixels whose centre a rectangle's edge meets within rounding may differ."""
    fast = partly_known(48, 64, generator=seeded(seed))
    assert int((fast != partly_known_slowly(48, 64, seeded(seed))).sum()) <= 1


def test_partly_known_masks_are_partly_known_and_seeded():
    first, again = (partly_known(64, 64, generator=seeded(3)) for _ in range(2))
    assert torch.equal(first, again) and 0 < first.mean() < 1


def test_dropout_has_the_papers_shares():
    generator = seeded(1)
    draws = [drop_conditioning(generator) for _ in range(6000)]
    for wanted in ((True, False), (False, True), (True, True)):
        assert abs(draws.count(wanted) / 6000 - 0.1 / 3) < 0.01


def test_growing_a_hole_by_five_pixels():
    known = torch.ones(1, 1, 32, 32)
    known[..., 16, 16] = 0
    grown = grow_hole(known, pixels=5)
    assert int((grown == 0).sum()) == 121 and torch.equal(grow_hole(known, pixels=0), known)


def test_latent_masks_keep_the_mean():
    known = training_mixture(4, 32, 48, generator=seeded(5))
    assert torch.allclose(to_latent_grid(known).mean(dim=(2, 3)), known.mean(dim=(2, 3)), atol=1e-6)
