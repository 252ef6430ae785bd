"""Local mapping: bundle adjustment of a window of keyframes, and removal of outliers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from epipole.cameras import CameraModel
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    BundleResult,
    Loss,
    adjust_bundle,
    with_fixed_gauge,
)
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.covariance import CalibrationSigma, add_calibration_error, learn_covariances
from epipole.pipelines.slam.map.gauge import align_gauge
from epipole.pipelines.slam.map.imu import InertialConstraints, pixel_variance
from epipole.pipelines.slam.map.imu_clock import CameraImu
from epipole.pipelines.slam.map.outliers import remove_outliers
from epipole.pipelines.slam.map.pair_adjustment import adjust_pair
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.map.triangulation import positions_of
from epipole.pipelines.slam.shutter.motion import straighten
from epipole.pipelines.slam.tracking.redetection import link_tracks
from epipole.scene import CameraRig

LOSS_SCALE_PX = 1.0
LAST_SCALES_PX, SCALES_OF_NOISE_PX = (8.0, 2.0), (1.0, 0.5)
"""Loss scales of the last rounds: wide at first, to pull together what has drifted apart; then that of the noise, with a stereo pair and
without. Residuals are 0.2 to 0.6 px, but the size of a stereo map should depend on all disparities."""
FIRST_WITH_IMU = 30
"""Iterations of the first adjustment with an IMU, whose measurements are much more accurate than the rotations until then."""
LEARN_EVERY = 5
"""Keyframes between attempts to align a metric map with the IMU."""
IN_TIME = 4
"""Keyframes before the newest that are adjusted with it if an IMU connects them."""
FIRST_OPTIMIZED = 6
"""Keyframes of a new map."""
START_ROUNDS = 3
"""Rounds of linking and adjusting at the start of a map of cameras without a common view."""
GROWTH = 1.25
"""All keyframes are adjusted again when their number has grown by this factor."""
LAST_STEPS = 3 + 2 * len(LAST_SCALES_PX)
COVARIANCES_EVERY = 3
"""Keyframes between computations of the covariances, which are propagated meanwhile."""
MOST_CONSTRAINED = 30
"""Largest single-camera map in which all keyframes are linked to the points in sight again, at 12 ms each."""
LEAST_TOGETHER = 8
"""Fewest keyframes, adjusted jointly, from which the second camera's principal point is estimated."""
SHIFT_SIGMA_PX = 0.3
"""Standard deviation of a pair's rectification along the rows."""


class Adjusted(NamedTuple):
    """An adjusted problem, in the map's world."""

    problem: BundleProblem
    result: BundleResult
    config: BundleConfig
    views: list[int]


