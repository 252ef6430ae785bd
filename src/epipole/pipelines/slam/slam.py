"""SLAM in one class: `track` takes a frame and says where the camera is; the map grows behind it."""

from __future__ import annotations

import numpy as np

from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.mapping import Disparities, RefinedPose
from epipole.pipelines.slam.anchoring import hold
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.corners import new_corners
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.local_mapping import LocalMapper, is_pinhole
from epipole.pipelines.slam.loop_closing import LoopCandidate, LoopCloser, Tie
from epipole.pipelines.slam.loop_correction import fuse, spread_drift
from epipole.pipelines.slam.path import Path
from epipole.pipelines.slam.place_recognition import describe_keyframe
from epipole.pipelines.slam.relocalizing import relocalize
from epipole.pipelines.slam.revisiting import find_again, tie_together
from epipole.pipelines.slam.single_depth import disparities_of, points_by_disparity
from epipole.pipelines.slam.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.snapshot import Snapshot, snapshot_of
from epipole.pipelines.slam.starting import Begun, OneCameraStart, place_in_map
from epipole.pipelines.slam.tracking import Tracks, locate, predict_pixels
from epipole.scene import Trajectory

LAST_SCALES_PX = (8.0, 2.0, 1.0)
"""Of the loss, in the last rounds: wide at first, so that what has drifted apart is drawn together."""
LOOP_ITERATIONS = 10
"""Of the adjustment of the whole map after a loop; the last frame is followed by a longer one."""
PROVEN_FRAMES = 3
"""In so many a point must have agreed with the others before it decides where the camera is."""
LEAST_KEYFRAMES = 3
"""A map of its own with fewer is given up when the camera is lost again."""


