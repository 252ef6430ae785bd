"""Images as columns, with their keypoints in compressed rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from epipole._checks import Declared, check_index, checked


@dataclass(frozen=True, slots=True, eq=False)
class Images(Declared):
    """One row per image; keypoints of image i are keypoints_px[keypoint_offsets[i] : keypoint_offsets[i + 1]]."""

    name: tuple[str, ...]
    """Path relative to the image folder, with forward slashes."""
    frame: Int32[np.ndarray, " n"]
    sensor: Int32[np.ndarray, " n"]
    """Row in the sensor columns of Rigs."""
    keypoint_offsets: Int64[np.ndarray, " n1"]
    keypoints_px: Float64[np.ndarray, "m 2"]
    """Pixel (0, 0) is the center of the top-left pixel."""

    def __len__(self) -> int:
        return len(self.name)

    @checked
    def keypoints_of(self, image: int) -> Float64[np.ndarray, "k 2"]:
        """Keypoints of one image, in pixels."""
        check_index(image, "image", len(self))
        return self.keypoints_px[self.keypoint_offsets[image] : self.keypoint_offsets[image + 1]]

    def __repr__(self) -> str:
        return f"Images({len(self)}, {len(self.keypoints_px)} keypoints)"
