"""Datamanagers at toy size, with a model that generates grey."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation

from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views
from fb_nerfstudio.datamanager import FillerbusterDataManager, FillerbusterDataManagerConfig
from fb_nerfstudio.generation import surroundings


class GreyFiller:
    """A stand-in for the diffusion model: unknown pixels become grey of the generator's first number."""

    size, model_hash, loads, calls = 16, "feedbeef" * 8, 0, 0

    recommended_sampling = SamplingConfig()

    def complete(
        self, views, *, generator, sampling=SamplingConfig(), on_step=None, prompt=None, current=None
    ) -> Views:
        GreyFiller.calls += 1
        if on_step is not None:
            on_step(1, 1)
        torch.rand(5)  # careless use of the global random state, which training must not notice
        images = torch.where(
            views.image_known > 0, views.images, torch.rand(1, generator=generator).expand_as(views.images)
        )
        ones = torch.ones_like(views.image_known)
        return Views(images=images, image_known=ones, raymaps=views.raymaps, rays_known=ones)


class ToySplats(torch.nn.Module):
    """A stand-in for the splat model: sees a wall at depth 2 in the left half of every picture."""

    device, room = torch.device("cpu"), None

    def __init__(self) -> None:
        super().__init__()
        self.means = torch.zeros(0, 3)
        self.gauss_params, self.strategy_state, self.info = {}, {}, {}
        self.added: list[tuple[torch.Tensor, torch.Tensor]] = []
        self.modes: list[bool] = []

    def get_outputs_for_camera(self, camera):
        self.modes.append(self.training)
        height, width = int(camera.height), int(camera.width)
        accumulation = torch.zeros(height, width, 1)
        accumulation[:, : width // 2] = 1.0
        return {
            "depth": torch.full((height, width, 1), 2.0),
            "accumulation": accumulation,
            "rgb": torch.full((height, width, 3), 0.5),
        }

    def add_gaussians(self, points, colors, optimizers) -> int:
        self.added.append((points, colors))
        return len(points)

    def remove_gaussians(self, chosen, optimizers) -> int:
        return 0


class ToyTrainer:
    """Saves what nerfstudio's trainer saves, as far as the datamanager is concerned."""

    def __init__(self, folder: Path, pipeline) -> None:
        self.base_dir, self.checkpoint_dir, self.pipeline = folder, folder / "nerfstudio_models", pipeline
        self.config = SimpleNamespace(save_only_latest_checkpoint=True, max_num_iterations=30_000)
        self._start_step = 0

    def save_checkpoint(self, step: int) -> None:
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        torch.save(
            {"step": step, "pipeline": self.pipeline.datamanager.state_dict()},
            self.checkpoint_dir / f"step-{step:09d}.ckpt",
        )


@pytest.fixture(autouse=True)
def stand_in_model(monkeypatch):
    """No test here loads real weights; the number of loads is counted."""
    GreyFiller.loads = GreyFiller.calls = 0

    def load(self):
        GreyFiller.loads += 1
        return GreyFiller()

    monkeypatch.setattr(FillerbusterDataManager, "load_inpainter", load)
    monkeypatch.setattr(FillerbusterDataManager, "check_inpainter", lambda self: None)
    # Nothing large is here, and each time takes half a second.
    monkeypatch.setattr(surroundings, "release_memory", lambda: None)


def options(**changes) -> CompletionConfig:
    """A small completion from the first step on, whose views are believed and take half of the steps."""
    sizes = {"context_views": 3, "anchor_views": 4, "densify_rounds": 1, "densify_views": 2, "steps": 2}
    return CompletionConfig(**{**sizes, "at_step": 0, "generated_share": 0.5, "trust": "full", **changes})


def make(
    data: Path, completion: CompletionConfig | None = None, test_mode: str = "val", **changes
) -> FillerbusterDataManager:
    config = FillerbusterDataManagerConfig(
        data=data,
        dataparser=NerfstudioDataParserConfig(load_3D_points=changes.pop("points", True)),
        completion=completion or options(),
        cache_images_type=changes.pop("cache_images_type", "uint8"),
        **changes,
    )
    return config.setup(device="cpu", test_mode=test_mode, world_size=1, local_rank=0)


def attributes(manager: FillerbusterDataManager, folder: Path | None = None) -> TrainingCallbackAttributes:
    pipeline = SimpleNamespace(datamanager=manager, model=ToySplats())
    trainer = None if folder is None else ToyTrainer(folder, pipeline)
    return TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=pipeline, trainer=trainer)


