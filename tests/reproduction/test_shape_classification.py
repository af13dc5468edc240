"""Training the shape autoencoder on an archive of shapes, and classifying with it."""

from __future__ import annotations

from dataclasses import replace
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
from nolbo_ppl.reproduction.shape_classification import ShapeVaeConfig, augmented, fit_shape_vae, score_shapes
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


def test_augmented_shapes() -> None:
    """Nothing is lost, up stays up, and each of the four mirror images comes."""
    voxels = torch.zeros(200, 32, 32, 32, dtype=torch.bool)
    voxels[:, 10, 12, 5] = True
    out = augmented(voxels, 1, torch.Generator().manual_seed(0))
    assert (out.flatten(1).sum(1) == 1).all()
    place = out.nonzero()[:, 1:]
    assert set(place[:, 2].tolist()) == {4, 5, 6}
    near = {(x, y) for x in (10, 21) for y in (12, 19)}
    seen = {min(near, key=lambda c: abs(c[0] - x) + abs(c[1] - y)) for x, y, _ in place.tolist()}
    assert seen == near
    assert torch.equal(augmented(voxels, 1, torch.Generator().manual_seed(0)), out)


def test_two_kinds_of_shapes_are_told_apart(tmp_path: Path) -> None:
    config = ShapeVaeConfig(steps=16, batch=8, decode=2, shift=0, half_precision=False)
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
    config = ShapeVaeConfig(steps=4, batch=4, decode=2, half_precision=False, checkpoint_every=1)
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
