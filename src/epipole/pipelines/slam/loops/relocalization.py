"""Relocalization of a lost camera by the most similar keyframes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.loops.recognition import (
    Recognition,
    View,
    most_alike,
    recognize,
    rival_of,
    view_of,
)
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.scene import CameraRig

LATEST = 2
"""Newest keyframes of the map in which the camera was lost, to which each lost frame is matched."""
ALIKE = 4
"""Most similar keyframes of all maps to which each lost frame is matched: the time does not grow with the maps."""
PENALTY = 0.02
"""Similarity that a keyframe loses with each frame that was matched to it without success, so that others get their turn."""


class Relocalizer:
    """Matches lost frames to keyframes, and remembers to which since the camera was lost."""

    def __init__(self, camera: Camera | CameraRig, config: OdometryConfig) -> None:
        self.camera, self.config = camera, config
        self._num_failures: Counter[tuple[int, int]] = Counter()

    def clear(self) -> None:
        """Remove what was tried, when the camera is localized."""
        self._num_failures.clear()

    def search(
        self, gray: np.ndarray, maps: Sequence[SlamMap], lost_in: SlamMap
    ) -> Iterator[tuple[SlamMap, Recognition]]:
        """The pose of an image in each map where it is recognized, by the keyframe with most inliers.

        Args:
            gray: the image.
            maps: all maps, in the order in which they are tried.
            lost_in: the map in which the camera was tracked last.
        """
        corners = new_corners(gray, np.zeros((0, 2)), self.config, camera=self.camera)
        if not len(corners):
            return
        view = view_of(gray, corners)
        alike = self._most_alike(view, maps)
        for number, model in enumerate(maps):
            newest = range(max(0, len(model.keyframes) - LATEST), len(model.keyframes))
            chosen = [k for there, k in alike if there == number]
            found = self._recognized(
                view, model, list(dict.fromkeys([*chosen, *(newest if model is lost_in else ())]))
            )
            if found is not None:
                yield model, found

    def _most_alike(self, view: View, maps: Sequence[SlamMap]) -> list[tuple[int, int]]:
        """(map, keyframe) of the most similar keyframes."""
        ranked = []
        for number, model in enumerate(maps):
            for k, cosine in most_alike(view.descriptor, model, np.zeros(len(model.keyframes), bool), None):
                tried = self._num_failures[model.number, model.keyframes[k].number]
                ranked.append((PENALTY * tried - cosine, number, k))
        return [(number, k) for _, number, k in sorted(ranked)[:ALIKE]]

    def _recognized(self, view: View, model: SlamMap, keyframes: list[int]) -> Recognition | None:
        """The pose by the keyframe with most inliers; None if too few or ambiguous."""
        found = [recognize(view, model, k, self.camera, self.config) for k in keyframes]
        good = [f for f in found if not f.reason]
        for k in keyframes:  # a pose that is not confirmed is a failure, too; if it is, `clear` follows
            self._num_failures[model.number, model.keyframes[k].number] += 1
        if not good:
            return None
        best = max(good, key=lambda f: len(f.points))
        return best if rival_of(best, good, model, self.camera) is None else None
