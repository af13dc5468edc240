"""What stands in a world, and that the camera can drive through it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.assets.shape_library import SEED_STRIDE, ShapeLibrary
from nolbo_ppl.synthetic.worlds import SequenceConfig, World, make_world, sequence_preset
from nolbo_ppl.synthetic.worlds.placing import Catalogue
from nolbo_ppl.synthetic.worlds.world import POOL_SEED


@pytest.fixture(params=["street", "indoor"])
def world(request: pytest.FixtureRequest) -> World:
    return request.getfixturevalue(request.param)


def outline(thing: object, count: int = 40) -> np.ndarray:
    """Points along the border of an object's footprint, from its pose and dimensions."""
    shape = thing.look.item.shape  # type: ignore[attr-defined]
    u = np.linspace(-0.5, 0.5, count)
    edge = np.concatenate([np.stack((u, np.full(count, s)), axis=1) for s in (-0.5, 0.5)])
    ring = np.concatenate((edge, edge[:, ::-1])) * shape.dimensions[:2]
    T = thing.T_ground_object  # type: ignore[attr-defined]
    return ring @ T[:2, :2].T + T[:2, 3]


def test_the_loop_closes(world: World) -> None:
    """The first frame of the second lap looks almost as the first frame did."""
    poses, config = world.T_world_camera, world.config
    np.testing.assert_array_equal(poses[0], np.eye(4))
    assert world.loop.length == pytest.approx(config.perimeter, rel=1e-3)
    distance = np.linalg.norm(poses[:, :3, 3], axis=1)
    late = np.arange(len(poses)) > len(poses) / 2
    nearest = np.flatnonzero(late)[np.argmin(distance[late])]
    assert distance[nearest] < 0.6 * config.step + 1.0
    assert np.degrees(np.arccos((np.trace(poses[nearest, :3, :3]) - 1) / 2)) < 25
    assert nearest < len(poses) - 3  # and goes on
    assert distance.max() > 0.3 * config.perimeter / np.pi


def test_same_configuration_same_world(world: World) -> None:
    again = make_world(world.config)
    np.testing.assert_array_equal(again.T_world_camera, world.T_world_camera)
    np.testing.assert_array_equal(again.static.vertices, world.static.vertices)
    assert again.static_materials == world.static_materials
    for a, b in zip(again.objects, world.objects, strict=True):
        np.testing.assert_array_equal(a.T_ground_object, b.T_ground_object)
        assert (a.id, a.look.item.shape.instance, a.look.materials) == (b.id, b.look.item.shape.instance, b.look.materials)


def test_objects_stand_apart_from_each_other_and_from_the_way(world: World) -> None:
    assert len(world.objects) == world.config.objects
    assert len({thing.id for thing in world.objects}) == len(world.objects)
    camera = world.T_ground_camera[:, :3, 3]
    way = np.concatenate([camera[:-1] + (camera[1:] - camera[:-1]) * f for f in np.linspace(0, 1, 20)])
    for k, thing in enumerate(world.objects):
        border = outline(thing)
        reach = np.linalg.norm(border[:, None] - way[None, :, :2], axis=-1).min()
        assert reach > (1.4 if world.config.world == "street" else 0.5), thing.id
        shape, T = thing.look.item.shape, thing.T_ground_object
        for other in world.objects[:k]:
            size = other.look.item.shape.dimensions
            if abs(T[2, 3] - other.T_ground_object[2, 3]) > 0.5 * (size[2] + shape.dimensions[2]) - 1e-6:
                continue  # one above the other
            local = (border - other.T_ground_object[:2, 3]) @ other.T_ground_object[:2, :2]
            assert not (np.abs(local) < 0.5 * size[:2] - 1e-9).all(axis=1).any(), (thing.id, other.id)


def test_objects_stand_on_something(world: World) -> None:
    tops = {0.0, 0.12, 0.55} | {
        round(float(o.centre[2] + o.look.item.shape.dimensions[2] / 2), 6)
        for o in world.objects
        if o.look.item.shape.category == "diningtable"
    }
    for thing in world.objects:
        foot = thing.centre[2] - thing.look.item.shape.dimensions[2] / 2
        assert min(abs(foot - top) for top in tops) < 1e-5, thing.id
        np.testing.assert_allclose(thing.T_ground_object[:3, 2], [0, 0, 1], atol=1e-12)


