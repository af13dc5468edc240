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
# # Shape from many views
#
# One image shows one side of an object. The guide's shape latent says so: its scale is wide where the image settles
# nothing. A map sees its objects again and again, and the EM fuses what each view says by its precision
# ([the EM](../docs/em.md)). This notebook does that alone, with known association: ten views of one object, the posterior
# after each, decoded.

# %%
# %matplotlib inline
import os

import matplotlib.pyplot as plt
import numpy as np

import nolbo_ppl
from nolbo_ppl.geometry.voxels import unpack_voxels, voxel_iou
from nolbo_ppl.inference.slam.detection_features import weighted_latents
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.renderer.camera_view import MeshInstance, View
from nolbo_ppl.synthetic.renderer.materials import sample_materials
from nolbo_ppl.synthetic.scenes.environment import sample_environment, sample_light
from nolbo_ppl.synthetic.scenes.render_scene import Scene, SceneObject, render_scene
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_sampler import camera_rotation
from nolbo_ppl.viz.shape_plots import draw_shape, draw_uncertainty
from nolbo_ppl.viz.style import category_colour

VIEWS = 10
model = nolbo_ppl.load(os.environ.get("NOLBO_MODEL", "tiny"))
config = preset("easy", model.config.image_size)
pool = ShapeLibrary(model.config.categories, seed=88_001)  # shapes that no training has seen

# %% [markdown]
# ## Ten views of one object
#
# The object stands on the ground; the camera walks around it in uneven steps and looks at it from changing heights and
# distances. Its paint stays the same, the light does too.


# %%
def view_of(item, materials, azimuth, rng, size=config.size):
    """One image of an object that faces the camera at this azimuth."""
    elevation, fill = np.radians(rng.uniform(8, 35)), rng.uniform(0.45, 0.7)
    R_camera_world = camera_rotation(elevation, 0.0)
    c, s = np.cos(-azimuth), np.sin(-azimuth)
    R_camera_object = R_camera_world @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    intrinsics = np.array([1.4 * size, 1.4 * size, size / 2, size / 2])
    centre = np.array([0.0, 0.0, 1.4 / fill])  # scene units: the diagonal is one
    up, half_height = R_camera_world[:, 2], 0.5 * item.shape.dimensions[2] / item.shape.diagonal
    light = np.random.default_rng(4)
    lights, sky, ground = sample_light(config, light, R_camera_world)
    view = View(
        height=size,
        width=size,
        intrinsics=intrinsics,
        up=up,
        north=R_camera_world[:, 0],
        camera_height=half_height - float(up @ centre),
        placed=(MeshInstance(item.mesh, R_camera_object, centre, materials, 0),),
        lights=lights,
        ambient_sky=sky,
        ambient_ground=ground,
        backdrop=sample_environment(config, light, R_camera_world, None),
    )
    thing = SceneObject(R_camera_object, centre, 1.0, item)
    return render_scene(Scene(view, (thing,), 1.0, 0.0, 0.005, int(rng.integers(2**31)), 1, 0.0, 1.0))


def views_of(category, number, seed):
    """An instance of the pool and its images."""
    rng = np.random.default_rng([seed, number])
    item = pool.item(category, number)
    materials = sample_materials(item.shape.parts, rng)
    azimuths = rng.uniform(-np.pi, np.pi) + 2.4 * np.arange(VIEWS)  # the golden angle, nearly: no two views alike
    return item, [view_of(item, materials, azimuth, rng) for azimuth in azimuths]


item, images = views_of("chair", 3, seed=1)
figure, axes = plt.subplots(2, 5, figsize=(10, 4.1), layout="constrained")
for n, (axis, rendered) in enumerate(zip(axes.flat, images), start=1):
    axis.imshow(rendered.image)
    axis.set_axis_off()
    axis.set_title(f"view {n}", fontsize=9)

