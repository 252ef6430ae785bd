"""SLAM in one class: `track` takes a frame and says where the camera is; the map grows behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.mapping import Disparities, RefinedPose
from epipole.pipelines.slam.anchoring import hold
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.corners import new_corners
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.local_mapping import LocalMapper, is_pinhole
from epipole.pipelines.slam.relocalizing import Relocalizer
from epipole.pipelines.slam.revisiting import find_again, tie_together
from epipole.pipelines.slam.single_depth import disparities_of
from epipole.pipelines.slam.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.snapshot import Snapshot, snapshot_of
from epipole.pipelines.slam.starting import Start, try_start
from epipole.pipelines.slam.tracking import Tracks, locate, predict_pixels
from epipole.scene import Trajectory

START_KEYFRAMES = 6
LAST_SCALES_PX = (8.0, 2.0, 1.0)
"""Of the loss, in the last rounds: wide at first, so that what has drifted apart is drawn together."""
MOST_WAITING = 300
"""Frames before the map's begin that are kept, to get their places once it has begun."""


@dataclass(slots=True, eq=False)
class _Placed:
    """A frame in the final trajectory: its place is told from its keyframe, which goes on to be adjusted."""

    timestamp_s: float
    keyframe: int
    cam_from_keyframe: Rigid3
    covariance: np.ndarray


