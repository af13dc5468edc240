"""The guide: which predictor is responsible for which object, and what the encoder hands over."""

from __future__ import annotations

import itertools

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.boxes import box_iou
from nolbo_ppl.models.guide import assign_predictors, orientation_posterior
from nolbo_ppl.models.scene_batch import cell_of, decode_box
from tests.factories import instance_config, random_batch, random_posterior, tiny_config, tiny_model


def greedy(cell: list[int], iou: torch.Tensor, present: list[bool]) -> dict[int, int]:
    """Brute force: in the order of their best IoU, objects take the best predictor still free in their cell."""
    taken: dict[int, set[int]] = {}
    result = {}
    objects = [m for m in range(len(cell)) if present[m]]
    for m in sorted(objects, key=lambda m: -float(iou[m].max())):
        free = [p for p in range(iou.shape[1]) if p not in taken.setdefault(cell[m], set())]
        if free:
            result[m] = max(free, key=lambda p: float(iou[m, p]))
            taken[cell[m]].add(result[m])
    return result


@pytest.mark.parametrize("predictors", [1, 2, 3])
def test_assignment_against_brute_force(predictors: int) -> None:
    generator = torch.Generator().manual_seed(0)
    cell = torch.randint(0, 4, (60, 7), generator=generator)
    iou = torch.rand(60, 7, predictors, generator=generator)
    present = torch.rand(60, 7, generator=generator) < 0.8
    predictor, assigned = assign_predictors(cell, iou, present)
    for b in range(60):
        expected = greedy(cell[b].tolist(), iou[b], present[b].tolist())
        assert {m: int(predictor[b, m]) for m in range(7) if assigned[b, m]} == expected
    assert bool((present & ~assigned).any()), "some are left out"


def test_a_lone_object_takes_the_highest_iou_even_of_zero() -> None:
    predictor, assigned = assign_predictors(
        torch.tensor([[3, 5]]), torch.tensor([[[0.2, 0.7], [0.0, 0.0]]]), torch.ones(1, 2).bool()
    )
    assert predictor.tolist() == [[1, 0]]
    assert assigned.all()


def test_objects_of_one_cell_take_different_predictors_and_the_third_is_left_out() -> None:
    iou = torch.tensor([[[0.9, 0.8], [0.95, 0.1], [0.5, 0.6]]])
    predictor, assigned = assign_predictors(torch.zeros(1, 3, dtype=torch.long), iou, torch.ones(1, 3).bool())
    assert predictor[0, :2].tolist() == [1, 0]
    assert assigned.tolist() == [[True, True, False]]


def test_order_of_the_slots_does_not_matter() -> None:
    generator = torch.Generator().manual_seed(1)
    cell, iou = torch.tensor([[0, 0, 0, 2]]), torch.rand(1, 4, 2, generator=generator)
    present = torch.tensor([[True, True, True, True]])
    predictor, assigned = assign_predictors(cell, iou, present)
    for order in itertools.permutations(range(4)):
        index = torch.tensor(order)
        p, a = assign_predictors(cell[:, index], iou[:, index], present)
        assert torch.equal(a[0], assigned[0, index])
        assert torch.equal(p[0][a[0]], predictor[0, index][a[0]])


def test_observe_picks_the_predictor_with_the_highest_iou() -> None:
    """End to end: boxes decoded by hand from the head's own output of each cell."""
    config = tiny_config()
    model = tiny_model(config, scatter=0.3).eval()
    batch = random_batch(config, 4, 4, objects=3, seed=2)
    batch.box[0, 0] = torch.tensor([-10.0, -10, 70, 70])
    scene = model.guide.observe(batch)
    where = scene.assignment
    assert torch.equal(where.assigned, batch.present)
    cell = cell_of(batch.box, 4, 4, 16)
    chosen = set()
    for b, m in batch.present.nonzero().tolist():
        boxes, rows = [], []
        for p in range(2):
            q = model.guide.parameters_at(scene.encoding, torch.tensor([b]), cell[b, m][None] * 2 + p)
            boxes.append(decode_box(q.box_loc, cell[b, m][None], 4, config)[0])
            rows.append(q)
        best = int(box_iou(torch.stack(boxes), batch.box[b, m]).argmax())
        assert int(where.predictor[b, m]) == best
        chosen.add(best)
        region = int(cell[b, m]) * 2 + best
        assert bool(where.is_object[b, region])
        torch.testing.assert_close(scene.posterior.range_loc[b, m], rows[best].range_loc[0])
        torch.testing.assert_close(scene.posterior.shape_scale[b, m], rows[best].shape_scale[0])
    assert int(where.is_object.sum()) == 12
    assert chosen == {0, 1}, "both predictors are chosen somewhere"


