"""Picture of a SLAM result: trajectories and landmarks from above."""

from __future__ import annotations

from os import PathLike

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.alignment import align, principal_plane
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.io.files import atomic_path


def draw_map(
    path: str | PathLike[str],
    odometry: Float[np.ndarray, "n 4 4"],
    estimate: Float[np.ndarray, "n 4 4"],
    *,
    truth: Float[np.ndarray, "n 4 4"] | None = None,
    landmarks: Float[np.ndarray, "m 3"] | None = None,
    covariance: Float[np.ndarray, "m 3 3"] | None = None,
    names: list[str] | None = None,
    title: str = "",
) -> None:
    """Write a PNG of odometry, estimate, truth (already aligned) and landmarks with 95 % ellipses, atomically."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Ellipse

    figure = Figure(figsize=(9, 9), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    i, j = principal_plane(estimate[:, :3, 3])
    for label, T, colour, width, dashes in (
        ("odometry", odometry, "0.6", 1.0, "-"),
        ("truth", truth, "k", 1.0, "--"),
        ("estimate", estimate, "tab:blue", 1.5, "-"),
    ):
        if T is not None:
            axes.plot(T[:, i, 3], T[:, j, 3], label=label, color=colour, linewidth=width, linestyle=dashes)
    if landmarks is not None and len(landmarks):
        axes.plot(landmarks[:, i], landmarks[:, j], ".", color="tab:red", ms=3, label=f"{len(landmarks)} landmarks")
        for k in range(len(landmarks) if covariance is not None else 0):
            values, vectors = np.linalg.eigh(covariance[k][np.ix_([i, j], [i, j])])  # type: ignore[index]
            width, height = 2 * np.sqrt(5.991 * np.maximum(values, 0))
            angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
            axes.add_patch(
                Ellipse(
                    (landmarks[k, i], landmarks[k, j]), width, height, angle=angle, fill=False, color="tab:red", alpha=0.3, lw=0.6
                )
            )
        if names is not None and len(names) <= 60:
            for k, name in enumerate(names):
                axes.annotate(name, (landmarks[k, i], landmarks[k, j]), fontsize=6, color="tab:red")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[i]} (m)")
    axes.set_ylabel(f"{'xyz'[j]} (m)")
    axes.legend(loc="best", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.grid(alpha=0.2)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def draw_slam_result(
    path: str | PathLike[str], odometry: Float[np.ndarray, "n 4 4"], result: SlamResult, truth: Float[np.ndarray, "n 4 4"] | None
) -> None:
    """Write the picture of a result: `draw_map` of its trajectory and landmarks, the truth aligned to it."""
    landmarks = result.landmarks
    draw_map(
        path,
        odometry,
        result.T_world_camera,
        truth=None if truth is None else align(truth, result.T_world_camera, "pose"),
        landmarks=np.array([x.T_world_object[:3, 3] for x in landmarks]).reshape(-1, 3),
        covariance=np.array([x.position_covariance for x in landmarks]).reshape(-1, 3, 3),
        names=[x.name for x in landmarks],
    )
