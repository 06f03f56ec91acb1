"""Trust of every pixel: laws of the curve, evidence in closed form, and what becomes of it in losses, checkpoints and
folders.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.plugin.splat_models import SIZE, camera, make_batch, make_model, make_optimizers
from helpers.scenes.completions import room_cameras
from helpers.scenes.trusted import CONFIG, Knows, views_of

from fb_core.completion.brought_views import brought_views
from fb_core.completion.pixel_trust import (
    LEAST,
    SOURCES,
    Curve,
    Evidence,
    angle_to_known,
    disagreement,
    evidence_of,
    fitted_curve,
)
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.rounds import CapturedView
from fb_core.completion.trust import Surroundings, Trust, measured_trust
from fb_core.data.capture.captures import TRUST_KEY, read_capture
from fb_core.data.media import read_image
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import sphere
from fb_core.splatting import photometric
from fb_nerfstudio.capture.unseen import Unseen
from fb_nerfstudio.generation.bank import Bank
from fb_nerfstudio.generation.trusted_views import shell_depth, with_pixel_trust
from method_configs.evaluations.trust import bars_of, bins

UP = torch.tensor([0.0, 0.0, 1.0])


def evidence(seed: int = 0, count: int = 3, side: int = 16) -> Evidence:
    draw = torch.Generator().manual_seed(seed)
    return Evidence(**{name: torch.rand(count, side, side, generator=draw) * 0.1 for name in SOURCES})


def turned(*degrees: float, side: int = 16) -> Pinholes:
    """Cameras at one place that look to these sides, 90 degrees wide."""
    angle = torch.deg2rad(torch.tensor(degrees))
    looks = torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)
    return Pinholes.looking_at(torch.zeros(len(degrees), 3), looks, up=UP, fov_degrees=90.0, width=side, height=side)


@pytest.mark.parametrize("source", SOURCES)
def test_more_evidence_against_a_pixel_never_makes_it_more_believed(source: str) -> None:
    told = evidence()
    error = sum(0.2 * getattr(told, name) for name in SOURCES) + 0.01 * torch.rand(
        3, 16, 16, generator=torch.Generator().manual_seed(5)
    )
    curve = fitted_curve(told, error, torch.ones(3, 16, 16, dtype=torch.bool), baseline=0.05)
    worse = dataclasses.replace(told, **{source: getattr(told, source) + 0.05})
    assert min(curve.weights) >= 0 and bool((curve.trust(worse) <= curve.trust(told)).all())
    assert float(curve.trust(told).min()) >= LEAST and float(curve.trust(worse).max()) <= 1


def test_the_curve_finds_the_error_that_the_evidence_tells() -> None:
    told = evidence()
    error = 0.01 + 0.5 * told.known + 0.3 * told.distance
    curve = fitted_curve(told, error, torch.ones(3, 16, 16, dtype=torch.bool), baseline=0.1)
    assert curve.weights == pytest.approx((0.01, 0.5, 0.0, 0.0, 0.3), abs=1e-6)
    free = dataclasses.replace(told, views=torch.zeros(3, 16, 16), spread=torch.zeros(3, 16, 16))
    assert torch.allclose(curve.error(free), error.double(), atol=1e-6)


def test_what_nobody_can_tell_counts_as_usual_and_gets_no_weight_where_it_never_could() -> None:
    told = evidence()
    nothing = torch.full((3, 16, 16), torch.nan)
    told = dataclasses.replace(told, views=nothing, spread=nothing)
    curve = fitted_curve(told, 0.5 * told.known, torch.ones(3, 16, 16, dtype=torch.bool), baseline=0.1)
    assert curve.weights[2] == curve.weights[3] == 0
    silent = dataclasses.replace(told, known=nothing)
    assert torch.allclose(
        curve.error(silent), torch.full((3, 16, 16), 0.5 * curve.usual[0], dtype=torch.float64), atol=1e-4
    )


def test_two_views_that_differ_and_samples_that_spread_bound_the_error_from_below() -> None:
    sure = Curve(weights=(0.0,) * 5, usual=(0.0,) * 4, baseline=0.1)
    none = torch.zeros(1, 4, 4)
    apart = Evidence(known=none, views=none + 0.08, spread=none, distance=none)
    assert torch.allclose(sure.error(apart), torch.full((1, 4, 4), 0.04, dtype=torch.float64)) and float(
        sure.trust(apart)[0, 0, 0]
    ) == (pytest.approx(0.6))
    assert float(sure.error(dataclasses.replace(apart, views=none, spread=none + 0.02)).max()) == pytest.approx(0.02)


def test_nothing_to_learn_from_leaves_little_trust() -> None:
    curve = fitted_curve(evidence(), torch.zeros(3, 16, 16), torch.zeros(3, 16, 16, dtype=torch.bool), baseline=0.1)
    assert float(curve.trust(evidence()).max()) == pytest.approx(LEAST)


def test_a_pixel_that_counts_for_nothing_decides_nothing() -> None:
    told, counts = evidence(), torch.ones(3, 16, 16, dtype=torch.bool)
    counts[:, :, :4] = False
    error = 0.5 * told.known
    spoilt = error.masked_fill(~counts, 9.0)
    assert fitted_curve(told, error, counts, baseline=0.1).weights == pytest.approx(
        fitted_curve(told, spoilt, counts, baseline=0.1).weights
    )


def test_the_angle_to_the_nearest_known_pixel() -> None:
    known = torch.zeros(2, 16, 16, dtype=torch.bool)
    known[0, :, :4] = True
    angle = angle_to_known(known, turned(0.0, 0.0))
    focal = 8.0
    assert bool((angle[0, :, :4] == 0).all())
    assert float(angle[0, 8, 15]) == pytest.approx(math.atan(12 / focal), abs=0.02)
    assert bool((angle[1] == angle[1, 0, 0]).all()) and float(angle[1, 0, 0]) == pytest.approx(
        math.atan(16 * 2**0.5 / focal), abs=1e-4
    )


def test_views_of_one_wall_that_agree_and_that_do_not() -> None:
    cameras = turned(0.0, 45.0, 180.0)  # the second looks more to the left
    depth = shell_depth(sphere(torch.zeros(3), 2.0), cameras)
    images = torch.zeros(3, 3, 16, 16)
    assert float(disagreement(images, cameras, depth).nan_to_num(0).max()) == 0
    images[1] = 0.5
    found = disagreement(images, cameras, depth)
    assert float(found[0, 8, 0]) == pytest.approx(0.25) and math.isnan(found[0, 8, 15]), (
        "the right half is shown by no other view"
    )
    assert bool(found[2].isnan().all()), "nothing looks the other way"
    hidden = depth.clone()
    hidden[1] *= 0.5  # something else stands in front there
    assert bool(disagreement(images, cameras, hidden)[0].isnan().all())
    assert bool(disagreement(images[:1], cameras[[0]], depth[:1]).isnan().all()), "one view alone"


@pytest.mark.parametrize("count", [1, 2, 3])
def test_views_without_depth_without_colours_and_alike(count: int) -> None:
    cameras = turned(*[0.0] * count)
    told = evidence_of(
        torch.rand(count, 3, 16, 16),
        cameras,
        torch.full((count, 16, 16), torch.inf),
        torch.zeros(count, 16, 16, dtype=torch.bool),
    )
    assert bool(torch.isnan(told.known).all() & torch.isnan(told.views).all() & torch.isnan(told.spread).all())
    assert bool(torch.isfinite(told.distance).all())


class Fades(Knows):
    """Knows the wholly hidden views; in all others it is the more wrong the farther off a known pixel is."""

    def complete(self, views, *, generator, sampling=None, on_step=None, prompt=None, current=None):
        right = super().complete(views, generator=generator, sampling=sampling, on_step=on_step)
        known = views.image_known[:, 0] >= 1
        away = angle_to_known(known | ~known.flatten(1).any(dim=1)[:, None, None], turned(*[0.0] * len(views)))
        noise = torch.randn(right.images.shape, generator=generator)
        return dataclasses.replace(right, images=right.images + 0.2 * away[:, None].sqrt() * noise)


def turning_photos(step: float, count: int = 12) -> list[CapturedView]:
    """Pictures of a coloured sphere, so many degrees apart."""
    cameras = turned(*[step * number for number in range(count)])
    images = 0.5 + 0.5 * torch.sin(3 * cameras.directions()).movedim(-1, 1)
    return [
        CapturedView(image=image, known=torch.ones(1, 16, 16), camera=cameras[[at]]) for at, image in enumerate(images)
    ]


def in_a_room(cameras: Pinholes) -> Surroundings:
    return Surroundings(shell_depth(sphere(torch.zeros(3), 5.0), cameras), None)


def test_a_model_that_errs_far_from_what_is_known_is_believed_less_there() -> None:
    context = turning_photos(30.0)
    trust = measured_trust(context, Fades(context), CONFIG, size=16, surroundings=in_a_room)
    assert trust.curve is not None and trust.curve.weights[4] > 0
    near, far = (
        Evidence(**{name: torch.full((1, 4, 4), value if name == "distance" else 0.0) for name in SOURCES})
        for value in (0.0, 1.0)
    )
    assert float(trust.curve.error(far).mean()) > float(trust.curve.error(near).mean())


@pytest.mark.parametrize(("step", "count", "parts"), [(8.0, 12, True), (90.0, 4, False)])
def test_where_views_overlap_much_parts_of_the_scene_are_hidden_from_all_of_them(
    step: float, count: int, parts: bool
) -> None:
    """Hiding a view alone would hide nothing that others do not show, and nothing could be learned about what nobody
    has seen.
    """
    context = turning_photos(step, count)
    model = Knows(context)
    trust = measured_trust(context, model, CONFIG, size=16, surroundings=in_a_room)
    (asked,) = model.asked
    known = asked.image_known[: len(context) - trust.hidden, 0] > 0
    towards = asked.raymaps[: len(known), 3:].movedim(1, -1)
    lost = 0
    for look in towards[:, 8, 8]:  # what is hidden from one is hidden from all that look there
        near = (towards @ look) > math.cos(math.radians(4))
        lost += bool(near.any()) and not bool(known[near].any())
    assert lost > 0 or not parts
    touched = int((~known).flatten(1).any(dim=1).sum())
    assert (touched > trust.hidden) == parts, "halves of as many views are hidden in any case"
    assert trust.value == 1.0 and trust.model < 1e-10, (
        "what is hidden of the scene does not spoil the comparison of views"
    )


def test_the_sentence_tells_the_splats_too_and_a_measurement_survives_as_plain_values() -> None:
    told = Trust(
        hidden=2,
        model=0.01,
        mean=0.04,
        nearest=0.05,
        splats=0.001,
        curve=Curve(weights=(0.1,) * 5, usual=(0.2,) * 4, baseline=0.04),
    )
    assert "10.0 dB worse than the splats' render" in told.in_words
    assert Trust.from_state(told.state()) == told
    nothing = Trust.from_state(Trust(hidden=0, model=math.nan, mean=math.nan, nearest=math.nan).state())
    assert nothing.value == 1.0 and nothing.curve is None
    old = Trust.restored(None, 0.43)
    assert old is not None and old.value == pytest.approx(0.43) and old.curve is None, (
        "a checkpoint of an earlier version"
    )
    assert Trust.restored(told.state(), told.value) == told and Trust.restored(None, None) is None


# ---- in the training ------------------------------------------------------------------------------------------------


def with_map(trust: torch.Tensor) -> CompletedViews:
    """Three views whose pixels are believed so far (h x w, 0 to 1)."""
    views = views_of(1.0)
    return dataclasses.replace(
        views, trust=(trust * 255).round().to(torch.uint8).expand(3, 16, 16)[..., None].contiguous()
    )


def test_pixels_of_no_trust_have_no_gradient_and_change_nothing() -> None:
    model, outputs, batch = loss_of_a_picture()
    trust = torch.ones(32, 32, 1)
    trust[:, :16] = 0
    rgb = outputs["rgb"]
    loss = model.get_loss_dict(outputs, batch | {"trust": trust})["main_loss"]
    gradient = torch.autograd.grad(loss, rgb)[0]
    assert bool((gradient[:, :16] == 0).all()) and bool((gradient[:, 16:] != 0).any())
    other = {"image": batch["image"].clone(), "mask": batch["mask"]}
    other["image"][:, :16] = 0.123
    assert float(model.get_loss_dict(outputs, other | {"trust": trust})["main_loss"].detach()) == pytest.approx(
        loss.item()
    )
    assert float(model.get_loss_dict(outputs, batch | {"trust": 0 * trust})["main_loss"]) == 0


def test_even_trust_is_a_weight_of_the_view() -> None:
    model, outputs, batch = loss_of_a_picture()
    whole = model.get_loss_dict(outputs, batch)["main_loss"]
    half = model.get_loss_dict(outputs, batch | {"trust": torch.full((32, 32, 1), 0.5)})["main_loss"]
    assert float(half) == pytest.approx(0.5 * float(whole), rel=1e-5)
    assert float(model.get_loss_dict(outputs, batch | {"trust": torch.ones(32, 32, 1)})["main_loss"]) == pytest.approx(
        float(whole), rel=1e-6
    )


def test_losses_of_normals_count_by_trust_too() -> None:
    model = make_model(normal_loss_from=0, background_color="black").train()
    model.step_cb(make_optimizers(model), 1)
    outputs, batch = model(camera()), make_batch() | {"mask": torch.ones(SIZE, SIZE, 1)}
    plain, half, none = (
        model.get_loss_dict(outputs, batch | {"trust": torch.full((SIZE, SIZE, 1), value)}) for value in (1.0, 0.5, 0.0)
    )
    for name in ("main_loss", "normal_alignment", "normal_tv"):
        assert half[name].item() == pytest.approx(0.5 * plain[name].item(), rel=1e-5) and none[name] == 0


def loss_of_a_picture():
    """A model, what it shows, and a picture with a mask to compare with."""
    model = make_model(ssim_lambda=0.2)
    rgb = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    outputs = {"rgb": rgb, "background": torch.zeros(3), "accumulation": torch.ones(32, 32, 1)}
    mask = torch.ones(32, 32, 1, dtype=torch.bool)
    mask[:4] = False
    return model, outputs, {"image": torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1)), "mask": mask}


def test_weighted_dissimilarity_is_one_minus_ssim_for_whole_weights() -> None:
    first, second = torch.rand(2, 20, 24, 3, dtype=torch.float64)
    known = (torch.rand(20, 24, 1) > 0.2).double()
    ones = torch.ones(20, 24, 1, dtype=torch.float64)
    for mask in (known, None):
        expected = 1 - photometric.ssim(first, second, mask)
        assert torch.allclose(photometric.dissimilarity(first, second, mask, ones), expected)
        assert torch.allclose(photometric.dissimilarity(first, second, mask), expected)


def test_the_bank_gives_trust_by_pixel_and_draws_by_what_is_believed() -> None:
    trust = torch.zeros(16, 16)
    trust[:, :4] = 0.8
    bank = Bank.of(with_map(trust), "cpu")
    _, batch = bank.batch(0, as_float=False)
    assert batch["view_weight"] == 1.0 and batch["trust"].shape == (16, 16, 1)
    assert torch.allclose(batch["trust"][..., 0], trust, atol=2e-3)
    assert bank.shares[0] == pytest.approx(0.2, abs=1e-3)
    nothing = Bank.of(with_map(torch.zeros(16, 16)), "cpu")
    assert nothing.share(most=0.5, captured=3) == 0 and nothing.drawn(7, seed=0, probability=0.0) is None


def test_pixel_trust_survives_checkpoints_folders_and_the_way_back(tmp_path) -> None:
    trust = torch.linspace(0, 1, 16).expand(16, 16)
    views = with_map(trust)
    again = CompletedViews.from_state(views.state())
    assert torch.equal(again.trust, views.trust)
    old = views.state()
    del old["trust"]
    assert CompletedViews.from_state(old).trust is None, "a checkpoint of an earlier version"
    both = CompletedViews.cat([views_of(0.5), views])
    assert torch.equal(both.trust[3:], views.trust) and bool((both.trust[:3] == round(255 * 0.5)).all())
    assert torch.equal(both[[4]].trust, views.trust[[1]])
    capture = read_capture(views.save_capture(tmp_path / "views").root)
    for frame in capture.frames:
        picture = read_image(capture.root / frame.extra[TRUST_KEY])
        assert torch.allclose(picture[0], trust, atol=3e-3)
    back = brought_views(capture.frames, number=9)
    assert torch.equal(back.trust, views.trust)
    escaping = [
        dataclasses.replace(frame, extra=frame.extra | {TRUST_KEY: "../../secret.png"}) for frame in capture.frames
    ]
    assert brought_views(escaping, number=9).trust is None


def test_views_get_the_trust_that_the_curve_tells_and_their_mean() -> None:
    cameras = room_cameras(1)[0][[0] * 3]
    views = dataclasses.replace(views_of(1.0), cameras=cameras)
    mask = torch.ones(3, 16, 16, dtype=torch.bool)
    mask[:, :, :8] = False  # the left half is seen
    unseen = Unseen(mask=mask, points=torch.zeros(3, 16, 16, 3))
    curve = Curve(weights=(0.0, 0.0, 0.0, 0.0, 0.1), usual=(0.0,) * 4, baseline=0.1)
    trusted = with_pixel_trust(views, unseen, None, sphere(torch.zeros(3), 3.0), curve)
    assert trusted.trust is not None and trusted.trust.shape == (3, 16, 16, 1)
    row = trusted.trust[0, 8, :, 0].float()
    assert bool((row[:8] == 255).all()) and bool((row[8:].diff() <= 0).all()) and float(row[15]) < 150
    assert trusted.origins[0].trust == pytest.approx(float(trusted.trust[0].float().mean() / 255), abs=3e-3)
    assert with_pixel_trust(views, unseen, None, sphere(torch.zeros(3), 3.0), None) is views


def test_five_bins_of_trust_and_their_bar() -> None:
    trust = torch.linspace(0, 1, 100, dtype=torch.float64)
    rows = bins("a part", trust, 1 - trust, 1 - trust)
    assert len(rows) == 5 and [row["trust"] for row in rows] == sorted(row["trust"] for row in rows)
    (bar,) = bars_of(rows)
    assert bar.value == pytest.approx(-0.202, abs=1e-3) and bar.holds
    assert not bars_of(bins("a part", trust, trust, trust))[0].holds
