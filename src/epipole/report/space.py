"""The model as compact data for the 3D view: quantised points and camera frusta."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from epipole.scene import Curve, Extent, Reconstruction, extent_of, frustum_corners_in_cam, frustum_size

MAX_POINTS = 60_000
_RADIUS_PERCENT = 95.0
_FRUSTUM_SIZES = (0.02, 0.15)  # of the radius


def stage_of(reconstruction: Reconstruction) -> Extent:
    """What the first view shows: the bulk of the points and the bulk of the cameras."""
    points, centers = reconstruction.points.xyz_in_world, reconstruction.camera_centers_in_world()
    return extent_of(points, centers, _RADIUS_PERCENT)


def sample_points(reconstruction: Reconstruction, stage: Extent, max_points: int) -> Int64[np.ndarray, " n"]:
    """Rows of points on the stage, at most max_points, drawn evenly at random (always the same ones)."""
    rows = np.flatnonzero(stage.contains(reconstruction.points.xyz_in_world))
    if len(rows) <= max_points:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, max_points, replace=False))


def space_payload(
    reconstruction: Reconstruction, max_points: int = MAX_POINTS, curves: Sequence[Curve] = ()
) -> dict[str, Any]:
    """Points as 16-bit steps inside the stage and bytes of colour; frusta as corners around centres; lines as they are."""
    stage = stage_of(reconstruction)
    rows = sample_points(reconstruction, stage, max_points)
    span = stage.high - stage.low
    steps = np.rint((reconstruction.points.xyz_in_world[rows] - stage.low) / span * 65535.0)
    images = np.flatnonzero(reconstruction.is_registered())
    cams_from_world = reconstruction.cams_from_world()[images]
    centers, camera_of_image = cams_from_world.centers(), reconstruction.camera_of_image[images]
    cameras = [reconstruction.cameras[c] for c in range(len(reconstruction.cameras))]
    in_cam = [frustum_corners_in_cam(camera.K, camera.width, camera.height) for camera in cameras]
    # Directions from centre to corner in the world: R^T corner.
    corners = [in_cam[c] @ rotation for c, rotation in zip(camera_of_image, cams_from_world.rotation)]
    return {
        "low": _rounded(stage.low),
        "span": _rounded(span),
        "focus": _rounded(stage.focus),
        "radius": stage.radius,
        "size": frustum_size(centers, *(share * stage.radius for share in _FRUSTUM_SIZES)),
        "count": len(rows),
        "xyz": _base64(steps.astype("<u2")),
        "rgb": _base64(reconstruction.points.rgb[rows].astype(np.uint8)),
        "image": images.tolist(),
        "centers": [_rounded(c) for c in centers],
        "corners": [[round(float(v), 4) for v in c.ravel()] for c in corners],
        "curves": [
            {
                "name": curve.name,
                "rgb": f"rgb({','.join(map(str, curve.rgb))})",
                "shown": curve.is_shown,
                "xyz": _rounded(curve.segments_in_world.ravel()),
            }
            for curve in curves
        ],
    }


def _rounded(values: Float64[np.ndarray, " n"]) -> list[float]:
    return [float(f"{v:.7g}") for v in values]


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