# %% [markdown]
# ## What each view says
#
# `observe_boxes` answers for given boxes, so that this notebook is about shape alone. Each view has a mean and a scale for
# each dimension of the latent. The black line is the shape autoencoder's posterior of the *true* voxels, which the guide
# was taught to predict: the single views scatter about it.


# %%
def observed(images):
    """Mean and scale of the shape latent by each view."""
    boxes = [rendered.labels[0].box[None] for rendered in images]
    cameras = np.array([rendered.intrinsics for rendered in images])
    answers = model.observe_boxes([rendered.image for rendered in images], cameras, boxes, decode=False)
    return np.concatenate([one.latent for one in answers]), np.concatenate([one.latent_scale for one in answers])


latent, scale = observed(images)
target, _ = model.shape_posterior(item.voxels[None])
dimension = np.arange(latent.shape[1])
figure, axis = plt.subplots(figsize=(10, 3), layout="constrained")
for n in range(VIEWS):
    axis.errorbar(
        dimension + 0.06 * (n - VIEWS / 2), latent[n], scale[n], fmt=".", color=plt.colormaps["viridis"](n / VIEWS), lw=0.8
    )
axis.plot(dimension, target[0], color="black", drawstyle="steps-mid", lw=1.2, label="of the true voxels")
axis.set(xlabel="dimension of the latent", title="latent by view, mean ± scale (dark: first view, light: last)")
axis.legend(frameon=False)

# %% [markdown]
# ## Fusing by precision
#
# $$\mu = \frac{\sum_k w_k \mu_k / s_k^2}{\sum_k w_k / s_k^2}, \qquad s^2 = \frac{1}{\sum_k w_k / s_k^2}$$
#
# This is the EM's latent update; the weights $w_k$ are the association marginals, all one here. The same function serves
# the SLAM.


# %%
def fused(latent, scale):
    """Posterior of the latent after 1, 2, ... views."""
    mean, variance = [], []
    for n in range(1, len(latent) + 1):
        m, v = weighted_latents(latent[:n], scale[:n] ** 2, np.zeros(n, dtype=int), np.ones(n), 1)
        mean.append(m[0])
        variance.append(v[0])
    return np.array(mean), np.array(variance)


def decoded(mean, variance, samples=8, seed=0):
    """Mean and variance of each voxel's occupancy over the posterior of the latent."""
    noise = np.random.default_rng(seed).standard_normal((samples, mean.shape[-1]))
    grids = model.decode(mean + np.sqrt(variance) * noise)
    return grids.mean(0), grids.var(0, ddof=1)


mean, variance = fused(latent, scale)
figure, axis = plt.subplots(figsize=(10, 2.8), layout="constrained")
for n, colour in ((1, "#b8c4d6"), (3, "#6f8fc0"), (10, "#1f4e9c")):
    offset = 0.18 * (np.searchsorted((1, 3, 10), n) - 1)
    axis.errorbar(
        dimension + offset, mean[n - 1], np.sqrt(variance[n - 1]), fmt="o", ms=3, color=colour, label=f"{n} view{'s' * (n > 1)}"
    )
axis.plot(dimension, target[0], color="black", drawstyle="steps-mid", lw=1.2, label="of the true voxels")
axis.set(xlabel="dimension of the latent", title="fused latent")
axis.legend(frameon=False, ncols=4)
# %% [markdown]
# ## Decoded, with uncertainty
#
# Above: the mean shape after 1, 3 and 10 views, and the true one. Below: the same surfaces, coloured by the standard
# deviation of their voxels over the posterior. What no view has settled stays light.

# %%
true_voxels = unpack_voxels(item.voxels[None], 32)[0]
colour, viewpoint = category_colour(item.shape.category), np.array([0.6, 0.4, 0.0])
figure = plt.figure(figsize=(11, 5.4))
grid = figure.add_gridspec(2, 4, left=0, right=1, top=0.93, bottom=0.06)
for column, n in enumerate((1, 3, 10)):
    occupancy, spread = decoded(mean[n - 1], variance[n - 1])
    draw_shape(figure, grid[0, column], occupancy, colour, viewpoint)
    draw_uncertainty(figure, grid[1, column], occupancy, spread, viewpoint)
    iou = voxel_iou(occupancy > 0.5, true_voxels)
    figure.text(0.125 + 0.25 * column, 0.95, f"{n} view{'s' if n > 1 else ''}, IoU {float(iou):.2f}", ha="center")
