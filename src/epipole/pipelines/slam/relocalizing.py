"""Where a lost camera is: corners compared with the map's points as keyframes saw them."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.config import MatchConfig, RansacConfig
from epipole.features import match_descriptors, root_sift
from epipole.geometry import Rigid3
from epipole.mapping import refine_pose
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.corners import new_corners
from epipole.pipelines.slam.slam_map import SlamMap
from epipole.robust import estimate_absolute_pose

PATCH_PX = 10.0
"""Size of the described neighbourhood, as SIFT's keypoints state it; held upright, as cameras mostly are."""
LATEST, OTHERS = 4, 6
"""Keyframes that are tried with each lost frame: the last ones, and others in turn."""
MIN_AGREEING = 25
"""A chance agreement of wrong matches has fewer (of patches that look alike it may have more: hence the share, too)."""
MIN_SHARE = 0.4


class Relocalizer:
    """Finds the camera again. Descriptors of keyframes are made when they are first needed."""

    def __init__(self, model: SlamMap, camera: Camera, config: SlamConfig) -> None:
        self.map, self.camera, self.config = model, camera, config
        self._descriptors: dict[int, np.ndarray] = {}
        self._turn = 0

    def find(self, grey: np.ndarray) -> tuple[Rigid3, np.ndarray, np.ndarray] | None:
        """(cam_from_world, pixels, points) by the keyframe with most points in agreement; None if none has enough."""
        corners = new_corners(grey, np.zeros((0, 2)), self.config)
        if len(corners) < MIN_AGREEING:
            return None
        mine = _described(grey, corners)
        best: tuple[Rigid3, np.ndarray, np.ndarray] | None = None
        for number in self._candidates():
            found = self._by_keyframe(number, corners, mine)
            if found is not None and (best is None or len(found[2]) > len(best[2])):
                best = found
        return best

    def _candidates(self) -> list[int]:
        count = len(self.map.keyframes)
        latest = list(range(max(0, count - LATEST), count))[::-1]
        others = [(self._turn + n) % count for n in range(min(OTHERS, count))]
        self._turn = (self._turn + OTHERS) % count
        return list(dict.fromkeys([*latest, *others]))

    def _by_keyframe(
        self, number: int, corners: np.ndarray, mine: np.ndarray
    ) -> tuple[Rigid3, np.ndarray, np.ndarray] | None:
        keyframe = self.map.keyframes[number]
        if number not in self._descriptors or len(self._descriptors[number]) != len(keyframe.point):
            self._descriptors[number] = _described(keyframe.grey, keyframe.pixels)
        placed = np.flatnonzero(self.map.has_place(keyframe.point))
        matches = match_descriptors(mine, self._descriptors[number][placed], MatchConfig(max_ratio=0.85))
        if len(matches) < MIN_AGREEING:
            return None
        pixels, points = corners[matches[:, 0]], keyframe.point[placed[matches[:, 1]]]
        limit = self.config.max_error_px
        ransac = RansacConfig(max_error_px=limit, min_inliers=MIN_AGREEING, seed=self.config.seed)
        sought = estimate_absolute_pose(self.map.xyz[points], pixels, self.camera, ransac)
        if not sought.success:
            return None
        refined = refine_pose(self.map.xyz[points], pixels, self.camera, sought.model)
        agrees = refined.error_sq <= limit**2
        if agrees.sum() < max(MIN_AGREEING, MIN_SHARE * len(matches)):
            return None
        return refined.cam_from_world, pixels[agrees], points[agrees]


def _described(grey: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """RootSIFT of upright patches of one size around points."""
    keypoints = [cv2.KeyPoint(float(x), float(y), PATCH_PX, 0.0, 1.0, 0) for x, y in pixels]
    described, values = cv2.SIFT.create().compute(grey, keypoints)
    if len(described) != len(pixels) or values is None:
        return np.zeros((len(pixels), 128), np.uint8)
    return root_sift(values)
