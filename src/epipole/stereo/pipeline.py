"""A pair of pictures to disparities, depth and points on disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole.config import StereoConfig
from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.geometry import depth_map_to_point_cloud
from epipole.io.atomic import atomic_folder, atomic_write
from epipole.io.depth_maps import read_pfm, write_pfm, write_png16
from epipole.io.photographs import read_rgb
from epipole.io.ply import write_points_ply
from epipole.scene import StereoRig
from epipole.stereo.calibration_error import calibration_sigma
from epipole.stereo.depth import DepthMap, RectifiedRig, depth_of, rectified_rig_of
from epipole.stereo.filling import FilledDisparities, fill_disparities
from epipole.stereo.matching import DisparityMap, match_stereo
from epipole.stereo.rectification import Rectification, rectify, within_both
from epipole.stereo.rows import MatchedPair, quick_warnings
from epipole.stereo.uncalibrated import UncalibratedRectification, rectify_uncalibrated

REASON_COLORS = np.array(
    [
        *([255, 255, 255], [200, 60, 50], [60, 90, 200], [230, 170, 40], [130, 60, 160], [120, 120, 120]),
        [90, 170, 150],
    ],
    np.uint8,
)
"""Of the values of `StereoReason` in `reasons.png`: white is known."""

_FITTED_WITH = (
    "window",
    "brightness_cost",
    "small_penalty",
    "edge_penalty",
    "edge_fade",
    "median_px",
    "block_px",
)

_MARKS = ("disparity.pfm", "sigma_disparity.pfm", "reasons.png")
ALWAYS_FILES = (
    "disparity.pfm",
    "disparity.png",
    "sigma_disparity.pfm",
    "reasons.png",
    "config.json",
    "report.html",
)
OPTIONAL_FILES = (
    *("depth.pfm", "sigma_depth.pfm", "cloud.ply", "homographies.json"),
    *("left.png", "right.png", "rig.json", "filled.pfm", "filled_mask.png"),
)
"""Those of an earlier run with more do not stay beside the disparities of one with less."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoResult:
    """What was found of a pair."""

    left_rgb: UInt8[np.ndarray, "h w 3"]
    """Rectified, as all maps are."""
    right_rgb: UInt8[np.ndarray, "h w 3"]
    disparities: DisparityMap
    rig: RectifiedRig | None
    """Of the rectified pair; None: there are disparities but no depth."""
    depths: DepthMap | None
    rectification: Rectification | UncalibratedRectification | None
    """None for a pair that came rectified."""
    warnings: tuple[str, ...]
    num_points: int
    filled: FilledDisparities | None = None
    """Guesses for the rest, where they were asked for."""
    out: Path | None = None
    """Where it was written."""

    def __repr__(self) -> str:
        depth = "no depth" if self.depths is None else f"{self.num_points} points"
        return f"StereoResult({self.disparities!r}, {depth}, in {self.out})"


def measure_pair(
    left_rgb: UInt8[np.ndarray, "h1 w1 3"],
    right_rgb: UInt8[np.ndarray, "h2 w2 3"],
    config: StereoConfig,
    rig: RectifiedRig | StereoRig | None = None,
) -> StereoResult:
    """Rectify where the rig says how, match, and turn disparities into depth where it says how far apart the cameras are.

    Raises:
        ShapeError: the pictures are no pair, or not of the calibration's size.
        ConfigError: left and right are swapped in the calibration, the range of disparities does not fit, or an uncalibrated
            pair has a rig.
        DegenerateGeometryError: the pair cannot be rectified.
    """
    left, right, flat, rectification = _rectified(left_rgb, right_rgb, config, rig)
    config = _down_to_infinity(config, flat)
    disparities = match_stereo(left, right, config)
    if rectification is not None:
        disparities = within_both(disparities, rectification.left_valid, rectification.right_valid)
    warnings = list(quick_warnings(left, right, _matched(disparities, config, isinstance(rig, StereoRig))))
    warnings += _limits(config, rig)
    depths, num_points = None, 0
    if flat is not None:
        wrong_px = None
        if (
            isinstance(rig, StereoRig)
            and rig.covariance is not None
            and isinstance(rectification, Rectification)
        ):
            wrong_px = calibration_sigma(rig, rectification, disparities.disparity_px)
        depths = depth_of(disparities, flat, wrong_px)
        num_points = int(np.isfinite(depths.depth).sum())
        if not num_points and disparities.density > 0:
            warnings.append(
                "no depth is positive and finite: every disparity plus the principal offset is zero or less"
            )
    filled = fill_disparities(disparities, left) if config.fill else None
    return StereoResult(
        left, right, disparities, flat, depths, rectification, tuple(warnings), num_points, filled
    )


