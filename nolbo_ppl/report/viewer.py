"""The run in 3D on a viser server: trajectories, cameras with pictures, objects with uncertainty, EM under a slider."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.geometry.pose import matrix_to_quaternion
from nolbo_ppl.io.images import open_image
from nolbo_ppl.io.run_folder import RunFolder, read_run
from nolbo_ppl.report.viewer_objects import Rgb, add_objects

if TYPE_CHECKING:
    from viser import ViserServer

WAYS: tuple[tuple[str, str, Rgb], ...] = (
    ("odometry", "Odometry", (224, 123, 57)),
    ("estimate", "Estimate", (47, 111, 222)),
    ("truth", "Truth", (90, 96, 104)),
)
"""Trajectories: attribute of the run, name, colour."""
MOST_CAMERAS = 60
"""Cameras drawn along the way; the slider reaches all."""
MOST_LABELS = 40
"""More names than this cover the scene: they are hidden until asked for."""
THUMBNAIL, PICTURE = 160, 640
"""Longer sides, px, of the pictures in the cameras along the way and at the slider."""


@dataclass
class Viewer:
    """Handles of what is on the server, by name."""

    run: RunFolder
    """What is shown."""
    scene: dict[str, Any] = field(default_factory=dict)
    """Nodes of the scene by their names."""
    gui: dict[str, Any] = field(default_factory=dict)
    """Controls by their names."""
    layers: dict[str, list[Any]] = field(default_factory=dict)
    """Nodes that one box shows and hides."""
    show_keyframe: Callable[[int], None] = lambda k: None
    """Moves the camera at the slider to a keyframe."""
    show_iteration: Callable[[int], None] = lambda i: None
    """Shows an iteration of EM."""

    def add(self, layer: str, name: str, handle: Any) -> Any:
        """Remember a node under its name and its layer."""
        self.scene[name] = handle
        self.layers.setdefault(layer, []).append(handle)
        return handle


def viser_module() -> Any:
    """The module viser.

    Raises:
        InputError: it is not installed.
    """
    try:
        import viser
    except ModuleNotFoundError:
        raise input_error("the 3D viewer needs viser", do="pip install 'nolbo-ppl[viewer]'") from None
    return viser


def up_direction(run: RunFolder) -> str:
    """Up in the world: against y when the camera drives in the plane of x and z, else along what it leaves out."""
    return {(0, 2): "-y", (0, 1): "+z", (1, 2): "+x"}[run.plane]


def wxyz(R: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """viser's order of a quaternion."""
    x, y, z, w = matrix_to_quaternion(R).tolist()
    return w, x, y, z


