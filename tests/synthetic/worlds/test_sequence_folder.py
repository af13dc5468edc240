"""Drives on disk: the contract of the folder, resuming, and errors that say what to do."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse
from nolbo_ppl.io.files import read_json, read_jsonl, write_json, write_jsonl
from nolbo_ppl.synthetic.worlds import SequenceConfig, read_sequence_folder, write_sequence_folder
from nolbo_ppl.synthetic.worlds import sequence_folder as folder

CONFIG = SequenceConfig(
    world="indoor", frames=18, step=0.4, laps=0.25, objects=24, clutter=4, size=(96, 64), supersample=1, seed=8
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("drive") / "a"
    write_sequence_folder(CONFIG, out)
    return out


def content(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}


def copied(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "copy"))


def test_files_of_the_contract(written: Path) -> None:
    names = {path.name for path in written.iterdir()}
    assert names == {
        "images",
        "intrinsics.json",
        "truth.txt",
        "times.txt",
        "objects.json",
        "scenes.jsonl",
        "voxels.npz",
        "drive.json",
    }
    assert sorted(path.name for path in (written / "images").iterdir()) == [f"{k:06d}.png" for k in range(18)]
    with Image.open(written / "images" / "000003.png") as image:
        assert image.size == (96, 64) and image.mode == "RGB"
    camera = read_json(written / "intrinsics.json")
    assert set(camera) == {"fx", "fy", "cx", "cy", "width", "height"} and camera["cx"] == 48
    rows = np.loadtxt(written / "truth.txt")
    assert rows.shape == (18, 12)
    np.testing.assert_allclose(rows[0].reshape(3, 4), np.eye(4)[:3])
    assert np.loadtxt(written / "times.txt").shape == (18,)
    things = read_json(written / "objects.json")
    assert {"id", "category", "instance", "symmetry", "T_world_object", "diagonal", "dimensions", "moving"} <= set(things[0])
    ids = {thing["id"]: thing for thing in things}
    labels = [thing for _, row in read_jsonl(written / "scenes.jsonl") for thing in row["objects"]]
    assert labels and all(ids[label["id"]]["instance"] == label["instance"] for label in labels)
    with np.load(written / "voxels.npz", allow_pickle=False) as voxels:
        assert {thing["instance"] for thing in things} == set(voxels.files)
        assert all(voxels[name].shape == (32**3 // 8,) and voxels[name].any() for name in voxels.files)
    facts = read_json(written / "drive.json")
    assert facts["config"]["seed"] == 8 and facts["version"] and len(facts["T_world_ground"]) == 4


def test_read_back(written: Path) -> None:
    drive = read_sequence_folder(written)
    assert len(drive) == 18 and drive.size == (96, 64) and drive.image(2).shape == (64, 96, 3)
    things = {thing.id: thing for thing in drive.objects}
    checked = 0
    for k, frame in enumerate(drive.frames):
        T_camera_world = inverse(drive.T_world_camera[k])
        for i, name in enumerate(frame.id):
            assert name is not None
            T = T_camera_world @ things[name].T_world_object
            np.testing.assert_allclose(frame.position[i], T[:3, 3], atol=2e-5)
            np.testing.assert_allclose(frame.R_camera_object[i], T[:3, :3], atol=1e-6)
            assert frame.category[i] == things[name].category
            checked += 1
    assert checked > 20
    # Gravity: the ground's normal, and the height of the camera above it.
    T_world_ground = np.array(drive.facts["T_world_ground"])
    assert (inverse(T_world_ground) @ drive.T_world_camera)[:, 2, 3] == pytest.approx(CONFIG.camera_height, abs=0.1)
    assert drive.voxels().keys() == {thing.instance for thing in drive.objects}


def test_a_drive_is_also_a_folder_of_scenes(written: Path) -> None:
    scenes = SceneFolder(written, size=96)
    assert len(scenes) == 18 and len(scenes.records[0]) == len(read_sequence_folder(written).frames[0])


def test_stopped_runs_go_on(written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that dies in frame 11 leaves whole files; called again it renders only what lacks, to the same bytes."""
    real, rendered = folder.render_frame, []

    def dying(world: object, frame: int) -> object:
        if frame == 11:
            raise KeyboardInterrupt
        return real(world, frame)  # type: ignore[arg-type]

    def counting(world: object, frame: int) -> object:
        rendered.append(frame)
        return real(world, frame)  # type: ignore[arg-type]

    out = tmp_path / "b"
    monkeypatch.setattr(folder, "render_frame", dying)
    with pytest.raises(KeyboardInterrupt):
        write_sequence_folder(CONFIG, out)
    assert not (out / "scenes.jsonl").exists() and not list(out.rglob("*.tmp*"))
    with pytest.raises(InputError, match=r"not a complete drive.*nolbo drive --out, which also resumes"):
        read_sequence_folder(out)
    monkeypatch.setattr(folder, "render_frame", counting)
    summary = write_sequence_folder(CONFIG, out)
    assert rendered == list(range(8, 18))
    assert content(out) == content(written)
    assert write_sequence_folder(CONFIG, out) == summary and len(rendered) == 10  # complete: nothing is left to do
    assert summary.frames == 18 and summary.objects == 24 and 0 < summary.seen <= 24 and summary.labels > 20


