"""`nolbo observe`: files in, observations and pictures out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nolbo_ppl.cli.observe import ObserveConfig, main, run
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.io.images import open_image
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.models.model_config import PRESETS
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration

THRESHOLD = 0.05


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> Iterator[None]:
    torch.set_default_dtype(torch.float32)
    yield


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fresh networks whose objectness is spread out, so that they see a few objects in anything."""
    folder = tmp_path_factory.mktemp("model")
    torch.set_default_dtype(torch.float32)
    save(folder, Nolbo.from_seed(PRESETS["nano"](), 0), Calibration(objectness_slope=40.0, objectness_shift=158.5), {})
    return folder


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures of different sizes, formats and modes, named out of order, and a file that is none."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for name, size in (("b.png", (64, 64, 3)), ("a.jpg", (48, 96, 3)), ("c.png", (100, 60)), ("d.PNG", (64, 64, 4))):
        Image.fromarray(rng.integers(0, 256, size, dtype=np.uint8)).save(folder / name)
    (folder / "notes.txt").write_text("no picture", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def observed(model: Path, images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("observed") / "deep" / "out"
    summary = run(ObserveConfig(images, out, str(model), (60.0, 60.0, 32.0, 32.0), score_threshold=THRESHOLD, pictures=False))
    assert summary.images == 4
    assert summary.detections == sum(1 for _ in read_jsonl(summary.file)) > 4
    return out


def test_frames_count_images_in_sorted_order(observed: Path, images: Path) -> None:
    rows = [row for _, row in read_jsonl(observed / "observations.jsonl")]
    names = {row["frame"]: row["image"] for row in rows}
    assert names == {0: "a.jpg", 1: "b.png", 2: "c.png", 3: "d.PNG"}
    assert [row["frame"] for row in rows] == sorted(row["frame"] for row in rows)
    assert len({row["id"] for row in rows}) == len(rows)


def test_lines_say_what_the_query_says(observed: Path, model: Path, images: Path) -> None:
    rows = [row for _, row in read_jsonl(observed / "observations.jsonl") if row["image"] == "b.png"]
    answer = load(model).observe(open_image(images / "b.png"), [60.0, 60.0, 32.0, 32.0], threshold=THRESHOLD)
    assert len(rows) == len(answer)
    for i, row in enumerate(rows):
        assert row["category"] == answer.category[i]
        np.testing.assert_allclose(row["position"], answer.position[i], atol=1e-5)
        # A float32 network: a batch sums in another order than one image.
        np.testing.assert_allclose(row["position_cov"], answer.position_covariance[i], atol=1e-8, rtol=1e-5)
        np.testing.assert_allclose(row["latent"], answer.latent[i], atol=1e-5)
        assert sum(row["class_posterior"].values()) == pytest.approx(1, abs=1e-5)
        assert sum(mode["weight"] for mode in row["azimuth_modes"]) == pytest.approx(1, abs=1e-4)
        assert all(row["objectness"] > THRESHOLD for row in rows)


def test_slam_reads_the_lines(observed: Path) -> None:
    table = read_observations(observed / "observations.jsonl", frames=4)
    rows = [row for _, row in read_jsonl(observed / "observations.jsonl")]
    assert len(table) == len(rows)
    assert table.latent_dim == 16
    assert table.has_rotation.all()
    np.testing.assert_allclose(np.linalg.norm([row["rotation"] for row in rows], axis=1), 1, atol=1e-6)


def test_a_picture_an_image(model: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("one.png", "two.jpg"):
        Image.fromarray(np.full((64, 64, 3), 120, dtype=np.uint8)).save(tmp_path / "images" / name)
    answer = load(model).observe(open_image(tmp_path / "images" / "one.png"), threshold=1e-6, decode=False)
    best = float(np.sort(answer.objectness)[-2:].mean())  # one or two objects: drawing shapes takes its time
    run(ObserveConfig(tmp_path / "images", tmp_path / "out", str(model), score_threshold=best))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["observations.jsonl", "one.png", "two.png"]
    with Image.open(tmp_path / "out" / "one.png") as picture:
        assert picture.width > 1000


def test_without_pictures_and_intrinsics_by_the_command_line(
    model: Path, images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = ["--images", str(images), "--out", str(tmp_path), "--model", str(model)]
    main([*folders, "--no-pictures", "--score-threshold", "0.999999"])
    assert "objects in 4 images" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["observations.jsonl"]


def test_each_photograph_has_the_focal_length_of_its_own_file(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a phone writes them: a wide lens, a long one, and a file whose camera nobody knows."""
    (tmp_path / "images").mkdir()
    picture = Image.fromarray(np.random.default_rng(3).integers(0, 256, (48, 96, 3), dtype=np.uint8))
    for name, film in (("a.jpg", 18), ("b.jpg", 54), ("c.jpg", None)):
        exif = Image.Exif()
        if film is not None:
            exif.get_ifd(0x8769)[0xA405] = film
        picture.save(tmp_path / "images" / name, exif=exif)
    main(["--images", str(tmp_path / "images"), "--out", str(tmp_path / "out"), "--model", str(model), "--no-pictures",
          "--score-threshold", str(THRESHOLD)])  # fmt: skip
    rows = [row for _, row in read_jsonl(tmp_path / "out" / "observations.jsonl")]
    for name, camera in (("a.jpg", [48.0, 48, 48, 24]), ("b.jpg", [144.0, 144, 48, 24]), ("c.jpg", None)):
        answer = load(model).observe(open_image(tmp_path / "images" / name), camera, threshold=THRESHOLD, decode=False)
        own = [row["position"] for row in rows if row["image"] == name]
        assert len(own) == len(answer) > 0
        np.testing.assert_allclose(own, answer.position, rtol=1e-3, atol=1e-4)
    assert "2 of 3 images tell their focal length" in capsys.readouterr().out


def test_nothing_found_is_an_empty_file(model: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Image.fromarray(np.full((64, 64, 3), 90, dtype=np.uint8)).save(tmp_path / "images" / "grey.png")
    summary = run(ObserveConfig(tmp_path / "images", tmp_path / "out", str(model), score_threshold=1 - 1e-12))
    assert summary.detections == 0
    assert summary.file.read_text(encoding="utf-8") == ""
    assert (tmp_path / "out" / "grey.png").is_file()


def test_batches_do_not_change_the_answers(model: Path, images: Path, tmp_path: Path) -> None:
    lines = []
    for batch in (1, 3):
        out = tmp_path / str(batch)
        run(ObserveConfig(images, out, str(model), score_threshold=THRESHOLD, pictures=False, batch=batch))
        lines.append([row for _, row in read_jsonl(out / "observations.jsonl")])
    assert [row["id"] for row in lines[0]] == [row["id"] for row in lines[1]]
    for one, three in zip(*lines):
        np.testing.assert_allclose(one["position"], three["position"], rtol=1e-3)


def test_a_larger_size_sees_other_cells(model: Path, images: Path, tmp_path: Path) -> None:
    """`--size` reaches the network: as many cells as a picture of that size has."""
    config = ObserveConfig(images, tmp_path / "large", str(model), score_threshold=0.01, pictures=False, size=128)
    small = ObserveConfig(images, tmp_path / "small", str(model), score_threshold=0.01, pictures=False)
    boxes = [[row["box"] for _, row in read_jsonl(run(one).file)] for one in (config, small)]
    assert boxes[0] != boxes[1]
    with pytest.raises(InputError, match="multiple of 32"):
        run(ObserveConfig(images, tmp_path / "odd", str(model), size=100))


def test_a_damaged_picture_is_named_and_leaves_no_observations(model: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match=r"torn\.png: not a readable image"):
        run(ObserveConfig(tmp_path / "images", tmp_path / "out", str(model)))
    assert not (tmp_path / "out" / "observations.jsonl").exists()


def test_bad_folders_and_models(model: Path, images: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder or video"):
        run(ObserveConfig(tmp_path / "nowhere", tmp_path / "out", str(model)))
    with pytest.raises(InputError, match="no image in the folder"):
        run(ObserveConfig(tmp_path, tmp_path / "out", str(model)))
    with pytest.raises(InputError, match="no such model: got 'huge', expected one of"):
        run(ObserveConfig(images, tmp_path / "out", "huge"))
    with pytest.raises(InputError, match="pictures would be written over the images"):
        run(ObserveConfig(images, images, str(model)))
    with pytest.raises(InputError, match="intrinsics"):
        run(ObserveConfig(images, tmp_path / "out", str(model), intrinsics=(0.0, 60.0, 32.0, 32.0)))
