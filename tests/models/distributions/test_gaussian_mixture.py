from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal, kl_divergence

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.distributions import (
    NoisyNormal,
    component_log_prob,
    enumerated_kl,
    gaussian_mixture_log_prob,
    kl_to_each_component,
    label_posterior,
)

COMPONENTS = torch.randn(6, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 3 + 5
LOG_WEIGHTS = torch.log_softmax(torch.arange(6.0, dtype=torch.float64) / 3, -1)


def posterior() -> tuple[torch.Tensor, torch.Tensor]:
    return COMPONENTS[:3] + 0.7 * torch.randn(5, 3, 4), 0.2 + torch.rand(5, 3, 4)


def test_densities_match_torch() -> None:
    value, _ = posterior()
    parts = Independent(Normal(COMPONENTS, torch.ones(6, 4)), 1)
    torch.testing.assert_close(component_log_prob(value, COMPONENTS), parts.log_prob(value[..., None, :]))
    mixture = MixtureSameFamily(Categorical(logits=LOG_WEIGHTS), parts)
    torch.testing.assert_close(gaussian_mixture_log_prob(value, COMPONENTS, LOG_WEIGHTS), mixture.log_prob(value))
    single = component_log_prob(value.float(), COMPONENTS.float())
    torch.testing.assert_close(single.double(), component_log_prob(value, COMPONENTS), rtol=1e-5, atol=1e-4)


def test_kl_to_each_component_matches_torch_and_monte_carlo(assert_mean) -> None:
    loc, scale = posterior()
    kl = kl_to_each_component(loc, scale, COMPONENTS)
    reference = kl_divergence(Normal(loc[..., None, :], scale[..., None, :]), Normal(COMPONENTS, torch.ones(6, 4))).sum(-1)
    torch.testing.assert_close(kl, reference)
    q = Normal(loc, scale)
    z = q.sample((5000,))
    assert_mean(q.log_prob(z).sum(-1)[..., None] - component_log_prob(z, COMPONENTS), kl)


def test_enumerated_kl_is_the_minimum_over_label_posteriors_and_bounds_the_kl(assert_mean) -> None:
    loc, scale = posterior()
    kl = kl_to_each_component(loc, scale, COMPONENTS)
    bound = enumerated_kl(kl, LOG_WEIGHTS)

    def joint(log_q: torch.Tensor) -> torch.Tensor:
        return (log_q.exp() * (log_q - LOG_WEIGHTS + kl)).sum(-1)

    torch.testing.assert_close(joint(label_posterior(kl, LOG_WEIGHTS)), bound)
    for _ in range(20):
        assert bool((joint(torch.log_softmax(torch.randn_like(kl), -1)) >= bound).all())
    q = Normal(loc, scale)
    z = q.sample((5000,))
    exact = q.log_prob(z).sum(-1) - gaussian_mixture_log_prob(z, COMPONENTS, LOG_WEIGHTS)
    assert bool((exact.mean(0) <= bound + 5 * exact.std(0) / math.sqrt(5000)).all())
    # With one component it is that component's KL.
    torch.testing.assert_close(enumerated_kl(kl[..., :1], torch.zeros(1)), kl[..., 0])


@settings(max_examples=30, deadline=None, derandomize=True)
@given(shift=st.floats(-1e4, 1e4))
def test_densities_do_not_depend_on_the_origin(shift) -> None:
    value = COMPONENTS[:2] + 0.3
    moved = component_log_prob(value + shift, COMPONENTS + shift)
    torch.testing.assert_close(moved, component_log_prob(value, COMPONENTS), rtol=1e-9, atol=1e-9)


def test_gradients() -> None:
    loc, scale = (x[0].clone().requires_grad_() for x in posterior())
    components = COMPONENTS.clone().requires_grad_()
    check = torch.autograd.gradcheck
    assert check(lambda m, s, c: enumerated_kl(kl_to_each_component(m, s, c), LOG_WEIGHTS), (loc, scale, components))
    assert check(lambda m, c: gaussian_mixture_log_prob(m, c, LOG_WEIGHTS), (loc, components))


def test_noisy_normal_uses_the_given_noise(assert_mean) -> None:
    loc, scale, noise = torch.randn(3, 4, requires_grad=True), torch.rand(4) + 0.1, torch.randn(3, 4)
    q = NoisyNormal(loc, scale, noise)
    state = torch.get_rng_state()
    torch.testing.assert_close(q.rsample(), loc + scale * noise)
    assert not q.sample().requires_grad and q.rsample().requires_grad
    assert bool((torch.get_rng_state() == state).all()), "no number of the global generator may be used"
    assert q.expand((2, 3, 4)).rsample().shape == (2, 3, 4)
    p = Normal(torch.zeros(4), torch.ones(4))
    torch.testing.assert_close(kl_divergence(q, p), kl_divergence(Normal(loc, scale.expand(3, 4)), p))
    torch.testing.assert_close(q.log_prob(noise), Normal(loc, scale).log_prob(noise))
    with pytest.raises(InputError, match="noise for one sample"):
        q.rsample((2,))
    free = NoisyNormal(torch.tensor(1.0), torch.tensor(2.0))
    assert_mean(free.expand((2,)).rsample((10_000,)), torch.tensor([1.0, 1.0]))
