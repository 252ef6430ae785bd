"""Motion-only bundle adjustment: the pose of one camera, or of a rig of cameras, from known points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.mapping import _pose_kernels as kernels
from epipole.scene import CameraRig

MAX_STEPS = 15


class _View(NamedTuple):
    """Kernel input."""

    models: np.ndarray
    params: np.ndarray
    mountings: np.ndarray
    """(c, 12): R row by row, then t of cam_from_rig."""
    camera: np.ndarray
    """(n,) of each point."""
    points: np.ndarray
    pixels: np.ndarray
    sigma_px: np.ndarray
    disparity_px: np.ndarray
    disparity_sigma_px: float
    focal_baseline: float


@dataclass(frozen=True, slots=True, eq=False)
class Disparities(Declared):
    """Disparities d = f B / Z of the points, from a second camera beside the first or a depth sensor."""

    disparity_px: Float64[np.ndarray, " n"]
    """NaN where unknown."""
    focal_baseline: float
    """Focal length times baseline, in pixels times the world's unit."""
    sigma_px: float = 1.0

    def rows(self, mask: Bool[np.ndarray, " n"]) -> Disparities:
        """The disparities of some of the points."""
        return Disparities(self.disparity_px[mask], self.focal_baseline, self.sigma_px)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPose:
    """A pose refined against known points."""

    cam_from_world: Rigid3
    """Of the camera, or of the rig."""
    information: Float64[np.ndarray, "6 6"]
    """Inverse covariance of xi = (translation, rotation) in exp(xi) @ cam_from_world, if the sigmas are right."""
    scores: Float64[np.ndarray, "6 6"]
    """Sum of g g^T over the points, where g is a point's part of the gradient."""
    error_sq: Float64[np.ndarray, " n"]
    """Squared error of each pixel in units of sigma^2; infinite behind the camera."""
    cost: float
    num_steps: int

    def covariance(self) -> Float64[np.ndarray, "6 6"]:
        """Inverse of the information; infinite if a direction is unconstrained."""
        if not np.isfinite(self.information).all() or np.linalg.cond(self.information) > 1e14:
            return np.full((6, 6), np.inf)
        return np.linalg.inv(self.information)

    def covariance_by_errors(self) -> Float64[np.ndarray, "6 6"]:
        """Covariance from the actual residuals, whatever the stated sigmas: H^-1 (sum g g^T) H^-1.

        H. White, A heteroskedasticity-consistent covariance matrix estimator, Econometrica 1980; scaled by (n / (n - 3))^2 for
        the 6 degrees of freedom that the fit takes from 2n residuals, like leaving out each point in turn.
        """
        bread, count = self.covariance(), int(np.isfinite(self.error_sq).sum())
        if count <= 3 or not np.isfinite(bread).all():
            return np.full((6, 6), np.inf)
        return bread @ self.scores @ bread * (count / (count - 3)) ** 2

    def __repr__(self) -> str:
        return f"RefinedPose({len(self.error_sq)} points, cost {self.cost:.4g}, {self.num_steps} steps)"


@checked
def refine_pose(
    points_in_world: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
    camera: Camera | CameraRig,
    start: Rigid3,
    sigma_px: Float64[np.ndarray, " n"] | None = None,
    disparities: Disparities | None = None,
    *,
    loss_scale: float = 2.0,
) -> RefinedPose:
    """Pose with the least sum of Cauchy(|project - pixel| / sigma) (Triggs et al. 2000, sections 3 and 4).

    Args:
        points_in_world: the known points.
        pixels: their observations in the camera, or in the stacked image of the rig.
        camera: intrinsics, of any model.
        start: initial cam_from_world, or rig_from_world.
        sigma_px: standard deviation of each pixel; None: 1.
        disparities: measured disparities of the points.
        loss_scale: of the Cauchy loss, in standard deviations.

    Raises:
        ShapeError: array sizes do not match, or the start is not a single motion.
        ConfigError: the loss scale or a sigma is not positive, or disparities are given for a rig.
    """
    n = len(points_in_world)
    if not 0 < loss_scale < 1e6:
        raise ConfigError(f"loss_scale must be positive and below 1e6, got {loss_scale}")
    if start.batch_shape() != ():
        raise ShapeError(f"start must be a single motion, got a batch of {start.batch_shape()}")
    ones = np.ones(n) if sigma_px is None else sigma_px
    if not (ones > 0).all():
        raise ConfigError("sigma_px must be positive")
    none = Disparities(np.full(n, np.nan), 1.0)
    depth = none if disparities is None else disparities
    if len(depth.disparity_px) != n:
        raise ShapeError(f"disparities must have {n} rows, got {len(depth.disparity_px)}")
    if isinstance(camera, CameraRig) and disparities is not None:
        raise ConfigError("disparities are those of one camera, not of a rig")
    view = _View(
        *_cameras_of(camera, pixels),
        points_in_world,
        pixels,
        ones,
        np.ascontiguousarray(depth.disparity_px),
        float(depth.sigma_px),
        float(depth.focal_baseline),
    )
    motion = np.concatenate([start.rotation.ravel(), start.translation])
    information, scores, error_sq = np.empty((6, 6)), np.empty((6, 6)), np.empty(n)
    cost, steps = kernels.refine_pose(view, loss_scale**2, MAX_STEPS, motion, information, scores, error_sq)
    pose = Rigid3(motion[:9].reshape(3, 3).copy(), motion[9:].copy())
    return RefinedPose(pose, information, scores, error_sq, float(cost), int(steps))


def _cameras_of(
    camera: Camera | CameraRig, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Models, parameters and mountings of the cameras, and the camera of each pixel."""
    if isinstance(camera, CameraRig):
        mounted = camera.cam_from_rig
        mountings = np.column_stack([mounted.rotation.reshape(-1, 9), mounted.translation])
        models = np.array([int(one.model) for one in camera.cameras])
        return models, camera.padded_params(), mountings, camera.camera_of(pixels)
    identity = np.concatenate([np.eye(3).ravel(), np.zeros(3)])[None]
    return (
        np.array([int(camera.model)]),
        camera.padded_params()[None],
        identity,
        np.zeros(len(pixels), np.int64),
    )
