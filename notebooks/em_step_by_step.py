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
# # EM step by step
#
# A camera drives around a small block twice. Its odometry drifts, its detector misses things and sees things that are not
# there. This notebook runs the EM one iteration at a time and looks inside: which detection is which object, before and
# after; what the bound does; and what objectness is for. The mathematics is in [the EM](../docs/em.md).

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.association import association_marginals
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, em_init, em_solve, finish, init, step
from nolbo_ppl.inference.slam.reference_em import e_step
from nolbo_ppl.metrics.association import landmark_to_object
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

LAP = 80
rng = np.random.default_rng(2)
truth = simulate_circuit(rng, laps=2, radius=35.0, frames_per_lap=LAP)
drive = simulate_sequence(
    truth,
    rng,
    world=WorldConfig(objects=40, categories=5, latent_dim=8, category_scale=2.0, lateral=(4.0, 9.0)),
    detector=DetectorConfig(maximum_range=18.0, clutter_rate=0.4),
    odometry_rotation_scale=0.012,
    odometry_translation_ratio=0.02,
)
problem, config, table = SlamProblem(drive.odometry, drive.observations), SlamConfig(), drive.observations
OBJECT, VO, OWN = "#e15759", "#9aa3ab", "#4e79a7"


def path(axis, T, **style):
    """A trajectory from above."""
    axis.plot(T[:, 0, 3], T[:, 2, 3], **style)


figure, axis = plt.subplots(figsize=(5.4, 5), layout="constrained")
path(axis, truth, color="black", lw=1, ls="--", label="truth")
path(axis, drive.odometry, color=VO, lw=1.2, label="odometry")
axis.scatter(drive.world.position[:, 0], drive.world.position[:, 2], s=14, color=OBJECT, label="objects")
axis.set(aspect="equal", xlabel="x, m", ylabel="z, m", title="two laps, from above")
axis.legend(frameon=False, fontsize=8)
print(f"{len(table)} detections of {len(drive.world.position)} objects, {np.sum(drive.object_of < 0)} of nothing")
print(f"error of the odometry: {absolute_trajectory_error(drive.odometry, truth).rmse:.2f} m")

# %% [markdown]
# ## `init`: scales and tracklets
#
# Over a few frames odometry is good. So detections of one object in neighbouring frames are put together first, by exact
# association frame by frame: tracklets. Standard deviations that nobody states are estimated from the data on the way. No loop
# is closed yet, so what was passed twice is there twice: below, each tracklet by the lap it was seen in.

# %%
state = init(problem, config)
second = state.features.first >= LAP
figure, axis = plt.subplots(figsize=(5.4, 5), layout="constrained")
path(axis, state.estimate.T_world_camera, color=VO, lw=1)
for own, colour, label in ((~second, OWN, "seen in the first lap"), (second, OBJECT, "seen in the second lap")):
    place = state.estimate.T_world_landmark[own, :3, 3]
    axis.scatter(place[:, 0], place[:, 2], s=16, color=colour, label=label)
axis.set(aspect="equal", xlabel="x, m", ylabel="z, m", title=f"{len(second)} tracklets")
axis.legend(frameon=False, fontsize=8)

# %% [markdown]
# ## The literal EM
#
# The paper's EM takes the landmarks and the sensor's covariance and asks for each detection which landmark it is. Here
# are the weights $w_{kj}$ of the *second* lap's detections for the *first* lap's landmarks, where the odometry puts them. A row
# is a true object (mean over its detections), a column a landmark, both in the order of the drive.


# %%
first = np.flatnonzero(~second)
object_of_landmark = landmark_to_object(drive.object_of[state.rows], state.landmark, len(second))[0][first]
later = (table.frame >= LAP) & (drive.object_of >= 0)
seen_in_both = [j for j in object_of_landmark if j >= 0 and (drive.object_of[later] == j).any()]
common = np.array(list(dict.fromkeys(seen_in_both)))


