"""The evaluation of completion: baselines have closed-form answers, results are reproducible, known views are never scored."""

import pytest
import torch
from tiny_models import tiny_model

from fb_core.evaluation.completion import CompletionTask, evaluate_completion, mean_color, nearest_known, summary, unseen_room
from fb_core.inpainter import SamplingConfig

TASK = CompletionTask(rooms=2, views=4, known=2)
QUICK = SamplingConfig(steps=2)


def test_nearest_known_view_of_a_known_camera_is_its_picture():
    images, cameras = unseen_room(TASK, 0, 16)
    assert torch.equal(nearest_known(images, cameras, cameras), images)


def test_mean_colour_is_the_best_constant_picture():
    images, _ = unseen_room(TASK, 0, 16)
    constant = mean_color(images, 4)
    assert constant.shape == images.shape
    best = (constant - images).square().mean()
    assert all((constant + shift - images).square().mean() > best for shift in (-0.05, 0.05))


def test_evaluation_is_reproducible_and_leaves_known_views_alone(tmp_path):
    model = tiny_model(tmp_path)
    first, again = (list(evaluate_completion(model, TASK, QUICK)) for _ in range(2))
    assert [r.psnr for r in first] == [r.psnr for r in again]
    for result in first:
        assert torch.equal(result.completed[:2], result.truth[:2]) and set(result.psnr) == {"model", "nearest", "mean"}
    table = summary(first)
    assert table["mean"]["psnr"] == pytest.approx(sum(r.psnr["mean"] for r in first) / 2)


@pytest.mark.parametrize("nonsense", [{"known": 0}, {"known": 16}, {"rooms": 0}, {"family": "castle"}])
def test_nonsense_tasks_are_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        CompletionTask(**nonsense)
