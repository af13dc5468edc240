"""Usual heights against boxes drawn of simulated cars: errors, coverage, and what is left alone."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import so3_exp
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.size_refinement import USUAL_HEIGHTS, refine_by_height, usual_range

CAMERA = np.array([720.0, 720.0, 620.0, 190.0])
SIZE = (1240, 380)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""R_camera_object of a car that faces the camera (z up, front -y)."""


def cars(rng: np.random.Generator, count: int) -> tuple[SimpleNamespace, np.ndarray]:
    """Boxes around the projected corners of cars of various sizes on a road, 1.65 m below the camera; the guide's ranges
    are off by a factor with a standard deviation of 0.45."""
    low, spread = USUAL_HEIGHTS["car"]
    height = low + spread * rng.standard_normal(count)
    size = np.column_stack([1.15 * height, 2.8 * height, height])
    depth, turn = rng.uniform(9, 40, count), rng.uniform(-np.pi, np.pi, count)
    centre = np.column_stack([rng.uniform(-0.35, 0.35, count) * depth, 1.65 - height / 2, depth])
    rotation = so3_exp(np.column_stack([np.zeros(count), turn, np.zeros(count)])) @ UPRIGHT
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
    corners = np.einsum("nij,ncj->nci", rotation, signs * size[:, None]) + centre[:, None]
    pixels = corners[..., :2] / corners[..., 2:] * CAMERA[:2] + CAMERA[2:]
    box = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
    factor = np.exp(0.45 * rng.standard_normal(count))
    position = factor[:, None] * centre
    covariance = np.einsum("ni,nj->nij", position, position) * 0.45**2 + 0.01 * np.eye(3)
    observed = SimpleNamespace(
        box=box,
        categories=("boat", "car"),
        class_log_posterior=np.tile(np.log([0.1, 0.9]), (count, 1)),
        position=position,
        position_covariance=covariance,
        R_camera_object=rotation,
        size=factor[:, None] * size,
        sized=False,
    )
    return observed, centre


def test_the_range_by_height_is_right_within_what_it_states() -> None:
    observed, centre = cars(np.random.default_rng(0), 400)
    found, scale = usual_range(observed, CAMERA, SIZE, USUAL_HEIGHTS)  # type: ignore[arg-type]
    true = np.linalg.norm(centre, axis=1)
    known = np.isfinite(found)
    whole = ((observed.box[:, :2] > 2) & (observed.box[:, 2:] < np.array(SIZE) - 2)).all(axis=1)
    np.testing.assert_array_equal(known, whole)
    z = (found[known] - true[known]) / scale[known]
    assert 0.25 < np.mean(z**2) < 1.2  # boxes are exact here, so less than what real ones are granted
    assert abs(np.median(found[known] / true[known]) - 1) < 0.04
    guide = np.linalg.norm(observed.position, axis=1)[known] / true[known]
    assert np.median(np.abs(found[known] / true[known] - 1)) < 0.3 * np.median(np.abs(guide - 1))


class Answers(SimpleNamespace):
    """Rows of answers with a length."""

    def __len__(self) -> int:
        return len(self.box)


def test_refined_positions_sizes_and_what_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, centre = cars(np.random.default_rng(1), 200)
    observed = Answers(**vars(plain), diagonal=np.linalg.norm(plain.size, axis=1))
    observed.class_log_posterior[::5] = np.log([0.9, 0.1])  # boats have no usual height

    def swap(before: Any, **values: Any) -> Any:
        return Answers(**(vars(before) | values))

    monkeypatch.setattr("nolbo_ppl.pipeline.size_refinement.replace", swap)
    refined = refine_by_height(observed, CAMERA, SIZE)  # type: ignore[arg-type]
    np.testing.assert_array_equal(refined.position[::5], plain.position[::5])
    used = np.flatnonzero((refined.position != plain.position).any(axis=1))
    assert len(used) > 100
    errors = [
        np.linalg.norm(p[used] - centre[used], axis=1) / np.linalg.norm(centre[used], axis=1)
        for p in (plain.position, refined.position)
    ]
    assert np.median(errors[1]) < 0.3 * np.median(errors[0])
    # The same pixels from another distance: sizes go with the range.
    ratio = np.linalg.norm(refined.position, axis=1) / np.linalg.norm(plain.position, axis=1)
    np.testing.assert_allclose(refined.size, plain.size * ratio[:, None])
    gap = refined.position[used] - centre[used]
    square = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(refined.position_covariance[used]), gap)
    assert np.mean(square < 6.25) > 0.85


def test_a_height_is_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nolbo_ppl.pipeline.size_refinement.replace", lambda old, **new: Answers(**(vars(old) | new)))
    plain, _ = cars(np.random.default_rng(1), 60)
    observed = Answers(**(vars(plain) | {"sized": True}), diagonal=np.linalg.norm(plain.size, axis=1))
    found, scale = usual_range(observed, CAMERA, SIZE, USUAL_HEIGHTS)  # type: ignore[arg-type]
    after = refine_by_height(observed, CAMERA, SIZE)  # type: ignore[arg-type]
    moved = np.abs(after.position - observed.position).max(axis=1) > 1e-9
    assert moved.any()
    distance = np.linalg.norm(after.position, axis=1)
    np.testing.assert_allclose(distance[moved], found[moved], rtol=1e-3)  # the height alone
    ray = after.position / distance[:, None]
    along = np.sqrt(np.einsum("ni,nij,nj->n", ray, after.position_covariance, ray))
    np.testing.assert_allclose(along[moved], scale[moved], rtol=1e-2)
    np.testing.assert_allclose(after.position_covariance[~moved], observed.position_covariance[~moved])


def test_usual_heights_are_for_the_weights_of_photographs_unless_told() -> None:
    made = {
        (model, option): RunConfig(Path("images"), Path("out"), model=model, usual_heights=option).refines_by_height  # type: ignore[arg-type]
        for model in ("tiny", "photo")
        for option in ("auto", "on", "off")
    }
    assert [key for key, value in made.items() if value] == [("tiny", "on"), ("photo", "auto"), ("photo", "on")]