class Slam:
    """Follows a camera, frame by frame, and makes a map. The same frames give the same answers on any machine's load.

    The world is the first frame's camera; its unit is the metre where the camera tells depth, else the median depth of
    the first points.
    """

    def __init__(self, camera: SlamCamera, config: SlamConfig | None = None) -> None:
        self.config = SlamConfig() if config is None else config
        self.camera = camera
        lens, baseline = camera.camera, camera.baseline
        if camera.depth is not None:
            baseline = self.config.sensor_baseline_m
        if baseline is not None and not is_pinhole(lens):
            raise ConfigError(
                "with depth, or a second camera, pictures are undistorted and the camera a PINHOLE"
            )
        self.focal_baseline = None if baseline is None else lens.focal_px * baseline
        self.map = SlamMap()
        self.mapper = LocalMapper(self.map, lens, self.focal_baseline, self.config)
        self.state = TrackingState.STARTING
        self._relocalizer = Relocalizer(self.map, lens, self.config)
        self._tracks = Tracks.none()
        self._before: Frame | None = None
        self._cam_from_world = Rigid3.identity()
        self._placed: list[_Placed] = []
        self._waiting: list[tuple[Frame, np.ndarray, np.ndarray]] = []
        self._num_frames = 0
        self._is_stale = np.zeros(0, np.int64)

    def track(self, frame: Frame) -> TrackedFrame:
        """Where the camera was when this frame was taken.

        Raises:
            ShapeError: the pictures are not of the camera's size.
            ConfigError: the frame is not later than the one before, or lacks what tells depth.
        """
        self._check(frame)
        if self.state is TrackingState.STARTING:
            answer = self._begin(frame)
        else:
            answer = self._follow(frame)
        self._before = frame
        self._num_frames += 1
        return answer

    def _check(self, frame: Frame) -> None:
        lens = self.camera.camera
        if frame.grey.shape != (lens.height, lens.width):
            raise ShapeError(
                f"the picture is {frame.grey.shape[1]} x {frame.grey.shape[0]}, the camera's {lens.width} x {lens.height}"
            )
        if self._before is not None and frame.timestamp_s <= self._before.timestamp_s:
            raise ConfigError(
                f"a frame of {frame.timestamp_s:.6f} s comes after one of {self._before.timestamp_s:.6f} s"
            )
        if self.camera.baseline is not None and frame.right_grey is None:
            raise ConfigError("a frame of a stereo camera needs its right picture")
        if self.camera.depth is None:
            return
        if frame.depth is None:
            raise ConfigError("a frame of a depth camera needs its depth")
        sensor = self.camera.depth.camera
        if frame.depth.shape != (sensor.height, sensor.width):
            size = f"{frame.depth.shape[1]} x {frame.depth.shape[0]}"
            raise ShapeError(f"the depth is {size}, the depth camera's {sensor.width} x {sensor.height}")

    # The begin of the map.

    def _begin(self, frame: Frame) -> TrackedFrame:
        if self.camera.tells_depth:
            self._cam_from_world = Rigid3.identity()
            keyframe = self._insert_keyframe(frame, None)
            if self.map.has_place(keyframe.point).sum() >= self.config.min_tracked:
                self.state = TrackingState.TRACKING
                return self._answer(frame, np.zeros((6, 6)), len(keyframe.point), "the first frame")
            self.map.clear()
            return self._no_place(frame, "too few points with depth: blank, dark, or nothing in range")
        return self._begin_with_one_camera(frame)

    def _begin_with_one_camera(self, frame: Frame) -> TrackedFrame:
        if self._before is None or not self._waiting:
            return self._wait_from(frame, "the first frame: depth needs a second place")
        self._tracks.follow(self._before.grey, frame.grey, self._tracks.pixels, self.config, and_back=True)
        started = try_start(self._tracks.start_px, self._tracks.pixels, self.camera.camera, self.config)
        if started.cam_from_first is not None:
            return self._start_map(frame, started)
        self._waiting.append((frame, self._tracks.pixels, self._tracks.point))
        is_thin = len(self._tracks.pixels) < 0.4 * self._num_at_start
        if is_thin or len(self._waiting) > MOST_WAITING:
            return self._wait_from(frame, started.reason)
        return self._no_place(frame, started.reason)

    def _wait_from(self, frame: Frame, reason: str) -> TrackedFrame:
        """Begin to wait for a second place, apart from this frame's."""
        corners = new_corners(frame.grey, np.zeros((0, 2)), self.config)
        self._tracks = Tracks(corners, np.arange(len(corners)), corners)
        self._num_at_start = len(corners)
        self._waiting = [(frame, corners, self._tracks.point)]
        return self._no_place(frame, reason)

    def _start_map(self, frame: Frame, started: Start) -> TrackedFrame:
        """Keyframes from the first to this one, adjusted together, and places for the frames between them.

        At a narrow angle the many frames in between tell as much as the two at the ends.
        """
        assert started.cam_from_first is not None and started.points_in_first is not None
        waiting, self._waiting = self._waiting, []
        points = self.map.add_points(started.points_in_first, self._tracks.start_px, 0)
        row_of_track = np.full(self._num_at_start, -1)
        row_of_track[self._tracks.point] = points
        number = self._num_frames - len(waiting)
        chosen = np.unique(np.linspace(0, len(waiting) - 1, START_KEYFRAMES).astype(int))
        place = Rigid3.identity()
        for n in chosen:
            then, pixels, track = waiting[n]
            rows = row_of_track[track]
            kept = rows >= 0
            found = self._place_in_map(rows[kept], pixels[kept], place)
            place = found.cam_from_world if found is not None and n > 0 else place
            none = np.full(int(kept.sum()), np.nan)
            self.map.keyframes.append(
                Keyframe(
                    number + int(n),
                    then.timestamp_s,
                    then.grey,
                    place,
                    Observations(pixels[kept], none, rows[kept]),
                )
            )
        self._tracks.point = points
        self._cam_from_world = started.cam_from_first
        self.state = TrackingState.TRACKING
        self._insert_keyframe(frame, None)
        self.mapper.adjust_all()
        self.map.rescale(1.0 / float(np.nanmedian(self.map.xyz[points, 2])))
        self._cam_from_world = self.map.keyframes[-1].cam_from_world
        self._placed += self._place_waiting(waiting, chosen, row_of_track)
        newest = self.map.keyframes[-1]
        here = self._place_in_map(newest.point, newest.pixels, self._cam_from_world)
        covariance = np.full((6, 6), np.inf) if here is None else here.covariance()
        return self._answer(frame, covariance, int(self.map.has_place(points).sum()), "the map begins")

    def _place_in_map(self, rows: np.ndarray, pixels: np.ndarray, start: Rigid3) -> RefinedPose | None:
        kept = self.map.has_place(rows)
        found = locate(self.map.xyz[rows[kept]], pixels[kept], self.camera.camera, start, None, self.config)
        return None if found is None else found[0]

    def _place_waiting(
        self,
        waiting: list[tuple[Frame, np.ndarray, np.ndarray]],
        chosen: np.ndarray,
        row_of_track: np.ndarray,
    ) -> list[_Placed]:
        """Places of the frames that came before the map had begun; each sought from that of the keyframe before."""
        out = []
        for n, (frame, pixels, track) in enumerate(waiting):
            keyframe = int(np.searchsorted(chosen, n, side="right")) - 1
            start = self.map.keyframes[keyframe].cam_from_world
            rows = row_of_track[track]
            found = self._place_in_map(rows[rows >= 0], pixels[rows >= 0], start)
            if found is not None:
                place = start if n == chosen[keyframe] else found.cam_from_world
                out.append(_Placed(frame.timestamp_s, keyframe, place @ start.inverse(), found.covariance()))
        return out

    # A frame in the map.

    def _follow(self, frame: Frame) -> TrackedFrame:
        assert self._before is not None
        # The last place is the prediction: points that slip along edges stay where they are foretold, and with a constant
        # velocity such a share of the error came back enlarged, from frame to frame.
        predicted = self._cam_from_world
        self._tracks.follow(self._before.grey, frame.grey, self._guess(predicted), self.config, and_back=True)
        self._hold(frame, predicted)
        found = self._locate(frame, predicted)
        if found is None and self.state is TrackingState.TRACKING:
            again = find_again(
                self.map, self.camera.camera, frame.grey, predicted, self._tracks.point, self.config
            )
            self._tracks.add(*again)
            found = self._locate(frame, predicted)
        if found is None:
            found = self._relocate(frame)
        if found is None:
            self.state = TrackingState.LOST
            return self._no_place(
                frame, f"{len(self._tracks.pixels)} points are followed, too few agree with the map"
            )
        self.state = TrackingState.TRACKING
        refined, num_agreeing = found
        self._cam_from_world = refined.cam_from_world
        self.mapper.place_from(self._cam_from_world, self._tracks.point, self._tracks.pixels)
        reason = self._why_keyframe(num_agreeing)
        if reason:
            self._insert_keyframe(frame, refined)
            newest = len(self.map.keyframes) - 1
            self.mapper.triangulate(newest)
            self.mapper.adjust_around(newest)
            self._forget_untracked()
            self._cam_from_world = self.map.keyframes[newest].cam_from_world
        return self._answer(frame, refined.covariance(), num_agreeing, reason)

    def _hold(self, frame: Frame, predicted: Rigid3) -> None:
        """Place the points by their first looks; those that look otherwise are given up."""
        tracks, lens = self._tracks, self.camera.camera
        tracks.pixels, is_same, self._is_stale = hold(
            self.map, lens, frame.grey, predicted, tracks.point, tracks.pixels
        )
        self._is_stale = tracks.point[self._is_stale]
        tracks.keep(is_same)

    def _relocate(self, frame: Frame) -> tuple[RefinedPose, int] | None:
        """The frame's pose by descriptors, wherever it is in the map; it then follows the points that were found."""
        again = self._relocalizer.find(frame.grey)
        if again is None:
            return None
        place, pixels, points = again
        self._tracks = Tracks(pixels, points, pixels)
        self._tracks.add(*find_again(self.map, self.camera.camera, frame.grey, place, points, self.config))
        return self._locate(frame, place)

    def _guess(self, predicted: Rigid3) -> np.ndarray:
        points = self.map.xyz[self._tracks.point]
        return predict_pixels(
            self._tracks.pixels, points, self._cam_from_world, predicted, self.camera.camera
        )

    def _locate(self, frame: Frame, predicted: Rigid3) -> tuple[RefinedPose, int] | None:
        """The frame's pose; points that do not agree are given up."""
        placed = np.flatnonzero(self.map.has_place(self._tracks.point))
        points, pixels = self.map.xyz[self._tracks.point[placed]], self._tracks.pixels[placed]
        deep = None
        if frame.depth is not None and self.focal_baseline is not None:
            measured = disparities_of(frame, pixels, np.full(len(pixels), np.nan), self.camera, self.config)
            deep = Disparities(measured, self.focal_baseline, self.config.depth_sigma_px)
        found = locate(points, pixels, self.camera.camera, predicted, deep, self.config)
        if found is None:
            return None
        refined, agrees = found
        kept = np.ones(len(self._tracks.point), bool)
        kept[placed] = agrees
        self._tracks.keep(kept)
        return refined, int(agrees.sum())

    def _why_keyframe(self, num_agreeing: int) -> str:
        """Why this frame should be a keyframe; empty if it need not."""
        last = self.map.keyframes[-1]
        if num_agreeing < self.config.keyframe_share * self._num_at_keyframe:
            return "fewer points in sight"
        if num_agreeing < self.config.keyframe_points and self._num_frames - last.number >= 3:
            return "few points in sight"
        if self._tracks.shift_px() > self.config.keyframe_motion * self.camera.camera.width:
            return "the points have moved"
        if self._num_frames - last.number >= self.config.keyframe_gap:
            return "time has passed"
        return ""

    # Keyframes.

    def _insert_keyframe(self, frame: Frame, refined: RefinedPose | None) -> Keyframe:
        """A keyframe at the present place: points in sight, older points found again, and new ones."""
        lens, place = self.camera.camera, self._cam_from_world
        if refined is not None:
            self._tracks.add(*find_again(self.map, lens, frame.grey, place, self._tracks.point, self.config))
        corners = new_corners(frame.grey, self._tracks.pixels, self.config)
        number = len(self.map.keyframes)
        pixels = np.concatenate([self._tracks.pixels, corners])
        points = np.concatenate([self._tracks.point, np.full(len(corners), -1)])
        disparity = self._disparities(frame, pixels, points)
        fresh = points < 0
        points[fresh] = self.map.add_points(
            self._from_depth(pixels[fresh], disparity[fresh]), pixels[fresh], number
        )
        lacking = ~self.map.has_place(points) & ~fresh
        self.map.xyz[points[lacking]] = self._from_depth(pixels[lacking], disparity[lacking])
        seen = Observations(pixels, disparity, points)
        keyframe = Keyframe(self._num_frames, frame.timestamp_s, frame.grey, place, seen)
        self.map.keyframes.append(keyframe)
        stale = np.isin(points, self._is_stale)
        self.map.anchor[points[stale]], self.map.anchor_px[points[stale]] = number, pixels[stale]
        self._is_stale = np.zeros(0, np.int64)
        self._tracks = Tracks(pixels.copy(), points.copy(), pixels.copy())
        self._num_at_keyframe = max(int(self.map.has_place(points).sum()), 1)
        return keyframe

    def _disparities(self, frame: Frame, pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
        if self.focal_baseline is None:
            return np.full(len(pixels), np.nan)
        guess = np.full(len(pixels), np.nan)
        known = points >= 0
        depth = self._cam_from_world.apply(self.map.xyz[points[known]])[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            guess[known] = np.where(depth > 0, self.focal_baseline / depth, np.nan)
        return disparities_of(frame, pixels, guess, self.camera, self.config)

    def _from_depth(self, pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """Places of points by their disparities at the present place; NaN without one, or where it says little."""
        out = np.full((len(pixels), 3), np.nan)
        if self.focal_baseline is None or not len(pixels):
            return out
        lens = self.camera.camera
        least = lens.focal_px / self.config.max_depth_baselines
        near = np.flatnonzero(disparity >= least)
        rays = lens.unproject(pixels[near])
        in_cam = rays / rays[:, 2:] * (self.focal_baseline / disparity[near])[:, None]
        out[near] = self._cam_from_world.inverse().apply(in_cam)
        return out

    def _forget_untracked(self) -> None:
        """Stop following points whose observation in the newest keyframe was a mistake."""
        self._tracks.keep(np.isin(self._tracks.point, self.map.keyframes[-1].point))

    # Answers.

    def _answer(self, frame: Frame, covariance: np.ndarray, num_points: int, reason: str) -> TrackedFrame:
        newest = len(self.map.keyframes) - 1
        relative = self._cam_from_world @ self.map.keyframes[newest].cam_from_world.inverse()
        self._placed.append(_Placed(frame.timestamp_s, newest, relative, covariance))
        is_keyframe = self.map.keyframes[newest].number == self._num_frames
        place = self._cam_from_world.inverse()
        return TrackedFrame(
            *(frame.timestamp_s, self.state, reason, place, covariance, num_points, is_keyframe),
        )

    def _no_place(self, frame: Frame, reason: str) -> TrackedFrame:
        num_points = len(self._tracks.pixels)
        return TrackedFrame(frame.timestamp_s, self.state, reason, None, None, num_points, is_keyframe=False)

    def finish(self) -> None:
        """After the last frame: tie keyframes together that see the same, and adjust the whole map."""
        if len(self.map.keyframes) < 2:
            return
        self.mapper.adjust_all()
        for loss_scale_px in LAST_SCALES_PX:
            tie_together(self.map, self.camera.camera, self.config)
            self.mapper.adjust_all(loss_scale_px)

    def trajectory(self) -> Trajectory:
        """Every frame that has a place, by the map as it is now."""
        keyframes = [k.cam_from_world for k in self.map.keyframes]
        places = [(p.cam_from_keyframe @ keyframes[p.keyframe]).inverse() for p in self._placed]
        if not places:
            return Trajectory(np.zeros(0), Rigid3.identity(0), np.zeros((0, 6, 6)))
        return Trajectory(
            np.array([p.timestamp_s for p in self._placed]),
            Rigid3(np.stack([p.rotation for p in places]), np.stack([p.translation for p in places])),
            np.stack([p.covariance for p in self._placed]),
        )

    def snapshot(self) -> Snapshot:
        """Map and followed points as they are now, to be shown."""
        return snapshot_of(self.map, self.state, self._tracks)