class LocalMapper:
    """Adjusts a map. Measured depth enters as an observation of a second camera beside the first."""

    def __init__(
        self,
        model: SlamMap,
        sensor: SlamCamera,
        focal_baseline: float | None,
        config: OdometryConfig,
        imu: CameraImu | None = None,
    ) -> None:
        self.map, self.sensor, self.camera, self.config = model, sensor, sensor.camera_or_rig, config
        self.focal_baseline = focal_baseline
        """Focal length times baseline; None for a single camera and for a rig."""
        self.is_metric = sensor.is_metric
        self.positions: dict[int, np.ndarray] = {}
        """Measured camera positions in the world by frame number; used when all keyframes are adjusted."""
        self.position_sigma = 1.0
        self.inertial = None if imu is None else InertialConstraints(imu, is_metric=self.is_metric)
        self.goes_on: Callable[[], bool] = lambda: True
        """Asked after every step of an adjustment, which it ends by returning False."""
        self.num_optimized = FIRST_OPTIMIZED
        """Number of keyframes when all were last adjusted."""

    def window_of(self, newest: int) -> tuple[list[int], list[int]]:
        """Keyframes with most points in common with the newest, and the fixed ones with points in common with these."""
        # The scale of a single camera drifts in a narrow window.
        width = self.config.window * (1 if self.is_metric else 2)
        shared = self.map.num_shared([newest])
        shared[newest] = len(self.map.xyz) + 1
        if self.inertial is not None and self.inertial.aligned is not None:
            shared[max(newest - IN_TIME, 0) : newest] = len(self.map.xyz) + 1
        order = np.argsort(-shared, kind="stable")[:width]
        window = sorted(int(k) for k in order if shared[k] > 0)
        shared = self.map.num_shared(window)
        shared[window] = 0
        order = np.argsort(-shared, kind="stable")[: self.config.max_fixed]
        return window, sorted(int(k) for k in order if shared[k] > 0)

    def adjust_around(self, newest: int) -> None:
        """Adjust the window of the newest keyframe, with the keyframes around it fixed.

        Each time the map has grown by a quarter, all of it is adjusted: amortized, five adjustments per keyframe at any map size.
        For a single camera, keyframes (in a large map only the new ones) are first linked to all points in sight, since only
        points seen from many sides preserve the scale.
        """
        if len(self.map.keyframes) >= GROWTH * self.num_optimized:
            since, self.num_optimized = self.num_optimized, len(self.map.keyframes)
            if not self.is_metric:
                first = since if len(self.map.keyframes) > MOST_CONSTRAINED else 0
                link_tracks(
                    self.map, self.camera, takewhile(lambda _: self.goes_on(), self.map.keyframes[first:])
                )
            self.adjust_all(max_iterations=8)
            if self.goes_on() and self.learn_inertial():
                self.adjust_all(max_iterations=FIRST_WITH_IMU)
            # An adjustment that was ended early is not repeated before the next growth: with one camera, mapping would fall behind.
            return
        # In meters any motion shows gravity; with one camera an attempt often fails, and takes half a second.
        is_due = self.is_metric and len(self.map.keyframes) % LEARN_EVERY == 0
        if is_due and self.learn_inertial():
            self.adjust_all(max_iterations=FIRST_WITH_IMU)
            return
        window, fixed = self.window_of(newest)
        self.adjust(window, fixed, 8)

    def adjust_all(self, loss_scale_px: float = LOSS_SCALE_PX, max_iterations: int = 40) -> Adjusted | None:
        """Adjust all keyframes and points."""
        return self.adjust(list(range(len(self.map.keyframes))), [], max_iterations, loss_scale_px)

    def adjust_start(self) -> None:
        """Adjust the first keyframes of cameras without a common view, whose scale is only known to some percent.

        Linked to the points of all keyframes, they determine it better; it converges slowly.
        """
        for _ in range(START_ROUNDS):
            link_tracks(self.map, self.camera, self.map.keyframes)
            self.adjust_all()

    def adjust_for_good(self, number: int, count: int, goes_on: Callable[[int, int], bool]) -> bool:
        """Final adjustment after the last frame: alternately link keyframes to the points in sight and adjust everything.

        Args:
            number: index of the map among those adjusted.
            count: number of those maps.
            goes_on: called with the number of finished steps and of all steps; returning False stops the adjustment.

        Returns:
            whether all steps were done.
        """
        if len(self.map.keyframes) < 2:
            return True
        adjusted = self.adjust_all()
        self.learn_inertial(is_last=True)
        done, total = number * LAST_STEPS + 1, count * LAST_STEPS
        for loss_scale_px in (*LAST_SCALES_PX, SCALES_OF_NOISE_PX[self.sensor.baseline is None]):
            if not goes_on(done, total):
                break
            link_tracks(self.map, self.camera, self.map.keyframes)
            if not goes_on(done + 1, total):
                break
            adjusted = self.adjust_all(loss_scale_px)
            done += 2
        if adjusted is not None and self.is_metric:
            views, sigma = adjusted.views, CalibrationSigma.of(self.sensor, self.config)
            add_calibration_error([self.map.keyframes[k] for k in views], *adjusted[:3], sigma)
        return done == (number + 1) * LAST_STEPS and goes_on(done, total)

    def adjust(
        self, window: list[int], fixed: list[int], max_iterations: int, loss_scale_px: float = LOSS_SCALE_PX
    ) -> Adjusted | None:
        """Adjust a window of keyframes and their points with other keyframes fixed, and remove outliers.

        Returns:
            the adjusted problem and its minimum; None if there was nothing to adjust.
        """
        # Rotation-only keyframes observe no triangulated point.
        window = [k for k in window if self.map.is_triangulated(self.map.keyframes[k].point).any()]
        if len(window) < 2:
            return None
        views = [*window, *fixed]
        if self.sensor.shutter.is_rolling:
            for keyframe in (self.map.keyframes[k] for k in views):
                straighten(self.map, keyframe, self.sensor.shutter, self.config.min_tracked)
        rows, problem = self._built(window, views)
        if not len(rows):
            return None
        config = BundleConfig(
            loss=Loss.CAUCHY,
            loss_scale_px=loss_scale_px,
            max_iterations=max_iterations,
            function_tolerance=1e-3,
        )
        problem, result = self._adjusted(problem, views, config)
        if self.focal_baseline is not None:
            self.map.right_shift_px = float(result.camera_params[1, 2] - self.sensor.camera.params[2])
        # Align an unconstrained map to its previous poses, so that poses already returned stay valid.
        if not self.is_metric and not fixed and not self.positions:
            back = align_gauge(result.rig_from_world, positions_of(self.map, window))
            result = replace(
                result,
                rig_from_world=back.move_cam_from_source(result.rig_from_world),
                points_in_world=back.apply(result.points_in_world),
            )
        for position, k in enumerate(window):
            self.map.keyframes[k].cam_from_world = result.rig_from_world[position]
        if self.inertial is not None:
            self.map.by_imu = self.inertial.shown_by(self.map.by_imu, problem, result, config)
        is_due = len(self.map.keyframes) % COVARIANCES_EVERY == 0 or len(window) == len(self.map.keyframes)
        if self.is_metric and is_due:
            learn_covariances([self.map.keyframes[k] for k in views], len(window), problem, result, config)
        self.map.xyz[rows] = result.points_in_world
        remove_outliers(self.map, self.camera, views, max(self.config.max_error_px, 2.0 * loss_scale_px))
        return Adjusted(problem, result, config, views)

    def cost_of(self, window: list[int]) -> float:
        """Final cost of an adjustment of keyframes; the map is not changed."""
        problem = self.problem_of(window)
        config = BundleConfig(loss=Loss.CAUCHY, max_iterations=15, function_tolerance=1e-4)
        return 0.0 if problem is None else adjust_bundle(problem, config).final_cost

    def problem_of(self, window: Sequence[int]) -> BundleProblem | None:
        """The adjustment of keyframes and their points; None if there is nothing to adjust."""
        window = [k for k in window if self.map.is_triangulated(self.map.keyframes[k].point).any()]
        if not window:
            return None
        rows, problem = self._built(window, window)
        return problem if len(rows) else None

    def _built(self, window: list[int], views: list[int]) -> tuple[np.ndarray, BundleProblem]:
        """Rows of the points that take part, and the problem of the views, of which those in the window are free."""
        is_seen = (self.map.counts(window) > 0) & np.isfinite(self.map.xyz[:, 0])
        frame, point, pixels, disparity = self._observations(views, is_seen)
        enough = np.bincount(point, 1.0 + np.isfinite(disparity), len(is_seen)) >= 2
        kept = enough[point]
        rows, local = np.unique(point[kept], return_inverse=True)
        seen = frame[kept], local, pixels[kept], disparity[kept]
        return rows, self._fixed(self._problem(views, len(window), rows, seen))

    def _fixed(self, problem: BundleProblem) -> BundleProblem:
        """The problem with its gauge fixed: one pose, and for a single camera the scale."""
        is_fixed = (~problem.frame_free.any(axis=1)).any()
        if not self.is_metric:
            return with_fixed_gauge(problem)
        if not is_fixed:
            problem.frame_free[0] = 0.0
        return problem

    def _adjusted(
        self, problem: BundleProblem, views: list[int], config: BundleConfig
    ) -> tuple[BundleProblem, BundleResult]:
        """Adjust with the IMU factors between the views, or without them if they contradict the images."""
        if self.inertial is None:
            return adjust_pair(problem, config, self.goes_on)
        keyframes = [self.map.keyframes[k] for k in views]
        paths = self.inertial.factors(keyframes, pixel_variance(problem, self.sensor.camera))
        if paths:
            constrained = replace(problem, priors=replace(problem.priors or BundlePriors(), paths=paths))
            with suppress(DegenerateGeometryError):
                constrained, result = adjust_pair(constrained, config, self.goes_on)
                if self.inertial.agrees(paths, result.rig_from_world):
                    return constrained, result
        return adjust_pair(problem, config, self.goes_on)

    def learn_inertial(self, *, is_last: bool = False) -> bool:
        """Align the map with the IMU, if any; whether it is aligned for the first time.

        Args:
            is_last: there will be no more keyframes.
        """
        if self.inertial is None or self.inertial.aligned is not None:
            return False
        seen = [k for k in self.map.keyframes if self.map.is_triangulated(k.point).any()]
        self.inertial.learn(seen, is_last=is_last)
        self.map.by_imu = self.inertial.shown_at_first()
        return self.inertial.aligned is not None

    def _observations(
        self, views: list[int], is_wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        parts = []
        for position, k in enumerate(views):
            own = self.map.keyframes[k]
            mask = is_wanted[own.point]
            parts.append(
                (
                    np.full(int(mask.sum()), position),
                    own.point[mask],
                    own.straight_px[mask],
                    own.straight_disparity_px[mask],
                )
            )
        return tuple(np.concatenate(column) for column in zip(*parts))  # type: ignore[return-value]

    def _problem(
        self, views: list[int], num_free: int, rows: np.ndarray, seen: tuple[np.ndarray, ...]
    ) -> BundleProblem:
        frame, point, pixels, disparity = seen
        sensor = np.zeros(len(frame), np.int32)
        if isinstance(self.camera, CameraRig):
            sensor = self.camera.camera_of(pixels).astype(np.int32)
        deep = np.flatnonzero(np.isfinite(disparity))
        frame, point = np.concatenate([frame, frame[deep]]), np.concatenate([point, point[deep]])
        beside = pixels[deep] - np.stack([disparity[deep], np.zeros(len(deep))], axis=1)
        pixels = np.concatenate([pixels, beside])
        sensor = np.concatenate([sensor, np.ones(len(deep), np.int32)])
        order = np.argsort(point, kind="stable")
        free = np.zeros((len(views), 6))
        free[:num_free] = 1.0
        mounted, models, params = self._cameras()
        params, params_free, priors = self._right_camera(params, views, num_free)
        return BundleProblem(
            positions_of(self.map, views),
            mounted,
            models,
            params,
            self.map.xyz[rows].copy(),
            np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(rows)))]).astype(np.int64),
            frame[order].astype(np.int32),
            sensor[order],
            sensor[order],
            pixels[order],
            free,
            params_free,
            np.ones(len(rows)),
            priors=priors,
        )

    def _cameras(self) -> tuple[Rigid3, np.ndarray, np.ndarray]:
        """Mountings, models and parameters: of a rig's cameras, or of the camera and the second one beside it."""
        if isinstance(self.camera, CameraRig):
            models = np.array([int(one.model) for one in self.camera.cameras], np.int32)
            return self.camera.cam_from_rig, models, self.camera.padded_params()
        baseline = 0.0 if self.focal_baseline is None else self.focal_baseline / self.camera.focal_px
        beside = Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [-baseline, 0.0, 0.0]]))
        models = np.full(2, int(self.camera.model), np.int32)
        return beside, models, np.tile(self.camera.padded_params(), (2, 1))

    def _right_camera(
        self, params: np.ndarray, views: list[int], num_free: int
    ) -> tuple[np.ndarray, np.ndarray, BundlePriors | None]:
        """Parameters of both cameras, which of them are free, and their priors.

        A bias of all disparities bends the scene, which makes it observable from the motion: if all keyframes of a pair are
        adjusted jointly, so is the second camera's principal point.
        """
        shifted, free = params.copy(), np.zeros(params.shape)
        shifted[1, 2] += self.map.right_shift_px
        if num_free < len(views):
            return shifted, free, None
        if self.positions:
            return shifted, free, self._known_poses(views)
        if self.sensor.baseline is None or num_free < LEAST_TOGETHER:
            return shifted, free, None
        free[1, 2] = 1.0
        sigma = np.full(params.shape, np.inf)
        sigma[1, 2] = SHIFT_SIGMA_PX
        return shifted, free, BundlePriors(params_expected=params, params_sigma=sigma)

    def _known_poses(self, views: list[int]) -> BundlePriors:
        none = np.full(3, np.nan)
        measured = np.array([self.positions.get(self.map.keyframes[k].number, none) for k in views])
        return BundlePriors(position_in_world=measured, position_sigma=self.position_sigma)


def focal_baseline_of(sensor: SlamCamera, config: OdometryConfig) -> float | None:
    """Focal length times baseline, for a depth sensor that of an equivalent pair; None for a single camera and for a rig.

    Raises:
        ConfigError: the camera measures depth and is not a pinhole, so that its pair would have no common rows.
    """
    baseline = sensor.baseline if sensor.depth is None else config.sensor_baseline_m
    if baseline is None:
        return None
    if sensor.camera.model != CameraModel.PINHOLE:
        raise ConfigError("depth and stereo images need a PINHOLE camera: undistort the images first")
    return sensor.camera.focal_px * baseline
