"""Generated views in nerfstudio's viewer: frustums with their pictures, one group per round, a switch for each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.viewer.viewer_elements import ViewerControl

from fb_nerfstudio.completed_views import CompletedViews

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer

_NODE = "/completion"
_COLORS = ((255, 160, 30), (70, 150, 255), (90, 210, 120), (210, 110, 230), (240, 220, 80))
_LARGEST_PICTURE = 128  # pixels; what a frustum shows
_FRUSTUM_SHARE = 0.15  # size of a frustum, in units of the usual distance between neighbouring cameras


class CompletionPanel(ViewerControl):
    """The panel "Completion" and its frustums.

    nerfstudio finds it as an attribute of the datamanager and calls ``_setup`` when there is a viewer: in ``ns-train`` before
    a checkpoint is loaded, in ``ns-viewer`` after. So views may be given before or after; without a viewer nothing happens.
    """

    def __init__(self) -> None:
        self.views: CompletedViews | None = None
        self.captured = 0
        self._folder: Any = None
        self._status: Any = None
        self._message = ""
        self._groups: dict[str, list[Any]] = {}
        self._switches: dict[str, Any] = {}

    @property
    def is_open(self) -> bool:
        """Whether there is a viewer to draw in."""
        return getattr(self, "viser_server", None) is not None

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        # Between the viewer's numbers and its tabs, so that it is seen without scrolling.
        order = viewer.stats_markdown.order + 0.5 if hasattr(viewer, "stats_markdown") else None
        self._folder = self.viser_server.gui.add_folder("Completion", order=order)
        with self._folder:
            self._status = self.viser_server.gui.add_markdown("")
        self._groups, self._switches = {}, {}
        self._add_switch("captured", f"Captured ({self.captured})", self._show_captured)
        self._draw()

    def show(self, views: CompletedViews | None) -> None:
        """Draw these generated views instead of the earlier ones."""
        self.views = views
        self._draw()

    def report(self, message: str) -> None:
        """A line of text in the panel, such as the progress of a running generation."""
        self._message = message
        self._write_status()

    def _draw(self) -> None:
        if not self.is_open:
            return
        for name in [name for name in self._switches if name != "captured"]:
            self._switches.pop(name).remove()
            for handle in reversed(self._groups.pop(name)):
                handle.remove()
        if self.views is not None:
            for number in self.views.rounds:
                self._draw_round(number, self.views.of_round(number))
        self._write_status()

    def _draw_round(self, number: int, views: CompletedViews) -> None:
        name = f"round_{number:02d}"
        title = "Anchors" if views.origins[0].role == "anchor" else f"Round {number}"
        scene, node = self.viser_server.scene, f"{_NODE}/{name}"
        group = scene.add_frame(node, show_axes=False)  # hiding it hides all below it
        self._groups[name] = [group, *(self._draw_view(f"{node}/view_{index:03d}", views, index) for index in range(len(views)))]
        self._add_switch(name, f"{title} ({len(views)})", lambda visible: setattr(group, "visible", visible))

    def _draw_view(self, node: str, views: CompletedViews, index: int) -> Any:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
        from viser import transforms

        camera = views.cameras[index].to("cpu")
        scale = _FRUSTUM_SHARE * spacing(self.views or views) * VISER_NERFSTUDIO_SCALE_RATIO
        stride = max(1, -(-max(camera.width, camera.height) // _LARGEST_PICTURE))
        handle = self.viser_server.scene.add_camera_frustum(
            node,
            fov=float(2 * np.arctan(camera.height / 2 / float(camera.focal[0, 1]))),
            aspect=camera.width / camera.height,
            scale=max(self.viewer.config.camera_frustum_scale, scale),
            color=_COLORS[views.origins[index].round % len(_COLORS)],
            image=views.images[index, ::stride, ::stride].cpu().numpy(),
            wxyz=transforms.SO3.from_matrix(camera.rotations[0].double().numpy()).wxyz,  # frustums have OpenCV axes, as ours
            position=camera.centers[0].double().numpy() * VISER_NERFSTUDIO_SCALE_RATIO,
        )

        @handle.on_click
        def _(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.position = event.target.position
                event.client.camera.wxyz = event.target.wxyz

        return handle

    def _add_switch(self, name: str, label: str, show: Any) -> None:
        with self._folder:
            switch = self.viser_server.gui.add_checkbox(label, initial_value=True)
        self._switches[name] = switch

        @switch.on_update
        def _(_: Any) -> None:
            show(switch.value)

    def _show_captured(self, visible: bool) -> None:
        if hasattr(self.viewer, "camera_handles"):  # drawn a little after the panel
            self.viewer.set_camera_visibility(visible)

    def _write_status(self) -> None:
        if self._status is None:
            return
        count = 0 if self.views is None else len(self.views)
        text = f"{count} generated views" if count else "No generated views"
        self._status.content = f"{text}  \n{self._message}" if self._message else text


def spacing(views: CompletedViews) -> float:
    """The median distance from a camera to its nearest neighbour, in scene units; 0 for a single camera."""
    centers = views.cameras.centers.double().cpu()
    if len(centers) < 2:
        return 0.0
    return float((torch.cdist(centers, centers) + torch.diag(torch.full((len(centers),), torch.inf))).min(dim=1).values.median())
