"""Image coverage by corners; elsewhere the camera model is extrapolated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from epipole.pipelines.calibration.calibrate import Calibration

_CELLS = (12, 9)


def coverage(found: Calibration, camera: int) -> float:
    """Fraction of the image's 12 x 9 cells with used corners, or enclosed by such cells."""
    return float(covered_cells(found, camera).mean())


def covered_cells(found: Calibration, camera: int) -> Bool[np.ndarray, "9 12"]:
    """Cells between the outermost used corners of their row and of their column."""
    own = found.used_mask & (found.corners.camera == camera)
    pixels, intrinsics = found.corners.pixels[own], found.cameras[camera]
    columns, rows = _CELLS
    hit = np.zeros((rows, columns), bool)
    column = np.clip((pixels[:, 0] + 0.5) / intrinsics.width * columns, 0, columns - 1).astype(int)
    row = np.clip((pixels[:, 1] + 0.5) / intrinsics.height * rows, 0, rows - 1).astype(int)
    hit[row, column] = True
    across = np.logical_or.accumulate(hit, axis=1) & np.logical_or.accumulate(hit[:, ::-1], axis=1)[:, ::-1]
    down = np.logical_or.accumulate(hit, axis=0) & np.logical_or.accumulate(hit[::-1], axis=0)[::-1]
    return across | down


def covered_pixels(found: Calibration, camera: int) -> Float64[np.ndarray, "n 2"]:
    """Centers of the covered cells."""
    intrinsics, cells = found.cameras[camera], covered_cells(found, camera)
    row, column = np.nonzero(cells)
    u = (column + 0.5) / cells.shape[1] * intrinsics.width - 0.5
    v = (row + 0.5) / cells.shape[0] * intrinsics.height - 0.5
    return np.stack([u, v], axis=1)
