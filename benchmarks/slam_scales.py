"""Scales, consistency and counting of the object SLAM in small simulated worlds.

    python benchmarks/slam_scales.py --worlds circuit --stated --miss 0.45 --seeds 20 --first-seed 5000
    python benchmarks/slam_scales.py --worlds room --seeds 20 --first-seed 5000

A line a world, then the mean of each figure with its 95 % interval.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import tyro

from nolbo_ppl.data.simulate import (
    R_WORLD_UPRIGHT,
    DetectorConfig,
    SimulatedSequence,
    SimulatedWorld,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_sequence,
)
from nolbo_ppl.geometry.pose import inverse, make_pose, relative, se3_log, so3_exp
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_with_associations
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.io.observations import Detections
from nolbo_ppl.metrics.association import landmark_to_object, normalised_error_squared
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error


@dataclass(frozen=True)
class Arguments:
    """Which worlds."""

    worlds: Literal["circuit", "room"] = "circuit"
    """circuit: two laps of 90 frames round 45 objects; room: 15 objects of 5 classes, one or two detections a frame."""
    seeds: int = 10
    """Worlds."""
    first_seed: int = 0
    """Seed of the first one; seeds below 1000 are for tuning."""
    stated: bool = False
    """Detections and odometry state their scales (exactly)."""
    miss: float = 0.15
    """Probability that a visible object is not detected."""
    clutter: float = 0.5
    """Mean number of false detections a frame."""
    odometry_rotation: float = 0.01
    """True scale of the odometry, rad a step (room: 0.01)."""
    odometry_ratio: float = 0.01
    """True scale of the odometry, m per m (circuit)."""
    hypotheses: int = 0
    """Hypotheses of the map; 0: the library's default."""


def without_scales(table: Detections) -> Detections:
    """The same detections, nothing stated."""
    nan = np.full(len(table), np.nan)
    return replace(
        table,
        position_covariance=np.full((len(table), 3, 3), np.nan),
        rotation_scale=nan,
        latent_scale=np.full_like(table.latent_scale, np.nan),
    )


