"""``fillerbuster eval scene``: what a completed scene shows at the cameras of photos that it was not given. Heavy
imports wait.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from fb_core.data.capture.frames import Frame
    from fb_core.geometry.cameras import Pinholes
    from fb_core.geometry.similarity import Similarity
    from fb_nerfstudio.splats.splat_file import Splats

WANTED_DB = 26.0
"""What the film is to reach where a photo of the scene saw the pixel."""
_PART = "photos that the scene was not given"
_TURN_RATE, _SHIFT_RATE = 2e-4, 4e-4  # radians; parts of the scene's extent
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene that fillerbuster complete has left, at the cameras of a posed capture's photos that it was not given."""

    scene: Path
    """The folder that fillerbuster complete has left."""
    capture: Path
    """Posed capture that holds the scene's photos (by the names of their files) and others."""
    side: int | None = None
    """Longest side in pixels of the pictures that are compared; by default that of the film."""
    most: int = 1000
    """At most so many of the other photos, equally spaced."""
    refine: int = 40
    """Steps in which each camera is fitted to its photo, since two reconstructions are never the same up to a
    similarity; 0: none.
    """
    pictures: Path | None = None
    """Folder for pictures: photo, film frame and its trust side by side."""
    json: Path | None = None
    """Write all measurements to this file."""

    def run(self) -> None:
        """Measure and report."""
        from fb_core.evaluation.results import Bar, Report
        from method_configs.benchmarks.command import show

        rows = measured(self)
        report = Report(seed=0, rows=rows)
        report.bars.append(
            Bar(name="PSNR where a photo saw it (dB)", value=rows[-1]["seen_psnr"], limit=WANTED_DB, sense=">=")
        )
        show(report, self.json, [])


def measured(config: Scene) -> list[dict[str, Any]]:
    """One row for each photo that the scene was not given, and one of all their pixels together.

    ``seen_psnr`` is over pixels of which the scene says that photos saw at least half, ``seen_share`` is their share;
    ``aligned_seen_psnr`` is the same before cameras were fitted.

    Raises ValueError for a folder that is no scene, and for a capture that has no other photos, or too few of the
    scene's.
    """
    import torch

    from fb_core.data import media
    from fb_core.data.capture.captures import read_capture
    from fb_core.files.json_files import read_json
    from fb_nerfstudio.splats.scene_film import film_frame, seen_by_photos
    from fb_nerfstudio.splats.splat_file import read_splats

    if not (config.scene / "splats.ply").is_file():
        raise ValueError(
            f"scene {config.scene}: no splats.ply there; give a folder that fillerbuster complete has left (--frames "
            "scene)"
        )
    report, ours = read_json(config.scene / "report.json"), read_capture(config.scene).photos.frames
    others, to_scene = _others(config, ours, read_capture(config.capture).photos.frames)
    splats, offset = (
        read_splats(config.scene / "splats.ply"),
        torch.tensor(report["splats"]["offset"], dtype=torch.float64),
    )
    trained = int(report["splats"]["photo_side"])
    cameras = [_small(frame.camera.moved(-offset), trained) for frame in ours]
    masks = [None if frame.mask_path is None else media.shrink(frame.load_mask(), trained)[0] >= 0.5 for frame in ours]
    seen = seen_by_photos(splats, cameras, masks)
    side = config.side or max(report["film"]["width"], report["film"]["height"])
    rows, sums = [], torch.zeros(5, dtype=torch.float64)
    for frame in others:
        photo, known, camera = _as_taken(frame, ours, to_scene, side)
        camera, blur = camera.moved(-offset), _blur(cameras[0], camera)
        aligned = film_frame(splats, seen, camera, blur=blur)
        fitted = _fitted(splats, camera, photo, known, steps=config.refine, blur=blur) if config.refine else camera
        drawn = film_frame(splats, seen, fitted, blur=blur)
        error, before = ((one.image - photo).square().mean(dim=0).double() for one in (drawn, aligned))
        at = (drawn.seen >= 0.5) & known
        part = torch.stack([error[at].sum(), before[at].sum(), at.sum(), error[known].sum(), known.sum()]).double()
        sums += part
        rows.append({"part": _PART, "photo": frame.image_path.name, **_row(part)})
        _logger.info(
            "%s: %.2f dB where seen (%.1f %% of the pixels)",
            frame.image_path.name,
            rows[-1]["seen_psnr"],
            100 * rows[-1]["seen_share"],
        )
        if config.pictures is not None:
            config.pictures.mkdir(parents=True, exist_ok=True)
            media.write_image(
                config.pictures / f"{frame.image_path.stem}.png",
                torch.cat([photo, drawn.image, drawn.trust_picture], dim=2),
            )
    return [*rows, {"part": _PART, "photo": f"all {len(others)}", **_row(sums)}]


