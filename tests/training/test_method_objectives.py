"""The compared methods: each loss by an independent computation, what each moves, what each answers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch.nn.functional import binary_cross_entropy_with_logits

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import SceneELBO, SceneLoss
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.single_object_predictor import SingleObjectModel
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.observations import Detections, read_observations, write_observations
from nolbo_ppl.models.baselines.adversary import Discriminator, adversarial_terms
from nolbo_ppl.models.baselines.method import METHODS, MethodName
from nolbo_ppl.models.baselines.single_object import BOX_SHARE, crop_objects, one_object_batch
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.posterior_calibration import CERTAIN, Calibration
from nolbo_ppl.models.scene_batch import decode_range, encode_range, unpack_bits
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.training.calibrate import about_mean, calibrate
from nolbo_ppl.training.initial_weights import adopt_features
from nolbo_ppl.training.method_objectives import AdversarialLoss, JointLoss, image_weights, shape_weights
from nolbo_ppl.training.stages import OBJECTIVES, StageRun, TrainingStage, scene_weights
from nolbo_ppl.training.train_config import TrainConfig
from tests.factories import random_batch, tiny_config, tiny_model

QUICK = OptimizerConfig(steps=3, learning_rate=1e-2, warmup=1, decay=0.0, ema=0.5)
ALL: tuple[MethodName, ...] = ("nolbo", "single", "ae", "vvae", "tlnet", "vaegan")


def terms_of(method: MethodName, *names: str) -> tuple[Nolbo, ObservedScene, dict[str, torch.Tensor]]:
    """Networks, a scene as its guide observed it, and terms of the objective."""
    config = tiny_config(method=method)
    model = tiny_model(config, scatter=0.5).eval()
    scene = model.guide.observe(random_batch(config, 2, 3))
    return model, scene, SceneELBO().terms(model.story, model.guide, scene, names=set(names))


def seen(scene: ObservedScene) -> torch.Tensor:
    return scene.assignment.assigned & scene.batch.has_voxels


def test_the_autoencoder_decodes_its_point() -> None:
    """AE: binary cross-entropy of the voxels decoded from the mean, whatever the noise; no scale, no prior."""
    model, scene, terms = terms_of("ae", "voxels")
    mask = seen(scene)
    logits = model.story.decoder(scene.posterior.shape_loc[mask])
    truth = unpack_bits(scene.batch.voxels[mask], 32).double()
    torch.testing.assert_close(-terms["voxels"], binary_cross_entropy_with_logits(logits, truth, reduction="sum"))
    assert "shape_kl" not in scene_weights("inclusive", method="ae")


@pytest.mark.parametrize("method", ["vvae", "vaegan"])
def test_the_vanilla_bound(method: MethodName) -> None:
    """vVAE: voxels at the sample, and KL(q || N(0, I)) within five standard errors of its Monte Carlo estimate."""
    model, scene, terms = terms_of(method, "voxels", "shape_kl")
    mask, q = seen(scene), scene.posterior
    assert scene.batch.noise is not None
    z = q.shape_loc[mask] + q.shape_scale[mask] * scene.batch.noise[mask]
    truth = unpack_bits(scene.batch.voxels[mask], 32).double()
    torch.testing.assert_close(-terms["voxels"], binary_cross_entropy_with_logits(model.story.decoder(z), truth, reduction="sum"))
    g = torch.Generator().manual_seed(0)
    own = torch.distributions.Normal(q.shape_loc[mask].detach(), q.shape_scale[mask].detach())
    drawn = own.loc + own.scale * torch.randn(20_000, *own.loc.shape, generator=g)
    ratio = (own.log_prob(drawn) + 0.5 * drawn.square() + 0.5 * math.log(2 * math.pi)).sum((-1, -2))
    error = float(ratio.std() / math.sqrt(len(ratio)))
    assert abs(float(ratio.mean()) + float(terms["shape_kl"].detach())) < 5 * error


def test_the_tl_network_is_drawn_to_the_shape() -> None:
    """TLNet: the gradient of its loss by the image's point is the difference to the shape's point."""
    _, scene, terms = terms_of("tlnet", "shape_inclusive")
    point = scene.posterior.shape_loc
    (gradient,) = torch.autograd.grad(-terms["shape_inclusive"], point)
    assert scene.batch.shape_loc is not None
    torch.testing.assert_close(gradient, (point - scene.batch.shape_loc) * seen(scene)[..., None])


def test_the_tl_networks_third_phase() -> None:
    """By hand: half the squared distance of the two points, weighted, and the cross-entropy of the shape's own decoded point;
    its gradient reaches both networks, and the table's older latents have no say."""
    config = tiny_config(method="tlnet")
    model, batch = tiny_model(config, scatter=0.5).eval(), random_batch(config, 2, 3)
    weights = {"shape_inclusive": 0.75}
    loss = JointLoss(SceneLoss(model.story, model.guide, SceneELBO(weights)), model, 0.01)
    assert batch.shape_loc is not None
    result = loss(batch.replace(shape_loc=batch.shape_loc + 7.0), decode=None)
    scene = model.guide.observe(batch)
    mask, known = seen(scene), batch.present & batch.has_voxels
    own, _ = model.shape_guide.posterior(batch.voxels[mask])
    distance = 0.5 * (scene.posterior.shape_loc[mask] - own).square().sum()
    every, _ = model.shape_guide.posterior(batch.voxels[known])
    truth = unpack_bits(batch.voxels[known], 32).double()
    entropy = binary_cross_entropy_with_logits(model.story.decoder(every), truth, reduction="sum")
    torch.testing.assert_close(-result.terms["shape_inclusive"], distance)
    torch.testing.assert_close(-result.terms["voxels"], entropy)
    torch.testing.assert_close(result.loss, (0.75 * distance + 0.01 * entropy) / 2)
    result.loss.backward()
    for part in (model.guide.encoder, model.shape_guide, model.story.decoder):
        assert any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in part.parameters())
    few = loss(batch, decode=1).terms["voxels"]
    first = torch.where(known, batch.decode_order, torch.inf).flatten().argmin()  # type: ignore[arg-type]
    one, _ = model.shape_guide.posterior(batch.voxels.flatten(0, 1)[first][None])
    logits = model.story.decoder(one)
    alone = binary_cross_entropy_with_logits(
        logits, unpack_bits(batch.voxels.flatten(0, 1)[first][None], 32).double(), reduction="sum"
    )
    torch.testing.assert_close(-few, int(known.sum()) * alone)
    nothing = loss(batch.replace(has_voxels=torch.zeros_like(batch.has_voxels)), decode=2)
    assert "voxels" not in nothing.terms and float(nothing.terms["shape_inclusive"].detach()) == 0.0


