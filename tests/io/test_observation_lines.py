"""Observation files: round trips, defaults, and every kind of damage with its line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import so3_exp
from nolbo_ppl.io.observations import Detections, check_table, read_observations, write_observations

LINE = {"frame": 0, "position": [1.0, 2.0, 3.0]}
MODE = {"weight": 1.0, "rotation": [0.0, 0.0, 0.0, 1.0], "std": 0.1}


def write(path: Path, *rows: object) -> Path:
    path.write_text("\n".join(r if isinstance(r, str) else json.dumps(r) for r in rows) + "\n")
    return path


def test_round_trip_of_every_field(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 5
    root = rng.standard_normal((n, 3, 3))
    table = Detections.from_arrays(
        np.arange(n),
        rng.standard_normal((n, 3)),
        position_covariance=root @ np.swapaxes(root, 1, 2) + np.eye(3),
        rotation=so3_exp(rng.standard_normal((n, 3))),
        rotation_scale=0.1,
        latent=rng.standard_normal((n, 4)),
        latent_scale=0.3,
        objectness=rng.random(n),
        category=["car", None, "bus", "car", "car"],
        size=rng.random((n, 3)) + 1,
        symmetry=[0, 1, 2, -1, 4],
        id=list("abcde"),
    )
    write_observations(tmp_path / "o.jsonl", table)
    back = read_observations(tmp_path / "o.jsonl", frames=n)
    for name in (
        "frame",
        "position",
        "position_covariance",
        "rotation",
        "rotation_scale",
        "latent",
        "latent_scale",
        "objectness",
        "size",
        "symmetry",
    ):
        np.testing.assert_allclose(getattr(back, name), getattr(table, name), rtol=2e-6, atol=2e-6, err_msg=name)
    assert back.category == table.category and back.id == table.id
    check_table(back, n)
    joined = Detections.concatenate([back.select(np.array([0, 1])), back.select(np.array([2, 3, 4]))])
    assert joined.id == back.id and joined.category == back.category


def test_only_frame_and_position_are_needed(tmp_path: Path) -> None:
    table = read_observations(write(tmp_path / "o.jsonl", LINE, "", {**LINE, "frame": 3, "id": 17}))
    assert len(table) == 2 and table.latent_dim == 0 and table.id == ("line-1", "17")
    assert table.objectness.tolist() == [1.0, 1.0] and not table.has_rotation.any()
    assert np.isnan(table.position_covariance).all()


def test_an_empty_file_is_an_empty_table(tmp_path: Path) -> None:
    table = read_observations(write(tmp_path / "o.jsonl", ""))
    assert len(table) == 0
    check_table(table, 5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ('{"frame": 0, "position": [1, 2', "not a line of JSON.*truncated"),
        ("[1, 2]", "not a JSON object"),
        ({"frame": 0}, "`position` is missing"),
        ({**LINE, "frame": -1}, "no row number"),
        ({**LINE, "frame": 1.5}, "no row number"),
        ({**LINE, "frame": True}, "no row number"),
        ({**LINE, "frame": 10}, "`frame` out of range.*0 to 9"),
        ({**LINE, "position": [1, 2]}, "`position` is no vector"),
        ({**LINE, "position": [1, 2, "x"]}, "`position` is no vector"),
        ('{"frame": 0, "position": [1, 2, NaN]}', "not a line of JSON"),
        ({**LINE, "position": [1, 2, 1e9]}, "`position` out of range"),
        ({**LINE, "position_std": 0}, "no standard deviation"),
        ({**LINE, "position_std": [1, -1, 1]}, "no standard deviation"),
        ({**LINE, "position_cov": [[1, 0, 0], [0, 1, 0]]}, "no 3x3 matrix"),
        ({**LINE, "position_cov": [[1, 0, 0], [0, -1, 0], [0, 0, 1]]}, "not positive definite"),
        ({**LINE, "position_cov": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "not positive definite"),
        ({**LINE, "rotation": [0, 0, 0, 0.5]}, "no unit quaternion"),
        ({**LINE, "rotation": [0, 0, 1]}, "`rotation` is no vector"),
        ({**LINE, "rotation_std": 0}, "no standard deviation"),
        ({**LINE, "latent": [[1.0]]}, "`latent` is no vector"),
        ({**LINE, "objectness": 1.2}, "no probability"),
        ({**LINE, "category": 3}, "no name"),
        ({**LINE, "size": [1, 1]}, "`size` is no standard deviation"),
        ({**LINE, "symmetry": -2}, "no order"),
        ({**LINE, "position": [True, False, True]}, "`position` is no vector"),
        ({**LINE, "position": ["1", "2", "3"]}, "`position` is no vector"),
        ({**LINE, "position_std": True}, "`position_std` is no standard deviation"),
        ({**LINE, "position_std": 1e-320}, "`position_std` is no standard deviation"),
        ({**LINE, "position_std": 1e200}, "`position_std` is no standard deviation"),
        ({**LINE, "latent": [1e300, 0.0]}, "`latent` is no vector"),
        ({**LINE, "symmetry": 10**18}, "no order"),
        ({**LINE, "postion_std": 1}, "unknown field.*postion_std"),
        ({**LINE, "rotation_modes": []}, "no list of modes"),
        ({**LINE, "rotation_modes": [[1, 2]]}, "no list of modes"),
        ({**LINE, "rotation_modes": [{"weight": 1.0, "std": 0.1}]}, "`rotation_modes` 0 has wrong fields"),
        ({**LINE, "rotation_modes": [{**MODE, "weight": -1}]}, "no weight"),
        ({**LINE, "rotation_modes": [{**MODE, "weight": 0.5}]}, "do not sum to one"),
        ({**LINE, "rotation_modes": [{**MODE, "rotation": [0, 0, 0, 2]}]}, "`rotation_modes` is no unit quaternion"),
        ({**LINE, "rotation_modes": [{**MODE, "std": 0}]}, "no standard deviation"),
        ({**LINE, "latent_modes": [[1, 2]]}, "`latent_modes` is no list of modes"),
        ({**LINE, "latent_modes": [{"weight": 1.0}]}, "`latent_modes` 0 has wrong fields"),
        ({**LINE, "latent_modes": [{"weight": 2.0, "latent": [0.0]}]}, "`latent_modes` 0: `weight` is no weight"),
        ({**LINE, "latent_modes": [{"weight": 0.4, "latent": [0.0]}]}, "weights of `latent_modes` do not sum to one"),
        ({**LINE, "latent_modes": [{"weight": 1.0, "latent": ["x"]}]}, "`latent` is no vector"),
        ({**LINE, "latent": [0.0, 1.0], "latent_modes": [{"weight": 1.0, "latent": [0.0]}]}, "another length.*2, as `latent`"),
        (
            {**LINE, "latent_modes": [{"weight": 0.5, "latent": [0.0]}, {"weight": 0.5, "latent": [0.0, 1.0]}]},
            "`latent_modes` of different lengths",
        ),
    ],
)
def test_damage_is_named_with_its_line(tmp_path: Path, change: object, match: str) -> None:
    path = write(tmp_path / "o.jsonl", LINE, change)
    with pytest.raises(InputError, match=rf"o\.jsonl:2: .*{match}"):
        read_observations(path, frames=10)


def test_duplicate_ids_and_mixed_latents(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r":2: duplicate id.*line 1 has it"):
        read_observations(write(tmp_path / "a.jsonl", {**LINE, "id": "x"}, {**LINE, "id": "x"}))
    with pytest.raises(InputError, match=r":2: latents of different lengths"):
        read_observations(write(tmp_path / "b.jsonl", {**LINE, "latent": [1, 2]}, {**LINE, "latent": [1]}))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"frame": [0, 9]}, "frame out of range"),
        ({"position": [[0, 0, 1], [0, np.inf, 1]]}, "position is not finite"),
        ({"position_covariance": np.stack([np.eye(3), -np.eye(3)])}, "not positive definite"),
        ({"position_covariance": np.stack([np.eye(3), np.eye(3, k=1) + np.eye(3)])}, "not symmetric"),
        ({"rotation": np.stack([np.eye(3), 2 * np.eye(3)])}, "no rotation"),
        ({"rotation_scale": [0.1, 0.0]}, "rotation_scale"),
        ({"objectness": [0.5, 1.5]}, "no probability"),
    ],
)
def test_tables_are_checked(change: dict[str, object], match: str) -> None:
    fields: dict[str, object] = {"frame": [0, 1], "position": np.ones((2, 3)), "id": ["good", "bad"], **change}
    with pytest.raises(InputError, match=f"'bad'.*{match}"):
        check_table(Detections.from_arrays(**fields), frames=5)  # type: ignore[arg-type]


def test_modes_of_orientations_round_trip(tmp_path: Path) -> None:
    turned = [0.0, 0.0, 1.0, 0.0]
    both = [{**MODE, "weight": 0.3}, {"weight": 0.7, "rotation": turned, "std": 0.2}]
    path = write(tmp_path / "o.jsonl", LINE, {**LINE, "rotation_modes": both}, {**LINE, "rotation_modes": [MODE]})
    table = read_observations(path)
    np.testing.assert_allclose(table.mode_weight, [[0, 0], [0.3, 0.7], [1, 0]])
    np.testing.assert_allclose(table.mode_std, [[1, 1], [0.1, 0.2], [0.1, 1]])
    assert table.has_rotation.tolist() == [False, True, True]
    np.testing.assert_allclose(table.rotation[1], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)  # the heavier one
    assert table.rotation_scale[1] == 0.2
    write_observations(tmp_path / "again.jsonl", table)
    back = read_observations(tmp_path / "again.jsonl")
    for name in ("mode_weight", "mode_rotation", "mode_std", "rotation"):
        np.testing.assert_allclose(getattr(back, name), getattr(table, name), atol=1e-7)
    check_table(back, 1)
    joined = Detections.concatenate([Detections.from_arrays([0], [[0, 0, 1.0]]), back.select(np.array([1, 2]))])
    np.testing.assert_allclose(joined.mode_weight, table.mode_weight)


def test_modes_of_a_table_are_checked() -> None:
    fields = {
        "frame": [0, 0],
        "position": np.ones((2, 3)),
        "mode_weight": np.ones((2, 1)),
        "mode_std": 0.1,
        "mode_rotation": np.tile(np.eye(3), (2, 1, 1, 1)),
        "id": ["good", "bad"],
    }
    check_table(Detections.from_arrays(**fields), 1)
    with pytest.raises(InputError, match="incomplete"):
        Detections.from_arrays([0], np.ones((1, 3)), mode_weight=np.ones((1, 1)))
    for change, match in (
        ({"mode_weight": [[1.0], [-1.0]]}, "mode_weight"),
        ({"mode_std": [[0.1], [0.0]]}, "mode_std"),
        ({"mode_rotation": np.stack([np.eye(3), 2 * np.eye(3)])[:, None]}, "mode_rotation"),
    ):
        with pytest.raises(InputError, match=f"'bad'.*{match}"):
            check_table(Detections.from_arrays(**{**fields, "rotation": np.eye(3), **change}), 1)
