"""Labelled scenes one by one, as an evaluation takes them: generated, or from a folder at the images' own size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.synthetic.scenes.render_scene import Rendered
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


@runtime_checkable
class Scenes(Protocol):
    """Labelled scenes by number."""

    def __len__(self) -> int:
        """Number of scenes."""

    def __getitem__(self, index: int) -> Annotations:
        """Scene of that number."""


@dataclass(frozen=True)
class GeneratedScenes:
    """Scenes rendered when they are asked for."""

    source: SceneGenerator
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Annotations:
        return annotations_of(self.source.render(index))


def annotations_of(rendered: Rendered) -> Annotations:
    """A rendered scene with its labels, its image and the shapes of its objects."""
    labels, n = rendered.labels, len(rendered.labels)
    return Annotations.from_arrays(
        rendered.intrinsics,
        np.array([label.box for label in labels]).reshape(n, 4),
        category=[label.category for label in labels],
        instance=[label.instance for label in labels],
        R_camera_object=[label.R_camera_object for label in labels],
        position=[label.position for label in labels],
        diagonal=[label.size for label in labels],
        visibility=[label.visibility for label in labels],
        symmetry=[label.symmetry for label in labels],
        voxels=np.array([label.item.voxels for label in labels], dtype=np.uint8).reshape(n, -1 if n else 0),
        pixels=rendered.image,
    )


@dataclass(frozen=True)
class FolderScenes:
    """Scenes of a data set on disk, its images at their own size."""

    folder: SceneFolder
    count: int

    def __len__(self) -> int:
        return min(self.count, len(self.folder))

    def __getitem__(self, index: int) -> Annotations:
        labels = self.folder.records[index]
        return replace(labels, voxels=self.folder.voxels(index), pixels=self.folder.image(index))
