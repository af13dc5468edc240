"""Run jobs in several processes, results in the order of the jobs."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

Job = tuple[Callable[..., Any], tuple[Any, ...]]


def _one_thread() -> None:
    """A worker uses one thread: more only spin beside the other workers."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import torch

    torch.set_num_threads(1)


def parallel(jobs: Iterable[Job], workers: int, ahead: int = 2) -> Iterator[Any]:
    """Yield the result of each job in order; at most `workers * ahead` jobs are under way.

    With one worker or fewer everything runs in this process. Processes are spawned, not forked: a fork of a process
    that holds Torch's thread pool may hang. An exception of a job is raised here; the workers are then stopped, as they
    are when the caller stops iterating.
    """
    if workers <= 1:
        for function, arguments in jobs:
            yield function(*arguments)
        return
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread)
    waiting: list[Future] = []
    try:
        iterator = iter(jobs)
        for function, arguments in iterator:
            waiting.append(executor.submit(function, *arguments))
            if len(waiting) >= workers * ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
