"""Observations of three objects with everything decoded, without a network."""

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.geometry.voxels import voxel_centres
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes


@pytest.fixture
def intrinsics():
    return np.array([150.0, 150.0, 64.0, 48.0])


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)


@pytest.fixture
def observations(intrinsics):
    rng = np.random.default_rng(1)
    n, labels, v = 3, len(CATEGORIES), 16
    position = np.array([[-1.0, 0.2, 4.0], [0.3, 0.1, 5.0], [8.0, 2.0, 40.0]])
    viewpoint = np.array([[0.4, 0.3, 0.0], [-2.0, 0.1, 0.05], [3.0, 0.5, 0.0]])
    R = allocentric_to_egocentric(viewpoint_to_matrix(torch.from_numpy(viewpoint)), torch.from_numpy(position)).numpy()
    pixel = position[:, :2] / position[:, 2:] * intrinsics[:2] + intrinsics[2:]
    log_posterior = np.log(rng.dirichlet(np.ones(labels), n))
    axis = voxel_centres(v)
    squared = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    inside = squared / np.array([0.1, 0.15, 0.2])[:, None, None, None]
    occupancy = 1 / (1 + np.exp(8 * (inside - 1)))
    return ObjectPosteriors(
        categories=CATEGORIES,
        objectness=np.array([0.9, 0.8, 0.4]),
        box=np.concatenate((pixel - 15, pixel + 15), 1),
        box_scale=np.ones((n, 4)),
        class_log_posterior=log_posterior,
        class_log_likelihood=log_posterior,
        instance_log_posterior=None,
        latent=rng.normal(size=(n, 16)),
        latent_scale=rng.uniform(0.1, 0.5, (n, 16)),
        position=position,
        position_covariance=0.02 * position[:, 2, None, None] * np.eye(3),
        viewpoint_modes=ViewpointModes(
            np.array([[0.7, 0.3]] * n), viewpoint[:, :1] + np.array([0.0, np.pi]), np.full((n, 2), 25.0)
        ),
        elevation_inplane=viewpoint[:, 1:],
        elevation_inplane_scale=np.full((n, 2), 0.1),
        viewpoint=viewpoint,
        R_camera_object=R,
        rotation_scale=np.full(n, 0.1),
        diagonal=np.array([1.2, 1.4, 9.0]),
        diagonal_log_scale=np.full(n, 0.1),
        size=np.array([[0.7, 0.7, 0.7], [0.9, 0.8, 0.7], [5.0, 5.0, 5.0]]),
        voxel_mean=occupancy,
        voxel_variance=occupancy * (1 - occupancy),
    )