def segments(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 2 3"]:
    """A line through points as pieces, straight across unknown ones (NaN); one point gives one piece of no length."""
    points = np.asarray(points, dtype=np.float32)
    points = points[np.isfinite(points).all(axis=1)]
    return np.stack([points[:-1], points[1:]], axis=1) if len(points) > 1 else np.repeat(points[None], 2, axis=1)


def scene_scale(run: RunFolder) -> float:
    """Size of a camera's picture in the scene, m: a small share of the way's extent."""
    extent = float(np.linalg.norm(np.ptp(run.estimate[:, :3, 3], axis=0)))
    return float(np.clip(0.02 * extent, 0.05, 1.5))


def read_picture(run: RunFolder, k: int, longest: int) -> UInt8[np.ndarray, "h w 3"] | None:
    """Picture of a keyframe, no side longer than `longest` px; None where there is none."""
    from PIL import Image

    path = run.images[k] if run.images else None
    if path is None:
        return None
    try:
        image = Image.fromarray(open_image(path, shorter_side=longest))
    except InputError:
        return None
    image.thumbnail((longest, longest))
    return np.asarray(image)


def field_of_view(run: RunFolder) -> tuple[float, float]:
    """Vertical angle, rad, and width over height of the pictures; 60 degrees and 3/2 where the camera is not known."""
    given = run.intrinsics or {}
    try:
        fy, width, height = float(given["fy"]), float(given["width"]), float(given["height"])
    except (KeyError, TypeError, ValueError):
        return np.pi / 3, 1.5
    return (2 * np.arctan2(height / 2, fy), width / height) if min(fy, width, height) > 0 else (np.pi / 3, 1.5)


def add_ways(viewer: Viewer, server: ViserServer) -> None:
    """The trajectories as lines."""
    for name, _, colour in WAYS:
        T = getattr(viewer.run, name)
        if T is not None:
            line = server.scene.add_line_segments(
                f"/trajectory/{name}", segments(T[:, :3, 3]), colour, thickness=3.0, thickness_units="screen"
            )
            viewer.add(name, f"/trajectory/{name}", line)


def add_cameras(viewer: Viewer, server: ViserServer) -> None:
    """Cameras along the way, with small pictures."""
    run, (fov, aspect), scale = viewer.run, field_of_view(viewer.run), scene_scale(viewer.run)
    for k in np.unique(np.linspace(0, len(run) - 1, min(len(run), MOST_CAMERAS)).round().astype(int)).tolist():
        handle = server.scene.add_camera_frustum(
            f"/cameras/{k:06d}",
            fov,
            aspect,
            scale=scale,
            color=(47, 111, 222),
            image=read_picture(run, k, THUMBNAIL),
            wxyz=wxyz(run.estimate[k, :3, :3]),
            position=run.estimate[k, :3, 3],
            thickness=1.5,
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
        )
        viewer.add("cameras", f"/cameras/{k:06d}", handle)


def add_keyframe(viewer: Viewer, server: ViserServer) -> None:
    """The camera at the slider, with its picture in the scene and beside it; clients may ride along."""
    run, (fov, aspect), scale = viewer.run, field_of_view(viewer.run), scene_scale(viewer.run)
    camera = viewer.add(
        "keyframe",
        "/keyframe",
        server.scene.add_camera_frustum(
            "/keyframe",
            fov,
            aspect,
            scale=3 * scale,
            color=(209, 73, 91),
            thickness=3.0,
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
        ),
    )
    blank = np.full((8, 16, 3), 230, dtype=np.uint8)
    picture = server.gui.add_image(blank, label="Picture") if any(run.images) else None
    slider = server.gui.add_slider("Keyframe", 0, max(len(run) - 1, 1), 1, 0, disabled=len(run) < 2)
    ride = server.gui.add_checkbox("Ride along", False, hint="Look through the camera of the keyframe")
    viewer.gui |= {"keyframe": slider, "ride": ride} | ({} if picture is None else {"picture": picture})

    def show(k: int) -> None:
        k = min(max(k, 0), len(run) - 1)
        pose, image = run.estimate[k], read_picture(run, k, PICTURE)
        camera.wxyz, camera.position, camera.image = wxyz(pose[:3, :3]), pose[:3, 3], image
        if picture is not None:
            picture.image = blank if image is None else image
        if ride.value:
            for client in server.get_clients().values():
                client.camera.position = pose[:3, 3] - pose[:3, 2] * 4 * scale
                client.camera.look_at = pose[:3, 3] + pose[:3, 2] * 10 * scale

    viewer.show_keyframe = show
    slider.on_update(lambda _: show(int(slider.value)))
    ride.on_update(lambda _: show(int(slider.value)))
    show(0)


def add_iterations(viewer: Viewer, server: ViserServer) -> None:
    """Where EM stood: a line and points that the slider sets."""
    found = viewer.run.iterations
    if found is None or not len(found):
        return
    line = server.scene.add_line_segments(
        "/em/trajectory", segments(found.T_world_camera[-1, :, :3, 3]), (150, 80, 200), thickness=3.5, thickness_units="screen"
    )
    points = server.scene.add_point_cloud(
        "/em/landmarks",
        found.landmarks[-1].astype(np.float32),
        (150, 80, 200),
        point_size=0.5 * scene_scale(viewer.run),
        point_shape="circle",
        precision="float32",
    )
    viewer.add("em", "/em/trajectory", line)
    viewer.add("em", "/em/landmarks", points)
    slider = server.gui.add_slider("EM iteration", 0, max(len(found) - 1, 1), 1, len(found) - 1, disabled=len(found) < 2)
    viewer.gui["iteration"] = slider

    def show(i: int) -> None:
        i = min(max(i, 0), len(found) - 1)
        line.points = segments(found.T_world_camera[i, :, :3, 3])
        points.points = found.landmarks[i].astype(np.float32)

    def moved(_: Any) -> None:
        viewer.gui["show-em"].value = True  # who moves the slider wants to see it
        show(int(slider.value))

    viewer.show_iteration = show
    slider.on_update(moved)


def add_switches(viewer: Viewer, server: ViserServer, hidden: tuple[str, ...]) -> None:
    """A box for every layer."""
    names = {name: shown for name, shown, _ in WAYS}
    names |= {
        "cameras": "Cameras",
        "keyframe": "Camera of the keyframe",
        "objects": "Shapes",
        "ellipsoids": "95 % ellipsoids",
        "labels": "Names",
        "em": "EM iteration",
        "grid": "Grid",
    }
    with server.gui.add_folder("Show"):
        for layer, handles in viewer.layers.items():
            box = server.gui.add_checkbox(names.get(layer, layer), layer not in hidden)
            viewer.gui[f"show-{layer}"] = box

            def switch(_: Any = None, box: Any = box, handles: list[Any] = handles) -> None:
                for handle in handles:
                    handle.visible = box.value

            box.on_update(switch)
            switch()


def look_from_above(run: RunFolder, server: ViserServer) -> None:
    """Every client starts above and behind the whole way."""
    points = run.estimate[:, :3, 3]
    middle, extent = (points.min(axis=0) + points.max(axis=0)) / 2, max(float(np.linalg.norm(np.ptp(points, axis=0))), 2.0)
    up = {"-y": (0.0, -1.0, 0.0), "+z": (0.0, 0.0, 1.0), "+x": (1.0, 0.0, 0.0)}[up_direction(run)]
    back = np.zeros(3)
    back[run.plane[1]] = -1.0
    server.initial_camera.position = tuple((middle + extent * (0.75 * np.array(up) + 0.65 * back)).tolist())
    server.initial_camera.look_at = tuple(middle.tolist())
    server.initial_camera.up = up


def add_grid(viewer: Viewer, server: ViserServer) -> None:
    """The ground, a little under the lowest camera."""
    run = viewer.run
    i, j = run.plane
    points = run.estimate[:, :3, 3]
    extent = 1.6 * max(float(np.ptp(points, axis=0).max()), 2.0)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    side = {"-y": points[:, 1].max() + 1.5, "+z": points[:, 2].min() - 1.5, "+x": points[:, 0].min() - 1.5}
    centre[3 - i - j] = side[up_direction(run)]
    size = 10.0 ** np.floor(np.log10(extent / 4))
    names: dict[tuple[int, int], Any] = {(0, 1): "xy", (0, 2): "xz", (1, 2): "yz"}
    handle = server.scene.add_grid(
        "/grid",
        extent,
        extent,
        plane=names[run.plane],
        cell_size=size,
        section_size=5 * size,
        position=centre,
        shadow_opacity=0.0,
    )
    viewer.add("grid", "/grid", handle)


def light_evenly(server: ViserServer) -> None:
    """Light from everywhere and no shadows: shapes are to be read, and many machines draw without a graphics card."""
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.add_light_ambient("/light", intensity=1.6)


def build_viewer(run_dir: str | PathLike[str] | RunFolder, server: ViserServer) -> Viewer:
    """Put a run on a viser server.

    Args:
        run_dir: folder of `nolbo run` or `nolbo slam`, or what `read_run` made of it.
        server: the server; its scene is added to.

    Raises:
        InputError: no result in the folder, or a file that is malformed or does not match.
    """
    run = run_dir if isinstance(run_dir, RunFolder) else read_run(run_dir)
    viewer = Viewer(run)
    server.scene.set_up_direction(up_direction(run))  # type: ignore[arg-type]
    server.gui.set_panel_label(run.path.resolve().name)
    light_evenly(server)
    look_from_above(run, server)
    add_grid(viewer, server)
    add_ways(viewer, server)
    add_keyframe(viewer, server)
    add_iterations(viewer, server)
    add_cameras(viewer, server)
    add_objects(viewer.add, run, server)
    add_switches(viewer, server, hidden=("em", "labels") if len(run.landmarks) > MOST_LABELS else ("em",))
    return viewer