def test_the_third_phase_moves_both_networks() -> None:
    """Scenes leave the shape autoencoder alone, the third phase moves it; steps are those of the other methods in all."""
    config = TrainConfig(method="tlnet", scene_steps=8, single_steps=0, decode=4)
    stages = {stage.name: stage for stage in config.stages()}
    assert [stages[name].optimisation.steps for name in ("scenes", "joint")] == [6, 2]
    assert "joint" not in {stage.name for stage in TrainConfig(method="ae").stages()}
    assert [stage.name for stage in TrainConfig(method="tlnet", joint=0.0, single_steps=0).stages()] == ["shapes", "scenes"]
    model = tiny_model(tiny_config(method="tlnet"))
    for name, moved in (("scenes", set()), ("joint", {"shape_guide", "story.decoder"})):
        before = {key: value.clone() for key, value in model.named_parameters()}
        run = StageRun(model, replace(stages[name], optimisation=QUICK, freeze=3 if name == "scenes" else 0))
        losses = [run.step(random_batch(model.config, 2, 3)).loss for _ in range(3)]
        assert prefixes(model, before) == {"guide.encoder", "guide.head"} | moved and np.isfinite(losses).all()


def test_adversarial_terms() -> None:
    """By hand from the networks' own outputs, and each reaches its own network alone."""
    config = tiny_config(method="vaegan")
    model = tiny_model(config).eval()
    assert isinstance(model.discriminator, Discriminator)
    voxels = unpack_bits(random_batch(config, 1, 3).voxels[0], 32).double()
    latent = torch.randn(3, 4, generator=torch.Generator().manual_seed(1))
    terms = adversarial_terms(model.discriminator, model.story.decoder, voxels, latent)
    made = torch.sigmoid(model.story.decoder(latent))
    p_true, p_made = (torch.sigmoid(model.discriminator(x)) for x in (voxels, made))
    torch.testing.assert_close(terms["discriminator"], p_true.log().sum() + (1 - p_made).log().sum())
    torch.testing.assert_close(terms["generator"], p_made.log().sum())
    right = float(torch.cat((p_true > 0.5, p_made < 0.5)).double().mean())
    for name, own, other in (("generator", model.story.decoder, model.discriminator),
                             ("discriminator", model.discriminator, model.story.decoder)):  # fmt: skip
        model.zero_grad(set_to_none=True)
        terms[name].backward(retain_graph=True)
        learns = name == "generator" or right <= 0.8
        assert any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in own.parameters()) == learns
        assert all(p.grad is None for p in other.parameters())


