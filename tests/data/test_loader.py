"""Caches, shuffled and streamed batches, prefetching: exact functions of (seed, step), resumed exactly."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data import scene_cache as cache
from nolbo_ppl.data.loader import batch_indices, prefetch, render_batch, shuffled_batches, streamed_batches
from nolbo_ppl.data.scene_cache import CachedScenes, cache_key, write_cache
from nolbo_ppl.errors import InputError
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.parallel import parallel
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.label_arrays import Arrays
from nolbo_ppl.synthetic.scenes.scene_config import easy, standard
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.scene_loader import ConcatScenes, to_batch

FIELDS = {
    "image",
    "intrinsics",
    "present",
    "box",
    "category",
    "instance",
    "viewpoint",
    "has_viewpoint",
    "symmetry",
    "position",
    "has_position",
    "diagonal",
    "has_size",
    "voxels",
    "has_voxels",
    "visibility",
}


@pytest.fixture(scope="module")
def source() -> SceneGenerator:
    return SceneGenerator(standard(32), seed=5, instances=2)


@pytest.fixture(scope="module")
def cached(source: SceneGenerator, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CachedScenes]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "BLOCK", 8)
        yield write_cache(tmp_path_factory.mktemp("cache"), source, 20)


def assert_equal(a: Arrays, b: Arrays) -> None:
    assert a.keys() == b.keys() == FIELDS
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_cached_scenes_are_the_rendered_ones(source: SceneGenerator, cached: CachedScenes) -> None:
    direct = render_batch(source, 0, 20)
    assert direct["present"].sum() > 20
    assert_equal(cached.batch(range(20)), direct)
    some = [17, 3, 3, 8]
    assert_equal(cached.batch(some), {name: array[some] for name, array in direct.items()})
    assert len(cached) == 20 and cached.size == 32
    with pytest.raises(InputError, match=r"no such scene in the cache: got \[20\], expected 0 to 19"):
        cached.batch([20])


def test_joined_caches_are_one_data_set(cached: CachedScenes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of both in any order, shapes of both once; the pool of shapes is the same."""
    monkeypatch.setattr(cache, "BLOCK", 8)
    other = write_cache(tmp_path, SceneGenerator(easy(32), seed=5, instances=2), 8)
    joined = ConcatScenes([cached, other])
    assert len(joined) == 28
    index = np.array([3, 25, 19, 20, 0, 27])
    batch = joined.batch(index)
    for row, number in enumerate(index):
        single = cached.batch([number]) if number < 20 else other.batch([number - 20])
        for name, array in single.items():
            np.testing.assert_array_equal(batch[name][row], array[0], err_msg=name)
    number, packed, category = joined.shapes()
    assert (np.diff(number) > 0).all()
    assert set(number) == set(cached.shapes()[0]) | set(other.shapes()[0])
    for part in (cached, other):
        for n, voxels, label in zip(*part.shapes()):
            row = int(np.searchsorted(number, n))
            np.testing.assert_array_equal(packed[row], voxels)
            assert category[row] == label


def test_shapes_of_a_cache(source: SceneGenerator, cached: CachedScenes) -> None:
    number, packed, category = cached.shapes()
    assert (np.diff(number) > 0).all()
    for n, bits, c in zip(number, packed, category):
        item = source.pool.asset_of(int(n))
        np.testing.assert_array_equal(bits, item.voxels)
        assert cached.categories[c] == item.shape.category


def test_cache_is_resumed_and_extended(source: SceneGenerator, cached: CachedScenes, monkeypatch: pytest.MonkeyPatch) -> None:
    root = cached.folder.parent
    render = SceneGenerator.render
    drawn: list[int] = []

    def dying(self: SceneGenerator, index: int):
        drawn.append(index)
        if len(drawn) == 12:
            raise KeyboardInterrupt
        return render(self, index)

    with monkeypatch.context() as patch:
        patch.setattr(SceneGenerator, "render", dying)
        with pytest.raises(KeyboardInterrupt):
            write_cache(root, source, 40)
    assert drawn == list(range(24, 36))  # three shards of eight were there
    assert len(list(cached.folder.glob(".shard-*.tmp"))) == 1
    drawn.clear()
    with monkeypatch.context() as patch:
        patch.setattr(SceneGenerator, "render", lambda self, index: drawn.append(index) or render(self, index))
        longer = write_cache(root, source, 40)
        assert drawn == list(range(32, 40))  # the shard finished before the kill is kept
        write_cache(root, source, 40)
        assert len(drawn) == 8
    assert not list(cached.folder.glob(".shard-*.tmp"))
    assert_equal(longer.batch(range(20)), cached.batch(range(20)))
    assert_equal(longer.batch([33]), render_batch(source, 33, 1))


def test_cache_key_tells_scenes_apart(source: SceneGenerator, tmp_path: Path) -> None:
    keys = {
        cache_key(source),
        cache_key(source, slots=6),
        cache_key(SceneGenerator(easy(32), seed=5, instances=2)),
        cache_key(SceneGenerator(standard(32), seed=6, instances=2)),
        cache_key(SceneGenerator(standard(32), seed=5, instances=3)),
        cache_key(SceneGenerator(standard(64), seed=5, instances=2)),
    }
    assert len(keys) == 6
    assert cache_key(SceneGenerator(standard(32), seed=5, instances=2)) == cache_key(source)
    with pytest.raises(InputError, match="number of cached scenes: got 0"):
        write_cache(tmp_path, source, 0)
    with pytest.raises(InputError, match="not enough scenes in the cache: got 0 scenes"):
        CachedScenes(tmp_path)


