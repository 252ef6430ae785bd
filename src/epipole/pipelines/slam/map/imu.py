"""IMU factors between keyframes, used in every adjustment once the IMU agrees with the trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.inertial import (
    ImuCalibration,
    ImuFactors,
    ImuNoise,
    InertialAlignment,
    MountedImu,
    align_path_to_imu,
    imu_factors,
)
from epipole.inertial.preintegration import LARGEST_GAP_S
from epipole.optim import BundleConfig, BundleProblem, BundleResult, bundle_variance
from epipole.pipelines.slam.map.imu_clock import CameraImu, path_of
from epipole.pipelines.slam.map.imu_readings import LARGEST_MISFIT, better_reading
from epipole.pipelines.slam.map.slam_map import ImuAlignment, Keyframe

LONGEST_S = 2.0
"""Longest interval between keyframes of an alignment: over longer ones the integrated biases are too large."""
LONGEST_KNOWN_S = 4.0
"""The same in a factor, for which the biases are known approximately."""
SHORTEST_S = 0.02
"""Shortest interval between keyframes: shorter ones contain hardly any samples."""
LEAST = 10
"""Fewest consecutive keyframes of a factor or an alignment."""
MOST_ALIGNED = 60
"""Most consecutive keyframes of an alignment."""
MOST_CONSTRAINED = 80
"""Most keyframes in one factor, whose cost grows with their cube."""
LEAST_NOISE_PX = 0.05


class InertialConstraints:
    """IMU constraints on the keyframes of one map.

    Attributes:
        camera_imu: measurements, mounting, specified noise and clock.
        is_metric: whether the map is in meters.
        aligned: scale, gravity and biases of some keyframes; None until they are observable.
        noise: noise densities, at least the specified ones, raised to what the adjusted trajectory shows.
    """

    def __init__(self, camera_imu: CameraImu, *, is_metric: bool = False) -> None:
        self.camera_imu, self.is_metric = camera_imu, is_metric
        self.aligned: InertialAlignment | None = None
        self.noise = camera_imu.imu.noise
        self._num_adjusted = 0  # keyframes with factors in the adjustment that showed gravity and scale

    @property
    def imu(self) -> MountedImu:
        """The measurements so far, with the noise as specified."""
        return self.camera_imu.imu

    def learn(self, keyframes: Sequence[Keyframe], *, is_last: bool = False) -> None:
        """Align the newest consecutive keyframes to the IMU, until it succeeds once; from then on the factors estimate the scale.

        The IMU waits until its clock is known, or the motion has not shown it for long, or these keyframes are the last.
        """
        if self.aligned is not None or not self.camera_imu.is_clock_known(is_last=is_last):
            return
        rows = [own[-MOST_ALIGNED:] for own in self._in_a_row(keyframes, LONGEST_S)]
        for number, own in enumerate(reversed(rows)):
            path = self._path([keyframes[k] for k in own])
            try:
                aligned = align_path_to_imu(*path, self.imu, is_metric=self.is_metric)
                misfit = aligned.misfit
            except DegenerateGeometryError:
                misfit = np.inf
            fits = misfit <= LARGEST_MISFIT
            if fits or (is_last and not number):
                other = better_reading(*path, self.imu, misfit, is_metric=self.is_metric)
                self.camera_imu.other_reading = other
                if fits and not other:
                    self.aligned, self.camera_imu.is_used = aligned, True
                    return

    def calibration(self, keyframes: Sequence[Keyframe], timestamp_s: float) -> ImuCalibration | None:
        """Scale, gravity and biases at a time, from the newest consecutive keyframes; None before the first alignment.

        The trajectory's standard deviations are those of the first alignment, which takes six times as long to estimate them.
        """
        rows = self._in_a_row(keyframes, LONGEST_S)
        if self.aligned is None or not rows:
            return None
        newest = rows[-1][-MOST_ALIGNED:]
        times, positions = self._path([keyframes[k] for k in newest])
        imu, sigmas = replace(self.imu, noise=self.noise), self.aligned.path_sigma
        try:
            found = align_path_to_imu(times, positions, imu, sigmas[0], sigmas[1], is_metric=self.is_metric)
        except DegenerateGeometryError:
            return None
        if found.misfit > LARGEST_MISFIT:
            return None
        covariance, noise = found.calibration.covariance.copy(), self.imu.noise
        since = max(timestamp_s - keyframes[newest[-1]].timestamp_s, 0.0)
        walked = since * np.repeat([noise.gyro_walk**2, noise.accel_walk**2], 3)
        covariance[:6, :6] += np.diag(walked)
        return replace(found.calibration, covariance=covariance)

    def factors(self, keyframes: Sequence[Keyframe], variance_px: float) -> tuple[ImuFactors, ...]:
        """Factors between keyframes, by their index in the sequence; none before the first alignment.

        Args:
            keyframes: adjusted or fixed.
            variance_px: variance of a pixel coordinate, in square pixels.
        """
        if self.aligned is None:
            return ()
        imu, out = replace(self.imu, noise=self.noise), []
        for own in self._in_a_row(keyframes, LONGEST_KNOWN_S):
            for part in np.array_split(own, -(-len(own) // MOST_CONSTRAINED)):
                rows, (times, positions) = part.astype(np.int64), self._path([keyframes[k] for k in part])
                aligned, is_metric = self.aligned, self.is_metric
                out.append(
                    imu_factors(rows, times, positions, imu, aligned, variance_px, is_metric=is_metric)
                )
        return tuple(out)

    def agrees(self, factors: Sequence[ImuFactors], cam_from_world: Rigid3) -> bool:
        """Whether the IMU agrees with the adjusted poses; if so its noise is rescaled to their residuals, else the alignment is dropped.

        Args:
            factors: one or more factors of the adjustment.
            cam_from_world: adjusted poses.
        """
        given = np.array([one.variance_factors(cam_from_world[one.frames]) for one in factors])
        gyro, accel = np.average(given, axis=0, weights=[len(one.frames) for one in factors])
        if not max(gyro, accel) <= LARGEST_MISFIT**2:
            self.aligned, self._num_adjusted = None, 0
            return False
        self.noise = replace(
            self.noise,
            gyro_density=max(self.noise.gyro_density * gyro**0.5, self.imu.noise.gyro_density),
            accel_density=max(self.noise.accel_density * accel**0.5, self.imu.noise.accel_density),
        )
        return True

    def shown_at_first(self) -> ImuAlignment | None:
        """Gravity and scale of the map by `aligned`."""
        if self.aligned is None:
            return None
        scale, sigma = (1.0, 0.0) if self.is_metric else _scale_without_gain(self.aligned, self.noise)
        return ImuAlignment(self.aligned.gravity_in_world, scale, sigma, is_adjusted=False)

    def shown_by(
        self, before: ImuAlignment | None, problem: BundleProblem, result: BundleResult, config: BundleConfig
    ) -> ImuAlignment | None:
        """Gravity and scale from an adjustment with factors that determines them, unless one of more keyframes did.

        Args:
            before: what the map has so far.
            problem: the adjusted problem.
            result: its minimum, in the map's world.
            config: of the adjustment.
        """
        paths = () if problem.priors is None else problem.priors.paths
        factors = [one for one in paths if isinstance(one, ImuFactors)]
        count = sum(len(one.frames) for one in factors)
        if self.aligned is None or not count or count < self._num_adjusted:
            return None if self.aligned is None else before
        scale, sigma = 1.0, 0.0
        try:
            found, variances = zip(*(one.gravity(result.rig_from_world[one.frames]) for one in factors))
            if not self.is_metric:
                scale, sigma = scale_by_factors(factors, problem, result, config)
        except DegenerateGeometryError:
            return before
        mean = np.average(found, axis=0, weights=1.0 / np.array(variances))
        gravity = mean * np.linalg.norm(found[0]) / np.linalg.norm(mean)
        self._num_adjusted = count
        return ImuAlignment(gravity, scale, sigma, is_adjusted=True)

    def _in_a_row(self, keyframes: Sequence[Keyframe], longest_s: float) -> list[np.ndarray]:
        """Indices of consecutive keyframes, in the order of time, at most so far apart, between which the log has no gap."""
        log = self.imu.log.timestamp_s
        if len(log) < 2:
            return []
        times = np.array([k.timestamp_s + self.camera_imu.offset_s for k in keyframes])
        order = np.argsort(times, kind="stable")
        sample = np.searchsorted(log, times[order], side="right") - 1
        is_hole = np.append(np.diff(log) > LARGEST_GAP_S, True)
        covered = (sample >= 0) & (~is_hole[sample] | (log[sample] == times[order]))
        order, sample = order[covered], sample[covered]
        apart = np.diff(times[order], prepend=-np.inf) > SHORTEST_S
        order, sample = order[apart], sample[apart]
        holes = np.cumsum(is_hole)[sample] - is_hole[sample]
        cut = np.flatnonzero((np.diff(times[order]) > longest_s) | (np.diff(holes) > 0)) + 1
        return [own for own in np.split(order, cut) if len(own) >= LEAST]

    def _path(self, keyframes: Sequence[Keyframe]) -> tuple[np.ndarray, Rigid3]:
        """Times by the IMU's clock, and world_from_camera."""
        times, positions = path_of(keyframes)
        return times + self.camera_imu.offset_s, positions