draw_shape(figure, grid[0, 3], true_voxels.astype(float), "#444444", viewpoint)
figure.text(0.875, 0.95, "truth", ha="center")
# %% [markdown]
# ## Over many objects
#
# One object proves nothing. The same for an unseen object of every category. Two references stand beside the curve: the mean
# shape of the true category, which needs no image beyond its label, and the shape autoencoder's own reconstruction of the
# true voxels, which a guide taught by it can hardly beat.

# %%
count = np.array([1, 2, 3, 5, 10])
iou, voxel_variance, error, claimed, prior_iou, ceiling = [], [], [], [], [], []
for category in model.config.categories:
    one, pictures = views_of(category, 11, seed=2)
    truth = unpack_voxels(one.voxels[None], 32)[0]
    teacher, _ = model.shape_posterior(one.voxels[None])
    mean, variance = (values[count - 1] for values in fused(*observed(pictures)))
    answers = [decoded(m, v) for m, v in zip(mean, variance)]
    iou.append([voxel_iou(occupancy > 0.5, truth) for occupancy, _ in answers])
    voxel_variance.append([spread.mean() for _, spread in answers])
    error.append(((mean - teacher) ** 2).mean(1))
    claimed.append(variance.mean(1))
    prior = model.prior_mean()[model.config.categories.index(category)]
    prior_iou.append(voxel_iou(model.decode(prior[None])[0] > 0.5, truth))
    ceiling.append(voxel_iou(model.decode(teacher)[0] > 0.5, truth))
iou, voxel_variance, error, claimed = (np.array(values, dtype=float) for values in (iou, voxel_variance, error, claimed))

figure, axes = plt.subplots(1, 3, figsize=(11, 3.3), layout="constrained")
stderr = iou.std(0, ddof=1) / np.sqrt(len(iou))
axes[0].plot(count, iou.mean(0), "o-", ms=3, label="fused views")
axes[0].fill_between(count, iou.mean(0) - stderr, iou.mean(0) + stderr, alpha=0.2, lw=0)
axes[0].axhline(np.mean(prior_iou), color="#9aa3ab", ls="--", label="mean of the true category")
axes[0].axhline(np.mean(ceiling), color="black", ls=":", label="autoencoder of the true voxels")
axes[0].set(title="voxel IoU (± 1 standard error)", xlabel="views", xticks=count)
axes[0].legend(frameon=False, fontsize=8)
axes[1].plot(count, voxel_variance.mean(0), "o-", ms=3, color="#59a14f")
axes[1].set(title="variance of a voxel's occupancy", xlabel="views", xticks=count, ylim=(0, None))
axes[2].semilogy(count, error.mean(0), "o-", ms=3, color="#e15759", label="actual squared error")
axes[2].semilogy(count, claimed.mean(0), "o-", ms=3, color="#4e79a7", label="claimed variance")
axes[2].set(title="a dimension of the latent", xlabel="views", xticks=count)
axes[2].legend(frameon=False, fontsize=8)
for k in range(len(count)):
    print(f"{count[k]:2d} views: IoU {iou[:, k].mean():.3f}, variance of a voxel {voxel_variance[:, k].mean():.4f}")

# %% [markdown]
# The last panel is a warning worth keeping. Fusing by precision takes the errors of the views as independent: claimed
# variance falls as 1/n. The actual error falls more slowly where views share an error, such as a part that the
# network always draws the same way. The SLAM meets this by estimating how many *independent* detections a track holds
# ([SLAM](../docs/slam.md#what-it-does), scales); wherever you fuse many views yourself, measure it as this panel does.
