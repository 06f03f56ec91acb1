"""What the viewer shows of coverage and trust: what nobody has seen, cameras before their views are there, and how far
pixels are believed.

Draws beside the frustums of :mod:`fb_nerfstudio.viewer`, into the same panel; like these it only draws and never asks
the training.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import UInt8

from fb_core.completion.results.completed_views import CompletedViews

if TYPE_CHECKING:
    from fb_core.completion.planning.plan import CompletionPlan

Pictures = Literal["generated", "trust", "trained on"]
"""What frustums show: the pictures, these tinted by the trust of each pixel, or these dark where the splats are not
trained on them.
"""
_NODE = "/completion"
_UNSEEN_COLOR, _PLANNED_COLOR = (255, 90, 40), (235, 235, 235)
_DOUBTED, _BELIEVED = (255, 120, 0), (40, 120, 255)  # told apart by people who do not tell red from green
_POINT_SHARE = 0.02  # size of a point, in units of the distance of the surface from its middle
_FRUSTUM_SHARE = 0.1  # the same, of a planned camera


def picture_of(views: CompletedViews, index: int, mode: Pictures, stride: int = 1) -> UInt8[np.ndarray, "h w 3"]:
    """What the frustum of a view shows: every ``stride``-th pixel."""
    picture = views.images[index, ::stride, ::stride].cpu()
    if mode == "generated":
        return picture.numpy()
    if mode == "trained on":
        return torch.where(views.masks[index, ::stride, ::stride].cpu(), picture, picture // 4).numpy()
    trust = views.pixel_trust[index, ::stride, ::stride].cpu().float() / 255
    tint = (1 - trust) * torch.tensor(_DOUBTED).float() + trust * torch.tensor(_BELIEVED).float()
    return (0.4 * picture.float().mean(dim=-1, keepdim=True) + 0.6 * tint).round().to(torch.uint8).numpy()


class CoverageOverlay:
    """Unseen parts of the surroundings as coloured points, planned cameras as empty frustums, and the choice of what
    pictures show.
    """

    def __init__(self, redraw: Callable[[], None]) -> None:
        """``redraw`` draws all frustums anew, once the pictures are to show something else."""
        self.mode: Pictures = "generated"
        self.plan: CompletionPlan | None = None
        self._redraw = redraw
        self._server: Any = None
        self._folder: Any = None
        self._order = 0.0
        self._switch: Any = None
        self._choice: Any = None
        self._points: Any = None
        self._planned: list[Any] = []
        self._visible = True
        self._lock = threading.RLock()  # the training plans, clicks switch

    def setup(self, server: Any, folder: Any, *, order: float) -> None:
        """There is a viewer, and the panel's folder, where fields appear once there is something to choose; draws what
        is known.
        """
        self._server, self._folder, self._order = server, folder, order
        self._points, self._planned, self._switch, self._choice = None, [], None, None
        self._draw()

    def offer_pictures(self) -> None:
        """There are frustums: let a person choose what their pictures show."""
        if self._server is None or self._choice is not None:
            return
        with self._folder:
            self._choice = choice = self._server.gui.add_dropdown(
                "Pictures show", get_args(Pictures), order=self._order + 0.1
            )

        @choice.on_update
        def _(_: Any) -> None:
            self.mode = choice.value
            self._redraw()

    def _offer_points(self) -> None:
        if self._switch is not None:
            return
        with self._folder:
            self._switch = switch = self._server.gui.add_checkbox(
                "What nobody has seen", initial_value=self._visible, order=self._order
            )

        @switch.on_update
        def _(_: Any) -> None:
            self._visible = bool(switch.value)
            if self._points is not None:
                self._points.visible = self._visible

    @property
    def in_words(self) -> str:
        """How much is still unseen; empty before anybody knows."""
        if self.plan is None or self.plan.covered is None:
            return ""
        before, after = (1 - share for share in self.plan.covered)
        planned = f", {after:.0%} with {self.plan.new_views} planned views" if self.plan.rounds else ""
        return f"Of what surrounds the capture {before:.0%} is unseen{planned}"

    def show(self, plan: CompletionPlan) -> None:
        """A new plan: what is unseen by it, and the cameras that are about to be generated."""
        with self._lock:
            self.plan = plan
            self._draw()

    def generated(self) -> None:
        """The planned views are there: they are drawn with their pictures elsewhere."""
        with self._lock:
            for handle in self._planned:
                handle.remove()
            self._planned = []

    def _draw(self) -> None:
        if self._server is None or self.plan is None:
            return
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO as RATIO

        self.generated()
        if self._points is not None:
            self._points.remove()
            self._points = None
        coverage, shape = self.plan.coverage, self.plan.shape
        if coverage is not None:
            self._offer_points()
        size = float(self.plan.shell.log_radius.median().exp())
        if coverage is not None and not bool(coverage.seen.all()):
            points = coverage.surface[~coverage.seen].cpu().float().numpy() * RATIO
            colors = np.tile(np.array(_UNSEEN_COLOR, dtype=np.uint8), (len(points), 1))
            self._points = self._server.scene.add_point_cloud(
                f"{_NODE}/unseen",
                points,
                colors,
                point_size=_POINT_SHARE * size * RATIO,
                point_shape="circle",
                visible=self._visible,
            )
        for one in self.plan.rounds:
            for index in range(len(one.cameras)):
                node = f"{_NODE}/planned/{one.number:02d}_{index:03d}"
                self._planned.append(
                    self._frustum(node, one.cameras[index], size=_FRUSTUM_SHARE * max(shape.radius, 0.1 * size))
                )

    def _frustum(self, node: str, camera: Any, *, size: float) -> Any:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO as RATIO
        from viser import transforms

        return self._server.scene.add_camera_frustum(
            node,
            fov=float(2 * np.arctan(camera.height / 2 / float(camera.focal[0, 1]))),
            aspect=camera.width / camera.height,
            scale=size * RATIO,
            color=_PLANNED_COLOR,
            wxyz=transforms.SO3.from_matrix(camera.rotations[0].double().numpy()).wxyz,
            position=camera.centers[0].double().numpy() * RATIO,
        )
