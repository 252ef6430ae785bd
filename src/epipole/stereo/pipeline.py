"""A rectified pair of files to disparities, depth and points on disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole.config import StereoConfig
from epipole.errors import ShapeError
from epipole.geometry import depth_map_to_point_cloud
from epipole.io.atomic import atomic_folder, atomic_write
from epipole.io.depth_maps import write_pfm, write_png16
from epipole.io.photographs import read_rgb
from epipole.io.ply import write_points_ply
from epipole.stereo.depth import DepthMap, RectifiedRig, depth_of
from epipole.stereo.matching import DisparityMap, match_stereo

REASON_COLORS = np.array(
    [[255, 255, 255], [200, 60, 50], [60, 90, 200], [230, 170, 40], [130, 60, 160], [120, 120, 120]], np.uint8
)
"""Of the values of `StereoReason` in `reasons.png`: white is known."""

DEPTH_FILES = ("depth.pfm", "sigma_depth.pfm", "cloud.ply")
"""Those of an earlier run with a rig do not stay beside the disparities of one without."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoResult:
    """What `run_stereo` has found and written."""

    out: Path
    left_rgb: UInt8[np.ndarray, "h w 3"]
    right_rgb: UInt8[np.ndarray, "h w 3"]
    disparities: DisparityMap
    depths: DepthMap | None
    """None without a rig: disparities alone say nothing of metres."""
    num_points: int

    def __repr__(self) -> str:
        depth = "no depth" if self.depths is None else f"{self.num_points} points"
        return f"StereoResult({self.disparities!r}, {depth}, in {self.out})"


def run_stereo(
    left: Path, right: Path, out: Path, config: StereoConfig, rig: RectifiedRig | None = None
) -> StereoResult:
    """Match a rectified pair and write `disparity.pfm`, `disparity.png`, `sigma_disparity.pfm`, `reasons.png`.

    With a rig also `depth.pfm`, `sigma_depth.pfm` and `cloud.ply`.

    Raises:
        FileFormatError: a picture cannot be read.
        ShapeError: the pictures are no pair.
        WorkspaceError: the output folder cannot be used.
    """
    left_rgb, right_rgb = read_rgb(left), read_rgb(right)
    if left_rgb.shape != right_rgb.shape:
        (h1, w1), (h2, w2) = left_rgb.shape[:2], right_rgb.shape[:2]
        raise ShapeError(
            f"{left} is {w1} x {h1} pixels and {right} {w2} x {h2}: a rectified pair has one size"
        )
    disparities = match_stereo(left_rgb, right_rgb, config)
    depths = None if rig is None else depth_of(disparities, rig)
    num_points = 0
    with atomic_folder(out, stale=DEPTH_FILES) as aside:
        write_pfm(aside / "disparity.pfm", disparities.disparity_px)
        write_png16(aside / "disparity.png", disparities.disparity_px)
        write_pfm(aside / "sigma_disparity.pfm", disparities.sigma_px)
        write_picture(aside / "reasons.png", REASON_COLORS[disparities.reason])
        if depths is not None and rig is not None:
            write_pfm(aside / "depth.pfm", depths.depth)
            write_pfm(aside / "sigma_depth.pfm", depths.sigma)
            cloud = depth_map_to_point_cloud(depths.depth, rig.K)
            write_points_ply(aside / "cloud.ply", cloud.points_in_cam, left_rgb[cloud.mask])
            num_points = len(cloud)
    return StereoResult(out, left_rgb, right_rgb, disparities, depths, num_points)


def write_picture(path: Path, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a PNG.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    _, data = cv2.imencode(".png", rgb[..., ::-1])
    with atomic_write(path) as aside:
        aside.write_bytes(data.tobytes())
