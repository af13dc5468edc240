"""Time and error of the association marginals, against pyehm (EHM2) where it is installed.

    python benchmarks/association.py --out association.json

pyehm (`pip install pyehm`, EPL-2.0) is a peer run beside the library, never a part of it. It is run in both
orientations in a child process with a time limit, on the same inputs in the same run, and the faster one counts.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import multiprocessing
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.inference.association import (
    Associator,
    association_marginals_batch,
    map_association,
    sample_associations,
)
from nolbo_ppl.io.files import write_json

Problem = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Settings:
    """What to run."""

    out: Path
    """JSON file for the results."""
    limit: float = 60.0
    """Seconds after which pyehm is given up, for each problem and orientation."""
    peer: bool = True
    """Run pyehm when it is installed."""
    seed: int = 0
    """Seed of the problems."""


@dataclass(frozen=True)
class Row:
    """One line of the table; times in milliseconds for the whole problem."""

    problem: str
    exact_ms: float
    pyehm_ms: float | None
    """None: not run, or beyond the limit."""
    pyehm_note: str
    """Its faster orientation, or why there is no time."""
    ratio: float | None
    """pyehm's time over ours; a lower bound where pyehm was given up."""
    pyehm_difference: float | None
    """Largest difference of a marginal between the two."""
    errors: dict[str, float]
    """Largest error of a marginal of the other associators against the exact one."""
    milliseconds: dict[str, float]
    """Times of the other associators."""


def dense(rng: np.random.Generator, n: int, m: int) -> Problem:
    """Every detection may be every landmark."""
    return rng.normal(size=(n, m)), np.full(n, 1.0)