class Slam:
    """Follows a camera, frame by frame, and makes a map. The same frames give the same answers on any machine's load.

    The world is the first frame's camera; its unit is the metre where the camera tells depth, else the median depth of
    the first points. After the camera was lost it is sought in the map; meanwhile a new map begins, which is joined to the
    first when a place is seen again.

    Attributes:
        config: options.
        camera: what is followed.
        maps: the first, in whose world answers are given, and those that are not joined to it yet.
        map: the one that the camera is followed in.
        state: of the last frame.
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
        self.state = TrackingState.STARTING
        self.maps: list[SlamMap] = [SlamMap()]
        self._enter(self.maps[0])
        self._closer = LoopCloser(lens, self.config, is_metric=camera.tells_depth)
        self._start = OneCameraStart(lens, self.config)
        self._tracks = Tracks.none()
        self._before: Frame | None = None
        self._cam_from_world = Rigid3.identity()
        self._path = Path()
        self._num_frames = 0
        self._num_lost = 0
        self._num_at_keyframe = 1
        self._is_stale = np.zeros(0, np.int64)

    @property
    def loops(self) -> list[LoopCandidate]:
        """Every place that looked like one seen before, and what came of it."""
        return self._closer.ledger

    def track(self, frame: Frame) -> TrackedFrame:
        """Where the camera was when this frame was taken.

        Raises:
            ShapeError: the pictures are not of the camera's size.
            ConfigError: the frame is not later than the one before, or lacks what tells depth.
        """
        self.camera.check(frame)
        if self._before is not None and frame.timestamp_s <= self._before.timestamp_s:
            raise ConfigError(
                f"a frame of {frame.timestamp_s:.6f} s comes after one of {self._before.timestamp_s:.6f} s"
            )
        if self.state is TrackingState.STARTING:
            answer = self._begin(frame)
        elif self.state is TrackingState.LOST:
            answer = self._find_place(frame)
        else:
            answer = self._follow(frame)
        self._before = frame
        self._num_frames += 1
        return answer

    # The begin of a map.

    def _begin(self, frame: Frame) -> TrackedFrame:
        """A map from this frame, where it tells depth; else with those that waited before it."""
        if self.camera.tells_depth:
            self._cam_from_world = Rigid3.identity()
            keyframe = self._insert_keyframe(frame, is_first=True)
            if self.map.has_place(keyframe.point).sum() >= self.config.min_tracked:
                return self._begun(frame, np.zeros((6, 6)))
            self.map.clear()
            self._tracks = Tracks.none()
            return self._no_place(frame, "too few points with depth: blank, dark, or nothing in range")
        begun = self._start.add(frame, self._num_frames)
        if isinstance(begun, str):
            return self._no_place(frame, begun, len(self._start.tracks))
        return self._begin_with_one_camera(frame, begun)

    def _begin_with_one_camera(self, frame: Frame, begun: Begun) -> TrackedFrame:
        self.maps[self.maps.index(self.map)] = begun.model
        self._enter(begun.model)
        self._tracks, self._cam_from_world = begun.tracks, begun.cam_from_world
        points = self._tracks.point
        self._insert_keyframe(frame, is_first=True)
        self.mapper.adjust_all()
        self.map.rescale(1.0 / float(np.nanmedian(self.map.xyz[points, 2])))
        newest = self.map.keyframes[-1]
        self._cam_from_world = newest.cam_from_world
        for one, keyframe, place, covariance in begun.place_waiting(self.camera.camera, self.config):
            self._path.add(one.number, one.frame.timestamp_s, keyframe, place, covariance)
        lens, place = self.camera.camera, self._cam_from_world
        here = place_in_map(self.map, newest.point, newest.pixels, place, lens, self.config)
        self._start = OneCameraStart(lens, self.config)
        return self._begun(frame, np.full((6, 6), np.inf) if here is None else here.covariance())

    def _begun(self, frame: Frame, covariance: np.ndarray) -> TrackedFrame:
        for keyframe in self.map.keyframes:
            describe_keyframe(keyframe)
        is_first = self.map is self.maps[0]
        self.state = TrackingState.TRACKING if is_first else TrackingState.SUBMAP
        self._num_lost = 0
        num_points = int(self.map.has_place(self._tracks.point).sum())
        return self._answer(
            frame, covariance, num_points, "the map begins" if is_first else "a new map begins"
        )

    def _enter(self, model: SlamMap) -> None:
        """Go on in this map."""
        self.map = model
        self.mapper = LocalMapper(model, self.camera.camera, self.focal_baseline, self.config)

    # A frame in the map.

    def _follow(self, frame: Frame) -> TrackedFrame:
        """Follow the points, find the pose with which they agree, extend the map where it is needed."""
        assert self._before is not None
        # The last place is the prediction: points that slip along edges stay where they are foretold, and with a constant
        # velocity such a share of the error came back enlarged, from frame to frame.
        predicted = self._cam_from_world
        self._tracks.follow(self._before.grey, frame.grey, self._guess(predicted), self.config, and_back=True)
        self._hold(frame, predicted)
        found = self._locate(frame, predicted) or self._search_wider(frame, predicted)
        if found is None:
            return self._find_place(frame)
        return self._placed(frame, *found)

    def _placed(self, frame: Frame, refined: RefinedPose, num_agreeing: int) -> TrackedFrame:
        self._cam_from_world = refined.cam_from_world
        self.mapper.place_from(self._cam_from_world, self._tracks.point, self._tracks.pixels)
        reason = self._why_keyframe(num_agreeing)
        if reason:
            self._extend(frame)
            reason = self._close_loop() or reason
        return self._answer(frame, refined.covariance(), num_agreeing, reason)

    def _extend(self, frame: Frame) -> None:
        """A keyframe, new points, and the adjustment of the keyframes around it."""
        self._insert_keyframe(frame)
        newest = len(self.map.keyframes) - 1
        self.mapper.triangulate(newest)
        self.mapper.adjust_around(newest)
        self._forget_untracked()
        self._cam_from_world = self.map.keyframes[newest].cam_from_world

    def _hold(self, frame: Frame, predicted: Rigid3) -> None:
        """Place the points by their first looks; those that look otherwise are given up."""
        tracks, lens = self._tracks, self.camera.camera
        tracks.pixels, is_same, self._is_stale = hold(
            self.map, lens, frame.grey, predicted, tracks.point, tracks.pixels
        )
        self._is_stale = tracks.point[self._is_stale]
        tracks.keep(is_same)

    def _search_wider(self, frame: Frame, predicted: Rigid3) -> tuple[RefinedPose, int] | None:
        lens, followed = self.camera.camera, self._tracks.point
        self._tracks.add(*find_again(self.map, lens, frame.grey, predicted, followed, self.config))
        return self._locate(frame, predicted)

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
        proven = self.map.num_agreed[self._tracks.point[placed]] >= PROVEN_FRAMES
        found = locate(points, pixels, self.camera.camera, predicted, deep, self.config, proven)
        if found is None:
            return None
        refined, agrees = found
        kept = np.ones(len(self._tracks.point), bool)
        kept[placed] = agrees
        self.map.num_agreed[self._tracks.point[placed[agrees]]] += 1
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

    # A camera that is lost.

    def _find_place(self, frame: Frame) -> TrackedFrame:
        """The frame's place in one of the maps by what it looks like; else a new map begins."""
        reason = f"{len(self._tracks)} points are followed, too few agree with the map"
        if self.state is not TrackingState.LOST:
            self._lose()
        for model in self.maps:
            again = relocalize(frame.grey, model, self.camera.camera, self.config)
            if again is not None:
                self._enter(model)
                self._tracks = Tracks(again.pixels, again.points, again.pixels)
                found = self._locate(frame, again.cam_from_world)
                if found is not None:
                    is_first = model is self.maps[0]
                    self.state = TrackingState.TRACKING if is_first else TrackingState.SUBMAP
                    self._num_lost = 0
                    return self._placed(frame, *found)
        self._num_lost += 1
        if self._num_lost <= self.config.lost_patience:
            return self._no_place(frame, reason)
        return self._begin_submap(frame, reason)

    def _lose(self) -> None:
        self.state = TrackingState.LOST
        self._closer.forget()
        if self.map is not self.maps[0] and len(self.map.keyframes) < LEAST_KEYFRAMES:
            self.maps.remove(self.map)
            self._path.forget(self.map.keyframes)

    def _begin_submap(self, frame: Frame, reason: str) -> TrackedFrame:
        self.maps.append(SlamMap())
        self._enter(self.maps[-1])
        answer = self._begin(frame)
        if answer.submap_from_body is not None:
            return answer
        self.maps = [m for m in self.maps if m is not self.map]
        self._enter(self.maps[0])
        return self._no_place(frame, f"{reason}; {answer.reason}")

    # Places seen again.

    def _close_loop(self) -> str:
        """Correct the map, or join it to an older one, if the newest keyframe shows a place seen before."""
        describe_keyframe(self.map.keyframes[-1])
        for there in self.maps:
            tie = self._closer.consider(self.map, there)
            if tie is not None and (self._joined(tie) if there is not self.map else self._corrected(tie)):
                self._closer.forget()
                return "a place seen before"
        return ""

    def _corrected(self, tie: Tie) -> bool:
        if not spread_drift(self.map, tie, is_metric=self.camera.tells_depth):
            self._closer.reject_last("the pose graph does not agree")
            return False
        self._settle()
        return True

    def _joined(self, tie: Tie) -> bool:
        # The older map stays, with its world.
        here, there = self.map, tie.there
        if self.maps.index(there) < self.maps.index(here):
            here.move(tie.there_from_here)
            self._tracks.point = self._tracks.point + there.absorb(here)
            self.maps.remove(here)
            self._enter(there)
        else:
            there.move(tie.there_from_here.inverse())
            here.absorb(there)
            self.maps.remove(there)
        if self.map is self.maps[0]:
            self.state = TrackingState.TRACKING
        self._settle()
        return True

    def _settle(self) -> None:
        """After a correction: what was seen twice becomes one, and the whole map is adjusted."""
        newest = len(self.map.keyframes) - 1
        window, _ = self.mapper.window_of(newest)
        into = fuse(self.map, window[::-1], self.camera.camera, self.config)
        self.mapper.adjust_around(newest)
        self.mapper.adjust_all(max_iterations=LOOP_ITERATIONS)
        self._tracks.rename(into)
        self._forget_untracked()
        self._cam_from_world = self.map.keyframes[-1].cam_from_world

    # Keyframes.

    def _insert_keyframe(self, frame: Frame, *, is_first: bool = False) -> Keyframe:
        """A keyframe at the present place: points in sight, older points found again, and new ones."""
        lens, place = self.camera.camera, self._cam_from_world
        if not is_first:
            self._tracks.add(*find_again(self.map, lens, frame.grey, place, self._tracks.point, self.config))
        elif self.camera.tells_depth:
            self._tracks = Tracks.none()
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
        if self.focal_baseline is None:
            return np.full((len(pixels), 3), np.nan)
        lens, most = self.camera.camera, self.config.max_depth_baselines
        in_cam = points_by_disparity(pixels, disparity, lens, self.focal_baseline, most)
        return self._cam_from_world.inverse().apply(in_cam)

    def _forget_untracked(self) -> None:
        """Stop following points whose observation in the newest keyframe was a mistake."""
        self._tracks.keep(np.isin(self._tracks.point, self.map.keyframes[-1].point))

    # Answers.

    def _answer(self, frame: Frame, covariance: np.ndarray, num_points: int, reason: str) -> TrackedFrame:
        newest = self.map.keyframes[-1]
        self._path.add(self._num_frames, frame.timestamp_s, newest, self._cam_from_world, covariance)
        place, is_first = self._cam_from_world.inverse(), self.map is self.maps[0]
        return TrackedFrame(
            *(frame.timestamp_s, self.state, reason, place if is_first else None, covariance, num_points),
            is_keyframe=newest.number == self._num_frames,
            submap_from_body=None if is_first else place,
        )

    def _no_place(self, frame: Frame, reason: str, num_points: int | None = None) -> TrackedFrame:
        count = len(self._tracks) if num_points is None else num_points
        return TrackedFrame(frame.timestamp_s, self.state, reason, None, None, count, is_keyframe=False)

    def finish(self) -> None:
        """After the last frame: tie keyframes together that see the same, and adjust the whole of every map."""
        here = self.map
        for model in self.maps:
            if len(model.keyframes) < 2:
                continue
            self._enter(model)
            self.mapper.adjust_all()
            for loss_scale_px in LAST_SCALES_PX:
                tie_together(model, self.camera.camera, self.config)
                self.mapper.adjust_all(loss_scale_px)
        self._enter(here)

    def trajectory(self, number: int = 0) -> Trajectory:
        """Every frame that has a place in one of the maps, the first unless told, by the map as it is now."""
        return self._path.trajectory(self.maps[number].keyframes)

    def snapshot(self) -> Snapshot:
        """Map and followed points as they are now, to be shown."""
        is_starting = self.state is TrackingState.STARTING and not self.camera.tells_depth
        return snapshot_of(self.map, self.state, self._start.tracks if is_starting else self._tracks)
