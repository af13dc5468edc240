"""Detectors of others, run on the same photographs in the same run: ONNX files of YOLOX and PicoDet (COCO's 80 categories)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.boxes import nms
from nolbo_ppl.models.evidence import COCO_LABELS

MIN_SCORE = 0.01
"""Least score of a detection."""
OVERLAP = 0.65
"""Boxes of one category that overlap more are one object (both projects' own setting of their COCO figures is 0.6 to 0.65)."""


@dataclass(frozen=True)
class PeerDetections:
    """What a peer finds in one image."""

    box: Float[np.ndarray, "n 4"]
    """[x0, y0, x1, y1], px of the image."""
    score: Float[np.ndarray, " n"]
    label: Float[np.ndarray, " n"]
    """Label among our categories."""


class OnnxPeer:
    """A detector in an ONNX file; YOLOX or PicoDet, told apart by their outputs.

    Args:
        path: the file.
        categories: our categories; COCO's others are left out of the answers.
        threads: threads of the runtime.

    Raises:
        InputError: `onnxruntime` is not installed, or the file is of another kind.
    """

    def __init__(self, path: str | os.PathLike[str], categories: Sequence[str], threads: int = 1) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise input_error("a peer", got="no package `onnxruntime`", do="pip install 'nolbo-ppl[onnx]'") from None
        if not Path(path).is_file():
            raise input_error("a peer", got="no such file", expected="an ONNX file", file=path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = threads, 3
        self._session: Any = onnxruntime.InferenceSession(os.fspath(path), options)
        self.name = Path(path).stem
        self._input = self._session.get_inputs()[0]
        outputs = [tuple(one.shape) for one in self._session.get_outputs()]
        self._side = int(self._input.shape[-1])
        self._labels = np.full(80, -1)
        for label, name in enumerate(categories):
            if name in COCO_LABELS:
                self._labels[COCO_LABELS[name]] = label
        self._yolox = len(outputs) == 1 and outputs[0][-1] == 85
        if not self._yolox and [shape[-1] for shape in outputs] != [80] * 4 + [32] * 4:
            raise input_error("a peer", got=f"outputs of shapes {outputs}", expected="YOLOX's or PicoDet's", file=path)

    def detect(self, image: UInt8[np.ndarray, "h w 3"]) -> PeerDetections:
        """Detections of our categories, suppressed within each category, best first."""
        height, width = image.shape[:2]
        factor = self._side / max(height, width)
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        canvas = np.full((self._side, self._side, 3), 114, dtype=np.float32)
        canvas[: size[1], : size[0]] = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))
        bgr = canvas[..., ::-1]
        if not self._yolox:
            mean, deviation = np.array([103.53, 116.28, 123.675]), np.array([57.375, 57.12, 58.395])
            bgr = (bgr - mean) / deviation
        tensor = np.ascontiguousarray(bgr.transpose(2, 0, 1)[None], dtype=np.float32)
        outputs = self._session.run(None, {self._input.name: tensor})
        box, score = self._decode_yolox(outputs[0][0]) if self._yolox else self._decode_picodet(outputs)
        best = score.argmax(1)
        value, label = score.max(1), self._labels[best]
        kept = np.flatnonzero((value >= MIN_SCORE) & (label >= 0))
        box, value, label = box[kept] / np.array([size[0] / width, size[1] / height] * 2), value[kept], label[kept]
        chosen = nms(torch.as_tensor(box), torch.as_tensor(value), OVERLAP, torch.as_tensor(label)).numpy()
        return PeerDetections(box[chosen], value[chosen], label[chosen])

    def _decode_yolox(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        corner, stride = _grid(self._side, (8, 16, 32))
        centre = (output[:, :2] + corner) * stride
        half = np.exp(output[:, 2:4]) * stride / 2
        return np.concatenate((centre - half, centre + half), 1), output[:, 4:5] * output[:, 5:]

    def _decode_picodet(self, outputs: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        corner, stride = _grid(self._side, (8, 16, 32, 64))
        score, bins = np.concatenate([one[0] for one in outputs[:4]]), np.concatenate([one[0] for one in outputs[4:]])
        logits = bins.reshape(-1, 4, 8)
        weight = np.exp(logits - logits.max(-1, keepdims=True))
        distance = (weight * np.arange(8)).sum(-1) / weight.sum(-1) * stride
        centre = (corner + 0.5) * stride
        return np.concatenate((centre - distance[:, :2], centre + distance[:, 2:]), 1), score


def _grid(side: int, strides: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of every cell of each level, row by row, and its stride."""
    corners, steps = [], []
    for stride in strides:
        cells = -(-side // stride)
        y, x = np.mgrid[:cells, :cells]
        corners.append(np.stack((x, y), -1).reshape(-1, 2))
        steps.append(np.full((cells * cells, 1), stride))
    return np.concatenate(corners).astype(np.float64), np.concatenate(steps).astype(np.float64)
