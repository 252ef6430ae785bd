"""Initialization of a single camera's map from its first frames, and its confirmation by later ones."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from epipole._parallel import inline_here
from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.start.two_view import (
    MIN_CONFIRMING,
    MIN_POINTS,
    Confirmation,
    Start,
    best_start,
    confirm_start,
    is_wide_enough,
    try_start,
)
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.pipelines.slam.tracking.points import Tracks, locate
from epipole.pipelines.slam.tracking.static_points import MOVING_PX, find_ambiguous_part

Result = TypeVar("Result")

START_KEYFRAMES = 6
MAX_CONFIRMING_FRAMES = 24
MOVING_QUANTILE = 0.75
"""A frame moved if this quantile of its points' shifts exceeds MOVING_PX."""
LONGEST_WAIT_S = 0.05
"""Longest time that a frame waits for the comparison of motions, before which no frame has a pose."""
MOST_WAITING = 300
"""Frames kept before the initialization; their poses are estimated after it."""
LEAST_KEPT = 0.4
"""If a smaller fraction of the first frame's points is still tracked, the present frame becomes the first."""


class WaitingFrame(NamedTuple):
    """A frame before the initialization."""

    frame: Frame
    number: int
    pixels: np.ndarray  # (n, 2) of the tracked points
    track: np.ndarray  # (n,) their indices


@dataclass(frozen=True, slots=True, eq=False)
class Initialization:
    """A new map of a single camera, not adjusted yet and without the present frame."""

    model: SlamMap
    tracks: Tracks
    """Points tracked in the present frame."""
    cam_from_world: Rigid3
    """Of the present frame."""
    waiting: list[WaitingFrame]
    row_of_track: np.ndarray
    """The map's point of each track; -1 for none."""

    def seen_by(self, one: WaitingFrame) -> tuple[np.ndarray, np.ndarray]:
        """A waiting frame's observations of the map: pixels (n, 2) and rows (n,) of the points."""
        rows = self.row_of_track[one.track]
        return one.pixels[rows >= 0], rows[rows >= 0]

    def locate_waiting(
        self, model: SlamMap, camera: Camera, config: OdometryConfig
    ) -> list[tuple[WaitingFrame, Keyframe, Rigid3, np.ndarray]]:
        """The waiting frames with their preceding keyframes, cam_from_world and covariances.

        Args:
            model: the map that has the points.
            camera: any model.
            config: thresholds.
        """
        out, keyframes = [], model.keyframes
        numbers = [k.number for k in keyframes]
        for one in self.waiting:
            keyframe = keyframes[int(np.searchsorted(numbers, one.number, side="right")) - 1]
            pixels, rows = self.seen_by(one)
            found = initialize_map(model, rows, pixels, keyframe.cam_from_world, camera, config)
            if found is not None:
                is_keyframe = keyframe.number == one.number
                position = keyframe.cam_from_world if is_keyframe else found.cam_from_world
                out.append((one, keyframe, position, found.covariance()))
        return out