def _row(part: Tensor) -> dict[str, float]:
    seen, before, count, all_of_it, pixels = part.tolist()

    def decibels(error: float, over: float) -> float:
        return round(-10 * math.log10(max(error / over, 1e-12)), 3) if over else math.nan

    return {
        "seen_psnr": decibels(seen, count),
        "aligned_seen_psnr": decibels(before, count),
        "psnr": decibels(all_of_it, pixels),
        "seen_share": round(count / max(pixels, 1), 4),
    }


def _others(config: Scene, ours: Sequence[Frame], given: Sequence[Frame]) -> tuple[list[Frame], Similarity]:
    """The photos that the scene was not given, and the similarity from their world to the scene's."""
    from fb_core.evaluation.metrics.pose_metrics import aligned
    from fb_core.geometry.viewpoints.paths import strided_subset

    by_name = {frame.image_path.stem: frame for frame in given}
    shared = [frame for frame in ours if frame.image_path.stem in by_name]
    others = [frame for frame in given if frame.image_path.stem not in {one.image_path.stem for one in ours}]
    if len(shared) < 3 or not others:
        raise ValueError(
            f"capture {config.capture}: expected at least 3 of the scene's photos by their file names, and others; "
            f"got {len(shared)} and {len(others)}"
        )
    similarity = aligned(
        [frame.camera for frame in shared], [by_name[frame.image_path.stem].camera for frame in shared]
    )
    assert similarity is not None  # all of them have cameras
    return [others[index] for index in strided_subset(len(others), config.most)], similarity.inverse


def _as_taken(frame: Frame, ours: Sequence[Frame], to_scene: Similarity, side: int) -> tuple[Tensor, Tensor, Pinholes]:
    """Photo, known pixels and camera in the scene's world. Its lens is the one that the scene found for photos of this
    size.
    """
    from fb_core.data import media

    size = (frame.camera.width, frame.camera.height)
    same = [one for one in ours if (one.camera.width, one.camera.height) == size]
    lens = same[0] if same else frame
    camera = dataclasses.replace(lens.camera, camera_to_world=to_scene.cameras(frame.camera).camera_to_world)
    taken = dataclasses.replace(lens, image_path=frame.image_path, mask_path=frame.mask_path, camera=camera)
    image, mask, camera = taken.load_undistorted()
    image, mask = media.shrink(image, side), media.shrink(mask, side)
    return image, mask[0] >= 0.999, _small(camera, side)


def _small(camera: Pinholes, side: int) -> Pinholes:
    scale = min(1.0, side / max(camera.width, camera.height))
    return camera.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _blur(trained: Pinholes, camera: Pinholes) -> float:
    from fb_nerfstudio.splats.backend import BLUR

    return BLUR * max(1.0, float(camera.focal.mean() / trained.focal.mean())) ** 2


def _fitted(splats: Splats, camera: Pinholes, photo: Tensor, known: Tensor, *, steps: int, blur: float) -> Pinholes:
    """The camera turned and shifted so that the splats look most like its photo (Adam on the mean absolute error)."""
    import torch

    from fb_nerfstudio.splats.backend import render_splats

    camera = camera.to(torch.float32)
    extent = float((splats.means - camera.centers).norm(dim=1).median())
    turn, shift = (torch.zeros(3, requires_grad=True) for _ in range(2))
    optimizer = torch.optim.Adam([{"params": [turn], "lr": _TURN_RATE}, {"params": [shift], "lr": _SHIFT_RATE}])
    opacities, scales = splats.logits.sigmoid(), splats.log_scales.exp()
    for _ in range(steps):
        drawn = render_splats(
            means=splats.means,
            quats=splats.quats,
            scales=scales,
            opacities=opacities,
            colors=splats.harmonics,
            viewmats=_moved(camera, turn, extent * shift),
            Ks=camera.intrinsics,
            width=camera.width,
            height=camera.height,
            sh_degree=splats.degree,
            eps2d=blur,
        )
        error = (drawn.colors[0] - drawn.alphas[0] * photo.movedim(0, -1)).abs()[known].mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    pose = torch.linalg.inv(_moved(camera, turn.detach(), extent * shift.detach()).double())[:, :3]
    return dataclasses.replace(camera.to(torch.float64), camera_to_world=pose)


def _moved(camera: Pinholes, turn: Tensor, shift: Tensor) -> Tensor:
    """World to camera [1, 4, 4], turned by a vector of radians and shifted (scene units) in the camera's own axes."""
    import torch

    zero = turn.new_zeros(())
    rows = [
        torch.stack(row) for row in ((zero, -turn[2], turn[1]), (turn[2], zero, -turn[0]), (-turn[1], turn[0], zero))
    ]
    top = torch.cat([torch.linalg.matrix_exp(torch.stack(rows)), shift[:, None]], dim=1)
    step = torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
    return (step @ camera.world_to_camera[0])[None]