def test_a_confident_discriminator_rests() -> None:
    config = tiny_config(method="vaegan")
    model = tiny_model(config).eval()
    assert model.discriminator is not None
    voxels = torch.zeros(4, 32, 32, 32)
    with torch.no_grad():  # sure of itself: an affine map of the number of occupied voxels
        for p in model.discriminator.parameters():
            p.mul_(0.0)
    bias = model.discriminator.network.dense.bias
    with torch.no_grad():
        bias[0] = 3.0  # says "true" to all: right about half of them
    terms = adversarial_terms(model.discriminator, model.story.decoder, voxels, torch.zeros(4, 4))
    terms["discriminator"].backward()
    assert float(bias.grad[0]) != 0.0
    assert float(terms["discriminator"].detach()) == pytest.approx(
        4 * math.log(1 / (1 + math.exp(-3))) + 4 * math.log(1 / (1 + math.exp(3)))
    )


def test_the_adversarial_loss_adds_its_weighted_terms() -> None:
    config = tiny_config(method="vaegan")
    model = tiny_model(config).eval()
    batch = random_batch(config, 2, 3)
    weights = scene_weights("inclusive", method="vaegan")
    run = StageRun(model, TrainingStage("scenes", QUICK, weights, decode=99))
    loss = run.state.loss
    assert isinstance(loss, AdversarialLoss)
    model.eval()
    whole, inner = loss(batch, decode=99), loss.loss(batch, decode=99)
    known = batch.has_voxels.flatten()
    voxels = unpack_bits(batch.voxels.flatten(0, 1)[known], 32).double()
    assert model.discriminator is not None and batch.noise is not None
    own = adversarial_terms(model.discriminator, model.story.decoder, voxels, batch.noise.flatten(0, 1)[known].roll(1, 0))
    expected = inner.loss - sum(weights[name] * value for name, value in own.items()) / 2
    torch.testing.assert_close(whole.loss, expected)
    assert set(whole.terms) == {*inner.terms, "generator", "discriminator"}


def prefixes(model: Nolbo, before: dict[str, torch.Tensor]) -> set[str]:
    """Parts with a parameter that is not bit-identical any more."""
    names = dict(model.named_parameters())
    moved = {name for name in names if not torch.equal(names[name], before[name])}
    return {".".join(name.split(".")[: 2 if name.startswith(("story", "guide")) else 1]) for name in moved}


@pytest.mark.parametrize("method", ALL)
def test_each_method_moves_its_parts(method: MethodName) -> None:
    """The stage of shapes moves the shape networks, that of scenes the guide, and the decoder where it learns along."""
    config, description = tiny_config(method=method), METHODS[method]
    model = tiny_model(config)
    scene = random_batch(config, 1, 4)
    assert scene.noise is not None
    shapes = ShapeBatch(scene.voxels[0], scene.category[0], scene.instance[0], scene.noise[0])
    adversary = {"discriminator"} if description.adversary else set()
    before = {name: value.clone() for name, value in model.named_parameters()}
    run = StageRun(model, TrainingStage("shapes", QUICK, shape_weights(method)))
    losses = [run.step(shapes).loss for _ in range(3)]
    prior = {"story.prior"} if description.label_prior else set()
    assert prefixes(model, before) == {"story.decoder", "shape_guide"} | prior | adversary
    assert losses[-1] < losses[0]
    before = {name: value.clone() for name, value in model.named_parameters()}
    weights = scene_weights("inclusive", method=method)
    (stage,) = (s for s in TrainConfig(method=method, scene_steps=3).stages() if s.name == "scenes")
    run = StageRun(model, TrainingStage("scenes", QUICK, weights, freeze=stage.freeze, decode=stage.decode))
    batch = random_batch(config, 2, 3)
    batch = one_object_batch(batch, 64) if description.one_object else batch
    for _ in range(3):
        run.step(batch)
    decoder = {"story.decoder"} if description.decoded else set()
    assert prefixes(model, before) == {"guide.encoder", "guide.head"} | decoder | adversary


