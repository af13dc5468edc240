"""Prior networks, decoder, voxel encoder, limits of scales, and the shape autoencoder's bound."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from nolbo_ppl.inference.elbo import PURE_BOUND, SceneELBO
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.scene_batch import unpack_bits
from nolbo_ppl.models.shape_networks import PatchReader, PatchWriter, PriorNetwork, VoxelDecoder, VoxelEncoder, bounded_exp
from nolbo_ppl.models.shape_vae import ShapeBatch
from tests.factories import instance_config, random_batch, tiny_config, tiny_model


def test_bounded_exp() -> None:
    assert float(bounded_exp(torch.tensor(0.0), -4.0, 2.0)) == pytest.approx(1.0, rel=1e-14)
    raw = torch.linspace(-200, 200, 2001)
    value = bounded_exp(raw, -4.0, 2.0)
    assert bool((value.diff() >= 0).all())
    assert bool(((value >= math.exp(-4)) & (value <= math.exp(2))).all())
    assert float(value[0]) == pytest.approx(math.exp(-4))
    assert float(value[-1]) == pytest.approx(math.exp(2))
    near = torch.tensor(0.0, requires_grad=True)
    bounded_exp(near, -5.0, 3.0).backward()
    assert 0.5 < float(near.grad) < 1


def test_prior_network_is_the_layers_on_one_hot_labels() -> None:
    network = PriorNetwork(5, 3, 7)
    first, _, last = network.layers
    for label in range(5):
        hidden = torch.nn.functional.elu(first.weight[:, label] + first.bias)
        torch.testing.assert_close(network()[label], last.weight @ hidden + last.bias)


def test_instance_prior() -> None:
    """p(i | l) is uniform over a category's own instances and "novel"; the means of the latter are zero."""
    prior = LabelPrior(instance_config()).double()
    p = prior.instance_log_probability(torch.tensor([[0, 1], [2, 3]])).exp()
    expected = torch.tensor([[[0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1]], [[0, 1, 1, 1, 0, 1], [0, 0, 0, 0, 1, 1]]]).double()
    torch.testing.assert_close(p, expected / expected.sum(-1, keepdim=True))
    mean = prior.instance_mean()
    assert mean.shape == (6, 2)
    assert bool((mean[-1] == 0).all())
    assert prior.label_mean().shape == (4, 4)
    torch.testing.assert_close(prior.label_mean()[:, :2], prior.category_mean())
    assert bool((prior.label_mean()[:, 2:] == 0).all())


def test_priors_start_far_apart() -> None:
    distance = torch.stack(
        [torch.pdist(LabelPrior(tiny_config(latent_dim=16, prior_width=64)).category_mean()).min() for _ in range(20)]
    )
    assert float(distance.detach().median()) > 2


def test_decoder_doubles_a_dense_grid() -> None:
    decoder = VoxelDecoder(tiny_config()).eval()
    out = decoder(torch.randn(3, 4))
    assert out.shape == (3, 32, 32, 32)
    assert float(out.detach().std()) > 0


def test_patches_are_convolutions() -> None:
    """The matrix products write and read the same voxels as strided convolutions with the same weights."""
    generator = torch.Generator().manual_seed(0)
    writer = PatchWriter(5)
    x = torch.randn(2, 5, 3, 3, 3, generator=generator)
    kernel = writer.linear.weight.T.unflatten(-1, (1, 2, 2, 2))
    expected = torch.nn.functional.conv_transpose3d(x, kernel, stride=2)
    bias = writer.linear.bias.unflatten(0, (2, 2, 2)).repeat(3, 3, 3)
    torch.testing.assert_close(writer(x), expected + bias)
    reader = PatchReader(3, 4)
    voxels = torch.randn(2, 1, 12, 12, 12, generator=generator)
    first, activation, last = reader.layers
    hidden = torch.nn.functional.conv3d(voxels, first.weight.unflatten(-1, (1, 4, 4, 4)), first.bias, stride=4)
    expected = torch.nn.functional.conv3d(activation(hidden), last.weight[..., None, None, None], last.bias)
    torch.testing.assert_close(reader(voxels), expected)


def test_voxel_encoder_sees_axes_in_order() -> None:
    """Scales are limited, and transposing the voxels changes the answer."""
    encoder = VoxelEncoder(tiny_config()).eval()
    voxels = (torch.rand(2, 32, 32, 32) < 0.3).double()
    loc, scale = encoder(voxels)
    assert loc.shape == scale.shape == (2, 4)
    assert bool(((scale > math.exp(-6)) & (scale < math.exp(2))).all())
    assert not torch.allclose(encoder(voxels.transpose(1, 3))[0], loc)


@pytest.mark.parametrize("instances", [False, True])
def test_bound_of_the_shape_autoencoder(instances: bool) -> None:
    """KL to the labels' Gaussians and the log likelihood of the voxels, both by hand."""
    config = instance_config() if instances else tiny_config()
    model = tiny_model(config).eval()
    scene = random_batch(config, 1, 4, seed=3)
    category, instance = torch.tensor([2, 2, 1, 0]), torch.tensor([1, -1, 0, -1])
    batch = ShapeBatch(scene.voxels[0], category, instance, scene.noise[0])
    with torch.no_grad():
        result = SceneELBO(PURE_BOUND).evaluate(model.shape_model, model.shape_guide, batch, scenes=4)
        loc, scale = model.shape_guide.posterior(batch.voxels)
        mean = model.story.prior.category_mean()[category]
        if instances:
            own = torch.stack([model.story.prior.instance()[i] if i >= 0 else torch.zeros(2) for i in instance])
            mean = torch.cat((mean, own), -1)
        kl = kl_divergence(Normal(loc, scale), Normal(mean, 1.0)).sum()
        p = torch.sigmoid(model.story.decoder(loc + scale * scene.noise[0]))
    truth = unpack_bits(batch.voxels, 32)
    log_likelihood = torch.where(truth, p, 1 - p).log().sum()
    assert set(result.terms) == {"shape_kl", "voxels"}
    torch.testing.assert_close(result.terms["shape_kl"], -kl)
    torch.testing.assert_close(result.terms["voxels"], log_likelihood)
    torch.testing.assert_close(result.loss, (kl - log_likelihood) / 4)