def weights_of(T_world_camera, T_world_landmark, latent):
    """Weights of the second lap's objects for given landmarks, with the camera where it is said to be."""
    plain = em_init(SlamProblem(T_world_camera, table), config, T_world_landmark, latent)
    _, weights, _ = e_step(plain)
    return np.array([weights[later & (drive.object_of == k)].mean(0) for k in common])


before = weights_of(drive.odometry, state.estimate.T_world_landmark[first], state.features.latent[first])


def show(axis, weights, columns, title):
    """A matrix of weights; true pairs are framed."""
    shown = axis.imshow(weights, vmin=0, vmax=1, cmap="magma", aspect="auto")
    for row, k in enumerate(common):
        for column in np.flatnonzero(columns == k):
            axis.add_patch(plt.Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, ec="#59a14f", lw=0.8))
    axis.set(title=title, xlabel="landmark", ylabel="object seen in the second lap")
    return shown


figure, axis = plt.subplots(figsize=(6, 4.6), layout="constrained")
figure.colorbar(show(axis, before, object_of_landmark, "weights before (true pairs framed)"))
right = np.isin(np.arange(before.size).reshape(before.shape), []) | (common[:, None] == object_of_landmark)
print(f"weight on the true landmark, mean over objects: {np.where(right, before, 0).sum(1).mean():.2f}")

# %% [markdown]
# The diagonal should be bright. But after a lap of drift most true landmarks lie many sensor scales beside their detections:
# under the sensor's covariance they are no candidates. Started from all tracklets, the EM runs all the same, and its bound, the
# log posterior, never falls; it climbs to a local maximum that keeps two copies of the street.

# %%
plain = em_init(problem, config, state.estimate.T_world_landmark, state.features.latent)
plain, infos = em_solve(plain, iterations=8)
bound = [info.bound for info in infos]
figure, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
axis.plot(range(1, len(bound) + 1), bound, "o-", color=OWN)
axis.set(xlabel="iteration", ylabel="nats", title="bound of the literal EM")
print(f"smallest change of the bound: {np.diff(bound).min():+.2e} nats")
print(f"error: {absolute_trajectory_error(plain.estimate.T_world_camera, truth).rmse:.2f} m")

# %% [markdown]
# ## `step`: covariances that know of the drift
#
# The working EM asks the graph itself how far two tracklets may lie apart: posterior samples of the linearised graph hold the
# drift between two passes. It first matches whole constellations of tracklets, then lets every link be decided anew, softly.
# Each `step` returns a new state and what it did; states are frozen, so the whole history can be kept. The pictures show, in
# orange, the links that the step to come will pull on.

# %%
states, steps = [state], []
for _ in range(6):
    state, info = step(state)
    states.append(state)
    steps.append(info)
    print(
        f"{info.iteration}: {info.phase:13s} {info.links:3d} links, {info.strong_links:3d} strong, "
        f"cameras moved {info.change:.3f} m, error "
        f"{absolute_trajectory_error(state.estimate.T_world_camera, truth).rmse:.2f} m"
    )

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained", sharex=True, sharey=True)
for axis, number in zip(axes, (0, 1, len(steps))):
    now, following = states[number], states[min(number + 1, len(steps))]
    path(axis, truth, color="black", lw=0.8, ls="--")
    path(axis, now.estimate.T_world_camera, color=OWN, lw=1.2)
    place = now.estimate.T_world_landmark[:, :3, 3]
    axis.scatter(place[:, 0], place[:, 2], s=10, color=OBJECT, zorder=3)
    for a, b, w in zip(following.links.a, following.links.b, following.links.weight):
        axis.plot(place[[a, b], 0], place[[a, b], 2], color="#f28e2b", lw=0.5 + 2 * w)
    error = absolute_trajectory_error(now.estimate.T_world_camera, truth).rmse
    when = f"{number} step{'s' * (number > 1)}" if number else "init"
    axis.set(aspect="equal", title=f"after {when}: {error:.2f} m")
