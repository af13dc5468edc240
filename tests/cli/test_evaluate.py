"""Evaluation against oracles whose errors are known: a model that knows the truth and answers with chosen faults."""

import dataclasses
import json
import math
import shutil
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY
from nolbo_ppl.cli import evaluate
from nolbo_ppl.cli.evaluate import EvaluateConfig, measure, metrics, open_scenes, table
from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.labelled_scenes import FolderScenes
from nolbo_ppl.evaluation.measure import measure_detections, measure_objects
from nolbo_ppl.evaluation.model_evaluation import SEED
from nolbo_ppl.evaluation.scores import REQUIRED, confusion, flipped
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.geometry.voxels import pack_voxels, unpack_voxels, voxel_centres
from nolbo_ppl.metrics.detection import match
from nolbo_ppl.metrics.intervals import IntervalEstimate
from nolbo_ppl.models.model_config import tiny
from nolbo_ppl.structures.annotations import ARRAYS, Annotations
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes
from nolbo_ppl.viz.example_plots import badness

LABELS = len(CATEGORIES)
SYMMETRY = np.array(list(CATEGORY_SYMMETRY.values()))
V = 16
"""Voxels along the side of the test shapes."""
CAMERA = np.array([200.0, 200.0, 64.0, 64.0])


def ellipsoids(rng, n, v=V):
    """Solid shapes of random proportions."""
    half = rng.uniform(0.15, 0.45, (n, 3))
    x, y, z = np.meshgrid(*[voxel_centres(v)] * 3, indexing="ij")
    return ((np.stack((x, y, z), -1) / half[:, None, None, None]) ** 2).sum(-1) < 1


def egocentric(viewpoint, position):
    R = viewpoint_to_matrix(torch.from_numpy(viewpoint))
    return allocentric_to_egocentric(R, torch.from_numpy(position)).numpy()


def made_scenes(count, seed=0, objects=4):
    """Scenes of objects that do not overlap; the image only tells scenes apart."""
    rng = np.random.default_rng(seed)
    scenes, viewpoints = [], []
    for _ in range(count):
        corner = np.stack((32.0 * np.arange(objects), np.full(objects, 40.0)), 1) + rng.uniform(0, 4, (objects, 2))
        box = np.concatenate((corner, corner + rng.uniform(16, 26, (objects, 2))), 1)
        category = rng.integers(LABELS, size=objects)
        middle = (box[:, :2] + box[:, 2:]) / 2
        depth = rng.uniform(2, 20, objects)
        position = np.concatenate(((middle - CAMERA[2:]) / CAMERA[:2], np.ones((objects, 1))), 1) * depth[:, None]
        viewpoint = rng.uniform([-math.pi, -0.1, -0.1], [math.pi, 0.8, 0.1], (objects, 3))
        viewpoints.append(viewpoint)
        scenes.append(
            Annotations.from_arrays(
                pixels=rng.integers(0, 256, (64, 64, 3), dtype=np.uint8),
                intrinsics=CAMERA,
                box=box,
                category=[CATEGORIES[label] for label in category],
                R_camera_object=egocentric(viewpoint, position),
                position=position,
                symmetry=SYMMETRY[category],
                voxels=pack_voxels(ellipsoids(rng, objects)),
                diagonal=np.ones(objects),
            )
        )
    return scenes, viewpoints