def test_batches_are_permutations_that_resume() -> None:
    order = np.concatenate([batch_indices(10, 4, 3, step) for step in range(10)])
    for epoch in range(4):
        assert sorted(order[10 * epoch : 10 * epoch + 10]) == list(range(10))
    assert not np.array_equal(order[:10], order[10:20])
    assert not np.array_equal(order[:10], np.concatenate([batch_indices(10, 4, 4, step) for step in range(3)])[:10])
    assert sorted(batch_indices(3, 7, 0, 0)[:6]) == [0, 0, 1, 1, 2, 2]  # a batch larger than the data set
    for bad in ((0, 4, 0, 0), (10, 0, 0, 0), (10, 4, 0, -1)):
        with pytest.raises(InputError, match="no batch of scenes"):
            batch_indices(*bad)


def test_shuffled_batches_resume(cached: CachedScenes) -> None:
    whole = list(islice(shuffled_batches(cached, 6, seed=1), 5))
    rest = list(islice(shuffled_batches(cached, 6, seed=1, start=3), 2))
    for a, b in zip(whole[3:], rest):
        assert_equal(a, b)


def test_streamed_batches_resume(source: SceneGenerator) -> None:
    whole = list(islice(streamed_batches(source, 3), 4))
    assert_equal(whole[2], render_batch(source, 6, 3))
    for a, b in zip(whole[2:], islice(streamed_batches(source, 3, start=2), 2)):
        assert_equal(a, b)


@pytest.mark.slow
def test_streaming_does_not_depend_on_the_number_of_workers(source: SceneGenerator) -> None:
    stream = streamed_batches(source, 2, workers=2)
    for step, batch in zip(range(5), stream):
        assert_equal(batch, render_batch(source, 2 * step, 2))
    stream.close()


def test_parallel_runs_in_order_and_raises() -> None:
    assert list(parallel([(pow, (2, k)) for k in range(6)], workers=1)) == [1, 2, 4, 8, 16, 32]
    with pytest.raises(ZeroDivisionError):
        list(parallel([(divmod, (1, 0))], workers=1))


def test_prefetch_keeps_order_and_ends() -> None:
    with prefetch(iter(range(20)), depth=3) as ahead:
        assert list(ahead) == list(range(20))
        assert list(ahead) == []
    assert all(thread.name != "prefetch" for thread in threading.enumerate())


def test_prefetch_hands_over_exceptions_and_stops() -> None:
    closed = threading.Event()

    def broken() -> Iterator[int]:
        try:
            yield 1
            raise ValueError("from the thread")
        finally:
            closed.set()

    ahead = prefetch(broken())
    assert next(ahead) == 1
    with pytest.raises(ValueError, match="from the thread"):
        next(ahead)
    with pytest.raises(StopIteration):
        next(ahead)
    assert closed.is_set()

    closed.clear()

    def endless() -> Iterator[int]:
        try:
            while True:
                yield 0
        finally:
            closed.set()

    with prefetch(endless(), depth=1) as ahead:
        assert next(ahead) == 0
    assert closed.is_set()
    assert all(thread.name != "prefetch" for thread in threading.enumerate())


def test_labelled_images_make_the_batch_that_the_loader_makes(source: SceneGenerator) -> None:
    """The library's own scenes as annotations, one by one, are the network's batch of the loader."""
    expected = to_batch(render_batch(source, 3, 4, slots=8))
    rendered = [source.render(k) for k in range(3, 7)]
    numbers = {asset.shape.instance: asset.number for one in rendered for asset in one.assets}
    scenes = [one.with_voxels() for one in rendered]
    batch = SceneBatch.from_annotations(scenes, slots=8, instances=numbers)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(batch, name), getattr(expected, name), err_msg=name)
    fewest = SceneBatch.from_annotations(scenes)
    assert fewest.present.shape[1] == max(map(len, scenes)) and (fewest.instance == -1).all()


def test_what_is_not_labelled_reaches_the_batch() -> None:
    image = np.zeros((16, 16, 3), np.uint8)
    one = Annotations.from_arrays([9, 9, 8, 8], [[1, 2, 5, 6]], category=["tram"], ignore=[[0, 0, 3, 3]], pixels=image)
    two = Annotations.from_arrays([9, 9, 8, 8], [], exhaustive=["car"], pixels=image)
    batch = SceneBatch.from_annotations([one, two], ("bus", "car"))
    assert batch.ignore is not None and batch.exhaustive is not None
    assert batch.ignore[:, 0].tolist() == [[0, 0, 3, 3], [0, 0, 0, 0]]
    assert batch.exhaustive.tolist() == [[True, True], [False, True]]
    assert batch.category.tolist() == [[-1], [-1]] and batch.present.tolist() == [[True], [False]]
    assert not (batch.has_viewpoint | batch.has_position | batch.has_size | batch.has_voxels).any()
    with pytest.raises(InputError, match="images of one batch"):
        SceneBatch.from_annotations([one, Annotations.from_arrays([9, 9, 8, 8], [], pixels=image[:8])])
    with pytest.raises(InputError, match="images of one batch"):
        SceneBatch.from_annotations([])
    with pytest.raises(InputError, match="more objects than slots"):
        SceneBatch.from_annotations([Annotations.from_arrays([9, 9, 8, 8], np.ones((2, 4)), pixels=image)], slots=1)
