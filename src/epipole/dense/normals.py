"""Normals of the surface that a depth image shows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import checked
from epipole.cameras import Camera
from epipole.dense import _fusion_kernels as kernels
from epipole.dense.view import intrinsics_of

REACH_PX, MOST_STEP = 3, 0.02
"""Pixels on each side whose difference gives the normal, and their largest relative difference of depth."""
_ROWS = 32


@checked
def normals_of(camera: Camera, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
    """Unit normals toward the camera, in its frame; NaN where unknown.

    Args:
        camera: the pinhole camera.
        depth: along the optical axis; NaN where unknown.
    """
    out, k = np.empty((*depth.shape, 3), np.float32), intrinsics_of(camera)
    _parallel.map_chunks(
        lambda start, stop, _: kernels.normal_rows(depth, k, REACH_PX, MOST_STEP, start, stop, out),
        len(depth),
        -(-len(depth) // _ROWS),
    )
    return out
