"""Metrics against closed forms and against independent implementations; contact sheets."""

from __future__ import annotations

import math

import pytest
import torch

from fb_core.evaluation.figures.contact_sheet import Strip, evenly, write_contact_sheet
from fb_core.evaluation.metrics.image_metrics import hole_share, mean_quality, psnr, ssim


def pictures(count: int = 3, side: int = 24) -> torch.Tensor:
    return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0))


def test_psnr_of_a_constant_error_is_its_logarithm():
    truth = 0.5 * torch.ones(2, 3, 8, 8)
    error = torch.tensor([0.1, 0.01]).reshape(2, 1, 1, 1)
    assert torch.allclose(psnr(truth + error, truth), torch.tensor([20.0, 40.0]), atol=1e-3)


def test_identical_pictures_have_finite_psnr_and_ssim_one():
    truth = pictures()
    assert torch.equal(psnr(truth, truth), torch.full((3,), 120.0))
    assert torch.allclose(ssim(truth, truth), torch.ones(3), atol=1e-5)


def test_metrics_treat_every_view_alone():
    images, truth, order = pictures(), pictures().flip(3), [2, 0, 1]
    for metric in (psnr, ssim):
        assert torch.allclose(metric(images, truth)[order], metric(images[order], truth[order]), atol=1e-5)
        one_by_one = torch.cat([metric(images[i : i + 1], truth[i : i + 1]) for i in range(3)])
        assert torch.allclose(metric(images, truth), one_by_one, atol=1e-5)


def test_ssim_agrees_with_the_loss_of_the_splats():
    """One implementation, for pictures in either layout; both use valid windows only."""
    from fb_core.splatting import photometric

    images, truth = pictures(), (pictures() + 0.1 * torch.randn(3, 3, 24, 24)).clamp(0, 1)
    expected = torch.stack(
        [photometric.ssim(a.movedim(0, -1), b.movedim(0, -1)) for a, b in zip(images, truth, strict=True)]
    )
    assert torch.allclose(ssim(images, truth), expected, atol=1e-4)


@pytest.mark.parametrize("scene", ["noise", "near", "one colour", "black"])
def test_ssim_agrees_with_two_libraries(scene: str):
    """kornia's without what it adds to denominators, torchmetrics' without windows that hang over the border."""
    from kornia.metrics import ssim as of_kornia
    from torchmetrics.functional.image import structural_similarity_index_measure as of_torchmetrics

    truth = pictures(side=32).double()
    images = truth.flip(3)
    if scene == "near":
        images = (truth + 0.02 * torch.randn(3, 3, 32, 32)).clamp(0, 1)
    elif scene != "noise":
        truth = torch.full_like(truth, 0.5 if scene == "one colour" else 0.0)
        images = truth + 1e-3
    ours = ssim(images, truth)
    kornia = of_kornia(images, truth, 11, 1.0, eps=0.0, padding="valid").mean(dim=(1, 2, 3))
    assert torch.allclose(ours, kornia, atol=1e-6)
    _, whole = of_torchmetrics(images, truth, data_range=1.0, reduction="none", return_full_image=True)
    assert torch.allclose(ours, whole[..., 5:-5, 5:-5].mean(dim=(1, 2, 3)), atol=1e-6)


def test_ssim_of_constant_pictures_is_its_luminance_term():
    dark, light, c1 = 0.2, 0.6, 0.01**2
    expected = (2 * dark * light + c1) / (dark**2 + light**2 + c1)
    value = ssim(torch.full((1, 3, 16, 16), dark), torch.full((1, 3, 16, 16), light))
    assert float(value) == pytest.approx(expected, abs=1e-4)


def test_hole_share_counts_pixels_below_one_half():
    accumulation = torch.tensor([[[0.0, 0.49], [0.5, 1.0]], [[1.0, 1.0], [1.0, 1.0]]])
    assert hole_share(accumulation).tolist() == [0.5, 0.0]


def test_mean_quality_is_the_mean_over_views():
    images, truth, accumulation = pictures(), pictures().flip(2), torch.rand(3, 24, 24)
    told = mean_quality(images, truth, accumulation)
    assert list(told) == ["psnr", "ssim", "hole_share"]
    assert told["psnr"] == pytest.approx(float(psnr(images, truth).mean()), rel=1e-5)
    assert told["hole_share"] == pytest.approx(float((accumulation < 0.5).float().mean()), rel=1e-5)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_bad_pictures_are_refused_in_one_sentence(metric):
    truth = pictures()
    broken = truth.clone()
    broken[0, 0, 0, 0] = math.nan
    with pytest.raises(ValueError, match="finite"):
        metric(broken, truth)


def test_pictures_without_room_for_a_window_are_refused():
    with pytest.raises(ValueError, match="at least 11 x 11 pixels, got 8 x 16"):
        ssim(torch.zeros(1, 3, 16, 8), torch.zeros(1, 3, 16, 8))
    with pytest.raises(ValueError, match="at least one view"):
        mean_quality(torch.zeros(0, 3, 16, 16), torch.zeros(0, 3, 16, 16), torch.zeros(0, 16, 16))


def test_evenly_keeps_the_ends():
    assert evenly(range(24), 4) == [0, 8, 15, 23]
    assert evenly([1, 2], 4) == [1, 2]


def test_contact_sheet_shows_every_picture(tmp_path):
    """Coloured pictures are found again, in their places, in the file."""
    from fb_core.data.media import read_image

    colors = [
        torch.tensor(c).reshape(3, 1, 1).expand(3, 9, 16) for c in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    ]
    strips = [Strip(heading="First", pictures=colors, captions=["a", "b", "c"]), Strip(heading="None", pictures=[])]
    write_contact_sheet(tmp_path / "sheet.png", strips, title="Title", columns=2, dpi=50)
    sheet = read_image(tmp_path / "sheet.png")
    centers = []
    for color in colors:
        rows, columns = ((sheet - color[:, :1, :1]).abs().sum(dim=0) < 0.02).nonzero(as_tuple=True)
        assert len(rows) > 500
        centers.append((float(rows.float().mean()), float(columns.float().mean())))
    (red, green, blue) = centers
    assert red[0] == pytest.approx(green[0], abs=1) and red[1] < green[1]  # one line
    assert blue[0] > red[0] and blue[1] == pytest.approx(red[1], abs=1)  # the next line begins at the left


def test_contact_sheets_refuse_nothing_and_wrong_captions(tmp_path):
    with pytest.raises(ValueError, match="at least one picture"):
        write_contact_sheet(tmp_path / "sheet.png", [Strip(heading="None", pictures=[])], title="Title")
    with pytest.raises(ValueError, match="expected 1 captions"):
        Strip(heading="One", pictures=[torch.zeros(3, 4, 4)], captions=[])
    assert not list(tmp_path.iterdir())
