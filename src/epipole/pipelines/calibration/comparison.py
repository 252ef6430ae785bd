"""Comparison of two calibrations: projection differences in pixels, after the best rotation between the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.special import chdtri

from epipole.cameras import MAX_PARAMS, Camera
from epipole.errors import EpipoleError
from epipole.features.boards import BoardView
from epipole.geometry import Rigid3
from epipole.geometry.rotation3 import Rotation3, skew
from epipole.pipelines.calibration.calibrate import Calibration, calibrate_views
from epipole.pipelines.calibration.coverage import covered_pixels
from epipole.pipelines.calibration.observations import Corners, RigState, adjust
from epipole.pipelines.calibration.start import locate_view

_ROUNDS = 20
_LEAST_VIEWS = 6
_LEAST_VIEWS_TO_WIDEN = 10
_CHANCE = (
    0.99  # fraction of correct calibrations with many views that are not widened (95 to 100 % with ten views)
)


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionDifference:
    """Difference between the projections of the same directions by two cameras."""

    pixels: Float64[np.ndarray, "n 2"]
    """In the first camera's image."""
    difference_px: Float64[np.ndarray, "n 2"]
    """Second minus first; NaN where one has no projection."""

    @property
    def distance_px(self) -> Float64[np.ndarray, " n"]:
        """Lengths of the differences."""
        return np.linalg.norm(self.difference_px, axis=1)

    def __repr__(self) -> str:
        return f"ProjectionDifference(median {np.nanmedian(self.distance_px):.3f} px)"


@dataclass(frozen=True, slots=True, eq=False)
class CrossCheck:
    """Cross-validation: a calibration from half of the views against the other half."""

    fitted_rms_px: float
    """Of the fitted half."""
    held_out_rms_px: float
    """Of the other half, of which only the poses were fitted."""
    difference_px: tuple[float, ...]
    """Median projection difference between the halves for each camera, where corners were seen."""
    disagreement: float
    """Squared Mahalanobis distance between the halves per unknown; about 1 for a correct model."""
    num_unknowns: int
    num_views: int
    """Of both halves."""

    @property
    def widening(self) -> float:
        """Factor by which the standard deviations are too small (Birge ratio, 1932).

        1 if chance explains the difference, or if the halves have too few views for valid covariances.
        """
        if self.num_views < _LEAST_VIEWS_TO_WIDEN:
            return 1.0
        expected = chdtri(self.num_unknowns, 1.0 - _CHANCE) / self.num_unknowns
        return float(np.sqrt(self.disagreement)) if self.disagreement > expected else 1.0


def projection_difference(
    first: Camera, second: Camera, pixels: Float64[np.ndarray, "n 2"] | None = None
) -> ProjectionDifference:
    """Difference of two cameras over the image, after the rotation that minimizes it.

    A shift of the principal point is almost equivalent to a rotation of the camera, which images of a board cannot distinguish; only
    the remainder matters (mrcal's differencing, Kogan 2021, at infinity). Gauss-Newton with Cauchy weights.

    Args:
        first: a camera.
        second: another one, or the same calibrated again.
        pixels: in the first one's image; None: a grid over all of it.
    """
    if pixels is None:
        u, v = np.meshgrid(np.linspace(0, first.width - 1, 24), np.linspace(0, first.height - 1, 18))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = first.unproject(pixels)
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        rotated = rays @ rotation.T
        seen, by_point, _ = second.project_with_jacobian(np.nan_to_num(rotated, nan=-1.0))
        error = seen - pixels
        usable = np.isfinite(error).all(axis=1) & np.isfinite(rays).all(axis=1)
        if usable.sum() < 3:
            break
        jacobian = by_point[usable] @ -skew(rotated[usable])
        weight = 1.0 / (1.0 + (error[usable] ** 2).sum(axis=1))
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian)
        step = -np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, jacobian, error[usable]))
        rotation = Rotation3.exp(step).matrix @ rotation
        if np.abs(step).max() < 1e-12:
            break
    known = np.isfinite(rays).all(axis=1)
    difference = np.full_like(pixels, np.nan)
    difference[known] = second.project(rays[known] @ rotation.T) - pixels[known]
    return ProjectionDifference(pixels, difference)


