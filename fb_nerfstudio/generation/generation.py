"""Generation in a training: what automatic rounds and a person's requests have in common."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer

from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import CompletedViews, views_target
from fb_core.completion.samples import Inpainter
from fb_core.files.whole import remove_folder, whole_file
from fb_core.geometry.shell import Shell
from fb_nerfstudio.capture.captured_views import CapturedViewsDatamanager
from fb_nerfstudio.capture.dataparser import files_read
from fb_nerfstudio.capture.splat_renders import TrainedSplats
from fb_nerfstudio.generation.fitting_in import fitted_in
from fb_nerfstudio.generation.next_round import report_of
from fb_nerfstudio.generation.scene import TrainedScene
from fb_nerfstudio.generation.state import GenerationState
from fb_nerfstudio.generation.surroundings import LazyViews
from fb_nerfstudio.viewer import CompletionPanel

COMPLETION_FOLDER = "completion"
"""Where in the run's folder the generated views are written as a capture."""
REPORT_NAME = "completion.json"
"""Beside that folder: how far the model is believed, its rounds and the trust of every view."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Generation:
    """A training into which views are generated."""

    captured: CapturedViewsDatamanager
    """The capture."""
    completion: CompletionConfig
    """What is asked for."""
    state: GenerationState
    """What there is so far; changed here."""
    load_inpainter: Callable[[], Inpainter]
    """Loads the diffusion model, which lives only while views are generated."""
    splats: TrainedSplats
    """The model that is trained; gets Gaussians for generated views."""
    optimizers: Optimizers | None
    """Its optimizers."""
    trainer: Trainer | None
    """Who saves checkpoints, and has the run's folder."""

    @property
    def panel(self) -> CompletionPanel:
        """What the viewer shows of it."""
        return self.state.panel

    @property
    def last_step(self) -> int | None:
        """The step before which the training ends, where it is known."""
        return None if self.trainer is None else steps_end(self.trainer)

    def scene(self, step: int) -> TrainedScene:
        """Capture and splats before an iteration."""
        return TrainedScene(
            splats=self.splats,
            optimizers=self.optimizers,
            cameras=self.captured.captured_cameras(),
            known=self.captured.known_parts,
            cloud=self.captured.train_dataparser_outputs.metadata.get("points3D_xyz"),
            step=step,
        )

    def context(self, scene: TrainedScene, indices: Sequence[int]) -> LazyViews:
        """Captured views that condition a generation, each read when it is looked at."""
        return LazyViews(lambda index: self.captured.captured_view(index, scene.cameras[index]), indices)

    def fitted_in(
        self, views: CompletedViews, scene: TrainedScene, shell: Shell, *, holes_only: bool = False
    ) -> tuple[CompletedViews, int]:
        """The views as they are to be trained on, and how many Gaussians were added for them."""
        curve = None if self.state.trust is None else self.state.trust.curve
        return fitted_in(views, scene, self.completion, shell=shell, holes_only=holes_only, curve=curve)

    def save_checkpoint(self, step: int) -> None:
        """A checkpoint of the state before this step; a resumed run begins with it (with step 1 where there is none
        before).
        """
        if self.trainer is not None:
            self.trainer.save_checkpoint(max(step - 1, 0))

    def save_views(self) -> Path | None:
        """Write the views as a capture into the run's folder and return where; None without a trainer, and where
        something else stands.
        """
        if self.trainer is None:
            return None
        config = self.captured.config
        data = config.data or config.dataparser.data
        folder = Path(self.trainer.base_dir) / COMPLETION_FOLDER
        target = views_target(folder, inputs=files_read(self.captured.train_dataparser_outputs, data))
        try:
            target.check()
        except ValueError as error:
            _logger.warning("%s; the generated views are in the checkpoint alone", error)
            return None
        views = self.state.views
        with whole_file(target.folder.with_name(REPORT_NAME)) as unfinished:
            report = report_of(self.state.trust, self.state.rounds, views)
            unfinished.write_text(json.dumps(report, indent=1, allow_nan=False), encoding="utf-8")
        if views is not None:
            views.save_capture(target)
        else:
            remove_folder(target)
        return target.folder


def steps_end(trainer: Trainer) -> int:
    """The step before which a training ends."""
    return trainer._start_step + trainer.config.max_num_iterations
