"""An inertial unit's measurements between keyframes, as factors of every adjustment once they agree with the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.inertial import (
    ImuFactors,
    InertialAlignment,
    MountedImu,
    align_path_to_imu,
    imu_factors,
)
from epipole.inertial.preintegration import LARGEST_GAP_S
from epipole.optim import BundleConfig, BundleProblem, BundleResult, bundle_variance
from epipole.pipelines.slam.map.slam_map import Keyframe
from epipole.scale import ScaleEstimate

LONGEST_S, SHORTEST_S = 2.0, 0.02
"""Between keyframes: over more the biases carry the unit too far, over less there is hardly a measurement."""
LEAST, MOST_ALIGNED, MOST_CONSTRAINED = 10, 60, 80
"""Keyframes in a row: for a factor, for an alignment, and in one factor, whose cost grows with their cube."""
LARGEST_MISFIT = 5.0
"""Times the noise that is stated: on EuRoC's flights it is 1.3 to 3.5, with the log of another path 30."""
LEAST_NOISE_PX = 0.05


class InertialConstraints:
    """What a unit says of the keyframes of one map.

    Attributes:
        imu: as stated.
        aligned: scale, gravity and biases of some keyframes; None until they can be told.
        noise: densities, as large as adjusted paths have shown.
    """

    def __init__(self, imu: MountedImu) -> None:
        self.imu = imu
        self.aligned: InertialAlignment | None = None
        self.noise = imu.noise

    def learn(self, keyframes: Sequence[Keyframe]) -> None:
        """Align the newest keyframes in a row, until they tell a scale once: from then on factors find it."""
        if self.aligned is not None:
            return
        rows = [own[-MOST_ALIGNED:] for own in self._in_a_row(keyframes)]
        for own in reversed(rows):
            times, positions = _path([keyframes[k] for k in own])
            imu = self.imu
            try:
                aligned = align_path_to_imu(times, positions, imu.log, imu.camera_from_imu, imu.noise)
                if aligned.misfit <= LARGEST_MISFIT:
                    self.aligned = aligned
                    return
            except DegenerateGeometryError:
                continue

    def factors(self, keyframes: Sequence[Keyframe], variance_px: float) -> tuple[ImuFactors, ...]:
        """Factors between keyframes, named by their places in the sequence; none before the first alignment.

        Args:
            keyframes: those that are adjusted, or held.
            variance_px: of a pixel.
        """
        if self.aligned is None:
            return ()
        imu, out = replace(self.imu, noise=self.noise), []
        for own in self._in_a_row(keyframes):
            for part in np.array_split(own, -(-len(own) // MOST_CONSTRAINED)):
                times, positions = _path([keyframes[k] for k in part])
                out.append(
                    imu_factors(part.astype(np.int64), times, positions, imu, self.aligned, variance_px)
                )
        return tuple(out)

    def agrees(self, factors: Sequence[ImuFactors], cam_from_world: Rigid3) -> bool:
        """Whether adjusted poses bear the unit out; then its noise is taken for as large as they show, else it counts no more.

        Args:
            factors: one or more, with which the poses were adjusted.
            cam_from_world: the poses.
        """
        given = np.array([one.variance_factors(cam_from_world[one.frames]) for one in factors])
        gyro, accel = np.average(given, axis=0, weights=[len(one.frames) for one in factors])
        if not max(gyro, accel) <= LARGEST_MISFIT**2:
            self.aligned = None
            return False
        self.noise = replace(
            self.noise,
            gyro_density=max(self.noise.gyro_density * gyro**0.5, self.imu.noise.gyro_density),
            accel_density=max(self.noise.accel_density * accel**0.5, self.imu.noise.accel_density),
        )
        return True

    def _in_a_row(self, keyframes: Sequence[Keyframe]) -> list[np.ndarray]:
        """Places of keyframes, by their times, that follow each other within the log."""
        log = self.imu.log.timestamp_s
        if len(log) < 2:
            return []
        times = np.array([k.timestamp_s for k in keyframes])
        order = np.argsort(times, kind="stable")
        sample = np.searchsorted(log, times[order], side="right") - 1
        is_hole = np.append(np.diff(log) > LARGEST_GAP_S, True)
        covered = (sample >= 0) & (~is_hole[sample] | (log[sample] == times[order]))
        order, sample = order[covered], sample[covered]
        apart = np.diff(times[order], prepend=-np.inf) > SHORTEST_S
        order, sample = order[apart], sample[apart]
        holes = np.cumsum(is_hole)[sample] - is_hole[sample]
        cut = np.flatnonzero((np.diff(times[order]) > LONGEST_S) | (np.diff(holes) > 0)) + 1
        return [own for own in np.split(order, cut) if len(own) >= LEAST]


def scale_by_factors(
    problem: BundleProblem, result: BundleResult, config: BundleConfig, imu: MountedImu
) -> ScaleEstimate | None:
    """The scale that an adjustment with inertial factors found, with its deviation; None where there were none.

    Args:
        problem: what was adjusted, with the factors among its priors.
        result: its minimum.
        config: how.
        imu: the unit.

    Raises:
        DegenerateGeometryError: something is not determined.
    """
    logs, variances = [], []
    for path in () if problem.priors is None else problem.priors.paths:
        assert isinstance(path, ImuFactors)
        log_scale, own, derivative = path.scale(result.rig_from_world[path.frames])
        of_all = np.zeros((len(problem.frame_free), 6))
        of_all[path.frames] = derivative
        logs.append(log_scale)
        variances.append(own + path.weight * bundle_variance(problem, result, of_all, config))
    if not logs:
        return None
    weight = 1.0 / np.array(variances)
    scale = float(np.exp((weight * logs).sum() / weight.sum()))
    sigma, shared = scale / float(np.sqrt(weight.sum())), imu.noise.accel_gain_sigma
    return ScaleEstimate("imu", "the IMU", scale, sigma, shared, "the IMU, adjusted with the images")


def pixel_variance(problem: BundleProblem, camera: Camera) -> float:
    """Of a pixel coordinate, by the median of one camera's residuals as they are."""
    point = np.repeat(np.arange(len(problem.points_in_world)), np.diff(problem.offsets))
    there = problem.rig_from_world[problem.frame].apply(problem.points_in_world[point])
    squared = ((camera.project(there) - problem.pixels) ** 2).sum(axis=1)
    seen = squared[np.isfinite(squared)]
    return max(float(np.median(seen)) / (2.0 * np.log(2.0)) if len(seen) else 1.0, LEAST_NOISE_PX**2)


def _path(keyframes: Sequence[Keyframe]) -> tuple[np.ndarray, Rigid3]:
    """Times, and world_from_camera."""
    positions = [k.cam_from_world for k in keyframes]
    there = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    return np.array([k.timestamp_s for k in keyframes]), there.inverse()