class _RectifiedPair(NamedTuple):
    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    rig: RectifiedRig | None
    rectification: Rectification | UncalibratedRectification | None


def _rectified(
    left: np.ndarray, right: np.ndarray, config: StereoConfig, rig: RectifiedRig | StereoRig | None
) -> _RectifiedPair:
    if config.uncalibrated:
        if rig is not None:
            raise ConfigError(
                "uncalibrated means that nothing is known of the cameras: give no calibration with it"
            )
        unknown = rectify_uncalibrated(left, right)
        return _RectifiedPair(*unknown.apply(left, right), None, unknown)
    if isinstance(rig, StereoRig):
        rig.check_pictures(left, right)
        flat = rectified_rig_of(rig)
        if flat is not None:
            return _RectifiedPair(left, right, flat, None)
        rectification = rectify(rig)
        return _RectifiedPair(*rectification.apply(left, right), rectification.rig, rectification)
    if left.shape != right.shape:
        (h1, w1), (h2, w2) = left.shape[:2], right.shape[:2]
        raise ShapeError(f"left is {w1} x {h1} pixels and right {w2} x {h2}: a rectified pair has one size")
    return _RectifiedPair(left, right, rig, None)


def _limits(config: StereoConfig, rig: RectifiedRig | StereoRig | None) -> list[str]:
    """What cannot be said with these settings."""
    out = []
    default = StereoConfig()
    matters = [name for name in _FITTED_WITH if name != "block_px" or config.method == "block"]
    changed = [name for name in matters if getattr(config, name) != getattr(default, name)]
    if changed:
        words = (
            f"the error bars were fitted with the default {', '.join(changed)}; with yours they are rougher"
        )
        out.append(words)
    if config.uncalibrated:
        out.append(
            "without a calibration disparities stand for depth up to a projective change of space, which may turn its order"
        )
    if isinstance(rig, StereoRig) and rig.covariance is None:
        out.append("the calibration has no covariance: sigma_depth is that of the disparities alone")
    return out


def _down_to_infinity(config: StereoConfig, rig: RectifiedRig | None) -> StereoConfig:
    """The same with a range that begins where depth ends: where principal points differ far things have negative disparities."""
    if rig is None or config.min_disparity_px != 0 or rig.principal_offset_px <= 0:
        return config
    return replace(config, min_disparity_px=-int(np.ceil(rig.principal_offset_px)))


def _matched(disparities: DisparityMap, config: StereoConfig, is_calibrated: bool) -> MatchedPair:
    high = np.inf if config.max_disparity_px is None else float(config.max_disparity_px)
    return MatchedPair(disparities.density, (float(config.min_disparity_px), high), is_calibrated)


def check_output(out: Path, pictures: Sequence[Path]) -> None:
    """Refuse a folder in which something would be lost.

    Raises:
        WorkspaceError: a picture lies in it, or a file of a name that is written or removed, of no earlier run.
    """
    for picture in pictures:
        if picture.resolve().parent == out.resolve():
            raise WorkspaceError(f"{out} is the folder of {picture.name}: choose another for the results")
    if all((out / name).is_file() for name in _MARKS):
        return  # an earlier run's, finished or not
    for name in (*ALWAYS_FILES, *OPTIONAL_FILES):
        if (out / name).exists():
            raise WorkspaceError(
                f"{out} holds {name}, which no earlier run has written: choose another folder"
            )


