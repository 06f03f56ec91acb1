"""Laws of completion: known content survives, unknown content never leaks, any size, any mixture, reproducible per
view.
"""

import dataclasses

import jaxtyping
import pytest
import torch
from helpers.scenes.mixed_views import cameras, mixed_views, seeded
from helpers.tiny_models import tiny_model

from fb_core.inpainter import Fillerbuster, SamplingConfig, noise_of
from fb_core.sampling.guidance import GuidanceVariant
from fb_core.views import Views

QUICK = SamplingConfig(steps=2, guidance_unknown=3.0)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("inpainter"))


def test_known_pixels_and_rays_are_returned_as_given(model):
    views = mixed_views()
    done = model.complete(views, generator=seeded(), sampling=QUICK)
    assert torch.equal(done.images * views.image_known, views.images * views.image_known)
    assert torch.equal(done.raymaps, views.raymaps)
    assert bool((done.image_known == 1).all()) and bool((done.rays_known == 1).all())
    assert done.images.min() >= 0 and done.images.max() <= 1


def test_what_stands_in_unknown_pixels_is_never_looked_at(model):
    views = mixed_views()
    poisoned = dataclasses.replace(views, images=torch.where(views.image_known > 0, views.images, torch.nan))
    wanted = model.complete(views, generator=seeded(), sampling=QUICK)
    got = model.complete(poisoned, generator=seeded(), sampling=QUICK)
    assert torch.equal(got.images, wanted.images) and bool(torch.isfinite(got.images).all())


def test_same_seed_same_bits_another_seed_another_sample(model):
    views = mixed_views()
    first, again, other = (model.complete(views, generator=seeded(s), sampling=QUICK).images for s in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_noise_of_a_view_does_not_depend_on_how_many_views_there_are():
    assert torch.equal(noise_of(5, 3, (4, 4)), noise_of(5, 7, (4, 4))[:3])
    assert not torch.equal(noise_of(5, 2, (4, 4))[0], noise_of(5, 2, (4, 4))[1])


def test_permuting_views_permutes_the_output_without_index_embeddings(tmp_path, monkeypatch):
    """With the noise permuted too; the first view stays first because it is the frame's reference."""
    model = tiny_model(tmp_path, index="none")
    views = mixed_views(known=2, partial=1, unknown=2)
    noise = torch.randn(5, 32, 4, 4, generator=seeded(3))
    order = [0, 3, 1, 4, 2]
    import fb_core.inpainter as inpainter

    monkeypatch.setattr(inpainter, "noise_of", lambda seed, count, size: noise)
    straight = model.complete(views, generator=seeded(), sampling=QUICK)
    monkeypatch.setattr(inpainter, "noise_of", lambda seed, count, size: noise[order])
    permuted = model.complete(views[order], generator=seeded(), sampling=QUICK)
    assert torch.allclose(permuted.images, straight.images[order], atol=1e-4)


@pytest.mark.parametrize(("width", "height"), [(16, 16), (48, 16), (33, 47), (17, 80)])
def test_any_size_and_aspect_ratio(model, width, height):
    views = mixed_views(width=width, height=height)
    done = model.complete(views, generator=seeded(), sampling=QUICK)
    assert done.size == (height, width) and bool(torch.isfinite(done.images).all())


@pytest.mark.parametrize("mixture", [(1, 0, 0), (0, 0, 1), (0, 1, 0), (0, 0, 3), (3, 0, 0), (1, 0, 63)])
def test_any_number_of_views_and_any_mixture(model, mixture):
    done = model.complete(mixed_views(*mixture), generator=seeded(), sampling=QUICK)
    assert len(done) == sum(mixture) and bool(torch.isfinite(done.images).all())


def test_rays_of_unposed_photos_are_recovered_as_unit_directions(model):
    images = torch.rand(3, 3, 32, 32, generator=seeded(2))
    done = model.complete(Views.unposed(images), generator=seeded(), sampling=QUICK)
    assert torch.equal(done.images, images)
    assert torch.allclose(done.raymaps[:, 3:].norm(dim=1), torch.ones(3, 32, 32), atol=1e-4)


def test_posed_and_unposed_views_in_one_sequence(model):
    posed = Views.known(torch.rand(2, 3, 32, 32, generator=seeded(2)), cameras(2))
    both = Views.cat([posed, Views.unposed(torch.rand(1, 3, 32, 32, generator=seeded(3)))])
    done = model.complete(both, generator=seeded(), sampling=QUICK)
    assert torch.equal(done.raymaps[:2], posed.raymaps) and bool(torch.isfinite(done.raymaps).all())


def test_the_answer_does_not_depend_on_where_and_how_large_the_scene_is(model):
    """The canonical frame absorbs every similarity that keeps the reference camera's up."""
    views = mixed_views()
    frame_rotation = torch.linalg.qr(torch.randn(3, 3, generator=seeded(9)))[0]
    frame_rotation *= torch.linalg.det(frame_rotation)
    origins = 3.0 * torch.einsum("ij,njhw->nihw", frame_rotation, views.raymaps[:, :3]) + 10.0
    directions = torch.einsum("ij,njhw->nihw", frame_rotation, views.raymaps[:, 3:])
    moved = dataclasses.replace(views, raymaps=torch.cat([origins, directions], dim=1))
    wanted = model.complete(views, generator=seeded(), sampling=QUICK).images
    assert torch.allclose(model.complete(moved, generator=seeded(), sampling=QUICK).images, wanted, atol=2e-3)


def test_progress_is_reported_per_step(model):
    seen = []
    model.complete(mixed_views(), generator=seeded(), sampling=QUICK, on_step=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 2), (2, 2)]


