"""A cache of rendered scenes: memory-mapped shards in a folder, made in parallel, resumed, read in any order.

A shard is a folder that appears by one rename once it is complete: a killed run leaves at most a temporary folder,
which the next run clears. The folder's name is a hash of everything the scenes depend on except how many they are, so
that asking for more scenes later only adds shards.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int, UInt8

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import write_json
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.io.output_folder import locked
from nolbo_ppl.parallel import parallel
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.structures.label_arrays import SLOTS, Arrays, allocentric_viewpoints, assemble, empty_labels, fill_annotations
from nolbo_ppl.synthetic.assets.shape_library import BLOCK, VOXELS
from nolbo_ppl.synthetic.scenes.render_scene import Rendered

VERSION = 2
"""Raised when the same seed gives other scenes than before, so that old caches are not taken for new ones."""


class Source(Protocol):
    """An endless, numbered sequence of scenes (`SceneGenerator`, `nolbo_ppl.synthetic.worlds.world_views.ViewSource`)."""

    @property
    def config(self) -> Sized:
        """What the scenes look like."""

    def render(self, index: int) -> Rendered:
        """Image and labels of the scene of that number."""

    def describe(self) -> dict[str, object]:
        """All that the scenes depend on."""


class Sized(Protocol):
    """Images of one size."""

    @property
    def size(self) -> int:
        """Height and width, px."""


def cache_key(source: Source, slots: int = SLOTS) -> str:
    """Sixteen hexadecimal digits that identify the scenes of a source."""
    text = json.dumps({"version": VERSION, "slots": slots, **source.describe()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _write_shard(source: Source, folder: Path, shard: int, slots: int) -> int:
    """Render one shard of `BLOCK` scenes into `folder/shard-00000`."""
    temporary = folder / f".shard-{shard:05d}.{os.getpid()}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    size = source.config.size
    images = np.lib.format.open_memmap(temporary / "images.npy", "w+", np.uint8, (BLOCK, 3, size, size))
    labels = empty_labels(BLOCK, slots)
    voxels: dict[int, np.ndarray] = {}
    for row in range(BLOCK):
        rendered = source.render(shard * BLOCK + row)
        images[row] = rendered.image.transpose(2, 0, 1)
        fill_annotations(labels, row, rendered.annotations, instance=rendered.numbers)
        for asset in rendered.assets:
            voxels.setdefault(asset.number, asset.voxels)
    images.flush()
    del images
    labels["viewpoint"] = allocentric_viewpoints(labels)
    labels["voxel_instance"] = np.array(sorted(voxels), dtype=np.int64)
    np.savez(temporary / "labels.npz", **labels)  # type: ignore[arg-type]
    rows = [voxels[number] for number in sorted(voxels)]
    np.save(temporary / "voxels.npy", np.array(rows, dtype=np.uint8).reshape(len(rows), VOXELS**3 // 8))
    final = folder / f"shard-{shard:05d}"
    if final.exists():  # another process was faster: its shard is the same
        shutil.rmtree(temporary)
    else:
        os.replace(temporary, final)
    return BLOCK


def write_cache(cache: str | os.PathLike[str], source: Source, count: int, workers: int = 1, slots: int = SLOTS) -> CachedScenes:
    """Render what is missing of the first `count` scenes (whole shards of 1024) into a cache and open it.

    Args:
        cache: folder that holds caches; this one is the sub-folder named by `cache_key`.
        source: the scenes.
        count: number of scenes wanted.
        workers: processes; the result does not depend on it.
        slots: object slots an image.

    Raises:
        InputError: `count` is not positive.
    """
    if count < 1:
        raise input_error("number of cached scenes", got=count, expected="at least 1")
    folder = Path(cache) / cache_key(source, slots)
    folder.mkdir(parents=True, exist_ok=True)
    shards = -(-count // BLOCK)
    missing = [shard for shard in range(shards) if not (folder / f"shard-{shard:05d}").is_dir()]
    if missing:
        with locked(folder, wait=True):  # another run may render the same scenes: what it has made is not made again
            for leftover in folder.glob(".shard-*.tmp"):
                shutil.rmtree(leftover, ignore_errors=True)
            write_json(folder / "source.json", {"version": VERSION, "slots": slots, **source.describe()})
            missing = [shard for shard in missing if not (folder / f"shard-{shard:05d}").is_dir()]
            jobs = [(_write_shard, (source, folder, shard, slots)) for shard in missing]
            with progress_bar(None, "rendering scenes", "scene", total=len(missing) * BLOCK) as bar:
                for done in parallel(jobs, workers):
                    bar.update(done)
    return CachedScenes(folder, count)


def _mapped(path: Path) -> np.ndarray:
    """An array that stays on the disk. Raises `InputError` for a damaged file."""
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy raises whatever damaged bytes make it run into
        raise input_error("damaged cache", got=error, do=f"delete {path.parent}", file=path) from None


class CachedScenes:
    """Scenes of a cache as a sequence; `batch` gathers any of them.

    Attributes:
        count: number of scenes.
        size: height and width of the images.
        categories: names the category numbers stand for.
    """

    def __init__(self, folder: str | os.PathLike[str], count: int | None = None) -> None:
        self.folder = Path(folder)
        shards = sorted(self.folder.glob("shard-*"))
        available = len(shards) * BLOCK
        count = available if count is None else count
        if not shards or count > available or count < 1:
            raise input_error(
                "not enough scenes in the cache",
                got=f"{available} scenes in {self.folder}",
                expected=count,
                do="call write_cache to render the missing ones",
            )
        self.count = count
        self.categories = CATEGORIES
        shards = shards[: -(-count // BLOCK)]
        self._images = [_mapped(shard / "images.npy") for shard in shards]
        self._voxels = [_mapped(shard / "voxels.npy") for shard in shards]
        self._voxel_row: list[np.ndarray] = []
        parts: list[Arrays] = []
        for shard in shards:
            with Npz(shard / "labels.npz") as stored:
                labels = {name: stored.array(name, kinds="fiub", finite=False) for name in stored.names}
            self._voxel_row.append(np.searchsorted(labels.pop("voxel_instance"), labels["instance"].clip(0)))
            parts.append(labels)
        self.labels: Arrays = {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}
        self.size = int(self._images[0].shape[-1])

    def __len__(self) -> int:
        return self.count

    def batch(self, indices: Sequence[int] | Int[np.ndarray, " b"]) -> Arrays:
        """The scenes of these numbers, in the layout of `nolbo_ppl.models.scene_batch.SceneBatch`, as NumPy arrays.

        Raises:
            InputError: a number outside [0, count).
        """
        index = np.asarray(indices, dtype=np.int64)
        if index.size and (index.min() < 0 or index.max() >= self.count):
            raise input_error("no such scene in the cache", got=index.tolist(), expected=f"0 to {self.count - 1}")
        images = np.stack([self._images[i // BLOCK][i % BLOCK] for i in index])
        labels = {name: array[index] for name, array in self.labels.items()}
        present = labels["present"]
        voxels = np.zeros((*present.shape, VOXELS**3 // 8), dtype=np.uint8)
        for row, slot in zip(*np.nonzero(present)):
            shard, within = divmod(int(index[row]), BLOCK)
            voxels[row, slot] = self._voxels[shard][self._voxel_row[shard][within, slot]]
        return assemble(images, labels, voxels, present.copy())

    def shapes(self) -> tuple[Int[np.ndarray, " n"], UInt8[np.ndarray, "n bytes"], Int[np.ndarray, " n"]]:
        """Number, packed voxels and category of every shape that occurs, each once, in the order of the numbers."""
        number = self.labels["instance"][self.labels["present"]]
        category = self.labels["category"][self.labels["present"]]
        number, first = np.unique(number, return_index=True)
        scene, slot = np.nonzero(self.labels["present"])
        packed = np.empty((len(number), VOXELS**3 // 8), dtype=np.uint8)
        for row, position in enumerate(first):
            shard, within = divmod(int(scene[position]), BLOCK)
            packed[row] = self._voxels[shard][self._voxel_row[shard][within, slot[position]]]
        return number, packed, category[first]