def test_a_frozen_encoder_stays_bit_identical() -> None:
    config = tiny_config(method="ae")
    model = tiny_model(config)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    weights = scene_weights("inclusive", method="ae")
    run = StageRun(model, TrainingStage("scenes", QUICK, weights, freeze_encoder=True, decode=4))
    for _ in range(2):
        run.step(random_batch(config, 2, 3))
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert not any(name.startswith("guide.encoder") for name in changed)
    assert any(name.startswith("guide.head") for name in changed)


def test_methods_without_labels_state_none() -> None:
    """AE's label logits and azimuths are flat whatever the head says, its prior means zero, its scale one unit."""
    model, scene, _ = terms_of("ae", "voxels")
    q = scene.posterior
    assert not bool(q.label_logits.any()) and not bool(q.azimuth_natural.any()) and not bool(q.azimuth_logits.any())
    assert not bool(model.story.prior.label_mean().any())
    torch.testing.assert_close(q.shape_scale, torch.ones_like(q.shape_scale))
    assert "label_inclusive" not in scene_weights("inclusive", method="ae")
    assert not any(name.startswith("objectness") for name in image_weights("single", OBJECTIVES["inclusive"]))


@pytest.mark.parametrize("method", ALL)
def test_answers_are_observations(method: MethodName, tmp_path: Path) -> None:
    """What each method answers is written as observations and read back: latents of all, categories of those that state them."""
    torch.set_default_dtype(torch.float32)
    config = tiny_config(method=method)
    model = Nolbo.from_seed(config, 0)
    seen: ObservationModel = ObservationModel(model)
    if METHODS[method].one_object:
        seen = SingleObjectModel(model, None, ObservationModel(Nolbo.from_seed(tiny_config(), 1)))
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    boxes = np.array([[10.0, 12.0, 50.0, 44.0], [55.0, 5.0, 90.0, 60.0]])
    (answer,) = seen.observe_boxes([image], [80.0, 80.0, 48.0, 32.0], [boxes])
    assert answer.voxel_mean is not None and answer.voxel_mean.shape == (2, 32, 32, 32)
    table = answer.detections(3, "image.png")
    write_observations(tmp_path / "observations.jsonl", table)
    back = read_observations(tmp_path / "observations.jsonl")
    np.testing.assert_array_equal(back.latent, table.latent)
    np.testing.assert_array_equal(back.position, table.position)
    describes = METHODS[method].describes
    assert bool(back.has_rotation.all()) == bool(back.has_rotation.any()) == describes
    assert all((name is not None) == describes for name in back.category)
    assert all((name in config.categories) == describes for name in answer.category)
    assert len(Detections.concatenate([table, back])) == 4
    everything = seen.observe([image], [80.0, 80.0, 48.0, 32.0], threshold=1e-6, decode=False)
    assert len(everything[0])


def test_a_crop_is_a_camera() -> None:
    """Points before the camera project into the crop, by its intrinsics, where their pixels of the image lie in it."""
    g = torch.Generator().manual_seed(3)
    image = 255 * torch.rand(2, 3, 64, 96, generator=g)
    box = torch.tensor([[10.0, 12.0, 50.0, 44.0], [55.0, 5.0, 90.0, 60.0], [30.0, 30.0, 44.0, 60.0]])
    row, camera = torch.tensor([0, 1, 1]), torch.tensor([80.0, 90.0, 48.0, 30.0]).expand(3, 4)
    crops = crop_objects(image, row, box, 64)
    local = crops.into(box)
    torch.testing.assert_close((local[:, 2:] - local[:, :2]).amax(-1), torch.full((3,), BOX_SHARE * 64))
    torch.testing.assert_close((local[:, 2:] + local[:, :2]) / 2, torch.full((3, 2), 32.0))
    torch.testing.assert_close(crops.back(local), box)
    point = torch.rand(3, 3, generator=g) * torch.tensor([1.0, 1.0, 4.0]) + torch.tensor([0.0, 0.0, 2.0])
    own = crops.camera(camera)
    pixel = point[:, :2] / point[:, 2:] * camera[:, :2] + camera[:, 2:]
    seen = point[:, :2] / point[:, 2:] * own[:, :2] + own[:, 2:]
    torch.testing.assert_close(seen, crops.into(pixel.repeat(1, 2))[:, :2])
    config = tiny_config()
    z = encode_range(point, torch.ones(3), local, own, config)
    torch.testing.assert_close(decode_range(z, local, own, config)[0], point)


