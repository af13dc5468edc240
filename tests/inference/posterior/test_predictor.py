"""Queries on the posterior: detections, metric positions, covariances, classes, voxels, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.boxes import pairwise_iou
from nolbo_ppl.geometry.rotation import quaternion_to_matrix, ray_rotation, viewpoint_to_matrix
from nolbo_ppl.inference.posterior.decode import position_covariance
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.preprocess import preprocess
from nolbo_ppl.models.guide import orientation_posterior
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.scene_batch import cell_of, decode_box, decode_range
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from tests.factories import instance_config, tiny_config, tiny_model

CAMERA = [70.0, 74.0, 33.0, 29.0]


def observer(config: ModelConfig | None = None, calibration: Calibration | None = None) -> ObservationModel:
    """A random network whose objectness spreads about one half and whose heads differ from cell to cell."""
    model = tiny_model(config, scatter=0.15).eval()
    head = model.guide.head.objectness
    with torch.no_grad():
        logit = model.guide.encode(torch.from_numpy(picture()).permute(2, 0, 1)[None]).objectness_logit
        head.weight.div_(logit.std())
        head.bias.copy_((head.bias - logit.mean()) / logit.std() - 0.2)
    return ObservationModel(model, calibration)


def picture(seed: int = 0, height: int = 64, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def assert_same(a: ObjectPosteriors, b: ObjectPosteriors, tolerance: float = 1e-9) -> None:
    """Equal in every field."""
    assert len(a) == len(b)
    for field in dataclasses.fields(ObjectPosteriors):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            for part in dataclasses.fields(x):
                np.testing.assert_allclose(getattr(x, part.name), getattr(y, part.name), atol=tolerance, rtol=tolerance)
        elif isinstance(x, np.ndarray):
            np.testing.assert_allclose(x, y, atol=tolerance, rtol=tolerance, err_msg=field.name)
        else:
            assert x == y


def parameters(model: ObservationModel, image: np.ndarray, region: int) -> RegionParameters:
    """Posterior of one region of a 64 x 64 image, straight from the guide."""
    with torch.no_grad():
        encoding = model.model.guide.encode(torch.from_numpy(image).permute(2, 0, 1)[None])
        return model.model.guide.parameters_at(encoding, torch.tensor([0]), torch.tensor([region]))


def test_detections_and_their_shapes() -> None:
    model, image = observer(), picture()
    found = model.observe(image, CAMERA, threshold=0.5, iou_threshold=1.0)
    n = len(found)
    assert 2 < n < 32
    with torch.no_grad():
        logit = model.model.guide.encode(torch.from_numpy(image).permute(2, 0, 1)[None]).objectness_logit[0]
    expected = torch.sigmoid(logit[logit > 0]).sort(descending=True).values
    np.testing.assert_allclose(found.objectness, expected.numpy())
    shapes = {
        "box": (n, 4),
        "box_scale": (n, 4),
        "class_log_posterior": (n, 4),
        "class_log_likelihood": (n, 4),
        "latent": (n, 4),
        "latent_scale": (n, 4),
        "position": (n, 3),
        "position_covariance": (n, 3, 3),
        "elevation_inplane": (n, 2),
        "elevation_inplane_scale": (n, 2),
        "viewpoint": (n, 3),
        "R_camera_object": (n, 3, 3),
        "rotation_scale": (n,),
        "diagonal": (n,),
        "diagonal_log_scale": (n,),
        "size": (n, 3),
        "voxel_mean": (n, 32, 32, 32),
        "voxel_variance": (n, 32, 32, 32),
    }
    for name, shape in shapes.items():
        value = getattr(found, name)
        assert value.shape == shape, name
        assert np.isfinite(value).all(), name
    assert found.instance_log_posterior is None
    assert found.viewpoint_modes.weights.shape == (n, 4)
    assert set(found.category) <= set(model.config.categories)


def test_overlapping_regions_add_up() -> None:
    """Greedy suppression by hand: the probability of an object is the sum over the regions that describe it."""
    model, image = observer(), picture(7)
    found = model.observe(image, CAMERA, threshold=0.6, iou_threshold=0.3)
    with torch.no_grad():
        logit = model.model.guide.encode(torch.from_numpy(image).permute(2, 0, 1)[None]).objectness_logit[0]
    region = (torch.sigmoid(logit) > 0.02).nonzero()[:, 0]
    p = torch.sigmoid(logit[region])
    box = torch.cat([decode_box(parameters(model, image, int(r)).box_loc, r[None] // 2, 4, model.config) for r in region])
    iou = pairwise_iou(box, box)
    left, expected = set(range(len(region))), []
    while left:
        best = max(left, key=lambda i: float(p[i]))
        same = [i for i in left if i == best or float(iou[best, i]) > 0.3]
        expected.append((min(float(p[same].sum()), 1 - 1e-6), best))
        left -= set(same)
    expected = sorted((e for e in expected if e[0] > 0.6), reverse=True)
    assert len(expected) < len(region), "some are joined"
    np.testing.assert_allclose(found.objectness, [value for value, _ in expected], atol=1e-12)
    np.testing.assert_allclose(np.sort(found.box, axis=0), np.sort(box[[best for _, best in expected]].numpy(), axis=0))


def test_size_of_the_scaled_images() -> None:
    """`size` acts as another image size of the network would."""
    model = observer()
    larger = ObservationModel(model.model)
    larger.config = dataclasses.replace(model.config, image_size=96)
    image = picture(2, 50, 110)
    assert_same(model.observe(image, CAMERA, size=96, threshold=0.4), larger.observe(image, CAMERA, threshold=0.4))
    boxes = [np.array([[5.0, 4, 60, 40]])]
    assert_same(model.observe_boxes([image], CAMERA, boxes, size=96)[0], larger.observe_boxes([image], CAMERA, boxes)[0])
    with pytest.raises(InputError, match="multiple of 32"):
        model.observe(image, CAMERA, size=100)


def test_answers_are_those_of_the_guide() -> None:
    """One region, recomputed: box, position, orientation at the density's mode, seen along the ray."""
    model, image = observer(), picture(1)
    found = model.observe(image, CAMERA, threshold=0.5, iou_threshold=1.0)
    with torch.no_grad():
        logit = model.model.guide.encode(torch.from_numpy(image).permute(2, 0, 1)[None]).objectness_logit[0]
    region = int(logit.argmax())
    q = parameters(model, image, region)
    box = decode_box(q.box_loc, torch.tensor([region // 2]), 4, model.config)
    np.testing.assert_allclose(found.box[0], box[0].numpy())
    position, diagonal = decode_range(q.range_loc, box, torch.tensor([CAMERA]), model.config)
    np.testing.assert_allclose(found.position[0], position[0].numpy())
    np.testing.assert_allclose(found.diagonal[0], diagonal[0].item())
    density = orientation_posterior(q, model.config).azimuth
    grid = torch.linspace(-math.pi, math.pi, 20001)[:, None]
    mode = float(grid[density.log_density(grid).squeeze(-1).argmax()])
    assert abs(math.remainder(found.viewpoint[0, 0] - mode, 2 * math.pi)) < 1e-3
    np.testing.assert_allclose(found.viewpoint[0, 1:], q.angle_loc[0].numpy())
    R = ray_rotation(position[0]) @ viewpoint_to_matrix(torch.from_numpy(found.viewpoint[0]))
    np.testing.assert_allclose(found.R_camera_object[0], R.numpy(), atol=1e-12)
    np.testing.assert_allclose(found.class_posterior[0], torch.softmax(q.label_logits[0], -1).numpy())


def test_suppression_and_threshold() -> None:
    model, image = observer(), picture()
    everything = model.observe(image, CAMERA, threshold=0.3, iou_threshold=1.0, decode=False)
    some = model.observe(image, CAMERA, threshold=0.3, iou_threshold=0.3, decode=False)
    assert 0 < len(some) < len(everything)
    iou = pairwise_iou(torch.from_numpy(some.box), torch.from_numpy(some.box))
    assert float((iou - torch.eye(len(some))).max()) <= 0.3
    assert (np.diff(some.objectness) <= 0).all()
    strict = model.observe(image, CAMERA, threshold=0.6, iou_threshold=1.0, decode=False)
    assert (strict.objectness > 0.6).all()
    assert len(strict) == int((everything.objectness > 0.6).sum())


def test_no_detection_is_an_empty_answer() -> None:
    model = observer(instance_config())
    for decode in (True, False):
        found = model.observe(picture(), CAMERA, threshold=0.9999, iou_threshold=1.0, decode=decode)
        assert len(found) == 0
        assert list(found.to_records(0, "a.png")) == []
        assert found.category == []
        assert found.box.shape == (0, 4)
        assert found.position_covariance.shape == (0, 3, 3)
        assert (found.voxel_mean is None) != decode
    assert model.observe([], CAMERA) == []


def test_batches_equal_one_by_one() -> None:
    """Images of several shapes together, some without detections: the same answers, in the order given."""
    model = observer()
    sizes = [(64, 64), (64, 48), (64, 64), (128, 128), (33, 64), (64, 64)]
    images = [picture(k, *size) for k, size in enumerate(sizes)]
    cameras = np.array([[60.0 + k, 61.0 + k, 30.0, 31.0] for k in range(6)])
    options: dict[str, Any] = {"threshold": 0.55, "iou_threshold": 0.4, "samples": 3}
    together = model.observe(images, cameras, batch=2, **options)
    counts = set()
    for image, camera, found in zip(images, cameras, together, strict=True):
        assert_same(found, model.observe(image, camera, **options), 1e-6)  # the search for the mode ends that near
        counts.add(len(found))
    assert len(counts) > 1


def test_tensors_and_arrays_are_the_same_image() -> None:
    model, image = observer(), picture()
    options: dict[str, Any] = {"threshold": 0.5, "decode": False}
    found = model.observe(torch.from_numpy(image).permute(2, 0, 1), CAMERA, **options)
    assert_same(found, model.observe(image, CAMERA, **options))


def test_double_resolution_gives_the_same_metres() -> None:
    """The same scene with twice the pixels (and twice the intrinsics); boxes double, metres stay."""
    model = observer()
    stripes = np.linspace(0, 255, 64).astype(np.uint8)
    small = np.repeat(np.repeat(stripes[None, :, None], 64, 0), 3, 2)
    large = small.repeat(2, 0).repeat(2, 1)
    options: dict[str, Any] = {"threshold": 0.4, "iou_threshold": 1.0, "decode": False}
    a = model.observe(small, CAMERA, **options)
    b = model.observe(large, [2 * v for v in CAMERA], **options)
    assert len(a) == len(b) > 3
    np.testing.assert_allclose(b.position, a.position, rtol=0.02, atol=0.02)
    np.testing.assert_allclose(b.box, 2 * a.box, rtol=0.02, atol=0.5)
    np.testing.assert_allclose(b.position_covariance, a.position_covariance, rtol=0.1, atol=1e-3 * a.position_covariance.max())
    one = model.observe(small, [50.0, 50.0, 32.0, 32.0], **options)
    again = model.observe(small, [100.0, 100.0, 32.0, 32.0], **options)
    # the same picture through twice the focal length is as much farther away as a radian then covers more pixels
    distance, twice = (np.linalg.norm(x.position, axis=1) for x in (one, again))
    cosine, closer = (x.position[:, 2] / np.linalg.norm(x.position, axis=1) for x in (one, again))
    np.testing.assert_allclose(twice, 2 * (cosine / closer) ** 1.5 * distance)


def test_bars_beside_images_of_odd_sizes() -> None:
    """An image whose sides are no multiples of 32 gets grey bars; boxes come back in its own pixels, rays through them."""
    model = observer()
    image = np.full((50, 90, 3), 120, np.uint8)
    camera = [80.0, 80.0, 45.0, 25.0]
    found = model.observe(image, camera, threshold=0.3, iou_threshold=1.0, decode=False)
    # the network saw 64 x 36 px and a bar below them: every cell's centre, decoded by hand and scaled back
    scale = np.array([64 / 90, 36 / 50])
    seen = torch.full((1, 3, 64, 64), 114, dtype=torch.uint8)
    seen[:, :, :36] = 120
    with torch.no_grad():
        encoding = model.model.guide.encode(seen)
    region = int(encoding.objectness_logit[0].argmax())
    q = model.model.guide.parameters_at(encoding, torch.tensor([0]), torch.tensor([region]))
    box = decode_box(q.box_loc, torch.tensor([region // 2]), 4, model.config)
    np.testing.assert_allclose(found.box[0], (box[0].numpy().reshape(2, 2) / scale).ravel())
    offset = (q.range_loc[0] * torch.tensor(model.config.range_spread) + torch.tensor(model.config.range_loc))[1:3].numpy()
    extent, centre = found.box[0, 2:] - found.box[0, :2], (found.box[0, :2] + found.box[0, 2:]) / 2
    pixel = centre + offset * extent
    x, y, z = found.position[0]
    np.testing.assert_allclose([80 * x / z + 45, 80 * y / z + 25], pixel)


def narrow_posterior(config: ModelConfig, n: int, seed: int = 0) -> RegionParameters:
    from tests.factories import random_posterior

    q = random_posterior(config, (n,), seed)
    q.box_loc = 0.5 * q.box_loc
    q.box_scale, q.range_scale = 0.003 * q.box_scale, 0.003 * q.range_scale
    return q


def test_position_covariance_against_propagated_samples() -> None:
    """Samples of box and range latents through the decoders, small scales: covariance within five standard errors."""
    model = observer()
    config, n, draws = model.config, 4, 40000
    q = narrow_posterior(config, n)
    cell = torch.tensor([0, 5, 10, 15])
    camera = torch.tensor([CAMERA]).expand(n, 4)
    box = decode_box(q.box_loc, cell, 4, config)
    box_scale = q.box_scale * torch.tensor(config.box_spread)
    box_scale[:, :2] *= config.stride
    position, _ = decode_range(q.range_loc, box, camera, config)
    found = position_covariance(q, box, box_scale, position, camera, config)
    torch.manual_seed(0)
    boxes = decode_box(q.box_loc + q.box_scale * torch.randn(draws, n, 4), cell, 4, config)
    samples, _ = decode_range(q.range_loc + q.range_scale * torch.randn(draws, n, 4), boxes, camera, config)
    deviation = samples - samples.mean(0)
    outer = deviation[..., :, None] * deviation[..., None, :]
    error = 5 * outer.std(0) / math.sqrt(draws)
    second_order = 1e-4 * found.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    assert bool(((outer.mean(0) - found).abs() <= error + second_order).all())
    assert bool((torch.linalg.eigvalsh(found) > 0).all())
    # each of the four sources is needed to agree: without it the covariance would be off by more than the tolerance
    assert bool(((found - outer.mean(0)).abs() / found.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] < 0.05).all())


def test_class_posterior_and_maximum_likelihood() -> None:
    model = observer(instance_config())
    found = model.observe(picture(), CAMERA, threshold=0.4, decode=False)
    np.testing.assert_allclose(np.exp(found.class_log_posterior).sum(-1), 1)
    np.testing.assert_allclose(found.class_posterior.sum(-1), 1)
    mean = model.model.story.prior.category_mean().detach().numpy()
    for i in range(len(found)):
        by_hand = [sum(-0.5 * (found.latent[i, k] - mu[k]) ** 2 - 0.5 * math.log(2 * math.pi) for k in range(2)) for mu in mean]
        np.testing.assert_allclose(found.class_log_likelihood[i], by_hand)
        assert found.category[i] == model.config.categories[int(np.argmax(by_hand))]
    # instances: the bound's optimum, within the most probable category
    np.testing.assert_allclose(np.exp(found.instance_log_posterior).sum(-1), 1)
    own = [*model.model.story.prior.instance().detach().numpy(), np.zeros(2)]
    for i in range(len(found)):
        label = int(found.class_log_posterior[i].argmax())
        loc, scale = found.latent[i, 2:], found.latent_scale[i, 2:]
        belongs = [c == label for c in model.config.instance_category] + [True]
        score = np.array([-0.5 * ((loc - mu) ** 2).sum() if b else -np.inf for mu, b in zip(own, belongs, strict=True)])
        score -= 0.5 * (scale**2).sum() - np.log(scale).sum()
        expected = np.exp(score - score.max())
        np.testing.assert_allclose(np.exp(found.instance_log_posterior[i]), expected / expected.sum(), atol=1e-12)


def test_voxels_against_own_samples() -> None:
    """Mean and variance over the shape latent: own samples of the posterior through the decoder, five standard errors."""
    model = observer()
    found = model.observe(picture(), CAMERA, threshold=0.7, iou_threshold=0.1, samples=200, seed=1)[[0]]
    rng = np.random.default_rng(7)
    latent = found.latent + found.latent_scale * rng.standard_normal((200, 4))
    own = model.decode(latent)
    error = 5 * np.sqrt(2 / 200) * own.std(0, ddof=1) + 1e-9
    # a million voxel comparisons share 200 draws: compare averages over blocks of 8^3 voxels
    blocks = (slice(None, None, 8),) * 3
    assert (np.abs(found.voxel_mean[0] - own.mean(0)) <= error)[blocks].all()
    fourth = ((own - own.mean(0)) ** 4).mean(0)
    spread = 5 * np.sqrt(2 * np.maximum(fourth - own.var(0) ** 2, 0) / 200) + 1e-9
    assert (np.abs(found.voxel_variance[0] - own.var(0, ddof=1)) <= 1.5 * spread)[blocks].all()
    assert found.voxel_variance.max() > 1e-5
    again = model.observe(picture(), CAMERA, threshold=0.7, iou_threshold=0.1, samples=200, seed=1)[[0]]
    assert_same(found, again, 0.0)


def test_decode_is_the_decoders_probability() -> None:
    model = observer()
    latent = np.random.default_rng(0).standard_normal((3, 4))
    with torch.no_grad():
        expected = torch.sigmoid(model.model.story.decoder(torch.from_numpy(latent)))
    np.testing.assert_allclose(model.decode(latent), expected.numpy())
    assert model.decode(np.zeros((0, 4))).shape == (0, 32, 32, 32)
    assert model.prior_mean().shape == (4, 4)
    with pytest.raises(InputError, match=r"shape latents: got \(3, 5\), expected \(n, 4\)"):
        model.decode(np.zeros((3, 5)))


def test_boxes_need_no_second_look() -> None:
    """Boxes and their scales are the same without it; what it is for is not."""
    model = observer()
    with torch.no_grad():
        encoding = model.model.guide.encode(torch.from_numpy(picture(5, 64, 64).transpose(2, 0, 1).copy())[None])
        row, region = torch.zeros(6, dtype=torch.long), torch.tensor([0, 3, 8, 13, 20, 31])
        full, quick = (model.model.guide.parameters_at(encoding, row, region, look=look) for look in (True, False))
    assert torch.equal(full.box_loc, quick.box_loc) and torch.equal(full.box_scale, quick.box_scale)
    assert not torch.allclose(full.label_logits, quick.label_logits)


def test_given_boxes_are_answered_in_order() -> None:
    """The predictor of the box's cell whose own box overlaps it most, scaled images included."""
    model = observer()
    image = picture(3, 128, 128)
    boxes = np.array([[10.0, 20, 50, 60], [70, 70, 120, 110], [0, 90, 30, 128], [60, 0, 100, 124]])
    camera = [2 * v for v in CAMERA]
    found, none = model.observe_boxes([image, image], camera, [boxes, np.zeros((0, 4))], decode=False)
    assert len(found) == 4
    assert len(none) == 0
    prepared = preprocess(image, camera, 64, torch.float64)
    with torch.no_grad():
        encoding = model.model.guide.encode(prepared.image[None])
    for i, box in enumerate(boxes / 2):
        cell = int(cell_of(torch.from_numpy(box), 4, 4, 16))
        rows = [model.model.guide.parameters_at(encoding, torch.tensor([0]), torch.tensor([2 * cell + p])) for p in range(2)]
        own = torch.cat([decode_box(q.box_loc, torch.tensor([cell]), 4, model.config) for q in rows])
        best = int(pairwise_iou(own, torch.from_numpy(box)[None])[:, 0].argmax())
        np.testing.assert_allclose(found.box[i], 2 * own[best].numpy())
        look = model.model.guide.parameters_at(
            encoding, torch.tensor([0]), torch.tensor([2 * cell + best]), box=torch.from_numpy(box)[None]
        )
        mode = look.at_map_category(model.model.story.prior.label_mean())
        np.testing.assert_allclose(found.latent[i], mode.shape_loc[0].detach().numpy())


def test_calibration_reaches_every_answer() -> None:
    image = picture()
    plain = observer().observe(image, CAMERA, threshold=0.5, iou_threshold=1.0)
    factors = Calibration(
        label_slope=0.5, azimuth_concentration=2.0, angle_scale=1.5, shape_scale=0.7, box_scale=3.0, range_scale=1.3
    )
    found = observer(calibration=factors).observe(image, CAMERA, threshold=0.5, iou_threshold=1.0)
    np.testing.assert_allclose(found.latent_scale, 0.7 * plain.latent_scale)
    np.testing.assert_allclose(found.box_scale, 3 * plain.box_scale)
    np.testing.assert_allclose(found.elevation_inplane_scale, 1.5 * plain.elevation_inplane_scale)
    np.testing.assert_allclose(found.diagonal_log_scale, 1.3 * plain.diagonal_log_scale)
    np.testing.assert_allclose(found.viewpoint_modes.concentration, np.minimum(2 * plain.viewpoint_modes.concentration, 300))
    np.testing.assert_allclose(np.diff(found.class_log_posterior), 0.5 * np.diff(plain.class_log_posterior))
    np.testing.assert_allclose(found.position, plain.position)
    shifted = observer(calibration=Calibration(objectness_shift=-1.0)).observe(image, CAMERA, threshold=0.1, iou_threshold=1.0)
    logit = np.log(plain.objectness / (1 - plain.objectness)) - 1
    np.testing.assert_allclose(shifted.objectness[: len(plain)], 1 / (1 + np.exp(-logit)))


def test_rows_survive_json() -> None:
    found = observer().observe(picture(), CAMERA, threshold=0.5)
    rows = list(found.to_records(7, "000007.png"))
    assert len(rows) == len(found)
    for i, row in enumerate(json.loads(json.dumps(rows, allow_nan=False))):
        assert row["frame"] == 7
        assert row["image"] == "000007.png"
        assert row["id"] == f"000007-{i:03d}"
        assert row["category"] == found.category[i]
        assert set(row["class_posterior"]) == set(found.categories)
        R = quaternion_to_matrix(torch.tensor(row["rotation"]))
        np.testing.assert_allclose(R.numpy(), found.R_camera_object[i], atol=1e-6)
        np.testing.assert_allclose(row["position"], found.position[i], atol=1e-5)
        np.testing.assert_allclose(row["position_cov"], found.position_covariance[i], atol=1e-9)
        np.testing.assert_allclose(row["latent_std"], found.latent_scale[i], atol=1e-5)
        assert row["rotation_std"] > 0
    assert len({row["id"] for row in rows}) == len(rows)


def test_meshes_are_in_metres() -> None:
    found = observer().observe(picture(), CAMERA, threshold=0.5)[[0]]
    blob = np.zeros((1, 32, 32, 32))
    blob[0, 8:24, 12:20, 4:28] = 1
    found = dataclasses.replace(found, voxel_mean=blob, diagonal=np.array([3.0]))
    vertices, faces = found.mesh(0)
    extent = vertices.max(0) - vertices.min(0)
    np.testing.assert_allclose(extent, 3 * np.array([16, 8, 24]) / 32, atol=3 / 32)
    assert faces.max() < len(vertices)
    unit, _ = found.mesh(0, metric=False)
    np.testing.assert_allclose(3 * unit, vertices)
    bare = dataclasses.replace(found, voxel_mean=None)
    with pytest.raises(ValueError, match="decode=True"):
        bare.mesh(0)


@pytest.mark.parametrize(
    ("image", "camera", "message"),
    [
        (np.zeros((64, 64), np.uint8), CAMERA, "an image: got"),
        (np.zeros((64, 64, 4), np.uint8), CAMERA, "an image: got"),
        (np.zeros((64, 64, 3)), CAMERA, "an image.*uint8"),
        (np.zeros((4, 64, 3), np.uint8), CAMERA, "at least 8 x 8"),
        ("a.png", CAMERA, "an image: got.*str"),
        (picture(), [1.0, 2.0, 3.0], "intrinsics: got"),
        (picture(), [0.0, 70.0, 32.0, 32.0], "positive fx, fy"),
        (picture(), [math.nan, 70.0, 32.0, 32.0], "intrinsics: got"),
    ],
)
def test_bad_images_and_intrinsics(image: Any, camera: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        observer().observe([image], camera)


def test_other_refusals() -> None:
    model = observer()
    with pytest.raises(InputError, match="intrinsics: got 3 rows, expected one for all or one for each of 2"):
        model.observe([picture(), picture()], np.ones((3, 4)))
    with pytest.raises(InputError, match="boxes: got 1 lists"):
        model.observe_boxes([picture(), picture()], CAMERA, [np.zeros((1, 4))])
    for threshold in (0.0, 1.0, -1.0, math.nan):
        with pytest.raises(InputError, match="threshold of the objectness"):
            model.observe(picture(), CAMERA, threshold=threshold)
    with pytest.raises(InputError, match="samples of the shape latent: got 1"):
        model.observe(picture(), CAMERA, threshold=0.5, samples=1)


def test_without_intrinsics_sixty_degrees_are_assumed() -> None:
    model, image = observer(), picture()
    focal = 32 / math.tan(math.radians(30))
    options: dict[str, Any] = {"threshold": 0.5, "decode": False}
    assert_same(model.observe(image, **options), model.observe(image, [focal, focal, 32, 32], **options))


@pytest.mark.parametrize("generated", [False, True])
def test_answers_say_whether_a_height_is_in_their_ranges(generated: bool) -> None:
    """In photographs it is, in generated scenes and for models that know no photographs it is not."""
    model = tiny_model(tiny_config(detector="yolox_nano"), scatter=0.3)
    assert isinstance(model.guide, HybridGuide)
    with torch.no_grad():
        model.guide.fusion.domain.weight.zero_()
        model.guide.fusion.domain.bias.fill_(30.0 if generated else -30.0)
    box = np.array([[10.0, 12.0, 50.0, 44.0]])
    (seen,) = ObservationModel(model).observe_boxes([picture()], CAMERA, [box], decode=False)
    assert seen.sized is not generated and seen[:1].sized is seen.sized
    (plain,) = observer().observe_boxes([picture()], CAMERA, [box], decode=False)
    assert plain.sized is False


def test_answers_state_the_law_of_their_positions_and_no_more_certainty_than_is_supported() -> None:
    networks = tiny_model(scatter=0.3)
    plain = ObservationModel(networks, Calibration(objectness_shift=30.0))
    careful = ObservationModel(
        networks, Calibration(objectness_shift=30.0, objectness_limit=0.9, position_dof=3.0, position_spread=0.4)
    )
    without, found = plain.observe(picture(), decode=False), careful.observe(picture(), decode=False)
    assert without.position_tails is None and np.isnan(without.detections(0).position_tails).all()
    assert found.position_tails == (3.0, 0.4)
    assert found[:1].detections(0).position_tails.tolist() == [[3.0, 0.4]]
    assert len(found) and float(without.objectness.max()) > 0.99 and float(found.objectness.max()) <= 0.9
