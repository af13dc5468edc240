# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # SLAM on a drive from files
#
# Odometry and detections in files, a corrected trajectory and a map out: what `nolbo slam` does, called from Python, and how to
# judge the result. No network takes part. The files are those of [SLAM](../docs/slam.md): KITTI poses and JSON Lines.

# %%
# %matplotlib inline
import json
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from nolbo_ppl.cli.slam import SlamRunConfig, run
from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_sequence
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory
from nolbo_ppl.metrics.association import association_pairs, landmark_to_object, normalised_error_squared
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, align, path_length

TRUTH, VO, OWN, OBJECT = "black", "#9aa3ab", "#4e79a7", "#e15759"
folder = Path(tempfile.mkdtemp(prefix="nolbo-"))

# %% [markdown]
# ## The drive
#
# Set `NOLBO_DATA` to a folder with the KITTI odometry poses (`kitti_odometry/poses/07.txt`) to drive through Karlsruhe. Without
# it the way is a loop of straight streets and round corners, a lap and a half. Either way the world is simulated: objects stand
# beside the road, a detector sees them with noise, misses some, and invents others; the odometry drifts.


# %%
def streets(corners, spacing=3.0, radius=9.0):
    """Camera poses along a closed polygon of streets with rounded corners, `corners` passed in turn."""
    points = []
    for before, here, after in zip(corners, corners[1:], corners[2:]):
        start, end = (here + radius * (there - here) / np.linalg.norm(there - here) for there in (before, after))
        bend = np.linspace(0, 1, 12)[:, None]
        points.extend((1 - bend) ** 2 * start + 2 * bend * (1 - bend) * here + bend**2 * end)
    way = np.array(points)
    along = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    at = np.arange(0, along[-1], spacing)
    x, z = (np.interp(at, along, way[:, i]) for i in range(2))
    ahead = np.stack((np.gradient(x), np.zeros_like(x), np.gradient(z)), axis=-1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    down = np.tile([0.0, 1.0, 0.0], (len(at), 1))
    T = make_pose(np.stack((np.cross(down, ahead), down, ahead), axis=-1), np.stack((x, np.zeros_like(x), z), axis=-1))
    return np.linalg.inv(T[0]) @ T


kitti = Path(os.environ.get("NOLBO_DATA", "")) / "kitti_odometry" / "poses" / "07.txt"
if "NOLBO_DATA" in os.environ and kitti.is_file():
    truth = read_trajectory(kitti).T_world_camera[::3]
else:
    corners = np.array([(0, 0), (0, 120), (70, 120), (70, 60), (150, 60), (150, 0)], dtype=float)
    truth = streets(np.concatenate((corners, corners, corners[:3])))[: int(1.5 * 540 / 3)]

rng = np.random.default_rng(9)
drive = simulate_sequence(
    truth,
    rng,
    world=WorldConfig(objects=160, categories=8, instance_scale=0.8, lateral=(4.0, 10.0)),
    detector=DetectorConfig(maximum_range=20.0, clutter_rate=0.3),
    odometry_rotation_scale=0.006,
    odometry_translation_ratio=0.02,
)
write_trajectory(folder / "odometry.txt", Trajectory(drive.odometry))
write_trajectory(folder / "truth.txt", Trajectory(truth))
write_observations(folder / "observations.jsonl", drive.observations)
print(f"{len(truth)} keyframes, {path_length(truth):.0f} m, {len(drive.observations)} detections")
print((folder / "odometry.txt").read_text().splitlines()[1])
line = json.loads((folder / "observations.jsonl").read_text().splitlines()[0])
print({name: line[name] for name in ("frame", "position", "objectness", "category")})

# %% [markdown]
# ## Run it
#
# The same as `nolbo slam --odometry odometry.txt --observations observations.jsonl --truth truth.txt --out map`. The truth is
# for the errors in the summary alone.

# %%
result, summary = run(
    SlamRunConfig(
        odometry=folder / "odometry.txt",
        observations=folder / "observations.jsonl",
        truth=folder / "truth.txt",
        out=folder / "map",
    )
)
for name in ("frames", "observations", "tracklets", "landmarks", "loop_pairs"):
    print(f"{name:14s} {summary[name]}")
print(f"{'error before':14s} {summary['before']['ate']:.2f} m")
print(f"{'error after':14s} {summary['after']['ate']:.2f} m")
print("written:", ", ".join(sorted(path.name for path in (folder / "map").iterdir())))

# %% [markdown]
# ## Trajectory and map

# %%
estimate = align(result.T_world_camera, truth)
moved = estimate[0] @ np.linalg.inv(result.T_world_camera[0])  # the same motion takes the map to the truth's frame
place = np.array([moved @ landmark.T_world_object for landmark in result.landmarks])[:, :3, 3]
existence = np.array([landmark.existence for landmark in result.landmarks])
figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained", sharex=True, sharey=True)
for axis, T, colour, label in ((axes[0], align(drive.odometry, truth), VO, "odometry"), (axes[1], estimate, OWN, "corrected")):
    axis.plot(truth[:, 0, 3], truth[:, 2, 3], color=TRUTH, lw=0.9, ls="--", label="truth")
    axis.plot(T[:, 0, 3], T[:, 2, 3], color=colour, lw=1.4, label=label)
    axis.set(aspect="equal", xlabel="x, m", ylabel="z, m")
    axis.legend(frameon=False, fontsize=8)
axes[1].scatter(*drive.world.position[:, [0, 2]].T, s=30, marker="+", color="#bbbbbb", lw=0.8)
shown = axes[1].scatter(place[:, 0], place[:, 2], s=10, c=existence, cmap="viridis", vmin=0, vmax=1, zorder=3)
figure.colorbar(shown, ax=axes[1], label="probability of existing (+: true objects)")
# %% [markdown]
# ## Error along the way
#
# Distance to the truth after a rigid alignment, before and after, with the trajectory's own claim: the standard deviation of its
# position. A loop shows as a fall of the error, and its covariance knows.

# %%
before = absolute_trajectory_error(drive.odometry, truth).errors
after = absolute_trajectory_error(result.T_world_camera, truth).errors
claim = np.sqrt(np.trace(result.pose_covariances()[:, 3:, 3:], axis1=1, axis2=2))
figure, axis = plt.subplots(figsize=(9, 2.8), layout="constrained")
axis.plot(before, color=VO, label="odometry")
axis.plot(after, color=OWN, label="corrected")
axis.plot(claim, color=OWN, ls=":", label="its standard deviation, from the first pose")
axis.set(xlabel="keyframe", ylabel="m", ylim=(0, None))
axis.legend(frameon=False, fontsize=8)
# %% [markdown]
# ## Are the loops right?
#
# A lower error alone proves little. Pairs of detections of one object, more than fifty keyframes apart, are the loops: how many
# of those the map joins are right (precision), and how many of the true ones it found (recall).

# %%
landmark_of = association_table(result).landmark_of
score = association_pairs(drive.observations.frame, drive.object_of, landmark_of, minimum_gap=50)
print(f"loop pairs: {score.true_pairs} true, {score.found_pairs} found")
print(f"precision {score.precision:.3f}, recall {score.recall:.3f}")

order = np.argsort(drive.observations.frame, kind="stable")
frame = drive.observations.frame
figure, axis = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
joined = landmark_of[:, None] == landmark_of
joined &= (landmark_of >= 0)[:, None] & (frame[:, None] > frame + 50)
a, b = np.nonzero(joined)
correct = (drive.object_of[a] == drive.object_of[b]) & (drive.object_of[a] >= 0)
axis.scatter(frame[b][correct], frame[a][correct], s=2, color=OWN, label="right")
axis.scatter(frame[b][~correct], frame[a][~correct], s=8, color=OBJECT, label="wrong")
axis.set(xlabel="earlier keyframe", ylabel="later keyframe", title="loops", xlim=(0, len(truth)), ylim=(0, len(truth)))
axis.legend(frameon=False, fontsize=8, markerscale=2)
# %% [markdown]
# ## Are the uncertainties right?
#
# For each landmark with a true object: squared error over claimed covariance, by degree of freedom, in the frame of the first
# camera, which both hold fixed. It is 1 on average when covariances are right, and more when they are too small. Mind that all
# landmarks share the camera's drift: one drive is a few draws of it, not a hundred. Average over drives before you conclude.

# %%
object_of_landmark, _ = landmark_to_object(drive.object_of, landmark_of, len(result.landmarks))
matched = np.flatnonzero(object_of_landmark >= 0)
fixed = truth[0] @ np.linalg.inv(result.T_world_camera[0])
error = np.array([(fixed @ result.landmarks[j].T_world_object)[:3, 3] for j in matched])
error -= drive.world.position[object_of_landmark[matched]]
covariance = np.array([fixed[:3, :3] @ result.landmarks[j].position_covariance @ fixed[:3, :3].T for j in matched])
nees = normalised_error_squared(error, covariance)
print(
    f"{len(matched)} of {len(result.landmarks)} landmarks are true objects; "
    f"{len(set(object_of_landmark[matched].tolist()))} different ones, of {len(drive.world.position)}"
)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained")
axes[0].hist(np.clip(nees, 0, 5), 30, color=OWN)
axes[0].axvline(1, color="black", lw=0.8)
axes[0].set(title=f"squared error over covariance, mean {nees.mean():.2f}", xlabel="by degree of freedom")
size = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
axes[1].plot(size, np.linalg.norm(error, axis=1), ".", color=OWN)
axes[1].plot([0, size.max()], [0, size.max()], color="black", lw=0.8)
axes[1].set(xlabel="claimed standard deviation, m", ylabel="actual error, m", title="landmarks")
# %% [markdown]
# ## One landmark
#
# What the map knows of an object: pose with covariance, class posterior, shape latent with variance, and whether it exists at
# all. With `model=` in the arguments (`nolbo slam --model tiny`) the latents of the shipped guide are decoded to voxels too;
# the tutorial [Shape from many views](shape_from_many_views.py) shows how.

# %%
best = max(result.landmarks, key=lambda landmark: landmark.detections)
print(f"{best.name}: {best.detections:.1f} detections in keyframes {best.first_frame} to {best.last_frame}")
print("position", best.T_world_object[:3, 3].round(2), "±", np.sqrt(np.diag(best.position_covariance)).round(3), "m")
print(f"exists with probability {best.existence:.4f}")
print("class", {name: round(p, 3) for name, p in sorted(best.class_posterior.items(), key=lambda item: -item[1])[:3]})
dimension = np.arange(len(best.latent))
figure, axis = plt.subplots(figsize=(8, 2.4), layout="constrained")
axis.errorbar(dimension, best.latent, np.sqrt(best.latent_variance), fmt="o", color=OWN, capsize=2)
if (j := object_of_landmark[best.index]) >= 0:
    axis.plot(dimension, drive.world.latent[j], color="black", drawstyle="steps-mid", lw=1, label="truth")
    axis.legend(frameon=False, fontsize=8)
axis.set(xlabel="dimension", title="shape latent from all views")