def look_alikes(rng: np.random.Generator, n: int, m: int) -> Problem:
    """Groups of five landmarks that no latent tells apart, near one another."""
    group = rng.normal(size=(n, m // 5)) * 6
    return np.repeat(group, 5, axis=1) + 0.3 * rng.normal(size=(n, m)), np.full(n, -8.0)


def drive(rng: np.random.Generator, frames: int) -> list[Problem]:
    """A drive past 40 landmarks along a loop: 1 to 15 detections a frame, 0.5 m noise under 1.5 m of drift."""
    angle = rng.uniform(0, 2 * np.pi, size=40)
    place = np.column_stack([np.cos(angle), np.sin(angle)]) * (30 + rng.normal(size=(40, 1)) * 4)
    problems = []
    for frame in range(frames):
        heading = 2 * np.pi * frame / frames * 3
        here = 30 * np.array([np.cos(heading), np.sin(heading)])
        seen = np.flatnonzero(np.linalg.norm(place - here, axis=1) < 18)[:14]
        seen = seen[rng.random(len(seen)) < 0.9]
        drift = rng.normal(size=2) * 1.5
        found = place[seen] + drift + rng.normal(size=(len(seen), 2)) * 0.5
        found = np.vstack([found, here + rng.uniform(-15, 15, size=(1, 2))])  # clutter
        gap = ((found[:, None] - place[None]) ** 2).sum(axis=-1)
        variance = 0.5**2 + 1.5**2
        problems.append((-0.5 * gap / variance - np.log(2 * np.pi * variance), np.full(len(found), np.log(1 / 900))))
    return problems


def milliseconds(run: Callable[[], object]) -> float:
    """Median over 7 rounds of the time of one call, after one call to compile; a round takes 0.02 s or more."""
    run()
    started = time.perf_counter()
    run()
    once = time.perf_counter() - started
    calls = max(1, int(0.02 / max(once, 1e-6)))
    rounds = []
    for _ in range(7 if once < 2 else 1):
        started = time.perf_counter()
        for _ in range(calls):
            run()
        rounds.append((time.perf_counter() - started) / calls)
    return 1e3 * float(np.median(rounds))


def pyehm_marginals(problem: Problem, rows: str) -> np.ndarray:
    """EHM2's marginals [n, m], its rows being our detections or our landmarks (nulls divided out of the columns).

    It is given the gate a careful user would: odds against the null hypothesis above 1e-12 are valid.
    """
    from pyehm.core import EHM2

    likelihood, null = problem
    odds = np.exp(likelihood - null[:, None])
    matrix = odds if rows == "detections" else odds.T
    matrix = np.ascontiguousarray(np.column_stack([np.ones(len(matrix)), matrix]))
    answer = np.asarray(EHM2().run((matrix > 1e-12).astype(np.int32), matrix))[:, 1:]
    return answer if rows == "detections" else answer.T


def _peer_process(problems: list[Problem], rows: str, pipe: Connection) -> None:
    """In the child: time over all problems in seconds, and the marginals."""
    started = time.perf_counter()
    answers = [pyehm_marginals(problem, rows) for problem in problems]
    seconds = time.perf_counter() - started
    if seconds < 0.5:  # too short to time once
        calls = int(0.5 / max(seconds, 1e-5))
        started = time.perf_counter()
        for _ in range(calls):
            for problem in problems:
                pyehm_marginals(problem, rows)
        seconds = (time.perf_counter() - started) / calls
    pipe.send((seconds, answers))


def run_peer(problems: list[Problem], rows: str, limit: float) -> tuple[float, list[np.ndarray]] | None:
    """Seconds and marginals of pyehm in one orientation, None beyond the limit."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_peer_process, args=(problems, rows, theirs))
    child.start()
    theirs.close()
    try:
        return ours.recv() if ours.poll(limit + 5) else None  # 5 s to start and import
    except EOFError as error:
        raise SystemExit(f"pyehm failed with rows = {rows}: see its message above") from error
    finally:
        child.kill()
        child.join()


def against_peer(problems: list[Problem], exact_ms: float, limit: float) -> tuple[float | None, str, float, float]:
    """pyehm's milliseconds in its faster orientation, a note, the ratio, and the largest difference."""
    runs = {rows: run_peer(problems, rows, limit) for rows in ("detections", "landmarks")}
    done = {rows: run for rows, run in runs.items() if run is not None}
    if not done:
        return None, f"> {limit:.0f} s either way", 1e3 * limit / exact_ms, np.nan
    rows, (seconds, answers) = min(done.items(), key=lambda item: item[1][0])
    exact = association_marginals_batch(problems)
    difference = max(np.abs(a - e.weights).max() for a, e in zip(answers, exact, strict=True))
    return 1e3 * seconds, f"rows = {rows}", 1e3 * seconds / exact_ms, float(difference)


def measure(name: str, problems: list[Problem], settings: Settings, peer: bool, stride: int = 1) -> Row:
    """One line of the table; with a stride, pyehm is compared on every so many frames alone."""
    exact = association_marginals_batch(problems)
    if not all(one.exact for one in exact):
        raise SystemExit(f"{name}: not within the exact budget")
    others: list[Associator] = ["belief_propagation", "softmax", "hungarian"]
    if len(problems) == 1:
        others.append("k_best")
    errors, times = {}, {}
    for associator in others:
        answers = association_marginals_batch(problems, associator=associator)
        errors[associator] = max(float(np.abs(a.weights - e.weights).max()) for a, e in zip(answers, exact))
        times[associator] = milliseconds(lambda a=associator: association_marginals_batch(problems, associator=a))
    if len(problems) == 1:
        likelihood, null = problems[0]
        times["map"] = milliseconds(lambda: map_association(likelihood, null))
        times["100 samples"] = milliseconds(
            lambda: sample_associations(likelihood, null, rng=np.random.default_rng(0), count=100)
        )
    exact_ms = milliseconds(lambda: association_marginals_batch(problems))
    if not peer:
        return Row(name, exact_ms, None, "pyehm not run", None, None, errors, times)
    shared = problems[::stride]
    shared_ms = exact_ms if stride == 1 else milliseconds(lambda: association_marginals_batch(shared))
    pyehm_ms, note, ratio, difference = against_peer(shared, shared_ms, settings.limit)
    if stride > 1:
        note += f", every {stride}th frame"
    return Row(name, exact_ms, pyehm_ms, note, ratio, None if np.isnan(difference) else difference, errors, times)


def show(row: Row) -> None:
    """Print one line and its details."""
    pyehm = "-" if row.pyehm_ms is None else f"{row.pyehm_ms:.3f}"
    ratio = "-" if row.ratio is None else f"{'>' if row.pyehm_ms is None else ''}{row.ratio:.0f}"
    difference = "-" if row.pyehm_difference is None else f"{row.pyehm_difference:.1e}"
    print(f"{row.problem:34} {row.exact_ms:10.3f} {pyehm:>12} {ratio:>8} {difference:>10}  {row.pyehm_note}")
    for name, error in row.errors.items():
        print(f"    {name:30} {row.milliseconds[name]:10.3f} ms, largest error {error:.1e}")
    for name in row.milliseconds.keys() - row.errors.keys():
        print(f"    {name:30} {row.milliseconds[name]:10.3f} ms")


def main(settings: Settings) -> None:
    """Run every problem, print the table, write the JSON."""
    peer = settings.peer and importlib.util.find_spec("pyehm") is not None
    if settings.peer and not peer:
        print("pyehm is not installed: its columns stay empty (pip install pyehm)")
    rng = np.random.default_rng(settings.seed)
    print(f"{'problem (detections x landmarks)':34} {'exact ms':>10} {'pyehm ms':>12} {'ratio':>8} {'difference':>10}")
    rows = []
    for name, problems, stride in [
        ("5x20 dense", [dense(rng, 5, 20)], 1),
        ("8x50 dense", [dense(rng, 8, 50)], 1),
        ("12x100 dense", [dense(rng, 12, 100)], 1),
        ("8x50 look-alikes", [look_alikes(rng, 8, 50)], 1),
        ("2585 frames, at most 15x40", drive(rng, 2585), 10),
    ]:
        rows.append(measure(name, problems, settings, peer, stride))
        show(rows[-1])
    write_json(
        settings.out,
        {
            "rows": [asdict(row) for row in rows],
            "settings": {"limit": settings.limit, "seed": settings.seed},
            "pyehm": importlib.metadata.version("pyehm") if peer else None,
            "python": platform.python_version(),
            "numba": importlib.metadata.version("numba"),
            "processor": platform.machine(),
        },
    )


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
