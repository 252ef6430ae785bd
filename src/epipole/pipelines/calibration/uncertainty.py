"""Uncertainty of a calibration: covariances at the minimum, and projection uncertainty in pixels.

Unknowns are theta = (parameters of every camera, padded to 12; xi of every camera but the first in exp(xi) @ cam_from_rig; two
parameters of the board's warp) and the views' poses, xi in exp(xi) @ rig_from_board. The poses are eliminated view by view, as in
bundle adjustment (Triggs et al. 2000). Their mean is kept, since a common rotation of camera and boards is unobservable: projection
uncertainty is that of a point fixed to the boards (mrcal's cross-reprojection, Kogan 2021).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from epipole.cameras import MAX_PARAMS
from epipole.errors import DegenerateGeometryError
from epipole.geometry.rotation3 import skew
from epipole.pipelines.calibration.observations import Corners, RigState, bent, free_params, warp_shapes


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariances of a calibration."""

    theta: Float64[np.ndarray, "t t"]
    """Zero for fixed parameters."""
    theta_and_mean: Float64[np.ndarray, "t 6"]
    mean_position: Float64[np.ndarray, "6 6"]
    """Of the mean of all views' xi."""
    noise_px: float
    """Standard deviation of a corner coordinate."""
    gradient_step: Float64[np.ndarray, " t"]
    """Remaining Gauss-Newton step of theta; at the minimum, zero except for parameters that were fixed there."""

    def widened(self, factor: float) -> Uncertainty:
        """Multiply the standard deviations by a factor, except that of the corner noise."""
        return replace(
            self,
            theta=factor**2 * self.theta,
            theta_and_mean=factor**2 * self.theta_and_mean,
            mean_position=factor**2 * self.mean_position,
        )

    def pose_of_camera(self, camera: int, num_cameras: int) -> slice:
        """Slice of theta with the pose of a camera (not the first)."""
        return slice(MAX_PARAMS * num_cameras + 6 * (camera - 1), MAX_PARAMS * num_cameras + 6 * camera)


def uncertainty_of(
    state: RigState, corners: Corners, board: Float64[np.ndarray, "n 3"], *, with_warp: bool
) -> Uncertainty:
    """Covariances at the minimum of plain least squares over these corners.

    Raises:
        DegenerateGeometryError: there are no more residuals than unknowns, or the views do not constrain all
            unknowns.
    """
    count = len(state.cameras)
    size = MAX_PARAMS * count + 6 * (count - 1) + 2
    free = _free_columns(state, with_warp)
    residuals = state.residuals(corners, board)
    reduced, gradient = np.zeros((size, size)), np.zeros(size)
    mean_map, mean_own, num_views = np.zeros((size, 6)), np.zeros((6, 6)), 0
    for view in np.unique(corners.view):
        rows = np.flatnonzero((corners.view == view) & np.isfinite(residuals).all(axis=1))
        if not len(rows):
            continue
        by_theta, by_position = _jacobians(state, corners, board, rows)
        by_theta *= free
        error = residuals[rows].reshape(-1)
        cross, own = by_theta.T @ by_position, by_position.T @ by_position
        inverse = np.linalg.inv(own)
        reduced += by_theta.T @ by_theta - cross @ inverse @ cross.T
        gradient += by_theta.T @ error - cross @ inverse @ (by_position.T @ error)
        mean_map += cross @ inverse
        mean_own += inverse
        num_views += 1
    freedom = 2 * int(np.isfinite(residuals).all(axis=1).sum()) - int(free.sum()) - 6 * num_views
    if freedom <= 0:
        raise DegenerateGeometryError(
            "there are no more residuals than unknowns, so the uncertainty cannot be estimated: add views"
        )
    noise = float(np.sqrt(np.nansum(residuals**2) / freedom))
    theta, scale = np.zeros((size, size)), 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    own = np.ix_(free, free)
    scaled = (reduced * scale[:, None] * scale)[own]
    lowest = np.linalg.eigvalsh(scaled)[0]
    if not lowest > 1e-13:
        raise DegenerateGeometryError(
            "the views do not constrain all parameters: show the board tilted in many directions and near the image borders"
        )
    theta[own] = np.linalg.inv(scaled) * scale[free][:, None] * scale[free]
    mean_map /= max(num_views, 1)
    return Uncertainty(
        noise**2 * theta,
        -(noise**2) * theta @ mean_map,
        noise**2 * (mean_own / max(num_views, 1) ** 2 + mean_map.T @ theta @ mean_map),
        noise,
        -theta @ gradient,
    )


