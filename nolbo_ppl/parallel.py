"""Run jobs in several processes, results in the order of the jobs."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from nolbo_ppl.errors import NolboError

Job = tuple[Callable[..., Any], tuple[Any, ...]]


def _begin_worker() -> None:
    """One thread: more only spin beside the other workers. A worker ends with its parent, and leaves Ctrl-C to it."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if "torch" in sys.modules:  # imported by the caller's own script: later imports go by the environment
        sys.modules["torch"].set_num_threads(1)


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for jobs for ever: every worker holds both ends of their queue."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def parallel(jobs: Iterable[Job], workers: int, ahead: int = 2) -> Iterator[Any]:
    """Yield the result of each job in order; at most `workers * ahead` jobs are under way.

    With one worker or fewer everything runs in this process. Processes are spawned, not forked: a fork of a process
    that holds Torch's thread pool may hang. An exception of a job is raised here; the workers are then stopped, as they
    are when the caller stops iterating.

    Raises:
        NolboError: a worker was killed, by the system where memory ran out.
    """
    if workers <= 1:
        for function, arguments in jobs:
            yield function(*arguments)
        return
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker)
    waiting: list[Future] = []
    try:
        iterator = iter(jobs)
        for function, arguments in iterator:
            waiting.append(executor.submit(function, *arguments))
            if len(waiting) >= workers * ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    except BrokenProcessPool:
        raise NolboError(
            f"one of {workers} worker processes was killed; if memory ran out, use fewer --workers; what is complete stays"
        ) from None
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
