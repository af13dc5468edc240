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
# # The posterior of one scene
#
# The guide sees an image once and answers, for every region of it, with distributions: is there an object, of which
# category, seen from where, how large in the image, how far away, of which shape. This notebook renders a scene that no
# training has seen, observes it with the weights of the package, and pictures each distribution beside the truth.
#
# Equations are named by their labels in the appendix of the NOLBO paper
# ([arXiv:1907.09760](https://arxiv.org/abs/1907.09760)); where the library departs from them,
# [docs/story.md](../docs/story.md) and [docs/bound.md](../docs/bound.md) say so.

# %%
# %matplotlib inline
import math
import os

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.stats import norm

import nolbo_ppl
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.metrics.detection import match_image
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.viz.panels import azimuth_density
from nolbo_ppl.viz.posterior_plots import draw_observations
from nolbo_ppl.viz.shape_plots import draw_shape, draw_uncertainty
from nolbo_ppl.viz.style import category_colour

model = nolbo_ppl.load(os.environ.get("NOLBO_MODEL", "tiny"))
source = SceneGenerator(preset("standard", model.config.image_size), seed=77_001)
candidates = [source.render(i) for i in range(8)]
scene = max(candidates, key=lambda one: sum(label.visibility > 0.5 for label in one.labels))
print("objects:", ", ".join(label.category for label in scene.labels))

# %% [markdown]
# ## Objectness of every region
#
# The encoder's grid has a cell for each patch of the image, and two predictors a cell. Each region k has a Bernoulli
# $q(o_k \mid I)$. In training it is drawn to $p(o_k \mid l_k)$, which is $1-\epsilon$ for an object and $\epsilon$ for
# background, by $KL(p \,\|\, q)$: the direction of the paper's training (its bound, eq. `ELBO`, has the other one).

# %%
image = torch.from_numpy(scene.image.transpose(2, 0, 1).copy())[None]
encoding = model.encode(image)
logit = model.calibration.objectness(encoding.objectness_logit)[0]
objectness = torch.sigmoid(logit).reshape(encoding.rows, encoding.columns, -1).numpy()
side = model.config.image_size

figure, axes = plt.subplots(1, 1 + objectness.shape[-1], figsize=(11, 3.6), layout="constrained")
axes[0].imshow(scene.image)
axes[0].set_title("the scene")
for p, panel in enumerate(axes[1:]):
    panel.imshow(scene.image, alpha=0.35, extent=(0, side, side, 0))
    shown = panel.imshow(objectness[..., p], vmin=0, vmax=1, cmap="magma", alpha=0.75, extent=(0, side, side, 0))
    panel.set_title(f"q(o = 1 | I), predictor {p}")
figure.colorbar(shown, ax=axes[1:], shrink=0.85)
# %% [markdown]
# Regions above a threshold that survive non-maximum suppression are the detections. `observe` returns all their
# posteriors; this is the library's own picture of them.

# %%
objects = model.observe(scene.image, scene.intrinsics, threshold=0.3)
draw_observations(scene.image, objects, scene.intrinsics, prior_mean=model.prior_mean(), objects=3)

# %% [markdown]
# From here on one object: the most certain one that overlaps a true object. The truth is shown in black.

# %%
boxes = np.array([label.box for label in scene.labels])
matched = match_image(objects.box, objects.objectness, boxes, np.zeros(len(boxes), dtype=bool))
index = int(np.flatnonzero(matched >= 0)[0]) if (matched >= 0).any() else 0
truth = scene.labels[max(int(matched[index]), 0)]
colour = category_colour(objects.category[index])
ray = torch.from_numpy(truth.position)[None]
true_rotation = egocentric_to_allocentric(torch.from_numpy(truth.R_camera_object)[None], ray)
true_viewpoint = matrix_to_viewpoint(true_rotation)[0].numpy()
print(f"observed: {objects.category[index]} ({objects.objectness[index]:.3f}), truth: {truth.category}")

# %% [markdown]
# ## Category: the head's posterior, and maximum likelihood over the prior means
#
# The label's Gaussian mixture $p_\psi(z \mid l) = N(z; \mu_\psi(l), I)$ makes a classifier of the shape latent:
# $\hat l = \arg\max_l N(\mu_q; \mu_\psi(l), I)$ (eq. `MLEproblemfinal`). Beside it the head's own $q(l \mid I)$.

