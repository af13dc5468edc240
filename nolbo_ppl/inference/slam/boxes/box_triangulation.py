"""A point from the directions it was seen in: robust least squares in inverse depth, with a covariance that says what is open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import inverse, skew

WIDTH = 2.0
"""Width of the Cauchy kernel, in standard deviations: gross errors of boxes weigh little."""
ITERATIONS = 20
"""Most iterations."""
BEHIND = 1e3
"""Residual of a point behind a camera that has seen it, in standard deviations."""


@dataclass(frozen=True)
class Triangulated:
    """A point and how well it is known."""

    position: Float[np.ndarray, " 3"]
    """In the world, m."""
    covariance: Float[np.ndarray, "3 3"]
    """m^2; as wide along the ray as parallax leaves it."""
    depth_spread: float
    """Relative standard deviation of the depth: that of the inverse depth, in units of it; above about 0.5 no depth is known."""
    misfit: float
    """Root mean square of the residuals under the kernel, in standard deviations."""


def triangulate(
    T_world_camera: Float[np.ndarray, "n 4 4"],
    direction: Float[np.ndarray, "n 2"],
    scale: Float[np.ndarray, "n 2"],
    depths: Float[np.ndarray, " d"],
    prior: tuple[float, float] | None = None,
    shared: Float[np.ndarray, "n 2"] | None = None,
    drift: Float[np.ndarray, "n-1 2"] | None = None,
) -> Triangulated:
    """Place of a static point that was seen in these directions.

    The point is (a, b, 1) / rho in the camera of the middle view: inverse depth is nearly linear in the image, also of points
    far away (Civera et al. 2008). Levenberg-Marquardt with iteratively reweighted residuals, under a Cauchy kernel, from the
    best of some depths; the covariance is the inverse of J'WJ, larger by the misfit where that is above 1.

    What all views err by alike (`shared`: a box's centre is not where the object's centre is seen) is two more unknowns, standard
    normal numbers of these scales; the answer is marginal over them. Poses are those of an odometry: where its `drift` is given,
    the covariance holds what its steps, away from the middle view, may be off by (the answer's own derivative by each step).

    Args:
        T_world_camera: poses of the views.
        direction: (x / z, y / z) in each.
        scale: their standard deviations, each view's own.
        depths: where to begin, m, in the camera of the middle view; the best is taken.
        prior: depth there by other evidence, m, and its relative standard deviation.
        shared: standard deviations, in each view, of the error that is one number for all of them; none by default.
        drift: standard deviations of angles, rad, and coordinates, m, of the motion from each view to the next; 0 by default.

    Example:
        >>> T = np.tile(np.eye(4), (3, 1, 1))
        >>> T[:, 0, 3] = [-0.5, 0.0, 0.5]
        >>> found = triangulate(T, np.array([[0.25, 0], [0, 0], [-0.25, 0]]), np.full((3, 2), 0.01), np.array([1.0, 5.0]))
        >>> (found.position.round(6) + 0.0).tolist(), round(found.depth_spread, 3)  # 0.01 sqrt(2) in a parallax of 1 m / 2 m
        ([0.0, 0.0, 2.0], 0.028)
    """
    middle = T_world_camera[len(T_world_camera) // 2]
    relative = inverse(T_world_camera) @ middle
    alike = np.zeros_like(scale) if shared is None else shared
    problem = _Problem(relative[:, :3, :3], relative[:, :3, 3], direction, scale, alike, prior)
    begin = direction[len(direction) // 2]
    starts = [np.array([*begin, 1.0 / depth, 0.0, 0.0]) for depth in depths]
    state = min(starts, key=lambda start: problem.cost(start))
    cost, damping = problem.cost(state), 1e-6
    for _ in range(ITERATIONS):
        information, gradient = problem.normal(state)
        step = np.linalg.solve(information + damping * np.diag(np.diag(information) + 1e-12), -gradient)
        trial = state + step
        trial[2] = max(trial[2], 0.2 * state[2])  # an inverse depth stays positive
        value = problem.cost(trial)
        if value > cost:
            damping = max(damping, 1e-6) * 20
            if damping > 1e8:
                break
            continue
        rest = cost - value < 1e-8 * max(cost, 1e-3)
        state, cost, damping = trial, value, damping / 10
        if rest:
            break
    information, _ = problem.normal(state)
    misfit = problem.misfit(state)
    inverted = np.linalg.inv(information + 1e-12 * np.eye(5))
    covariance = inverted[:3, :3] * max(misfit, 1.0) ** 2
    if drift is not None:
        covariance = covariance + (inverted @ problem.drifted(state, drift) @ inverted)[:3, :3]
    a, b, rho = state[:3]
    local = np.array([a, b, 1.0]) / rho
    D = np.array([[1 / rho, 0, -a / rho**2], [0, 1 / rho, -b / rho**2], [0, 0, -1 / rho**2]])
    world = middle[:3, :3] @ D
    return Triangulated(
        position=middle[:3, :3] @ local + middle[:3, 3],
        covariance=world @ covariance @ world.T,
        depth_spread=float(np.sqrt(covariance[2, 2]) / rho),
        misfit=misfit,
    )


@dataclass(frozen=True)
class _Problem:
    """Least squares of one point."""

    R: Float[np.ndarray, "n 3 3"]
    """Rotation from the middle view to each."""
    t: Float[np.ndarray, "n 3"]
    """Translation."""
    direction: Float[np.ndarray, "n 2"]
    """What was seen."""
    scale: Float[np.ndarray, "n 2"]
    """Its standard deviations."""
    shared: Float[np.ndarray, "n 2"]
    """Those of the error that is one number for all views."""
    prior: tuple[float, float] | None
    """Depth and its relative standard deviation."""

    def _point(self, state: Float[np.ndarray, " 5"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The point times its inverse depth (nothing is divided by a far depth), its direction, and the residuals."""
        a, b, rho = state[:3]
        h = self.R @ np.array([a, b, 1.0]) + rho * self.t
        predicted = h[:, :2] / np.where(np.abs(h[:, 2:]) > 1e-9, h[:, 2:], 1e-9)
        return h, predicted, np.where(h[:, 2:] > 0, (predicted + self.shared * state[3:] - self.direction) / self.scale, BEHIND)

    def _off(self, state: Float[np.ndarray, " 5"]) -> tuple[float, float]:
        """Residual of the prior, and its derivative; nothing without one."""
        if self.prior is None:
            return 0.0, 0.0
        depth, spread = self.prior
        return (state[2] * depth - 1) / spread, depth / spread

    def cost(self, state: Float[np.ndarray, " 5"]) -> float:
        """Half the sum of squares, under the kernel."""
        square = np.sum(self._point(state)[2] ** 2, axis=1)
        priors = self._off(state)[0] ** 2 + float(state[3:] @ state[3:])
        return 0.5 * WIDTH**2 * float(np.log1p(square / WIDTH**2).sum()) + 0.5 * priors

    def misfit(self, state: Float[np.ndarray, " 5"]) -> float:
        """Root mean square of the residuals by their weights."""
        square = np.sum(self._point(state)[2] ** 2, axis=1)
        weight = 1 / (1 + square / WIDTH**2)
        return float(np.sqrt((weight * square).sum() / (2 * weight.sum())))

    def drifted(self, state: Float[np.ndarray, " 5"], drift: Float[np.ndarray, "n-1 2"]) -> Float[np.ndarray, "5 5"]:
        """Covariance of J'Wr by the errors of the steps between views: each moves all views behind it, away from the middle."""
        h, predicted, residual = self._point(state)
        weight = 1 / (1 + np.sum(residual**2, axis=1) / WIDTH**2)
        z, rho = np.where(h[:, 2] > 1e-9, h[:, 2], np.inf), state[2]
        # Derivative of the whitened residuals by the point itself, in the middle camera's axes.
        by_point = (self.R[:, :2] - predicted[:, :, None] * self.R[:, 2:]) * (rho / z)[:, None, None] / self.scale[:, :, None]
        moved = np.einsum("nij,nik,n->njk", self._jacobian(predicted, z), by_point, weight)
        middle = len(moved) // 2
        behind = np.concatenate([np.cumsum(moved[:middle], axis=0), np.cumsum(moved[:middle:-1], axis=0)[::-1]])
        centre = -np.einsum("nji,nj->ni", self.R, self.t)
        pivot = np.concatenate([centre[1 : middle + 1], centre[middle:-1]])
        point = np.array([state[0], state[1], 1.0]) / rho
        arm = skew(point - pivot)
        spread = drift[:, 0, None, None] ** 2 * arm @ np.swapaxes(arm, 1, 2) + drift[:, 1, None, None] ** 2 * np.eye(3)
        return np.einsum("sij,sjk,slk->il", behind, spread, behind)

    def _jacobian(self, predicted: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2 5"]:
        """Derivative of the residuals by the state."""
        moved = np.stack([self.R[:, :, 0], self.R[:, :, 1], self.t], axis=2)
        own = self.shared[:, :, None] * np.eye(2)
        J = np.concatenate([(moved[:, :2] - predicted[:, :, None] * moved[:, 2:]) / z[:, None, None], own], axis=2)
        return J / self.scale[:, :, None]

    def normal(self, state: Float[np.ndarray, " 5"]) -> tuple[Float[np.ndarray, "5 5"], Float[np.ndarray, " 5"]]:
        """J'WJ and J'Wr."""
        h, predicted, residual = self._point(state)
        weight = 1 / (1 + np.sum(residual**2, axis=1) / WIDTH**2)
        z = np.where(h[:, 2] > 1e-9, h[:, 2], np.inf)
        J = self._jacobian(predicted, z)
        information = np.einsum("nij,nik,n->jk", J, J, weight)
        gradient = np.einsum("nij,ni,n->j", J, residual, weight)
        off, slope = self._off(state)
        information[2, 2] += slope**2
        gradient[2] += slope * off
        information[[3, 4], [3, 4]] += 1.0
        gradient[3:] += state[3:]
        return information, gradient
