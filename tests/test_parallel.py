"""Jobs in several processes: order, errors, killed workers, and no orphans."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nolbo_ppl.errors import InputError, NolboError
from nolbo_ppl.io.files import read_json
from nolbo_ppl.parallel import parallel


def test_order_and_errors() -> None:
    jobs = [*((pow, (i, 2)) for i in range(6)), (read_json, ("none.json",))]
    for workers in (1, 2):
        results = parallel(jobs, workers)
        assert [next(results) for _ in range(6)] == [0, 1, 4, 9, 16, 25]
        with pytest.raises(InputError, match=r"none\.json: no such file"):
            next(results)


def test_a_killed_worker_is_said() -> None:
    with pytest.raises(NolboError, match="one of 2 worker processes was killed"):
        list(parallel([(signal.raise_signal, (signal.SIGKILL,))], 2))


def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    """Each worker tells its number by a file; after the parent is killed none of them lives."""
    program = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from nolbo_ppl.parallel import parallel\n"
        "if __name__ == '__main__':\n"
        "    jobs = [(os.system, (f'echo $PPID > {sys.argv[1]}/{i}',)) for i in range(2)] + [(time.sleep, (60,))] * 2\n"
        "    list(parallel(jobs, 2))\n"
    )
    (tmp_path / "program.py").write_text(program)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "program.py"), str(tmp_path)])
    end = time.monotonic() + 60
    while not all((tmp_path / str(i)).is_file() and (tmp_path / str(i)).read_text().strip() for i in range(2)):
        assert time.monotonic() < end
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    workers = {int((tmp_path / str(i)).read_text()) for i in range(2)}
    for worker in workers:
        while Path(f"/proc/{worker}").exists() and "Z" not in Path(f"/proc/{worker}/stat").read_text().rsplit(")", 1)[1][:3]:
            assert time.monotonic() < end, f"worker {worker} of {os.getpid()} is an orphan"
            time.sleep(0.05)
