"""Generated views in nerfstudio's viewer: frustums with their pictures, a switch for each round, and what a person may
ask for.

Everything here runs in the viewer's threads or draws for the training's: buttons only put requests into a queue
(:mod:`fb_core.completion.requests`), which the training takes between two iterations.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from fb_core.completion.requests import (
    MOST_VIEWS,
    CompleteFrom,
    CompleteMissing,
    RegenerateRound,
    RemoveView,
    Request,
    RequestQueue,
    key_of,
    place_of,
)
from fb_core.completion.results.completed_views import CompletedViews, round_title
from fb_core.geometry.viewpoints.paths import distances
from fb_nerfstudio.viewer_coverage import CoverageOverlay, picture_of

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer

_NODE = "/completion"
_COLORS = ((255, 160, 30), (70, 150, 255), (90, 210, 120), (210, 110, 230), (240, 220, 80))
_SELECTED_COLOR = (255, 60, 60)
_LARGEST_PICTURE = 128  # pixels; what a frustum shows
_FRUSTUM_SHARE = 0.15  # size of a frustum, in units of the usual distance between neighbouring cameras
_ASKING = 1000.0  # place of the buttons in the panel: below all switches
_OVERLAYS = 2.5  # place of what is drawn over: above the rounds' switches
_NO_ROUND = "none yet"
_ENDED = "Training has ended: nothing will be generated any more. To ask for more, go on with --load-dir."
_PLAIN = "This run trains without new views: nothing will be generated on request."


class CompletionPanel(ViewerControl):
    """The panel "Completion" and its frustums.

    nerfstudio finds it as an attribute of the datamanager and calls ``_setup`` when there is a viewer: in ``ns-train``
    before a checkpoint is loaded, in ``ns-viewer`` after. So views may be given before or after; without a viewer
    nothing happens.
    """

    def __init__(self, *, prompt: str = "") -> None:
        self.views: CompletedViews | None = None
        self.captured = 0
        self._prompt = prompt
        self.requests = RequestQueue()
        self._folder: Any = None
        self._status: Any = None
        self._progress: Any = None
        self._asking: dict[str, Any] = {}
        self._message = ""
        self._groups: dict[str, list[Any]] = {}
        self._switches: dict[str, Any] = {}
        self._drawn: dict[str, tuple] = {}
        self._hidden: set[str] = set()
        self._rounds: dict[str, int] = {}
        self._lock = (
            threading.RLock()
        )  # of all that is said, drawn and selected here: the training draws, clicks select
        self._selected: str | None = None
        self._marker: Any = None
        self.coverage = CoverageOverlay(self._draw)

    @property
    def is_open(self) -> bool:
        """Whether there is a viewer to draw in."""
        return getattr(self, "viser_server", None) is not None

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        gui = self.viser_server.gui
        # Between the viewer's numbers and its tabs, so that it is seen without scrolling.
        order = viewer.stats_markdown.order + 0.5 if hasattr(viewer, "stats_markdown") else None
        with self._lock:
            self._folder = gui.add_folder("Completion", order=order)
            self._groups, self._switches, self._drawn = {}, {}, {}
            with self._folder:
                self._status = gui.add_markdown("", order=0)
                self._progress = gui.add_progress_bar(0.0, visible=False, order=1)
                self._add_buttons(gui)
            self.coverage.setup(self.viser_server, self._folder, order=_OVERLAYS)
            self._add_switch("captured", f"Captured ({self.captured})", self._show_captured)
            self._draw()

    # ------------------------------------------------------------------------------------ what the training has to say

    def show(self, views: CompletedViews | None) -> None:
        """Draw these generated views instead of the earlier ones."""
        with self._lock:
            self.views = views
            self._draw()

    def report(self, message: str, share: float | None = None) -> None:
        """A line of text in the panel, and how far a running generation is (0 to 1; None when nothing runs)."""
        with self._lock:
            self._message = message
            if self._progress is not None:
                self._progress.visible = share is not None
                if share is not None:
                    self._progress.value = 100.0 * share
            self._write_status()

    def training_begins(self, *, takes_requests: bool = True) -> None:
        """From now on requests are taken, unless the run trains without new views."""
        if takes_requests:
            self.requests.open()
        else:
            self.requests.close(_PLAIN)
        self._write_status()

    def training_ended(self) -> None:
        """Nobody takes requests any more; says so."""
        dropped = self.requests.close(_ENDED)
        self.report(f"{dropped} waiting requests were dropped." if dropped else "")

    # --------------------------------------------------------------------------------------------------------- drawing

    def _draw(self) -> None:
        """Bring frustums and switches up to date; rounds that are as they were stay untouched."""
        if not self.is_open:
            return
        with self._lock:
            rounds = (
                {}
                if self.views is None
                else {f"round_{number:02d}": self.views.of_round(number) for number in self.views.rounds}
            )
            states = {name: (self.coverage.mode, *_told(views)) for name, views in rounds.items()}
            for name in [name for name in self._drawn if self._drawn[name] != states.get(name)]:
                self._clear_round(name)
            for name, views in rounds.items():
                if name not in self._drawn:
                    self._draw_round(name, views)
                    self._drawn[name] = states[name]
            if rounds:
                self.coverage.offer_pictures()
            self._hidden &= set(rounds)
            self._offer_rounds()
            if place_of(self.views, self._selected or "") is None:
                self._select(None)
            self._write_status()

    def _clear_round(self, name: str) -> None:
        del self._drawn[name]
        self._switches.pop(name).remove()
        for handle in reversed(self._groups.pop(name)):
            handle.remove()

    def _draw_round(self, name: str, views: CompletedViews) -> None:
        scene, node = self.viser_server.scene, f"{_NODE}/{name}"
        group = scene.add_frame(node, show_axes=False, visible=name not in self._hidden)  # hiding it hides all below it
        self._groups[name] = [
            group,
            *(self._draw_view(f"{node}/view_{index:03d}", views, index) for index in range(len(views))),
        ]

        def show(visible: bool) -> None:
            with self._lock:
                (self._hidden.discard if visible else self._hidden.add)(name)
                group.visible = visible

        self._add_switch(name, _label(views), show, order=3 + views.origins[0].round)

    def _draw_view(self, node: str, views: CompletedViews, index: int) -> Any:
        camera = views.cameras[index]
        stride = max(1, -(-max(camera.width, camera.height) // _LARGEST_PICTURE))
        color, picture = (
            _COLORS[views.origins[index].round % len(_COLORS)],
            picture_of(views, index, self.coverage.mode, stride),
        )
        handle, key = self._frustum(node, views, index, color=color, image=picture), key_of(views, index)

        @handle.on_click
        def _(_: Any) -> None:
            with self._lock:
                self._select(None if key == self._selected else key)

        return handle

    def _frustum(self, node: str, views: CompletedViews, index: int, *, size: float = 1.0, **look: Any) -> Any:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
        from viser import transforms

        camera = views.cameras[index].to("cpu")
        scale = _FRUSTUM_SHARE * spacing(self.views or views) * VISER_NERFSTUDIO_SCALE_RATIO
        return self.viser_server.scene.add_camera_frustum(
            node,
            fov=float(2 * np.arctan(camera.height / 2 / float(camera.focal[0, 1]))),
            aspect=camera.width / camera.height,
            scale=size * max(self.viewer.config.camera_frustum_scale, scale),
            wxyz=transforms.SO3.from_matrix(
                camera.rotations[0].double().numpy()
            ).wxyz,  # frustums have OpenCV axes, as ours
            position=camera.centers[0].double().numpy() * VISER_NERFSTUDIO_SCALE_RATIO,
            **look,
        )

    def _add_switch(self, name: str, label: str, show: Callable[[bool], None], order: float = 2) -> None:
        with self._folder:
            switch = self.viser_server.gui.add_checkbox(label, initial_value=name not in self._hidden, order=order)
        self._switches[name] = switch

        @switch.on_update
        def _(_: Any) -> None:
            show(switch.value)

    def _show_captured(self, visible: bool) -> None:
        if hasattr(self.viewer, "camera_handles"):  # drawn a little after the panel
            self.viewer.set_camera_visibility(visible)

    def _write_status(self) -> None:
        with self._lock:
            if self._status is None:
                return
            count, closed = 0 if self.views is None else len(self.views), self.requests.closed
            generated = views_in_words(count, "generated ") if count else "No generated views"
            lines = [generated, self.coverage.in_words, closed, self._message]
            self._status.content = "  \n".join(line for line in lines if line)
            for element in self._asking.values():
                element.disabled = closed is not None
            for name in ("look", "remove"):
                if name in self._asking:
                    self._asking[name].disabled = self._selected is None or (name == "remove" and closed is not None)

    # ---------------------------------------------------------------------------------------------------------- asking

    def _add_buttons(self, gui: Any) -> None:
        """Fields and buttons, from top to bottom."""
        place = iter(range(100))

        def add(name: str, kind: str, *args: Any, **options: Any) -> Any:
            self._asking[name] = getattr(gui, f"add_{kind}")(*args, order=_ASKING + next(place), **options)
            return self._asking[name]

        add("prompt", "text", "Prompt", self._prompt, hint="What is to be seen, for models that read text.")
        add(
            "seed",
            "number",
            "Seed",
            1,
            min=0,
            max=2**31 - 1,
            step=1,
            hint="Decides the pictures. It counts up by itself.",
        )
        hint = "The view from here and its neighbours to both sides."
        add("views", "number", "Views", 1, min=1, max=MOST_VIEWS, step=1, hint=hint)
        add("complete", "button", "Complete from here", hint="Generate from where you stand.").on_click(
            self._complete_clicked
        )
        hint = "As many views as are set above, where they show most of what nobody has seen."
        add("missing", "button", "Complete what is missing", hint=hint).on_click(self._missing_clicked)
        add("round", "dropdown", "Round", (_NO_ROUND,), hint="Which views to generate anew.")
        add("regenerate", "button", "Regenerate round", hint="The same cameras, another seed.").on_click(
            self._regenerate_clicked
        )
        add("look", "button", "Go to selected view", hint="Click a frustum to select it.").on_click(self._look_clicked)
        add("remove", "button", "Remove this view", hint="Click a frustum to select it.").on_click(self._remove_clicked)

    def _offer_rounds(self) -> None:
        """The rounds that there are, in the list to choose from."""
        rounds = [] if self.views is None else self.views.rounds
        options = tuple(_label(self.views.of_round(number)) for number in rounds) if self.views is not None else ()
        self._rounds = dict(zip(options, rounds, strict=True))
        if (options or (_NO_ROUND,)) != self._asking["round"].options:
            self._asking["round"].options = options or (_NO_ROUND,)

    def _complete_clicked(self, event: Any) -> None:
        views, pose = int(self._asking["views"].value), pose_of(event.client.camera)
        self._ask(
            f"{views_in_words(views)} from here",
            lambda seed, prompt: CompleteFrom(camera_to_world=pose, views=views, seed=seed, prompt=prompt),
        )

    def _missing_clicked(self, _: Any) -> None:
        views = int(self._asking["views"].value)
        what = f"at most {views_in_words(views)} of what is missing"
        self._ask(what, lambda seed, prompt: CompleteMissing(views=views, seed=seed, prompt=prompt))

    def _regenerate_clicked(self, _: Any) -> None:
        with self._lock:
            label = self._asking["round"].value
            number = self._rounds.get(label)
        if number is None:
            self.report("There is no round to generate anew.")
            return
        self._ask(f"{label} anew", lambda seed, prompt: RegenerateRound(number=number, seed=seed, prompt=prompt))

    def _remove_clicked(self, _: Any) -> None:
        with self._lock:
            key = self._selected
        if key is not None:
            self._ask("one view fewer", lambda seed, prompt: RemoveView(key=key), counts=False)

    def _look_clicked(self, event: Any) -> None:
        with self._lock:
            views, place = self.views, place_of(self.views, self._selected or "")
        if views is not None and place is not None:
            self._look_from(event.client, views, place)

    def _look_from(self, client: Any, views: CompletedViews, index: int) -> None:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
        from viser import transforms

        camera = views.cameras[index].to("cpu")
        with client.atomic():
            client.camera.position = camera.centers[0].double().numpy() * VISER_NERFSTUDIO_SCALE_RATIO
            client.camera.wxyz = transforms.SO3.from_matrix(camera.rotations[0].double().numpy()).wxyz

    def _ask(self, what: str, request: Callable[[int, str], Request], *, counts: bool = True) -> None:
        """Put a request into the queue, and say that it waits or why it cannot be."""
        with self._lock:  # two clicks at a time have a seed each
            seed, prompt = int(self._asking["seed"].value), self._asking["prompt"].value.strip()
            try:
                self.requests.put(request(seed, prompt))
            except ValueError as error:
                self.report(str(error))
                return
            if counts:
                self._asking["seed"].value = seed + 1
            paused = getattr(getattr(self.viewer, "trainer", None), "training_state", "") == "paused"
            waits = "Training is paused; it begins when you resume." if paused else "Waiting for the training."
            self._message = f"Asked for: {what}. {waits}"
            self._write_status()

    def _select(self, key: str | None) -> None:
        """Mark the frustum of a view and offer to remove it; None marks none."""
        with self._lock:
            if self._marker is not None:
                self._marker.remove()
                self._marker = None
            place = place_of(self.views, key or "")
            self._selected = None if place is None else key
            if self.views is not None and place is not None:
                self._marker = self._frustum(f"{_NODE}/selected", self.views, place, size=1.1, color=_SELECTED_COLOR)
                origin = self.views.origins[place]
                said = (
                    f"Selected: {round_title(origin.role, origin.round)}, seed {origin.seed}, trust {origin.trust:.2f}"
                )
                self._message = f'{said}, prompt "{origin.prompt}"' if origin.prompt else said
            self._write_status()


def pose_of(camera: Any) -> Float[Tensor, "3 4"]:
    """Camera-to-world of a viser client's camera, in scene units. Both have OpenCV axes."""
    from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
    from viser import transforms

    rotation = torch.from_numpy(transforms.SO3(np.asarray(camera.wxyz)).as_matrix())
    center = torch.from_numpy(np.asarray(camera.position, dtype=np.float64)) / VISER_NERFSTUDIO_SCALE_RATIO
    return torch.cat([rotation, center[:, None]], dim=1).float()


def views_in_words(count: int, which: str = "") -> str:
    """For example "1 view" and "3 generated views"."""
    return f"{count} {which}view{'' if count == 1 else 's'}"


def spacing(views: CompletedViews) -> float:
    """The median distance from a camera to its nearest neighbour, in scene units; 0 for a single camera."""
    centers = views.cameras.centers.double().cpu()
    if len(centers) < 2:
        return 0.0
    return float(
        (distances(centers, centers) + torch.diag(torch.full((len(centers),), torch.inf))).min(dim=1).values.median()
    )


def _label(views: CompletedViews) -> str:
    return f"{round_title(views.origins[0].role, views.origins[0].round)} ({len(views)})"


def _told(views: CompletedViews) -> tuple:
    """What a round's drawing depends on."""
    sums = (int(values.sum(dtype=torch.int64)) for values in (views.images, views.masks, views.pixel_trust))
    return tuple(key_of(views, index) for index in range(len(views))), *sums
