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
# # The latent space
#
# SLAM compares what two images say of a shape, millions of times. The paper's answer is a latent whose density is
# known: the story throws it from $p_\psi(z \mid l) = N(\mu_\psi(l), I)$, one Gaussian for each category, and the guide
# learns to meet it (NOLBO, figure `latentdistribution`). This notebook looks at that space, and at the one of a plain
# autoencoder, which has no such density.

# %%
# %matplotlib inline
import dataclasses
import os

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.stats import chi2
from sklearn.manifold import TSNE
from sklearn.metrics import silhouette_score
from torch import nn

import nolbo_ppl
from nolbo_ppl.models.scene_batch import unpack_bits
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.viz.shape_plots import draw_shape
from nolbo_ppl.viz.style import category_colour

model = nolbo_ppl.load(os.environ.get("NOLBO_MODEL", "tiny"))
categories, dimensions = model.config.categories, model.config.latent_dim

# %% [markdown]
# ## What the guide sees
#
# Some 150 images of one unseen object each. The guide answers for the object's box; its latent's mean is one point.

# %%
single = dataclasses.replace(
    preset("standard", model.config.image_size),
    objects=(1, 1),
    empty_probability=0.0,
    object_pixels=(48.0, 0.8),
    truncation_probability=0.0,
)
source = SceneGenerator(single, seed=88_003)
scenes = [scene for scene in map(source.render, range(150)) if len(scene.labels) == 1]
labels = np.array([categories.index(scene.labels[0].category) for scene in scenes])
answers = model.observe_boxes(
    [scene.image for scene in scenes],
    np.array([scene.intrinsics for scene in scenes]),
    [scene.labels[0].box[None] for scene in scenes],
    decode=False,
)
guide = np.concatenate([answer.latent for answer in answers])

figure, axes = plt.subplots(1, 8, figsize=(11, 1.7), layout="constrained")
for axis, scene in zip(axes, scenes):
    axis.imshow(scene.image)
    axis.set_axis_off()
    axis.set_title(scene.labels[0].category, fontsize=8)

# %% [markdown]
# ## A plain autoencoder
#
# For comparison: a 3D autoencoder with a latent of the same size, trained on reconstruction alone, without prior, labels or
# noise. It is given an advantage: it sees the true voxels (at 16³), at training and below, where the guide has an image.

# %%
pool = ShapeLibrary(categories, seed=88_004)
items = [pool.item(category, number) for category in categories for number in range(16)]


def coarse(items):
    """Occupancy of shapes at 16^3."""
    packed = torch.from_numpy(np.stack([item.voxels for item in items]))
    fine = unpack_bits(packed, model.config.voxel_size).float()
    return torch.nn.functional.adaptive_avg_pool3d(fine[:, None], 16).gt(0.4).float()


torch.manual_seed(0)
encoder = nn.Sequential(
    nn.Conv3d(1, 16, 4, 2, 1), nn.ELU(), nn.Conv3d(16, 32, 4, 2, 1), nn.ELU(), nn.Flatten(), nn.Linear(32 * 64, dimensions)
)
decoder = nn.Sequential(
    nn.Linear(dimensions, 32 * 64),
    nn.ELU(),
    nn.Unflatten(1, (32, 4, 4, 4)),
    nn.ConvTranspose3d(32, 16, 4, 2, 1),
    nn.ELU(),
    nn.ConvTranspose3d(16, 1, 4, 2, 1),
)
voxels, loss_at = coarse(items), []
optimiser = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=3e-3)
for _ in range(200):
    batch = voxels[torch.randint(len(voxels), (32,))]
    loss = nn.functional.binary_cross_entropy_with_logits(decoder(encoder(batch)), batch)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    loss_at.append(loss.item())

known = coarse([scene.labels[0].item for scene in scenes])
with torch.inference_mode():
    plain = encoder(known)
    found, known = decoder(plain) > 0, known.bool()
plain = plain.numpy()
iou = ((found & known).flatten(1).sum(1) / (found | known).flatten(1).sum(1)).mean()
figure, axis = plt.subplots(figsize=(6, 2.2), layout="constrained")
axis.semilogy(loss_at, color="#4e79a7")
axis.set(xlabel="step", title="reconstruction loss, nats a voxel")
print(f"it reconstructs unseen shapes with a voxel IoU of {float(iou):.2f}")

# %% [markdown]
# ## Both spaces in two dimensions
#
# t-SNE keeps neighbours together. The guide's means share their map with samples of the prior, $z \sim N(\mu_\psi(l), I)$:
# where the story says a category lies, its images must land. Rings are the prior means.

# %%
rng = np.random.default_rng(0)
means = model.prior_mean()
prior_label = np.repeat(np.arange(len(categories)), 20)
prior = means[prior_label] + rng.standard_normal((len(prior_label), dimensions))


def embedded(points):
    """Two dimensions by t-SNE."""
    return TSNE(2, perplexity=25, init="pca", random_state=0).fit_transform(points)


shared = embedded(np.concatenate((guide, prior, means)).astype(np.float64))
maps = (
    ("plain autoencoder, of true voxels", embedded(plain.astype(np.float64)), labels),
    ("NOLBO: the guide, of images", shared[: len(guide)], labels),
    ("NOLBO: samples of the prior", shared[len(guide) : len(guide) + len(prior)], prior_label),
)
figure, axes = plt.subplots(1, 3, figsize=(12, 4.4), layout="constrained")
for axis, (title, place, label) in zip(axes, maps):
    for number, category in enumerate(categories):
        own = label == number
        axis.scatter(*place[own].T, s=9, color=category_colour(category), label=category)
    if title.startswith("NOLBO"):
        for number, category in enumerate(categories):
            place_of_mean = shared[len(guide) + len(prior) + number]
            axis.scatter(*place_of_mean, s=330, facecolor="none", edgecolor=category_colour(category), lw=1.2)
    axis.set(title=title, xticks=[], yticks=[])
