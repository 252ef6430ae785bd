"""Errors of estimated cameras, after alignment by the similarity that a reconstruction leaves free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3, Similarity3, align_points

# Camera centers are collinear if their spread across the main direction is below this fraction of the spread along it:
# they then do not determine the rotation about that line.
LINE_SPREAD = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class CameraAlignment(Declared):
    """The similarity from estimated to true coordinates."""

    truth_from_estimated: Similarity3
    used_mask: Bool[np.ndarray, " n"]
    """Cameras that are known in both."""
    is_on_line: bool
    """Whether the centers are collinear; the rotation about the line then comes from the cameras' rotations."""

    def __repr__(self) -> str:
        how = "centers on a line, with rotations" if self.is_on_line else "centers"
        scale = float(self.truth_from_estimated.scale)
        return f"CameraAlignment({int(self.used_mask.sum())} cameras, {how}, scale {scale:.6g})"


@dataclass(frozen=True, slots=True, eq=False)
class CameraErrors:
    """Errors of each camera after alignment; NaN for cameras that are not known in both."""

    position: Float64[np.ndarray, " n"]
    """Distance between the centers, in the truth's unit of length."""
    rotation_deg: Float64[np.ndarray, " n"]
    alignment: CameraAlignment

    @property
    def mean_position(self) -> float:
        """Mean distance of the centers, in the truth's unit."""
        return float(np.nanmean(self.position))

    @property
    def median_position(self) -> float:
        """Median distance of the centers, in the truth's unit."""
        return float(np.nanmedian(self.position))

    @property
    def max_position(self) -> float:
        """Largest distance of the centers, in the truth's unit."""
        return float(np.nanmax(self.position))

    @property
    def mean_rotation_deg(self) -> float:
        """Mean angle between the rotations."""
        return float(np.nanmean(self.rotation_deg))

    @property
    def median_rotation_deg(self) -> float:
        """Median angle between the rotations."""
        return float(np.nanmedian(self.rotation_deg))

    @property
    def max_rotation_deg(self) -> float:
        """Largest angle between the rotations."""
        return float(np.nanmax(self.rotation_deg))

    def __repr__(self) -> str:
        return (
            f"CameraErrors({int(self.alignment.used_mask.sum())} of {len(self.position)} cameras, position mean "
            f"{self.mean_position:.4g}, rotation mean {self.mean_rotation_deg:.4g} deg)"
        )


@checked
def align_cameras(estimated: Rigid3, truth: Rigid3) -> CameraAlignment:
    """truth_from_estimated with the least squared distances of the camera centers (Umeyama, PAMI 1991).

    If the centers are collinear, they leave the rotation about their line free; it is then the one that best agrees with the
    cameras' own rotations.

    Args:
        estimated: cams_from_world of the estimate, NaN rows for cameras that are not registered.
        truth: cams_from_world of the truth, in the same order; NaN rows if unknown.

    Raises:
        DegenerateGeometryError: fewer than two cameras are known in both, or all are at one position.
        ShapeError: the batches differ.
    """
    used = _known_on_both_sides(estimated, truth)
    if used.sum() < 2:
        raise DegenerateGeometryError(f"alignment needs at least 2 registered cameras, got {int(used.sum())}")
    source, target = estimated[used].centers(), truth[used].centers()
    if min(_spread(source), _spread(target)) < 1e-12:
        raise DegenerateGeometryError("all cameras are at the same position, so the scale is undetermined")
    is_on_line = len(source) < 3 or min(_spread_across(source), _spread_across(target)) < LINE_SPREAD
    if is_on_line:
        similarity = _align_on_line(estimated[used], truth[used])
    else:
        similarity = align_points(source, target)
    return CameraAlignment(similarity, used, is_on_line)


@checked
def camera_errors(estimated: Rigid3, truth: Rigid3, alignment: CameraAlignment | None = None) -> CameraErrors:
    """Position and rotation errors of each camera, after `align_cameras` or a given alignment.

    Args:
        estimated: cams_from_world of the estimate, NaN rows for cameras that are not registered.
        truth: cams_from_world of the truth, in the same order.
        alignment: None: align the cameras themselves.

    Raises:
        DegenerateGeometryError: the cameras cannot be aligned.
        ShapeError: the batches differ.
    """
    if alignment is None:
        alignment = align_cameras(estimated, truth)
    used = _known_on_both_sides(estimated, truth)
    position, rotation_deg = np.full(len(used), np.nan), np.full(len(used), np.nan)
    moved = alignment.truth_from_estimated.move_cam_from_source(estimated[used])
    position[used] = np.linalg.norm(moved.centers() - truth[used].centers(), axis=1)
    difference = Rotation3(moved.rotation) @ Rotation3(truth[used].rotation).inverse()
    rotation_deg[used] = np.degrees(difference.angle_rad())
    return CameraErrors(position, rotation_deg, alignment)


def _known_on_both_sides(estimated: Rigid3, truth: Rigid3) -> np.ndarray:
    if estimated.translation.shape != truth.translation.shape or estimated.translation.ndim != 2:
        raise ShapeError(
            "estimated and truth must be batches of the same n cameras, got "
            f"{estimated.translation.shape[:-1]} and {truth.translation.shape[:-1]}"
        )
    both = np.concatenate([estimated.as_matrix(), truth.as_matrix()], axis=2)
    return np.isfinite(both).all(axis=(1, 2))


def _spread(points: np.ndarray) -> float:
    """Largest distance from the mean, relative to the largest coordinate (which determines rounding errors)."""
    return float(np.abs(points - points.mean(axis=0)).max() / max(np.abs(points).max(), 1e-300))


def _spread_across(points: np.ndarray) -> float:
    """Spread across the points' main direction over the spread along it."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(singular[1] / singular[0])


def _align_on_line(estimated: Rigid3, truth: Rigid3) -> Similarity3:
    """The similarity that maps the line of centers onto the true line, rotated about it to fit the cameras.

    The mean rotation of the cameras (nearest in the Frobenius norm) is corrected by the smallest rotation that makes the lines
    parallel; the scale is the ratio of the spreads.
    """
    source, target = estimated.centers(), truth.centers()
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    rotations = np.swapaxes(truth.rotation, -1, -2) @ estimated.rotation
    mean_rotation = Rotation3.nearest(rotations.sum(axis=0)).matrix
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = Rotation3.from_two_vectors(mean_rotation @ vt[0], u[:, 0]).matrix @ mean_rotation
    scale = float(np.linalg.norm(b) / np.linalg.norm(a))
    return Similarity3(
        np.asarray(scale), rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    )
