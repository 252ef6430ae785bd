"""Corners observed in all views by all cameras, stored as arrays, and their least-squares problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.features.boards import BoardView
from epipole.geometry import Rigid3
from epipole.optim import BundleConfig, BundleProblem, BundleResult, Loss, adjust_bundle
from epipole.optim.bundle_problem import NUM_PARAMS, free_params_mask


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """One row per observed corner, sorted by corner as bundle adjustment requires."""

    view: Int64[np.ndarray, " k"]
    camera: Int64[np.ndarray, " k"]
    corner: Int64[np.ndarray, " k"]
    pixels: Float64[np.ndarray, "k 2"]
    num_views: int
    num_cameras: int

    @staticmethod
    def of(views: Sequence[Sequence[BoardView]]) -> Corners:
        """From views[camera][view].

        Raises:
            ShapeError: the cameras have different numbers of views.
        """
        counts = {len(v) for v in views}
        if len(counts) != 1:
            raise ShapeError(
                "every camera needs the same number of views; use an empty view where there is no image"
            )
        rows = [
            (np.full(len(seen), v), np.full(len(seen), c), seen.corner, seen.pixels)
            for c, own in enumerate(views)
            for v, seen in enumerate(own)
        ]
        view, camera, corner = (
            np.concatenate([np.zeros(0, np.int64), *(r[k] for r in rows)]).astype(np.int64) for k in range(3)
        )
        pixels = np.concatenate([np.zeros((0, 2)), *(r[3] for r in rows)])
        order = np.lexsort((camera, view, corner))
        return Corners(view[order], camera[order], corner[order], pixels[order], counts.pop(), len(views))

    def select(self, mask: Bool[np.ndarray, " k"]) -> Corners:
        """Masked rows; views keep their numbers."""
        return replace(
            self,
            view=self.view[mask],
            camera=self.camera[mask],
            corner=self.corner[mask],
            pixels=self.pixels[mask],
        )

    def of_view(self, camera: int, view: int) -> Int64[np.ndarray, " n"]:
        """Rows of one image."""
        return np.flatnonzero((self.camera == camera) & (self.view == view))

    def __len__(self) -> int:
        return len(self.view)

    def __repr__(self) -> str:
        return f"Corners({len(self)} in {self.num_views} views of {self.num_cameras} cameras)"


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """The estimated quantities."""

    cameras: tuple[Camera, ...]
    cam_from_rig: Rigid3
    """One row per camera; the first is the identity."""
    rig_from_board: Rigid3
    """One row per view; NaN if unknown."""
    warp: Float64[np.ndarray, " 2"]
    """Height of the board's center above its edges, horizontally and vertically, in board units."""

    def residuals(self, corners: Corners, board: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 2"]:
        """Projected minus observed pixels; NaN for views without a pose."""
        shape = bent(board, self.warp)
        in_rig = self.rig_from_board[corners.view].apply(shape[corners.corner])
        in_cam = self.cam_from_rig[corners.camera].apply(in_rig)
        out = np.full((len(corners), 2), np.nan)
        for c, camera in enumerate(self.cameras):
            own = np.flatnonzero((corners.camera == c) & np.isfinite(in_cam).all(axis=1))
            if len(own):
                out[own] = camera.project(in_cam[own]) - corners.pixels[own]
        return out


def warp_shapes(board: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """1 - x^2 and 1 - y^2 with x, y from -1 to 1 over the board: the two modes of bending (as in mrcal)."""
    low, high = board[:, :2].min(axis=0), board[:, :2].max(axis=0)
    at = (2.0 * board[:, :2] - low - high) / np.maximum(high - low, 1e-12)
    return 1.0 - at**2


def bent(board: Float64[np.ndarray, "n 3"], warp: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "n 3"]:
    """The board's corners, warped."""
    out = board.copy()
    out[:, 2] += warp_shapes(board) @ warp
    return out


def free_params(cameras: Sequence[Camera]) -> Float64[np.ndarray, "c 12"]:
    """Mask of the estimated parameters: all but k4 to k6 of the rational model, which boards rarely constrain."""
    free = free_params_mask(np.array([int(c.model) for c in cameras], np.int32), principal_point=True)
    free[:, NUM_PARAMS - 3 :] = 0.0
    return free


def adjust(
    state: RigState,
    corners: Corners,
    board: Float64[np.ndarray, "n 3"],
    *,
    robust_px: float | None = None,
    refine_cameras: bool = True,
) -> tuple[RigState, BundleResult]:
    """Bundle adjustment of cameras, their poses in the rig and the poses of all views, with the board fixed.

    Args:
        state: initial values.
        corners: observations.
        board: its corners.
        robust_px: scale of the Cauchy loss; None: plain least squares.
        refine_cameras: False adjusts the poses of the views only.
    """
    known = np.isfinite(state.rig_from_board.translation).all(axis=1)
    corners = corners.select(known[corners.view])
    models = np.array([int(c.model) for c in state.cameras], np.int32)
    count = len(state.cameras)
    start = Rigid3(
        np.where(known[:, None, None], state.rig_from_board.rotation, np.eye(3)),
        np.where(known[:, None], state.rig_from_board.translation, 0.0),
    )
    rotating = np.ones((count, 6)) if refine_cameras else np.zeros((count, 6))
    rotating[0] = 0.0
    free = free_params(state.cameras)
    problem = BundleProblem(
        rig_from_world=start,
        cam_from_rig=state.cam_from_rig,
        camera_model=models,
        camera_params=np.stack([c.padded_params() for c in state.cameras]),
        points_in_world=bent(board, state.warp),
        offsets=np.concatenate([[0], np.cumsum(np.bincount(corners.corner, minlength=len(board)))]),
        frame=corners.view.astype(np.int32),
        sensor=corners.camera.astype(np.int32),
        camera=corners.camera.astype(np.int32),
        pixels=corners.pixels,
        frame_free=np.repeat(known[:, None].astype(np.float64), 6, axis=1),
        params_free=free if refine_cameras else np.zeros_like(free),
        point_free=np.zeros(len(board)),
        sensor_free=rotating,
    )
    loss = {"loss": Loss.TRIVIAL} if robust_px is None else {"loss": Loss.CAUCHY, "loss_scale_px": robust_px}
    config = BundleConfig(**loss, max_iterations=200, function_tolerance=1e-10)
    result = adjust_bundle(problem, config)
    positions = Rigid3(
        np.where(known[:, None, None], result.rig_from_world.rotation, np.nan),
        np.where(known[:, None], result.rig_from_world.translation, np.nan),
    )
    cameras = tuple(
        Camera(c.model, c.width, c.height, result.camera_params[k, : c.model.num_params].copy())
        for k, c in enumerate(state.cameras)
    )
    return RigState(cameras, result.cam_from_rig, positions, state.warp), result
