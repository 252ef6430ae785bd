"""Images of a board that is known."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from epipole.geometry import Rotation3


def board_pictures(folder: Path, count: int = 12, moved_m: float = 0.0) -> dict[str, Any]:
    """Images of a chessboard of 9 x 6 inner corners before a pinhole camera, as files in IMAGES and as arrays.

    `moved_m` is how far to the right all boards are: of a camera beside the first, minus the baseline."""
    square_px, images = 40, []
    rows, columns = np.indices((7 * square_px, 10 * square_px)) // square_px
    board = np.pad(np.where((rows + columns) % 2, 255, 0).astype(np.uint8), square_px, constant_values=255)
    meters_from_pixel = np.array([[0.025 / square_px, 0, -0.15], [0, 0.025 / square_px, -0.11], [0, 0, 1]])
    K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]])
    (folder / "IMAGES").mkdir(parents=True)
    rng = np.random.default_rng(4)
    for number in range(count):
        rotation = Rotation3.exp(rng.uniform(-0.5, 0.5, 3)).matrix
        at = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.45, 0.6)])
        at[0] += moved_m
        plane = K @ np.column_stack([rotation[:, :2], at]) @ meters_from_pixel
        gray = cv2.warpPerspective(board, plane, (640, 480), flags=cv2.INTER_AREA, borderValue=200)
        images.append(np.ascontiguousarray(gray))
        Image.fromarray(gray).save(folder / "IMAGES" / f"{number:02d}.png")
    return {"images": images}
