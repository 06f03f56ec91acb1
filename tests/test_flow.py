"""Laws of the flow: endpoints, target, zero loss of a perfect network."""

import torch

from fb_core.flow import at_time, data_from, logit_normal_times, masked_loss, validation_loss, velocity


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
    assert torch.allclose(data_from(at_time(data, noise, time), velocity(data, noise), time), data, atol=1e-6)


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
    assert torch.allclose(masked_loss(wrong, velocity(data, noise), weight), torch.tensor(4.0))
    assert masked_loss(wrong, data, torch.zeros_like(weight)) == 0


def test_times_are_logit_normal():
    times = logit_normal_times(20_000, generator=torch.Generator().manual_seed(0))
    logits = torch.logit(times)
    assert 0 < times.min() and times.max() < 1
    assert abs(float(logits.mean())) < 0.03 and abs(float(logits.std()) - 1) < 0.03
