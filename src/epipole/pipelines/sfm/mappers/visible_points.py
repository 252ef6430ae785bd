"""Which points of a growing model the waiting images see, counted again only where they have changed."""

from __future__ import annotations

import numpy as np

from epipole.mapping import ModelBuilder
from epipole.mapping.match_components import rows_of_groups


class VisiblePoints:
    """Numbers and distribution of the points that each image sees if its matches are right.

    Registering an image changes the points of some components. Only images with keypoints in these are counted and scored again.
    """

    def __init__(self, model: ModelBuilder) -> None:
        self._model = model
        self._use_components()

    def _use_components(self) -> None:
        """Count everything again."""
        self._components, num_images = self._model.components, len(self._model.registered)
        self._had_point, self._time = np.zeros(len(self._components), bool), 0
        self._is_outdated = np.zeros(num_images, bool)
        self._count, self._score = np.zeros(num_images, np.int64), np.zeros(num_images)

    def update(self) -> None:
        """Notice which components have points now; to be called before the others."""
        model = self._model
        if model.components is not self._components:
            self._use_components()
        changed = model.changes.since(self._time)
        self._time = model.changes.now
        has_point = model.has_point(changed)
        rows = rows_of_groups(model.components.offsets, changed[has_point != self._had_point[changed]])
        self._is_outdated[model.row_image[rows]] = True
        self._had_point[changed] = has_point

    def count(self, image: int) -> int:
        """Number of keypoints whose component has a point."""
        if self._is_outdated[image]:
            self._count[image], self._score[image] = len(self._rows(image)), np.nan
            self._is_outdated[image] = False
        return int(self._count[image])

    def score(self, image: int) -> float:
        """`spread_score` of these keypoints."""
        if self.count(image) and np.isnan(self._score[image]):
            camera = self._model.cameras[int(self._model.camera_of_image[image])]
            pixels = self._model.row_pixel[self._rows(image)]
            self._score[image] = spread_score(pixels, camera.width, camera.height)
        return float(self._score[image]) if self._count[image] else 0.0

    def _rows(self, image: int) -> np.ndarray:
        rows = self._model.rows_of_image[image]
        return np.asarray(rows[self._had_point[self._model.row_component[rows]]])


def spread_score(pixels: np.ndarray, width: int, height: int, levels: int = 6) -> float:
    """Number and distribution of visible points: occupied cells on finer and finer grids, weighted by 4^level.

    The visibility pyramid of Schoenberger and Frahm (CVPR 2016, section 4.2).
    """
    score = 0.0
    for level in range(1, levels + 1):
        cells = 1 << level
        x = np.clip(pixels[:, 0] * cells / width, 0, cells - 1).astype(int)
        y = np.clip(pixels[:, 1] * cells / height, 0, cells - 1).astype(int)
        score += len(np.unique(y * cells + x)) * 4.0**level
    return score
