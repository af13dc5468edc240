"""Labels of rendered scenes against their pixels, and what may appear in a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.camera import project
from nolbo_ppl.geometry.rotation import geodesic_angle, ray_rotation, viewpoint_to_matrix
from nolbo_ppl.structures.label_arrays import allocentric_viewpoints, empty_labels, fill_annotations
from nolbo_ppl.synthetic.assets.shape_library import SEED_STRIDE, ShapeLibrary
from nolbo_ppl.synthetic.renderer.camera_view import Mesh, MeshInstance
from nolbo_ppl.synthetic.renderer.ray_casting import trace
from nolbo_ppl.synthetic.scenes.footprint import Footprint
from nolbo_ppl.synthetic.scenes.render_scene import Rendered, Scene, amodal_box, render_scene
from nolbo_ppl.synthetic.scenes.scene_config import DIFFICULTIES, SceneConfig, full, preset, standard
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.synthetic.scenes.scene_sampler import camera_rotation

COUNT = 24


@pytest.fixture(scope="module")
def source() -> SceneGenerator:
    return SceneGenerator(replace(standard(64), objects=(1, 6)), seed=3, instances=3)


@pytest.fixture(scope="module")
def rendered(source: SceneGenerator) -> list[tuple[Scene, Rendered]]:
    scenes = [source.scene(index) for index in range(COUNT)]
    return [(scene, render_scene(scene)) for scene in scenes]


def test_box_is_the_projection_of_the_labelled_shape(rendered: list[tuple[Scene, Rendered]]) -> None:
    """Shape, rotation, position and size in metres, projected with the intrinsics, span the labelled box."""
    seen = set()
    for _, image in rendered:
        for label in image.labels:
            points = label.item.shape.vertices * label.size @ label.R_camera_object.T + label.position
            intrinsics = torch.from_numpy(image.intrinsics).expand(len(points), 4)
            pixels = project(torch.from_numpy(points), intrinsics).numpy()
            box = np.clip(np.concatenate((pixels.min(axis=0), pixels.max(axis=0))), 0, 64)
            np.testing.assert_allclose(label.box, box, atol=1e-6)
            assert label.size == pytest.approx(np.linalg.norm(label.dimensions))
            seen.add(label.category)
    assert len(seen) >= 10


def test_box_encloses_the_pixels_of_its_object(rendered: list[tuple[Scene, Rendered]]) -> None:
    tight = []
    for _, image in rendered:
        for number, label in enumerate(image.labels):
            rows, columns = np.nonzero(image.instance_id == number)
            assert len(rows), "an object without a pixel is labelled"
            x0, y0, x1, y1 = label.box
            assert x0 <= columns.min() + 0.5 and columns.max() + 0.5 <= x1
            assert y0 <= rows.min() + 0.5 and rows.max() + 0.5 <= y1
            if label.visibility > 0.999:
                tight.append(max(columns.min() - x0, x1 - columns.max() - 1, rows.min() - y0, y1 - rows.max() - 1))
    assert np.mean(tight) < 1.0  # only parts thinner than a pixel fall between the rays


def test_every_pixel_lies_on_the_labelled_shape(rendered: list[tuple[Scene, Rendered]]) -> None:
    """Depth of each pixel, scaled to metres and moved into the object's frame, lies on the voxels of the shape."""
    for scene, image in rendered:
        kept = _kept(scene, image)
        hits = trace(replace(scene.view, placed=kept))
        for number, label in enumerate(image.labels):
            rows, columns = np.nonzero(image.instance_id == number)
            thing = next(t for t in scene.objects if np.array_equal(t.R_camera_object, label.R_camera_object))
            depth = hits.depth[rows, columns] * (label.size / thing.diagonal)
            fx, fy, cx, cy = image.intrinsics
            rays = np.stack(((columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(len(rows))), axis=1)
            points = rays * depth[:, None]
            canonical = (points - label.position) @ label.R_camera_object / label.size
            half = 0.5 * label.dimensions / label.size
            assert (np.abs(canonical) <= half + 1e-3).all()
            occupied = label.item.shape.voxels(32)
            cell = np.clip(np.floor((canonical + 0.5) * 32).astype(int), 0, 31)
            grown = np.pad(occupied, 2)
            near = np.zeros(len(cell), dtype=bool)
            for d in np.ndindex(5, 5, 5):
                near |= grown[tuple((cell + d).T)]
            assert near.mean() > 0.97, label.instance


def _kept(scene: Scene, image: Rendered) -> tuple[MeshInstance, ...]:
    """Clutter and the objects that kept their labels."""
    wanted = {R.tobytes() for R in image.annotations.R_camera_object}
    instance_ids = {
        k for k, thing in enumerate(scene.objects) if np.asarray(thing.R_camera_object, dtype=np.float64).tobytes() in wanted
    }
    return tuple(p for p in scene.view.placed if p.instance_id < 0 or p.instance_id in instance_ids)


def test_visibility_is_the_seen_share_of_the_whole_silhouette(rendered: list[tuple[Scene, Rendered]]) -> None:
    partly = 0
    for scene, image in rendered:
        kept = [p for p in _kept(scene, image) if p.instance_id >= 0]
        assert len(kept) == len(image.labels)
        for number, (thing, label) in enumerate(zip(kept, image.labels)):
            intrinsics = scene.view.intrinsics + np.array([0, 0, 64, 64])
            large = replace(scene.view, placed=(thing,), height=192, width=192, intrinsics=intrinsics)
            alone = np.count_nonzero(trace(large).index >= 0)  # one image size more on every side
            assert label.visibility == pytest.approx((image.instance_id == number).sum() / alone, rel=0.06)
            assert standard().least_visibility <= label.visibility <= 1
            partly += label.visibility < 0.9
    assert partly > 5


def test_nothing_seen_goes_unlabelled(rendered: list[tuple[Scene, Rendered]]) -> None:
    """A hidden object is taken out of the scene, not only out of the labels."""
    removed = 0
    for scene, image in rendered:
        removed += len(scene.objects) - len(image.labels)
        assert set(np.unique(image.instance_id)) - {-1} == set(range(len(image.labels)))
        again = render_scene(replace(scene, view=replace(scene.view, placed=_kept(scene, image))))
        np.testing.assert_array_equal(again.image, image.image)
    assert removed > 0


def test_scenes_depend_on_seed_and_index_alone(source: SceneGenerator, rendered: list[tuple[Scene, Rendered]]) -> None:
    fresh = SceneGenerator(source.config, seed=3, instances=3)
    for index in (7, 2):
        again = fresh.render(index)
        np.testing.assert_array_equal(again.image, rendered[index][1].image)
        for a, b in zip(again.labels, rendered[index][1].labels):
            np.testing.assert_array_equal(a.box, b.box)
            assert a.instance == b.instance
    other = SceneGenerator(source.config, seed=4, instances=3).render(7)
    assert not np.array_equal(other.image, rendered[7][1].image)


def test_seeds_share_no_shape() -> None:
    names = []
    for seed in (0, 1):
        pool = ShapeLibrary(seed=seed, instances=SEED_STRIDE)
        names.append({pool.item("bottle", k).shape.instance for k in (0, 1, SEED_STRIDE - 1)})
    assert not names[0] & names[1]
    pool = ShapeLibrary(("bottle", "car"), seed=0, instances=5)
    assert pool.total == 10
    assert pool.asset_of(7) is pool.item("car", 2)
    assert pool.item("car", 2).number == 7
    drawn = {pool.draw(np.random.default_rng(k), block=0).number for k in range(80)}
    assert drawn == set(range(10))


def test_object_frame_shows_its_front_at_azimuth_zero() -> None:
    """At azimuth 0 the camera sees the front lamps of a car and not its rear ones; at 180 degrees the reverse."""
    pool = ShapeLibrary(("car",), seed=0, instances=6)
    for azimuth, seen, hidden in ((0.0, "light_front", "light_rear"), (np.pi, "light_rear", "light_front")):
        shares = {seen: 0, hidden: 0}
        for k in range(6):
            shape = pool.item("car", k).shape
            viewpoint = torch.tensor([azimuth, 0.2, 0.0], dtype=torch.float64)
            R = viewpoint_to_matrix(viewpoint).numpy()
            thing = MeshInstance(Mesh(shape.vertices, shape.faces, shape.part), R, np.array([0, 0, 1.6]), (), 0)
            view = replace(SceneGenerator(standard(64), seed=0, instances=1).scene(0).view, placed=(thing,))
            hits = trace(replace(view, intrinsics=np.array([90.0, 90, 32, 32])))
            parts = shape.part[hits.face[hits.index >= 0]]
            for role in shares:
                if role in shape.parts:
                    shares[role] += np.count_nonzero(parts == shape.parts.index(role))
        assert shares[seen] > 20 and shares[hidden] == 0


def test_allocentric_viewpoint_far_off_the_axis(rendered: list[tuple[Scene, Rendered]]) -> None:
    """Turning the camera until the object is on its axis leaves the allocentric viewpoint as it is."""
    labels = empty_labels(1, 2)
    viewpoint = torch.tensor([[0.7, 0.4, 0.1], [-2.5, 0.1, -0.2]], dtype=torch.float64)
    ray = torch.tensor([[2.0, -0.5, 2.2], [-1.5, 1.0, 1.2]], dtype=torch.float64)
    ego = ray_rotation(ray) @ viewpoint_to_matrix(viewpoint)
    labels["rotation"][0], labels["position"][0] = ego.numpy(), ray.numpy()
    labels["has_viewpoint"][0] = labels["has_position"][0] = True
    labels["intrinsics"][0] = [100, 100, 64, 64]
    np.testing.assert_allclose(allocentric_viewpoints(labels)[0], viewpoint.numpy(), atol=1e-5)
    far = geodesic_angle(ego, viewpoint_to_matrix(viewpoint))
    off_axis = ray[:, 2] / torch.linalg.vector_norm(ray, dim=1)
    np.testing.assert_allclose(np.cos(far.numpy()), off_axis.numpy(), atol=1e-9)
    # Without a position the ray goes through the middle of the box.
    labels["has_position"][0] = False
    middle = (ray[:, :2] / ray[:, 2:] * 100 + 64).numpy()
    labels["box"][0] = np.concatenate((middle - 5, middle + 5), axis=1)
    np.testing.assert_allclose(allocentric_viewpoints(labels)[0], viewpoint.numpy(), atol=1e-4)
    # The same on rendered scenes: rotation = ray rotation times the rotation of the viewpoint.
    labels = empty_labels(COUNT)
    for row, (_, image) in enumerate(rendered):
        fill_annotations(labels, row, image.annotations, instance=image.numbers)
    allocentric = allocentric_viewpoints(labels)
    for row, slot in zip(*np.nonzero(labels["present"])):
        position = torch.from_numpy(labels["position"][row, slot].astype(np.float64))
        R = ray_rotation(position) @ viewpoint_to_matrix(torch.from_numpy(allocentric[row, slot].astype(np.float64)))
        np.testing.assert_allclose(R.numpy(), labels["rotation"][row, slot], atol=2e-5)


def test_camera_rotation_looks_down_and_rolls() -> None:
    R = camera_rotation(np.radians(30), 0.0)
    np.testing.assert_allclose(R.T @ [0, 0, 1], [0, np.cos(np.radians(30)), -0.5], atol=1e-12)  # optical axis, z up
    np.testing.assert_allclose(R.T @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    rolled = camera_rotation(0.0, np.radians(90))
    np.testing.assert_allclose(rolled @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # up is at the right of the image
    assert np.linalg.det(camera_rotation(0.3, 0.2)) == pytest.approx(1)


def test_footprints_meet_when_they_share_a_point() -> None:
    rng = np.random.default_rng(0)
    verdicts = []
    for _ in range(150):
        boxes = []
        for _ in range(2):
            a = rng.uniform(-np.pi, np.pi)
            axes = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
            low = rng.uniform(-1, 1)
            boxes.append(Footprint(rng.uniform(-1, 1, 2), axes, rng.uniform(0.1, 0.8, 2), (low, low + 0.8)))
        points = rng.uniform(-1, 1, (4000, 2)) * boxes[0].half @ boxes[0].axes + boxes[0].centre
        inside = (np.abs((points - boxes[1].centre) @ boxes[1].axes.T) <= boxes[1].half).all(axis=1).any()
        overlap = min(boxes[0].z[1], boxes[1].z[1]) > max(boxes[0].z[0], boxes[1].z[0])
        if inside and overlap:
            assert boxes[0].meets(boxes[1])
        if not boxes[0].meets(boxes[1]):
            assert not (inside and overlap)
        verdicts.append(boxes[0].meets(boxes[1]))
        assert boxes[1].meets(boxes[0]) == verdicts[-1]
    assert 20 < sum(verdicts) < 130


def test_objects_stand_on_the_ground_and_do_not_touch(rendered: list[tuple[Scene, Rendered]]) -> None:
    for scene, _ in rendered:
        for thing, placed in zip(scene.objects, [p for p in scene.view.placed if p.instance_id >= 0]):
            height = placed.vertices @ scene.view.up + scene.view.camera_height
            if thing.item.shape.category != "aeroplane":
                assert height.min() == pytest.approx(0, abs=1e-6 * thing.diagonal + 1e-9)
            else:
                assert height.min() > -1e-6


def test_azimuths_and_sizes_cover_their_ranges() -> None:
    source = SceneGenerator(standard(64), seed=0, instances=1)
    side: list[float] = []
    labels = empty_labels(80)
    labels["intrinsics"][:] = 1
    for row in range(80):
        scene = source.scene(row)
        for slot, thing in enumerate(scene.objects):
            labels["rotation"][row, slot], labels["position"][row, slot] = thing.R_camera_object, thing.centre
            labels["has_viewpoint"][row, slot] = labels["has_position"][row, slot] = True
        boxes = [amodal_box(p, scene.view) for p in scene.view.placed if p.instance_id >= 0]
        side += [max(box[2] - box[0], box[3] - box[1]) for box in boxes]
    azimuth, elevation, _ = allocentric_viewpoints(labels)[labels["has_viewpoint"]].T
    n = len(azimuth)
    quarter = np.histogram(azimuth, bins=4, range=(-np.pi, np.pi))[0]
    assert (np.abs(quarter - n / 4) < 5 * np.sqrt(n * 3 / 16)).all()
    assert np.mean((np.degrees(elevation) > -1) & (np.degrees(elevation) < 50)) > 0.75
    assert min(side) < 14 and max(side) > 40


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_presets_render(difficulty: str) -> None:
    config = replace(preset(difficulty, 32), supersample=2 if difficulty == "easy" else 1)
    source = SceneGenerator(config, seed=1, instances=1)
    images = [source.render(k).image for k in range(3)]
    assert all(image.shape == (32, 32, 3) and image.dtype == np.uint8 for image in images)
    assert min(image.std() for image in images) > 1


def test_photographs_lie_behind_the_objects(tmp_path) -> None:
    from PIL import Image

    rng = np.random.default_rng(0)
    for k in range(2):
        Image.fromarray(rng.integers(0, 255, (90, 120, 3), dtype=np.uint8)).save(tmp_path / f"{k}.png")
    config = replace(full(32), photographs=1.0)
    with_picture = SceneGenerator(config, seed=0, instances=1, backgrounds=str(tmp_path))
    assert with_picture.scene(0).view.backdrop.picture is not None
    assert not np.array_equal(with_picture.render(0).image, SceneGenerator(config, seed=0, instances=1).render(0).image)
    with pytest.raises(InputError, match="no image in the folder"):
        (tmp_path / "empty").mkdir()
        SceneGenerator(config, backgrounds=str(tmp_path / "empty")).scene(0)
    with pytest.raises(InputError, match="no such folder of images"):
        SceneGenerator(config, backgrounds=str(tmp_path / "absent")).scene(0)
    (tmp_path / "empty" / "broken.jpg").write_bytes(b"not a picture")
    with pytest.raises(InputError, match=r"broken.jpg: not a readable image"):
        SceneGenerator(config, backgrounds=str(tmp_path / "empty")).scene(0)


def test_cad_shapes_take_the_place_of_generated_ones() -> None:
    shapes = ShapeLibrary(("car", "sofa"), seed=9, instances=2)
    cad = tuple(shapes.item(c, k).shape for c in ("car", "sofa") for k in range(2))
    source = SceneGenerator(replace(standard(32), empty_probability=0.0), seed=0, cad=cad)
    names = {label.instance for k in range(12) for label in source.render(k).labels}
    assert names and names <= {shape.instance for shape in cad}
    assert "cad" in source.describe()["shapes"]
    with pytest.raises(InputError, match="no CAD shape of the wanted categories"):
        ShapeLibrary(("bus",), cad=cad)


def test_bad_configurations() -> None:
    with pytest.raises(InputError, match="size of the scenes: got 100, expected a positive multiple of 32"):
        SceneConfig(size=100)
    with pytest.raises(InputError, match=r"categories of the scenes: got .*'cat'"):
        SceneConfig(categories=("cat",))
    with pytest.raises(InputError, match="number of objects a scene"):
        SceneConfig(objects=(3, 2))
    with pytest.raises(InputError, match="rays a pixel"):
        SceneConfig(supersample=0)
    with pytest.raises(InputError, match="unknown difficulty: got 'hard', expected easy, standard, full"):
        preset("hard")
    with pytest.raises(InputError, match="instances a category"):
        ShapeLibrary(CATEGORIES, instances=0)
    with pytest.raises(InputError, match="seed of the shapes"):
        ShapeLibrary(CATEGORIES, seed=-1)
    with pytest.raises(InputError, match="more objects than slots"):
        rendered = SceneGenerator(replace(standard(64), objects=(5, 6), empty_probability=0.0), seed=3, instances=1)
        fill_annotations(empty_labels(1, 1), 0, max((rendered.render(k).annotations for k in range(4)), key=len))
