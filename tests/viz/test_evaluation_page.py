"""The page of an evaluation and its pictures of whole scenes and of retrieval."""

import base64
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.evaluation.retrieval import RetrievalRecords
from nolbo_ppl.metrics.detection import match
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.viz.detection_plots import choose_scenes, mistakes, write_detections
from nolbo_ppl.viz.evaluation_page import LARGE, WORDS, write_page
from nolbo_ppl.viz.evaluation_plots import draw_retrieval
from nolbo_ppl.viz.style import save


def found(right, missed, wrong):
    """Scenes with so many objects found, missed, and things found that are none."""
    boxes, scores, truths = [], [], []
    for r, m, w in zip(right, missed, wrong):
        corner = np.stack((np.arange(r + m + w) * 30.0, np.zeros(r + m + w)), 1)
        box = np.concatenate((corner, corner + 20), 1)
        truths.append(box[: r + m])
        boxes.append(np.concatenate((box[:r], box[r + m :])))
        scores.append(np.full(r + w, 0.9))
    return match(boxes, scores, truths, [np.zeros(len(t), dtype=bool) for t in truths])


def test_mistakes_are_the_missed_and_the_false():
    matches = found([2, 1, 0, 0], [0, 1, 3, 0], [0, 1, 0, 4])
    assert mistakes(matches).tolist() == [0, 2, 3, 4]
    assert mistakes(matches, threshold=0.95).tolist() == [2, 2, 3, 0]  # nothing is sure enough: all are missed


def test_scenes_are_chosen_by_their_mistakes():
    matches = found([3, 0, 1, 2, 5, 0], [0, 2, 1, 0, 0, 0], [0, 9, 1, 5, 0, 7])
    # Mistakes 0, 11, 2, 5, 0; the last holds nothing to find. Among the faultless the fuller scene comes first.
    assert choose_scenes(matches, 1) == {"best": [4], "median": [2], "worst": [1]}
    assert choose_scenes(matches, 4)["best"] == [4]  # three rows of scenes that differ, as many as there are


class Scenes:
    def __getitem__(self, index):
        image = np.random.default_rng(index).integers(0, 256, (60, 200, 3), dtype=np.uint8)
        box = np.array([[10.0, 10, 50, 40], [60, 10, 100, 40]])
        return Annotations.from_arrays([100.0, 100, 100, 30], box, ignore=[[120.0, 10, 180, 50]], pixels=image)


class Model:
    def observe(self, images, intrinsics, *, threshold, decode):
        posterior = np.full((1, 12), 0.01)
        posterior[0, 5] = 0.89
        return [
            SimpleNamespace(
                box=np.array([[12.0, 9, 52, 41]]), objectness=np.array([0.8]), class_posterior=posterior, categories=CATEGORIES
            )
        ]


def test_detections_are_drawn(tmp_path):
    figure = write_detections(found([2, 1, 0], [0, 1, 2], [0, 0, 0]), Scenes(), Model(), tmp_path / "detections.png")
    assert [axes.get_title() for axes in figure.axes] == [
        "best: 2 to find, 0 mistakes",
        "median: 2 to find, 1 mistakes",
        "worst: 2 to find, 2 mistakes",
    ]
    first = figure.axes[0]
    assert len(first.patches) == 1 + 2 + 1 and first.texts[0].get_text() == "car 0.80"
    assert (tmp_path / "detections.png").stat().st_size > 5000
    assert write_detections(found([0], [0], [2]), Scenes(), Model(), tmp_path / "nothing.png") is None
    assert not (tmp_path / "nothing.png").exists()


def test_retrieval_is_drawn(tmp_path):
    rank = np.array([[1, 2], [1, 1], [3, 3], [4, 1]])
    records = RetrievalRecords(np.array([5, 5, 6, 6]), np.full(4, 4), dict.fromkeys(("evidence", "overlap", "euclidean"), rank))
    figure = draw_retrieval(records, CATEGORIES)
    left, right = figure.axes
    # First places: 4 of the 8 searches; within three places 7; within four all. Chance at the first place: a quarter.
    np.testing.assert_allclose(left.lines[0].get_ydata(), [4 / 8, 5 / 8, 7 / 8, 1.0])
    np.testing.assert_allclose(left.lines[3].get_ydata(), [0.25, 0.5, 0.75, 1.0])
    assert [round(bar.get_height(), 3) for bar in right.patches] == [0.75, 0.25]
    assert [tick.get_text() for tick in right.get_xticklabels()] == ["car", "chair"]
    save(figure, tmp_path / "retrieval.png")


def values(**changes):
    row = {"objects": 3, "ap50": 0.5, "acc_pi6": None}
    return {
        "ap50": 0.512345,
        "acc_pi6": None,
        "intervals": {"ap50": [0.4, 0.6], "acc_pi6": None},
        "counts": {"ap50": 12, "acc_pi6": 0},
        "scenes": 7,
        "objects": 12,
        "by_category": {"car<b>": row, "bus": row},
        "by_difficulty": {"under 24 px": row},
        "retrieval": None,
        "versions": {"torch": "2"},
        "configuration": {
            "model": "tiny & co",
            "scenes": None,
            "difficulty": "full",
            "seed": 5,
            "cad": None,
            "backgrounds": "photos",
        },
        **changes,
    }


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.open, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.sources.append(dict(attrs)["src"])
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_the_page_holds_everything_and_needs_nothing(tmp_path):
    rng = np.random.default_rng(0)
    small = Image.fromarray(rng.integers(0, 256, (20, 20, 3), dtype=np.uint8))
    small.save(tmp_path / "confusion.png")
    Image.fromarray(rng.integers(0, 256, (500, 500, 3), dtype=np.uint8)).save(tmp_path / "precision_recall.png")
    assert (tmp_path / "precision_recall.png").stat().st_size > LARGE
    pictures = [tmp_path / "confusion.png", tmp_path / "precision_recall.png"]
    write_page(values(), pictures, tmp_path / "index.html")
    html = (tmp_path / "index.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(html)
    assert reader.open == [] and "http" not in re.sub(r"base64,[^\"]*", "", html)
    kinds = [source.split(";")[0] for source in reader.sources]
    assert kinds == ["data:image/jpeg", "data:image/png"]  # the order of the captions; the large one as JPEG
    assert base64.b64decode(reader.sources[1].split(",")[1]) == (tmp_path / "confusion.png").read_bytes()
    assert "0.512" in reader.text and "0.400 to 0.600" in reader.text and WORDS["ap50"] in reader.text
    assert "car<b>" in reader.text and "tiny & co" in reader.text and "full, seed 5, backgrounds photos" in reader.text
    assert "acc_pi6" not in reader.text  # what was not measured has no row and no column


def test_every_figure_has_words():
    from nolbo_ppl.evaluation.scores import REQUIRED

    assert set(REQUIRED) <= set(WORDS)


@pytest.mark.parametrize("scenes", ["a/folder", None])
def test_the_page_names_its_scenes(tmp_path, scenes):
    configuration = {**values()["configuration"], "scenes": scenes}
    write_page(values(configuration=configuration), [], tmp_path / "index.html")
    assert ("a/folder" in (tmp_path / "index.html").read_text()) == (scenes is not None)
