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
# # The model in Pyro's hands
#
# `nolbo train` is an optimiser around one object, `SceneELBO`. That object is a `pyro.infer.ELBO`, and the generative model
# and its guide are an ordinary Pyro pair: they take the same arguments, and what Pyro does with models it does with this
# one. Here a tiny pair is trained by Pyro's own `SVI`, drawn from by `Predictive`, and an azimuth is sampled by NUTS across
# the place where angles begin again. ([The generative story](../docs/story.md), [the bound](../docs/bound.md).)

# %%
# %matplotlib inline
import dataclasses
import math

import matplotlib.pyplot as plt
import numpy as np
import pyro
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO
from pyro.infer.inspect import get_model_relations
from pyro.optim import ClippedAdam

from nolbo_ppl.data.loader import render_batch
from nolbo_ppl.inference.elbo import INCLUSIVE, SceneELBO
from nolbo_ppl.models.distributions import WrappedNormal
from nolbo_ppl.models.model_config import nano
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.prior_predictive import prior_predictive
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.scene_loader import to_batch
from nolbo_ppl.viz.shape_plots import draw_shape
from nolbo_ppl.viz.style import category_colour

torch.manual_seed(0)
config = nano()
single = dataclasses.replace(preset("standard", config.image_size), objects=(1, 2), empty_probability=0.0)
batch = to_batch(render_batch(SceneGenerator(single, seed=7), first=0, size=16))
figure, axes = plt.subplots(1, 8, figsize=(10, 1.4))
for axis, image in zip(axes, batch.image):
    axis.imshow(image.permute(1, 2, 0))
    axis.axis("off")

# %% [markdown]
# ## The pair
#
# `guide.observe` runs the encoder and finds the region that is responsible for each object; what it returns is what model
# and guide are called with. Which site hangs on which, Pyro finds out by itself (`pyro.render_model` draws it, with the
# extra `graphviz`).

# %%
model = Nolbo.from_seed(config, seed=0)
scene = model.guide.observe(batch)
relations = get_model_relations(model.story, model_args=(scene,))
for site, parents in relations["sample_sample"].items():
    above = ", ".join(parent for parent in parents if parent != site) or "-"
    print(f"{site:18} on {above:20} {relations['sample_dist'][site]}")

# %% [markdown]
# ## SVI, with either bound
#
# A step encodes the batch anew, for the scene carries the encoder's graph. `Trace_ELBO` draws every latent;
# `SceneELBO` has a closed form for all but the voxels. They estimate one number, and ours has far less noise: the curves
# are losses in nats a scene, of two models that begin alike.


# %%
def trained(loss, steps: int = 40):
    """A model of the same start after some steps of SVI, and the losses on the way."""
    own = Nolbo.from_seed(config, seed=0)
    svi = SVI(own.story, own.guide, ClippedAdam({"lr": 2e-3, "clip_norm": 50.0}), loss=loss)
    losses = [svi.step(own.guide.observe(batch), decode=8) / len(batch.image) for _ in range(steps)]
    return own, losses


by_scene, losses_scene = trained(SceneELBO())
by_trace, losses_trace = trained(Trace_ELBO(max_plate_nesting=2))
figure, axis = plt.subplots(figsize=(6, 2.6))
axis.plot(losses_trace, color="0.6", label="Trace_ELBO")
axis.plot(losses_scene, color="tab:blue", label="SceneELBO")
axis.set(xlabel="step", ylabel="nats a scene", yscale="log")
axis.legend()
assert losses_scene[-1] < 0.8 * losses_scene[0] and losses_trace[-1] < 0.8 * losses_trace[0]

# %% [markdown]
# ## The bound by term
#
# A loss of Pyro's is one number. `terms` names its parts, which add up to it; the default objective of `nolbo train` weighs
# others (`INCLUSIVE`), through the same object.