def run_stereo(
    left: Path, right: Path, out: Path, config: StereoConfig, rig: RectifiedRig | StereoRig | None = None
) -> StereoResult:
    """Measure a pair of files and write what was found.

    Raises:
        FileFormatError: a picture cannot be read.
        ShapeError: the pictures are no pair.
        ConfigError: rig and options do not fit the pictures.
        WorkspaceError: the output folder cannot be used.
    """
    check_output(out, (left, right))
    return write_stereo(measure_pair(read_rgb(left), read_rgb(right), config, rig), out)


def write_stereo(result: StereoResult, out: Path) -> StereoResult:
    """Write `disparity.pfm`, `disparity.png`, `sigma_disparity.pfm`, `reasons.png`; and more where there is more.

    With a rig `depth.pfm`, `sigma_depth.pfm`, `cloud.ply`, `rig.json` and the rectified pair, `left.png` and `right.png`;
    of an uncalibrated pair the rectified pair and `homographies.json`.

    Raises:
        WorkspaceError: the output folder cannot be used.
    """
    found, depths, rig = result.disparities, result.depths, result.rig
    with atomic_folder(out, stale=OPTIONAL_FILES) as aside:
        write_pfm(aside / "disparity.pfm", found.disparity_px)
        write_png16(aside / "disparity.png", found.disparity_px)
        write_pfm(aside / "sigma_disparity.pfm", found.sigma_px)
        write_picture(aside / "reasons.png", REASON_COLORS[found.reason])
        if result.filled is not None:
            write_pfm(aside / "filled.pfm", result.filled.disparity_px)
            mask = 255 * result.filled.filled_mask.astype(np.uint8)
            write_picture(aside / "filled_mask.png", np.repeat(mask[..., None], 3, axis=2))
        if result.rectification is not None or depths is not None:
            write_picture(aside / "left.png", result.left_rgb)
            write_picture(aside / "right.png", result.right_rgb)
        if isinstance(result.rectification, UncalibratedRectification):
            text = json.dumps(_homographies(result.rectification), indent=1)
            (aside / "homographies.json").write_text(text + "\n", encoding="utf-8")
        if depths is not None and rig is not None:
            write_pfm(aside / "depth.pfm", depths.depth)
            write_pfm(aside / "sigma_depth.pfm", depths.sigma)
            cloud = depth_map_to_point_cloud(depths.depth, rig.K)
            write_points_ply(aside / "cloud.ply", cloud.points_in_cam, result.left_rgb[cloud.mask])
            text = json.dumps(_described(rig, result.rectification), indent=1)
            (aside / "rig.json").write_text(text + "\n", encoding="utf-8")
    return replace(result, out=out)


def write_picture(path: Path, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a PNG.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    _, data = cv2.imencode(".png", rgb[..., ::-1])
    with atomic_write(path) as aside:
        aside.write_bytes(data.tobytes())


@dataclass(frozen=True, slots=True, eq=False)
class StereoFiles:
    """What `write_stereo` wrote of a pair with a rig."""

    left_rgb: UInt8[np.ndarray, "h w 3"]
    depths: Float32[np.ndarray, "h w"]
    sigma_depth: Float32[np.ndarray, "h w"]
    K: Float64[np.ndarray, "3 3"]


def read_stereo(out: Path) -> StereoFiles:
    """Read depth back.

    Raises:
        FileFormatError: there is none, because the pair had no rig, or a file is damaged.
    """
    if not (out / "depth.pfm").is_file():
        raise FileFormatError(
            out, "it holds disparities but no depth: give focal length and baseline, or a calibration"
        )
    try:
        K = np.array(json.loads((out / "rig.json").read_text())["K"], np.float64).reshape(3, 3)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(out / "rig.json", "it is missing or damaged") from error
    files = StereoFiles(
        read_rgb(out / "left.png"), read_pfm(out / "depth.pfm"), read_pfm(out / "sigma_depth.pfm"), K
    )
    if not files.left_rgb.shape[:2] == files.depths.shape == files.sigma_depth.shape:
        raise FileFormatError(out, "its pictures and maps are not of one size")
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
        "is_turned": rectification.is_turned,
    }