def test_look_alikes_share_shape_and_colours(street: World) -> None:
    looks = Counter(id(thing.look) for thing in street.objects)
    assert max(looks.values()) >= 2
    assert len(looks) < len(street.objects)
    by_instance: dict[str, set[int]] = {}
    for thing in street.objects:
        by_instance.setdefault(thing.look.item.shape.instance, set()).add(thing.look.seed)
    assert all(len(seeds) == 1 for seeds in by_instance.values())
    numbers = {int(thing.look.item.shape.instance.split("-")[1]) // SEED_STRIDE for thing in street.objects}
    assert numbers == {POOL_SEED + street.config.seed}  # unseen by any training


def test_no_copies_where_none_are_wanted() -> None:
    catalogue = Catalogue(ShapeLibrary(seed=3, instances=500), 0.0, 1, np.random.default_rng(2))
    looks = [catalogue.pick("bottle") for _ in range(12)]
    assert len({look.seed for look in looks}) == 12
    assert catalogue.pick("car", 5.0).item.shape.diagonal <= 5.0 + 0.5


def test_worlds_differ_by_seed(street: World) -> None:
    other = make_world(replace(street.config, seed=street.config.seed + 1))
    assert not np.allclose(other.T_world_camera, street.T_world_camera)
    mine, theirs = ({t.look.item.shape.instance for t in w.objects} for w in (street, other))
    assert not mine & theirs


def test_way_back_sees_the_loop_from_the_other_side(street: World) -> None:
    config = replace(street.config, laps=0.6, opposite=0.5, frames=60, step=2.0)
    world = make_world(config)
    forward = world.T_ground_camera[:, :2, 2]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    place = world.T_ground_camera[:, :2, 3]
    pairs = np.linalg.norm(place[:, None] - place[None], axis=-1) < 4.5
    facing = forward @ forward.T
    assert (pairs & (facing < -0.9)).sum() > 10


def test_moving_objects_keep_to_their_lane(street: World) -> None:
    world = make_world(replace(street.config, moving=3, objects=20))
    moving = [thing for thing in world.objects if thing.moving]
    assert len(moving) == 3 and len(world.objects) == 20
    for thing in moving:
        poses = np.array([world.T_ground_object(thing, k) for k in range(world.config.frames)])
        np.testing.assert_allclose(poses[0], thing.T_ground_object)
        assert np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).min() > 0.3
        np.testing.assert_allclose(world.loop.distance(poses[:, :2, 3]), 3.6, atol=0.05)
        gap = np.linalg.norm(poses[:, :2, 3] - world.T_ground_camera[:, :2, 3], axis=1)
        assert gap.min() > 0.5 * thing.look.item.shape.dimensions[0] + 1.0


@pytest.mark.parametrize("name", ["street", "indoor"])
@pytest.mark.parametrize("preset", ["default", "demo"])
def test_presets(name: str, preset: str) -> None:
    config = sequence_preset(preset, name, 3)  # type: ignore[arg-type]
    assert (config.world, config.seed) == (name, 3)
    assert config.laps > 1 and (config.frames, config.objects) == ((120, 60) if preset == "demo" else (300, config.objects))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"world": "sea"}, r"unknown world: got 'sea', expected street, indoor"),
        ({"frames": 1}, r"frames of the drive: got 1, expected at least 2"),
        ({"frames": 10**6}, r"frames of the drive: got 1000000, expected at most"),
        ({"laps": 0.0}, r"laps of the drive"),
        ({"laps": float("nan")}, r"laps of the drive"),
        ({"opposite": -1.0}, r"laps of the drive"),
        ({"step": 0.0}, r"step of the drive"),
        ({"size": (16, 16)}, r"size of the images"),
        ({"focal": 0.0}, r"focal length over width"),
        ({"look_alikes": 1.0}, r"share of look-alikes"),
        ({"camera_height": 9.0}, r"camera of the drive"),
        ({"objects": -1}, r"objects of the drive: got -1"),
        ({"noise": -0.1}, r"noise of the drive"),
        ({"frames": 20}, r"loop of the drive: got 12\.2 m.*at least 70 m; use more frames"),
        ({"moving": 2, "opposite": 0.5}, r"moving objects: got 2 in world 'street' with opposite 0\.5"),
    ],
)
def test_bad_configurations(options: dict, match: str) -> None:
    with pytest.raises(InputError, match=match):
        SequenceConfig(**options)


def test_unknown_presets() -> None:
    with pytest.raises(InputError, match=r"unknown preset of a drive: got 'long', expected default, demo"):
        sequence_preset("long", "street")
    with pytest.raises(InputError, match="unknown world: got 'sea'"):
        sequence_preset("demo", "sea")  # type: ignore[arg-type]
