"""Labelled scenes one by one, as an evaluation takes them: generated, or from a folder at the images' own size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.evaluation.measure import SceneTruth
from nolbo_ppl.synthetic.scenes.render_scene import Rendered
from nolbo_ppl.synthetic.scenes.scene_source import SceneSource


@runtime_checkable
class Scenes(Protocol):
    """Labelled scenes by number."""

    def __len__(self) -> int:
        """Number of scenes."""

    def __getitem__(self, index: int) -> SceneTruth:
        """Scene of that number."""


@dataclass(frozen=True)
class GeneratedScenes:
    """Scenes rendered when they are asked for."""

    source: SceneSource
    count: int
    categories: tuple[str, ...]
    """The model's categories: what the labels are numbered by."""

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> SceneTruth:
        return truth_of_rendered(self.source.render(index), self.categories)


def truth_of_rendered(rendered: Rendered, categories: Sequence[str]) -> SceneTruth:
    """Labels of a rendered scene as arrays; a category the model does not know is -1."""
    labels, n = rendered.labels, len(rendered.labels)
    return SceneTruth(
        image=rendered.image,
        intrinsics=rendered.intrinsics,
        box=np.array([label.box for label in labels]).reshape(n, 4),
        category=np.array([_label(label.category, categories) for label in labels], dtype=np.int64),
        R_camera_object=np.array([label.R_camera_object for label in labels]).reshape(n, 3, 3),
        position=np.array([label.position for label in labels]).reshape(n, 3),
        symmetry=np.array([label.symmetry for label in labels], dtype=np.int64),
        visibility=np.array([label.visibility for label in labels], dtype=np.float64),
        voxels=np.array([label.item.voxels for label in labels], dtype=np.uint8).reshape(n, -1 if n else 0),
        diagonal=np.array([label.size for label in labels], dtype=np.float64),
        ignore=np.zeros((0, 4)),
    )


def _label(category: str | None, categories: Sequence[str]) -> int:
    return categories.index(category) if category in categories else -1


@dataclass(frozen=True)
class FolderScenes:
    """Scenes of a data set on disk, its images at their own size."""

    folder: SceneFolder
    count: int

    def __len__(self) -> int:
        return min(self.count, len(self.folder))

    def __getitem__(self, index: int) -> SceneTruth:
        record, arrays = self.folder.records[index], self.folder.batch([index])
        objects, n = record.objects, len(record.objects)
        unknown_rotation, unknown_position = np.full((3, 3), np.nan), np.full(3, np.nan)
        return SceneTruth(
            image=self.folder.image(index),
            intrinsics=record.intrinsics,
            box=np.array([thing.box for thing in objects]).reshape(n, 4),
            category=np.array([_label(thing.category, self.folder.categories) for thing in objects], dtype=np.int64),
            R_camera_object=np.array(
                [unknown_rotation if thing.R_camera_object is None else thing.R_camera_object for thing in objects]
            ).reshape(n, 3, 3),
            position=np.array([unknown_position if thing.position is None else thing.position for thing in objects]).reshape(
                n, 3
            ),
            symmetry=np.array([thing.symmetry for thing in objects], dtype=np.int64),
            visibility=np.array([thing.visibility for thing in objects], dtype=np.float64),
            voxels=arrays["voxels"][0, :n],
            diagonal=np.array([np.nan if thing.size is None else thing.size for thing in objects], dtype=np.float64),
            ignore=record.ignore,
        )
