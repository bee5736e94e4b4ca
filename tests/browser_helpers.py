# SPDX-License-Identifier: Apache-2.0
"""A real browser without a screen: Chromium, spoken to in its DevTools protocol."""

import base64
import json
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.request import urlopen

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Browser:
    """One page in a headless Chromium; a context manager.

    Args:
        url: to open.
        size: of the page (width, height) [pixels].
    """

    def __init__(self, url, size=(1200, 850)):
        self._url, self._size, self._number = url, size, 0

    def __enter__(self):
        self._profile = tempfile.TemporaryDirectory(prefix="chromium_", ignore_cleanup_errors=True)
        log_path = Path(self._profile.name) / "log.txt"
        width, height = self._size
        with open(log_path, "wb") as log:
            self._process = subprocess.Popen(
                [
                    CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle",
                    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                    f"--window-size={width},{height}", "--remote-debugging-port=0",
                    f"--user-data-dir={self._profile.name}", "about:blank",
                ],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        port = self._wait_for_port(log_path)
        with urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            page = next(page for page in json.load(answer) if page["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.send("Page.navigate", url=self._url)
        return self

    def __exit__(self, *_):
        self._socket.close()
        self._process.terminate()
        self._process.wait(10.0)
        self._profile.cleanup()

    def _wait_for_port(self, log_path, timeout=30.0):
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            found = re.search(r"ws://127\.0\.0\.1:(\d+)/", log_path.read_text(errors="replace"))
            if found:
                return int(found[1])
            time.sleep(0.05)
        self._process.kill()
        raise AssertionError(f"chromium did not start:\n{log_path.read_text(errors='replace')}")

    def send(self, method, **parameters):
        """One command of the protocol; returns its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=30.0))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def text(self):
        """All text on the page."""
        result = self.send("Runtime.evaluate", expression="document.body.innerText")
        return result["result"].get("value", "")

    def click(self, label):
        """Click the button with a label."""
        expression = (
            "[...document.querySelectorAll('button')]"
            f".find(b => b.innerText.trim() === {json.dumps(label)}).click()"
        )
        self.send("Runtime.evaluate", expression=expression)

    def mouse(self, kind, x, y):
        """A mouse event: mousePressed, mouseMoved or mouseReleased at a place [pixels]."""
        button = {"button": "left", "buttons": 0 if kind == "mouseReleased" else 1, "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def screenshot(self, path):
        """Save what the page shows as PNG."""
        Path(path).write_bytes(base64.b64decode(self.send("Page.captureScreenshot")["data"]))
