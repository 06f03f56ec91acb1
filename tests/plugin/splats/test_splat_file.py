"""Splats as a file, what photos show of them, pictures with shares, and the budget of a scene."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import pytest
import torch

from fb_core.completion.planning.candidate_views import Candidates
from fb_core.completion.planning.path_candidates import with_path
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import Similarity
from fb_core.geometry.viewpoints.coverage import Coverage
from fb_core.geometry.viewpoints.paths import CaptureShape
from fb_nerfstudio.splats.scene_film import film_frame, seen_by_photos
from fb_nerfstudio.splats.splat_file import Splats, read_splats, write_splats
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.complete.scenes.scene_budget import SceneBudget, Speed

UP = torch.tensor([0.0, 0.0, 1.0])


def random_splats(count: int, degree: int, seed: int = 0) -> Splats:
    draw = torch.Generator().manual_seed(seed)
    return Splats(
        means=torch.randn(count, 3, generator=draw),
        log_scales=torch.randn(count, 3, generator=draw) - 3,
        quats=torch.randn(count, 4, generator=draw),
        logits=torch.randn(count, generator=draw),
        harmonics=torch.randn(count, (degree + 1) ** 2, 3, generator=draw),
    )


def blobs(places: list[list[float]], *, size: float = 0.15) -> Splats:
    """Opaque round grey Gaussians."""
    count = len(places)
    return Splats(
        means=torch.tensor(places).reshape(count, 3),
        log_scales=torch.full((count, 3), math.log(size)),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        logits=torch.full((count,), 6.0),
        harmonics=torch.zeros(count, 1, 3),
    )


def looking(center: list[float], target: list[float], side: int = 32) -> Pinholes:
    at, to = torch.tensor([center]), torch.tensor([target])
    return Pinholes.looking_at(at, to, up=UP, fov_degrees=60.0, width=side, height=side)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_file_gives_back_the_same_bits(degree: int, tmp_path: Path) -> None:
    splats = random_splats(7, degree)
    write_splats(tmp_path / "splats.ply", splats)
    read = read_splats(tmp_path / "splats.ply")
    assert read.degree == degree
    for field in dataclasses.fields(Splats):
        assert torch.equal(getattr(read, field.name), getattr(splats, field.name)), field.name


def test_other_readers_find_the_customary_names_and_values(tmp_path: Path) -> None:
    import trimesh

    splats = random_splats(5, 1)
    write_splats(tmp_path / "splats.ply", splats)
    rows = trimesh.load(str(tmp_path / "splats.ply"), process=False).metadata["_ply_raw"]["vertex"]["data"]
    assert list(rows.dtype.names)[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert torch.equal(
        torch.tensor(rows["f_rest_4"].reshape(-1)), splats.harmonics[:, 2, 1]
    )  # the second colour's second coefficient
    assert torch.equal(torch.tensor(rows["rot_0"].reshape(-1)), splats.quats[:, 0])


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"]
)
def test_other_files_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match="expected a binary PLY file of Gaussian splats"):
        read_splats(tmp_path / "a.ply")
    write_splats(tmp_path / "b.ply", random_splats(9, 1))
    (tmp_path / "b.ply").write_bytes((tmp_path / "b.ply").read_bytes()[:-10])
    with pytest.raises(ValueError, match="its header promises 9 Gaussians"):
        read_splats(tmp_path / "b.ply")


def test_splats_and_cameras_that_move_together_give_the_same_picture() -> None:
    splats, camera = random_splats(50, 1), looking([0.0, -4, 0], [0.0, 0, 0])
    to = Similarity(rotation=torch.eye(3).double(), scale=2.5, shift=torch.tensor([3.0, -1, 2]).double())
    seen = torch.arange(50) % 2 == 0
    one, other = (
        film_frame(splats, seen, camera),
        film_frame(splats.moved(to), seen, to.cameras(camera).to(torch.float32)),
    )
    assert torch.allclose(one.image, other.image, atol=1e-4) and torch.allclose(one.seen, other.seen, atol=1e-4)
    quarter = dataclasses.replace(to, rotation=torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double())
    with pytest.raises(ValueError, match="expected a world that is shifted and scaled only"):
        splats.moved(quarter)


def test_values_that_are_not_finite_are_left_out() -> None:
    parameters = {
        "means": torch.tensor([[0.0, 0, 0], [math.nan, 0, 0]]), "scales": torch.zeros(2, 3), "quats": torch.ones(2, 4),
        "opacities": torch.zeros(2, 1), "features_dc": torch.tensor([[0.2, 0.0, -1.0]]).repeat(2, 1),
        "features_rest": torch.zeros(2, 0, 3),
    }  # fmt: skip
    splats = Splats.of_parameters(parameters, sh_degree=0)
    assert len(splats) == 1
    drawn = 0.5 + 0.28209479177387814 * splats.harmonics[0, 0]  # the constant harmonic
    assert torch.allclose(drawn, torch.tensor([0.2, 0.0, -1.0]).sigmoid(), atol=1e-6)


def test_what_stands_behind_beside_or_under_a_mask_is_not_seen() -> None:
    splats = blobs([[0.0, 0, 0], [0.0, 1.5, 0], [5.0, 0, 0], [0.0, 0, 1.4]], size=0.3)
    splats.log_scales[1] = math.log(0.05)  # far within what the first one covers
    camera = looking([0.0, -4, 0], [0.0, 0, 0])
    assert seen_by_photos(splats, [camera], [None]).tolist() == [
        True,
        False,
        False,
        True,
    ]  # the second stands behind the first
    upper = torch.zeros(32, 32, dtype=torch.bool)
    upper[16:] = True  # the lower half is known
    assert seen_by_photos(splats, [camera], [upper]).tolist() == [True, False, False, False]
    assert seen_by_photos(splats, [camera, looking([0.0, 4, 0], [0.0, 0, 0])], [None, None]).tolist() == [
        True,
        True,
        False,
        True,
    ]
    assert seen_by_photos(splats, [], []).tolist() == [False] * 4


def test_shares_add_up_and_tell_seen_from_made_up_from_empty() -> None:
    splats = blobs([[-0.6, 0, 0], [0.6, 0, 0]], size=0.25)
    frame = film_frame(splats, torch.tensor([True, False]), looking([0.0, -4, 0], [0.0, 0, 0]))
    assert torch.allclose(frame.seen + frame.generated + frame.empty, torch.ones(32, 32), atol=1e-6)
    assert min(float(frame.seen.min()), float(frame.generated.min()), float(frame.empty.min())) >= 0
    assert float(frame.seen[16, 11]) > 0.9 and float(frame.generated[16, 20]) > 0.9 and float(frame.empty[0, 0]) == 1
    picture = frame.trust_picture
    assert (
        float((picture[:, 16, 11] - picture[0, 16, 11]).abs().max()) < 0.1
        and float(picture[0, 16, 20] - picture[2, 16, 20]) > 0.4
    )


# ---- the path among the candidates, and the budget -------------------------------------------------------------------


def test_a_path_s_views_come_first_among_the_candidates() -> None:
    around = torch.stack(
        [looking([math.cos(a), math.sin(a), 0.0], [0.0, 0, 0]).camera_to_world[0] for a in (0.0, 1.0, 2.0)]
    )
    cameras = [dataclasses.replace(looking([1.0, 0, 0], [0.0, 0, 0]), camera_to_world=pose[None]) for pose in around]
    shape = CaptureShape.of(cameras)
    surface = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    coverage = Coverage(surface=surface, weight=torch.ones(20), seen=torch.zeros(20, dtype=torch.bool))
    plain = Candidates(centers=torch.zeros(2, 3), looks=torch.eye(3)[:2], coverage=coverage)
    path = Pinholes.cat([looking([0.0, 3, 0], [0.0, 0, 0])])
    both = with_path(plain, path, shape)
    assert len(both.centers) == 3 and torch.equal(both.centers[0], path.centers[0]) and both.shown(0.5).shape == (3, 20)
    assert torch.allclose(both.looks[0], torch.tensor([0.0, -1, 0]), atol=1e-6)
    of_object = dataclasses.replace(plain, sides=torch.zeros(2, 20, dtype=torch.bool))
    sides = with_path(of_object, path, shape).shown(0.5)
    towards = torch.nn.functional.normalize(path.centers - shape.focus, dim=1)
    cosine = torch.nn.functional.normalize(surface - shape.focus, dim=1) @ towards[0]
    assert sides.shape == (3, 20) and torch.equal(sides[0], cosine > math.cos(math.radians(30)))


def test_more_time_never_makes_less_and_what_is_given_is_kept() -> None:
    speed = Speed(step=2e-6, frame=1.5e-6, whole_step=0.02)

    def budget(seconds: float, **given: int) -> SceneBudget:
        return SceneBudget.of(seconds, speed, CompleteOptions(views=32, **given), photos=(1920, 1080), device="cpu")

    several = [budget(seconds) for seconds in (1, 30, 120, 300, 1200, 10000)]
    for less, more in itertools.pairwise(several):
        assert less.photo_side <= more.photo_side <= 1920 and less.film_side <= more.film_side <= 1920
    for seconds, one in zip((120, 300, 1200, 10000), several[2:], strict=True):
        assert one.seconds <= seconds
    small = SceneBudget.of(100, speed, CompleteOptions(views=1), photos=(32, 32), device="cpu")
    assert small.schedule.steps * speed.whole_step <= small.seconds <= 100  # a step has its price on any picture
    strip = SceneBudget.of(1, speed, CompleteOptions(views=1), photos=(200, 2000), device="cpu")
    assert int(strip.photo_side * 0.1) >= 16  # what is trained on has 16 pixels at least
    given = budget(300, iterations=12, photo_size=100, film_size=5000)
    assert (given.schedule.steps, given.photo_side, given.film_side) == (12, 100, 1920)
