"""A headless Chromium, driven by chromedriver's protocol (W3C WebDriver), as far as tests of pages need."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# No network, no services of Google's, and WebGL by software.
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
_PATIENCE = 120.0
"""Of a page that draws by software on a busy machine [s]."""


def programs() -> tuple[str, str] | None:
    """Chromium and its driver; None where one is missing."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next((path for name in names if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    return None if browser is None or driver is None else (browser, driver)


class Browser:
    """One window."""

    def __init__(self, address: str) -> None:
        self._address = address

    def call(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """What the driver answers to a command; a POST if there is a body."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self._address}{path}", data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from error

    def open(self, page: Path) -> None:
        """Load a file, and wait until its script has drawn everything."""
        self.call("/url", {"url": page.resolve().as_uri()})
        end = time.monotonic() + _PATIENCE
        while self.run("return document.body.dataset.ready") != "true":
            if time.monotonic() > end:
                raise TimeoutError(f"{page} was not ready: {self.complaints()}")
            time.sleep(0.1)

    def run(self, script: str, *arguments: Any) -> Any:
        """The value that a function with this body returns."""
        return self.call("/execute/sync", {"script": script, "args": list(arguments)})

    def size(self, width: int, height: int) -> None:
        """Of the page's viewport [pixel]."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.devtools("Emulation.setDeviceMetricsOverride", metrics)

    def scheme(self, name: str) -> None:
        """What the system prefers, dark or light."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.devtools("Emulation.setEmulatedMedia", {"features": features})

    def devtools(self, command: str, arguments: dict[str, Any]) -> Any:
        """A command of Chromium's own."""
        return self.call("/goog/cdp/execute", {"cmd": command, "params": arguments})

    def screenshot(self, *, whole: bool = False) -> bytes:
        """A PNG of the viewport, or of the whole page."""
        if not whole:
            return base64.b64decode(self.call("/screenshot"))
        arguments = {"format": "png", "captureBeyondViewport": True}
        return base64.b64decode(self.devtools("Page.captureScreenshot", arguments)["data"])

    def press(self, *keys: str) -> None:
        """Type keys, where the focus is."""
        actions = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        self.call("/actions", {"actions": [{"type": "key", "id": "keys", "actions": actions}]})

    def point(self, x: float, y: float) -> None:
        """Move the mouse to a place of the viewport [pixel]."""
        move = {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y), "origin": "viewport"}
        self.call("/actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": [move]}]})

    def complaints(self) -> list[str]:
        """Errors of the console since they were asked for last."""
        entries = self.call("/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] == "SEVERE"]


@contextmanager
def browsing(width: int = 1280, height: int = 900) -> Iterator[Browser]:
    """A browser with a profile of its own, ended afterwards."""
    found = programs()
    assert found is not None
    browser, driver = found
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = subprocess.Popen(
        [driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    root = Browser(f"http://127.0.0.1:{port}")
    try:
        with tempfile.TemporaryDirectory() as profile:
            _await(root)
            options = {
                "binary": browser,
                "args": [*_FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"],
            }
            wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
            session = root.call("/session", {"capabilities": {"alwaysMatch": wanted}})["sessionId"]
            window = Browser(f"http://127.0.0.1:{port}/session/{session}")
            try:
                yield window
            finally:
                urllib.request.urlopen(
                    urllib.request.Request(window._address, method="DELETE"), timeout=_PATIENCE
                ).close()
    finally:
        server.terminate()
        server.wait()


def _await(root: Browser) -> None:
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            if root.call("/status")["ready"]:
                return
        except OSError:
            pass
        if time.monotonic() > end:
            raise TimeoutError("chromedriver does not answer")
        time.sleep(0.1)
