"""What a run has left on disk, read without building its model: capture, held-out pictures, generated views,
Gaussians.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.models.splatfacto import SH2RGB

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.point_cloud import Points
from fb_core.geometry.rotations import flip_axes
from fb_core.geometry.similarity import Similarity
from fb_nerfstudio.capture.dataparser import without_open3d

_FAINT, _MOST_POINTS = 0.05, 100_000
_MOVED = 1e-4  # of the capture's extent: far more than float32 loses, far less than a person would change


@dataclass(frozen=True, kw_only=True)
class CompletedCapture:
    """A capture and what a run has generated for it."""

    capture: Capture
    """In its own world."""
    held_out: frozenset[int]
    """Frames of the capture that the run did not train on."""
    generated: CompletedViews
    """Cameras in the capture's world, float64."""
    world: Similarity
    """From the capture's world to the run's."""
    finished: bool
    """False where the generation was interrupted and rounds are missing."""


def read_completed(config: Any, checkpoint: dict[str, Any]) -> CompletedCapture:
    """Capture and generated views of a run.

    Args:
        config: the run's trainer config, as ns-train has saved it.
        checkpoint: what its checkpoint file holds.

    Raises ValueError for a run without generated views, and for a capture that is gone, of another format, or changed
    since.
    """
    state = checkpoint["pipeline"].get("datamanager._extra_state")
    if state is None or state["views"] is None:
        raise ValueError(
            "it has no generated views: let it train past completion.at_step, or give a run with completion"
        )
    data = config.pipeline.datamanager.data or config.data or config.pipeline.datamanager.dataparser.data
    if not isinstance(config.pipeline.datamanager.dataparser, NerfstudioDataParserConfig):
        name = type(config.pipeline.datamanager.dataparser).__name__
        raise ValueError(f"expected a run on a capture with transforms.json, got one that was read by {name}")
    capture = read_capture(data).photos  # what it has of generated views is in the run's bank
    place = {str(frame.image_path): index for index, frame in enumerate(capture.frames)}
    trained = _trained(config, data)
    names = [str(path) for path in trained.image_filenames]
    if not set(names) <= set(place):
        raise ValueError(f"capture {data}: pictures that the run was trained on are not in it any more; restore it")
    frames = [place[name] for name in names]
    poses, theirs = capture.poses[frames], flip_axes(trained.cameras.camera_to_worlds.double())
    world = Similarity.between(
        (poses[:, :, :3], poses[:, :, 3]),
        (theirs[:, :, :3], theirs[:, :, 3]),
        scale_of_one_place=float(trained.dataparser_scale),
    )
    moved = float((world.points(poses[:, :, 3]) - theirs[:, :, 3]).abs().max())
    if not moved <= _MOVED * max(1.0, float(theirs[:, :, 3].abs().max())):
        raise ValueError(
            f"capture {data}: its cameras have changed since the run; restore the transforms.json that the run was "
            "trained on"
        )
    views = CompletedViews.from_state(state["views"])
    return CompletedCapture(
        capture=capture,
        held_out=frozenset(place.values()) - set(frames),
        generated=dataclasses.replace(views, cameras=world.inverse.cameras(views.cameras.to("cpu"))),
        world=world,
        finished=bool(state["finished"]),
    )


def gaussian_centers(config: Any, checkpoint: dict[str, Any], world: Similarity) -> Points:
    """Centres and colours of a run's Gaussians that are not faint, in the capture's world; the most opaque where they
    are many.
    """
    state = checkpoint["pipeline"]
    means, opacities, colors = (
        state[f"_model.gauss_params.{name}"].float().cpu() for name in ("means", "opacities", "features_dc")
    )
    opacities = opacities.flatten().sigmoid()
    chosen = opacities.topk(min(len(opacities), _MOST_POINTS)).indices.sort().values
    chosen = chosen[(opacities[chosen] > _FAINT) & means[chosen].isfinite().all(dim=1)]
    rgb = SH2RGB(colors) if config.pipeline.model.sh_degree > 0 else colors.sigmoid()
    return Points(positions=world.inverse.points(means[chosen]), colors=rgb[chosen].double().clamp(0, 1))


def _trained(config: Any, data: Path) -> DataparserOutputs:
    """What nerfstudio's reader gives the run to train on: names of full-size pictures and their cameras in the run's
    world.
    """
    parser = copy.deepcopy(config.pipeline.datamanager.dataparser)
    parser.data, parser.load_3D_points = Path(data), False
    reader = without_open3d(parser).setup()
    reader.downscale_factor = 1  # the pictures themselves, not smaller copies beside them
    return reader.get_dataparser_outputs(split="train")
