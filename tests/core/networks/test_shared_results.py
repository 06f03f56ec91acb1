"""Results that samplings share: the same bits as without, never an answer to another question, in bounded memory."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from helpers.scenes.mixed_views import mixed_views, seeded

from fb_core import inpainter
from fb_core.completion.inpainters.lazy_inpainter import LazyInpainter
from fb_core.inpainter import Fillerbuster
from fb_core.networks.shared_results import LIMIT_BYTES, SharedResults
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE
from fb_core.views import Views

QUICK = dataclasses.replace(Fillerbuster.from_pretrained().recommended_sampling, steps=1)


@pytest.fixture
def model() -> Fillerbuster:
    """The bundled model, in which known tokens stand apart."""
    return Fillerbuster.from_pretrained()


@pytest.fixture
def work(monkeypatch) -> list[str]:
    """What the networks computed of what is known, in order."""
    done: list[str] = []

    def counting(owner: type, name: str, says) -> None:
        plain = getattr(owner, name)

        def counted(self, *arguments, **options):
            done.append(says(self))
            return plain(self, *arguments, **options)

        monkeypatch.setattr(owner, name, counted)

    counting(VAE, "encode", lambda vae: "rays" if vae.config.in_channels == 6 else "images")
    counting(DiT, "run_known", lambda dit: "known")
    return done


def posed(*, unknown: int = 2, moved: float = 0.0) -> Views:
    """Views with known rays: five pictures wholly or partly known, and so many unknown ones, at other places if they
    are ``moved``, within the extent of all.
    """
    views = mixed_views(4, 1, unknown)
    rays = views.raymaps.clone()
    rays[1, :3] += 1000  # the frame follows the known view that is farthest out
    rays[5:, :3] += moved
    return dataclasses.replace(views, raymaps=rays)


def ask(model: Fillerbuster, views: Views, seed: int = 0, sampling: SamplingConfig = QUICK) -> Views:
    return model.complete(views, generator=seeded(seed), sampling=sampling)


def same(one: Views, other: Views) -> bool:
    return torch.equal(one.images, other.images) and torch.equal(one.raymaps, other.raymaps)


# ---- answers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"precision": "bfloat16"},
        {"window": 3, "rounds": 2},
        {"guidance_unknown": 3.0},
        {"sample_posterior": True},
        {"views_at_once": 2},
    ],
    ids=["plain", "bfloat16", "windows", "guided", "posterior", "few at once"],
)
def test_rounds_that_share_are_what_rounds_alone_are_to_the_bit(model, change) -> None:
    sampling = dataclasses.replace(QUICK, **change)
    rounds = [posed(), posed(moved=0.25), posed(moved=-0.5), posed(unknown=3), posed()[[2, 0, 5, 1, 3, 4, 6]]]
    alone = [ask(model, views, seed, sampling) for seed, views in enumerate(rounds)]
    model.shared = SharedResults()
    for _ in range(2):
        shared = [ask(model, views, seed, sampling) for seed, views in enumerate(rounds)]
        assert all(same(*pair) for pair in zip(alone, shared, strict=True))
    assert model.shared.answered


def test_rounds_in_one_frame_encode_and_show_what_is_known_once(model, work) -> None:
    model.shared = SharedResults()
    sampling = dataclasses.replace(QUICK, views_at_once=5)
    ask(model, posed(), 0, sampling)
    first = list(work)
    work.clear()
    ask(model, posed(moved=0.25), 1, sampling)
    assert first.count("known") == 1 and "images" in first
    assert work == ["rays"]  # of the unknown views alone


def test_another_scale_of_the_frame_leaves_the_latents_of_pictures_alone_shared(model, work) -> None:
    model.shared = SharedResults()
    ask(model, posed())
    work.clear()
    ask(model, posed(moved=5000.0))
    assert "known" in work and "rays" in work and "images" not in work


@pytest.mark.parametrize("what", ["picture", "mask", "ray", "pose", "order", "size", "precision"])
def test_a_changed_question_is_never_answered_with_what_was_kept(model, work, what) -> None:
    views, sampling = posed(), QUICK
    model.shared = SharedResults()
    ask(model, views)
    images, image_known, rays = views.images.clone(), views.image_known.clone(), views.raymaps.clone()
    if what == "picture":
        images[1, 0, 3, 3] += 1e-6
    elif what == "mask":
        image_known[1, 0, 3, 3] = 0
    elif what == "ray":
        rays[1, 3, 3, 3] += 1e-4
    elif what == "pose":
        rays[1, 2] += 0.01
    views = dataclasses.replace(views, images=images, image_known=image_known, raymaps=rays)
    if what == "order":
        views = views[[1, 0, 2, 3, 4, 5, 6]]
    elif what == "size":
        views = Views(**{f.name: getattr(views, f.name)[..., :16] for f in dataclasses.fields(Views)})
    elif what == "precision":
        sampling = dataclasses.replace(QUICK, precision="bfloat16")
    work.clear()
    got = ask(model, views, 0, sampling)
    assert "known" in work
    model.shared = None
    assert same(got, ask(model, views, 0, sampling))


@pytest.mark.parametrize("part", ["dit", "image_vae", "raymap_vae"])
@pytest.mark.parametrize("how", ["written to", "loaded", "another network"])
def test_other_weights_are_never_answered_with_what_was_kept(model, part: str, how: str) -> None:
    views, network = posed(), getattr(model, part)
    model.shared = SharedResults()
    ask(model, views)
    other = copy.deepcopy(network)
    for weight in other.parameters():
        weight.mul_(1.25)
    if how == "written to":
        for weight in network.parameters():
            weight.mul_(1.25)
    elif how == "loaded":
        network.load_state_dict(other.state_dict())
    else:
        setattr(model, part, other)
    got = ask(model, views)
    model.shared = None
    assert same(got, ask(model, views))


def test_a_copy_of_a_model_with_all_that_it_keeps_answers_as_the_model(model) -> None:
    model.shared = SharedResults()
    expected = ask(model, posed())
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert same(expected, ask(twin, posed())) and same(expected, ask(model, posed()))


def test_threads_get_right_answers_and_the_bound_holds() -> None:
    shared, switching = SharedResults(4000), sys.getswitchinterval()

    def asked(turn: int) -> bool:
        name = turn * 7 % 23
        return int(shared.of(lambda: torch.full((100,), name), str(name))[0]) == name

    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert all(pool.map(asked, range(3000)))
    finally:
        sys.setswitchinterval(switching)
    kept = sum(size for _, size in shared._results.values())
    assert 0 < shared.bytes == kept <= 4000


# ---- memory ----------------------------------------------------------------------------------------------------------


def test_the_oldest_results_make_room_and_too_large_ones_are_not_kept() -> None:
    shared, calls = SharedResults(100), []

    def of(name: str, count: int) -> torch.Tensor:
        def compute() -> torch.Tensor:
            calls.append(name)
            return torch.zeros(count)

        return shared.of(compute, name)

    for name, count in (("a", 10), ("b", 10), ("a", 10), ("c", 10)):
        of(name, count)
    assert calls == ["a", "b", "c"] and shared.bytes == 80 and shared.room_bytes == 20
    for name, count in (("a", 10), ("b", 10)):
        of(name, count)
    assert calls == ["a", "b", "c", "b"]
    for name, count in (("d", 26), ("d", 26)):
        of(name, count)
    assert calls[-2:] == ["d", "d"] and shared.bytes == 80
    shared.forget()
    assert shared.bytes == 0
    of("a", 10)
    assert calls[-1] == "a"


def test_what_a_result_keeps_alive_is_counted_once() -> None:
    shared, base = SharedResults(), torch.zeros(100)
    shared.of(lambda: {"half": [base[:50]], "rest": (base[50:],)}, "x")
    assert shared.bytes == 400


def test_nothing_but_all_that_decides_is_the_same() -> None:
    shared = SharedResults()
    x = torch.arange(6.0)
    asked = [
        (x, "a"), (x, "b"), (x.view(2, 3), "a"), (x.double(), "a"), (x, None), (x[:3], x[3:]), (x[:2], x[2:]), (x,),
        (x + 0.0, "a", ""), ("a", x),
    ]  # fmt: skip
    got = [shared.of(lambda number=number: [torch.tensor(number)], *parts) for number, parts in enumerate(asked)]
    assert [int(one[0]) for one in got] == list(range(len(asked)))
    assert int(shared.of(lambda: [torch.tensor(-1)], x.clone(), "a")[0]) == 0
    assert int(shared.of(lambda: [torch.tensor(-1)], x.view(2, 3).t().contiguous().t(), "a")[0]) == 2


def test_the_estimate_counts_what_is_kept_and_a_budget_without_room_keeps_nothing(model, monkeypatch) -> None:
    views = posed()
    bare = model.estimate(len(views), views.size, QUICK)
    model.shared = SharedResults()
    assert model.estimate(len(views), views.size, QUICK).peak == bare.peak + LIMIT_BYTES
    ask(model, views)
    assert model.shared.bytes > 0
    tight = dataclasses.replace(QUICK, memory_budget_bytes=bare.peak + LIMIT_BYTES - 1)
    assert model.estimate(len(views), views.size, tight).peak == bare.peak
    ask(model, views, 0, tight)
    assert model.shared.bytes == 0
    ask(model, views, 0, dataclasses.replace(tight, memory_budget_bytes=bare.peak + LIMIT_BYTES))
    assert model.shared.bytes > 0
    monkeypatch.setattr(inpainter, "available_bytes", lambda device: bare.working + model.shared.room_bytes - 1)
    assert model._cut(len(views), views.size, QUICK, None).views_decoded >= 1


def test_a_completion_s_model_shares_and_says_so_before_it_is_loaded() -> None:
    lazy = LazyInpainter(None, "cpu")
    _, said = lazy.expected(views=4, known=2, size=32, sampling=QUICK)
    assert lazy._loaded().shared is not None
    assert said == lazy._loaded().estimate(4, (32, 32), QUICK).peak
