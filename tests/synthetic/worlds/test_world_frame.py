"""Frames against the truth: objects where the poses say, the ground fixed in the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from nolbo_ppl.geometry.pose import inverse
from nolbo_ppl.synthetic.renderer.ray_casting import trace
from nolbo_ppl.synthetic.worlds import SequenceConfig, World, make_world, render_frame
from nolbo_ppl.synthetic.worlds.world_frame import frame_view


@pytest.fixture(params=["street", "indoor"])
def world(request: pytest.FixtureRequest) -> World:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def slow_street() -> World:
    """A short piece of a street, in steps small enough to match the pictures of neighbouring frames."""
    return make_world(
        SequenceConfig(frames=10, step=0.7, laps=0.08, objects=12, clutter=4, size=(256, 128), supersample=2, seed=2, noise=0.0)
    )


def test_boxes_are_the_projections_of_the_true_objects(world: World) -> None:
    """Each object's mesh, moved by `T_world_object` and `T_world_camera` alone, gives the label's box and pose."""
    things = {thing.id: thing for thing in world.objects}
    fx, fy, cx, cy = world.intrinsics
    width, height = world.config.size
    seen, whole = 0, 0
    for k in range(0, world.config.frames, 5):
        made = render_frame(world, k)
        T_camera_world = inverse(world.T_world_camera[k])
        for name, label in zip(made.ids, made.rendered.labels, strict=True):
            shape = things[name].look.item.shape
            T = T_camera_world @ world.T_world_ground @ things[name].T_ground_object
            points = shape.vertices * shape.diagonal @ T[:3, :3].T + T[:3, 3]
            assert points[:, 2].min() > 0
            pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
            box = np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))
            np.testing.assert_allclose(label.box, np.clip(box, 0, [width, height, width, height]), atol=1e-6)
            np.testing.assert_allclose(label.position, T[:3, 3], atol=1e-9)
            np.testing.assert_allclose(label.R_camera_object, T[:3, :3], atol=1e-9)
            assert label.size == pytest.approx(np.linalg.norm(label.dimensions))
            seen += 1
            if np.allclose(label.box, box, atol=1e-6):  # not cut by the border
                whole += 1
                centre = T[:2, 3] / T[2, 3] * [fx, fy] + [cx, cy]
                side = label.box[2:] - label.box[:2]
                assert (np.abs(centre - 0.5 * (label.box[:2] + label.box[2:])) < 0.25 * side + 1).all()
    assert seen >= 10 and whole >= 5


def test_pixels_of_an_object_lie_in_its_box(world: World) -> None:
    config = world.config
    found = 0
    for k in range(0, config.frames, 5):
        rendered = render_frame(world, k).rendered
        for number, label in enumerate(rendered.labels):
            rows, columns = np.nonzero(rendered.instance_id == number)
            assert len(rows) > 0
            assert columns.min() >= np.floor(label.box[0]) and columns.max() < np.ceil(label.box[2])
            assert rows.min() >= np.floor(label.box[1]) and rows.max() < np.ceil(label.box[3])
            assert config.least_visibility <= label.visibility <= 1
            assert min(label.box[2:] - label.box[:2]) >= config.least_box
            found += 1
    assert found > 10


def test_a_frame_depends_on_the_world_and_its_number_alone(street: World) -> None:
    first = render_frame(street, 3)
    render_frame(street, 9)
    again = render_frame(make_world(street.config), 3)
    np.testing.assert_array_equal(first.rendered.image, again.rendered.image)
    assert first.record("a") == again.record("a")
    assert (render_frame(street, 4).rendered.image != first.rendered.image).mean() > 0.3


def test_record_names_its_objects(street: World) -> None:
    made = render_frame(street, 0)
    row = made.record("images/000000.png")
    assert row["image"] == "images/000000.png"
    assert [thing["id"] for thing in row["objects"]] == list(made.ids)
    assert len(set(made.ids)) == len(made.ids)


def test_hidden_and_tiny_objects_have_no_label(street: World) -> None:
    strict = replace(street, config=replace(street.config, least_visibility=0.6, least_box=15.0))
    for k in (0, 10):
        ids = set(render_frame(strict, k).ids)
        loose = render_frame(street, k)
        expected = {
            name
            for name, label in zip(loose.ids, loose.rendered.labels)
            if label.visibility >= 0.6 and min(label.box[2:] - label.box[:2]) >= 15
        }
        assert ids == expected
        np.testing.assert_array_equal(render_frame(strict, k).rendered.image, loose.rendered.image)  # still in the picture


def ground_pixels(world: World, frame: int) -> np.ndarray:
    """Pixels that show the road (height 0), from the depth of the first hit."""
    hits = trace(frame_view(world, frame)[0])
    rows, columns = np.indices(hits.depth.shape)
    fx, fy, cx, cy = world.intrinsics
    z = np.where(np.isfinite(hits.depth), hits.depth, 0.0)
    rays = np.stack(((columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(z.shape)), axis=-1)
    T = world.T_ground_camera[frame]
    points = (rays * z[..., None]) @ T[:3, :3].T + T[:3, 3]
    return (hits.index == 0) & (np.abs(points[..., 2]) < 0.03) & (z > 1) & (z < 12)


def warped(world: World, target: int, source: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source picture and ground mask as the target camera sees them, by the homography of the plane z = 0."""
    T = inverse(world.T_ground_camera[source]) @ world.T_ground_camera[target]
    pose = world.T_ground_camera[target]
    normal, height = pose[2, :3], pose[2, 3]  # a ground point x of the target camera has normal . x = -height
    fx, fy, cx, cy = world.intrinsics
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    H = K @ (T[:3, :3] - np.outer(T[:3, 3], normal) / height) @ np.linalg.inv(K)
    rows, columns = np.indices((world.config.size[1], world.config.size[0]))
    points = np.stack((columns + 0.5, rows + 0.5, np.ones(rows.shape)), axis=-1) @ H.T
    at = np.stack((points[..., 1] / points[..., 2] - 0.5, points[..., 0] / points[..., 2] - 0.5))
    grey = render_frame(world, source).rendered.image.astype(float).mean(axis=-1)
    mask = map_coordinates(ground_pixels(world, source).astype(float), at, order=1, cval=0.0)
    return map_coordinates(grey, at, order=1), mask, (points[..., 2] > 0)