def test_windows_complete_more_views_than_fit(model):
    done = model.complete(
        mixed_views(2, 1, 4), generator=seeded(), sampling=dataclasses.replace(QUICK, window=3, rounds=2)
    )
    assert len(done) == 7 and bool(torch.isfinite(done.images).all())


def test_bad_views_are_refused_with_one_sentence(model):
    with pytest.raises(ValueError, match="at least 16x16 pixels, got 12x20"):
        model.complete(mixed_views(width=12, height=20), generator=seeded())
    with pytest.raises(ValueError, match="at least one view"):
        model.complete(mixed_views()[[]], generator=seeded())
    views = mixed_views()
    broken = views.images.clone()
    broken[0, :, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="1 known pixels are NaN"):
        model.complete(dataclasses.replace(views, images=broken), generator=seeded())
    with pytest.raises(ValueError, match="must lie in"):
        model.complete(dataclasses.replace(views, image_known=views.image_known * 2), generator=seeded())
    for far in (
        {"images": views.images * 1e30},
        {"raymaps": views.raymaps * 1e30},
    ):  # their squares are infinite, the answer was NaN
        with pytest.raises(ValueError, match="are beyond"):
            model.complete(dataclasses.replace(views, **far), generator=seeded())


def test_pixels_in_integers_are_refused(model, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users run without the tests' type checks
    views = mixed_views()
    with pytest.raises(ValueError, match=r"pixels in floating-point numbers, got torch\.uint8"):
        model.complete(dataclasses.replace(views, images=(255 * views.images).to(torch.uint8)), generator=seeded())


def test_a_caller_s_autocast_changes_not_a_bit():
    bundled, views = Fillerbuster.from_pretrained(), mixed_views()
    wanted = bundled.complete(views, generator=seeded(), sampling=QUICK)
    with torch.autocast("cpu", torch.bfloat16):
        got = bundled.complete(views, generator=seeded(), sampling=QUICK)
        assert torch.is_autocast_enabled("cpu")
    assert torch.equal(got.images, wanted.images) and torch.equal(got.raymaps, wanted.raymaps)


@pytest.mark.parametrize(
    "nonsense", [{"steps": 0}, {"solver": "magic"}, {"rounds": 0}, {"views_at_once": 0}, {"shift": -1.0}]
)
def test_nonsense_sampling_is_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        SamplingConfig(**nonsense)


@pytest.mark.parametrize("name", ["steps", "rounds", "window", "views_at_once"])
@pytest.mark.parametrize("value", [2.5, 2.0, True, "3"])
def test_counts_of_a_sampling_are_whole_numbers(name, value, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match="expected a whole number, got"):
        SamplingConfig(**{name: value})


@pytest.mark.parametrize("shift", [1e30, 1e-323])
def test_a_shift_that_leaves_steps_without_length_is_refused(shift):
    with pytest.raises(ValueError, match="leaves steps without length"):
        SamplingConfig(shift=shift)
    assert len(set(SamplingConfig(shift=1000.0).times)) == 25


def test_guidance_that_overflows_is_refused():
    with pytest.raises(ValueError, match="guidance_unknown: expected -1000 to 1000"):
        SamplingConfig(guidance_unknown=1e30)


def test_a_model_s_own_sampling_is_the_default_everywhere(tmp_path):
    model = tiny_model(tmp_path)
    own = {"steps": 3, "guidance_unknown": 2.0, "shift": 1.5, "window": 2}
    model.info["sampling"] = own
    views, recommended = mixed_views(1, 1, 2), SamplingConfig(**own)
    by_default = model.complete(views, generator=seeded())
    asked, usual = (
        model.complete(views, generator=seeded(), sampling=one) for one in (recommended, SamplingConfig(steps=3))
    )
    assert torch.equal(by_default.images, asked.images) and not torch.equal(by_default.images, usual.images)
    assert model.denoising(views, seed=0).sampling == recommended
    assert (
        model.estimate(24, (64, 64))
        == model.estimate(24, (64, 64), recommended)
        != model.estimate(24, (64, 64), SamplingConfig())
    )
    images = torch.rand(3, 3, 32, 32, generator=seeded(2))
    poses = model.recover_raymaps(images, generator=seeded(), sampling=recommended.for_poses())
    assert torch.equal(model.recover_raymaps(images, generator=seeded()), poses)


def test_progress_tells_step_time_and_a_cheap_preview(model):
    seen = []
    model.complete(
        mixed_views(),
        generator=seeded(),
        sampling=dataclasses.replace(QUICK, steps=4, shift=1.0),
        on_progress=seen.append,
    )
    assert [(at.step, at.steps, at.time) for at in seen] == [(1, 4, 0.75), (2, 4, 0.5), (3, 4, 0.25), (4, 4, 0.0)]
    preview = seen[-1].preview()
    assert preview.shape == (5, 3, 4, 4) and 0 <= preview.min() and preview.max() <= 1
    assert seen[-1].latents.shape == (5, 32, 4, 4)


def test_a_preview_looks_like_the_decoded_views():
    """The bundled autoencoder: the matrix explains most of what a decoding explains."""
    import torch.nn.functional as F

    from fb_core.sampling.preview import LatentColors

    vae = Fillerbuster.from_pretrained().image_vae
    coarse = torch.rand(6, 3, 3, 3, generator=seeded(8))
    pictures = F.interpolate(coarse, size=(64, 64), mode="bicubic", align_corners=True).clamp(0, 1)
    with torch.no_grad():
        preview = LatentColors.of(vae)(vae.encode(pictures))
    wanted = F.avg_pool2d(pictures, 8)
    assert (preview - wanted).square().mean() < 0.1 * wanted.var()


def test_known_latents_may_be_imposed(model):
    views = mixed_views()
    plain = model.complete(views, generator=seeded(), sampling=QUICK)
    imposed = model.complete(views, generator=seeded(), sampling=dataclasses.replace(QUICK, known="imposed"))
    assert torch.equal(imposed.images * views.image_known, views.images * views.image_known)
    assert not torch.equal(imposed.images, plain.images)


@pytest.mark.parametrize("change", [{}, {"window": 2}, {"guidance": GuidanceVariant(rescale=0.5)}])
def test_where_known_latents_are_imposed_what_nobody_asks_for_changes_nothing(model, monkeypatch, change):
    sampling = dataclasses.replace(QUICK, known="imposed", solver="corrected", **change)
    denoising = model.denoising(mixed_views(), seed=0, sampling=sampling)
    asked = denoising._asked()
    assert (asked is None) == ("guidance" in change) and (asked is None or 0 < int(asked.sum()) < asked.numel())
    latents = denoising.run()
    monkeypatch.setattr(type(denoising), "_asked", lambda self: None)
    torch.testing.assert_close(latents, denoising.run(), atol=1e-4, rtol=1e-5)


def test_reference_compatible_is_the_original_s_way_not_ours(model):
    views = mixed_views()
    options = {"steps": 3, "guidance_unknown": 7.0}
    original = model.complete(views, generator=seeded(), sampling=SamplingConfig(reference_compatible=True, **options))
    same_grid = model.complete(
        views, generator=seeded(), sampling=SamplingConfig(solver="euler", grid="reference", shift=1.0, **options)
    )
    assert not torch.allclose(original.images, same_grid.images, atol=1e-3), "the guidance map lands on other views"
    even = {"steps": 3, "guidance_unknown": 2.0, "guidance_known": 2.0}
    one_view = mixed_views(0, 1, 0)
    original = model.complete(one_view, generator=seeded(), sampling=SamplingConfig(reference_compatible=True, **even))
    same_grid = model.complete(
        one_view, generator=seeded(), sampling=SamplingConfig(solver="euler", grid="reference", shift=1.0, **even)
    )
    assert torch.allclose(original.images, same_grid.images, atol=1e-5), (
        "one view under one scale has nothing to scramble"
    )


def test_raymaps_of_photos_have_an_entry_of_their_own(model):
    raymaps = model.recover_raymaps(torch.rand(3, 3, 32, 32, generator=seeded(2)), generator=seeded(), sampling=QUICK)
    assert raymaps.shape == (3, 6, 32, 32) and torch.allclose(
        raymaps[:, 3:].norm(dim=1), torch.ones(3, 32, 32), atol=1e-4
    )
