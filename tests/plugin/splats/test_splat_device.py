"""The splat model on a pretended GPU: everything that it makes is where its Gaussians are.

What fake tensors cannot follow is replaced: the search tree for the first Gaussians' sizes, which is SciPy's, and
gsplat's kernels, for which our rasterizer stands in. A picture's size is a value, too; it is the answer 1.
"""

from __future__ import annotations

import gsplat.rendering
import pytest
import torch
from helpers.pretended_device import DEVICE, drawn, made_there, pretended
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import SceneBox

from fb_core.splatting.rasterizer import rasterization
from fb_nerfstudio.splats import gaussians
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel, FillerbusterSplatModelConfig

pytestmark = pytest.mark.usefixtures("shapes_unchecked")


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat.rendering, "rasterization", lambda **given: rasterization(**given))
    monkeypatch.setattr(gaussians, "neighbour_distance", lambda points, among=None: points.new_ones(len(points)))


def model_there(**options: object) -> FillerbusterSplatModel:
    with made_there():
        config = FillerbusterSplatModelConfig(num_downscales=0, sh_degree=1, sh_degree_interval=1, **options)
        model = config.setup(
            scene_box=SceneBox(torch.zeros(2, 3)), num_train_data=4, seed_points=(drawn(40, 3), drawn(40, 3))
        )
    model.optimizers = {}
    return model


def camera_there() -> Cameras:
    size = torch.ones(1, 1, dtype=torch.int64, device=DEVICE)
    focal = {name: drawn(1, 1) for name in ("fx", "fy", "cx", "cy")}
    return Cameras(drawn(1, 3, 4), **focal, width=size, height=size, camera_type=CameraType.PERSPECTIVE)


def devices(tensors: dict[str, torch.Tensor]) -> set[torch.device]:
    return {value.device for value in tensors.values()}


@pytest.mark.parametrize("options", [{}, {"strategy": "mcmc"}], ids=["default", "mcmc"])
def test_renders_and_losses_are_where_the_gaussians_are(options: dict[str, str]):
    with pretended(True):
        model = model_there(normal_loss_from=0, **options)
        assert devices(dict(model.gauss_params.items())) == {DEVICE}
        outputs = model.train().get_outputs(camera_there())
        batch = {name: torch.ones(1, 1, channels, device=DEVICE) for name, channels in BATCH.items()}
        losses = model.get_loss_dict(outputs, batch)
        assert {"main_loss", "normal_alignment", "normal_tv"} <= losses.keys()
        assert devices(outputs) == devices(losses) == {DEVICE}


BATCH = {"image": 3, "mask": 1, "trust": 1}


def test_pictures_of_an_evaluation_are_there_too():
    with pretended(True), torch.no_grad():
        outputs = model_there().eval().get_outputs(camera_there())
        assert {"rgb", "depth", "normal", "surface_normal"} <= outputs.keys() and devices(outputs) == {DEVICE}


def test_gaussians_come_to_those_that_are_there():
    with pretended(True), torch.no_grad():
        model = model_there(max_gaussians=50)
        made = gaussians.gaussians_at(drawn(4, 3), drawn(4, 3), sh_degree=1, among=model.means)
        assert devices(made) == {DEVICE} and model.room == 10
