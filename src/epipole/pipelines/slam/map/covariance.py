"""Pose covariances in the map's world: the error of the map plus that of the frame relative to it.

Only cameras that measure depth have both. A single camera leaves the scale open, so its frames report their own part only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.cameras import CameraModel
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    BundleResult,
    adjust_bundle,
    bundle_covariance,
    with_result,
)
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap


class CalibrationSigma(NamedTuple):
    """Standard deviations of a calibration."""

    focal_fraction: float
    """Of the focal length, relative."""
    center_px: float
    """Of the principal point, in pixels."""
    depth_fraction: float
    """Of the baseline or of the measured depth, relative."""

    @staticmethod
    def of(sensor: SlamCamera, config: OdometryConfig) -> CalibrationSigma:
        """From the options; None selects the default."""
        usual = OF_PAIR if sensor.depth is None else OF_SENSOR
        given = config.focal_sigma, config.center_sigma_px, config.depth_sigma
        return CalibrationSigma(*(u if g is None else g for u, g in zip(usual, given)))

    def in_words(self) -> str:
        """Text for the summary."""
        return (
            f"{100 * self.focal_fraction:g} % of the focal length, {self.center_px:g} px of the principal point,"
            f" {100 * self.depth_fraction:g} % of depth"
        )


OF_PAIR = CalibrationSigma(3e-3, 1.0, 3e-3)
"""Rectified pairs are usually calibrated with a board."""
OF_SENSOR = CalibrationSigma(1e-2, 3.0, 1.5e-2)
"""Depth sensors often come with the manufacturer's values: the three sensors of TUM RGB-D differ by 3 % in focal length, 16 px in
the principal point and 3 % in depth scale."""
LEAST_NOISE_PX = 0.01
SHARED_PX = 0.02
"""Bias common to all disparities: a patch covers more than its point. On rendered pairs disparities were 0.003 to 0.036 px too
large, most at edges."""


def own_covariance(refined: RefinedPose, model: SlamMap, number: int, *, measures_depth: bool) -> np.ndarray:
    """(6, 6) covariance of a frame's pose relative to the map; zero if the frame became a keyframe, which has its own covariance.

    Args:
        refined: pose of the frame.
        model: the map.
        number: frame number.
        measures_depth: whether the map has covariances: the noise is then estimated from the frame's residuals, else it is one pixel.
    """
    if not measures_depth:
        return refined.covariance()
    newest = next((k for k in reversed(model.keyframes) if len(k.point)), None)
    if newest is not None and newest.number == number and newest.covariance.any():
        return np.zeros((6, 6))
    return by_errors(refined)


def by_errors(refined: RefinedPose) -> np.ndarray:
    """(6, 6) covariance of a pose with the noise estimated from the residuals of its points, with a lower bound."""
    return refined.covariance_by_errors() + LEAST_NOISE_PX**2 * refined.covariance()


def carry_covariance(model: SlamMap, refined: RefinedPose) -> None:
    """Propagate the covariance of the previous keyframe to the newest one, until an adjustment computes it."""
    before, newest = model.keyframes[-2:]
    if before.covariance.any():
        between = newest.cam_from_world @ before.cam_from_world.inverse()
        newest.covariance = with_map_error(before.covariance, between, by_errors(refined))


def with_map_error(
    keyframe_covariance: np.ndarray, cam_from_keyframe: Rigid3, covariance: np.ndarray
) -> np.ndarray:
    """(..., 6, 6) covariance of poses stored relative to keyframes: Ad C_keyframe Ad^T plus their own part.

    Args:
        keyframe_covariance: (..., 6, 6).
        cam_from_keyframe: batch shape (...).
        covariance: (..., 6, 6) of cam_from_keyframe; may be infinite.
    """
    adjoint = cam_from_keyframe.adjoint()
    return adjoint @ keyframe_covariance @ np.swapaxes(adjoint, -1, -2) + covariance


def learn_covariances(
    keyframes: Sequence[Keyframe],
    num_free: int,
    problem: BundleProblem,
    result: BundleResult,
    config: BundleConfig,
) -> None:
    """Set the covariances of the adjusted keyframes' poses in the world.

    The covariance of the adjustment, conditional on the fixed keyframes and with errors correlated along tracks, plus the effect of
    a bias common to all disparities, plus the covariance of the newest fixed keyframe, propagated rigidly.

    Args:
        keyframes: of the problem's frames, in their order.
        num_free: number of keyframes at the start of the sequence that were adjusted.
        problem: the adjusted problem.
        result: its minimum.
        config: of the adjustment.
    """
    try:
        own = bundle_covariance(problem, result, config, clustered=True).rig_from_world
    except DegenerateGeometryError:
        return
    shared = _by_shared_error(problem, result, config)
    constrained = [k for k in range(num_free, len(keyframes)) if keyframes[k].covariance.any()]
    for k in range(num_free):
        covariance = own[k] + np.outer(shared[k], shared[k])
        if constrained:
            near = keyframes[max(constrained, key=lambda n: keyframes[n].number)]
            between = result.rig_from_world[k] @ near.cam_from_world.inverse()
            covariance = with_map_error(near.covariance, between, covariance)
        if np.isfinite(covariance).all():
            keyframes[k].covariance = covariance


def add_calibration_error(
    keyframes: Sequence[Keyframe],
    problem: BundleProblem,
    result: BundleResult,
    config: BundleConfig,
    sigma: CalibrationSigma,
) -> None:
    """Add the effect of calibration errors to the covariances of all keyframes, to first order.

    Each parameter is changed by one standard deviation and the poses are optimized again; their change xi adds xi xi^T.

    Args:
        keyframes: of the problem's frames, in their order.
        problem: the adjusted problem.
        result: its minimum.
        config: of the adjustment.
        sigma: standard deviations of the parameters.
    """
    if not any(sigma):
        return
    found = replace(with_result(problem, result), params_free=np.zeros_like(problem.params_free))
    found = replace(found, priors=_of_poses(found))
    for changed in _off_calibrations(found, sigma):
        moved = adjust_bundle(changed, replace(config, max_iterations=1)).rig_from_world
        steps = (moved @ result.rig_from_world.inverse()).log()
        for keyframe, step in zip(keyframes, steps, strict=True):
            if np.isfinite(step).all():
                keyframe.covariance = keyframe.covariance + np.outer(step, step)


def _off_calibrations(problem: BundleProblem, sigma: CalibrationSigma) -> Iterator[BundleProblem]:
    """The problem with one parameter changed by one standard deviation; last, the baseline.

    The cameras of a rectified pair have the same parameters; those of a rig have errors of their own.
    """
    params, num = problem.camera_params, len(problem.camera_params)
    is_pair = num == 2 and problem.camera_model[0] == problem.camera_model[1]
    is_pair &= bool((problem.cam_from_rig.rotation == np.eye(3)).all())
    is_pair &= np.array_equal(
        *np.delete(params[:2], 2, axis=1)
    )  # a pair's principal points may differ along the rows
    for cameras in [list(range(num))] if is_pair else [[k] for k in range(num)]:
        model = CameraModel(int(problem.camera_model[cameras[0]]))
        focal, (cx, cy) = list(model.focal_indices), model.principal_point_indices
        for columns in (focal, [cx], [cy]):
            off, at = params.copy(), np.ix_(cameras, columns)
            off[at] += sigma.focal_fraction * params[at] if columns is focal else sigma.center_px
            yield replace(problem, camera_params=off)
    beside = problem.cam_from_rig
    longer = Rigid3(beside.rotation, beside.translation * (1.0 + sigma.depth_fraction))
    yield replace(problem, cam_from_rig=longer)


def _by_shared_error(problem: BundleProblem, result: BundleResult, config: BundleConfig) -> np.ndarray:
    """(f, 6) change xi of the poses, in exp(xi) @ cam_from_world, if all disparities were smaller by `SHARED_PX`."""
    found = with_result(problem, result)
    params = found.camera_params.copy()
    params[1, 2] += SHARED_PX
    constrained = replace(
        found, camera_params=params, params_free=np.zeros_like(found.params_free), priors=_of_poses(found)
    )
    moved = adjust_bundle(constrained, replace(config, max_iterations=1)).rig_from_world
    return (moved @ result.rig_from_world.inverse()).log()


def _of_poses(problem: BundleProblem) -> BundlePriors | None:
    """The priors without those of the camera parameters, which are fixed here."""
    known = problem.priors
    return None if known is None else replace(known, params_expected=None, params_sigma=None)
