"""`nolbo view`: the page is served, loads without script errors, and holds the run."""

from __future__ import annotations

import re
import shutil
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli.view import ViewerConfig, main, run
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import quaternion_to_matrix
from nolbo_ppl.io.files import write_json
from nolbo_ppl.report import read_run
from nolbo_ppl.report.run_follower import RunFollower
from nolbo_ppl.report.viewer import Viewer, build_viewer
from tests.report.browser import Browser
from tests.report.factory import FRAMES, make_run

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'nolbo-ppl[viewer]'")
PORT = 18_080
"""Where a free port is looked for."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "square")


@pytest.fixture(scope="module")
def server() -> Iterator[object]:
    made = viser.ViserServer(host="127.0.0.1", port=PORT, verbose=False)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def viewer(folder: Path, server: viser.ViserServer) -> Viewer:
    return build_viewer(folder, server)


def rotation_of(node: viser.SceneNodeHandle) -> np.ndarray:
    """Rotation of a node."""
    return quaternion_to_matrix(np.asarray(node.wxyz)[[1, 2, 3, 0]])


def test_scene_holds_the_run(viewer: Viewer, folder: Path) -> None:
    found = read_run(folder)
    m = len(found.landmarks)
    assert {name: len(nodes) for name, nodes in viewer.layers.items()} == {
        "grid": 1,
        "odometry": 1,
        "estimate": 1,
        "truth": 1,
        "keyframe": 1,
        "em": 2,
        "cameras": FRAMES,
        "objects": m,
        "ellipsoids": m,
        "labels": m,
    }
    assert viewer.scene["/cameras/000007"].image is not None
    line = viewer.scene["/trajectory/estimate"].points
    np.testing.assert_allclose(line[:, 0], found.estimate[:-1, :3, 3], atol=1e-5)
    np.testing.assert_allclose(line[:, 1], found.estimate[1:, :3, 3], atol=1e-5)


def test_objects_stand_at_their_poses_in_metres(viewer: Viewer, folder: Path) -> None:
    found = read_run(folder)
    for k, landmark in enumerate(found.landmarks):
        node, ball = viewer.scene[f"/objects/{k}"], viewer.scene[f"/ellipsoids/{k}"]
        np.testing.assert_allclose(node.position, landmark.position)
        np.testing.assert_allclose(rotation_of(node), landmark.T_world_object[:3, :3], atol=1e-6)
        R = rotation_of(ball)
        np.testing.assert_allclose(R @ np.diag(np.square(ball.scale)) @ R.T / 7.8147, landmark.position_covariance, atol=1e-6)
    voxels = found.voxels(found.landmarks[0].name)
    assert voxels is not None
    inside = np.argwhere(voxels[0] > 0.5)
    extent = (np.ptp(inside, axis=0) + 1) / len(voxels[0]) * found.landmarks[0].diagonal
    np.testing.assert_allclose(
        np.ptp(viewer.scene["/objects/0"].vertices, axis=0), extent, atol=1.1 / 16 * found.landmarks[0].diagonal
    )


def test_sliders_move_camera_and_iteration(viewer: Viewer, folder: Path) -> None:
    found = read_run(folder)
    viewer.show_keyframe(13)
    camera = viewer.scene["/keyframe"]
    np.testing.assert_allclose(camera.position, found.estimate[13, :3, 3])
    np.testing.assert_allclose(rotation_of(camera), found.estimate[13, :3, :3], atol=1e-6)
    assert camera.fov == pytest.approx(2 * np.arctan(24 / 48)) and camera.aspect == 2.0
    assert found.iterations is not None
    for i in (0, len(found.iterations) - 1):
        viewer.show_iteration(i)
        np.testing.assert_allclose(
            viewer.scene["/em/trajectory"].points[:, 0], found.iterations.T_world_camera[i, :-1, :3, 3], atol=1e-5
        )
        np.testing.assert_allclose(viewer.scene["/em/landmarks"].points, found.iterations.landmarks[i], atol=1e-5)


def test_boxes_show_and_hide_layers(viewer: Viewer) -> None:
    assert not viewer.scene["/em/trajectory"].visible and viewer.scene["/trajectory/truth"].visible
    viewer.gui["show-truth"].value = False
    assert not viewer.scene["/trajectory/truth"].visible
    viewer.gui["iteration"].value = 0  # who moves the slider wants to see it
    assert viewer.gui["show-em"].value and viewer.scene["/em/trajectory"].visible


@pytest.mark.slow
def test_page_loads_without_script_errors(viewer: Viewer, server: viser.ViserServer, tmp_path: Path) -> None:
    address = f"http://127.0.0.1:{server.get_port()}"
    with urllib.request.urlopen(address, timeout=60) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    browser = Browser(tmp_path, 480, 320)
    try:
        browser.open(address)
        browser.until("document.querySelector('canvas') !== null && document.body.innerText.includes('Keyframe')")
        assert browser.errors == []
        outside = [url for url in browser.requests if not re.match(r"data:|blob:|(http|ws)://127\.0\.0\.1", url)]
        assert outside == []
    finally:
        browser.close()


def test_verb_serves_until_it_is_stopped(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stop = threading.Event()
    stop.set()
    run(ViewerConfig(folder, port=PORT + 50, browser=False), stop)
    assert re.search(r"http://localhost:\d+", capsys.readouterr().out)


def test_a_run_that_is_still_going_is_followed(folder: Path, server: viser.ViserServer, tmp_path: Path) -> None:
    """Stage by stage: nothing yet, odometry alone, the result; a stage that is taken away leaves what was shown."""
    going = tmp_path / "going"
    going.mkdir()
    write_json(going / "run.json", {"format": 2, "complete": []})
    follower = RunFollower(going, partial(read_run, going, unfinished=True), server)
    assert not follower.refresh() and follower.viewer is None
    for name in ("odometry.txt", "frames.jsonl", "intrinsics.json"):
        shutil.copy(folder / name, going / name)
    write_json(going / "run.json", {"format": 2, "complete": ["odometry"]})
    assert follower.refresh() and follower.viewer is not None
    assert {"odometry", "keyframe", "cameras"} <= set(follower.viewer.layers) and "objects" not in follower.viewer.layers
    assert "odometry" in follower.viewer.gui["stages"].content
    assert not follower.refresh()  # nothing new
    shutil.copytree(folder / "slam", going / "slam")
    write_json(going / "run.json", {"format": 2, "complete": ["odometry", "observe", "slam"]})
    assert follower.refresh() and "objects" in follower.viewer.layers
    shown = follower.viewer
    (going / "slam" / "landmarks.json").write_text("[")
    assert not follower.refresh() and follower.viewer is shown


def test_the_verb_follows_behind_the_guard(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A page served before the first stage, with its token; strangers are refused; a stage that ends is shown."""
    going = tmp_path / "going"
    going.mkdir()
    write_json(going / "run.json", {"format": 2, "complete": []})
    stop, shown = threading.Event(), threading.Event()
    refresh = RunFollower.refresh

    def told(self: RunFollower) -> bool:
        new = refresh(self)
        if new:
            shown.set()
        return new

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFollower, "refresh", told)
        config = ViewerConfig(going, port=PORT + 70, browser=False, poll=0.05)
        thread = threading.Thread(target=run, args=(config, stop))
        thread.start()
        try:
            address, text = None, ""
            for _ in range(600):
                text += capsys.readouterr().out
                if (match := re.search(r"http://\S+token=\S+", text)) is not None:
                    address = match.group(0)
                    break
                time.sleep(0.1)
            assert address is not None
            with urllib.request.urlopen(address, timeout=60) as answer:
                assert answer.status == 200
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address.split("?")[0], timeout=60)
            assert not shown.is_set()
            shutil.copy(folder / "odometry.txt", going / "odometry.txt")
            assert shown.wait(60)
        finally:
            stop.set()
            thread.join(60)


def test_slam_folder_alone_is_shown(folder: Path, server: viser.ViserServer) -> None:
    server.scene.reset()
    server.gui.reset()
    shown = build_viewer(folder / "slam", server)
    assert {"estimate", "keyframe", "objects", "labels"} <= set(shown.layers) and "odometry" not in shown.layers
    assert "picture" not in shown.gui


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no result of a run"):
        main([str(tmp_path), "--no-browser"])
    with pytest.raises(InputError, match="no such folder"):
        run(ViewerConfig(tmp_path / "nowhere"))
