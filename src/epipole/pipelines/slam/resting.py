"""Parts of the picture that rest while others move: the scene before a camera at rest, or things that go along with a moving one.

Pictures alone cannot tell the two apart. A moving camera leaves nothing at rest, to half a pixel, but what goes along with it
and what is far away: a large part of the picture that rests is taken for the scene, and that is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from epipole.cameras import Camera

REST_PX, MOVING_PX, OFF_PX, OFF = 0.5, 3.0, 0.5, 3.0
"""Points that move less rest, and those that move more move; a motion that is off by more, and by so many times what it is off
by for points that move, does not explain points at rest."""
COLUMNS, ROWS = 8, 6
"""Cells of the picture: a thing with much texture has more points than its share of the picture."""
LEAST_SHARE, SCENE_SHARE = 0.1, 0.3
"""Of the cells with points: fewer at rest say nothing; more are the scene."""
LEAST_POINTS = 8
BETWEEN, BETWEEN_SHARE = 0.4, 0.12
"""Points at all depths move at all speeds: such a share of the moving ones is slower than this part of their median."""
AT_REST = "the camera is taken to rest, and what moves to pass by"
GOES_ALONG = "that part is taken to go along with the camera, or to be far away"


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What rests in a picture whose other points move."""

    mask: Bool[np.ndarray, " n"]
    """Points at rest."""
    share: float
    """Of the picture."""
    is_scene: bool
    """Whether the camera is taken to rest."""

    def in_words(self) -> str:
        """What is made of it."""
        taken = AT_REST if self.is_scene else GOES_ALONG
        return f"{100 * self.share:.0f} % of the picture rests while the rest of it moves: {taken}"


def resting_part(
    pixels_before: np.ndarray, pixels: np.ndarray, errors_px: np.ndarray, camera: Camera
) -> Rest | None:
    """What rests in the picture beside points that move; None where it says nothing.

    Args:
        pixels_before: (n, 2) in an earlier picture.
        pixels: (n, 2) of the same points.
        errors_px: (n,) by which they are off from where a motion, the camera's or a thing's, says.
        camera: of the pictures.
    """
    shift = np.linalg.norm(pixels - pixels_before, axis=1)
    moves = (shift > MOVING_PX) & (errors_px < shift)
    off_px = max(OFF_PX, OFF * float(np.median(errors_px[moves]))) if moves.any() else np.inf
    rests = (shift < REST_PX) & (errors_px > off_px)
    column = np.clip(pixels_before[:, 0] * COLUMNS / camera.width, 0, COLUMNS - 1).astype(int)
    row = np.clip(pixels_before[:, 1] * ROWS / camera.height, 0, ROWS - 1).astype(int)
    resting, moving = (
        np.bincount((row * COLUMNS + column)[mask], minlength=ROWS * COLUMNS) for mask in (rests, moves)
    )
    num_cells = int(((resting > 0) | (moving > 0)).sum())
    share = float((resting > moving).sum() / max(num_cells, 1))
    if share < LEAST_SHARE or rests.sum() < LEAST_POINTS or not moves.any():
        return None
    return Rest(rests, share, share >= SCENE_SHARE)


def is_ambiguous_start(pixels_before: np.ndarray, pixels: np.ndarray, camera: Camera) -> Rest | None:
    """What rests where a camera at rest before a moving thing explains all points; None where it does not.

    To one camera that is the same as a camera that moves past something near, before things too far away to move.
    """
    shift = np.linalg.norm(pixels - pixels_before, axis=1)
    moves = shift >= REST_PX
    rest = resting_part(pixels_before, pixels, np.where(moves, 0.0, np.inf), camera)
    if rest is None or rest.is_scene:
        return rest
    is_gap = (shift[moves] < BETWEEN * np.median(shift[moves])).mean() < BETWEEN_SHARE
    return rest if is_gap else None
