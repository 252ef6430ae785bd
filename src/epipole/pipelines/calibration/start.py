"""Initial values of calibration: focal length and pose of every view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.geometry.rotation3 import skew
from epipole.pipelines.calibration.observations import Corners
from epipole.solvers import solve_pnp

_FOCALS = np.geomspace(0.3, 4.0, 14)  # of the image's longer side
_FINER = 1.0 + np.linspace(-0.08, 0.08, 5)
_FAR_VIEW = 5.0  # a view this many times worse than the median view is rejected from the start
_TRIMS, _TRIM = (
    2,
    4.0,
)  # corners with errors this many times the median are excluded from a view's first pose


@dataclass(frozen=True, slots=True, eq=False)
class _Positions:
    rig_from_board: Rigid3
    error_px: np.ndarray
    """Median reprojection error of each view; NaN without a pose."""


def start_camera(
    corners: Corners, camera: int, board: np.ndarray, model: CameraModel, size: tuple[int, int]
) -> tuple[Camera, Rigid3]:
    """The undistorted camera with the smallest median errors, and cam_from_board of each view (NaN: none).

    Grid search over the focal length, with poses from each view's homography; works for every camera model.

    Raises:
        DegenerateGeometryError: fewer than three views show the board.
    """
    views = [corners.of_view(camera, v) for v in range(corners.num_views)]
    seen = [v for v, rows in enumerate(views) if len(rows)]
    if len(seen) < 3:
        raise DegenerateGeometryError(
            f"the board is found in {len(seen)} images of a camera, at least 3 are needed"
        )

    def guess(focal: float) -> Camera:
        return Camera(model, *size, model.initial_params(focal, *size))

    def error(focal: float) -> float:
        camera = guess(focal)
        errors = [
            _plane_error(camera, corners.pixels[views[v]], board[corners.corner[views[v]]]) for v in seen
        ]
        return float(np.median(errors))

    coarse = max(size) * _FOCALS
    best = min(coarse, key=error)
    camera_guess = guess(min(best * _FINER, key=error))
    positions = _positions(camera_guess, corners, views, board, seen)
    good = positions.error_px <= _FAR_VIEW * max(float(np.nanmedian(positions.error_px)), 0.1)
    rotation, translation = (
        positions.rig_from_board.rotation.copy(),
        positions.rig_from_board.translation.copy(),
    )
    rotation[~good], translation[~good] = np.nan, np.nan
    return camera_guess, Rigid3(rotation, translation)


def _plane_error(camera: Camera, pixels: np.ndarray, points: np.ndarray) -> float:
    """Median reprojection error of the pose from `plane_pose`, which depends on the focal length."""
    rays = camera.unproject(pixels)
    usable = np.isfinite(rays).all(axis=1)
    pose = plane_pose(rays[usable], points[usable])
    if pose is None:
        return np.inf
    distance = np.linalg.norm(camera.project(pose.apply(points)) - pixels, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))


def plane_pose(rays: np.ndarray, points: np.ndarray) -> Rigid3 | None:
    """cam_from_board from the homography of the board's plane to the rays; None for fewer than four.

    ray x (H (X, Y, 1)) = 0 is solved by its null vector; H = [r1 r2 t] up to scale, with r1 and r2 replaced by the nearest
    orthonormal pair. Their deviation from it depends on the focal length (Zhang, PAMI 2000). The board is nearly flat.
    """
    if len(rays) < 4:
        return None
    middle, size = points.mean(axis=0), np.ptp(points[:, :2], axis=0).max()
    plane = np.column_stack([(points[:, :2] - middle[:2]) / size, np.ones(len(points))])
    rows = (skew(rays)[:, :, :, None] * plane[:, None, None, :]).reshape(-1, 9)
    matrix = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    if np.einsum("ni,ij,nj->", rays, matrix, plane) < 0:  # the board is in front of the camera
        matrix = -matrix
    left, values, right = np.linalg.svd(matrix[:, :2], full_matrices=False)
    if not values[1] > 1e-12 * values[0]:
        return None
    axes = left @ right
    rotation = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
    return Rigid3(rotation, matrix[:, 2] * size / values.mean() - rotation @ middle)


def locate_view(
    camera: Camera, pixels: np.ndarray, points: np.ndarray, *, precise: bool = True
) -> tuple[Rigid3, float] | None:
    """cam_from_board of one view and its median error, refitted twice without outlier corners.

    Uses PnP, or with precise=False the board's homography, which takes a hundredth of the time.
    """
    rays = camera.unproject(pixels)
    usable = np.isfinite(rays).all(axis=1)
    found: tuple[Rigid3, float] | None = None
    for _ in range(_TRIMS + 1):
        pose = _pose(rays[usable], points[usable], precise=precise)
        if pose is None:
            return None
        distance = np.linalg.norm(camera.project(pose.apply(points)) - pixels, axis=1)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        middle = float(np.median(distance))
        found = (pose, middle) if np.isfinite(middle) else None
        usable = np.isfinite(rays).all(axis=1) & (distance <= max(_TRIM * middle, 1e-6))
    return found


def _pose(rays: np.ndarray, points: np.ndarray, *, precise: bool) -> Rigid3 | None:
    if not precise:
        return plane_pose(rays, points)
    try:
        return solve_pnp(points, rays)
    except (DegenerateGeometryError, ShapeError):
        return None


def _positions(
    camera: Camera, corners: Corners, views: list[np.ndarray], board: np.ndarray, which: list[int]
) -> _Positions:
    rotation, translation = np.full((len(views), 3, 3), np.nan), np.full((len(views), 3), np.nan)
    error = np.full(len(views), np.nan)
    for v in which:
        rows = views[v]
        found = locate_view(camera, corners.pixels[rows], board[corners.corner[rows]], precise=False)
        if found is not None:
            rotation[v], translation[v], error[v] = found[0].rotation, found[0].translation, found[1]
    return _Positions(Rigid3(rotation, translation), error)


def start_rig(first_from_board: Rigid3, other_from_board: Rigid3) -> Rigid3:
    """other_from_first: the medoid of the views' motions, in rotation angle plus relative translation.

    Raises:
        DegenerateGeometryError: no view shows the board to both cameras.
    """
    both = np.isfinite(first_from_board.translation).all(axis=1)
    both &= np.isfinite(other_from_board.translation).all(axis=1)
    if not both.any():
        raise DegenerateGeometryError("no view shows the board to both cameras")
    motions = other_from_board[both] @ first_from_board[both].inverse()
    cos = (np.einsum("aij,bij->ab", motions.rotation, motions.rotation) - 1.0) / 2.0
    angle = np.arccos(np.clip(cos, -1.0, 1.0))
    gap = np.linalg.norm(motions.translation[:, None] - motions.translation[None], axis=2)
    length = np.median(np.linalg.norm(motions.translation, axis=1))
    far = angle + gap / max(float(length), 1e-12)
    return motions[int(np.argmin(np.median(far, axis=1)))]
