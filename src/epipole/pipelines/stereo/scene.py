"""Viewer scene of a measured pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.pipelines.stereo.depth import point_covariances
from epipole.pipelines.stereo.files import StereoFiles, read_stereo
from epipole.pipelines.stereo.pairs import read_summary
from epipole.report.markup import count
from epipole.report.space_scene import CameraLayer, FirstView, PointLayer, PointMeasure, SpaceScene
from epipole.scene import DepthMap, RectifiedRig, depth_map_to_point_cloud

UNIT = "the unit of the baseline"
"""Meters if the baseline was specified in meters."""


def is_mine(path: Path) -> bool:
    """Whether a folder has the results of one or several pairs."""
    return (path / "disparity.pfm").is_file() or "done" in read_summary(path)


def scene(path: Path) -> SpaceScene:
    """The points of a pair and its left camera.

    Raises:
        FileFormatError: the folder has several pairs, or a pair without depth.
    """
    if not (path / "disparity.pfm").is_file():
        done = read_summary(path)["done"]
        hint = f": choose one, e.g. {path / str(done[0])}" if done else "; none was measured"
        raise FileFormatError(path, f"it holds several pairs{hint}")
    return scene_of_pair(read_stereo(path), path.resolve().name)


def is_pair_file(path: Path) -> bool:
    """Whether a file belongs to the results of a pair with depth."""
    own = path.name in ("depth.pfm", "disparity.pfm", "cloud.ply", "rig.json")
    return own and path.is_file() and (path.parent / "rig.json").is_file()


def scene_of_file(path: Path) -> SpaceScene:
    """The pair that a file belongs to.

    Raises:
        FileFormatError: a file is damaged.
    """
    return scene(path.parent)


def scene_of_pair(files: StereoFiles, title: str) -> SpaceScene:
    """Points with their uncertainties, and the left camera.

    Raises:
        FileFormatError: no pixel has a depth.
    """
    layer = points_of_depths(files.depths, files.sigma_depth, files.K, files.left_rgb)
    if not len(layer.xyz_in_world):
        raise FileFormatError(title, "no pixel of the pair has a depth")
    height, width = files.depths.shape
    camera = CameraLayer(
        "Left camera",
        ("left",),
        Rigid3.identity(1),
        files.K[None],
        np.array([[width, height]]),
        lambda _: files.left_rgb,
    )
    return SpaceScene(
        title=title,
        words=f"{count(len(layer.xyz_in_world))} of {count(width * height)} pixels have a depth",
        unit=UNIT,
        points=(layer,),
        cameras=camera,
        view=view_of_depths(layer.xyz_in_world),
    )


def points_of_depths(
    depths: np.ndarray, sigma: np.ndarray | None, K: np.ndarray, rgb: np.ndarray
) -> PointLayer:
    """The points of a depth map in the camera frame, with uncertainties if known."""
    cloud = depth_map_to_point_cloud(depths, K)
    depth = depths[cloud.mask].astype(np.float64)
    measures: tuple[PointMeasure, ...] = (PointMeasure("depth", depth),)
    covariances, words = None, ""
    if sigma is not None:
        relative = np.where(sigma[cloud.mask] > 0, sigma[cloud.mask], np.nan) / depth
        measures = (PointMeasure("depth error", 100.0 * relative.astype(np.float64), "% of depth"), *measures)
        known = DepthMap(depths.astype(np.float64), sigma.astype(np.float64), np.zeros(depths.shape))
        covariances = point_covariances(known, RectifiedRig(K[0, 0], K[0, 2], K[1, 2], 1.0))[cloud.mask]
        words = "from the disparity errors"
    return PointLayer("Points", cloud.points_in_cam, rgb[cloud.mask], measures, covariances, words)


def view_of_depths(points_in_cam: np.ndarray) -> FirstView:
    """View from beside the camera toward the median depth."""
    middle = float(np.median(points_in_cam[:, 2])) if len(points_in_cam) else 1.0
    position = middle * np.array([-0.25, -0.25, -0.2])
    return FirstView(position, np.array([0.0, 0.0, middle]), np.array([0.0, -1.0, 0.0]))