def cross_check(views: Sequence[Sequence[BoardView]], found: Calibration) -> CrossCheck | None:
    """Calibrate with every second used view and test on the others; None if there are too few views or it fails."""
    used = np.unique(found.corners.view[found.used_mask])
    if len(used) < _LEAST_VIEWS:
        return None
    sizes = [(c.width, c.height) for c in found.cameras]
    kept = _only_used(views, found)
    split = [[[own[v] for v in used[start::2]] for own in kept] for start in (0, 1)]
    try:
        fitted = [calibrate_views(half, sizes, found.config) for half in split]
        disagreement, num_unknowns = _disagreement(fitted[0], fitted[1])
    except (EpipoleError, np.linalg.LinAlgError):
        return None
    held_out = [_validation_rms(fitted[k], split[1 - k]) for k in (0, 1)]
    differences = [
        projection_difference(a, b, covered_pixels(found, c))
        for c, (a, b) in enumerate(zip(fitted[0].cameras, fitted[1].cameras))
    ]
    return CrossCheck(
        float(np.mean([f.rms_px for f in fitted])),
        float(np.mean(held_out)),
        tuple(float(np.nanmedian(d.distance_px)) for d in differences),
        disagreement,
        num_unknowns,
        len(used),
    )


def _disagreement(first: Calibration, second: Calibration) -> tuple[float, int]:
    """(Squared Mahalanobis distance per unknown, number of unknowns) of two calibrations from different views."""
    count = len(first.cameras)
    apart = np.zeros(len(first.uncertainty.theta))
    for c, (a, b) in enumerate(zip(first.cameras, second.cameras)):
        apart[MAX_PARAMS * c : MAX_PARAMS * c + len(a.params)] = b.params - a.params
        if c:
            rotated = second.state.cam_from_rig[c] @ first.state.cam_from_rig[c].inverse()
            apart[first.uncertainty.pose_of_camera(c, count)] = rotated.log()
    apart[-2:] = second.state.warp - first.state.warp
    covariance = first.uncertainty.theta + second.uncertainty.theta
    free = np.diag(covariance) > 0
    scale = np.sqrt(np.diag(covariance)[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(scale, scale)
    whitened = apart[free] / scale
    return float(whitened @ np.linalg.solve(correlation, whitened) / free.sum()), int(free.sum())


def _only_used(views: Sequence[Sequence[BoardView]], found: Calibration) -> list[list[BoardView]]:
    corners, out = found.corners, []
    for c, own in enumerate(views):
        kept = []
        for v, view in enumerate(own):
            rows = corners.of_view(c, v)
            good = corners.corner[rows[found.used_mask[rows]]]
            mask = np.isin(view.corner, good)
            kept.append(BoardView(view.corner[mask], view.pixels[mask]))
        out.append(kept)
    return out


def _validation_rms(fitted: Calibration, views: list[list[BoardView]]) -> float:
    corners, board = Corners.of(views), fitted.board
    rotation = np.full((corners.num_views, 3, 3), np.nan)
    translation = np.full((corners.num_views, 3), np.nan)
    for v in range(corners.num_views):
        for c, camera in enumerate(fitted.cameras):
            rows = corners.of_view(c, v)
            used = (
                locate_view(camera, corners.pixels[rows], board[corners.corner[rows]]) if len(rows) else None
            )
            if used is not None:
                position = fitted.state.cam_from_rig[c].inverse() @ used[0]
                rotation[v], translation[v] = position.rotation, position.translation
                break
    state: RigState = replace(fitted.state, rig_from_board=Rigid3(rotation, translation))
    state, _ = adjust(state, corners, board, refine_cameras=False)
    squares = (state.residuals(corners, board) ** 2).sum(axis=1)
    return float(np.sqrt(np.nanmean(squares)))