def run_callbacks(manager: FillerbusterDataManager, attrs: TrainingCallbackAttributes, step: int = 0) -> None:
    for callback in manager.get_training_callbacks(attrs):
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)


def generated(
    manager: FillerbusterDataManager, folder: Path | None = None, step: int = 0
) -> TrainingCallbackAttributes:
    attrs = attributes(manager, folder)
    run_callbacks(manager, attrs, step)
    return attrs


def draws(manager: FillerbusterDataManager, steps: range) -> list[int | str]:
    """Which views the steps draw: captured ones' indices, and "g" with the sum of a generated one's pose."""
    result = []
    for step in steps:
        camera, batch = manager.next_train(step)
        for drawn in (camera, *batch.get("beside", ())[:1]):
            index = (drawn.metadata or {}).get("cam_idx")
            result.append(index if index is not None else f"g{float(drawn.camera_to_worlds.sum()):.5f}")
    return result


def two_views() -> CompletedViews:
    """One camera at the origin looking along +x, one along -x, 90 degrees wide."""
    centers, ahead = torch.zeros(2, 3), torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    cameras = Pinholes.looking_at(
        centers, centers + ahead, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=90.0, width=8, height=8
    )
    images = torch.stack([torch.full((8, 8, 3), 255), torch.full((8, 8, 3), 51)]).to(torch.uint8)
    origin = Origin(role="anchor", round=0, seed=0, prompt="", model_hash="")
    return CompletedViews(
        images=images, masks=torch.ones(2, 8, 8, 1, dtype=torch.bool), cameras=cameras, origins=(origin, origin)
    )


class Recorder:
    """Stands for viser's server: remembers nodes, switches, fields and buttons."""

    def __init__(self) -> None:
        self.nodes: dict[str, SimpleNamespace] = {}
        self.boxes: dict[str, SimpleNamespace] = {}
        self.fields: dict[str, SimpleNamespace] = {}
        self.bar = SimpleNamespace(value=0.0, visible=False)
        self.client = SimpleNamespace(
            atomic=_NoContext, camera=SimpleNamespace(wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0))
        )
        self.scene = self.gui = self

    def _node(self, name, **values):
        clicks = []
        values = {
            "visible": True,
            "remove": lambda: self.nodes.pop(name),
            "on_click": clicks.append,
            "clicks": clicks,
            **values,
        }
        self.nodes[name] = SimpleNamespace(**values)
        return self.nodes[name]

    def _field(self, label, value=None, **values):
        clicks = []
        hooks = {"on_click": clicks.append, "on_update": clicks.append, "clicks": clicks}
        self.fields[label] = SimpleNamespace(value=value, disabled=False, **hooks, **values)
        return self.fields[label]

    def add_text(self, label, value, **_):
        return self._field(label, value)

    add_number = add_text

    def add_button(self, label, **_):
        return self._field(label)

    def add_dropdown(self, label, options, **_):
        return self._field(label, options[0], options=options)

    def add_progress_bar(self, value, **_):
        return self.bar

    def click(self, thing: str) -> None:
        """On a button or on a frustum, as a person does."""
        for callback in (self.fields | self.nodes)[thing].clicks:
            callback(SimpleNamespace(client=self.client))

    def add_frame(self, name, **values):
        return self._node(name, **values)

    def add_camera_frustum(self, name, **values):
        return self._node(name, **values)

    def add_point_cloud(self, name, points, colors, **values):
        return self._node(name, points=points, colors=colors, **values)

    def add_folder(self, label, order=None):
        return _NoContext()

    def add_markdown(self, content, order=None):
        self.status = SimpleNamespace(content=content)
        return self.status

    def add_checkbox(self, label, initial_value, order=None):
        box = SimpleNamespace(value=initial_value, remove=lambda: self.boxes.pop(label), callbacks=[])
        box.on_update = box.callbacks.append
        self.boxes[label] = box
        return box

    def switch(self, label: str, value: bool) -> None:
        self.boxes[label].value = value
        for callback in self.boxes[label].callbacks:
            callback(None)


class _NoContext:
    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def toy_viewer() -> SimpleNamespace:
    viewer = SimpleNamespace(
        viser_server=Recorder(), config=SimpleNamespace(camera_frustum_scale=0.1), camera_handles={}
    )
    viewer.visible = []
    viewer.set_camera_visibility = viewer.visible.append
    return viewer
