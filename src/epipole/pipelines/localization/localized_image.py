"""Result of the localization of one image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64

from epipole.cameras import Camera
from epipole.geometry import Rigid3


class LocalizationReason(StrEnum):
    """Why an image is not localized, or OK."""

    OK = "ok"
    FEW_FEATURES = "too few features"
    FEW_MATCHES = "too few matches with the points of the model"
    FEW_INLIERS = "no pose fits enough of its matches with the model"
    NOT_CONFIRMED = "too few of the points that its pose predicts are found"
    UNDETERMINED = "the matched points do not determine the pose"


@dataclass(frozen=True, slots=True, eq=False)
class LocalizedImage:
    """Pose of an image in a model; failures are reported in it, not raised."""

    reason: LocalizationReason
    cam_from_world: Rigid3
    """NaN if the image is not localized."""
    covariance: Float64[np.ndarray, "6 6"]
    """Of xi = (translation, rotation) in exp(xi) @ cam_from_world, from the residuals; infinite if unknown. It includes noise
    of the image and of its points, but no deformation of the model."""
    camera: Camera
    """Intrinsics, with the estimated focal length if it was unknown."""
    pixels: Float64[np.ndarray, "k 2"]
    """Observations of points, with which the pose was computed."""
    point: Int64[np.ndarray, " k"]
    """Row of each in the model's points."""
    num_matches: int
    """Number of matches found by descriptors alone."""
    num_inliers: int
    """Number of these that agree with the first pose."""
    num_confirmed: int
    """Number of other points found near their projections."""
    num_by_chance: int
    """The same with displaced projections: the number found by chance."""
    focal_correction: float
    """Relative change of the focal length that fits the points better; NaN if unknown."""
    is_focal_contradicted: bool
    """Whether the points contradict a fixed focal length clearly."""
    error_px: float
    """Median reprojection error; NaN if the image is not localized."""
    neighbors: tuple[int, ...]
    """Rows of the model's images that it was matched with, most similar first."""

    @property
    def success(self) -> bool:
        """Whether the image is localized."""
        return self.reason is LocalizationReason.OK

    def position_in_world(self) -> Float64[np.ndarray, " 3"]:
        """Camera center."""
        return self.cam_from_world.centers()

    def position_sigma(self) -> float:
        """Standard deviation of the camera center's position: root of the summed variances of its axes."""
        # The center -R^T t moves by -R^T times the translation of xi, as exp(xi) acts in the camera frame.
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    def rotation_sigma_rad(self) -> float:
        """Standard deviation of the orientation: root of the summed variances of its axes."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    def __repr__(self) -> str:
        if not self.success:
            return f"LocalizedImage({self.reason.value})"
        return f"LocalizedImage({len(self.point)} points, {self.error_px:.2f} px, sigma {self.position_sigma():.3g})"
