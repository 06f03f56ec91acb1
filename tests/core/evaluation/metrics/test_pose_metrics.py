"""How far recovered cameras are from the true ones: no world is preferred, and what was not found counts."""

import dataclasses
import math

import pytest
import torch
from helpers.scenes.pose_scenes import scattered
from helpers.scenes.recovered_cameras import anywhere, each

from fb_core.evaluation.metrics.pose_metrics import aligned, pair_accuracy, pose_errors
from fb_core.geometry.cameras import Pinholes

TRUTH = scattered(6, width=20, height=16)


@pytest.mark.parametrize("seed", range(3))
def test_the_truth_in_another_world_is_right(seed):
    errors = pose_errors(each(anywhere(seed).cameras(TRUTH)), each(TRUTH))
    assert errors["rotation_degrees"] < 1e-5 and errors["center"] < 1e-9 and errors["focal_percent"] < 1e-9
    assert errors["found_share"] == errors["rra_15"] == errors["rta_15"] == 1.0


def test_errors_are_the_same_in_every_world():
    found = dataclasses.replace(TRUTH, camera_to_world=TRUTH.camera_to_world + 0.0, focal=TRUTH.focal * 1.1)
    turned = each(found)
    turned[0] = anywhere(7, scale=1.0).cameras(turned[0])
    here = pose_errors(turned, each(TRUTH))
    there = pose_errors([anywhere(1, scale=0.1).cameras(camera) for camera in turned], each(TRUTH))
    assert here == pytest.approx(there, abs=1e-6) and here["focal_percent"] == pytest.approx(10.0)
    assert here["rra_15"] == pytest.approx(10 / 15)  # the five pairs of the strayed camera are wrong


def test_centers_are_measured_in_the_extent_of_the_true_cameras():
    # Four cameras on a square, each moved outwards or inwards in turn, which no similarity can take out.
    centers = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    square = dataclasses.replace(
        TRUTH[[0, 1, 2, 3]], camera_to_world=torch.cat([torch.eye(3).expand(4, 3, 3).double(), centers[..., None]], 2)
    )
    strayed = centers * torch.tensor([1.1, 0.9, 1.1, 0.9], dtype=torch.float64)[:, None]
    found = dataclasses.replace(square, camera_to_world=torch.cat([square.rotations, strayed[..., None]], dim=2))
    small = pose_errors(each(found), each(square))
    large = pose_errors(each(anywhere(0, 5.0).cameras(found)), each(anywhere(0, 5.0).cameras(square)))
    assert small["center"] == pytest.approx(1.1 * 4 / 4.04 - 1) and large["center"] == pytest.approx(small["center"])


def test_what_was_not_found_is_wrong_in_all_of_its_pairs():
    found: list[Pinholes | None] = [*each(TRUTH)]
    found[2] = None
    errors = pose_errors(found, each(TRUTH))
    assert errors["found_share"] == pytest.approx(5 / 6) and errors["rra_15"] == errors["rta_15"] == pytest.approx(
        10 / 15
    )
    assert errors["rotation_degrees"] < 1e-5
    nothing = pose_errors([None] * 6, each(TRUTH))
    assert math.isnan(nothing["rotation_degrees"]) and nothing["found_share"] == nothing["rra_15"] == 0.0


def test_places_that_mirror_the_truth_fall_on_its_middle():
    mirrored = torch.cat([TRUTH.rotations, -TRUTH.centers[:, :, None]], dim=2)
    similarity = aligned(each(dataclasses.replace(TRUTH, camera_to_world=mirrored)), each(TRUTH))
    assert similarity is not None and 0 < similarity.scale < 1e-6
    assert torch.allclose(similarity.points(-TRUTH.centers), TRUTH.centers.mean(dim=0).expand(6, 3), atol=1e-6)


def test_true_cameras_in_one_place_have_no_directions():
    here = dataclasses.replace(
        TRUTH, camera_to_world=torch.cat([TRUTH.rotations, torch.zeros(6, 3, 1, dtype=torch.float64)], dim=2)
    )
    shares = pair_accuracy(each(here), each(here))
    assert shares["rra_15"] == 1.0 and math.isnan(shares["rta_15"])