def test_crops_hold_the_pixels_of_the_image() -> None:
    """A flat patch of one colour about a box fills its crop with that colour; another colour elsewhere does not enter."""
    image = torch.zeros(1, 3, 96, 96)
    image[:, 0, 20:76, 20:76] = 200.0
    crops = crop_objects(image, torch.tensor([0]), torch.tensor([[36.0, 36.0, 60.0, 60.0]]), 64)
    torch.testing.assert_close(crops.image[:, 0], torch.full((1, 64, 64), 200.0))
    assert not bool(crops.image[:, 1:].any())


def test_one_object_of_a_scene() -> None:
    config = tiny_config()
    batch = random_batch(config, 3, 4, objects=3)
    assert batch.decode_order is not None
    single = one_object_batch(batch, 64)
    slot = torch.where(batch.present, batch.decode_order, 9.0).argmin(1)
    rows = torch.arange(3)
    torch.testing.assert_close(single.category[:, 0], batch.category[rows, slot])
    torch.testing.assert_close(single.position[:, 0], batch.position[rows, slot])
    torch.testing.assert_close(single.viewpoint[:, 0], batch.viewpoint[rows, slot])
    assert single.image.shape == (3, 3, 64, 64) and single.noise is not None and single.noise.shape == (3, 1, 4)
    largest = one_object_batch(batch.replace(decode_order=None), 64)
    area = (batch.box[..., 2:] - batch.box[..., :2]).prod(-1)
    torch.testing.assert_close(largest.category[:, 0], batch.category[rows, area.argmax(1)])
    none = one_object_batch(batch.replace(present=torch.zeros_like(batch.present)), 64)
    assert not bool(none.present.any())


def test_boxes_of_single_objects_are_those_of_the_image() -> None:
    """The answer's box lies where the crop's own box lies in the image; its position does not depend on the crop's pixels."""
    torch.set_default_dtype(torch.float32)
    config = tiny_config(method="single")
    model = Nolbo.from_seed(config, 0)
    seen = SingleObjectModel(model, None, ObservationModel(Nolbo.from_seed(tiny_config(), 1)))
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    box = np.array([[10.0, 12.0, 50.0, 44.0]])
    (answer,) = seen.observe_boxes([image], [80.0, 80.0, 48.0, 32.0], [box], decode=False)
    pixels = torch.from_numpy(image.transpose(2, 0, 1).copy())[None].float()
    crops = crop_objects(pixels, torch.tensor([0]), torch.from_numpy(box).float(), 64)
    own = ObservationModel(model)
    camera = crops.camera(torch.tensor([[80.0, 80.0, 48.0, 32.0]]))[0].numpy()
    (there,) = own.observe_boxes([crops.image[0].to(torch.uint8)], camera, [crops.into(torch.from_numpy(box).float()).numpy()],
                                 decode=False)  # fmt: skip
    np.testing.assert_allclose(answer.box, crops.back(torch.from_numpy(there.box).float()).numpy(), atol=0.5)
    np.testing.assert_allclose(answer.position, there.position, rtol=0.02, atol=0.02)
    (none,) = seen.observe_boxes([image], [80.0, 80.0, 48.0, 32.0], [np.zeros((0, 4))], decode=False)
    assert len(none) == 0
    many = box + np.arange(6)[:, None]
    (few,), (all_at_once,) = (seen.observe_boxes([image], [80.0, 80.0, 48.0, 32.0], [many], batch=batch) for batch in (1, 16))
    np.testing.assert_allclose(few.latent, all_at_once.latent, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(few.viewpoint_modes.azimuth, all_at_once.viewpoint_modes.azimuth, rtol=1e-3, atol=1e-3)
    assert few.voxel_mean is not None and all_at_once.voxel_mean is not None  # samples do not depend on the batch either
    np.testing.assert_allclose(few.voxel_mean, all_at_once.voxel_mean, rtol=1e-3, atol=1e-3)


def test_single_objects_are_as_certain_as_the_detector_and_bad_images_are_refused() -> None:
    """No head of this model says where objects are, so its own limit of certainty has no say."""
    torch.set_default_dtype(torch.float32)
    model = Nolbo.from_seed(tiny_config(method="single"), 0)
    detector = ObservationModel(Nolbo.from_seed(tiny_config(), 1))
    seen = SingleObjectModel(model, Calibration(objectness_limit=0.5), detector)
    image, camera = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8), [80.0, 80.0, 48.0, 32.0]
    found, own = (one.observe(image, camera, threshold=1e-3, decode=False) for one in (seen, detector))
    assert len(found) > 0
    np.testing.assert_allclose(found.objectness, own.objectness)
    box = [np.array([[10.0, 12.0, 50.0, 44.0]])]
    (given,) = seen.observe_boxes([image], camera, box, decode=False)
    assert given.objectness == pytest.approx([CERTAIN])
    for picture, lens in ((image.astype(float), camera), (image[..., 0], camera), (image, [0.0, 80.0, 48.0, 32.0])):
        with pytest.raises(InputError, match=r"an image|intrinsics"):
            seen.observe_boxes([picture], lens, box)


