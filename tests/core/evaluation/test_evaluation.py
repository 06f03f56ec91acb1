"""The evaluation of completion: baselines have closed-form answers, results are reproducible, known views are never
scored.
"""

import pytest
import torch
from helpers.tiny_models import tiny_model

from fb_core.data.telea import inpainted
from fb_core.evaluation.completion import (
    METHODS,
    CompletionTask,
    RoomResult,
    baselines,
    evaluate_completion,
    likeliest_of,
    mean_color,
    mean_of,
    nearest_known,
    started_at,
    summary,
    unseen_room,
)
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.evaluation.reprojection import reproject
from fb_core.inpainter import SamplingConfig

TASK = CompletionTask(rooms=2, views=4, known=2)
QUICK = SamplingConfig(steps=2)
ROOM = unseen_room(family="narrow", seed=0, number=0, views=4, size=16)


def test_nearest_known_view_of_a_known_camera_is_its_picture():
    assert torch.equal(nearest_known(ROOM.images, ROOM.cameras, ROOM.cameras), ROOM.images)


def test_mean_colour_is_the_best_constant_picture():
    constant = mean_color(ROOM.images, 4)
    assert constant.shape == ROOM.images.shape
    best = (constant - ROOM.images).square().mean()
    assert all((constant + shift - ROOM.images).square().mean() > best for shift in (-0.05, 0.05))


def test_reprojection_into_the_same_camera_is_the_picture():
    one = ROOM[:1]
    drawn, known = reproject(one.images, one.depth, one.cameras, one.cameras)
    assert bool(known.all()) and torch.allclose(drawn, one.images, atol=1e-6)


def test_reprojection_by_true_depth_finds_the_pixels_that_two_cameras_share():
    room = unseen_room(family="narrow", seed=0, number=1, views=12, size=64)
    drawn, known = reproject(room[:8].images, room[:8].depth, room[:8].cameras, room[8:].cameras)
    error = (drawn - room.images[8:]).abs().mean(dim=1)[known]
    assert 0.2 < float(known.float().mean()) < 1 and float(error.median()) < 0.03


def test_the_nearer_of_two_surfaces_hides_the_other():
    two = ROOM[:1].cameras[[0, 0]]
    images = torch.stack([torch.full((3, 16, 16), 0.2), torch.full((3, 16, 16), 0.9)])
    drawn, _ = reproject(
        images, torch.stack([torch.full((16, 16), 3.0), torch.full((16, 16), 2.0)]), two, ROOM[:1].cameras
    )
    assert torch.allclose(drawn, torch.full_like(drawn, 0.9))


def test_what_lies_behind_a_camera_is_not_drawn_and_nothing_known_is_grey():
    _, known = reproject(ROOM.images[:1], -ROOM.depth[:1], ROOM.cameras[[0]], ROOM.cameras[[0]])
    assert not bool(known.any())
    assert torch.equal(inpainted(ROOM.images[:1], known), torch.full_like(ROOM.images[:1], 0.5))


def test_inpainting_keeps_what_is_known_and_continues_a_constant():
    known = torch.ones(1, 16, 16, dtype=torch.bool)
    known[:, 5:9, 5:9] = False
    filled = inpainted(torch.full((1, 3, 16, 16), 0.25), known)
    assert torch.allclose(filled, torch.full_like(filled, 0.25), atol=1 / 255)


def test_baselines_answer_for_every_hidden_view():
    answers = baselines(ROOM[:3], ROOM[3:].cameras)
    assert set(answers) == set(METHODS) - {"model"}
    assert all(answer.shape == (1, 3, 16, 16) and bool(torch.isfinite(answer).all()) for answer in answers.values())


def test_evaluation_is_reproducible_and_leaves_known_views_alone(tmp_path):
    model = tiny_model(tmp_path)
    first, again = (list(evaluate_completion(model, TASK, QUICK)) for _ in range(2))
    assert [r.psnr for r in first] == [r.psnr for r in again]
    for result in first:
        assert torch.equal(result.completed[:2], result.truth[:2]) and set(result.psnr) == set(METHODS)
    table = summary(first)
    assert table["mean"]["psnr"] == pytest.approx(sum(r.psnr["mean"] for r in first) / 2)


def test_a_model_that_starts_from_the_reprojection_stays_near_it_at_small_strength(tmp_path):
    """At strength 1 it is the model from noise, bit by bit; towards 0 nothing is left to do but the autoencoder's round
    trip.
    """
    model = tiny_model(tmp_path)
    (result,) = evaluate_completion(model, CompletionTask(rooms=1, views=4, known=2), QUICK, strengths=(1.0, 0.5, 0.01))
    assert result.psnr[started_at(1.0)] == result.psnr["model"] != result.psnr[started_at(0.5)]
    room = unseen_room(family="narrow", seed=0, number=0, views=4, size=model.size)
    start = baselines(room[:2], room[2:].cameras)["reprojected"]
    with torch.no_grad():
        returned = model.image_vae.decode(model.image_vae.encode(start))
    expected = float(psnr(returned.clamp(0, 1), room.images[2:]).mean())
    assert result.psnr[started_at(0.01)] == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize("nonsense", [{"known": 0}, {"known": 16}, {"rooms": 0}, {"family": "castle"}])
def test_nonsense_tasks_are_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        CompletionTask(**nonsense)


def test_the_mean_of_samples_is_scored_and_a_single_one_is_left_alone(tmp_path):
    model = tiny_model(tmp_path)
    (alone,), (result,) = (
        evaluate_completion(model, CompletionTask(rooms=1, views=4, known=2), QUICK, samples=count) for count in (1, 3)
    )
    assert result.psnr["model"] == alone.psnr["model"]
    assert mean_of(3) in result.psnr and mean_of(3) not in alone.psnr
    assert result.psnr[mean_of(3)] > result.psnr["model"]  # independent errors cancel
    assert result.psnr["model"] < result.psnr[likeliest_of(3)] < result.psnr[mean_of(3)]
    assert result.edges[likeliest_of(3)] > result.edges[mean_of(3)]


def test_what_is_above_the_baseline_is_told_room_by_room():
    pictures = torch.zeros(1, 3, 4, 4)
    results = [
        RoomResult(truth=pictures, completed=pictures, psnr={"model": base + 0.5, "reprojected": base})
        for base in (10.0, 20.0, 30.0)
    ]
    rows = summary(results)
    assert rows["model"]["above_psnr"] == pytest.approx(0.5) and rows["model"]["above_standard_error"] == pytest.approx(
        0
    )
    assert rows["model"]["standard_error"] > 1 and rows["reprojected"]["above_psnr"] == 0
