"""Frame quality: images that are blurred, dark, overexposed or of one shade are reported and do not become keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from epipole.mapping import RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame, TrackedFrame
from epipole.scene import CameraRig

REMEMBERED = 15
"""Previous frames that define the usual detail. A persistent blur becomes usual."""
LEAST_REMEMBERED = 3
CERTAIN = 2
"""Factor on the minimum number of inliers for an image with a problem."""
CERTAIN_PART = 0.2
"""Part of the points of the last keyframe that must agree in such an image."""
BLURRED = 0.68
"""Fraction of the usual detail below which an image is blurred. The hand-held kitchen of 7-Scenes goes down to 0.71; 10 pixels of
motion leave 0.60 to 0.67 in most images, 5 pixels 0.8."""
MOST_USUAL = 1.0
"""Upper bound of the usual detail: noise alone has more fine detail than any image of a scene."""
LEAST_CONTRAST = 4.0
"""Smallest standard deviation of the gray values, averaged over 8 x 8 pixels, of an image that shows something."""
DARK, BRIGHT, WHITE, MOST_WHITE = 30.0, 225.0, 250, 0.5
_ANGLES = np.deg2rad(np.arange(0.0, 180.0, 22.5))
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)


@dataclass(frozen=True, slots=True)
class FrameQuality:
    """Problems of a frame's images as text; empty for none."""

    problem: str = ""
    right_problem: str = ""
    """Of a pair's right image."""

    is_left_alone: bool = False
    """Whether a pair's left image shows nothing, and the right one does."""

    @property
    def is_usable(self) -> bool:
        """Whether the (left) image may become a keyframe."""
        return not self.problem

    def confirmed(
        self, found: tuple[RefinedPose, int] | None, num_points: int, config: OdometryConfig
    ) -> tuple[RefinedPose, int] | None:
        """The pose and its number of inliers; None if the image has a problem and the inliers are too few for that.

        Points tracked in a blurred image have larger errors, all in the same direction. Where few of many points agree, some do by chance.

        Args:
            found: pose and number of inliers.
            num_points: points at the last keyframe.
            config: the minimum number of inliers.
        """
        if found is None or self.is_usable:
            return found
        return found if found[1] >= max(CERTAIN * config.min_tracked, CERTAIN_PART * num_points) else None

    def with_quality(self, answer: TrackedFrame) -> TrackedFrame:
        """The answer with the problem as its reason; without a pose, the reason why there is none is appended."""
        words = self.problem
        if self.right_problem:
            words = f"{words}; {self.right_problem}" if words else self.right_problem
        if not words:
            return answer
        if answer.world_from_body is None and answer.submap_from_body is None:
            words = f"{words}; {answer.reason}"
        elif self.is_left_alone:
            words = f"{words}; tracked in the right image"
        elif answer.is_keyframe:
            words = f"{answer.reason}; {words}"
        return replace(answer, reason=words)


class FrameQualityMonitor:
    """Assesses every frame's images before they are tracked."""

    def __init__(self, rig: CameraRig | None = None) -> None:
        self._usual: list[np.ndarray] = []
        self._rig = rig
        self._of_each = [] if rig is None else [FrameQualityMonitor() for _ in rig.cameras]

    def assess(self, frame: Frame) -> FrameQuality:
        """Problems of the images; of a rig only if all of its images have one."""
        if self._rig is not None:
            images = zip(self._of_each, self._rig.parts(frame.gray))
            found = [one.assess(Frame(frame.timestamp_s, np.ascontiguousarray(gray))) for one, gray in images]
            return found[0] if all(one.problem for one in found) else FrameQuality()
        problem, detail = _examined(frame.gray)
        shows_nothing = bool(problem)
        if not shows_nothing:
            problem = self._blur(detail)
            self._usual = [*self._usual[1 - REMEMBERED :], np.minimum(detail, MOST_USUAL)]
        if frame.right_gray is None:
            return FrameQuality(problem)
        right = _examined(frame.right_gray)[0]
        if shows_nothing and not right:
            return FrameQuality(problem.replace("the image", "the left image"), is_left_alone=True)
        return FrameQuality(problem, right.replace("the image", "the right image"))

    def _blur(self, detail: np.ndarray) -> str:
        if len(self._usual) < LEAST_REMEMBERED:
            return ""
        fraction = float((detail / np.median(np.array(self._usual), axis=0)).min())
        return (
            f"the image is blurred: {100 * fraction:.0f} % of the usual detail" if fraction < BLURRED else ""
        )


def shows_something(gray: np.ndarray) -> bool:
    """Whether an image has enough contrast for tracking."""
    return float(gray[::8, ::8].std()) >= LEAST_CONTRAST


def _examined(gray: np.ndarray) -> tuple[str, np.ndarray]:
    """The exposure problem of an image, and its detail: the ratio of fine to coarse edges by direction.

    Motion blur removes the fine edges across it in any scene; contrast and exposure scale fine and coarse edges alike.
    """
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    mean, deviation = (float(value[0, 0]) for value in cv2.meanStdDev(small))
    white = float((small >= WHITE).mean())
    if white > MOST_WHITE or (deviation < LEAST_CONTRAST and mean > BRIGHT):
        problem = f"the image is overexposed: {100 * white:.0f} % of it is white"
    elif deviation >= LEAST_CONTRAST:
        problem = ""
    elif mean < DARK:
        problem = f"the image is dark (mean {mean:.0f} of 255): no light, or the camera is covered"
    else:
        problem = f"the image is of one shade (mean {mean:.0f} of 255): the camera is covered, or faces a blank wall"
    return problem, np.sqrt(_edges(half) / np.maximum(_edges(small), 1e-3))


def _edges(gray: np.ndarray) -> np.ndarray:
    """(8,) mean squared derivatives along directions 22.5 degrees apart."""
    along_x, along_y = (cv2.Sobel(gray, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    xx, xy, yy = (
        cv2.mean(cv2.multiply(a, b))[0]
        for a, b in ((along_x, along_x), (along_x, along_y), (along_y, along_y))
    )
    return _COS * _COS * xx + 2.0 * _COS * _SIN * xy + _SIN * _SIN * yy