for axis in axes[1:]:
    low, high = shared.min(0) - 3, shared.max(0) + 3
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False, markerscale=2)
# %% [markdown]
# The plain autoencoder groups what looks alike, since it sees the voxels; but its groups are ragged and lie anywhere.
# A number for the picture is the silhouette over categories, 1 for far and tight groups, 0 for none, taken in all
# dimensions.

# %%
print(f"silhouette of the plain autoencoder (true voxels): {silhouette_score(plain, labels):.2f}")
print(f"silhouette of the guide (images):                  {silhouette_score(guide, labels):.2f}")

# %% [markdown]
# ## Distances have a meaning
#
# Because the prior is a density of unit variance, a distance is a number of nats:
# $-\log N(z; \mu_\psi(l), I) = \tfrac12 \lVert z - \mu_\psi(l) \rVert^2 + \text{const}$. Samples of the prior have squared
# distances that follow $\chi^2$ with as many degrees of freedom as dimensions. The guide's *means* lie nearer, since a mean
# has no noise in it, and distances to the nearest *other* category are far off the curve: that gap is what the
# classifier of eq. `MLEproblemfinal` and the SLAM's weights live on. Errors are the objects whose nearest mean is another's.

# %%
squared = ((guide[:, None] - means) ** 2).sum(-1)
own = squared[np.arange(len(labels)), labels]
other = np.where(np.eye(len(categories), dtype=bool)[labels], np.inf, squared).min(1)
edges = np.geomspace(max(own.min(), 0.05), other.max(), 60)
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
axis.hist(own, edges, color="#59a14f", alpha=0.7, label="to the own category's mean")
axis.hist(other, edges, color="#e15759", alpha=0.6, label="to the nearest other mean")
count = len(own) * np.diff(chi2(dimensions).cdf(edges))
axis.plot(np.sqrt(edges[1:] * edges[:-1]), count, color="black", label=f"χ² of {dimensions}, the prior's own")
axis.set(xscale="log", xlabel="squared distance of the guide's mean", ylabel="images")
axis.legend(frameon=False)
print(f"nearest prior mean is the true category's for {np.mean(own < other):.2f} of the images")

# %% [markdown]
# ## A density can be sampled
#
# Shapes decoded from draws of $p_\psi(z \mid l)$ are objects of that category. The plain autoencoder has nothing to draw
# from: a Gaussian about all of its latents, the best guess there is, mixes categories.

# %%
drawn = [categories.index(name) for name in ("aeroplane", "chair", "motorbike")]
chosen = np.repeat(drawn, 2)
samples = means[chosen] + rng.standard_normal((len(chosen), dimensions))
occupancy = model.decode(samples)
with torch.inference_mode():
    latents = rng.multivariate_normal(plain.mean(0), np.cov(plain.T), len(chosen))
    anything = torch.sigmoid(decoder(torch.as_tensor(latents, dtype=torch.float32)))[:, 0].numpy()
figure = plt.figure(figsize=(12, 4.4))
grid = figure.add_gridspec(2, len(chosen), left=0, right=1, top=0.92, bottom=0, hspace=0.12)
viewpoint = np.array([0.6, 0.35, 0.0])
for column, number in enumerate(chosen):
    draw_shape(figure, grid[0, column], occupancy[column], category_colour(categories[number]), viewpoint)
    draw_shape(figure, grid[1, column], anything[column], "#9aa3ab", viewpoint)
    figure.text((column + 0.5) / len(chosen), 0.94, categories[number], ha="center", fontsize=9)
figure.text(0.5, 0.46, "plain autoencoder, drawn from one Gaussian about its latents", ha="center", fontsize=9)
# %% [markdown]
# ## Between two categories
#
# On the straight line from one prior mean to another the decoder passes a region that no category claims. The shapes are
# coloured by the likelier category; the class posterior (bars) says how fast the story changes its mind.

# %%
start, end = categories.index("chair"), categories.index("sofa")
share = np.linspace(0, 1, 7)
line = means[start] + share[:, None] * (means[end] - means[start])
log_likelihood = -0.5 * ((line[:, None] - means) ** 2).sum(-1)
posterior = np.exp(log_likelihood - np.logaddexp.reduce(log_likelihood, axis=1, keepdims=True))
figure = plt.figure(figsize=(12, 3))
grid = figure.add_gridspec(2, len(share), height_ratios=(4, 1), left=0.01, right=0.99, top=0.98, bottom=0.08)
for column, (shape, probability) in enumerate(zip(model.decode(line), posterior)):
    best = categories[int(probability.argmax())]
    draw_shape(figure, grid[0, column], shape, category_colour(best), viewpoint)
    bar = figure.add_subplot(grid[1, column])
    shares = probability[[start, end]]
    bar.barh(["chair", "sofa"], shares, color=[category_colour("chair"), category_colour("sofa")])
    bar.set(xlim=(0, 1), xticks=[], yticks=[] if column else [0, 1])
    bar.spines[:].set_visible(False)
