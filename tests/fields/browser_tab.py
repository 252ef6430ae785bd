"""A page in a headless browser with WebGL in software: its pictures, its errors, and hands on it."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from websockets.sync.client import connect

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
OFFLINE = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
)
LONGEST_S = 60.0


class Tab:
    """One page, over the browser's own protocol."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.count, self.problems = socket, 0, []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": params}))
        while True:
            told = json.loads(self.socket.recv(timeout=LONGEST_S))
            if told.get("id") == self.count:
                assert "error" not in told, told
                return told["result"]
            self._note(told)

    def _note(self, told: dict[str, Any]) -> None:
        if told["method"] == "Runtime.exceptionThrown":
            self.problems.append(str(told["params"]["exceptionDetails"]))
        if told["method"] == "Log.entryAdded" and told["params"]["entry"]["level"] == "error":
            self.problems.append(told["params"]["entry"]["text"])

    def value(self, expression: str) -> Any:
        done = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait_until(self, expression: str) -> None:
        stop = time.monotonic() + LONGEST_S
        while not self.value(expression):
            assert time.monotonic() < stop, (expression, self.problems)
            time.sleep(0.05)

    def open(self, address: str, width: int = 800, height: int = 600) -> None:
        """Load a page, whole."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=address)
        self.wait_until("document.documentElement?.dataset.ready === 'yes'")

    def picture(self, clip: dict[str, float] | None = None) -> np.ndarray:
        """(h, w, 3) of 8 bits what is seen; of a part {x, y, width, height}, or of all."""
        extra = {} if clip is None else {"clip": clip | {"scale": 1}}
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png", **extra)["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


@contextmanager
def open_tab(folder: Path, *options: str) -> Iterator[Tab]:
    """A browser of its own, which ends with the block."""
    profile = folder / "profile"
    command = [BROWSER, "--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars", *SOFTWARE_GL]
    command += [*OFFLINE, f"--user-data-dir={profile}", "--remote-debugging-port=0", *options, "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port, stop = profile / "DevToolsActivePort", time.monotonic() + LONGEST_S
        while not (port.is_file() and port.read_text().count("\n")):
            assert time.monotonic() < stop and process.poll() is None
            time.sleep(0.05)
        number = port.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{number}/json/list", timeout=LONGEST_S) as answer:
            target = next(page for page in json.load(answer) if page["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=None, proxy=None) as socket:
            yield Tab(socket)
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
