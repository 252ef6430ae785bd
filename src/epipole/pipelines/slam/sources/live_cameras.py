"""Frames of live cameras: one camera, two cameras as a stereo pair, or one that delivers both images side by side."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from epipole.errors import ConfigError
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.sources.folder import (
    FrameSource,
    Preparation,
    QueuedFrame,
    of_one_camera,
    of_pair,
)

SYNCHRONOUS_S = 0.002
"""Median time between the two images of a pair beyond which a note reports it."""
FAILURES = (cv2.error, OSError, AttributeError, IndexError, TypeError, ValueError)
"""Errors of a driver, and of images that it claims to have read."""
MOST_PAIRS = 10_000
"""Last pairs whose time difference counts."""
_NUMBER, _DEVICE = re.compile(r"[0-9]{1,3}"), re.compile(r"/dev/video([0-9]{1,3})")


def camera_indices(source: Path) -> tuple[int, ...]:
    """Numbers of the one or two cameras that a source names; empty if it names none.

    Args:
        source: numbers of at most three digits or devices such as /dev/video0, two of them with a comma between, left first. An existing
            file with such a number as its name is no camera.
    """
    words = str(source).split(",")
    found = [index for index in map(_index, words) if index is not None]
    is_file = _NUMBER.fullmatch(words[0]) is not None and source.exists()
    return tuple(found) if len(found) == len(words) <= 2 and not is_file else ()


def _index(word: str) -> int | None:
    if word.startswith("/dev/"):
        device = _DEVICE.fullmatch(str(Path(word).resolve()))  # also of links such as /dev/v4l/by-id/NAME
        return None if device is None else int(device[1])
    return int(word) if _NUMBER.fullmatch(word) else None


def open_cameras(
    indices: Sequence[int],
    sensor: Literal["mono", "stereo"],
    given: CameraOptions,
    captures: Sequence[Any] = (),
    clock: Callable[[], float] = time.time,
) -> FrameSource:
    """Open the frames of live cameras; slow tracking gets the newest frame, and dropped frames are counted.

    Args:
        indices: numbers of one camera or of two (left, right), as in OpenCV.
        sensor: "stereo" for two cameras, or for one that delivers the left and the right image side by side.
        given: intrinsics of the camera, or the calibration of both.
        captures: one source of images per camera, as `cv2.VideoCapture`; empty: the cameras are opened.
        clock: returns the time in seconds.

    Raises:
        ConfigError: there is no such camera, its intrinsics are unknown, or the images are not those of a pair.
    """
    name = f"camera {indices[0]}" if len(indices) == 1 else f"cameras {indices[0]} and {indices[1]}"
    if len(set(indices)) < len(indices):
        raise ConfigError(f"{name}: a stereo pair needs two different cameras")
    opened = captures or _opened(indices)
    camera = (
        CameraPair(*opened) if len(indices) == 2 else OneCamera(opened[0], 2 if sensor == "stereo" else 1)
    )
    try:
        first = camera.read()
        if first is None:
            raise ConfigError(f"{name} delivers no image: another program may use it")
        made = _preparation([(image.shape[1], image.shape[0]) for image in first], given)
    except BaseException:
        camera.release()
        raise
    newest = _Newest(camera, clock)

    def frames() -> Generator[QueuedFrame, None, None]:
        for number, seconds, images in newest.images():
            read = partial(_of_images, made, seconds, images)
            yield QueuedFrame(number, seconds, f"frame_{number:06d}.jpg", read)

    layout = "camera" if sensor == "mono" else "two cameras" if len(indices) == 2 else "side by side"
    return FrameSource(
        made.camera,
        0,
        frames,
        made.body_from_camera,
        lambda: [*camera.notes(), *made.notes()],
        is_live=True,
        about={"layout": layout, "sensor": sensor, "camera_source": "given"},
    )


def _preparation(sizes: list[tuple[int, int]], given: CameraOptions) -> Preparation:
    if len(sizes) == 1:
        intrinsics = given.camera(sizes[0])
        if intrinsics is None:
            raise ConfigError(
                "unknown intrinsics of the live camera: pass camera_params (fx,fy,cx,cy) or a calibration"
            )
        return of_one_camera(intrinsics)
    (width, height), right = sizes
    if right != (width, height):
        raise ConfigError(
            f"the two images of a pair must have one size, got {width} x {height} and {right[0]} x {right[1]}"
        )
    rig = given.rig(sizes[0])
    if rig is None:
        raise ConfigError("unknown geometry of the live stereo pair: pass a calibration of both cameras")
    return of_pair(rig)


def _of_images(made: Preparation, seconds: float, images: Sequence[np.ndarray]) -> Frame:
    return made.frame(
        seconds, *(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images)
    )


class OneCamera:
    """A camera that delivers one image, or the left and the right image as the halves of one."""

    def __init__(self, capture: Any, num_images: int) -> None:
        self._capture, self._num_images = capture, num_images

    def read(self) -> tuple[np.ndarray, ...] | None:
        """Wait for the next image or pair; None at the end."""
        is_read, image = self._capture.read()
        if not is_read:
            return None
        return (image,) if self._num_images == 1 else tuple(np.array_split(image, 2, axis=1))

    def release(self) -> None:
        """Close it."""
        self._capture.release()

    def notes(self) -> list[str]:
        """No warnings."""
        return []


class CameraPair:
    """Two independent cameras, read together: both images are grabbed before any is decoded."""

    def __init__(self, left: Any, right: Any, clock: Callable[[], float] = time.monotonic) -> None:
        self._captures, self._clock = (left, right), clock
        self._apart_s = deque[float](maxlen=MOST_PAIRS)

    def read(self) -> tuple[np.ndarray, ...] | None:
        """Wait for the next image of each; None if one of them ends."""
        times = []
        for capture in self._captures:
            if not capture.grab():
                return None
            times.append((float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0, self._clock()))
        # V4L2 gives the time of an image by the system's clock. Other drivers count from the start of each camera, or give 0 or -1.
        has_stamps = sys.platform == "linux" and min(stamp for stamp, _ in times) > 0.0
        column = 0 if has_stamps else 1
        self._apart_s.append(abs(times[1][column] - times[0][column]))
        found = [capture.retrieve() for capture in self._captures]
        return tuple(image for _, image in found) if all(is_read for is_read, _ in found) else None

    def release(self) -> None:
        """Close both."""
        for capture in self._captures:
            capture.release()

    def notes(self) -> list[str]:
        """A warning if the images of a pair are not of one time."""
        apart_s = np.array(self._apart_s)
        if not len(apart_s) or float(np.median(apart_s)) <= SYNCHRONOUS_S:
            return []
        median_ms, most_ms = 1e3 * np.percentile(apart_s, (50.0, 95.0))
        return [
            f"the two cameras are not synchronized: the images of a pair are {median_ms:.0f} ms apart in the median and {most_ms:.0f} ms in "
            "the 95th percentile, so depth is biased while the cameras move"
        ]


class _Newest:
    """Newest image or images, read in a thread because driver queues deliver old images."""

    def __init__(self, camera: OneCamera | CameraPair, clock: Callable[[], float]) -> None:
        self._camera, self._clock = camera, clock
        self._changed = threading.Condition()
        self._newest: tuple[int, float, tuple[np.ndarray, ...]] | None = None
        self._is_over = False
        self._error: Exception | None = None

    def images(self) -> Iterator[tuple[int, float, tuple[np.ndarray, ...]]]:
        """Yield number, seconds and pixels of the newest image or images, until the camera or the caller stops."""
        thread = threading.Thread(target=self._read, daemon=True)
        thread.start()
        try:
            while True:
                with self._changed:
                    while self._newest is None and not self._is_over:
                        self._changed.wait(0.2)  # short waits, so that Ctrl-C works on every system
                    taken, self._newest = self._newest, None
                if taken is None and self._error is not None:
                    raise ConfigError(f"the live camera failed: {self._error}") from self._error
                if taken is None:
                    return
                yield taken
        finally:
            self._is_over = True
            thread.join(timeout=5.0)
            self._camera.release()

    def _read(self) -> None:
        number = 0
        while not self._is_over:
            try:
                images = self._camera.read()
            except FAILURES as error:
                images, self._error = None, error
            seconds = self._clock()
            with self._changed:
                if images is not None:
                    self._newest = (number, seconds, images)
                else:
                    self._is_over = True
                self._changed.notify()
            number += 1


def _opened(indices: Sequence[int]) -> list[Any]:
    captures: list[Any] = []
    try:
        for index in indices:
            captures.append(_opened_camera(index))
    except BaseException:
        for capture in captures:
            capture.release()
        raise
    return captures


def _opened_camera(index: int) -> Any:
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below is enough
    try:
        capture = cv2.VideoCapture(index)
    finally:
        cv2.utils.logging.setLogLevel(before)
    if not capture.isOpened():
        raise ConfigError(f"camera {index} cannot be opened: it does not exist, or another program uses it")
    return capture
