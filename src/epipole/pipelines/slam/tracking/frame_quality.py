"""Images that tell little: blurred, dark, overexposed, of one shade; said in words, and kept out of the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from epipole.mapping import RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame, TrackedFrame

REMEMBERED = 15
"""Frames before this one that tell how sharp images of this camera and place are; a blur that lasts becomes usual."""
LEAST_REMEMBERED = 3
CERTAIN = 2
"""So many times as many points as usual must agree on the place of an image with a problem."""
BLURRED = 0.68
"""Share of the usual detail below which an image is blurred. The kitchen of 7-Scenes, carried by hand, goes down to 0.71;
10 pixels of motion leave 0.60 to 0.67 in most images, 5 pixels 0.8."""
MOST_USUAL = 1.0
"""Noise alone has more fine detail than any image of things: it is no measure for them."""
LEAST_CONTRAST = 4.0
"""Standard deviation of the grey values (of averages over 8 x 8 pixels) of an image that shows something."""
DARK, BRIGHT, WHITE, MOST_WHITE = 30.0, 225.0, 250, 0.5
_ANGLES = np.deg2rad(np.arange(0.0, 180.0, 22.5))
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)


@dataclass(frozen=True, slots=True)
class FrameQuality:
    """What is wrong with a frame's images, in words; empty for nothing."""

    problem: str = ""
    right_problem: str = ""
    """Of a pair's second image."""

    is_left_alone: bool = False
    """Whether a pair's left image shows nothing, and the right one does."""

    @property
    def is_usable(self) -> bool:
        """Whether the (left) image may become a keyframe."""
        return not self.problem

    def confirmed(
        self, found: tuple[RefinedPose, int] | None, config: OdometryConfig
    ) -> tuple[RefinedPose, int] | None:
        """A place and the number of points that agree; None where these are few for such an image.

        Points that are found in a blurred image are off by more than others, and all to the same side.
        """
        is_certain = found is None or self.is_usable or found[1] >= CERTAIN * config.min_tracked
        return found if is_certain else None

    def with_quality(self, answer: TrackedFrame) -> TrackedFrame:
        """The answer with what is wrong: alone where the frame has a place, else before the reason why it has none."""
        words = self.problem
        if self.right_problem:
            words = f"{words}; {self.right_problem}" if words else self.right_problem
        if not words:
            return answer
        if answer.world_from_body is None and answer.submap_from_body is None:
            words = f"{words}; {answer.reason}"
        elif self.is_left_alone:
            words = f"{words}; followed in the right image"
        elif answer.is_keyframe:
            words = f"{answer.reason}; {words}"
        return replace(answer, reason=words)


class FrameQualityMonitor:
    """Looks at every frame's images before they are followed."""

    def __init__(self) -> None:
        self._usual: list[np.ndarray] = []

    def assess(self, frame: Frame) -> FrameQuality:
        """What is wrong with the images, in words."""
        problem, detail = _examined(frame.grey)
        shows_nothing = bool(problem)
        if not shows_nothing:
            problem = self._blur(detail)
            self._usual = [*self._usual[1 - REMEMBERED :], np.minimum(detail, MOST_USUAL)]
        if frame.right_grey is None:
            return FrameQuality(problem)
        right = _examined(frame.right_grey)[0]
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


def shows_something(grey: np.ndarray) -> bool:
    """Whether there is anything in an image that points could be followed from."""
    return float(grey[::8, ::8].std()) >= LEAST_CONTRAST


def _examined(grey: np.ndarray) -> tuple[str, np.ndarray]:
    """What is wrong with an image of itself, and its detail: fine against coarse edges, by direction.

    Blur by motion takes the fine edges across it, whatever is in sight; contrast and exposure change both alike.
    """
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    mean, deviation = (float(value[0, 0]) for value in cv2.meanStdDev(small))
    white = float((small >= WHITE).mean())
    if white > MOST_WHITE or (deviation < LEAST_CONTRAST and mean > BRIGHT):
        problem = f"the image is overexposed: {100 * white:.0f} % of it is white"
    elif deviation >= LEAST_CONTRAST:
        problem = ""
    elif mean < DARK:
        problem = f"the image is dark (mean {mean:.0f} of 255): no light, or the lens is covered"
    else:
        problem = f"the image is of one shade (mean {mean:.0f} of 255): the lens is covered, or a blank wall"
    return problem, np.sqrt(_edges(half) / np.maximum(_edges(small), 1e-3))


def _edges(grey: np.ndarray) -> np.ndarray:
    """(8,) mean squared derivatives along directions that are 22.5 degrees apart."""
    along_x, along_y = (cv2.Sobel(grey, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    xx, xy, yy = (
        cv2.mean(cv2.multiply(a, b))[0]
        for a, b in ((along_x, along_x), (along_x, along_y), (along_y, along_y))
    )
    return _COS * _COS * xx + 2.0 * _COS * _SIN * xy + _SIN * _SIN * yy