class OneCameraStart:
    """Collects frames of a single camera until a map can be initialized.

    Motions that explain the images are optimized and compared, which takes the time of several frames. With `judges`, that happens
    beside tracking, and a later frame receives the result.
    """

    def __init__(self, camera: Camera, config: OdometryConfig, judges: Executor | None = None) -> None:
        self.camera, self.config = camera, config
        self.tracks = Tracks.none()
        self._judges = judges
        self._waiting: list[WaitingFrame] = []
        self._num_at_start = 0
        self._choice: tuple[Future[Start], Tracks] | None = None
        """The motion to initialize with, and the tracks that it refers to."""
        self._verdict: Future[Confirmation] | None = None

    def add(self, frame: Frame, number: int, problem: str = "") -> Initialization | str:
        """The map if it can be initialized with this frame, else the reason why not; never from an image with a problem."""
        if not self._waiting:
            return self._wait_from(frame, number, "the first frame: depth needs a second position")
        self._track(frame)
        tracks = self.tracks
        reason = self._choose(problem) if self._choice is None else ""
        initial = reason or problem or self._chosen()
        self._waiting.append(WaitingFrame(frame, number, tracks.pixels, tracks.point))
        if isinstance(initial, Initialization):
            return initial
        is_thin = len(tracks.pixels) < max(MIN_POINTS, LEAST_KEPT * self._num_at_start)
        if is_thin or len(self._waiting) > MOST_WAITING:
            return self._wait_from(frame, number, initial)
        return initial

    def _choose(self, problem: str) -> str:
        """Choose the motion to initialize with; a reason if none is possible."""
        tracks = self.tracks
        started = try_start(tracks.start_px, tracks.pixels, self.camera, self.config)
        reason = started.reason or self._may_rest() or problem
        if not reason:
            work = partial(best_start, started, self._pixels_since(), self.camera, self.config)
            self._choice = self._beside(work), Tracks(tracks.pixels, tracks.point, tracks.start_px)
        return reason

    def _chosen(self) -> Initialization | str:
        """The map by the chosen motion; a reason if the motions are ambiguous or still compared."""
        assert self._choice is not None
        future, then = self._choice
        wait_for([future], LONGEST_WAIT_S)
        if not future.done():
            return "the motions that could explain the images are still being compared"
        self._choice = None
        started = future.result()
        return started.reason or self._initialize(started, then)

    def _beside(self, work: Callable[[], Result]) -> Future[Result]:
        """The result of work that is done beside tracking, or at once if there is no thread for it."""
        if self._judges is not None:
            return self._judges.submit(_inline, work)
        done: Future[Result] = Future()
        done.set_result(work())
        return done

    @property
    def first_number(self) -> int:
        """Number of the map's first frame."""
        return self._waiting[0].number

    @property
    def first_time_s(self) -> float:
        """Time of that frame."""
        return self._waiting[0].frame.timestamp_s

    def confirm(self, frame: Frame, number: int, cam_from_first: Rigid3) -> Confirmation:
        """Compare the map's motion since its first frame with an estimate from image tracks alone.

        Args:
            frame: the present one.
            number: its number.
            cam_from_first: its motion since the first frame, from the map.
        """
        self._track(frame)
        if self._verdict is not None and (verdict := self.verdict()) is not Confirmation.OPEN:
            return verdict
        now = self.tracks
        if self._verdict is None and (len(now) < MIN_CONFIRMING or number - self.first_number > MOST_WAITING):
            return Confirmation.OUT_OF_SIGHT
        self._waiting.append(WaitingFrame(frame, number, now.pixels, now.point))
        while len(self._waiting) > MAX_CONFIRMING_FRAMES:  # each has its image
            self._waiting = [*self._waiting[:-1:2], self._waiting[-1]]
        seen = now.start_px, now.pixels, self.camera, self.config
        if self._verdict is None and is_wide_enough(cam_from_first, *seen):
            work = partial(confirm_start, cam_from_first, self._pixels_since(), self.camera, self.config)
            self._verdict = self._beside(work)
        return self.verdict()

    def verdict(self, *, wait: bool = False) -> Confirmation:
        """The result of the last comparison; open while it is made (unless `wait`), and without one."""
        if self._verdict is None or not (wait or self._verdict.done()):
            return Confirmation.OPEN
        verdict, self._verdict = self._verdict, None
        return verdict.result()

    def _track(self, frame: Frame) -> None:
        tracks = self.tracks
        tracks.track(self._waiting[-1].frame.gray, frame.gray, tracks.pixels, self.config, and_back=True)
        tracks.keep(frame.is_used(tracks.pixels))

    def _wait_from(self, frame: Frame, number: int, reason: str) -> str:
        """Make this frame the first of a new attempt."""
        corners = new_corners(frame.gray, np.zeros((0, 2)), self.config, frame.ignored_mask)
        self.tracks = Tracks(corners, np.arange(len(corners)), corners)
        if self._choice is not None:
            self._choice[0].cancel()
        self._num_at_start, self._choice = len(corners), None
        self._waiting = [WaitingFrame(frame, number, corners, self.tracks.point)]
        return reason

    def _may_rest(self) -> str:
        """Why the camera may have been at rest since the first frame while an object moved; empty if it cannot.

        Lost points count with their last pixel, since the object gradually occludes the static scene.
        """
        last = self._waiting[0].pixels.copy()
        for one in self._waiting:
            moves = np.linalg.norm(one.pixels - self._waiting[0].pixels[one.track], axis=1)
            if np.quantile(moves, MOVING_QUANTILE) > MOVING_PX:
                last[one.track] = one.pixels
            else:
                last[one.track] = np.nan
        last[self.tracks.point] = self.tracks.pixels
        known = np.isfinite(last[:, 0])
        static = find_ambiguous_part(self._waiting[0].pixels[known], last[known], self.camera)
        if static is None:
            return ""
        return (
            f"{100 * static.fraction:.0f} % of the image is static while the rest moves: one camera cannot distinguish an object"
            " that passes it from a near object that it passes in front of a distant background"
        )

    def _pixels_since(self) -> np.ndarray:
        """(f, n, 2) pixels of the tracked points in some frames since the first, with the first and the present one."""
        now, waiting = self.tracks, self._waiting
        used = np.unique(np.linspace(0, len(waiting) - 1, START_KEYFRAMES).astype(int))
        seen = [waiting[n].pixels[np.searchsorted(waiting[n].track, now.point)] for n in used]
        return np.stack([*seen, now.pixels])

    def _initialize(self, started: Start, then: Tracks) -> Initialization | str:
        """Create the map, with keyframes in between: at small angles they contribute as much as the two ends.

        Args:
            started: the motion, and the points of `then`.
            then: the tracks of the frame with that motion, which may precede the present frame.
        """
        assert started.cam_from_first is not None and started.points_in_first is not None
        model, waiting, now = SlamMap(), list(self._waiting), self.tracks
        points = model.add_points(started.points_in_first, then.start_px, 0)
        row_of_track = np.full(self._num_at_start, -1)
        row_of_track[then.point] = points
        position = Rigid3.identity()
        for n in np.unique(np.linspace(0, len(waiting) - 1, START_KEYFRAMES).astype(int)):
            one = waiting[n]
            rows = row_of_track[one.track]
            pixels, rows = one.pixels[rows >= 0], rows[rows >= 0]
            found = initialize_map(model, rows, pixels, position, self.camera, self.config)
            position = found.cam_from_world if found is not None and n > 0 else position
            seen = Observations(pixels, np.full(len(rows), np.nan), rows)
            keyframe = Keyframe(one.number, one.frame.timestamp_s, one.frame.gray, position, seen)
            keyframe.ignored_mask = one.frame.ignored_mask
            model.keyframes.append(keyframe)
        tracks, position = Tracks(now.pixels, row_of_track[now.point], now.start_px), started.cam_from_first
        if now.pixels is not then.pixels:
            found = initialize_map(model, tracks.point, now.pixels, position, self.camera, self.config)
            if found is None:
                return "too few points of the new map are still tracked"
            position = found.cam_from_world
        return Initialization(model, tracks, position, waiting, row_of_track)


def _inline(work: Callable[[], Result]) -> Result:
    with inline_here():  # tracking needs the other processors
        return work()


def initialize_map(
    model: SlamMap,
    rows: np.ndarray,
    pixels: np.ndarray,
    start: Rigid3,
    camera: Camera,
    config: OdometryConfig,
) -> RefinedPose | None:
    """The pose of a frame from its pixels alone; None if there are too few inliers."""
    kept = model.is_triangulated(rows)
    found = locate(model.xyz[rows[kept]], pixels[kept], camera, start, None, config)
    return None if found is None else found[0]
