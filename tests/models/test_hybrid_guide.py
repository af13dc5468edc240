"""Evidence of a detector re-binned into regions, objects cut out at one size, and the guide that puts them together."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import INCLUSIVE, SceneELBO, SceneLoss
from nolbo_ppl.models.backbones import COLOUR_MIDDLE, COLOUR_SCALE
from nolbo_ppl.models.crops import BOX_SIDE, MIDDLE, SIDE, Crops, brightened, cut_out, image_levels, with_mirrored
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.models.evidence import COCO_LABELS, MIN_LOG, ROLE_SIDE, WEAK, bin_best, detector_evidence
from nolbo_ppl.models.hybrid_guide import HybridGuide, assign_regions, known_regions
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import cell_of, decode_box, decode_range, encode_range
from nolbo_ppl.models.yolox import Predictions, ScaledConv, YoloxNano
from tests.factories import random_batch, tiny_config

CONFIG = tiny_config(detector="yolox_nano")


def hybrid(seed: int = 0) -> Nolbo:
    return Nolbo.from_seed(CONFIG, seed).double()


def guide_of(model: Nolbo) -> HybridGuide:
    assert isinstance(model.guide, HybridGuide)
    return model.guide


def random_boxes(n: int, side: float, g: torch.Generator) -> torch.Tensor:
    centre = side * torch.rand(2, n, 2, generator=g)
    half = torch.exp(2 + torch.rand(2, n, 2, generator=g) * 2) / 2
    return torch.cat((centre - half, centre + half), -1)


@pytest.mark.parametrize(("kernel", "groups"), [(1, 1), (3, 1), (3, 6)])
def test_scaled_kernels_are_the_plain_ones(kernel: int, groups: int) -> None:
    g = torch.Generator().manual_seed(kernel + groups)
    plain = torch.nn.Conv2d(6, 12, kernel, 2 if kernel > 1 else 1, kernel // 2, groups=groups).double()
    with torch.no_grad():
        plain.weight.mul_(torch.exp(3 * torch.randn(12, 1, 1, 1, generator=g)))  # channels of very different size
    scaled = ScaledConv(6, 12, kernel, 2 if kernel > 1 else 1, groups)
    scaled.set_kernel(plain.weight.detach(), plain.bias.detach())
    torch.testing.assert_close(scaled.weight.square().mean((1, 2, 3)), torch.ones(12))
    x = torch.randn(2, 6, 8, 8, generator=g)
    torch.testing.assert_close(scaled(x), plain(x))
    with pytest.raises(InputError, match="kernel of a detector"):
        scaled.set_kernel(plain.weight.detach()[:3], plain.bias.detach())


def test_the_best_prediction_of_a_cell_and_size_is_kept() -> None:
    g = torch.Generator().manual_seed(3)
    box, score = random_boxes(60, 64.0, g), torch.randn(2, 60, generator=g)
    index, found = bin_best(box, score, 4, 4, CONFIG)
    for b in range(2):
        best: dict[int, int] = {}
        for n in range(60):
            cell = int(cell_of(box[b, n], 4, 4, 16))
            large = float((box[b, n, 2:] - box[b, n, :2]).max()) >= ROLE_SIDE
            region = 2 * cell + large
            if region not in best or score[b, n] > score[b, best[region]]:
                best[region] = n
        assert {k: int(index[b, k]) for k in range(32) if found[b, k]} == best


def test_a_detectors_evidence_is_its_own_odds() -> None:
    g = torch.Generator().manual_seed(4)
    box = random_boxes(40, 64.0, g)
    predictions = Predictions(
        box, torch.randn(2, 40, generator=g), torch.randn(2, 40, 80, generator=g), torch.randn(2, 40, 5, generator=g)
    )
    evidence = detector_evidence(predictions, 4, 4, CONFIG)
    own = [COCO_LABELS[name] for name in CONFIG.categories]
    probability = torch.sigmoid(predictions.objectness) * torch.sigmoid(predictions.classes[..., own]).amax(-1)
    index, found = bin_best(box, torch.logit(probability), 4, 4, CONFIG)
    expected = torch.where(found, torch.logit(probability).gather(1, index), MIN_LOG)
    torch.testing.assert_close(evidence.log_odds, expected.clamp_min(MIN_LOG))
    b, k = (value[0] for value in found.nonzero(as_tuple=True))
    trucks = torch.nn.functional.logsigmoid(predictions.classes[b, index[b, k], 7])
    torch.testing.assert_close(evidence.labels[b, k, len(own)], trucks)


def test_before_training_regions_say_what_the_detector_says() -> None:
    guide = guide_of(hybrid()).eval()
    image = random_batch(CONFIG).image
    with torch.no_grad():
        gathered, encoding = guide.gather(image), guide.encode(image)
    strength = torch.maximum(gathered.detector.log_odds, gathered.scene.log_odds)
    expected = torch.where(strength > WEAK, gathered.detector.log_odds, strength)
    torch.testing.assert_close(encoding.objectness_logit, expected)
    assert encoding.fused is not None and encoding.box is not None
    torch.testing.assert_close(encoding.fused.label_logits, gathered.detector.labels[..., : len(CONFIG.categories)])
    alone = (gathered.detector.found > 0) & (gathered.scene.found == 0)
    assert alone.any()
    torch.testing.assert_close(encoding.box[alone], gathered.detector.box[alone])


def test_objects_are_cut_out_at_one_size() -> None:
    """On an image whose colours are its coordinates, a crop's colours are where its pixels come from."""
    y, x = torch.meshgrid(torch.arange(192) + 0.5, torch.arange(192) + 0.5, indexing="ij")
    levels = image_levels(torch.stack((x, y, x + y))[None])
    box = torch.tensor([[60.0, 70.0, 104.0, 92.0], [30.0, 20.0, 170.0, 180.0]])
    crops = cut_out(levels, torch.tensor([0, 0]), box)
    sides = (crops.box[:, 2:] - crops.box[:, :2]).amax(-1)
    torch.testing.assert_close(sides, torch.full((2,), BOX_SIDE))
    step = torch.arange(SIDE) + 0.5 - SIDE / 2
    for k in range(2):
        centre = (box[k, :2] + box[k, 2:]) / 2
        across = centre[0] + step / crops.factor[k]
        inside = (across > 8) & (across < 184)  # beyond the border its last pixel goes on
        torch.testing.assert_close(crops.image[k, 0, SIDE // 2, inside], across[inside], atol=0.05, rtol=0)


def test_dark_objects_are_brightened() -> None:
    """An even box comes to the wanted mean whatever lies around it, black to one as much brighter as can be; bright ones stay."""
    colours = torch.tensor([0.12, 0.3, 0.45, 0.8, 1e-3])
    box = torch.tensor([[20.0, 30, 60, 80]]).expand(5, 4)
    light = torch.full((5, 3, SIDE, SIDE), 0.99)
    light[:, :, 30:80, 20:60] = colours[:, None, None, None]
    crops = Crops((255 * light - COLOUR_MIDDLE) / COLOUR_SCALE, box, torch.ones(5))
    seen = (brightened(crops).image * COLOUR_SCALE + COLOUR_MIDDLE) / 255
    inside = seen[:, :, 30:80, 20:60].mean((1, 2, 3))
    torch.testing.assert_close(inside, torch.tensor([MIDDLE, MIDDLE, 0.45, 0.8, 0.1]))
    torch.testing.assert_close(seen[2:4], light[2:4])
    assert (seen[0, :, :20] > 0.99).all() and (seen <= 1).all()  # surroundings keep their order and are not cut off


def test_the_azimuth_of_a_mirrored_picture_is_the_negative() -> None:
    """A guide that looks at both says of the mirror image exactly the opposite of what it says of the image."""
    guide = guide_of(hybrid(3)).eval()
    image = random_batch(CONFIG, scenes=1, slots=1).image
    width = image.shape[-1]
    box = torch.tensor([[20.0, 12, 50, 44]])
    turned = torch.stack((width - box[:, 2], box[:, 1], width - box[:, 0], box[:, 3]), -1)
    row, region = torch.tensor([0]), torch.tensor([3])
    angles = torch.linspace(-3, 3, 25)[:, None]

    def density(picture: torch.Tensor, place: torch.Tensor, q_of: HybridGuide) -> torch.Tensor:
        with torch.no_grad():
            q = q_of.parameters_at(q_of.encode(picture), row, region, box=place)
        return VonMisesMixture(q.azimuth_logits, q.azimuth_natural, max_concentration=300.0).log_prob(angles)

    here, there = density(image, box, guide), density(image.flip(-1), turned, guide)
    torch.testing.assert_close(here, there.flip(0))
    guide.training = True  # one look alone
    one, other = density(image, box, guide), density(image.flip(-1), turned, guide)
    assert (one - other.flip(0)).abs().max() > 1e-3
    torch.testing.assert_close(here, torch.logaddexp(one, other.flip(0)) - torch.log(torch.tensor(2.0)))


def test_crops_and_their_mirror_images() -> None:
    g = torch.Generator().manual_seed(8)
    crops = Crops(torch.randn(2, 3, SIDE, SIDE, generator=g), torch.tensor([[10.0, 20, 30, 50], [5, 6, 90, 100]]), torch.ones(2))
    both = with_mirrored(crops)
    assert len(both.box) == 4 and torch.equal(both.image[:2], crops.image) and torch.equal(both.box[:2], crops.box)
    assert torch.equal(both.image[2, :, 20:50, SIDE - 30 : SIDE - 10], crops.image[0, :, 20:50, 10:30].flip(-1))
    assert both.box[2].tolist() == [SIDE - 30, 20, SIDE - 10, 50]


def test_range_of_a_crop_is_that_of_the_image() -> None:
    """Seen in a crop, the camera has so many more pixels a radian: the position must come out the same."""
    model = hybrid()
    guide = guide_of(model).eval()
    batch = random_batch(CONFIG, scenes=1, slots=1)
    with torch.no_grad():
        encoding = guide.encode(batch.image)
        box = batch.box[0, :1]
        region = guide.responsible_region(encoding, torch.tensor([0]), box)
        raw, factor = guide.look_at(encoding.levels, torch.tensor([0]), box)
        q = guide.parameters_at(encoding, torch.tensor([0]), region, box=box)
    first = sum(guide.head.sizes[:5])
    camera = batch.intrinsics * torch.cat((factor, factor, factor, factor))
    here, _ = decode_range(q.range_loc, box, batch.intrinsics, CONFIG)
    in_crop, _ = decode_range(raw[:, first : first + 4], box * factor, camera, CONFIG)
    torch.testing.assert_close(here, in_crop)
    again = encode_range(here, torch.ones(1), box, batch.intrinsics, CONFIG)
    torch.testing.assert_close(again[:, :3], q.range_loc[:, :3])


def test_objects_share_no_region() -> None:
    g = torch.Generator().manual_seed(5)
    own, logit = random_boxes(32, 64.0, g), torch.randn(2, 32, generator=g)
    box = own[:, :6] + torch.randn(2, 6, 4, generator=g)
    box[:, 1] = box[:, 0]  # two objects in one place
    present = torch.ones(2, 6, dtype=torch.bool)
    region, assigned, overlap = assign_regions(own, logit, box, present, 4, 4, CONFIG)
    assert assigned.all()
    for row in region:
        assert len(set(row.tolist())) == 6
    assert (overlap[:, 2:] > 0.5).float().mean() > 0.8


def test_what_is_not_labelled_is_not_background() -> None:
    own = torch.tensor([[[0.0, 0, 20, 20], [40, 40, 60, 60], [41, 41, 61, 61], [100, 0, 120, 20], [100, 80, 120, 100]]])
    labels = torch.nn.functional.one_hot(torch.tensor([[0, 2, 2, 2, 1]]), 4).double()
    batch = random_batch(CONFIG, scenes=1, slots=1)
    batch = batch.replace(
        box=torch.tensor([[[40.0, 40, 60, 60]]]),
        ignore=torch.tensor([[[95.0, 0, 130, 30], [0, 0, 0, 0]]]),
        exhaustive=torch.tensor([[True, False, True, True]]),
    )
    # free; the object's own region and its neighbour; in a region to ignore; of a category not labelled throughout
    assert known_regions(own, labels, batch).tolist() == [[True, False, False, False, False]]
    everything = batch.replace(ignore=None, exhaustive=None)
    assert known_regions(own, labels, everything).tolist() == [[True, False, False, True, True]]


def test_the_objective_runs_and_leaves_the_detector_alone() -> None:
    model = hybrid().train()
    batch = random_batch(CONFIG)
    batch = batch.replace(exhaustive=torch.zeros(2, 4, dtype=torch.bool))
    scene = model.guide.observe(batch)
    assert scene.assignment.counted is not None
    assert (scene.assignment.counted == scene.assignment.is_object).all()  # nothing is labelled throughout
    loss = SceneLoss(model.story, model.guide, SceneELBO(INCLUSIVE))
    result = loss(batch)
    result.loss.backward()
    assert torch.isfinite(result.loss)
    assert all(p.grad is None for p in guide_of(model).detector.parameters())
    moved = [name for name, p in model.guide.named_parameters() if p.grad is not None and bool(p.grad.any())]
    assert any(name.startswith("encoder") for name in moved) and any(name.startswith("fusion") for name in moved)
    # objects lie where a region decodes to them: boxes of responsible regions are those of `observe`'s target
    at, slot = scene.assignment.assigned.nonzero(as_tuple=True)
    cell = scene.assignment.cell[at, slot]
    box = decode_box(scene.assignment.box_target[at, slot], cell, scene.encoding.columns, CONFIG)
    torch.testing.assert_close(box, batch.box[at, slot])


def test_statistics_stay_in_training() -> None:
    model = hybrid().train()
    before = {k: v.clone() for k, v in model.guide.encoder.state_dict().items() if "running" in k}
    model.guide.observe(random_batch(CONFIG))
    after = model.guide.encoder.state_dict()
    assert before and all(torch.equal(value, after[name]) for name, value in before.items())


def test_a_detector_needs_the_small_encoder() -> None:
    with pytest.raises(InputError, match="detector"):
        dataclasses.replace(CONFIG, glimpse=0)


def test_levels_of_predictions() -> None:
    found = YoloxNano().double()(torch.zeros(1, 3, 64, 96))
    assert found.box.shape == (1, 8 * 12 + 4 * 6 + 2 * 3, 4)
    assert found.classes.shape[-1] == 80 and found.features.shape[-1] == 128


@pytest.mark.parametrize("sides", [(64, 96), (37, 50)])
def test_levels_are_means_over_blocks(sides: tuple[int, int]) -> None:
    image = torch.randn(2, 3, *sides, generator=torch.Generator().manual_seed(0))
    for number, level in enumerate(image_levels(image)):
        expected = image
        for _ in range(number):
            expected = torch.nn.functional.avg_pool2d(expected, 2)
        torch.testing.assert_close(level, expected)
