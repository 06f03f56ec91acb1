"""Copy the capture `fox` (instant-ngp's) with its head masked out of every photo: a capture for the masked protocol.

    python docs/make_fox_masks.py FOX outputs/fox-masked
    ns-train fillerbuster-masked --data outputs/fox-masked

The mask is made by hand, once for all photos: nose and ear tips were marked in photos 0001 and 0029 and triangulated; a
sphere around them (numbers below) is projected into each photo, lens distortion included. Black is what is to be
inpainted.
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
from pathlib import Path

import torch
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.frames import Frame
from fb_core.data.capture.undistort import straight_directions
from fb_core.files.ownership import Target
from fb_core.files.whole import whole_folder

CENTER, RADIUS = (1.95, -1.10, 0.65), 1.3
"""Of the sphere around the head, in the units and axes of transforms.json. Nose (2.48, -1.25, -0.24) and ear tips
(1.79, -1.83, 1.59), (2.37, -0.35, 1.53) lie inside; the marks of the two photos agree to 0.015.
"""
_SIDE = 480  # the mask is made on a grid of so many cells along the longer side, and scaled up


def looks_at_sphere(frame: Frame, center: Tensor, radius: float) -> Tensor:
    """1 where a pixel of the bent photo sees past the sphere, 0 where it looks at it; [1, height, width]."""
    camera = frame.camera
    step = max(camera.width, camera.height) / _SIDE
    rows, columns = (torch.arange(step / 2, side, step, dtype=torch.float64) for side in (camera.height, camera.width))
    places = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
    directions = (
        straight_directions(places.reshape(-1, 2), camera, frame.camera_model, frame.distortion) @ camera.rotations[0].T
    )
    directions = directions / directions.norm(dim=-1, keepdim=True)
    towards = center - camera.centers[0]
    along = directions @ towards
    meets = (along > 0) & (towards.square().sum() - along.square() < radius**2)
    known = (~meets).float().reshape(1, len(rows), len(columns))
    return (media.resize(known, camera.height, camera.width) > 0.5).float()


def main() -> None:
    """Write the copy, whole or not at all."""
    parser = argparse.ArgumentParser(description="Copy the capture fox with its head masked out of every photo.")
    parser.add_argument("capture", type=Path, help="folder with transforms.json")
    parser.add_argument("output", type=Path, help="new folder")
    told = parser.parse_args()
    if told.output.exists():
        raise SystemExit(f"{told.output} exists already; choose another folder")
    capture = read_capture(told.capture)
    content = json.loads((told.capture / "transforms.json").read_text(encoding="utf-8"))
    center, shares = torch.tensor(CENTER, dtype=torch.float64), []
    with whole_folder(Target(folder=told.output, kind="capture", overwrite=True, inputs=(told.capture,))) as unfinished:
        (unfinished / "images").mkdir()
        (unfinished / "masks").mkdir()
        for entry, frame in zip(content["frames"], capture.frames, strict=True):
            name = frame.image_path.name
            shutil.copyfile(frame.image_path, unfinished / "images" / name)
            mask = looks_at_sphere(frame, center, RADIUS)
            shares.append(1 - float(mask.mean()))
            media.write_image(unfinished / "masks" / f"{frame.image_path.stem}.png", mask)
            entry |= {"file_path": f"images/{name}", "mask_path": f"masks/{frame.image_path.stem}.png"}
        (unfinished / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    logging.info(
        "%d photos in %s; the mask takes %.0f %% of them on average",
        len(shares),
        told.output,
        100 * sum(shares) / len(shares),
    )


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main()
