"""Batches for training: from a cache in a shuffled order, or streamed fresh; both exact functions of (seed, step)."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from itertools import count
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.parallel import parallel
from nolbo_ppl.structures.label_arrays import SLOTS, Arrays, allocentric_viewpoints, assemble, empty_labels, fill_annotations
from nolbo_ppl.synthetic.assets.shape_library import VOXELS
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

T = TypeVar("T")


class BatchedScenes(Protocol):
    """Scenes that can be gathered by number: `CachedScenes`, `SceneFolder`."""

    def __len__(self) -> int:
        """Number of scenes."""

    def batch(self, indices: Int[np.ndarray, " b"]) -> Arrays:
        """The scenes of these numbers."""


def batch_indices(total: int, batch_size: int, seed: int, step: int) -> Int[np.ndarray, " {batch_size}"]:
    """Numbers of the scenes of one training step: every epoch is a new permutation, and batches run over its end.

    Raises:
        InputError: no scenes, or an empty batch.
    """
    if total < 1 or batch_size < 1 or step < 0:
        raise input_error(
            "no batch of scenes",
            got=f"{total} scenes, batch size {batch_size}, step {step}",
            expected="at least one scene, a batch of at least one, a step of at least 0",
        )
    first = step * batch_size
    position = np.arange(first, first + batch_size)
    epoch, within = position // total, position % total
    result = np.empty(batch_size, dtype=np.int64)
    for e in np.unique(epoch):
        order = np.random.default_rng([seed, int(e)]).permutation(total)
        result[epoch == e] = order[within[epoch == e]]
    return result


def shuffled_batches(scenes: BatchedScenes, batch_size: int, seed: int, start: int = 0) -> Iterator[Arrays]:
    """Endless shuffled batches from step `start` on; step s is the same whatever `start` was."""
    total = len(scenes)
    for step in count(start):
        yield scenes.batch(batch_indices(total, batch_size, seed, step))


def render_batch(source: SceneGenerator, first: int, size: int, slots: int = SLOTS) -> Arrays:
    """Render scenes `first` to `first + size` into one batch."""
    images = np.empty((size, 3, source.config.size, source.config.size), dtype=np.uint8)
    labels = empty_labels(size, slots)
    voxels = np.zeros((size, slots, VOXELS**3 // 8), dtype=np.uint8)
    for row in range(size):
        rendered = source.render(first + row)
        images[row] = rendered.image.transpose(2, 0, 1)
        fill_annotations(labels, row, rendered.annotations, instance=rendered.numbers)
        for slot, asset in enumerate(rendered.assets):
            voxels[row, slot] = asset.voxels
    labels["viewpoint"] = allocentric_viewpoints(labels)
    return assemble(images, labels, voxels, labels["present"].copy())


def streamed_batches(
    source: SceneGenerator, batch_size: int, workers: int = 1, start: int = 0, slots: int = SLOTS
) -> Iterator[Arrays]:
    """Endless fresh batches from step `start` on: step s holds scenes s * batch_size onwards, never seen before.

    The order and the contents do not depend on `workers` or `start`. Close the iterator to stop its processes.
    """
    jobs = ((render_batch, (source, step * batch_size, batch_size, slots)) for step in count(start))
    yield from parallel(jobs, workers, ahead=3)


class prefetch(Iterator[T]):
    """Run an iterator on a thread, up to `depth` results ahead.

    An exception of the iterator is raised where its result would have been. `close` (or leaving the `with` block) stops
    the thread and closes the iterator.
    """

    _END = object()

    def __init__(self, iterator: Iterable[T], depth: int = 2) -> None:
        self._queue: queue.Queue = queue.Queue(maxsize=depth)
        self._stopped = threading.Event()
        self._iterator = iter(iterator)
        self._thread = threading.Thread(target=self._run, name="prefetch", daemon=True)
        self._thread.start()

    def _put(self, item: object) -> bool:
        while not self._stopped.is_set():
            try:
                self._queue.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def _run(self) -> None:
        try:
            for item in self._iterator:
                if not self._put((item, None)):
                    break
            else:
                self._put((self._END, None))
        except BaseException as error:  # handed to the consumer
            self._put((None, error))
        finally:
            close = getattr(self._iterator, "close", None)
            if close is not None:
                close()

    def __iter__(self) -> prefetch[T]:
        return self

    def __next__(self) -> T:
        if self._stopped.is_set():
            raise StopIteration
        item, error = self._queue.get()
        if error is not None:
            self.close()
            raise error
        if item is self._END:
            self.close()
            raise StopIteration
        return item

    def close(self) -> None:
        """Stop the thread and wait for it."""
        self._stopped.set()
        self._thread.join()

    def __enter__(self) -> prefetch[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
