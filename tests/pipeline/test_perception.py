"""Images of a sequence, read and observed so many at once as memory bears."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.pipeline import perception
from nolbo_ppl.pipeline.perception import observe_images


def test_large_images_are_observed_fewer_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perception, "PIXELS_AT_ONCE", 100)
    sides = [5, 5, 8, 8, 20, 3, 3, 3, 3, 3]
    asked: list[list[int]] = []

    def observe(images: list) -> list:
        asked.append([len(image) for image in images])
        return [f"{len(image)} px" for image in images]

    found = list(observe_images(observe, lambda k: np.zeros((sides[k], sides[k], 3), np.uint8), len(sides), 4))
    assert [(k, len(image), answer) for k, image, answer in found] == [(k, n, f"{n} px") for k, n in enumerate(sides)]
    # 25 + 25 + 64 pixels are enough, one of 400 is more than that, four small ones are a batch
    assert asked == [[5, 5, 8], [8, 20], [3, 3, 3, 3], [3]]
    assert not list(observe_images(observe, lambda k: np.zeros((9, 9, 3), np.uint8), 0, 4))