def projection_sigma(
    state: RigState, known: Uncertainty, camera: int, pixels: Float64[np.ndarray, "n 2"], distance: float
) -> Float64[np.ndarray, " n"]:
    """Projection uncertainty of points fixed to the boards: standard deviation in pixels along the worst direction.

    Args:
        state: the calibration.
        known: its covariances.
        camera: index of the camera.
        pixels: projections of the points.
        distance: from the camera, in board units; infinity for directions.
    """
    count = len(state.cameras)
    rays = state.cameras[camera].unproject(pixels)
    far = 1e9 * max(1.0, float(np.abs(np.nan_to_num(state.rig_from_board.translation)).max()))
    points = rays * min(distance, far)
    _, by_point, by_params = state.cameras[camera].project_with_jacobian(points)
    moved = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points)], axis=2)
    by_position = by_point @ moved
    by_theta = np.zeros((len(points), 2, known.theta.shape[0]))
    by_theta[:, :, MAX_PARAMS * camera : MAX_PARAMS * camera + by_params.shape[2]] = by_params
    if camera:
        by_theta[:, :, known.pose_of_camera(camera, count)] = by_position
        by_position = by_position @ state.cam_from_rig[camera].adjoint()
    variance = by_theta @ known.theta @ by_theta.transpose(0, 2, 1)
    both = by_theta @ known.theta_and_mean @ by_position.transpose(0, 2, 1)
    variance = (
        variance
        + both
        + both.transpose(0, 2, 1)
        + by_position @ known.mean_position @ by_position.transpose(0, 2, 1)
    )
    usable = np.isfinite(variance).all(axis=(1, 2))
    out = np.full(len(points), np.nan)
    out[usable] = np.sqrt(np.maximum(np.linalg.eigvalsh(variance[usable])[:, 1], 0.0))
    return out


def _free_columns(state: RigState, with_warp: bool) -> np.ndarray:
    count = len(state.cameras)
    free = np.zeros(MAX_PARAMS * count + 6 * (count - 1) + 2, bool)
    free[: MAX_PARAMS * count] = free_params(state.cameras).ravel() > 0
    free[MAX_PARAMS * count : -2] = True
    free[-2:] = with_warp
    return free


def _jacobians(
    state: RigState, corners: Corners, board: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """D residuals / d theta and d residuals / d xi of one view's pose: (2 n, t), (2 n, 6)."""
    count, view = len(state.cameras), int(corners.view[rows[0]])
    size = MAX_PARAMS * count + 6 * (count - 1) + 2
    by_theta, by_position = np.zeros((len(rows), 2, size)), np.zeros((len(rows), 2, 6))
    position = state.rig_from_board[view]
    on_board = bent(board, state.warp)[corners.corner[rows]]
    raised = warp_shapes(board)[corners.corner[rows]]
    in_rig = position.apply(on_board)
    for c, camera in enumerate(state.cameras):
        own = np.flatnonzero(corners.camera[rows] == c)
        if not len(own):
            continue
        rotation = state.cam_from_rig.rotation[c]
        in_cam = state.cam_from_rig[c].apply(in_rig[own])
        _, by_point, by_params = camera.project_with_jacobian(in_cam)
        by_theta[own, :, MAX_PARAMS * c : MAX_PARAMS * c + len(camera.params)] = by_params
        if c:
            at = MAX_PARAMS * count + 6 * (c - 1)
            by_theta[own, :, at : at + 3] = by_point
            by_theta[own, :, at + 3 : at + 6] = by_point @ -skew(in_cam)
        in_rig_frame = by_point @ rotation
        by_position[own, :, :3] = in_rig_frame
        by_position[own, :, 3:] = in_rig_frame @ -skew(in_rig[own])
        by_bend = (in_rig_frame @ position.rotation)[:, :, 2]
        by_theta[own, :, -2:] = by_bend[:, :, None] * raised[own][:, None, :]
    return by_theta.reshape(-1, size), by_position.reshape(-1, 6)
