"""Training the shape autoencoder on an archive of shapes, and classifying with it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from nolbo_ppl.data.voxel_archive import VoxelArchive
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import SceneELBO
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.models.scene_batch import pack_bits
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.reproduction.shape_classification import (
    ShapeVaeConfig,
    augmented,
    balanced_rows,
    fit_shape_vae,
    score_shapes,
)
from tests.factories import random_batch, tiny_config, tiny_model


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> None:
    torch.set_default_dtype(torch.float32)


def posts_and_slabs(count: int) -> VoxelArchive:
    """Upright posts and flat slabs of random sizes."""
    rng = np.random.default_rng(0)
    voxels = np.zeros((count, 32, 32, 32), dtype=bool)
    for k in range(count):
        a, b, c = rng.integers(2, 5), rng.integers(2, 5), rng.integers(9, 14)
        half = (a, b, c) if k % 2 else (c, c, a)
        voxels[k][tuple(slice(16 - h, 16 + h) for h in half)] = True
    return VoxelArchive(voxels, np.arange(count) % 2, ("slab", "post"))


def chairs(count: int) -> torch.Tensor:
    """Seats with a back at one end of the second axis and an arm on one side, of random sizes, in the middle of the grid."""
    rng = np.random.default_rng(0)
    voxels = torch.zeros(count, 32, 32, 32, dtype=torch.bool)
    for shape in voxels:
        width, depth, height = (int(k) for k in rng.integers(6, 13, 3))
        box = shape[16 - width : 16 + width, 16 - depth : 16 + depth, 16 - height : 16 + height]
        box[:, :, :4] = True
        box[:, :3] = True
        box[:2, :, :9] = True
    return voxels


def sides(voxels: torch.Tensor) -> torch.Tensor:
    """Extents along the three axes."""
    return torch.stack([voxels.any(b + 1).any(a + 1).sum(1) for a, b in ((1, 2), (0, 2), (0, 1))], 1)


def test_augmented_shapes() -> None:
    """Nothing is lost, up stays up, the back stays at the back, the arm is on either side."""
    voxels = chairs(200)
    out = augmented(voxels, torch.Generator().manual_seed(0))
    flipped = (out == voxels.flip(1)).flatten(1).all(1)
    assert (flipped | (out == voxels).flatten(1).all(1)).all()
    assert abs(float(flipped.float().mean()) - 0.5) < 5 * (0.25 / 200) ** 0.5
    assert torch.equal(augmented(voxels, torch.Generator().manual_seed(0)), out)
    assert torch.equal(augmented(voxels, torch.Generator().manual_seed(0), mirror=False), voxels)


def test_stretched_shapes_keep_class_and_volume() -> None:
    """The longest side stays, others change by the stated factors at most, and volume with them; so do all proportions."""
    voxels = chairs(100)
    out = augmented(voxels, torch.Generator().manual_seed(1), mirror=False, stretch=0.2)
    before, after = sides(voxels), sides(out)
    assert (after.amax(1) - before.amax(1)).abs().max() <= 1
    ratio = after / before
    assert (ratio < 1.2**2 * 1.1).all() and (ratio > 1.2**-2 / 1.1).all()
    assert float(ratio.std()) > 0.05
    volume = out.flatten(1).sum(1) / voxels.flatten(1).sum(1)
    assert (volume / ratio.prod(1)).sub(1).abs().max() < 0.35 and abs(float(volume.mean()) - 1) < 0.2
    assert torch.equal(out.flatten(1).sum(1) > 0, torch.ones(100, dtype=torch.bool))
    # back and seat lie where they lay
    assert (out.float().mean((1, 3)).argmax(1) < 16).all() and (out.float().mean((1, 2)).argmax(1) < 16).all()


def test_moved_shapes() -> None:
    """One voxel along every axis at most, each of the 27 places, and nothing is lost."""
    voxels = torch.zeros(400, 32, 32, 32, dtype=torch.bool)
    voxels[:, 10, 12, 5] = True
    out = augmented(voxels, torch.Generator().manual_seed(0), mirror=False, shift=1)
    place = out.nonzero()
    assert torch.equal(place[:, 0], torch.arange(400))
    assert {tuple(row) for row in (place[:, 1:] - torch.tensor([10, 12, 5])).tolist()} == set(product((-1, 0, 1), repeat=3))


@pytest.mark.parametrize(("balance", "power"), [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])
def test_balanced_batches(balance: float, power: float) -> None:
    """Classes of 1800 and 200 shapes come in proportion to n^(1 - balance); no shape comes twice."""
    category = (torch.arange(2000) >= 1800).long()
    generator = torch.Generator().manual_seed(0)
    rows = [balanced_rows(category, 8, balance, generator) for _ in range(500)]
    assert all(len(set(row.tolist())) == 8 for row in rows)
    share = float(category[torch.cat(rows)].float().mean())
    expected = 200**power / (200**power + 1800**power)
    assert abs(share - expected) < 5 * (expected * (1 - expected) / 4000) ** 0.5
    with pytest.raises(InputError, match="shapes of a batch"):
        balanced_rows(category[:3], 4, balance, generator)


def test_two_kinds_of_shapes_are_told_apart(tmp_path: Path) -> None:
    config = ShapeVaeConfig(steps=16, batch=8, decode=2)
    archive = posts_and_slabs(24)
    losses: list[float] = []
    model = fit_shape_vae(archive, config, tmp_path / "a.safetensors", lambda info: losses.append(info.loss))
    scores = score_shapes(model, archive, batch=7)
    assert (scores.predicted == scores.category).mean() == 1.0
    assert losses[-1] < 0.5 * losses[0]
    loc, _ = model.shape_guide.posterior(pack_bits(torch.from_numpy(archive.voxels)))
    mean = model.story.prior.label_mean()
    np.testing.assert_array_equal(scores.predicted, torch.cdist(loc, mean).argmin(1).numpy())
    decoded = torch.sigmoid(model.story.decoder(loc)).numpy()
    np.testing.assert_allclose(scores.iou, voxel_iou(decoded, archive.voxels), atol=1e-6)


def test_a_killed_fit_goes_on_bit_for_bit(tmp_path: Path) -> None:
    config = ShapeVaeConfig(steps=4, batch=4, decode=2, shift=1, checkpoint_every=1)
    archive = posts_and_slabs(6)
    whole = fit_shape_vae(archive, config)

    class Killed(Exception):
        pass

    def kill(info: object) -> None:
        if info.step == 2:  # type: ignore[attr-defined]
            raise Killed

    file = tmp_path / "a.safetensors"
    with pytest.raises(Killed):
        fit_shape_vae(archive, config, file, kill)
    resumed = fit_shape_vae(archive, config, file)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    with pytest.raises(InputError, match="another configuration"):
        fit_shape_vae(archive, replace(config, seed=1), file)
    with pytest.raises(InputError, match="no shapes"):
        fit_shape_vae(archive.select(np.zeros(0, int)), config)


def test_decoded_shapes_stand_for_all() -> None:
    """Of copies of one shape, a few decoded give the voxel term of all."""
    torch.set_default_dtype(torch.float64)
    model = tiny_model().eval()
    scene = random_batch(tiny_config(), 1, 2)
    assert scene.noise is not None
    batch = ShapeBatch(*(part[0, :1].repeat(6, *(1,) * (part.dim() - 2)) for part in
                         (scene.voxels, scene.category, scene.instance, scene.noise)))  # fmt: skip
    terms = [
        SceneELBO().terms(model.shape_model, model.shape_guide, batch, names={"voxels", "shape_kl"}, decode=decode)
        for decode in (None, 2)
    ]
    torch.testing.assert_close(terms[0]["voxels"], terms[1]["voxels"])
    torch.testing.assert_close(terms[0]["shape_kl"], terms[1]["shape_kl"])