# %%
likelihood = objects.class_log_likelihood[index]
normalised = np.exp(likelihood - np.logaddexp.reduce(likelihood))
place = np.arange(len(objects.categories))
figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
axis.bar(place - 0.2, objects.class_posterior[index], 0.4, label="q(l | I)", color=colour)
axis.bar(place + 0.2, normalised, 0.4, label="N(μ_q; μ_ψ(l), I), normalised", color="#9aa3ab")
axis.set_xticks(place, objects.categories, rotation=40, ha="right")
axis.get_xticklabels()[objects.categories.index(truth.category)].set_fontweight("bold")
axis.set(ylabel="probability", ylim=(0, 1.02), title=f"category (truth in bold: {truth.category})")
axis.legend(frameon=False)
# %% [markdown]
# ## Azimuth: a mixture of von Mises densities
#
# The story throws the orientation latent as a wrapped normal about the true angle (eq. `meanvarofwrappedgaussian` gives
# its moments). The guide's azimuth is a mixture, because a view can be ambiguous: front and back, or the turns of a
# symmetric object. The modes are kept for SLAM. Angles are allocentric: relative to the ray through the object.

# %%
angle = np.linspace(-math.pi, math.pi, 1441)
density = azimuth_density(objects, index, angle)
modes = objects.viewpoint_modes
figure = plt.figure(figsize=(9, 3.6), layout="constrained")
polar, line = figure.add_subplot(1, 2, 1, projection="polar"), figure.add_subplot(1, 2, 2)
polar.plot(angle, density, color=colour)
polar.fill(angle, density, color=colour, alpha=0.3)
polar.set_theta_zero_location("S")
polar.plot([true_viewpoint[0]] * 2, [0, density.max()], color="black", lw=1.5)
polar.set_yticks([])
line.semilogy(np.degrees(angle), density, color=colour)
line.axvline(np.degrees(true_viewpoint[0]), color="black", label="truth")
for weight, mean, concentration in zip(modes.weights[index], modes.azimuth[index], modes.concentration[index]):
    if weight > 0.01:
        line.axvline(np.degrees(mean), color=colour, lw=0.5 + 2 * weight, ls=":")
        print(f"mode of weight {weight:.3f} at {np.degrees(mean):6.1f}°, scale {np.degrees(concentration**-0.5):.1f}°")
line.set(xlabel="azimuth, degrees", ylabel="density, 1/rad", ylim=(1e-4, None), title="log density")
line.legend(frameon=False)
# %% [markdown]
# ## Elevation and in-plane rotation: Normals

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), layout="constrained")
for k, (axis, name) in enumerate(zip(axes, ("elevation", "in-plane rotation"))):
    mean, scale = objects.elevation_inplane[index, k], objects.elevation_inplane_scale[index, k]
    x = mean + scale * np.linspace(-4, 4, 201)
    axis.plot(np.degrees(x), norm.pdf(x, mean, scale), color=colour)
    axis.fill_between(np.degrees(x), norm.pdf(x, mean, scale), color=colour, alpha=0.3)
    axis.axvline(np.degrees(true_viewpoint[1 + k]), color="black")
    axis.set(xlabel=f"{name}, degrees", yticks=[], title=f"{np.degrees(mean):.1f}° ± {np.degrees(scale):.1f}°")

# %% [markdown]
# ## Position: a Gaussian in the camera frame
#
# The paper needs a position for SLAM and does not say where it comes from. Here a range latent gives log distance over
# pixels of a radian there, and the projected centre; together with the box they make a position whose covariance is long
# along the ray and narrow across it. The surface is the 90 % region.

# %%
mean, covariance = objects.position[index], objects.position_covariance[index]
u, v = np.meshgrid(np.linspace(0, 2 * math.pi, 40), np.linspace(0, math.pi, 20))
sphere = np.stack((np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)), -1)
surface = mean + math.sqrt(6.2514) * sphere @ np.linalg.cholesky(covariance).T  # 6.2514: chi-square of 3 at 90 %
figure = plt.figure(figsize=(10, 4))
space = figure.add_subplot(1, 2, 1, projection="3d")
space.plot_surface(surface[..., 0], surface[..., 2], -surface[..., 1], color=colour, alpha=0.35, lw=0)
for end, style in ((mean, "-"), (truth.position, ":")):
    space.plot([0, end[0]], [0, end[2]], [0, -end[1]], color="black", lw=0.8, ls=style)
space.scatter(truth.position[0], truth.position[2], -truth.position[1], color="black", s=30)
space.set(xlabel="x, m", ylabel="z (forward), m", zlabel="-y (up), m", title="90 % region, camera at the origin")

# %% [markdown]
# ## Range: log-normal
#
# The density of the distance along the ray, and of the object's size: an image fixes their ratio well and each of them
# only through what objects of a category usually measure.

