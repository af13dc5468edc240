"""A headless chromium under test: pages are loaded, used and photographed, and their script errors collected."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")


def chromium() -> str:
    """The browser; skips the test when there is none."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser on PATH (one of {', '.join(NAMES)}): apt-get install chromium")
    return found


PATIENCE = 180.0
"""Seconds to wait for an answer: machines that test are busy."""


class Browser:
    """One page, spoken to by the DevTools protocol."""

    def __init__(self, folder: Path, width: int = 1240, height: int = 900) -> None:
        client = pytest.importorskip("websockets.sync.client", reason="websockets (with viser) speaks to the browser")
        self.process = subprocess.Popen(
            [
                chromium(),
                "--headless",
                "--no-sandbox",
                "--disable-dev-shm-usage",
                "--hide-scrollbars",
                "--no-first-run",
                "--remote-debugging-port=0",
                "--enable-unsafe-swiftshader",
                "--use-gl=angle",
                "--use-angle=swiftshader",
                f"--user-data-dir={folder}",
                f"--window-size={width},{height}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            address = self._page_address(folder / "DevToolsActivePort")
            # Without keep-alive: a busy page is no dead one.
            self.socket = client.connect(address, max_size=None, open_timeout=PATIENCE, ping_interval=None)
        except BaseException:
            self.close()
            raise
        self.count, self.errors, self.requests, self.loaded = 0, [], [], False
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def _page_address(self, port_file: Path, seconds: float = PATIENCE) -> str:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if port_file.is_file() and (lines := port_file.read_text().splitlines()):
                with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json/list", timeout=30) as answer:
                    pages = [target for target in json.load(answer) if target["type"] == "page"]
                if pages:
                    return pages[0]["webSocketDebuggerUrl"]
            assert self.process.poll() is None, "the browser has ended"
            time.sleep(0.1)
        raise TimeoutError("the browser did not start")

    def _take(self, timeout: float) -> dict[str, Any]:
        message = json.loads(self.socket.recv(timeout=timeout))
        values = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                details = values["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description") or details["text"])
            case "Runtime.consoleAPICalled" if values["type"] in ("error", "assert"):
                self.errors.append(" ".join(str(x.get("value", x.get("description"))) for x in values["args"]))
            case "Log.entryAdded" if values["entry"]["level"] == "error":
                self.errors.append(values["entry"]["text"] + " " + values["entry"].get("url", ""))
            case "Network.requestWillBeSent":
                self.requests.append(values["request"]["url"])
            case "Page.loadEventFired":
                self.loaded = True
        return message

    def call(self, method: str, **values: Any) -> dict[str, Any]:
        """Ask the browser and wait for the answer."""
        self.count += 1
        number = self.count
        self.socket.send(json.dumps({"id": number, "method": method, "params": values}))
        while (message := self._take(PATIENCE)).get("id") != number:
            pass
        assert "error" not in message, message
        return message["result"]

    def open(self, url: str) -> None:
        """Load a page; errors and requests of earlier ones are forgotten."""
        self.errors.clear()
        self.requests.clear()
        self.loaded = False
        self.call("Page.navigate", url=url)
        while not self.loaded:
            self._take(PATIENCE)

    def run(self, script: str) -> Any:
        """Value of an expression on the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)["result"].get("value")

    def until(self, script: str, seconds: float = PATIENCE) -> None:
        """Wait for an expression to be true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < end, f"never true: {script}; errors: {self.errors}"
            time.sleep(0.2)

    def photograph(self, path: Path, whole: bool = False) -> None:
        """A PNG of what is seen, or of the whole page."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"]))

    def close(self) -> None:
        """End the browser."""
        if hasattr(self, "socket"):
            self.socket.close()
        self.process.terminate()
        try:
            self.process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
