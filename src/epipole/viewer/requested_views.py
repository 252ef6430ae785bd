"""Views of a field requested by tabs, rendered by the job between two of its steps."""

from __future__ import annotations

import io
import queue
import threading
from collections.abc import Callable
from time import perf_counter

import numpy as np
from jaxtyping import Float32
from PIL import Image

from epipole._jit import compile_seconds
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.viewer.page_server import Request

LEAST_SIDE_PX, MOST_SIDE_PX = 48, 320
"""Range of the height of a view: the smallest at first, since an untrained field is fog and slow to render."""
RENDER_S = 0.3
"""Target time per view, seconds: slower fields are rendered smaller."""
LEAST_ASPECT, MOST_ASPECT = 0.25, 4.0
MOST_WAITING, LONGEST_WAIT_S = 4, 20.0
"""Largest number of waiting views, and how long a tab waits for its view (seconds) before it has to ask again."""

Render = Callable[[Camera, Rigid3], Float32[np.ndarray, "h w 3"]]


class RequestedViews:
    """Accepts requests in server threads, and renders them in the job's thread."""

    def __init__(self) -> None:
        self._waiting = queue.Queue[_Pending](MOST_WAITING)
        self._side_px = float(LEAST_SIDE_PX)

    def answer(self, requested: Request) -> bytes | None:
        """The JPEG of a view; empty if the job had no time for it, None if the query is invalid."""
        values = _numbers_of(requested.query)
        if values is None or camera_of(values, LEAST_SIDE_PX) is None:
            return None
        one = _Pending(values)
        try:
            self._waiting.put_nowait(one)
        except queue.Full:
            return b""
        one.is_wanted = one.is_rendered.wait(LONGEST_WAIT_S)
        return _jpeg(one.image) if one.is_wanted else b""

    def render_next(self, render: Render) -> bool:
        """Render the view that has waited longest, if any."""
        while True:
            try:
                one = self._waiting.get_nowait()
            except queue.Empty:
                return False
            found = camera_of(one.values, round(self._side_px)) if one.is_wanted else None
            if found is None:
                continue
            start, compiling = perf_counter(), compile_seconds()
            one.image = render(*found)
            one.is_rendered.set()
            seconds = max(perf_counter() - start - (compile_seconds() - compiling), 1e-6)
            side = self._side_px * np.sqrt(RENDER_S / seconds)
            self._side_px = float(np.clip(side, LEAST_SIDE_PX, MOST_SIDE_PX))
            return True


class _Pending:
    def __init__(self, values: np.ndarray) -> None:
        self.values, self.image, self.is_wanted = values, np.zeros((1, 1, 3), np.float32), True
        self.is_rendered = threading.Event()


def _numbers_of(query: str) -> np.ndarray | None:
    try:
        return np.array([float(word) for word in query[:1000].split(",")])
    except ValueError:
        return None


def camera_of(values: np.ndarray, side_px: int) -> tuple[Camera, Rigid3] | None:
    """The pinhole camera of a viewpoint, and its cam_from_world.

    Args:
        values: (11,) position, forward and down directions in the world, the tangent of half the vertical field of
            view, and width over height.
        side_px: height of the image.

    Returns:
        None if the values are not a valid viewpoint.
    """
    if values.shape != (11,) or not np.isfinite(values).all() or np.abs(values).max() > 1e12:
        return None
    position, ahead, down, (tangent, aspect) = values[:3], values[3:6], values[6:9], values[9:]
    right = np.cross(down, ahead)
    sizes = np.linalg.norm(right), np.linalg.norm(ahead)
    if min(sizes) < 1e-9 or not 1e-3 < tangent < 1e3:
        return None
    x, z = right / sizes[0], ahead / sizes[1]
    width, focal = (
        max(1, round(float(np.clip(aspect, LEAST_ASPECT, MOST_ASPECT)) * side_px)),
        0.5 * side_px / tangent,
    )
    params = np.array([focal, focal, 0.5 * (width - 1), 0.5 * (side_px - 1)])
    rotation = np.stack([x, np.cross(z, x), z])
    return Camera(CameraModel.PINHOLE, width, side_px, params), Rigid3(rotation, -rotation @ position)


def _jpeg(image: Float32[np.ndarray, "h w 3"]) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(stream, "JPEG", quality=80)
    return stream.getvalue()
