"""Folders that results are written into: one process at a time, complete or not at all, nothing of anybody else's replaced.

A folder is locked by a file in it that names process and host; the lock of the system ends with the process, whatever ends
it. Results are written into a hidden folder beside the old ones and take their place in one step: the hidden folder gets the
name that says "complete" by one rename, then its files are moved. A process killed between the two leaves a move that the
next one ends.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.files import TEMPORARY, read_json, to_the_end, write_json

LOCK = ".nolbo-lock"
"""The file whose lock a process holds while it writes into the folder."""
NEW = ".nolbo-new"
"""Where results grow."""
COMPLETE = ".nolbo-complete"
"""What NEW is called from the moment it is complete until its files are moved."""
OWN = ".own.json"
"""In both: names of all files that belong to such a result."""


def contents(folder: str | os.PathLike[str]) -> list[str]:
    """Names in a folder, sorted, without locks and what killed processes left; empty where there is no folder.

    Raises:
        InputError: it is a file.
    """
    folder = Path(folder)
    if not folder.exists():
        return []
    if not folder.is_dir():
        raise input_error("the output is a file", expected="a folder, or nothing yet", do="choose another --out", file=folder)
    return sorted(name for name in os.listdir(folder) if name not in (LOCK, NEW, COMPLETE) and not TEMPORARY.fullmatch(name))


def sweep(folder: Path) -> None:
    """Delete what killed processes left in a folder and the folders in it; the caller holds its lock."""
    shutil.rmtree(folder / NEW, ignore_errors=True)
    for place in (folder, *(entry for entry in folder.iterdir() if entry.is_dir() and not entry.is_symlink())):
        for entry in place.iterdir():
            if TEMPORARY.fullmatch(entry.name):
                _remove(entry)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def locked(folder: str | os.PathLike[str], *, wait: bool = False) -> Iterator[None]:
    """Hold a folder for this process; it is made where it is missing, and goes again if it stays empty.

    Args:
        folder: the folder.
        wait: wait for another process in place of raising.

    Raises:
        InputError: another process holds it (names process and host), or it is a file.
        OSError: it cannot be made or written into.
    """
    folder = Path(folder)
    contents(folder)
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = None
    try:
        descriptor = _acquire(folder, wait)
        yield
    finally:
        if descriptor is not None:
            try:
                to_the_end(lambda: (folder / LOCK).unlink(missing_ok=True))
            finally:
                os.close(descriptor)
        to_the_end(lambda: _remove_empty(made))


def _remove_empty(folders: list[Path]) -> None:
    """Delete folders, the innermost first, as long as they are empty."""
    with suppress(OSError):
        for folder in filter(Path.exists, folders):
            folder.rmdir()


def _acquire(folder: Path, wait: bool) -> int:
    import fcntl

    path = folder / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                raise _in_use(folder, _holder(descriptor), "wait for it, or choose another --out") from None
            holder = _holder(descriptor)
            if holder.get("host") not in (None, socket.gethostname()):  # locks may not reach other machines
                raise _in_use(folder, holder, f"if that process has ended, delete {LOCK} in it")
            if os.path.exists(path) and os.path.samestat(os.fstat(descriptor), os.stat(path)):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps({"process": os.getpid(), "host": socket.gethostname()}).encode(), 0)
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its last holder has deleted the file meanwhile: what was locked has no name any more


def _holder(descriptor: int) -> dict[str, Any]:
    """What the lock says; nothing where its writer was killed in between."""
    try:
        found = json.loads(os.pread(descriptor, 1000, 0))
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _in_use(folder: Path, holder: dict[str, Any], do: str) -> InputError:
    who = f"process {holder.get('process', 'unknown')} on {holder.get('host', 'this machine')}"
    return input_error("another process writes into the folder", got=who, do=do, file=folder)


@contextmanager
def output_folder(
    out: str | os.PathLike[str],
    own: Collection[str],
    *,
    is_own: Callable[[Path], bool],
    inputs: Collection[str | os.PathLike[str] | None] = (),
) -> Iterator[Path]:
    """Yield an empty folder; what is in it at the end of the block takes its place in `out` at once.

    Everything is checked before the block begins: that `out` can be written, that nobody else writes there, and that nothing
    is replaced but an older result of the same kind. A block that raises changes nothing.

    Args:
        out: where the results go, made when missing; what else it holds stays.
        own: names of all files and folders that such a result may have; those that the new one lacks go.
        is_own: whether the folder holds an older result of the same kind.
        inputs: files that the results are made from; None is passed over.

    Raises:
        InputError: `out` holds one of the inputs, or something else, under a name of the result, or is in use.
        OSError: it cannot be written.

    Example:
        >>> import tempfile, pathlib
        >>> out = pathlib.Path(tempfile.mkdtemp()) / "result"
        >>> with output_folder(out, ("a.txt",), is_own=lambda folder: False) as folder:
        ...     _ = (folder / "a.txt").write_text("done")
        ...     (out / "a.txt").exists()
        False
        >>> (out / "a.txt").read_text()
        'done'
    """
    out = Path(out)
    contents(out)
    for given in inputs:
        if given is not None:
            _refuse_input(Path(given), out, own)
    with locked(out):
        finish(out)
        sweep(out)
        taken = [name for name in own if (out / name).exists()]
        if taken and not is_own(out):
            raise input_error(
                "the folder holds something else",
                got=", ".join(taken[:3]),
                expected="a folder with an older result, or without files of these names",
                do="choose another --out",
                file=out,
            )
        new = out / NEW
        new.mkdir()
        try:
            yield new
            write_json(new / OWN, sorted(own))
            to_the_end(lambda: _put_in_place(new, out))
        finally:
            to_the_end(lambda: shutil.rmtree(new, ignore_errors=True))


def _put_in_place(new: Path, out: Path) -> None:
    """The complete folder takes the place of the old result; nothing where it did so before."""
    if new.is_dir():
        os.replace(new, out / COMPLETE)
    finish(out)


def _refuse_input(given: Path, out: Path, own: Collection[str]) -> None:
    for name in own:
        place = (out / name).resolve()
        if given.resolve() == place or place in given.resolve().parents:
            raise input_error("the result would replace an input", got=f"--out {out}", do="choose another --out", file=given)


def settle(folder: str | os.PathLike[str]) -> None:
    """Before a folder is read: wait for a move of results that is under way, end one that a killed process began.

    Raises:
        OSError: there is such a move, and the folder cannot be written.
    """
    if (Path(folder) / COMPLETE).is_dir():
        with locked(folder, wait=True):
            finish(folder)


def finish(out: str | os.PathLike[str]) -> None:
    """End the move of a complete result that a killed process began; nothing where there is none."""
    out = Path(out)
    complete = out / COMPLETE
    if not complete.is_dir():
        return
    if (complete / OWN).is_file():
        found = read_json(complete / OWN)
        names = {entry.name for entry in complete.iterdir()}
        # A file that was moved already is not in the folder any more: only before the first move can old ones be told.
        for name in found if isinstance(found, list) else ():
            if name not in names and isinstance(name, str) and Path(name).name == name:
                _remove(out / name)
        (complete / OWN).unlink()
    for entry in sorted(complete.iterdir()):
        if (out / entry.name).is_dir():
            _remove(out / entry.name)
        os.replace(entry, out / entry.name)
    complete.rmdir()
