"""Angles have no ends: samplers and autoguides pass +-pi as any other angle."""

from __future__ import annotations

import math

import pyro
import pytest
import torch
from pyro.infer import MCMC, NUTS, SVI, Trace_ELBO
from pyro.infer.autoguide import AutoNormal
from pyro.optim import Adam
from torch import Tensor
from torch.distributions import biject_to, transform_to

from nolbo_ppl.models.distributions import ViewpointNormal, VonMisesMixture, WrappedNormal, circular

REPLICAS = 8


def wrapped() -> WrappedNormal:
    return WrappedNormal(torch.tensor(3.14), torch.tensor(0.3))


def straddling() -> VonMisesMixture:
    """Two components on either side of the seam, and a limit nowhere: HMC needs the function's own gradient."""
    return VonMisesMixture.from_mean_concentration(torch.zeros(2), torch.tensor([2.8, -2.7]), torch.tensor([12.0, 9.0]))


@pytest.mark.parametrize("make", [wrapped, straddling])
def test_nuts_crosses_the_seam(make) -> None:
    """Share above zero and trigonometric moments within 5 standard errors (of as many draws as are worth independent)."""
    p = make()

    def model() -> None:
        with pyro.plate("replicas", REPLICAS):
            pyro.sample("angle", p.expand((REPLICAS,)))

    pyro.set_rng_seed(1)
    chain = MCMC(NUTS(model, max_tree_depth=4), num_samples=80, warmup_steps=40, disable_progbar=True)
    chain.run()
    x = chain.get_samples()["angle"]
    assert x.shape == (80, REPLICAS)
    assert bool(((x >= -math.pi) & (x < math.pi)).all())
    grid = torch.arange(20_000) * (2 * math.pi / 20_000) - math.pi
    density = p.log_prob(grid).exp() * (2 * math.pi / 20_000)
    # columns are independent chains' coordinates: their spread is the standard error, autocorrelation included
    for statistic in (lambda v: (v > 0).double(), torch.cos, torch.sin):
        expected = float((density * statistic(grid)).sum())
        mean = statistic(x).mean(0)
        error = max(float(mean.std()), 0.5 * float(statistic(x).std()) / math.sqrt(80)) / math.sqrt(REPLICAS)
        assert abs(float(mean.mean()) - expected) < 5 * error
    if make is wrapped:
        assert abs(float((x > 0).double().mean()) - 0.498) < 0.1


def test_autoguide_at_the_seam() -> None:
    """The normal of an autoguide lies across +-pi and has the angle's own scale."""

    def model() -> None:
        pyro.sample("angle", WrappedNormal(torch.tensor(3.14), torch.tensor(0.3)))

    pyro.clear_param_store()
    pyro.set_rng_seed(0)
    guide = AutoNormal(model, init_scale=0.1)
    svi = SVI(model, guide, Adam({"lr": 0.05}), Trace_ELBO(num_particles=8, vectorize_particles=True, max_plate_nesting=0))
    for _ in range(150):
        svi.step()
    loc, scale = guide.locs.angle.detach(), guide.scales.angle.detach()
    assert abs(float(torch.remainder(loc - 3.14 + math.pi, 2 * math.pi) - math.pi)) < 0.1
    assert float(scale) == pytest.approx(0.3, rel=0.2)
    pyro.clear_param_store()


def test_the_covering_map() -> None:
    for registry in (biject_to, transform_to):
        wrap = registry(circular)
        x = torch.tensor([-7.0, -math.pi, 0.2, 3.5, 9.5], requires_grad=True)
        y = wrap(x)
        assert bool(circular.check(y).all())
        torch.testing.assert_close(torch.stack((y.cos(), y.sin())), torch.stack((x.cos(), x.sin())))
        (slope,) = torch.autograd.grad(y.sum(), x)
        assert bool((slope == 1).all()) and bool((wrap.log_abs_det_jacobian(x, y) == 0).all())
        assert torch.equal(wrap.inv(y), y)
    viewpoint = biject_to(ViewpointNormal(torch.zeros(2, 3), 0.1).support)
    value: Tensor = viewpoint(torch.full((2, 3), 4.0))
    assert viewpoint.log_abs_det_jacobian(torch.full((2, 3), 4.0), value).shape == (2,)
    torch.testing.assert_close(value, torch.full((2, 3), 4.0 - 2 * math.pi))
    assert not bool(circular.check(torch.tensor(4.0)))
