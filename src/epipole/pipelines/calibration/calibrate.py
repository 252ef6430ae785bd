"""Calibration from views of a board: cameras, their poses in a rig, and covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from epipole.cameras import MAX_PARAMS, Camera, camera_model_named
from epipole.config import options_of
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.features.boards import BoardView, corners_on_board
from epipole.geometry import Rigid3
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.observations import Corners, RigState, adjust
from epipole.pipelines.calibration.start import locate_view, start_camera, start_rig
from epipole.pipelines.calibration.uncertainty import Uncertainty, uncertainty_of
from epipole.scene import StereoRig

_ROBUST_PX = 1.0
_LEAST_NOISE_PX = 0.02
_ROUNDS = 6
_LEAST_FRACTION = 0.5  # a view with a smaller fraction of inlier corners is rejected


class ViewState(StrEnum):
    """Whether an image was used; else the reason."""

    USED = "used"
    NO_BOARD = "no board found"
    NO_POSE = "no pose of the board fits its corners"
    OFF = "large reprojection errors: another board, a wrong order of corners, or a moved camera"


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of a calibration; lengths are in the unit of `BoardConfig.square`."""

    state: RigState
    config: CalibrationConfig
    corners: Corners
    """All detected corners."""
    used_mask: Bool[np.ndarray, " k"]
    residuals_px: Float64[np.ndarray, "k 2"]
    """Projected minus detected; NaN for views without a pose."""
    view_states: tuple[tuple[ViewState, ...], ...]
    """By `[camera][view]`."""
    uncertainty: Uncertainty

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras."""
        return self.state.cameras

    @property
    def board(self) -> Float64[np.ndarray, "n 3"]:
        """The flat board's corners."""
        return corners_on_board(self.config.board)

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error of the used corners, as OpenCV reports it."""
        return float(np.sqrt((self.residuals_px[self.used_mask] ** 2).sum(axis=1).mean()))

    def view_rms_px(self, camera: int) -> Float64[np.ndarray, " v"]:
        """The same for each view; from all its corners if it was rejected, NaN if it has no pose."""
        out = np.full(self.corners.num_views, np.nan)
        for view in range(len(out)):
            rows = self.corners.of_view(camera, view)
            taken = rows[self.used_mask[rows]]
            rows = taken if len(taken) else rows
            squares = (self.residuals_px[rows] ** 2).sum(axis=1)
            if np.isfinite(squares).any():
                out[view] = np.sqrt(np.nanmean(squares))
        return out

    def params_sigma(self, camera: int) -> Float64[np.ndarray, " p"]:
        """Standard deviations of a camera's parameters."""
        first = MAX_PARAMS * camera
        variance = np.diag(self.uncertainty.theta)[first : first + len(self.cameras[camera].params)]
        return np.sqrt(variance)

    def rig(self) -> StereoRig:
        """The two cameras, with their covariance.

        Raises:
            ShapeError: there are not two cameras; for more, use `state.cam_from_rig`.
        """
        if len(self.cameras) != 2:
            raise ShapeError(f"a stereo rig needs two cameras, {len(self.cameras)} were calibrated")
        own = np.r_[: 2 * MAX_PARAMS, self.uncertainty.pose_of_camera(1, 2)]
        covariance = self.uncertainty.theta[np.ix_(own, own)]
        return StereoRig(self.cameras[0], self.cameras[1], self.state.cam_from_rig[1], covariance)

    def baseline_sigma(self) -> float:
        """Standard deviation of the distance between the first two cameras."""
        # |t| of the translation t changes only with the translation part of xi along t.
        rig = self.rig()
        toward = rig.right_from_left.translation / rig.baseline
        own = self.uncertainty.pose_of_camera(1, len(self.cameras))
        return float(np.sqrt(toward @ self.uncertainty.theta[own, own][:3, :3] @ toward))

    def __repr__(self) -> str:
        used = sum(state is ViewState.USED for states in self.view_states for state in states)
        total = sum(len(states) for states in self.view_states)
        return f"Calibration({len(self.cameras)} cameras, {used} of {total} images, rms {self.rms_px:.3f} px)"


def calibrate_views(
    views: Sequence[Sequence[BoardView]],
    sizes: Sequence[tuple[int, int]],
    config: CalibrationConfig | None = None,
) -> Calibration:
    """Calibrate one camera, or several rigidly mounted ones, from views of a board.

    Each camera is initialized separately (a grid of focal lengths, the homography of each view), and the rig from the view
    whose motion agrees best with the others. Everything is adjusted with the Cauchy loss, outlier corners and views are rejected,
    and the rest is fitted by least squares until the inliers no longer change.

    Args:
        views: by `[camera][view]`; empty if the board was not found.
        sizes: width and height of each camera's images.
        config: options.

    Raises:
        DegenerateGeometryError: there are too few views, or they do not constrain all parameters.
        ShapeError: the cameras have different numbers of views, or a view has corners that are not on the board.
    """
    config = options_of(CalibrationConfig, config)
    board = corners_on_board(config.board)
    corners = Corners.of(views)
    if len(corners) and corners.corner.max() >= len(board):
        raise ShapeError("a view has corners that are not on the board")
    state = _start(corners, board, sizes, config)
    state, _ = adjust(state, corners, board, robust_px=_ROBUST_PX)
    state, used = _optimize(state, corners, board, config)
    known = uncertainty_of(state, corners.select(used), board, with_warp=config.refine_warp)
    if config.refine_warp:
        for _ in range(_ROUNDS):
            step = known.gradient_step[-2:]
            bent_state = replace(state, warp=state.warp + step)
            state, _ = adjust(bent_state, corners.select(used), board)
            known = uncertainty_of(state, corners.select(used), board, with_warp=True)
            if (np.abs(step) < 1e-3 * np.sqrt(np.diag(known.theta)[-2:])).all():
                break
    residuals = state.residuals(corners, board)
    return Calibration(state, config, corners, used, residuals, _states(corners, used, residuals), known)