axes[0].set(xlabel="x, m", ylabel="z, m")
# %% [markdown]
# Its log evidence is reported for each iteration. This form is no coordinate ascent on the bound above: covariances change
# between iterations, and are inflated in the first ones. Compare values within a phase only.

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), layout="constrained")
number = [info.iteration for info in steps]
colours = [OWN if info.phase == "em" else "#f28e2b" for info in steps]
axes[0].bar(number, [info.log_evidence for info in steps], color=colours)
axes[0].set(title="log evidence, nats (orange: constellations)", xlabel="iteration")
axes[1].semilogy(number, [max(info.change, 1e-4) for info in steps], "o-", color=OWN)
axes[1].set(title="motion of the cameras, m", xlabel="iteration")
# %% [markdown]
# ## Weights after
#
# `finish` merges linked tracklets into landmarks, solves once more without robust kernels, and associates every detection anew
# with the map, exactly, frame by frame. The same matrix as above, from the corrected trajectory and the landmarks of the map:

# %%
final, associations = finish(state)
object_of = drive.object_of[associations.row]
object_of_final, _ = landmark_to_object(object_of, associations.landmark, len(final.static), associations.weight)
shown_columns = np.array([j for k in common for j in np.flatnonzero(object_of_final == k)])
after = np.zeros((len(common), len(final.static)))
for row, k in enumerate(common):
    own = np.flatnonzero(later & (drive.object_of == k))
    inside = np.isin(associations.row, own)
    np.add.at(after[row], associations.landmark[inside], associations.weight[inside] / len(own))
figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
show(axes[0], before, object_of_landmark, "before")
figure.colorbar(show(axes[1], after[:, shown_columns], object_of_final[shown_columns], "after"), ax=axes)
right = common[:, None] == object_of_final
print(f"weight on the true landmark, mean over objects: {np.where(right, after, 0).sum(1).mean():.2f}")

# %% [markdown]
# ## What objectness does
#
# A frame with two detections near one landmark, and a second landmark farther off. Detection 2 has objectness $q$. The odds
# of a detection for a landmark are $q(o)\,A_{kj}$, so does $q$ decide who gets the landmark?
#
# **Without a background hypothesis it does not**: every association holds both detections, the factor $q$ is in all of them, and
# divides out of the weights. **With one**, detection 2 may also be nothing at all, with odds $(1 - q)\,\lambda_{clutter}$, and a
# doubtful detection leaves the landmark to the other.

# %%
log_A = np.log(np.array([[0.30, 0.001], [0.40, 0.020]]))  # two detections, two landmarks
log_clutter, log_new = np.log(0.05), np.log(0.001)
q = np.linspace(0.01, 0.99, 99)
without, with_background = [], []
for value in q:
    objectness = np.array([0.95, value])
    log_odds = log_A + np.log(objectness)[:, None]
    without.append(association_marginals(log_odds, np.full(2, -np.inf)).weights)
    log_null = np.logaddexp(np.log(objectness) + log_new, np.log1p(-objectness) + log_clutter)
    with_background.append(association_marginals(log_odds, log_null).weights)
figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained", sharey=True)
for axis, weights, title in zip(axes, (without, with_background), ("without background", "with background")):
    weights = np.array(weights)
    for k, j, colour, dashes in ((0, 0, OWN, "-"), (1, 0, OBJECT, "-"), (1, 1, "#59a14f", "--")):
        axis.plot(q, weights[:, k, j], color=colour, ls=dashes, label=f"detection {k + 1} is landmark {j + 1}")
    axis.set(title=title, xlabel="objectness of detection 2", ylim=(-0.02, 1.02))
axes[0].set_ylabel("weight")
axes[1].legend(frameon=False, fontsize=8)
print(f"without background, weights change by {np.ptp(np.array(without), axis=0).max():.0e} over all objectnesses")

# %% [markdown]
# In the drive above, detections of nothing have low objectness. How probable the EM holds it that each detection is background,
# by what it truly was:

# %%
figure, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
edges = np.linspace(0, 1, 21)
for own, colour, label in ((drive.object_of >= 0, OWN, "objects"), (drive.object_of < 0, OBJECT, "nothing")):
    axis.hist(associations.background[own], edges, color=colour, alpha=0.7, label=label, log=True)
axis.set(xlabel="probability of background", ylabel="detections")
axis.legend(frameon=False)
