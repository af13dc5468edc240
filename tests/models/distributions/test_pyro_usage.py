"""Every distribution as a site: plates, masks, event dimensions, expansion, shapes, validation."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine

from nolbo_ppl.models.distributions import (
    MatrixFisher,
    NoisyNormal,
    Objectness,
    SinCosNormal,
    SymmetricMatrixFisher,
    ViewpointMixture,
    ViewpointNormal,
    ViewpointSinCos,
    VonMisesMixture,
    WrappedNormal,
)

BATCH = (3, 2)


def rotation() -> torch.Tensor:
    return torch.eye(3).expand(*BATCH, 3, 3)


MAKE = {
    "WrappedNormal": lambda: WrappedNormal(torch.randn(BATCH), torch.tensor(0.3)),
    "SinCosNormal": lambda: SinCosNormal(torch.randn(BATCH), torch.tensor(0.3)),
    "VonMisesMixture": lambda: VonMisesMixture(torch.randn(*BATCH, 4), 5 * torch.randn(4, 2)),
    "MatrixFisher": lambda: MatrixFisher(rotation(), 20.0),
    "SymmetricMatrixFisher": lambda: SymmetricMatrixFisher(rotation(), 20.0, torch.tensor([0, 2])),
    "ViewpointNormal": lambda: ViewpointNormal(torch.randn(*BATCH, 3), torch.tensor(0.1)),
    "ViewpointNormalSymmetric": lambda: ViewpointNormal(torch.randn(3), torch.tensor(0.1), torch.ones(BATCH, dtype=int)),
    "ViewpointMixture": lambda: ViewpointMixture(
        torch.randn(*BATCH, 4), torch.randn(*BATCH, 4, 2), torch.randn(2), torch.full((2,), 0.2)
    ),
    "ViewpointSinCos": lambda: ViewpointSinCos(torch.randn(*BATCH, 3), torch.tensor(0.1)),
    "NoisyNormal": lambda: NoisyNormal(torch.randn(BATCH), torch.ones(BATCH), torch.randn(BATCH)),
    "Objectness": lambda: Objectness(logits=torch.randn(BATCH)),
}


@pytest.fixture(params=MAKE)
def distribution(request) -> dist.TorchDistribution:
    return MAKE[request.param]()


def test_shapes_support_and_expansion(distribution) -> None:
    d = distribution
    assert d.batch_shape == BATCH
    value = d.sample()
    assert value.shape == BATCH + d.event_shape
    assert bool(d.support.check(value).all())
    assert d.log_prob(value).shape == BATCH
    if not isinstance(d, NoisyNormal):
        many = d.sample((5,))
        assert many.shape == (5, *BATCH, *d.event_shape)
        assert d.log_prob(many).shape == (5, *BATCH)
        torch.testing.assert_close(d.log_prob(many)[2], d.log_prob(many[2]))
    larger = d.expand((4, *BATCH))
    assert type(larger) is type(d)
    assert larger.batch_shape == (4, *BATCH) and larger.event_shape == d.event_shape
    torch.testing.assert_close(larger.log_prob(value), d.log_prob(value).expand(4, *BATCH))
    assert larger.sample().shape == (4, *BATCH, *d.event_shape)
    assert larger.expand((7, 4, *BATCH)).batch_shape == (7, 4, *BATCH)


def test_sites_in_plates_with_masks(distribution) -> None:
    d = distribution
    mask = torch.tensor([[True, False], [False, True], [True, True]])

    def model(fn: dist.TorchDistribution, dims: int) -> None:
        with pyro.plate("scenes", 3, dim=-2 + dims), pyro.plate("regions", 2, dim=-1 + dims), poutine.mask(mask=mask):
            pyro.sample("z", fn)

    trace = poutine.trace(model).get_trace(d, 0)
    trace.compute_log_prob()
    site = trace.nodes["z"]
    expected = d.log_prob(site["value"])
    torch.testing.assert_close(site["log_prob"], torch.where(mask, expected, 0.0))
    trace.format_shapes()
    # The same as one event, which the mask then covers as a whole.
    whole = d.to_event(2)
    torch.testing.assert_close(whole.log_prob(site["value"]), expected.sum())
    masked = d.mask(mask)
    torch.testing.assert_close(masked.log_prob(site["value"]), torch.where(mask, expected, 0.0))
    assert masked.expand((4, *BATCH)).log_prob(site["value"]).shape == (4, *BATCH)


def test_plate_expands_a_site(distribution) -> None:
    d = distribution
    with pyro.plate("draws", 4, dim=-3), poutine.trace() as tracer:
        value = pyro.sample("z", d)
    assert value.shape == (4, *BATCH, *d.event_shape)
    assert tracer.trace.nodes["z"]["fn"].log_prob(value).shape == (4, *BATCH)


def test_rsample_is_differentiable_where_promised(distribution) -> None:
    d = distribution
    assert d.has_rsample == (type(d) not in (VonMisesMixture, ViewpointMixture, Objectness))
    if isinstance(d, MatrixFisher | SymmetricMatrixFisher):
        parameter = torch.tensor(5.0, requires_grad=True)
        args = (parameter, d.order) if isinstance(d, SymmetricMatrixFisher) else (parameter,)
        sample = type(d)(d.R_mode, *args).rsample()
    elif d.has_rsample:
        parameter = torch.zeros_like(d.loc).requires_grad_()
        sample = type(d)(parameter, d.scale).rsample()
    else:
        return
    (grad,) = torch.autograd.grad(sample.sum(), parameter)
    assert bool(torch.isfinite(grad).all()) and bool((grad != 0).any())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WrappedNormal(torch.zeros(2), torch.tensor([0.1, 0.0])), "scale"),
        (lambda: WrappedNormal(torch.tensor(float("nan")), torch.tensor(0.1)), "loc"),
        (lambda: SinCosNormal(torch.zeros(2), torch.tensor(-1.0)), "scale"),
        (lambda: VonMisesMixture(torch.tensor([float("nan"), 0.0]), torch.zeros(2, 2)), "logits"),
        (lambda: VonMisesMixture(torch.zeros(2), torch.full((2, 2), float("nan"))), "natural"),
        (lambda: ViewpointNormal(torch.zeros(3), torch.tensor(0.0)), "scale"),
        (lambda: ViewpointMixture(torch.zeros(2), torch.zeros(2, 2), torch.zeros(2), torch.zeros(2)), "scale"),
        (lambda: ViewpointSinCos(torch.zeros(3), torch.tensor(-0.1)), "scale"),
        (lambda: MatrixFisher(2 * torch.eye(3), 1.0), "R_mode"),
        (lambda: SymmetricMatrixFisher(torch.eye(3), -1.0, 1), "concentration"),
        (lambda: NoisyNormal(torch.zeros(2), torch.tensor(-1.0)), "scale"),
        (lambda: WrappedNormal(torch.zeros(2), 0.1).log_prob(torch.tensor(4.0)), "support"),
        (lambda: VonMisesMixture(torch.zeros(1), torch.ones(1, 2)).log_prob(torch.tensor(-4.0)), "support"),
        (lambda: ViewpointNormal(torch.zeros(3), 0.1).log_prob(torch.tensor([0.0, 7.0, 0.0])), "support"),
    ],
)
def test_invalid_parameters_and_values_raise(make, message) -> None:
    with pytest.raises(ValueError, match=message):
        make()