def _start(
    corners: Corners, board: np.ndarray, sizes: Sequence[tuple[int, int]], config: CalibrationConfig
) -> RigState:
    """Initialize each camera, then the rig, then every view from the cameras that see it."""
    model = camera_model_named(config.model)
    alone: list[tuple[Camera, Rigid3]] = []
    for c, size in enumerate(sizes):
        camera, positions = start_camera(corners, c, board, model, size)
        own = corners.select(corners.camera == c)
        single = replace(own, camera=np.zeros(len(own), np.int64), num_cameras=1)
        start = RigState((camera,), Rigid3.identity(1), positions, np.zeros(2))
        found, _ = adjust(start, single, board, robust_px=_ROBUST_PX)
        alone.append((found.cameras[0], found.rig_from_board))
    first_from_board = alone[0][1]
    rotation, translation = np.eye(3)[None], np.zeros((1, 3))
    constrains_rotation, constrains_translation = (
        first_from_board.rotation.copy(),
        first_from_board.translation.copy(),
    )
    for _, positions in alone[1:]:
        motion = start_rig(first_from_board, positions)
        rotation = np.concatenate([rotation, motion.rotation[None]])
        translation = np.concatenate([translation, motion.translation[None]])
        from_other = motion.inverse() @ positions
        missing = ~np.isfinite(constrains_translation).all(axis=1)
        constrains_rotation[missing] = from_other.rotation[missing]
        constrains_translation[missing] = from_other.translation[missing]
    return RigState(
        tuple(camera for camera, _ in alone),
        Rigid3(rotation, translation),
        Rigid3(constrains_rotation, constrains_translation),
        np.zeros(2),
    )


def _optimize(
    state: RigState, corners: Corners, board: np.ndarray, config: CalibrationConfig
) -> tuple[RigState, np.ndarray]:
    """Plain least squares over the inlier corners, which are selected again after each fit."""
    used = _agreeing(state, corners, board, config)
    for _ in range(_ROUNDS):
        state, _ = adjust(_only_seen(state, corners, used), corners.select(used), board)
        state = _with_all_poses(state, corners, board)
        now = _agreeing(state, corners, board, config)
        if (now == used).all():
            break
        used = now
    state, _ = adjust(_only_seen(state, corners, used), corners.select(used), board)
    return _with_all_poses(state, corners, board), used


def _agreeing(state: RigState, corners: Corners, board: np.ndarray, config: CalibrationConfig) -> np.ndarray:
    """Corners within `outlier_factor` robust standard deviations, in views that are not much worse than the median view."""
    distance = np.linalg.norm(state.residuals(corners, board), axis=1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    key = corners.camera * corners.num_views + corners.view
    middles = np.full(corners.num_cameras * corners.num_views, np.nan)
    for k in np.unique(key):
        middles[k] = np.median(distance[key == k])
    finite = middles[np.isfinite(middles)]
    if not len(finite):
        raise DegenerateGeometryError("no pose of the board was found in any view")
    typical = max(float(np.median(finite)), _LEAST_NOISE_PX)
    is_good_view = middles <= config.max_view_factor * typical
    good = is_good_view[key]
    # Median of a Rayleigh distribution: 1.1774 standard deviations of a coordinate.
    sigma = max(float(np.median(distance[good])) / 1.1774, _LEAST_NOISE_PX)
    agreeing = good & (distance <= config.outlier_factor * sigma)
    for k in np.unique(key[good]):
        own = key == k
        if agreeing[own].mean() < _LEAST_FRACTION:
            agreeing[own] = False
    return agreeing


def _only_seen(state: RigState, corners: Corners, used: np.ndarray) -> RigState:
    rotation, translation = state.rig_from_board.rotation.copy(), state.rig_from_board.translation.copy()
    unseen = np.bincount(corners.view[used], minlength=corners.num_views) == 0
    rotation[unseen], translation[unseen] = np.nan, np.nan
    if (~unseen).sum() < 3:
        raise DegenerateGeometryError(
            f"only {int((~unseen).sum())} views agree with each other, at least 3 are needed"
        )
    return replace(state, rig_from_board=Rigid3(rotation, translation))


def _with_all_poses(state: RigState, corners: Corners, board: np.ndarray) -> RigState:
    """The state with poses for all views: rejected ones may agree with better cameras."""
    rotation, translation = state.rig_from_board.rotation.copy(), state.rig_from_board.translation.copy()
    for view in np.flatnonzero(~np.isfinite(translation).all(axis=1)):
        for c, camera in enumerate(state.cameras):
            rows = corners.of_view(c, int(view))
            found = (
                locate_view(camera, corners.pixels[rows], board[corners.corner[rows]]) if len(rows) else None
            )
            if found is not None:
                position = state.cam_from_rig[c].inverse() @ found[0]
                rotation[view], translation[view] = position.rotation, position.translation
                break
    return replace(state, rig_from_board=Rigid3(rotation, translation))


def _states(corners: Corners, used: np.ndarray, residuals: np.ndarray) -> tuple[tuple[ViewState, ...], ...]:
    out = []
    for c in range(corners.num_cameras):
        states = []
        for view in range(corners.num_views):
            rows = corners.of_view(c, view)
            if not len(rows):
                states.append(ViewState.NO_BOARD)
            elif used[rows].any():
                states.append(ViewState.USED)
            else:
                has_residual = np.isfinite(residuals[rows]).any()
                states.append(ViewState.OFF if has_residual else ViewState.NO_POSE)
        out.append(tuple(states))
    return tuple(out)
