"""What ``fillerbuster complete`` says: what was found of lenses and places, what each method lacks, how long it takes;
straight photos.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.textured_box import cameras_on_an_arc

from fb_core.completion.fly_through import FoundCameras
from fb_core.data import media
from fb_core.data.photos.straight_photos import straightened
from fb_core.evaluation.self_consistency import photo_of
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.bundle_adjustment import straight_places
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.registration.choice import Registration
from method_configs.commands.complete.forecast import Forecast, forecast, memory_beside
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.complete.output import _write_photo
from method_configs.commands.complete.report import announcement_of_work, no_cameras, what_was_found

PHOTOS = [photo_of(torch.zeros(3, 24, 32), name=f"photo {index}", device="one") for index in range(3)]


def registered(
    verdicts: list[str], reasons: list[str], *, arrangement=Arrangement.APART, notes: tuple[str, ...] = ()
) -> Registration:
    cameras = cameras_on_an_arc(len(verdicts))
    return Registration(
        cameras=tuple(cameras[index] for index in range(len(verdicts))),
        verdicts=tuple(verdicts),
        reasons=tuple(reasons),
        residuals_degrees=(0.1,) * len(verdicts),
        raymaps=None,
        arrangement=arrangement,
        notes=notes,
    )


def test_a_pure_rotation_is_said_to_have_no_distances_and_notes_are_told():
    here = registered(["ok"] * 3, [""] * 3, arrangement=Arrangement.ONE_PLACE, notes=("The lens bends.",))
    told = what_was_found(PHOTOS, FoundCameras(registration=here, method="features", tried={"features": 3}))
    assert any("in one place" in line and "no distances" in line for line in told) and "The lens bends." in told
    apart = FoundCameras(registration=registered(["ok"] * 3, [""] * 3), method="features", tried={"features": 3})
    assert len(what_was_found(PHOTOS, apart)) == 1


def test_a_refusal_names_what_every_method_found():
    model = registered(["doubtful"] * 3, ["rays stray"] * 3)
    features = registered(
        ["no camera", "doubtful", "no camera"], ["too few features", "hardly determined", "too few features"]
    )
    found = FoundCameras(
        registration=model,
        method="model",
        tried={"model": 0, "features": 0},
        answers=(("model", model), ("features", features)),
    )
    told = no_cameras(PHOTOS, found, Path("out"))
    assert (
        "by the model: 3 doubtful, such as: rays stray; by features: 2 no camera, 1 doubtful, such as: too few features"
        in told
    )
    assert "--known-poses" in told


# ---- forecasts -------------------------------------------------------------------------------------------------------


def test_what_is_left_follows_what_has_passed():
    expected = Forecast(stages={"cameras": 10.0, "new views": 20.0, "writing": 5.0})
    assert expected.total == 35.0
    assert expected.left({"reading": 3.0, "cameras": 20.0}) == pytest.approx(50.0)  # a machine half as fast
    assert expected.left({"reading": 3.0}) == pytest.approx(35.0) and expected.left({"cameras": 1e9}) == pytest.approx(
        200.0
    )


def test_work_is_counted_by_photos_and_pixels():
    def seconds(count: int, side: int) -> dict[str, float]:
        photos = [photo_of(torch.zeros(3, side, side), name=f"{index}", device="one") for index in range(count)]
        return dict(forecast(photos, CompleteOptions(cameras="features", poses_only=True), None, None, None).stages)

    few, many, large = seconds(4, 100), seconds(16, 100), seconds(4, 400)
    assert (
        many["cameras"] > 4 * few["cameras"]
        and large["cameras"] > 4 * few["cameras"]
        and large["writing"] > few["writing"]
    )


# ---- straight photos -------------------------------------------------------------------------------------------------

BEND = {"k1": -0.2, "k2": 0.04}


def pattern(plane: torch.Tensor) -> torch.Tensor:
    """Smooth colours by place in the plane at depth 1: [h, w, 2] -> [3, h, w]."""
    x, y = plane.unbind(dim=-1)
    return torch.stack([(4 * x).sin(), (5 * y).sin(), (3 * x + 3 * y).cos()]).float() / 2 + 0.5


def places(camera: Pinholes) -> torch.Tensor:
    """Of pixel centres, from the principal point, in focal lengths: [h, w, 2], float64."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return (torch.stack([x, y], dim=-1).double() - camera.principal[0]) / camera.focal[0]


def bent_photo() -> tuple:
    camera = cameras_on_an_arc(1, width=160, height=120).to(torch.float64)
    shape = (120, 160, 2)
    plane = straight_places(places(camera).reshape(-1, 2).numpy(), np.array([BEND["k1"], BEND["k2"]])).reshape(shape)
    return dataclasses.replace(
        photo_of(pattern(torch.from_numpy(plane)), name="bent", device="one"), source=Path("bent.png")
    ), camera


def test_a_straightened_photo_is_what_its_straight_camera_sees():
    photo, camera = bent_photo()
    straight, seen_by = straightened(photo, camera, BEND)
    image, known = straight.load_with_mask()
    expected = pattern(places(seen_by))
    assert float(known.mean()) > 0.95 and straight.size == photo.size and not straight.stored
    assert float(((image - expected).abs() * known).max()) < 0.02
    assert float((image - photo.load()).abs().max()) > 0.1  # which it was not before


def test_the_straight_picture_is_what_is_written(tmp_path: Path):
    photo, camera = bent_photo()
    media.write_image(tmp_path / "bent.png", photo.load())
    photo = dataclasses.replace(photo, source=tmp_path / "bent.png")
    straight, _ = straightened(photo, camera, BEND)
    (tmp_path / "out").mkdir()
    written = media.read_image(_write_photo(straight, tmp_path / "out", as_it_is=straight.stored))
    assert float((written - straight.load()).abs().max()) < 0.01


@pytest.mark.parametrize("count", [3, 40])
def test_memory_counts_the_process_and_its_photos(count: int):
    """Libraries and drawing take more than the bundled model does."""
    photos = [photo_of(torch.zeros(3, 24, 32), name=f"photo {index}", device="one") for index in range(count)]
    told = forecast(photos, CompleteOptions(cameras="features", poses_only=True), None, None, None)
    assert 1.0 < memory_beside(photos) / 2**30 < 2.0  # seen: 1.03 to 1.46 GiB
    assert "GiB of memory" in announcement_of_work(
        photos, CompleteOptions(cameras="features", poses_only=True), None, None, None, told
    )
