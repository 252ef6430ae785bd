"""The files of a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.disparity_search.rectification import rectify
from epipole.errors import EpipoleError
from epipole.io.calibration.files import CalibrationFile, write_calibration, write_opencv_yaml, write_ros_yaml
from epipole.pipelines.calibration.calibrate import Calibration
from epipole.pipelines.calibration.comparison import CrossCheck
from epipole.pipelines.calibration.verdict import Verdict
from epipole.scene import StereoRig


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRun:
    """Result of `calibrate`, as written to the output folder."""

    out: Path
    calibration: Calibration
    check: CrossCheck | None
    verdict: Verdict
    images: tuple[tuple[Path, ...], ...]
    """By `[camera][view]`."""
    problems: dict[str, str]
    """Images that could not be read, with reasons, and notes on images with different EXIF orientations."""

    def __repr__(self) -> str:
        return f"CalibrationRun({self.calibration!r}, {self.verdict.sentence!r}, in {self.out})"


def write_results(found: CalibrationRun, folder: Path) -> None:
    """Write the calibration as JSON with covariances, and for OpenCV and ROS."""
    content = calibration_file(found.calibration)
    about = _about(found.calibration, found.verdict, found.check)
    write_calibration(folder / "calibration.json", content, about)
    write_opencv_yaml(folder / "opencv.yaml", content)
    if len(found.calibration.cameras) == 1:
        write_ros_yaml(folder / "ros.yaml", found.calibration.cameras[0], "camera")
    else:
        _write_ros_pair(folder, found.calibration.rig())


def _write_ros_pair(out: Path, rig: StereoRig) -> None:
    """Write ROS files, which include the rectification; none if the pair cannot be rectified."""
    try:
        rectified = rectify(rig)
    except EpipoleError:
        return
    flat = rectified.rig
    for name, camera, rotation, offset in (
        ("left", rig.left, rectified.rectified_from_left, 0.0),
        ("right", rig.right, rectified.rectified_from_right, -flat.focal_px * flat.baseline),
    ):
        projection = np.column_stack([flat.K, [offset, 0.0, 0.0]])
        write_ros_yaml(out / f"ros_{name}.yaml", camera, name, rotation, projection)


def calibration_file(found: Calibration) -> CalibrationFile:
    """The calibration as written to disk."""
    covariance = found.rig().covariance if len(found.cameras) == 2 else None
    return CalibrationFile(found.cameras, found.state.cam_from_rig, covariance)


def _about(found: Calibration, verdict: Verdict, check: CrossCheck | None) -> dict[str, object]:
    about: dict[str, object] = {
        "verdict": verdict.sentence,
        "rms_px": found.rms_px,
        "corner_noise_px": found.uncertainty.noise_px,
        "sigmas_widened_by": None if check is None else check.widening,
        "params_sigma": [
            dict(zip(camera.model.param_names, found.params_sigma(c).tolist()))
            for c, camera in enumerate(found.cameras)
        ],
        "board_warp": found.state.warp.tolist(),
    }
    if len(found.cameras) == 2:
        about |= {"baseline": found.rig().baseline, "baseline_sigma": found.baseline_sigma()}
    return about
