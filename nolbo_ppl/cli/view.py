"""`nolbo view`: a run in 3D in the browser."""

from __future__ import annotations

import sys
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from nolbo_ppl.io.run_folder import read_run
from nolbo_ppl.report.viewer import build_viewer, viser_module
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


def run(arguments: ViewerConfig, stop: threading.Event | None = None) -> None:
    """Serve the run until `stop` is set, or for ever.

    Raises:
        InputError: no result in the folder, a malformed file, or viser is not installed.
    """
    viser_module()  # a word about it first, where it is not installed
    found = read_run(arguments.run_dir, odometry=arguments.odometry, truth=arguments.truth, pictures=arguments.images)
    server, guard = guarded_server(arguments.host, arguments.port)
    try:
        build_viewer(found, server)
        name = "localhost" if arguments.host in ("0.0.0.0", "127.0.0.1") else arguments.host
        address = f"http://{name}:{server.get_port()}/?token={guard.token}"
        if found.images and not any(found.images):
            sys.stdout.write("pictures lie outside of the run's folder and are not shown: --images FOLDER shows them\n")
        sys.stdout.write(f"{address}\nCtrl-C ends it. Who has this address sees the run.\n")
        sys.stdout.flush()
        if arguments.browser:
            webbrowser.open(address)
        (stop or threading.Event()).wait()
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
