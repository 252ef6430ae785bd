"""What a live view shows, and how often it may: data and arithmetic without a server."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from epipole.geometry import Rigid3

PICTURE_WIDTH = 480
PLACED_RGB, WAITING_RGB = (60, 220, 110), (255, 170, 60)


@dataclass(frozen=True, slots=True, eq=False)
class LiveScene:
    """A path, its map and what is known now; the world has y down (a camera's axes)."""

    words: str
    """Counts, as Markdown."""
    places_in_world: Float64[np.ndarray, "n 3"]
    """Of the path so far."""
    path_in_world: Float64[np.ndarray, "m 2 3"]
    """Its pieces."""
    world_from_keyframes: Rigid3
    """(k,)."""
    points_in_world: Float64[np.ndarray, "p 3"]
    loops_in_world: Float64[np.ndarray, "l 2 3"]
    """Pieces between the ends of closed loops."""


class Budget:
    """Says when a view may be updated so that it takes no more than a share of the time since the begin."""

    def __init__(self, share: float, pause_s: float) -> None:
        self.share, self.pause_s = share, pause_s
        self.spent_s = self._cost_s = 0.0
        self._begin_s = perf_counter()
        self._last_s = -np.inf

    def allows(self) -> bool:
        """Whether the next update, as long as the last one, would stay within the share."""
        now = perf_counter()
        within = self.spent_s + self._cost_s <= self.share * (now - self._begin_s)
        return within and now - self._last_s >= self.pause_s

    def spend(self, seconds: float) -> None:
        """An update has taken this long."""
        self._cost_s, self._last_s = seconds, perf_counter()
        self.spent_s += seconds


def picture_with_points(
    grey: UInt8[np.ndarray, "h w"], pixels: Float64[np.ndarray, "n 2"], has_place: Bool[np.ndarray, " n"]
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture at `PICTURE_WIDTH`, with the points that have a place in green, and the others in orange."""
    scale = min(1.0, PICTURE_WIDTH / grey.shape[1])
    size = (max(1, round(scale * grey.shape[1])), max(1, round(scale * grey.shape[0])))
    small = cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB)
    for (x, y), known in zip((pixels + 0.5) * scale - 0.5, has_place):
        color = PLACED_RGB if known else WAITING_RGB
        cv2.circle(small, (round(x), round(y)), 2, color, -1, cv2.LINE_AA)
    return small


def frusta_pieces(
    world_from_cams: Rigid3, corners_in_cam: Float64[np.ndarray, "4 3"], size: float
) -> Float64[np.ndarray, "k 2 3"]:
    """The edges of cameras as pieces of lines: four from the centre, four around the picture."""
    count = len(world_from_cams.translation)
    centers = np.repeat(world_from_cams.translation[:, None], 4, axis=1)
    turned = np.einsum("nij,kj->nki", world_from_cams.rotation, size * corners_in_cam)
    corners = centers + turned
    edges = np.stack([np.stack([centers, corners], 2), np.stack([corners, np.roll(corners, 1, 1)], 2)], 1)
    return edges.reshape(8 * count, 2, 3)