# %%
distance = float(np.linalg.norm(mean))
direction = mean / distance
log_scale = math.sqrt(float(direction @ covariance @ direction)) / distance
figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), layout="constrained")
true_distance = float(np.linalg.norm(truth.position))
log_diagonal, log_diagonal_scale = math.log(objects.diagonal[index]), float(objects.diagonal_log_scale[index])
rows = (
    (axes[0], "distance, m", math.log(distance), log_scale, true_distance),
    (axes[1], "diagonal of the box, m", log_diagonal, log_diagonal_scale, truth.size),
)
for axis, name, centre, scale, true_value in rows:
    x = np.exp(centre + scale * np.linspace(-4, 4, 201))
    axis.plot(x, norm.pdf(np.log(x), centre, scale) / x, color=colour)
    axis.fill_between(x, norm.pdf(np.log(x), centre, scale) / x, color=colour, alpha=0.3)
    axis.axvline(true_value, color="black")
    axis.set(xlabel=name, yticks=[], title=f"{math.exp(centre):.2f} m, log scale {scale:.2f}")

# %% [markdown]
# ## Shape latent against the prior means
#
# $q(z \mid I)$ with mean and scale, the mean $\mu_\psi(l)$ of its category, those of the other categories in grey, and
# the posterior $q(z \mid \text{true voxels})$ of the shape autoencoder, the target in training (in black).

# %%
prior = model.prior_mean()
teacher, teacher_scale = model.shape_posterior(truth.item.voxels[None])
latent, latent_scale = objects.latent[index], objects.latent_scale[index]
dimension = np.arange(len(latent))
figure, axis = plt.subplots(figsize=(10, 3.2), layout="constrained")
for category, row in zip(objects.categories, prior):
    own = category == objects.category[index]
    axis.plot(dimension, row, color=colour if own else "#c9ced3", lw=2 if own else 0.7, zorder=2 if own else 1)
axis.errorbar(dimension, latent, latent_scale, fmt="o", color=colour, capsize=2, label="q(z | I)", zorder=3)
axis.errorbar(
    dimension + 0.2,
    teacher[0],
    teacher_scale[0],
    fmt="s",
    color="black",
    ms=3,
    capsize=2,
    label="q(z | true voxels)",
    zorder=3,
)
axis.set(xlabel="dimension", title=f"shape latent, and the prior mean of {objects.category[index]} (line)")
axis.legend(frameon=False, ncols=2)
# %% [markdown]
# ## Voxels: mean and variance over the posterior
#
# Decoding samples of the latent gives a mean occupancy and, for each voxel, the variance of its occupancy probability
# over the posterior: where the shape is not settled by the image. Below: projections along the three axes (mean as the
# greatest occupancy, scale as the greatest standard deviation), then the mesh at the estimated viewpoint, the same
# surface coloured by its scale, and the true shape.

# %%
voxel_mean, voxel_scale = objects.voxel_mean[index], np.sqrt(objects.voxel_variance[index])
true_voxels = unpack_voxels(truth.item.voxels[None], 32)[0]
figure, axes = plt.subplots(3, 3, figsize=(8, 7.4), layout="constrained")
for k, name in enumerate(("from the right", "from the back", "from above")):
    for row, (grid, title) in enumerate(((voxel_mean, "mean"), (voxel_scale, "scale"), (true_voxels, "truth"))):
        panel = axes[row, k]
        colours, top = (("viridis", 1), ("magma", 0.5), ("gray", 1))[row]
        shown = panel.imshow(grid.max(axis=k).T, origin="lower", cmap=colours, vmin=0, vmax=top)
        panel.set(xticks=[], yticks=[], title=f"{title}, {name}")
        if k == 2:
            figure.colorbar(shown, ax=panel)

# %%
viewpoint = objects.viewpoint[index]
figure = plt.figure(figsize=(10, 3.4))
grid = figure.add_gridspec(1, 3)
for place, draw in zip(
    grid,
    (
        lambda place: draw_shape(figure, place, voxel_mean, colour, viewpoint),
        lambda place: draw_uncertainty(figure, place, voxel_mean, objects.voxel_variance[index], viewpoint),
        lambda place: draw_shape(figure, place, true_voxels.astype(float), "#444444", true_viewpoint),
    ),
):
    draw(place)
for x, name in ((0.2, "mean shape"), (0.5, "scale of its voxels"), (0.8, "true shape")):
    figure.text(x, 0.96, name, ha="center")

# %% [markdown]
# `objects.mesh(i)` gives the mesh itself by marching cubes, in metres and the object's own frame; `objects.to_records(...)`
# the lines that `nolbo slam` reads.

# %%
vertices, faces = objects.mesh(index)
print(f"{len(vertices)} vertices, {len(faces)} faces")
print(f"extents {np.ptp(vertices, axis=0).round(2)} m, truth {truth.dimensions.round(2)} m")
