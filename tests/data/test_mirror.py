"""Mirrored scenes against points projected by both cameras, and the supply's mirrored latents against encoding anew."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.mirror import mirror, mirror_voxels
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.camera import project
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.geometry.voxels import pack_voxels, unpack_voxels
from nolbo_ppl.training.scene_loader import SceneLoader, ShapeTable
from tests.factories import random_batch, tiny_config, tiny_model


def pixels_of(batch, points: torch.Tensor) -> torch.Tensor:
    """Where points of the objects' frames (units of the diagonal) are seen, from viewpoints and positions alone."""
    R_camera_object = allocentric_to_egocentric(viewpoint_to_matrix(batch.viewpoint), batch.position)
    place = torch.einsum("bmij,bmpj->bmpi", R_camera_object, points) * batch.diagonal[..., None, None]
    place = place + batch.position[..., None, :]
    return project(place, batch.intrinsics[:, None, None].expand(*place.shape[:-1], 4))


def test_a_mirrored_scene_shows_mirrored_points() -> None:
    batch = random_batch(tiny_config(), scenes=6, slots=3, seed=4)
    chosen = torch.tensor([True, False, True, True, False, True])
    mirrored = mirror(batch, chosen)
    points = 0.5 * torch.randn(6, 3, 20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    before = pixels_of(batch, points)
    after = pixels_of(mirrored, torch.where(chosen[:, None, None, None], points * torch.tensor([-1.0, 1, 1]).double(), points))
    width = batch.image.shape[-1]
    expected = torch.where(chosen[:, None, None, None], torch.tensor([width, 0]) + before * torch.tensor([-1, 1]), before)
    torch.testing.assert_close(after, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(mirrored.image[0], batch.image[0].flip(-1))
    torch.testing.assert_close(mirrored.image[1], batch.image[1])
    size = mirrored.box[..., 2:] - mirrored.box[..., :2]
    torch.testing.assert_close(size, batch.box[..., 2:] - batch.box[..., :2])
    assert bool((mirrored.instance[chosen] == -1).all())


def test_a_box_keeps_what_it_frames() -> None:
    batch = random_batch(tiny_config(), scenes=1, slots=1, seed=2)
    x0, y0, x1, y1 = (round(float(v)) for v in batch.box[0, 0])
    painted = torch.zeros_like(batch.image)
    painted[0, :, max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 255
    mirrored = mirror(batch.replace(image=painted, box=torch.tensor([[[x0, y0, x1, y1]]]).double()), torch.tensor([True]))
    columns = torch.nonzero(mirrored.image[0, 0].amax(0))[:, 0]
    left, right = (float(v) for v in mirrored.box[0, 0, [0, 2]])
    assert columns.min() == max(left, 0) and columns.max() + 1 == min(right, painted.shape[-1])


def test_voxels_are_reflected_along_x() -> None:
    rng = np.random.default_rng(0)
    voxels = rng.random((3, 32, 32, 32)) < 0.3
    mirrored = mirror_voxels(torch.from_numpy(pack_voxels(voxels))).numpy()
    np.testing.assert_array_equal(unpack_voxels(mirrored, 32), voxels[:, ::-1])
    with pytest.raises(InputError, match="packed voxels to mirror: got 5 bytes"):
        mirror_voxels(torch.zeros(2, 5, dtype=torch.uint8))


class _Folder:
    """Six scenes as a data set."""

    def __init__(self, batch) -> None:
        self.arrays = {
            name: value.numpy()
            for name in batch.__dataclass_fields__
            if (value := getattr(batch, name)) is not None and not name.startswith(("shape_", "noise"))
        }

    def __len__(self) -> int:
        return 6

    def batch(self, indices):
        return {name: value[np.asarray(indices)] for name, value in self.arrays.items()}


def test_the_supply_mirrors_half_the_scenes_with_their_latents() -> None:
    config = tiny_config()
    batch = random_batch(config, scenes=6, slots=2, seed=3)
    batch = batch.replace(instance=torch.arange(12).reshape(6, 2))
    model = tiny_model(config)
    table = ShapeTable(np.arange(12), batch.voxels.flatten(0, 1).numpy(), batch.category.flatten().numpy())
    table.encode_shapes(model, mirrored=True)
    still = Augmentation(
        geometric_probability=0.0,
        mirror_probability=0.5,
        brightness=0.0,
        contrast=(1.0, 1.0),
        saturation=(1.0, 1.0),
        hue=0.0,
        blur_probability=0.0,
        noise_probability=0.0,
        inversion_probability=0.0,
    )
    supply = SceneLoader(_Folder(batch), table, 6, 0, config.latent_dim, still)
    mirrored = plain = 0
    for step in range(4):
        found = supply.batch(step)
        loc, scale = model.shape_guide.posterior(found.voxels.flatten(0, 1))
        torch.testing.assert_close(found.shape_loc.flatten(0, 1), loc.detach())
        torch.testing.assert_close(found.shape_scale.flatten(0, 1), scale.detach())
        for image in found.image:
            flipped = any(torch.allclose(image.double(), one.double().flip(-1)) for one in batch.image)
            mirrored += flipped
            plain += not flipped
    assert mirrored > 4 and plain > 4
    table.encode_shapes(model)
    with pytest.raises(InputError, match="latents of mirrored shapes"):
        supply.batch(0)
