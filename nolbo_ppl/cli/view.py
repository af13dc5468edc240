"""`nolbo view`: a run in 3D in the browser."""

from __future__ import annotations

import sys
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.run_folder import RECORD, read_run
from nolbo_ppl.report.run_follower import RunFollower
from nolbo_ppl.report.viewer import viser_module
from nolbo_ppl.report.viewer_guard import guarded_server


@dataclass(frozen=True)
class ViewerConfig:
    """Show a folder that `nolbo run` or `nolbo slam` wrote in 3D: trajectories, cameras, objects, EM under a slider."""

    run_dir: tyro.conf.Positional[Path]
    """Folder of the run."""
    port: int = 8080
    """Port of the page; the next free one when it is taken."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets other machines in."""
    browser: bool = True
    """Open the page in a browser."""
    odometry: Path | None = None
    """Trajectory before the correction, where the folder has no odometry.txt."""
    truth: Path | None = None
    """True trajectory, where the folder has no truth.txt."""
    images: Path | None = None
    """Folder of the images, where they lie outside of the run's folder; no picture from elsewhere is shown."""
    follow: bool = True
    """Look for new stages of a run that is still going, and show them."""
    poll: float = 2.0
    """How often, s."""


def run(arguments: ViewerConfig, stop: threading.Event | None = None) -> None:
    """Serve the run until `stop` is set, or for ever.

    Raises:
        InputError: no result in the folder, a malformed file, or viser is not installed.
    """
    viser_module()  # a word about it first, where it is not installed
    if not arguments.poll > 0:
        raise input_error("--poll", got=arguments.poll, expected="seconds, more than 0")
    folder, stop = arguments.run_dir, stop or threading.Event()
    going = arguments.follow and (folder / RECORD).is_file()
    read = partial(
        read_run,
        folder,
        odometry=arguments.odometry,
        truth=arguments.truth,
        pictures=arguments.images,
        unfinished=going,
    )
    found = None
    try:
        found = read()
    except InputError:
        if not going or (folder / "slam").exists():  # a run that has a result, and a malformed one
            raise
    server, guard = guarded_server(arguments.host, arguments.port)
    try:
        follower = RunFollower(folder, read, server)
        follower.refresh()
        name = "localhost" if arguments.host in ("0.0.0.0", "127.0.0.1") else arguments.host
        address = f"http://{name}:{server.get_port()}/?token={guard.token}"
        if found is not None and found.images and not any(found.images):
            sys.stdout.write("pictures lie outside of the run's folder and are not shown: --images FOLDER shows them\n")
        sys.stdout.write(f"{address}\nCtrl-C ends it. Who has this address sees the run.\n")
        sys.stdout.flush()
        if arguments.browser:
            webbrowser.open(address)
        while not stop.wait(arguments.poll if arguments.follow else None):
            follower.refresh()
    finally:
        server.stop()


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo view`."""
    arguments = tyro.cli(ViewerConfig, prog="nolbo view", args=args)
    try:
        run(arguments)
    except KeyboardInterrupt:
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
