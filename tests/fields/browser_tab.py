"""A page in a headless browser with WebGL in software: its images, its errors, and hands on it."""

import base64
import time
from typing import Any

import cv2
import numpy as np

LONGEST_S = 60.0


class Tab:
    """One page, over the browser's own protocol."""

    def __init__(self, page: Any) -> None:
        self.page, self.session, self.problems = page, page.context.new_cdp_session(page), []
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", lambda said: self.problems.append(said.text) if said.type == "error" else None)
        self.call("Page.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        return self.session.send(method, params)

    def value(self, expression: str) -> Any:
        done = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait_until(self, expression: str) -> None:
        stop = time.monotonic() + LONGEST_S
        while not self.value(expression):
            assert time.monotonic() < stop, (expression, self.problems)
            self.page.wait_for_timeout(20)

    def open(self, address: str, width: int = 800, height: int = 600) -> None:
        """Load a page, whole."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=address)
        self.wait_until("document.documentElement?.dataset.ready === 'yes'")

    def image(self, clip: dict[str, float] | None = None) -> np.ndarray:
        """(h, w, 3) of 8 bits what is seen; of a part {x, y, width, height}, or of all."""
        extra = {} if clip is None else {"clip": clip | {"scale": 1}}
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png", **extra)["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)
