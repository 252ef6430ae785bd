"""Initialization of a single camera's map from two frames, unless the camera is at rest or only rotates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.start.candidate_motions import (
    Judged,
    are_apart,
    judge,
    median_angle_deg,
    median_off_px,
    motions_of_plane,
    rival_of,
)
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.pipelines.slam.tracking.points import Tracks, locate
from epipole.pipelines.slam.tracking.static_points import MOVING_PX, find_ambiguous_part
from epipole.robust import PairKind, triangulate_points, verify_pair

MIN_POINTS = 50
LEAST_SHIFT = 0.015
"""Median shift of the points, as a fraction of the image width, below which no initialization is tried."""
START_KEYFRAMES = 6
CONFIRMING_ANGLE = 2.0
"""Later frames confirm the initialization at this multiple of `OdometryConfig.start_angle_deg`."""
MAX_CONFIRMING_FRAMES = 24
MIN_CONFIRMING = 30
"""Points of the first frame that are needed to confirm the initialization."""
MOVING_QUANTILE = 0.75
"""A frame moved if this quantile of its points' shifts exceeds MOVING_PX."""
MAX_ROTATION_DEG, MAX_DIRECTION_DEG = 1.5, 15.0
"""The map's motion since its first frame may differ this much from the independent estimate, in rotation and direction."""
MAX_EPIPOLAR_PX, MAX_EPIPOLAR_RATIO = 1.0, 3.0
"""A map is contradicted if its epipolar error (median) exceeds both this and this multiple of the independent estimate's."""
MOST_WAITING = 300
"""Frames kept before the initialization; their poses are estimated after it."""
LEAST_ANGLE_DEG = 0.3
"""Smallest triangulation angle of the initialization."""
LEAST_KEPT = 0.4
"""If a smaller fraction of the first frame's points is still tracked, the present frame becomes the first."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A two-view initialization, or the reason why there is none."""

    reason: str
    """Empty for an initialization."""
    cam_from_first: Rigid3 | None = None
    """Scaled to a median depth of 1."""
    points_in_first: np.ndarray | None = None
    """(n, 3); NaN for points with too small a triangulation angle or too large an error."""


def try_start(first_px: np.ndarray, pixels: np.ndarray, camera: Camera, config: OdometryConfig) -> Start:
    """Try to initialize a map from two frames.

    Epipolar geometry, a plane, a rotation and no motion compete (Torr's GRIC, in `verify_pair`); the median triangulation angle
    must then be large enough.

    Args:
        first_px: (n, 2) in the first frame.
        pixels: (n, 2) the same points now.
        camera: any model.
        config: the smallest median angle.
    """
    if len(pixels) < MIN_POINTS:
        return Start(f"{len(pixels)} points are tracked, {MIN_POINTS} are needed: blank, dark or blurred")
    shift = float(np.median(np.linalg.norm(pixels - first_px, axis=1)))
    if shift < LEAST_SHIFT * camera.width:
        return Start(f"the points have moved by {shift:.1f} px: the camera hardly moves")
    ransac = RansacConfig(max_error_px=1.5, min_inliers=MIN_POINTS, seed=config.seed)
    found = verify_pair(first_px, pixels, camera, camera, is_calibrated=True, config=ransac)
    if found.kind in (PairKind.ROTATION, PairKind.NO_MOTION):
        return Start("the camera only rotates, which gives no depth: move it sideways")
    if found.kind not in (PairKind.GENERAL, PairKind.PLANAR):
        return Start("the points do not move like those of one rigid scene")
    angle = np.degrees(found.median_angle_rad)
    if not angle >= config.start_angle_deg:
        return _too_narrow(angle, config)
    started = start_by(found.cam2_from_cam1, first_px, pixels, camera, found.inlier_mask)
    assert started.points_in_first is not None
    count = int(np.isfinite(started.points_in_first[:, 0]).sum())
    return (
        started
        if count >= MIN_POINTS
        else Start(f"only {count} points are triangulated, {MIN_POINTS} are needed")
    )


def start_by(
    cam_from_first: Rigid3,
    first_px: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    use: np.ndarray | None = None,
) -> Start:
    """Triangulate the points by a motion of unknown scale.

    Args:
        cam_from_first: the motion.
        first_px: (n, 2) in the first frame.
        pixels: the same points now.
        camera: any model.
        use: (n,) mask of the points to triangulate; None: all.
    """
    two = Rigid3.stack([Rigid3.identity(), cam_from_first])
    made = triangulate_points(
        two, camera, np.stack([first_px, pixels]), max_error_px=2.0, min_angle_rad=np.deg2rad(LEAST_ANGLE_DEG)
    )
    good = made.success_mask if use is None else made.success_mask & use
    depth = float(np.median(made.points_in_world[good, 2])) if good.any() else 1.0
    points = np.where(good[:, None], made.points_in_world / depth, np.nan)
    return Start("", Rigid3(cam_from_first.rotation, cam_from_first.translation / depth), points)


