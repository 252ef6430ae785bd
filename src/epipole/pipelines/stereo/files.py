"""Reading and writing the files of a measured pair."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole.disparity_search.rectification import Rectification
from epipole.errors import FileFormatError
from epipole.image.encoding import encoded_image
from epipole.io.atomic import atomic_write
from epipole.io.files import read_json
from epipole.io.images.depth_maps import read_pfm, write_pfm, write_png16
from epipole.io.images.photographs import read_rgb
from epipole.io.json_files import json_text
from epipole.io.meshes.ply import write_points_ply
from epipole.pipelines.stereo.pair import StereoResult
from epipole.pipelines.stereo.uncalibrated import UncalibratedRectification
from epipole.scene import RectifiedRig, depth_map_to_point_cloud

REASON_COLORS = np.array(
    [
        [255, 255, 255],
        [200, 60, 50],
        [60, 90, 200],
        [230, 170, 40],
        [130, 60, 160],
        [120, 120, 120],
        [90, 170, 150],
    ],
    np.uint8,
)
"""Colors of the values of `StereoReason` in `reasons.png`; white: known."""


def write_stereo(result: StereoResult, folder: Path) -> None:
    """Write `disparity.pfm`, `disparity.png`, `sigma_disparity.pfm`, `reasons.png`, and more.

    With a rig also `depth.pfm`, `sigma_depth.pfm`, `cloud.ply`, `rig.json` and the rectified pair, `left.png` and
    `right.png`; for an uncalibrated pair also the rectified pair and `homographies.json`.

    Raises:
        WorkspaceError: the output folder cannot be used.
    """
    found, depths, rig = result.disparities, result.depths, result.rig
    write_pfm(folder / "disparity.pfm", found.disparity_px)
    write_png16(folder / "disparity.png", found.disparity_px)
    write_pfm(folder / "sigma_disparity.pfm", found.sigma_px)
    write_image(folder / "reasons.png", REASON_COLORS[found.reason])
    if result.filled is not None:
        write_pfm(folder / "filled.pfm", result.filled.disparity_px)
        mask = 255 * result.filled.filled_mask.astype(np.uint8)
        write_image(folder / "filled_mask.png", np.repeat(mask[..., None], 3, axis=2))
    if result.rectification is not None or depths is not None:
        write_image(folder / "left.png", result.left_rgb)
        write_image(folder / "right.png", result.right_rgb)
    if isinstance(result.rectification, UncalibratedRectification):
        text = json_text(_homographies(result.rectification), indent=1)
        (folder / "homographies.json").write_text(text, encoding="utf-8")
    if depths is not None and rig is not None:
        write_pfm(folder / "depth.pfm", depths.depth)
        write_pfm(folder / "sigma_depth.pfm", depths.sigma)
        cloud = depth_map_to_point_cloud(depths.depth, rig.K)
        write_points_ply(folder / "cloud.ply", cloud.points_in_cam, result.left_rgb[cloud.mask])
        text = json_text(_described(rig, result.rectification), indent=1)
        (folder / "rig.json").write_text(text, encoding="utf-8")


def write_image(path: Path, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a PNG.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    data = encoded_image(".png", rgb[..., ::-1])
    with atomic_write(path) as aside:
        aside.write_bytes(data)


@dataclass(frozen=True, slots=True, eq=False)
class StereoFiles:
    """The files that `write_stereo` writes for a pair with a rig."""

    left_rgb: UInt8[np.ndarray, "h w 3"]
    depths: Float32[np.ndarray, "h w"]
    sigma_depth: Float32[np.ndarray, "h w"]
    K: Float64[np.ndarray, "3 3"]


def read_stereo(out: Path) -> StereoFiles:
    """Read the depth of a pair.

    Raises:
        FileFormatError: there is none, since the pair had no rig, or a file is damaged.
    """
    if not (out / "depth.pfm").is_file():
        raise FileFormatError(
            out, "it has disparities but no depth: pass focal length and baseline, or a calibration"
        )
    try:
        K = np.array(read_json(out / "rig.json")["K"], np.float64).reshape(3, 3)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise FileFormatError(out / "rig.json", "it is missing or damaged") from error
    if not np.isfinite(K).all():
        raise FileFormatError(out / "rig.json", "its camera matrix is not finite")
    files = StereoFiles(
        read_rgb(out / "left.png"), read_pfm(out / "depth.pfm"), read_pfm(out / "sigma_depth.pfm"), K
    )
    if not files.left_rgb.shape[:2] == files.depths.shape == files.sigma_depth.shape:
        raise FileFormatError(out, "its images and maps have different sizes")
    return files


def _homographies(found: UncalibratedRectification) -> dict[str, object]:
    offset = np.abs(found.vertical_px)
    return {
        "rectified_from_left_px": found.rectified_from_left_px.tolist(),
        "rectified_from_right_px": found.rectified_from_right_px.tolist(),
        "num_matches": len(offset),
        "vertical_median_px": float(np.median(offset)),
        "vertical_p95_px": float(np.percentile(offset, 95)),
    }


def _described(
    rig: RectifiedRig, rectification: Rectification | UncalibratedRectification | None
) -> dict[str, object]:
    about: dict[str, object] = {
        "K": rig.K.tolist(),
        "baseline": rig.baseline,
        "principal_offset_px": rig.principal_offset_px,
    }
    if not isinstance(rectification, Rectification):
        return about
    width, height = rectification.size
    return {
        **about,
        "width": width,
        "height": height,
        "rectified_from_left": rectification.rectified_from_left.tolist(),
        "rectified_from_right": rectification.rectified_from_right.tolist(),
        "Q": rectification.Q.tolist(),
        "is_rotated": rectification.is_rotated,
    }