def _scale_without_gain(aligned: InertialAlignment, noise: ImuNoise) -> tuple[float, float]:
    """Scale, and its standard deviation without that of the accelerometer's gain."""
    gain = aligned.scale * noise.accel_gain_sigma
    return aligned.scale, float(np.sqrt(max(aligned.sigma**2 - gain**2, 0.0)))


def scale_by_factors(
    factors: Sequence[ImuFactors], problem: BundleProblem, result: BundleResult, config: BundleConfig
) -> tuple[float, float]:
    """Meters per unit from an adjustment with IMU factors, and the standard deviation without that of the accelerometer's gain.

    Args:
        factors: one or more factors of the adjustment.
        problem: the adjusted problem.
        result: its minimum.
        config: of the adjustment.

    Raises:
        DegenerateGeometryError: the problem is underdetermined.
    """
    logs, variances = [], []
    for path in factors:
        log_scale, own, derivative = path.scale(result.rig_from_world[path.frames])
        of_all = np.zeros((len(problem.frame_free), 6))
        of_all[path.frames] = derivative
        logs.append(log_scale)
        variances.append(own + path.weight * bundle_variance(problem, result, of_all, config))
    weight = 1.0 / np.array(variances)
    scale = float(np.exp((weight * logs).sum() / weight.sum()))
    return scale, scale / float(np.sqrt(weight.sum()))


def pixel_variance(problem: BundleProblem, camera: Camera) -> float:
    """Variance of a pixel coordinate, in square pixels, from the median of the first camera's current residuals."""
    point = np.repeat(np.arange(len(problem.points_in_world)), np.diff(problem.offsets))
    rows = np.flatnonzero(problem.sensor == 0)
    in_rig = problem.rig_from_world[problem.frame[rows]].apply(problem.points_in_world[point[rows]])
    seen = camera.project(problem.cam_from_rig[0].apply(in_rig))
    squared = ((seen - problem.pixels[rows]) ** 2).sum(axis=1)
    seen = squared[np.isfinite(squared)]
    return max(float(np.median(seen)) / (2.0 * np.log(2.0)) if len(seen) else 1.0, LEAST_NOISE_PX**2)
