"""Data sets on disk: round trip, resumption, user data with gaps, and every malformed line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nolbo_ppl.data.converters.photographs import convert_photographs, read_photographs
from nolbo_ppl.data.dataset_folder import SceneFolder, letterbox
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.camera import project
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.synthetic import dataset_writer as dataset
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import standard
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from tests.data.converters.test_photographs import write as labels

COUNT = 10


@pytest.fixture(scope="module")
def source() -> SceneGenerator:
    return SceneGenerator(standard(64), seed=11, instances=2)


@pytest.fixture(scope="module")
def written(source: SceneGenerator, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes") / "set"
    summary = write_scenes(out, source, COUNT)
    assert summary["scenes"] == COUNT
    return out


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the voxels' archive, whose entries carry dates, by name."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".npz"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(files)}


def test_round_trip(source: SceneGenerator, written: Path) -> None:
    folder = SceneFolder(written, size=64)
    assert len(folder) == COUNT and folder.slots == 8
    batch = folder.batch(range(COUNT))
    objects = 0
    for row in range(COUNT):
        rendered = source.render(row)
        np.testing.assert_array_equal(batch["image"][row], rendered.image.transpose(2, 0, 1))
        np.testing.assert_allclose(batch["intrinsics"][row], rendered.intrinsics, rtol=1e-6)
        assert batch["present"][row].sum() == len(rendered.labels)
        for slot, label in enumerate(rendered.labels):
            objects += 1
            record = folder.records[row]
            np.testing.assert_allclose(record.R_camera_object[slot], label.R_camera_object, atol=1e-8)
            np.testing.assert_allclose(record.position[slot], label.position, atol=1e-6)
            np.testing.assert_allclose(batch["box"][row, slot], label.box, atol=1e-5)
            assert folder.categories[batch["category"][row, slot]] == label.category
            assert folder.instances[batch["instance"][row, slot]] == label.instance
            assert batch["diagonal"][row, slot] == pytest.approx(label.size, abs=1e-6)
            assert batch["visibility"][row, slot] == pytest.approx(label.visibility, abs=1e-6)
            assert batch["symmetry"][row, slot] == label.symmetry
            bits = np.unpackbits(batch["voxels"][row, slot]).reshape(32, 32, 32).astype(bool)
            np.testing.assert_array_equal(bits, label.item.shape.voxels(32))
    assert objects > 10
    for name in ("has_viewpoint", "has_position", "has_size", "has_voxels"):
        np.testing.assert_array_equal(batch[name], batch["present"])
    number, packed, category = folder.shapes()
    assert [folder.instances[n].split("-")[0] for n in number] == [folder.categories[c] for c in category]
    assert packed.shape == (len(folder.instances), 4096)


def test_rendered_folders_are_told_from_others(written: Path, user: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "drive.json").write_text("{}")
    assert dataset.is_generated(written) and dataset.is_generated(tmp_path / "drive")
    convert_photographs(read_photographs(labels(tmp_path / "labels")), tmp_path / "photographs")
    assert not dataset.is_generated(tmp_path / "photographs") and not dataset.is_generated(user(user_line()))


def test_killed_run_is_resumed(source: SceneGenerator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "CHUNK", 3)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    write_scenes(whole, source, 8)
    render = SceneGenerator.render

    def dying(self: SceneGenerator, index: int):
        if index == 5:
            raise KeyboardInterrupt
        return render(self, index)

    with monkeypatch.context() as patch:
        patch.setattr(SceneGenerator, "render", dying)
        with pytest.raises(KeyboardInterrupt):
            write_scenes(killed, source, 8)
    assert not (killed / "scenes.jsonl").exists()
    with pytest.raises(InputError, match=r"scenes.jsonl: no such file"):
        SceneFolder(killed)
    drawn: list[int] = []

    def counting(self: SceneGenerator, index: int):
        drawn.append(index)
        return render(self, index)

    monkeypatch.setattr(SceneGenerator, "render", counting)
    write_scenes(killed, source, 8)
    assert drawn == [3, 4, 5, 6, 7]  # the finished chunk is not made again
    assert contents(killed) == contents(whole)
    write_scenes(killed, source, 8)  # finished: nothing to do
    assert len(drawn) == 5
    with np.load(killed / "voxels.npz") as a, np.load(whole / "voxels.npz") as b:
        assert a.files == b.files
        assert all(np.array_equal(a[name], b[name]) for name in a.files)


@pytest.mark.slow
def test_files_do_not_depend_on_the_number_of_workers(
    source: SceneGenerator, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "CHUNK", 4)
    write_scenes(tmp_path / "two", source, COUNT, workers=2)
    assert contents(tmp_path / "two") == contents(written)


def test_other_scenes_are_not_mixed_in(source: SceneGenerator, written: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder holds other scenes.*choose another --out"):
        write_scenes(written, replace(source, seed=12), COUNT)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="the folder is not empty"):
        write_scenes(tmp_path, source, 1)
    with pytest.raises(InputError, match="number of scenes: got 0, expected at least 1"):
        write_scenes(tmp_path / "new", source, 0)


def user_line(**changes: object) -> dict:
    thing = {
        "box": [10, 20, 110, 60],
        "category": "car",
        "instance": "my car",
        "rotation": [0, 0, 0, 1],
        "position": [0.1, 0.2, 5.0],
        "size": 4.5,
        "visibility": 0.5,
        "symmetry": 1,
    }
    line = {"image": "a.png", "intrinsics": [200, 210, 80, 50], "objects": [thing]}
    for field, value in changes.items():
        target = line if field in line else thing
        if value is None:
            target.pop(field)
        else:
            target[field] = value
    return line


@pytest.fixture
def user(tmp_path: Path) -> Callable[..., Path]:
    """A folder of one image of 160 x 100 px with the given line."""

    def make(line: dict | str) -> Path:
        pixels = np.random.default_rng(0).integers(0, 255, (100, 160, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "a.png")
        text = line if isinstance(line, str) else json.dumps(line)
        (tmp_path / "scenes.jsonl").write_text("\n" + text + "\n")
        return tmp_path

    return make


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (user_line(image="b.png"), r"scenes.jsonl:2: image: got b.png, expected an image file in"),
        (user_line(image=None), r"scenes.jsonl:2: image: expected a path"),
        (user_line(image="scenes.jsonl"), r"scenes.jsonl:2: image scenes.jsonl: not a readable image"),
        (user_line(intrinsics=[200, 210, 80]), r":2: intrinsics: got \[200, 210, 80\], expected \[fx, fy, cx, cy\]"),
        (user_line(intrinsics=[200, -210, 80, 50]), r":2: intrinsics: .*all positive"),
        (user_line(intrinsics=[200, 1e-320, 80, 50]), r":2: intrinsics: .*all positive"),
        (user_line(size=5e-324), r":2: objects\[0\].size: .*positive"),
        (user_line(intrinsics="f"), r":2: intrinsics: got f"),
        (user_line(objects={}), r":2: objects: got \{\}, expected a list of objects"),
        (user_line(objects=[7]), r":2: objects\[0\]: got 7"),
        (user_line(box=None), r":2: objects\[0\].box: expected \[x0, y0, x1, y1\] in px"),
        (user_line(box=[110, 20, 10, 60]), r":2: objects\[0\].box: got .*expected x0 < x1 and y0 < y1"),
        (user_line(box=[10, 20, 190, 60]), r":2: objects\[0\].box: .*inside the image of 160 x 100 px; cut it"),
        (user_line(box=[10, 20, True, 60]), r":2: objects\[0\].box"),
        ('{"image": "a.png", "intrinsics": [1, 1, 1, NaN], "objects": []}', r":2: not a line of JSON.*NaN"),
        ('{"image": "a.png", "intrin', r"scenes.jsonl:2: not a line of JSON.*truncated"),
        (user_line(rotation=[0, 0, 0, 2]), r":2: objects\[0\].rotation: .* of length 2, expected a unit quaternion"),
        (user_line(rotation=[0, 0, 1]), r":2: objects\[0\].rotation: .*R_camera_object"),
        (user_line(category="zebra"), r":2: objects\[0\].category: got 'zebra', expected one of aeroplane"),
        (user_line(instance=5), r":2: objects\[0\].instance: got 5, expected a name"),
        (user_line(size=0), r":2: objects\[0\].size: got 0.0, expected the box diagonal in m, positive"),
        (user_line(size="big"), r":2: objects\[0\].size: got big"),
        (user_line(size=None, dimensions=[1, 2, -1]), r":2: objects\[0\].dimensions: .*positive"),
        (user_line(position=[0, 0, -1]), r":2: objects\[0\].position: .*z > 0"),
        (user_line(visibility=1.5), r":2: objects\[0\].visibility: got 1.5, expected a share from 0 to 1"),
        (user_line(symmetry=-1), r":2: objects\[0\].symmetry: got -1"),
        (user_line(symmetry=1.5), r":2: objects\[0\].symmetry: got 1.5"),
    ],
)
def test_malformed_lines(user: Callable[..., Path], line: dict | str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SceneFolder(user(line), size=64)


def test_malformed_folders(user: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such data set"):
        SceneFolder(tmp_path / "absent")
    folder = user(user_line())
    with pytest.raises(InputError, match="image size: got 50, expected a positive multiple of 32"):
        SceneFolder(folder, size=50)
    with pytest.raises(InputError, match=r"no such image in the data set: got \[1\], expected 0 to 0"):
        SceneFolder(folder, size=64).batch([1])
    with pytest.raises(InputError, match="more objects in an image than slots"):
        SceneFolder(folder, size=64, slots=0)
    np.savez(folder / "voxels.npz", **{"my car": np.zeros(7, dtype=np.uint8)})
    with pytest.raises(InputError, match=r"voxels.npz: voxels of my car: got uint8 \[7\]"):
        SceneFolder(folder, size=64)
    (folder / "voxels.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"voxels.npz: not a readable NPZ file"):
        SceneFolder(folder, size=64)
    (folder / "voxels.npz").unlink()
    opened = SceneFolder(folder, size=64)
    data = (folder / "a.png").read_bytes()
    (folder / "a.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"a.png: not a readable image"):
        opened.batch([0])
    (folder / "scenes.jsonl").write_text("\n\n")
    with pytest.raises(InputError, match="a data set without images"):
        SceneFolder(folder)


def test_missing_labels_are_unlabelled(user: Callable[..., Path]) -> None:
    line = {"image": "a.png", "intrinsics": [200, 210, 80, 50], "objects": [{"box": [1, 2, 30, 40]}]}
    folder = SceneFolder(user(line))
    batch = folder.batch([0])
    assert batch["present"].sum() == 1
    for name in ("has_viewpoint", "has_position", "has_size", "has_voxels"):
        assert not batch[name].any()
    assert (batch["category"] == -1).all() and (batch["instance"] == -1).all()
    assert batch["visibility"][0, 0] == 1 and batch["symmetry"][0, 0] == 1
    size_of_sides = SceneFolder(user(user_line(size=None, dimensions=[1.0, 2.0, 2.0], visibility=None))).batch([0])
    assert size_of_sides["diagonal"][0, 0] == 3.0 and size_of_sides["has_size"][0, 0]
    bottle = SceneFolder(user(user_line(category="bottle", symmetry=None))).batch([0])
    assert bottle["symmetry"][0, 0] == 0  # what the category declares


def test_declared_symmetry_is_that_of_objects_that_state_none(user: Callable[..., Path]) -> None:
    line = user_line(category="mug", symmetry=None)
    stated = {**line["objects"][0], "category": "box", "symmetry": 4}
    unknown = {"box": stated["box"]}
    line["objects"] += [stated, unknown]
    folder = user(line)
    assert SceneFolder(folder, ("box", "mug")).batch([0])["symmetry"][0, :3].tolist() == [1, 4, 1]
    assert SceneFolder(folder, ("box", "mug"), symmetry=(1, 2)).batch([0])["symmetry"][0, :3].tolist() == [2, 4, 1]
    with pytest.raises(InputError, match="symmetry: got 1, expected one of each of 2 categories"):
        SceneFolder(folder, ("box", "mug"), symmetry=(1,))


def test_letterbox_keeps_the_perspective(user: Callable[..., Path]) -> None:
    """A point projected with the new intrinsics lands where the letterbox took its pixel; boxes follow."""
    folder = SceneFolder(user(user_line()), size=64)
    batch = folder.batch([0])
    image = folder.image(0)
    canvas, scale, shift = letterbox(image, 64)
    assert scale == pytest.approx(0.4) and shift == (0.0, 12.0)
    np.testing.assert_array_equal(batch["image"][0], canvas.transpose(2, 0, 1))
    point = torch.tensor([[0.3, -0.1, 2.0]], dtype=torch.float64)
    old = project(point, torch.from_numpy(folder.intrinsics(0))[None])[0].numpy()
    new = project(point, torch.from_numpy(batch["intrinsics"].astype(np.float64)))[0].numpy()
    np.testing.assert_allclose(new, old * scale + shift, atol=1e-5)
    np.testing.assert_allclose(batch["box"][0, 0], [4, 20, 44, 36], atol=1e-5)
    assert (canvas[:12] == 114).all() and (canvas[52:] == 114).all() and not (canvas[12:52] == 114).all()
    lines = [line for _, line in read_jsonl(folder.path / "scenes.jsonl")]
    assert len(lines) == 1