# %%
def terms_of(own: Nolbo) -> dict[str, float]:
    """The bound's terms on the batch, nats a scene, without gradients."""
    own.eval()
    with torch.no_grad():
        found = SceneELBO().terms(own.story, own.guide, own.guide.observe(batch), decode=8)
    return {name: float(value) / len(batch.image) for name, value in found.items()}


before, after = terms_of(Nolbo.from_seed(config, seed=0)), terms_of(by_scene)
figure, axis = plt.subplots(figsize=(7, 2.6))
place = np.arange(len(before))
axis.bar(place - 0.2, [-value for value in before.values()], 0.4, color="0.7", label="before")
axis.bar(place + 0.2, [-after[name] for name in before], 0.4, color="tab:blue", label="after")
axis.set_xticks(place, list(before), rotation=30, ha="right")
axis.set(yscale="symlog", ylabel="- nats a scene")
axis.legend()
with torch.no_grad():
    inclusive = SceneELBO(INCLUSIVE).loss(by_scene.story, by_scene.guide, by_scene.guide.observe(batch), decode=0)
print(f"bound {sum(after.values()):.0f} nats a scene; inclusive objective {inclusive / len(batch.image):.1f}")

# %% [markdown]
# ## Draws of the model alone
#
# `poutine.uncondition` frees what is observed; `prior_predictive` does it for whole objects: category, shape, pose and box.
# After so few steps shapes are clouds. The shipped weights draw chairs.

# %%
objects = prior_predictive(by_scene.story, count=5, seed=1)
figure = plt.figure(figsize=(9, 2))
grid = figure.add_gridspec(1, 5)
for k in range(5):
    occupancy = objects.voxel_probability[k].numpy()
    occupancy = occupancy / max(float(occupancy.max()), 1e-6)
    name = config.categories[int(objects.category[k])]
    draw_shape(figure, grid[k], occupancy, category_colour(name), np.array([0.6, 0.4, 0.0])).set_title(name)

# %% [markdown]
# ## Draws of the posterior
#
# `Predictive` with the guide: azimuths of the objects of four images, all draws at once.

# %%
with torch.no_grad():
    scene = by_scene.guide.observe(batch)
    draws = Predictive(by_scene.story, guide=by_scene.guide, num_samples=200, parallel=True, return_sites=("orientation_latent",))
    azimuth = draws(scene, decode=0)["orientation_latent"][..., 0]
figure, axes = plt.subplots(1, 4, figsize=(10, 1.8), sharey=True)
for k, axis in enumerate(axes):
    axis.hist(azimuth[:, k, 0].numpy(), bins=np.linspace(-math.pi, math.pi, 37), color="tab:blue")
    axis.axvline(float(batch.viewpoint[k, 0, 0]), color="black")
    axis.set(xlim=(-math.pi, math.pi), xlabel="azimuth, rad")

# %% [markdown]
# ## A circle has no ends
#
# The azimuth of a car seen from behind is +-pi. The support of angles is a circle: NUTS walks on the line and is wrapped,
# so that a chain passes pi as any other angle.


# %%
def azimuths() -> None:
    """Eight independent azimuths about 3.14 rad."""
    with pyro.plate("eight", 8):
        pyro.sample("azimuth", WrappedNormal(torch.tensor(3.14), torch.tensor(0.3)).expand((8,)))


chain = MCMC(NUTS(azimuths, max_tree_depth=4), num_samples=80, warmup_steps=40, disable_progbar=True)
chain.run()
found = chain.get_samples()["azimuth"].flatten()
figure, axis = plt.subplots(figsize=(6, 2))
axis.hist(found.numpy(), bins=60, color="tab:blue")
axis.set(xlabel="rad", title=f"above zero: {float((found > 0).float().mean()):.2f}")
assert 0.35 < float((found > 0).float().mean()) < 0.65
with torch.no_grad():
    free = poutine.trace(poutine.uncondition(by_scene.story)).get_trace(scene, decode=0)
print("drawn anew:", ", ".join(name for name in ("box", "range", "rotation") if not free.nodes[name]["is_observed"]))