def test_ground_is_fixed_in_the_world(slow_street: World) -> None:
    """One frame warped into another by the plane's homography shows the same picture; unwarped it does not."""
    target = render_frame(slow_street, 4).rendered.image.astype(float).mean(axis=-1)
    road = ground_pixels(slow_street, 4)
    for source in (3, 6):
        moved, mask, ahead = warped(slow_street, 4, source)
        both = road & (mask > 0.99) & ahead
        assert both.sum() > 2000
        assert np.corrcoef(moved[both], target[both])[0, 1] > 0.85
        still = render_frame(slow_street, source).rendered.image.astype(float).mean(axis=-1)
        assert np.corrcoef(still[both], target[both])[0, 1] < 0.5


def test_ground_has_corners_to_follow(slow_street: World) -> None:
    """The road alone has contrast at the scale of a feature detector: steps within three pixels."""
    image = render_frame(slow_street, 4).rendered.image.astype(float).mean(axis=-1)
    road = ground_pixels(slow_street, 4)
    inside = road[3:-3, 3:-3] & road[6:, 6:] & road[:-6, :-6] & road[6:, :-6] & road[:-6, 6:]
    gx = image[3:-3, 6:] - image[3:-3, :-6]
    gy = image[6:, 3:-3] - image[:-6, 3:-3]
    assert np.percentile(np.abs(gx[inside]), 75) > 8 and np.percentile(np.abs(gy[inside]), 75) > 8


def test_standing_objects_stand_and_moving_ones_move(street: World) -> None:
    world = make_world(replace(street.config, moving=3, objects=30))
    moving = {thing.id for thing in world.objects if thing.moving}
    places: dict[str, list[np.ndarray]] = {}
    for k in range(world.config.frames):
        made = render_frame(world, k)
        T = world.T_world_camera[k]
        for name, label in zip(made.ids, made.rendered.labels):
            places.setdefault(name, []).append(T[:3, :3] @ label.position + T[:3, 3])
    spread = {name: np.ptp(np.array(rows), axis=0).max() for name, rows in places.items() if len(rows) > 1}
    assert any(name in moving for name in spread)
    assert all((spread[name] > 0.5) == (name in moving) for name in spread)