class Oracle:
    """A model that has seen the answers; `spoil` changes what it says about the objects of a scene."""

    def __init__(self, scenes, viewpoints, seed=0, scale=0.05, kappa=30.0, spoil=lambda said, *_: said, false=False):
        self.config = tiny()
        rng = self.rng = np.random.default_rng(seed)
        grids = ellipsoids(rng, 64).reshape(-1, V**3).astype(float)
        self.mean = grids.mean(0)
        self.basis = np.linalg.svd(grids - self.mean, full_matrices=False)[2][: self.config.latent_dim]
        self.answers = {}
        for scene, viewpoint in zip(scenes, viewpoints):
            said = self.answer(scene, viewpoint, scale, kappa)
            self.answers[scene.image.tobytes()] = (scene, spoil(said, scene, rng))
        self.false = false

    def answer(self, scene, viewpoint, scale, kappa):
        """Draws such that the truth is one draw of the posterior that is returned."""
        rng, n, d = self.rng, len(scene.box), self.config.latent_dim
        offsets, weights = np.array([0.0, math.pi, 1.0, -1.5]), np.array([0.6, 0.2, 0.1, 0.1])
        component = rng.choice(4, n, p=weights)
        draw = offsets[component] + rng.vonmises(0, kappa, n)
        mean = viewpoint[:, 0] - draw  # the truth is `mean` plus a draw of the mixture
        tilt = viewpoint[:, 1:] + 0.1 * rng.normal(size=(n, 2))
        factor = rng.normal(size=(n, 3, 3))
        covariance = scale**2 * (factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(3))
        position = scene.position + (np.linalg.cholesky(covariance) @ rng.normal(size=(n, 3, 1)))[..., 0]
        teacher, _ = self.shape_posterior(scene.voxels)
        latent_scale = rng.uniform(0.5, 2.0, (n, d))
        probability = rng.dirichlet(np.full(LABELS, 0.15), n)
        for i, true in enumerate(scene.labels(CATEGORIES)):  # the true label is a draw of the posterior
            drawn = rng.choice(LABELS, p=probability[i])
            probability[i, [drawn, true]] = probability[i, [true, drawn]]
        likelihood = np.where(np.arange(LABELS) == scene.labels(CATEGORIES)[:, None], 0.0, -10.0)
        best = np.stack((mean, *tilt.T), 1)
        return ObjectPosteriors(
            categories=CATEGORIES,
            objectness=rng.uniform(0.1, 1, n),
            box=scene.box.copy(),
            box_scale=np.ones((n, 4)),
            class_log_posterior=np.log(np.maximum(probability, 1e-12)),
            class_log_likelihood=likelihood,
            instance_log_posterior=None,
            latent=teacher + latent_scale * rng.normal(size=(n, d)),
            latent_scale=latent_scale,
            position=position,
            position_covariance=covariance,
            viewpoint_modes=ViewpointModes(np.tile(weights, (n, 1)), mean[:, None] + offsets, np.full((n, 4), kappa)),
            elevation_inplane=tilt,
            elevation_inplane_scale=np.full((n, 2), 0.1),
            viewpoint=best,
            R_camera_object=egocentric(best, position),
            rotation_scale=np.full(n, 0.1),
            diagonal=np.ones(n),
            diagonal_log_scale=np.full(n, 0.1),
            size=np.full((n, 3), 0.6),
            voxel_mean=None,
            voxel_variance=None,
        )

    def observe(self, images, intrinsics, *, threshold, decode, batch):
        found = []
        for image in images:
            _, said = self.answers[image.tobytes()]
            right = self.rng.random(len(said)) < said.objectness if self.false else np.ones(len(said), dtype=bool)
            # Where it is wrong, it sees the object below the picture, where there is none.
            box = np.where(right[:, None], said.box, said.box + np.array([0, 300.0, 0, 300.0]))
            found.append(dataclasses.replace(said, box=box))
        return found

    def observe_boxes(self, images, intrinsics, boxes, *, decode=True, batch=16):
        answers = []
        for image, wanted in zip(images, boxes):
            scene, said = self.answers[image.tobytes()]
            slots = [int(np.flatnonzero((scene.box == box).all(1))[0]) for box in wanted]
            one = said[slots]
            if decode:
                occupancy = self.decode(one.latent)
                one = dataclasses.replace(one, voxel_mean=occupancy, voxel_variance=occupancy * (1 - occupancy))
            answers.append(one)
        return answers

    def decode(self, latent):
        return np.clip(self.mean + latent @ self.basis, 0, 1).reshape(-1, V, V, V)

    def shape_posterior(self, packed):
        grids = unpack_voxels(packed, V).reshape(-1, V**3).astype(float)
        latent = (grids - self.mean) @ self.basis.T
        return latent, np.full(latent.shape, 0.1)

    def prior_mean(self):
        return np.zeros((LABELS, self.config.latent_dim))


def exactly(said, scene, rng, viewpoints):
    """Everything right and certain."""
    viewpoint = viewpoints[scene.image.tobytes()]
    n = len(scene.box)
    certain = np.where(np.arange(LABELS) == scene.labels(CATEGORIES)[:, None], 0.0, -30.0)
    return dataclasses.replace(
        said,
        objectness=np.ones(n),
        class_log_posterior=certain,
        viewpoint=viewpoint,
        position=scene.position,
        R_camera_object=scene.R_camera_object,
        elevation_inplane=viewpoint[:, 1:],
        viewpoint_modes=ViewpointModes(np.ones((n, 1)), viewpoint[:, :1], np.full((n, 1), 200.0)),
    )


