"""Labelled scenes one by one, as an evaluation takes them: generated, or from a folder at the images' own size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.structures.annotations import Annotations
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
        return self.source.render(index).with_voxels()


@dataclass(frozen=True)
class FolderScenes:
    """Scenes of a data set on disk, its images at their own size."""

    folder: SceneFolder
    count: int
    first: int = 0
    """Number of the scene that comes first."""

    def __len__(self) -> int:
        return min(self.count, len(self.folder) - self.first)

    def __getitem__(self, index: int) -> Annotations:
        row = self.first + index
        labels = self.folder.records[row]
        return replace(labels, voxels=self.folder.voxels(row), pixels=self.folder.image(row))
