"""What the viewer shows of a measured pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.image import color_map
from epipole.pipelines.stereo.files import StereoFiles, read_stereo
from epipole.pipelines.stereo.pairs import read_summary
from epipole.scene import depth_map_to_point_cloud
from epipole.viewer import DepthView, ViewerHandle, view_depth


def is_mine(path: Path) -> bool:
    """Whether a folder holds a measured pair, or several."""
    return (path / "disparity.pfm").is_file() or "done" in read_summary(path)


def show(path: Path, *, port: int | None, host: str, block: bool) -> ViewerHandle:
    """The points of a pair, before the camera that saw them.

    Raises:
        FileFormatError: the folder holds several pairs, or one without depth.
    """
    if not (path / "disparity.pfm").is_file():
        done = read_summary(path)["done"]
        hint = f": choose one, {path / str(done[0])} for one" if done else "; none was measured"
        raise FileFormatError(path, f"it holds several pairs{hint}")
    return view_depth(depth_view(read_stereo(path)), port=port, host=host, block=block)


def depth_view(files: StereoFiles) -> DepthView:
    """Points and pictures of a pair, as the viewer takes them."""
    cloud = depth_map_to_point_cloud(files.depths, files.K)
    depth = files.depths[cloud.mask].astype(np.float64)
    with np.errstate(invalid="ignore"):
        logarithm = np.log(np.where(files.depths > 0, files.depths, np.nan))
    return DepthView(
        cloud.points_in_cam,
        files.left_rgb[cloud.mask],
        np.nan_to_num(files.sigma_depth[cloud.mask] / depth, nan=np.inf).astype(np.float64),
        files.left_rgb,
        color_map(logarithm),
        float(files.K[0, 0]),
    )
