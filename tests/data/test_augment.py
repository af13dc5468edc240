"""Augmentation: geometry against projected points and painted pixels, colour limits, one seed a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nolbo_ppl.data.augment import Augmentation, augment
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.camera import project
from nolbo_ppl.models.scene_batch import SceneBatch

STILL = Augmentation(
    geometric_probability=0.0,
    brightness=0.0,
    contrast=(1.0, 1.0),
    saturation=(1.0, 1.0),
    hue=0.0,
    inversion_probability=0.0,
    blur_probability=0.0,
    noise_probability=0.0,
)
MOVING = replace(STILL, geometric_probability=1.0)


def make_batch(b: int = 6, m: int = 3, size: int = 64, seed: int = 0) -> SceneBatch:
    """Scenes with objects whose box is centred on the projection of their position."""
    rng = np.random.default_rng(seed)
    intrinsics = np.tile([80.0, 84.0, 33.0, 31.0], (b, 1))
    centre = rng.uniform(14, 50, (b, m, 2))
    half = rng.uniform(4, 12, (b, m, 2))
    depth = rng.uniform(2, 9, (b, m, 1))
    slope = (centre - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]
    position = np.concatenate((slope, np.ones_like(depth)), axis=-1) * depth
    present = rng.random((b, m)) < 0.8
    fields = {
        "image": torch.from_numpy(rng.integers(0, 256, (b, 3, size, size), dtype=np.uint8)),
        "intrinsics": torch.from_numpy(intrinsics),
        "present": torch.from_numpy(present),
        "box": torch.from_numpy(np.concatenate((centre - half, centre + half), axis=-1)),
        "category": torch.zeros(b, m, dtype=torch.long),
        "instance": torch.zeros(b, m, dtype=torch.long),
        "viewpoint": torch.from_numpy(rng.normal(size=(b, m, 3))),
        "has_viewpoint": torch.from_numpy(present),
        "symmetry": torch.ones(b, m, dtype=torch.long),
        "position": torch.from_numpy(position),
        "has_position": torch.from_numpy(present),
        "diagonal": torch.ones(b, m),
        "has_size": torch.from_numpy(present),
        "voxels": torch.zeros(b, m, 8, dtype=torch.uint8),
        "has_voxels": torch.from_numpy(present),
        "visibility": torch.ones(b, m),
    }
    return SceneBatch(**fields)


def middles(batch: SceneBatch) -> torch.Tensor:
    return project(batch.position, batch.intrinsics[:, None].expand(*batch.position.shape[:2], 4))


@pytest.mark.parametrize("size", [None, 96, 32])
def test_positions_stay_exact(size: int | None) -> None:
    """With the new intrinsics, positions still project to the middle of every box that was not cut."""
    batch = make_batch(40)
    moved = augment(batch, MOVING, np.arange(40), size)
    side = moved.image.shape[-1]
    assert side == (size or 64)
    box = moved.box
    whole = moved.present & (box[..., :2] > 0).all(-1) & (box[..., 2:] < side).all(-1)
    assert whole.sum() > 30
    middle = (box[..., :2] + box[..., 2:]) / 2
    torch.testing.assert_close(middles(moved)[whole], middle[whole], atol=1e-9, rtol=0)
    for name in ("position", "viewpoint", "diagonal", "category", "symmetry"):
        assert torch.equal(getattr(moved, name), getattr(batch, name))
    assert ((box >= 0) & (box <= side)).all() or not moved.present.all()
    assert ((box[moved.present] >= 0) & (box[moved.present] <= side)).all()
    zoom = moved.intrinsics[:, 0] / batch.intrinsics[:, 0] / (side / 64)
    torch.testing.assert_close(moved.intrinsics[:, 1] / batch.intrinsics[:, 1] / (side / 64), zoom)
    low, high = MOVING.scale
    assert zoom.min() >= low - 1e-9 and zoom.max() <= high + 1e-9 and zoom.std() > 0.05


@pytest.mark.parametrize("size", [None, 96])
def test_pixels_move_with_the_intrinsics(size: int | None) -> None:
    """A bright blob painted where a point projects is found where the new intrinsics project it."""
    batch = make_batch(12, 1)
    batch = batch.replace(box=torch.cat((middles(batch) - 4, middles(batch) + 4), -1))
    rows = torch.arange(64) + 0.5
    middle = middles(batch)[:, 0]
    along, down = rows - middle[:, :1], rows - middle[:, 1:]
    blob = torch.exp(-0.5 * (along[:, None, :] ** 2 + down[:, :, None] ** 2) / 9)
    batch = batch.replace(image=(blob[:, None] * 250).to(torch.uint8).expand(-1, 3, -1, -1).contiguous())
    moved = augment(batch, replace(MOVING, translation=0.05), np.arange(12), size)
    image = moved.image[:, 0].double()
    side = image.shape[-1]
    weight = image * (image > 40)
    grid = torch.arange(side) + 0.5
    found = torch.stack(((weight.sum(1) @ grid), (weight.sum(2) @ grid)), -1) / weight.sum((1, 2))[:, None]
    target = middles(moved)[:, 0]
    inside = ((target > 8) & (target < side - 8)).all(-1)
    assert inside.sum() >= 6
    torch.testing.assert_close(found[inside], target[inside], atol=0.25, rtol=0)


def test_there_is_no_flip() -> None:
    """The right half of an image stays at the right, whatever the seed: a mirrored object has another azimuth."""
    batch = make_batch(60, 1)
    image = torch.zeros(60, 3, 64, 64, dtype=torch.uint8)
    image[:, :, 8:28, 36:56] = 200
    moved = augment(batch.replace(image=image), MOVING, np.arange(60)).image.double().mean(1)
    assert (moved[:, :, 32:].sum((1, 2)) > moved[:, :, :32].sum((1, 2))).all()
    assert (moved[:, :32].sum((1, 2)) > moved[:, 32:].sum((1, 2))).all()


def test_objects_pushed_out_lose_their_label() -> None:
    batch = make_batch(64)
    config = replace(MOVING, scale=(2.0, 2.0), translation=0.4)
    moved = augment(batch, config, np.arange(64))
    lost = batch.present & ~moved.present
    kept = moved.present
    assert lost.sum() > 10 and kept.sum() > 10
    assert (moved.present <= batch.present).all()
    box = moved.box[kept]
    assert (box[:, 2:] > box[:, :2]).all()
    assert (moved.visibility[kept] >= config.least_visible).all()
    assert (moved.visibility[kept] < 1).any()
    for row, slot in lost.nonzero():  # hardly anything of it is left in the image
        focal, middle = moved.intrinsics[row, :2], moved.intrinsics[row, 2:]
        factor = focal / batch.intrinsics[row, :2]
        shift = middle - factor * batch.intrinsics[row, 2:]
        whole = batch.box[row, slot] * factor.repeat(2) + shift.repeat(2)
        cut = whole.clamp(0, 64)
        share = (cut[2:] - cut[:2]).prod() / (whole[2:] - whole[:2]).prod()
        assert share < config.least_visible or (cut[2:] - cut[:2]).min() < 2


def test_nothing_happens_without_augmentation() -> None:
    batch = make_batch()
    same = augment(batch, STILL, np.arange(6))
    torch.testing.assert_close(same.image.double(), batch.image.double(), atol=1e-3, rtol=0)
    assert torch.equal(same.box, batch.box) and torch.equal(same.intrinsics, batch.intrinsics)
    sized = augment(batch, None, np.arange(6), 32)
    assert sized.image.shape == (6, 3, 32, 32)
    assert torch.equal(sized.present, batch.present)
    torch.testing.assert_close(sized.intrinsics, batch.intrinsics / 2)
    torch.testing.assert_close(sized.box[batch.present], batch.box[batch.present] / 2)


def test_a_scene_depends_on_its_own_seed_alone() -> None:
    batch, seeds = make_batch(8), np.arange(100, 108)
    whole = augment(batch, Augmentation(), seeds)
    for part in (slice(0, 3), slice(3, 8)):
        half = augment(batch[part], Augmentation(), seeds[part])
        torch.testing.assert_close(half.image, whole.image[part], atol=1e-3, rtol=0)
        assert torch.equal(half.present, whole.present[part]) and torch.equal(half.box, whole.box[part])
    other = augment(batch, Augmentation(), seeds + 8)
    assert not torch.allclose(other.image.double(), whole.image.double())


def test_colours_stay_in_range_and_change() -> None:
    batch = make_batch(64)
    image = augment(batch, Augmentation(inversion_probability=0.5), np.arange(64)).image
    assert image.min() >= 0 and image.max() <= 255
    grey = batch.replace(image=torch.full_like(batch.image, 100))
    plain = replace(STILL, saturation=(0.3, 2.0), hue=1.0)
    torch.testing.assert_close(
        augment(grey, plain, np.arange(64)).image.double(), grey.image.double(), atol=0.5, rtol=0
    )  # grey has neither hue nor saturation
    negative = augment(batch, replace(STILL, inversion_probability=1.0), np.arange(64)).image
    torch.testing.assert_close(negative.double(), 255 - batch.image.double(), atol=1e-3, rtol=0)
    noisy = augment(grey, replace(STILL, noise_probability=1.0, noise=10.0), np.arange(64)).image.double()
    scale = noisy.std((1, 2, 3))
    assert scale.max() < 10.5 and scale.std() > 1
    smooth = augment(batch, replace(STILL, blur_probability=1.0), np.arange(64)).image.double()
    assert (smooth.std((1, 2, 3)) < batch.image.double().std((1, 2, 3))).all()


def test_bad_input() -> None:
    with pytest.raises(InputError, match=r"seeds.*: got 5, expected one for each of 6 scenes"):
        augment(make_batch(), STILL, np.arange(5))
    with pytest.raises(InputError, match=r"augmentation scale: got \(0, 1\)"):
        Augmentation(scale=(0, 1))