def exact_oracle(scenes, viewpoints, change=lambda said, scene, k: said):
    table = {scene.image.tobytes(): (v, k) for k, (scene, v) in enumerate(zip(scenes, viewpoints))}
    only = {key: v for key, (v, _) in table.items()}
    model = Oracle(
        scenes,
        viewpoints,
        spoil=lambda said, scene, rng: change(exactly(said, scene, rng, only), scene, table[scene.image.tobytes()][1]),
    )
    for scene, said in model.answers.values():
        said.latent[:] = model.shape_posterior(scene.voxels)[0]
    return model


def config(**changes):
    return EvaluateConfig(out="unused", **{"resamples": 40, "pictures": False, "batch": 16, **changes})


def test_exact_answers_score_perfectly():
    scenes, viewpoints = made_scenes(24)
    result = measure(config(), exact_oracle(scenes, viewpoints), scenes)
    value = {name: one.value for name, one in result.figures.items()}
    for name in (
        "ap50",
        "map50",
        "category_accuracy",
        "acc_pi6",
        "acc_pi6_all",
        "coverage90_orientation",
        "coverage90_position",
        "coverage90_latent",
        "coverage90_tilt",
    ):
        assert value[name] == 1.0, name
    assert value["med_err_deg"] == pytest.approx(0, abs=1e-6)
    assert value["ece_objectness"] == pytest.approx(0, abs=1e-12) and value["ece_class"] == pytest.approx(0, abs=1e-9)
    assert value["voxel_iou"] == value["voxel_iou_ceiling"]
    assert value["median_range_error"] == pytest.approx(0, abs=1e-12)


def test_voxel_figures_are_those_of_the_decoder():
    scenes, viewpoints = made_scenes(6)
    model = exact_oracle(scenes, viewpoints)
    result = measure(config(), model, scenes)
    truth = unpack_voxels(np.concatenate([s.voxels for s in scenes]), V)
    decoded = model.decode(model.shape_posterior(np.concatenate([s.voxels for s in scenes]))[0]) > 0.5
    prior = model.decode(model.prior_mean())[0] > 0.5

    def iou(a):
        return np.mean([(x & y).sum() / (x | y).sum() for x, y in zip(np.broadcast_to(a, truth.shape), truth)])

    assert result.figures["voxel_iou"].value == pytest.approx(iou(decoded), abs=1e-12)
    assert result.figures["voxel_iou_gain"].value == pytest.approx(iou(decoded) - iou(prior), abs=1e-12)