def test_encoding_lays_regions_out_row_by_row() -> None:
    """Region = cell * predictors + predictor, cells row by row: a wide image tells rows from columns."""
    config = tiny_config()
    model = tiny_model(config, scatter=0.2).eval()
    image = torch.randint(0, 256, (1, 3, 32, 96), dtype=torch.uint8)
    encoding = model.guide.encode(image)
    assert (encoding.rows, encoding.columns) == (2, 6)
    maps, _ = model.guide.encoder((image.double() - 127.5) / 64)
    logits = model.guide.head.objectness(maps[0].permute(1, 2, 0))
    torch.testing.assert_close(encoding.objectness_logit[0], logits.flatten())
    torch.testing.assert_close(encoding.features[0, 1 * 6 + 4], maps[0, :, 1, 4])


def test_a_known_instance_tells_its_category() -> None:
    config = instance_config()
    batch = random_batch(config, 1, 4)
    batch.category[0] = torch.tensor([-1, -1, 0, 2])
    batch.instance[0] = torch.tensor([2, -1, -1, 3])
    scene = tiny_model(config).eval().guide.observe(batch)
    assert scene.batch.category.tolist() == [[2, -1, 0, 2]]


def test_half_precision_comes_back_in_full() -> None:
    config = tiny_config()
    model = tiny_model(config).float().eval()
    batch = random_batch(config).to(torch.float32)
    torch.set_default_dtype(torch.float32)
    model.requires_grad_(False)
    exact = model.guide.observe(batch)
    model.guide.half_precision = True
    rough = model.guide.observe(batch)
    assert rough.posterior.box_loc.dtype == torch.float32
    assert rough.encoding.objectness_logit.dtype == torch.float32
    difference = (rough.encoding.objectness_logit - exact.encoding.objectness_logit).abs().max()
    assert 0 < float(difference) < 0.1


@pytest.mark.parametrize("form", ["angle", "sincos"])
def test_single_mode_orientation(form: str) -> None:
    """Natural parameters become a mean and a scale 1 / sqrt(kappa), limited to the largest concentration."""
    config = tiny_config(orientation=form, max_concentration=100.0)
    q = random_posterior(config, (5,))
    q.azimuth_natural = torch.tensor([[3.0, 4.0], [0.0, -9.0], [-300.0, 0.0], [0.0, 400.0], [1e-9, 0.0]])[:, None]
    found = orientation_posterior(q, config)
    torch.testing.assert_close(found.loc[:, 0].cos(), torch.tensor([0.6, 0.0, -1.0, 0.0, 1.0]))
    torch.testing.assert_close(found.loc[:, 0].sin(), torch.tensor([0.8, -1.0, 0.0, 1.0, 0.0]))
    torch.testing.assert_close(found.scale[:4, 0] ** -2, torch.tensor([5.0, 9.0, 100.0, 100.0]))
    assert bool(torch.isfinite(found.scale).all())


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((3, 64, 64), "wrong shape"),
        ((1, 1, 64, 64), "wrong shape"),
        ((1, 3, 64, 65), "multiples of 32"),
        ((1, 3, 0, 64), "multiples of 32"),
    ],
)
def test_wrong_images(shape: tuple[int, ...], message: str) -> None:
    model = tiny_model()
    with pytest.raises(InputError, match=message):
        model.guide.encode(torch.zeros(shape, dtype=torch.uint8))


def test_what_is_not_labelled_is_not_learnt_as_background() -> None:
    """Cells in a part to ignore, and all of an image that is not labelled throughout, keep the objects they describe."""
    model = tiny_model()
    batch = random_batch(model.config, slots=1)
    assert model.guide.observe(batch).assignment.counted is None
    masked = batch.replace(
        ignore=torch.tensor([[[0.0, 0.0, 33.0, 17.0]], [[0.0, 0.0, 0.0, 0.0]]]),
        exhaustive=torch.tensor([[True] * 4, [True, False, True, True]]),
    )
    where = model.guide.observe(masked).assignment
    assert where.counted is not None
    free = ~where.is_object
    cells = where.counted[0].unflatten(0, (16, 2))[:, 0]
    expected = torch.ones(16, dtype=torch.bool)
    expected[:2] = False  # centres at 8 and 24 px of the first row
    object_cell = int(where.cell[0, 0])
    expected[object_cell] = cells[object_cell]
    assert torch.equal(cells, expected)
    assert not (where.counted[1] & free[1]).any() and where.counted[where.is_object].all()
