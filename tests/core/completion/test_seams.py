"""Laws of the colour match between generated and captured regions."""

from __future__ import annotations

import torch

from fb_core.completion.seams import spread, without_seams


def _pictures(seed: int, count: int = 2, size: int = 32) -> torch.Tensor:
    return 0.3 + 0.4 * torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(seed))


def test_nothing_reliable_changes_nothing():
    images = _pictures(0)
    same = without_seams(images, torch.full_like(images, torch.nan), torch.zeros(2, 32, 32, dtype=torch.bool))
    torch.testing.assert_close(same, images)


def test_agreeing_pictures_stay():
    images = _pictures(1)
    reliable = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(2)) < 0.3
    torch.testing.assert_close(without_seams(images, images, reliable), images)


def test_a_tint_is_gone_where_reliable_and_fades_with_the_distance():
    truth, tint = torch.full((1, 3, 64, 64), 0.5), torch.tensor([0.2, -0.1, 0.05])[:, None, None]
    reliable = torch.zeros(1, 64, 64, dtype=torch.bool)
    reliable[..., :16] = True
    error = (without_seams(truth + tint, truth, reliable) - truth).abs()[0] / tint.abs()
    assert float(error[..., :12].max()) < 1e-5
    columns = error.mean(dim=(0, 1))
    assert float(columns[16]) < 0.6 and float(columns[17]) < 0.8, "no full step at the border"
    assert bool((columns[16:].diff() > -0.02).all()), "the tint comes back gradually"
    assert float(columns[-1]) > 0.9, "what is far away keeps its own colour"


def test_a_view_is_mended_by_its_own_pixels_only():
    images, rendered = _pictures(3), _pictures(4)
    reliable = torch.zeros(2, 32, 32, dtype=torch.bool)
    reliable[0, 8:20, 4:9] = True
    both = without_seams(images, rendered, reliable)
    torch.testing.assert_close(both[1], images[1])
    torch.testing.assert_close(both[:1], without_seams(images[:1], rendered[:1], reliable[:1]))


def test_mirrored_pictures_are_mended_mirrored():
    images, rendered = _pictures(5), _pictures(6)
    reliable = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(7)) < 0.2
    mirrored = without_seams(images.flip(-1), rendered.flip(-1), reliable.flip(-1))
    torch.testing.assert_close(mirrored.flip(-1), without_seams(images, rendered, reliable))


def test_unreliable_renders_never_matter_and_values_stay_in_range():
    images, rendered = _pictures(8, size=23), 5 * _pictures(9, size=23)
    reliable = torch.rand(2, 23, 23, generator=torch.Generator().manual_seed(10)) < 0.1
    mended = without_seams(images, rendered, reliable)
    poisoned = torch.where(reliable[:, None], rendered, torch.nan)
    torch.testing.assert_close(without_seams(images, poisoned, reliable), mended)
    assert 0 <= float(mended.min()) and float(mended.max()) <= 1


def test_spread_continues_a_constant_and_keeps_what_is_known():
    weight = (torch.rand(3, 1, 9, 14, generator=torch.Generator().manual_seed(11)) < 0.1).float()
    weight[:, :, 4, 4] = 1
    torch.testing.assert_close(spread(torch.full((3, 2, 9, 14), 0.7) * weight, weight), torch.full((3, 2, 9, 14), 0.7))
    values = torch.randn(3, 2, 9, 14, generator=torch.Generator().manual_seed(12)) * weight
    torch.testing.assert_close(spread(values, weight) * weight, values)


def test_pictures_of_one_pixel_and_no_pictures():
    one = without_seams(
        torch.full((1, 3, 1, 1), 0.2), torch.full((1, 3, 1, 1), 0.6), torch.ones(1, 1, 1, dtype=torch.bool)
    )
    torch.testing.assert_close(one, torch.full((1, 3, 1, 1), 0.6))
    assert without_seams(
        torch.empty(0, 3, 8, 8), torch.empty(0, 3, 8, 8), torch.empty(0, 8, 8, dtype=torch.bool)
    ).shape == (0, 3, 8, 8)
