"""Image points that stay still while others move: a static scene and a moving object, or a moving camera and something attached to it.

Images alone cannot distinguish the two. A moving camera keeps only two kinds of points still to half a pixel: points that move
with it, and points that are far away. If a large part of the image is static, the camera is therefore assumed to be at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from epipole.cameras import Camera

STATIC_PX = 0.5
"""A point that moves less is static, in pixels."""
MOVING_PX = 3.0
"""A point that moves more is moving, in pixels."""
MIN_ERROR_PX = 0.5
"""A motion contradicts a static point if it predicts it at least this far away, in pixels."""
MIN_ERROR_RATIO = 3.0
"""... and this many times as far as the moving points are from their predictions (median)."""
COLUMNS, ROWS = 8, 6
"""Grid cells of the image. Cells are counted instead of points, since textured objects have more points per area."""
MIN_FRACTION = 0.1
"""Smaller static fractions of the occupied cells are ignored."""
SCENE_FRACTION = 0.3
"""A larger static fraction is assumed to be the scene."""
MIN_POINTS = 8
SLOW, MIN_SLOW_FRACTION = 0.4, 0.12
"""In a scene with points at all depths, at least this fraction of the moving points moves slower than SLOW times their median."""
CAMERA_AT_REST = "the camera is assumed to be at rest, and the moving part to be an object"
MOVES_ALONG = "the static part is assumed to be far away or attached to the camera"


@dataclass(frozen=True, slots=True, eq=False)
class StaticPart:
    """The static part of an image in which other points move."""

    mask: Bool[np.ndarray, " n"]
    """Static points."""
    fraction: float
    """Of the occupied grid cells."""
    is_scene: bool
    """Whether the camera is assumed to be at rest."""

    def in_words(self) -> str:
        """For the user: how large it is, and what is assumed."""
        assumed = CAMERA_AT_REST if self.is_scene else MOVES_ALONG
        return f"{100 * self.fraction:.0f} % of the image is static while the rest moves: {assumed}"


def find_static_part(
    pixels_before: np.ndarray, pixels: np.ndarray, errors_px: np.ndarray, camera: Camera
) -> StaticPart | None:
    """The static part of an image that contradicts the motion of its other points; None if there is none.

    Args:
        pixels_before: (n, 2) in an earlier image.
        pixels: (n, 2) of the same points now.
        errors_px: (n,) distance of each point from where the motion predicts it.
        camera: of the images.
    """
    shift = np.linalg.norm(pixels - pixels_before, axis=1)
    moves = (shift > MOVING_PX) & (errors_px < shift)
    if not moves.any():
        return None
    min_error_px = max(MIN_ERROR_PX, MIN_ERROR_RATIO * float(np.median(errors_px[moves])))
    is_static = (shift < STATIC_PX) & (errors_px > min_error_px)
    column = np.clip(pixels_before[:, 0] * COLUMNS / camera.width, 0, COLUMNS - 1).astype(int)
    row = np.clip(pixels_before[:, 1] * ROWS / camera.height, 0, ROWS - 1).astype(int)
    num_static, num_moving = (
        np.bincount((row * COLUMNS + column)[mask], minlength=ROWS * COLUMNS) for mask in (is_static, moves)
    )
    fraction = float((num_static > num_moving).sum() / ((num_static > 0) | (num_moving > 0)).sum())
    if fraction < MIN_FRACTION or is_static.sum() < MIN_POINTS:
        return None
    return StaticPart(is_static, fraction, fraction >= SCENE_FRACTION)


def find_ambiguous_part(pixels_before: np.ndarray, pixels: np.ndarray, camera: Camera) -> StaticPart | None:
    """The static part of an image if a camera at rest before a moving object explains all points; None if it does not.

    For one camera this looks the same as moving past a near object in front of a distant background.
    """
    shift = np.linalg.norm(pixels - pixels_before, axis=1)
    moves = shift >= STATIC_PX
    static = find_static_part(pixels_before, pixels, np.where(moves, 0.0, np.inf), camera)
    if static is None or static.is_scene:
        return static
    has_gap = (shift[moves] < SLOW * np.median(shift[moves])).mean() < MIN_SLOW_FRACTION
    return static if has_gap else None
