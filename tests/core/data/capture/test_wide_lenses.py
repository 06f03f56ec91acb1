"""Fisheye lenses that see farther than a plane holds: straightened to what it holds, the same everywhere."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from fb_core.data.capture.captures import validate_capture
from fb_core.data.capture.undistort import check_straight, straight_directions, undistort
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d
from fb_nerfstudio.capture.pictures import CapturePictures

WIDE = {  # width, height, focal length, coefficients; twice width / 2 / focal is the field of view
    "180 degrees": (160, 120, 51.0, {"k1": 0.0001}),
    "200 degrees": (160, 120, 45.8, {"k1": 0.0001}),
    "200 degrees, square": (160, 160, 45.8, {}),
    "190 degrees, bent": (160, 120, 50.0, {"k1": -0.01, "k2": 0.001}),
    "220 degrees, off centre": (160, 120, 42.0, {}),
}


@pytest.mark.parametrize("name", WIDE)
def test_lenses_beyond_170_degrees_are_straightened_to_what_a_plane_holds(name: str) -> None:
    """The straight picture shows, at every pixel, what its camera's ray sees; nothing is unknown but what the lens has
    not seen.
    """
    width, height, focal, lens = WIDE[name]
    centre = [width / 2 + (3 if "off" in name else 0), height / 2]
    camera = Pinholes(
        camera_to_world=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.full((1, 2), focal, dtype=torch.float64),
        principal=torch.tensor([centre], dtype=torch.float64),
        width=width,
        height=height,
    )
    places = torch.stack(
        torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy"), dim=-1
    ).double()
    directions = straight_directions(places.reshape(-1, 2), camera, "OPENCV_FISHEYE", lens)
    bent = ((places - camera.principal) / focal).norm(dim=-1).reshape(-1)
    angles = torch.atan2(directions[:, :2].norm(dim=1), directions[:, 2])
    series = angles * (1 + lens.get("k1", 0.0) * angles**2 + lens.get("k2", 0.0) * angles**4)
    assert torch.allclose(series, bent, atol=1e-9), "beyond 90 degrees, too"
    image = (0.5 + 0.5 * directions).T.reshape(3, height, width).float()
    straight, known, pinhole = undistort(image, torch.ones(1, height, width), camera, "OPENCV_FISHEYE", lens)
    fields = [
        2 * math.degrees(math.atan(side / 2 / float(pinhole.focal[0, axis])))
        for axis, side in enumerate((width, height))
    ]
    assert max(fields) == pytest.approx(140, abs=1e-6)
    rays = pinhole.directions()[0].movedim(-1, 0)
    rays = rays / rays.norm(dim=0)
    error = ((2 * straight - 1) - rays).abs().amax(dim=0)[known[0] > 0]
    assert float(known.mean()) > 0.75 and float(error.max()) < 0.02
    check_straight(camera, "OPENCV_FISHEYE", lens, "here")


def test_wide_lenses_train_on_what_all_else_sees(tiny_capture: Path, caplog) -> None:
    meta = json.loads((tiny_capture / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame.update(fl_x=14.0, fl_y=14.0, cx=24.0, cy=16.0)
    meta.update(camera_model="OPENCV_FISHEYE")
    (tiny_capture / "transforms.json").write_text(json.dumps(meta))
    capture = validate_capture(tiny_capture)
    outputs = NerfstudioWithoutOpen3d(
        NerfstudioDataParserConfig(data=tiny_capture, eval_mode="all")
    ).get_dataparser_outputs("train")
    assert "a fisheye lens of 196 degrees is straightened to 140 degrees" in caplog.text
    data = CapturePictures(outputs, 1.0).get_data(1, "uint8")
    image, mask, camera = capture.frames[1].load_undistorted()
    assert "mask" not in data, "what is known stands in the straight picture's alpha"
    assert torch.allclose(data["image"][..., :3].movedim(-1, 0) / 255, image, atol=0.51 / 255)
    assert torch.equal(data["image"][..., 3] > 127, mask[0] >= 0.5) and 0.1 < float(mask.mean()) < 1
    lens = outputs.cameras.distortion_params
    assert (
        float(outputs.cameras.fx[1]) == pytest.approx(float(camera.focal[0, 0]))
        and lens is not None
        and not bool(lens.any())
    )
    half = CapturePictures(outputs, 0.5).get_data(1, "uint8")["image"]
    assert half.shape == (16, 24, 4)
