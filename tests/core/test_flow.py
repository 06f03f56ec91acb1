"""Laws of the flow: endpoints, target, zero loss of a perfect network."""

import torch

from fb_core.flow import at_time, logit_normal_times, masked_loss, validation_loss, velocity


def pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(2, 3, 32, 4, 4, generator=generator), torch.randn(2, 3, 32, 4, 4, generator=generator)


def test_endpoints_are_data_and_noise():
    data, noise = pair()
    assert torch.equal(at_time(data, noise, torch.zeros(2)), data)
    assert torch.equal(at_time(data, noise, torch.ones(2)), noise)


def test_velocity_is_the_derivative_of_the_path():
    data, noise = (x.double() for x in pair())
    step, time = 1e-6, torch.full((2,), 0.3, dtype=torch.float64)
    slope = (at_time(data, noise, time + step) - at_time(data, noise, time)) / step
    assert torch.allclose(slope, velocity(data, noise), atol=1e-6)


def test_data_is_recovered_from_a_perfect_velocity():
    data, noise = pair()
    time = torch.tensor([0.2, 0.9])
    assert torch.allclose(
        at_time(data, noise, time) - time[:, None, None, None, None] * velocity(data, noise), data, atol=1e-6
    )


def test_perfect_network_has_zero_loss():
    data, noise = pair()
    assert masked_loss(velocity(data, noise), velocity(data, noise)) == 0
    losses = validation_loss(lambda state, time: velocity(data, noise), data, noise, steps=5)
    assert losses.shape == (5, 2) and torch.equal(losses, torch.zeros(5, 2))


def test_loss_ignores_positions_without_ground_truth():
    data, noise = pair()
    weight = torch.zeros(2, 3, 1, 4, 4)
    weight[:, 0] = 1
    wrong = velocity(data, noise).clone()
    wrong[:, 1:] += 100
    wrong[:, 0] += 2
    loss = masked_loss(wrong.requires_grad_(), velocity(data, noise), weight)
    assert torch.allclose(loss, torch.tensor(4.0 / 3)), (
        "an error of 2 in one view of three; the mean is over all of them"
    )
    (gradient,) = torch.autograd.grad(loss, wrong)
    assert not gradient[:, 1:].any() and bool(gradient[:, 0].any())
    assert masked_loss(wrong, data, torch.zeros_like(weight)) == 0


def test_losses_of_equal_parts_average_to_the_whole_s_however_uneven_their_ground_truth():
    (data, noise), weight = pair(), torch.zeros(2, 3, 1, 4, 4)
    weight[0], weight[1, 0, :, 0] = 1, 1
    whole, *parts = (
        masked_loss(data[part], noise[part], weight[part]) for part in (slice(None), slice(0, 1), slice(1, 2))
    )
    assert torch.allclose(whole, (parts[0] + parts[1]) / 2) and parts[0] > 3 * parts[1]
    assert torch.allclose(masked_loss(data, noise, torch.ones_like(weight)), masked_loss(data, noise))


def test_validation_has_the_same_loss_per_modality():
    data, noise = pair()
    wrong = velocity(data, noise).clone()
    wrong[:, :, :16] += 2
    wrong[:, :, 16:] += 3
    losses = validation_loss(lambda state, time: wrong, data, noise, steps=2)
    assert torch.allclose(losses, torch.tensor([[4.0, 9.0]] * 2))
    for column, channels in enumerate((slice(16), slice(16, None))):
        assert torch.equal(losses[0, column], masked_loss(wrong, velocity(data, noise), channels=channels))


def test_times_are_logit_normal():
    times = logit_normal_times(20_000, generator=torch.Generator().manual_seed(0))
    logits = torch.logit(times)
    assert 0 < times.min() and times.max() < 1
    assert abs(float(logits.mean())) < 0.03 and abs(float(logits.std()) - 1) < 0.03