def test_scatter_about_the_mean_of_views() -> None:
    """Deviations from group means have the variance of a single view; lone views and unknown shapes say nothing."""
    g = torch.Generator().manual_seed(5)
    group = torch.randint(-1, 4000, (12_000,), generator=g)
    value = 3.0 * torch.randn(4000, 2, generator=g)[group.clamp_min(0)] + 0.7 * torch.randn(12_000, 2, generator=g)
    found = about_mean(value, group)
    _, count = torch.unique(group[group >= 0], return_counts=True)
    assert len(found) == int(count[count > 1].sum())
    assert float(found.var()) == pytest.approx(0.49, rel=0.05)


def test_features_are_adopted() -> None:
    initial = tiny_model(tiny_config(), seed=4)
    model = tiny_model(tiny_config(method="vvae", latent_dim=6), seed=5)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    adopt_features(model, initial)
    now, given = model.state_dict(), initial.state_dict()
    for name in now:
        features = name.startswith(("guide.encoder.", "story.decoder.layers.", "shape_guide.encoder.layers."))
        torch.testing.assert_close(now[name], given[name] if features else before[name])
    with pytest.raises(InputError, match="features of the initial weights"):
        adopt_features(model, tiny_model(tiny_config(encoder_channels=(4, 6, 8, 16))))


def test_options_of_methods() -> None:
    assert TrainConfig(method="ae").model() == ModelConfig(**{**TrainConfig().model().__dict__, "method": "ae"})
    assert TrainConfig().identity().keys().isdisjoint({"method", "initial_part", "freeze_encoder"})
    assert TrainConfig(method="ae").identity()["method"] == "ae"
    with pytest.raises(InputError, match="initial_part"):
        TrainConfig(initial_part="features")
    with pytest.raises(InputError, match="initial weights of another method"):
        TrainConfig(method="ae", initial="tiny").model()
    assert TrainConfig(method="ae", initial="tiny", initial_part="features", latent_dim=8).model().latent_dim == 8
    with pytest.raises(InputError, match="method 'ae'"):
        tiny_config(method="ae", instances=("a",), instance_category=(0,))
    with pytest.raises(InputError, match="method: got 'gan'"):
        tiny_config(method="gan")
    with pytest.raises(InputError, match="method"):
        ModelConfig.from_json({"method": "gan"})


@pytest.mark.parametrize("method", ALL)
def test_every_method_is_calibrated(method: MethodName) -> None:
    """Factors are found for each; where nothing but a shape's views says where its latent lies, by their scatter."""
    config = tiny_config(method=method)
    model = tiny_model(config, scatter=0.3)
    batch = random_batch(config, 25, 3)
    if METHODS[method].one_object:
        batch = one_object_batch(random_batch(config, 60, 1), 64)
    shape = torch.arange(batch.present.numel()).reshape(batch.present.shape) % 10
    batch = batch.replace(shape_index=shape)
    found = calibrate(model, [batch])
    assert found.shape_scale > 0 and found.box_scale > 0
    if METHODS[method].decoded:
        with torch.no_grad():
            scene = model.eval().guide.observe(batch)
        q = scene.posterior.at_map_category(model.story.prior.label_mean())
        mask = scene.assignment.assigned & batch.has_voxels
        z = (q.shape_loc / q.shape_scale)[mask].detach()
        scatter = torch.cat([z[shape[mask] == k] - z[shape[mask] == k].mean(0) for k in range(10)])
        count = torch.cat([(shape[mask] == k).sum().repeat(int((shape[mask] == k).sum())) for k in range(10)])
        squared = (scatter.square() * (count / (count - 1))[:, None]).sum(-1)
        expected = float(torch.sqrt(torch.quantile(squared, 0.9) / chi2.ppf(0.9, config.latent_dim)))
        assert found.shape_scale == pytest.approx(expected)
        assert found.shape_correlation == 0.0
