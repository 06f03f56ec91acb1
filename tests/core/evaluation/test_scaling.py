"""More context and longer sequences: the rows differ in nothing but what they name."""

import pytest
from helpers.tiny_models import save_tiny_model, tiny_model

from fb_core.evaluation import scaling
from fb_core.evaluation.completion import complete_hidden
from fb_core.evaluation.scaling import ScalingTask, evaluate_scaling
from fb_core.inpainter import SamplingConfig
from method_configs.evaluations.scaling import Scaling

TASK = ScalingTask(rooms=1, contexts=(1, 2), lengths=(1, 2), scored=2, known=1, trained_views=3)


def test_every_row_asks_for_the_same_hidden_views(tmp_path, monkeypatch):
    asked = []

    def recorded(model, given, hidden, sampling, *, seed):
        asked.append((len(given.images), hidden))
        return complete_hidden(model, given, hidden, sampling, seed=seed)

    monkeypatch.setattr(scaling, "complete_hidden", recorded)
    rows = evaluate_scaling(tiny_model(tmp_path), TASK, SamplingConfig(steps=1))
    assert [(row["part"], row["known"], row["views"]) for row in rows] == [
        ("context", 1, 3),
        ("context", 2, 4),
        ("length", 1, 3),
        ("length", 1, 6),
    ]
    first = asked[0][1]
    assert [(known, len(hidden)) for known, hidden in asked] == [(1, 2), (2, 2), (1, 2), (1, 5)]
    assert all((hidden.camera_to_world[:2] == first.camera_to_world).all() for _, hidden in asked)


@pytest.mark.parametrize("nonsense", [{"contexts": (0,)}, {"rooms": 0}, {"scored": 12}, {"family": "castle"}])
def test_nonsense_is_refused(nonsense):
    with pytest.raises(ValueError, match=r"expected|do not fit"):
        ScalingTask(**nonsense)


def test_the_command_writes_report_and_figure(tmp_path):
    folder = save_tiny_model(tmp_path / "model")
    options = {"rooms": 1, "contexts": (1,), "lengths": (1,), "scored": 2}
    Scaling(model=folder, json=tmp_path / "scaling.json", figure=tmp_path / "scaling.png", **options).run()
    assert (tmp_path / "scaling.json").exists() and (tmp_path / "scaling.png").exists()
