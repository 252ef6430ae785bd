"""Surface normals from depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ShapeError


@checked
def normals_of(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Unit normals in the camera frame, facing the camera, from the differences of neighboring pixels' positions.

    Args:
        depth: along the optical axis, NaN where unknown.
        camera: pinhole camera of the same size.

    Returns:
        NaN at pixels with an unknown neighbor above, below, left or right.

    Raises:
        ShapeError: depth and camera have different sizes.
    """
    if depth.shape != (camera.height, camera.width):
        raise ShapeError(f"depth is {depth.shape[::-1]}, but its camera is {camera.width} x {camera.height}")
    row, column = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([column, row], axis=2).reshape(-1, 2).astype(np.float64))
    positions = (rays / rays[:, 2:]).reshape(*depth.shape, 3) * depth.astype(np.float64)[..., None]
    out = np.full(positions.shape, np.nan)
    right = positions[1:-1, 2:] - positions[1:-1, :-2]
    down = positions[2:, 1:-1] - positions[:-2, 1:-1]
    across = np.cross(down, right)  # y points down, so this faces the camera
    with np.errstate(invalid="ignore", divide="ignore"):
        out[1:-1, 1:-1] = across / np.linalg.norm(across, axis=2, keepdims=True)
    return out