@pytest.mark.slow
def test_files_do_not_depend_on_the_number_of_processes(written: Path, tmp_path: Path) -> None:
    write_sequence_folder(CONFIG, tmp_path / "c", workers=2)
    assert content(tmp_path / "c") == content(written)


def test_other_drives_are_refused(written: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder holds another drive.*choose another --out"):
        write_sequence_folder(replace(CONFIG, seed=9), written)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="the folder is not empty"):
        write_sequence_folder(CONFIG, tmp_path)


def test_malformed_objects(written: Path, tmp_path: Path) -> None:
    out = copied(written, tmp_path)
    good = read_json(out / "objects.json")

    def refused(match: str, **change: object) -> None:
        write_json(out / "objects.json", [{**good[0], **change}, *good[1:]])
        with pytest.raises(InputError, match=match):
            read_sequence_folder(out)

    refused(r"objects\.json: entry 0: category: got spoon, expected aeroplane", category="spoon")
    refused(r"entry 0: id", id=3)
    refused(r"entry 0: T_world_object.*expected a 4 x 4 pose", T_world_object=[[1, 2], [3, 4]])
    refused(r"entry 0: T_world_object", T_world_object=(2 * np.eye(4)).tolist())
    refused(r"entry 0: dimensions, diagonal", diagonal=-1.0)
    refused(r"entry 0: dimensions, diagonal", dimensions=None)
    refused(r"got two with one id", id=good[1]["id"])
    write_json(out / "objects.json", {})
    with pytest.raises(InputError, match=r"true objects: got dict, expected a list"):
        read_sequence_folder(out)
    write_json(out / "objects.json", good[1:])
    if any(good[0]["id"] in frame.id for frame in read_sequence_folder(written).frames):
        with pytest.raises(InputError, match=r"scenes\.jsonl:\d+: id: got O0, expected one of objects\.json"):
            read_sequence_folder(out)


def test_malformed_files(written: Path, tmp_path: Path) -> None:
    out = copied(written, tmp_path)
    rows = [row for _, row in read_jsonl(out / "scenes.jsonl")]
    write_jsonl(out / "scenes.jsonl", rows[:-1])
    with pytest.raises(InputError, match=r"lengths differ: got 17 frames, 18 poses, 18 times"):
        read_sequence_folder(out)
    write_jsonl(out / "scenes.jsonl", rows)
    (out / "times.txt").write_text("soon\n")
    with pytest.raises(InputError, match=r"times\.txt:1: not a time"):
        read_sequence_folder(out)
    write_json(out / "intrinsics.json", {"fx": 1})
    with pytest.raises(InputError, match=r"intrinsics\.json: intrinsics: fy: got"):
        read_sequence_folder(out)
    with pytest.raises(InputError, match="not a complete drive"):
        read_sequence_folder(tmp_path / "absent")
    (written.parent / "bad.png").write_text("no picture")
    with pytest.raises(InputError, match="not a readable image"):
        folder.read_image(written.parent / "bad.png")