def circuit(seed: int, arguments: Arguments) -> SimulatedSequence:
    """Two laps round 45 objects of 8 categories."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, frames_per_lap=90)
    return simulate_sequence(
        truth,
        rng,
        world=WorldConfig(objects=45, categories=8, latent_dim=6),
        detector=DetectorConfig(miss_rate=arguments.miss, clutter_rate=arguments.clutter),
        odometry_rotation_scale=arguments.odometry_rotation,
        odometry_translation_ratio=arguments.odometry_ratio,
    )


def room(seed: int, arguments: Arguments) -> SimulatedSequence:
    """Three rounds in a room of 6 m: 15 objects of 5 classes along the walls, steps of 0.09 m, few detections a frame."""
    rng = np.random.default_rng(seed)
    steps, rounds = 240, 3
    angle = np.linspace(0, 2 * np.pi * rounds, steps, endpoint=False)
    radius = 0.09 * steps / (2 * np.pi * rounds)
    place = radius * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    outward = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    down = np.tile([0.0, 1.0, 0.0], (steps, 1))
    truth = make_pose(np.stack([np.cross(down, outward), down, outward], axis=-1), place)
    truth = inverse(truth[0]) @ truth
    around = np.sort(rng.uniform(0, 2 * np.pi, 15)) * 0.3 + 0.7 * np.linspace(0, 2 * np.pi, 15, endpoint=False)
    wall = rng.uniform(2.2, 3.4, 15)
    position = np.stack([wall * np.cos(around), rng.uniform(-0.5, 1.0, 15), wall * np.sin(around)], axis=1)
    first = make_pose(np.stack([np.cross(down[0], outward[0]), down[0], outward[0]], axis=-1)[None], place[:1])[0]
    position = (inverse(first) @ np.c_[position, np.ones(15)].T).T[:, :3]
    category = rng.integers(5, size=15)
    means = 3.0 * rng.standard_normal((5, 0))
    heading = so3_exp(rng.uniform(-np.pi, np.pi, (15, 1)) * np.array([0.0, 0.0, 1.0]))
    world = SimulatedWorld(position, R_WORLD_UPRIGHT @ heading, category, np.zeros((15, 0)), means)
    detector = DetectorConfig(
        minimum_range=0.3,
        maximum_range=4.0,
        field_of_view=np.deg2rad(60),
        miss_rate=0.3,
        clutter_rate=0.05,
        position_scale=0.05,
        position_ratio=0.02,
        rotation_scale=None,
    )
    table, source = simulate_detections(truth, world, detector, rng)
    names = [f"c{category[s]}" if s >= 0 else f"c{rng.integers(5)}" for s in source]
    odometry = simulate_odometry(truth, rng, rotation_scale=0.01, translation_scale=0.02)
    return SimulatedSequence(truth, odometry, replace(table, category=names), source, world)


def figures(world: SimulatedSequence, result: SlamResult, oracle_T: np.ndarray) -> dict[str, float]:
    """Errors, squared normalised errors per degree of freedom, counts."""
    assert world.world is not None
    before, after, best = (
        absolute_trajectory_error(T, world.truth).rmse for T in (world.odometry, result.T_world_camera, oracle_T)
    )
    pose = normalised_error_squared(
        se3_log(relative(result.T_world_camera, world.truth))[1:], result.pose_covariances()[1:]
    ).mean()
    owner, _ = landmark_to_object(world.object_of, association_table(result).landmark_of, len(result.landmarks))
    known = np.flatnonzero(owner >= 0)
    seen = len(np.unique(world.object_of[world.object_of >= 0]))
    out = {
        "before": before,
        "after": after,
        "after/oracle": after / best,
        "after/before": after / before,
        "landmarks/objects": len(result.landmarks) / seen,
        "nees_pose": float(pose),
        "warnings": float(len(result.state.noise.warnings)),
    }
    if len(known):
        gap = np.array([result.landmarks[j].T_world_object[:3, 3] - world.world.position[owner[j]] for j in known])
        spread = np.array([result.landmarks[j].position_covariance for j in known])
        out["nees_landmark"] = float(normalised_error_squared(gap, spread).mean())
        if world.world.latent.shape[1]:
            pairs = [(result.landmarks[j], owner[j]) for j in known if result.landmarks[j].latent is not None]
            z = [np.mean((m.latent - world.world.latent[o]) ** 2 / m.latent_variance) for m, o in pairs]
            out["nees_latent"] = float(np.mean(z))
        oriented = [j for j in known if result.landmarks[j].oriented]
        if oriented:
            R = np.array([result.landmarks[j].T_world_object[:3, :3] for j in oriented])
            true = world.world.rotation[owner[oriented]]
            error = se3_log(make_pose(np.swapaxes(R, 1, 2) @ true, np.zeros((len(R), 3))))[:, :3]
            upright = np.linalg.norm(error, axis=1) < 1.0
            cov = np.array([result.landmarks[j].covariance[:3, :3] for j in oriented])
            out["nees_orientation"] = float(normalised_error_squared(error[upright], cov[upright]).mean())
    return out


def run(seed: int, arguments: Arguments) -> dict[str, float]:
    """One world."""
    world = (room if arguments.worlds == "room" else circuit)(seed, arguments)
    config = SlamConfig()
    if arguments.hypotheses:
        config = replace(config, hypotheses=arguments.hypotheses)
    true_scales = (
        SlamConfig(odometry_rotation_scale=0.01, odometry_translation_scale=0.02)
        if arguments.worlds == "room"
        else SlamConfig(odometry_rotation_scale=arguments.odometry_rotation, odometry_translation_ratio=arguments.odometry_ratio)
    )
    oracle = solve_with_associations(SlamProblem(world.odometry, world.observations), world.object_of, true_scales)
    if arguments.stated:
        table = world.observations
        config = replace(
            config,
            odometry_rotation_scale=true_scales.odometry_rotation_scale,
            odometry_translation_scale=true_scales.odometry_translation_scale,
            odometry_translation_ratio=true_scales.odometry_translation_ratio,
        )
    else:
        table = without_scales(world.observations)
    start = time.process_time()
    result = solve(SlamProblem(world.odometry, table), config)
    seconds = time.process_time() - start
    noise = result.state.noise
    row = figures(world, result, oracle.estimate.T_world_camera)
    row["rotation_scale"] = float(np.median(noise.rotation_step))
    row["translation_scale"] = float(np.median(noise.translation_step))
    true = np.sqrt(np.trace(world.observations.position_covariance, axis1=1, axis2=2))
    row["position_scale/true"] = float(np.median(np.sqrt(np.trace(noise.position_covariance, axis1=1, axis2=2)) / true))
    row["factor"] = noise.position_factor
    row["rotation_factor"] = noise.rotation_factor
    row["seconds"] = seconds
    if noise.warnings:
        print("   ", *noise.warnings, sep="\n    ")
    return row


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments)
    rows = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        rows.append(run(seed, arguments))
        print(seed, "  ".join(f"{k} {v:.3g}" for k, v in rows[-1].items()), flush=True)
    print()
    for key in rows[0]:
        values = np.array([row[key] for row in rows if key in row])
        half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
        print(f"{key:20s} mean {values.mean():.3f} +- {half:.3f}  median {np.median(values):.3f}  worst {values.max():.3f}")


if __name__ == "__main__":
    main()