class Confirmation(Enum):
    """Verdict of later frames on the initialization of a map."""

    OPEN = 0
    CONFIRMED = 1
    REFUTED = 2
    OUT_OF_SIGHT = 3
    """Too few points of the first frame are still tracked."""


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
    """Collects frames of a single camera until a map can be initialized."""

    def __init__(self, camera: Camera, config: OdometryConfig) -> None:
        self.camera, self.config = camera, config
        self.tracks = Tracks.none()
        self._waiting: list[WaitingFrame] = []
        self._num_at_start = 0

    def add(self, frame: Frame, number: int, problem: str = "") -> Initialization | str:
        """The map if it can be initialized with this frame, else the reason why not; never from an image with a problem."""
        if not self._waiting:
            return self._wait_from(frame, number, "the first frame: depth needs a second position")
        self._track(frame)
        tracks = self.tracks
        started = try_start(tracks.start_px, tracks.pixels, self.camera, self.config)
        reason = started.reason or self._may_rest() or problem
        if not reason:
            started = self._best_of(started)
            reason = started.reason
        initial = None if reason else self._initialize(started)
        self._waiting.append(WaitingFrame(frame, number, tracks.pixels, tracks.point))
        if initial is not None:
            return initial
        is_thin = len(tracks.pixels) < max(MIN_POINTS, LEAST_KEPT * self._num_at_start)
        if is_thin or len(self._waiting) > MOST_WAITING:
            return self._wait_from(frame, number, reason)
        return reason

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
        now, camera = self.tracks, self.camera
        if len(now) < MIN_CONFIRMING or number - self.first_number > MOST_WAITING:
            return Confirmation.OUT_OF_SIGHT
        self._waiting.append(WaitingFrame(frame, number, now.pixels, now.point))
        while len(self._waiting) > MAX_CONFIRMING_FRAMES:  # they hold their images
            self._waiting = [*self._waiting[:-1:2], self._waiting[-1]]
        least_deg = CONFIRMING_ANGLE * self.config.start_angle_deg
        if not median_angle_deg(cam_from_first, now.start_px, now.pixels, camera) >= least_deg:
            return Confirmation.OPEN
        ransac = RansacConfig(max_error_px=1.5, min_inliers=MIN_CONFIRMING, seed=self.config.seed)
        found = verify_pair(now.start_px, now.pixels, camera, camera, is_calibrated=True, config=ransac)
        epipolar = [found.cam2_from_cam1] if found.kind in (PairKind.GENERAL, PairKind.PLANAR) else []
        judged = self._judged([cam_from_first, *epipolar])
        best = min(judged, key=lambda one: one.loss)
        if rival_of(best, judged) is not None or not best.median_angle_deg >= least_deg:
            return Confirmation.OPEN
        if not are_apart(best.cam_from_first, cam_from_first, MAX_ROTATION_DEG, MAX_DIRECTION_DEG):
            return Confirmation.CONFIRMED
        off_px, least_px = (
            median_off_px(motion, now.start_px, now.pixels, camera)
            for motion in (cam_from_first, best.cam_from_first)
        )
        return (
            Confirmation.REFUTED
            if off_px > max(MAX_EPIPOLAR_PX, MAX_EPIPOLAR_RATIO * least_px)
            else Confirmation.OPEN
        )

    def _track(self, frame: Frame) -> None:
        tracks = self.tracks
        tracks.track(self._waiting[-1].frame.gray, frame.gray, tracks.pixels, self.config, and_back=True)
        tracks.keep(frame.is_used(tracks.pixels))

    def _wait_from(self, frame: Frame, number: int, reason: str) -> str:
        """Make this frame the first of a new attempt."""
        corners = new_corners(frame.gray, np.zeros((0, 2)), self.config, frame.ignored_mask)
        self.tracks = Tracks(corners, np.arange(len(corners)), corners)
        self._num_at_start = len(corners)
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

    def _best_of(self, started: Start) -> Start:
        """Initialize with the motion that fits all frames since the first best; a reason if another one fits as well."""
        assert started.cam_from_first is not None
        judged = self._judged([started.cam_from_first])
        best = min(judged, key=lambda one: one.loss)
        if rival_of(best, judged) is not None:
            return Start(
                "the points are near a plane, and two motions explain them: keep moving, along a curve"
            )
        if not best.median_angle_deg >= self.config.start_angle_deg:
            return _too_narrow(best.median_angle_deg, self.config)
        if not are_apart(best.cam_from_first, judged[0].cam_from_first):
            return started
        return start_by(best.cam_from_first, self.tracks.start_px, self.tracks.pixels, self.camera)

    def _judged(self, motions: list[Rigid3]) -> list[Judged]:
        """These motions and those that a plane allows, in this order, optimized with the frames since the first."""
        now, camera, waiting = self.tracks, self.camera, self._waiting
        of_plane = motions_of_plane(now.start_px, now.pixels, camera, self.config.seed)
        used = np.unique(np.linspace(0, len(waiting) - 1, START_KEYFRAMES).astype(int))
        seen = [waiting[n].pixels[np.searchsorted(waiting[n].track, now.point)] for n in used]
        pixels = np.stack([*seen, now.pixels])
        return [judge(motion, pixels, camera) for motion in (*motions, *of_plane)]

    def _initialize(self, started: Start) -> Initialization:
        """Create the map, with keyframes in between: at small angles they contribute as much as the two ends."""
        assert started.cam_from_first is not None and started.points_in_first is not None
        model, waiting = SlamMap(), list(self._waiting)
        points = model.add_points(started.points_in_first, self.tracks.start_px, 0)
        row_of_track = np.full(self._num_at_start, -1)
        row_of_track[self.tracks.point] = points
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
        tracks = Tracks(self.tracks.pixels, points, self.tracks.start_px)
        return Initialization(model, tracks, started.cam_from_first, waiting, row_of_track)


def _too_narrow(angle_deg: float, config: OdometryConfig) -> Start:
    return Start(
        f"triangulation angle {angle_deg:.2f} degrees, {config.start_angle_deg:g} are needed: keep moving"
    )


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
