"""Stochastic variational inference reaches a posterior that is known."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor, nn

from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import (
    PURE_BOUND,
    ElboResult,
    SceneELBO,
)
from nolbo_ppl.models.generative import conjugate_target, expected_normal_log_prob
from tests.factories import (
    assert_within,
)


class LinearStory(nn.Module):
    """z ~ N(0, I), y ~ N(A z + b, scale^2 I), under the names of the box."""

    def __init__(self, y: Tensor, matrix: Tensor, shift: Tensor, scale: float, closed_form: bool) -> None:
        super().__init__()
        self.y, self.matrix, self.shift, self.scale, self.closed_form = y, matrix, shift, scale, closed_form

    def expected(self, q: dist.TorchDistribution) -> Tensor:
        """E_q[log N(y; A z + b, scale^2 I)]."""
        mean = (self.matrix @ q.mean[..., None])[..., 0] + self.shift
        spread = torch.diagonal(self.matrix @ q.covariance_matrix @ self.matrix.mT, dim1=-2, dim2=-1)
        return expected_normal_log_prob(mean, spread, self.y, self.scale)

    def forward(self, scene: object, decode: int | None = None) -> None:
        with pyro.plate("scenes", len(self.y), dim=-1):
            prior = dist.MultivariateNormal(torch.zeros(2), torch.eye(2))
            z = pyro.sample("box_latent", prior)
            mean = (self.matrix @ z[..., None])[..., 0] + self.shift
            infer = {"expected_log_prob": ("box_latent", self.expected)} if self.closed_form else {}
            pyro.sample("box", dist.Normal(mean, self.scale).to_event(1), obs=self.y, infer=infer)


class LinearGuide(nn.Module):
    """An amortised full-covariance Gaussian: mean W y + c."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(2, 3))
        self.bias = nn.Parameter(torch.zeros(2))
        self.raw = nn.Parameter(torch.zeros(2, 2))

    def cholesky(self) -> Tensor:
        return torch.tril(self.raw, -1) + torch.diag_embed(torch.exp(self.raw.diagonal()))

    def forward(self, y: Tensor) -> None:
        loc = y @ self.weight.T + self.bias
        with pyro.plate("scenes", len(y), dim=-1):
            pyro.sample("box_latent", dist.MultivariateNormal(loc, scale_tril=self.cholesky().expand(len(y), 2, 2)))


@pytest.mark.parametrize(("closed_form", "steps", "tolerance"), [(True, 300, 2e-3), (False, 300, 0.08)])
def test_svi_reaches_the_exact_posterior(closed_form: bool, steps: int, tolerance: float) -> None:
    """Linear and Gaussian: SVI finds the posterior and its bound is the log evidence."""
    generator = torch.Generator().manual_seed(0)
    matrix, shift, scale = torch.randn(3, 2, generator=generator), torch.tensor([0.5, -1.0, 0.2]), 0.7
    y = torch.randn(30, 3, generator=generator) * 1.5
    story, guide = LinearStory(y, matrix, shift, scale, closed_form), LinearGuide()
    elbo = SceneELBO(PURE_BOUND)

    def loss() -> ElboResult:
        return elbo.evaluate(story, guide, y, scenes=len(y))

    config = optimisation.OptimizerConfig(
        steps=steps, learning_rate=0.05, start_rate=0.05, warmup=1, decay=0.9, weight_decay=0.0, ema=0.0
    )
    state = optimisation.init(guide, loss, config)
    for _ in range(steps):
        state, info = optimisation.step(state)
    assert set(info.terms) == {"box", "box_kl"}
    precision = torch.eye(2) + matrix.T @ matrix / scale**2
    covariance = torch.linalg.inv(precision)
    gain = covariance @ matrix.T / scale**2
    torch.testing.assert_close(guide.weight.detach(), gain, atol=tolerance, rtol=0)
    torch.testing.assert_close(guide.bias.detach(), -gain @ shift, atol=tolerance, rtol=0)
    torch.testing.assert_close((guide.cholesky() @ guide.cholesky().T).detach(), covariance, atol=tolerance, rtol=0)
    evidence = dist.MultivariateNormal(shift, matrix @ matrix.T + scale**2 * torch.eye(3)).log_prob(y).mean()
    with torch.no_grad():
        bound = -torch.stack([loss().loss for _ in range(1 if closed_form else 200)])
    if closed_form:
        assert float(bound[0]) == pytest.approx(float(evidence), abs=1e-4)
    else:
        assert_within(bound, evidence, slack=0.01)
    # a guide that is not the posterior stays below the evidence by KL(q || posterior)
    with torch.no_grad():
        guide.bias.add_(0.3)
        loc = y @ guide.weight.T + guide.bias
        story.closed_form = True
        q = dist.MultivariateNormal(loc, scale_tril=guide.cholesky().expand(30, 2, 2))
        exact = dist.MultivariateNormal((y - shift) @ gain.T, covariance)
        gap = torch.distributions.kl_divergence(q, exact).mean()
        assert float(loss().loss) == pytest.approx(float(gap - evidence), abs=1e-9)


def test_conjugate_truth_and_expectation() -> None:
    """p(z | y) by Bayes on a grid, and the expected log likelihood by quadrature."""
    y, scale = torch.tensor([0.8]), 0.6
    grid = torch.linspace(-9, 9, 20001)
    log_joint = dist.Normal(0.0, 1.0).log_prob(grid) + dist.Normal(grid, scale).log_prob(y)
    density = torch.exp(log_joint - torch.logsumexp(log_joint, 0)) / (grid[1] - grid[0])
    truth = conjugate_target(y, scale)
    torch.testing.assert_close(truth.log_prob(grid[:, None]).exp(), density, atol=1e-9, rtol=0)
    q = dist.Normal(torch.tensor(0.3), 0.4)
    by_grid = torch.trapezoid(q.log_prob(grid).exp() * dist.Normal(grid, scale).log_prob(y), grid)
    found = expected_normal_log_prob(torch.tensor([0.3]), torch.tensor([0.16]), y, scale)
    assert float(found) == pytest.approx(float(by_grid), abs=1e-9)