def test_known_faults_give_known_figures():
    """Every fourth scene: azimuth turned by pi for all, category of the first object wrong, one box lost of four."""
    scenes, viewpoints = made_scenes(40)

    def change(said, scene, k):
        if k % 4:
            return said
        turned = said.viewpoint + np.array([math.pi, 0, 0])
        likelihood = said.class_log_likelihood.copy()
        likelihood[0, (scene.labels(CATEGORIES)[0] + 1) % LABELS] = 5.0
        box = said.box.copy()
        box[3] += 400.0
        return dataclasses.replace(
            said,
            viewpoint=turned,
            R_camera_object=egocentric(turned, scene.position),
            box=box,
            class_log_likelihood=likelihood,
            objectness=np.array([1, 1, 1, 0.2]),
        )

    result = measure(config(), exact_oracle(scenes, viewpoints, change), scenes)
    category = np.concatenate([s.labels(CATEGORIES) for s in scenes])
    spoilt = np.repeat(np.arange(40) % 4 == 0, 4)
    by_category = [1 - spoilt[category == c].mean() for c in range(LABELS) if (category == c).any()]
    plain = [1 - spoilt[category == c].mean() for c in range(LABELS) if (category == c).any() and SYMMETRY[c] == 1]
    free = [1.0 if SYMMETRY[c] == 0 else share for c, share in enumerate(by_category)]
    value = {name: one.value for name, one in result.figures.items()}
    assert value["acc_pi6"] == pytest.approx(np.mean(plain), abs=1e-12)
    assert value["acc_pi6_all"] == pytest.approx(np.mean(free), abs=1e-12)  # a turn costs a free axis nothing
    assert value["category_accuracy"] == pytest.approx(150 / 160, abs=1e-12)
    assert value["ap50"] == pytest.approx(150 / 160, abs=1e-12)  # the lost boxes come last
    assert value["ece_objectness"] == pytest.approx(10 * 0.2 / 160, abs=1e-12)
    assert np.nanmean(flipped(result.objects)) == pytest.approx(spoilt[SYMMETRY[category] == 1].mean(), abs=1e-12)
    matrix = confusion(result.objects, LABELS)
    assert matrix.sum() == 160 and np.trace(matrix) == 150
    worst = np.argsort(-badness(result.objects))[: spoilt.sum() // 2]
    assert spoilt[worst].all()


def test_coverage_of_exact_posteriors_is_nominal():
    """Truths drawn from the posteriors: every region covers as stated, and probabilities come true."""
    scenes, viewpoints = made_scenes(400, seed=1)
    result = measure(config(), Oracle(scenes, viewpoints, false=True), scenes)
    for name in ("orientation", "tilt", "position", "latent"):
        figure = result.figures[f"coverage90_{name}"]
        assert figure.value == pytest.approx(0.9, abs=5 * math.sqrt(0.09 / figure.count)), name
        for level in (50, 68, 95, 99):
            value, p = result.figures[f"coverage{level}_{name}"], level / 100
            assert value.value == pytest.approx(p, abs=5 * math.sqrt(p * (1 - p) / value.count)), (level, name)
    regions = metrics(result, config())["calibration"]["regions"]
    assert all(regions[name]["distance_from_uniform"] < 0.05 for name in ("tilt", "position", "latent"))
    plain, tails = (result.figures[f"{name}_log_score"].value for name in ("position", "position_tails"))
    assert tails == pytest.approx(plain, abs=0.01)  # nobody fitted tails: Gaussian
    for name in ("class", "objectness"):
        perfect = result.figures[f"ece_{name}_if_perfect"]
        assert perfect.low < result.figures[f"ece_{name}"].value < 1.5 * perfect.high
        assert result.figures[f"ece_{name}_debiased"].value < 0.03
    # A calibrated forecast has an expected calibration error of about 0.3 sqrt(bins / n), 0.03 here.
    assert result.figures["ece_class"].value < 0.04 and result.figures["ece_objectness"].value < 0.04
    # The log score of truths drawn from the mixture is its entropy: -sum w log(w f) for modes that hardly overlap.
    entropy = 0.5 * math.log(2 * math.pi * math.e / 30.0) - sum(w * math.log(w) for w in (0.6, 0.2, 0.1, 0.1))
    assert result.figures["azimuth_log_score"].value == pytest.approx(entropy, abs=0.12)


def test_overconfidence_shows():
    scenes, viewpoints = made_scenes(60, seed=2)

    def spoil(said, scene, rng):
        sharp = 4 * said.class_log_posterior
        return dataclasses.replace(
            said,
            position_covariance=said.position_covariance / 16,
            class_log_posterior=sharp,
            latent_scale=said.latent_scale / 2,
            objectness=np.sqrt(said.objectness),
        )

    value = {k: v.value for k, v in measure(config(), Oracle(scenes, viewpoints, spoil=spoil), scenes).figures.items()}
    assert value["coverage90_position"] < 0.4 and value["coverage90_latent"] < 0.2 and value["ece_class"] > 0.1
    assert value["coverage99_position"] < 0.6 and value["ece_class_debiased"] > 0.08 > value["ece_class_if_perfect"]


def test_small_and_hidden_objects_do_not_count():
    scenes, viewpoints = made_scenes(10)
    hidden = []
    for scene in scenes:
        box, visibility = scene.box.copy(), scene.visibility.copy()
        box[0, 2:] = box[0, :2] + 11.9
        visibility[1] = 0.49
        hidden.append(dataclasses.replace(scene, box=box, visibility=visibility))
    result = measure(config(), exact_oracle(hidden, viewpoints), hidden)
    assert len(result.objects) == 20 and set(result.objects.slot) == {2, 3}
    # Everything is found, what does not count included, and none of that is held against the model.
    assert result.figures["ap50"] == IntervalEstimate(1.0, 1.0, 1.0, 20)
    assert result.detections.all.ignored.sum() == 20


def test_the_true_size_corrects_the_depth():
    """Everything is seen twice as far and 1.6 times as large: the known size leaves a quarter of the distance too much."""
    scenes, viewpoints = made_scenes(10)

    def change(said, scene, k):
        return dataclasses.replace(said, position=2 * said.position, diagonal=1.6 * said.diagonal)

    result = measure(config(), exact_oracle(scenes, viewpoints, change), scenes)
    assert result.figures["median_depth_error"].value == pytest.approx(1.0)
    assert result.figures["median_depth_error_known_size"].value == pytest.approx(0.25)
    unknown = [dataclasses.replace(scene, diagonal=np.full(4, np.nan)) for scene in scenes]
    result = measure(config(), exact_oracle(scenes, viewpoints, change), unknown)
    assert result.figures["median_depth_error_known_size"].count == 0
    assert result.figures["median_depth_error_known_size"].value is None


def test_azimuth_alone():
    """A tilt of 40 degrees spoils the viewpoint and leaves the azimuth right."""
    scenes, viewpoints = made_scenes(10)

    def change(said, scene, k):
        tilted = said.viewpoint + np.array([0, math.radians(40), 0])
        return dataclasses.replace(said, viewpoint=tilted, R_camera_object=egocentric(tilted, scene.position))

    result = measure(config(), exact_oracle(scenes, viewpoints, change), scenes)
    assert result.figures["acc_pi6"].value == 0.0 and result.figures["azimuth_acc_pi6"].value == 1.0


def test_detections_in_regions_to_ignore_are_not_judged():
    """A false detection halves the precision, unless the picture is unlabelled there."""
    scenes, viewpoints = made_scenes(10)

    model = exact_oracle(scenes, viewpoints)
    right = model.observe

    def observe(images, intrinsics, **options):
        found = [one[[0, 1, 2, 3, 0, 1, 2, 3]] for one in right(images, intrinsics, **options)]
        for one in found:
            one.box[4:] += np.array([0, 200.0, 0, 200.0])
        return found

    model.observe = observe
    plain = measure(config(), model, scenes).figures["ap50"].value
    assert plain == pytest.approx(0.5, abs=0.01)
    region = np.array([[0.0, 230.0, 200.0, 400.0]])
    masked = [dataclasses.replace(scene, ignore=region) for scene in scenes]
    result = measure(config(), model, masked)
    assert result.figures["ap50"].value == 1.0 and result.detections.all.ignored.sum() == 40
    assert result.figures["map50"].value == 1.0


@pytest.mark.parametrize("share", [0.49, 0.51])
def test_a_region_takes_what_lies_half_in_it(share):
    box = np.array([[0.0, 0, 100, 50]])
    region = np.array([[100 * (1 - share), -20, 500, 300.0]])
    found = match([box], [np.ones(1)], [np.zeros((0, 4))], [np.zeros(0, dtype=bool)], regions=[region])
    assert found.ignored.tolist() == [share > 0.5]


def test_retrieval_takes_the_latents_at_the_true_boxes():
    """An oracle that answers with the shape's own latent finds every instance; one that answers with nothing, none."""
    from nolbo_ppl.evaluation.instance_views import InstanceViews
    from nolbo_ppl.synthetic.scenes.scene_config import preset
    from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

    views = InstanceViews(SceneGenerator(dataclasses.replace(preset("easy", 64), categories=("car", "chair"))), 3, CATEGORIES)
    truth = {view.image.tobytes(): view.voxels for instance in views.instances for view in views.pair(*instance)}
    model = Oracle([], [])

    def own(image):  # a latent of its own for each shape
        return np.random.default_rng(zlib.crc32(truth[image.tobytes()].tobytes())).normal(size=16)

    def answers(latent):
        def observe_boxes(images, intrinsics, boxes, *, decode, batch):
            assert len(images) == len(intrinsics) == len(boxes) and all(len(box) == 1 for box in boxes) and not decode
            return [SimpleNamespace(latent=latent(image)[None], latent_scale=np.full((1, 16), 0.1)) for image in images]

        return observe_boxes

    model.observe_boxes = answers(own)
    found = evaluate.measure_retrieval(config(batch=4), model, views)
    assert len(found) == 6 and (found.gallery == 3).all() and all((rank == 1).all() for rank in found.rank.values())
    model.observe_boxes = answers(lambda image: np.zeros(16))
    found = evaluate.measure_retrieval(config(batch=4), model, views)
    assert all((rank == 3).all() for rank in found.rank.values())
    lone = InstanceViews(views.source, 1, ("boat",))
    with pytest.raises(InputError, match="instances to find again"):
        evaluate.measure_retrieval(config(), model, lone)


def test_missing_labels_are_left_out():
    scenes, viewpoints = made_scenes(12)
    partly = []
    for scene in scenes:
        part = dataclasses.replace(
            scene,
            R_camera_object=scene.R_camera_object.copy(),
            position=scene.position.copy(),
            category=(*scene.category[:2], None, *scene.category[3:]),
            voxels=scene.voxels.copy(),
        )
        part.R_camera_object[0], part.position[1], part.voxels[3] = np.nan, np.nan, 0
        partly.append(part)
    model = exact_oracle(scenes, viewpoints)
    result = measure(config(), model, partly)
    counts = {name: one.count for name, one in result.figures.items()}
    assert counts["ap50"] == 48 and counts["category_accuracy"] == 36 and counts["map50"] == 36
    assert counts["coverage90_position"] == 36 and counts["voxel_iou"] == 36 and counts["voxel_iou_gain"] == 24
    assert result.figures["map50"].value == 1.0  # a detection of an unlabelled object is not held against it
    json.dumps(metrics(result, config()), allow_nan=False)


def test_metrics_hold_every_key_and_nothing_that_json_lacks():
    scenes, viewpoints = made_scenes(8)
    result = measure(config(), Oracle(scenes, viewpoints), scenes)
    values = json.loads(json.dumps(metrics(result, config()), allow_nan=False))
    for part in (values, values["intervals"], values["counts"]):
        assert set(REQUIRED) <= set(part)
    for name in REQUIRED:
        low, high = values["intervals"][name]
        assert low >= 0 and low <= high and (low <= values[name] <= high or name.startswith("ece")), name
    assert set(values["by_category"]) == set(CATEGORIES)
    assert values["configuration"]["count"] == 500 and values["versions"]["numpy"]
    text = table(result)
    assert all(name in text for name in (*REQUIRED, *CATEGORIES))


def test_intervals_depend_on_the_seed_alone():
    scenes, viewpoints = made_scenes(8)
    one, two = (metrics(measure(config(), Oracle(scenes, viewpoints), scenes), config()) for _ in range(2))
    assert one == two


def test_category_detection_by_its_own_score():
    box = np.array([[0, 0, 20, 20], [40, 0, 60, 20.0]])
    posterior = np.array([[0.9, 0.1, 0.0], [0.2, 0.0, 0.8]])
    records = measure_detections(
        [box], [np.array([0, 1])], [np.ones(2, dtype=bool)], [(box, np.array([0.5, 1.0]), posterior)], labels=3
    )
    assert records.all.correct.all()
    assert records.by_category[0].correct.tolist() == [True] and records.by_category[0].score[0] == pytest.approx(0.45)
    assert len(records.by_category[1].score) == 0 and records.by_category[1].truths.sum() == 1
    assert records.by_category[2].correct.tolist() == [False]  # a box of category 1 taken for category 2


def test_coarser_truth_is_compared_at_its_own_resolution():
    scenes, viewpoints = made_scenes(3)
    model = exact_oracle(scenes, viewpoints)
    coarse = [dataclasses.replace(s, voxels=pack_voxels(ellipsoids(np.random.default_rng(5), 4, v=8))) for s in scenes]
    slots = [np.arange(4)] * 3
    answers = model.observe_boxes([s.image for s in scenes], None, [s.box for s in scenes])
    records = measure_objects(coarse, answers, slots, range(3), model)
    assert np.isfinite(records.voxel_iou).all()
    odd = [dataclasses.replace(s, voxels=pack_voxels(ellipsoids(np.random.default_rng(5), 4, v=12))) for s in scenes]
    with pytest.raises(InputError, match=r"voxel grids.*12\^3 for a model of 16\^3"):
        measure_objects(odd, answers, slots, range(3), model)


def test_errors():
    scenes, viewpoints = made_scenes(2)
    model = Oracle(scenes, viewpoints)
    with pytest.raises(InputError, match=r"no object to evaluate on.*99\.0 px"):
        measure(config(least_side=99.0), model, scenes)
    with pytest.raises(InputError, match=r"number of scenes.*0"):
        open_scenes(config(count=0), model.config)
    with pytest.raises(InputError, match="a folder of scenes and what to generate others from"):
        open_scenes(config(scenes="a", backgrounds="b"), model.config)
    with pytest.raises(InputError, match="answers at true boxes"):
        measure_objects(scenes, [], [np.arange(4)] * 2, range(2), model)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    from nolbo_ppl.synthetic.dataset_writer import write_scenes
    from nolbo_ppl.synthetic.scenes.scene_config import preset
    from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

    folder = tmp_path_factory.mktemp("scenes") / "set"
    write_scenes(folder, SceneGenerator(preset("easy", 64), seed=SEED), 6)
    return folder


@pytest.mark.slow
def test_folder_and_generated_scenes_are_the_same(scene_folder):
    from nolbo_ppl.evaluation.labelled_scenes import GeneratedScenes
    from nolbo_ppl.synthetic.scenes.scene_config import preset
    from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

    model_config = dataclasses.replace(tiny(), image_size=64)
    read = open_scenes(config(scenes=scene_folder, count=5), model_config)
    assert isinstance(read, FolderScenes) and len(read) == 5
    generated = GeneratedScenes(SceneGenerator(preset("easy", 64), seed=SEED), 5)
    for index in range(5):
        a, b = read[index], generated[index]
        for name in (*ARRAYS, "intrinsics", "ignore", "voxels", "pixels"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-5, err_msg=name)
        assert (a.category, a.instance, a.exhaustive) == (b.category, b.instance, b.exhaustive)


@pytest.mark.slow
def test_labels_without_a_symmetry_have_the_one_the_model_declares(scene_folder, tmp_path):
    from nolbo_ppl.io.files import read_jsonl, write_jsonl

    rows = [row for _, row in read_jsonl(scene_folder / "scenes.jsonl")]
    for row in rows:
        for thing in row["objects"]:
            del thing["symmetry"]
    shutil.copytree(scene_folder / "images", tmp_path / "images")
    write_jsonl(tmp_path / "scenes.jsonl", rows)
    declared = dataclasses.replace(tiny(), image_size=64, symmetry=tuple(range(2, 14)))
    scenes = open_scenes(config(scenes=tmp_path), declared)
    seen = 0
    for index in range(len(scenes)):
        np.testing.assert_array_equal(scenes[index].symmetry, scenes[index].labels(CATEGORIES) + 2)
        seen += len(scenes[index].symmetry)
    assert seen > 0


@pytest.mark.slow
def test_the_verb_writes_figures_and_pictures(scene_folder, tmp_path, capsys):
    """An untrained network from a folder of weights: everything is written, nothing is NaN."""
    from nolbo_ppl.inference.posterior.model_folder import save
    from nolbo_ppl.models.observation_model import Nolbo
    from nolbo_ppl.models.posterior_calibration import Calibration

    torch.set_default_dtype(torch.float32)
    model = Nolbo.from_seed(tiny(), 0)
    list(model.story.decoder.parameters())[-1].data.fill_(-4.0)  # empty shapes, which draw fast
    save(tmp_path / "model", model, Calibration(), {})
    out = tmp_path / "out"
    arguments = f"--model {tmp_path / 'model'} --scenes {scene_folder} --count 6 --out {out} --resamples 20"
    evaluate.main(
        [*arguments.split(), "--score-threshold", "0.002", "--retrieval", "--gallery", "2", "--test-sizes", "64", "128"]
    )
    values = json.loads((out / "metrics.json").read_text())
    assert set(REQUIRED) <= set(values) and values["scenes"] == 6
    assert values["configuration"]["scenes"] == str(scene_folder) and values["seeds"]["scenes"] is None
    for name in ("precision_recall", "reliability", "confusion", "viewpoint", "retrieval", "examples", "detections"):
        assert (out / f"{name}.png").stat().st_size > 5000
    assert (out / "index.html").read_text().count("data:image/") == 7
    assert values["retrieval"]["car"]["instances"] == 2 and 0 <= values["retrieval_recall1"] <= 1
    assert "ap50" in capsys.readouterr().out


def test_stand_in_has_the_interface_of_the_real_model():
    """What the oracle answers with is what the real model's methods are called with."""
    import inspect

    from nolbo_ppl.inference.posterior.predictor import ObservationModel

    for name in ("observe", "observe_boxes"):
        inspect.signature(getattr(ObservationModel, name)).bind(
            SimpleNamespace(), [], None, *([[]] if name == "observe_boxes" else []), decode=False, batch=4
        )
