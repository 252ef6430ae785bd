"""The stereo commands: which job it is, from what was given."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from epipole.cli.screen import (
    progress_on_screen,
    show_batch,
    show_diagnosis,
    show_stereo,
    waiting_for_kernels,
)
from epipole.config import CalibrationOptions, RigOptions, StereoConfig
from epipole.errors import ConfigError

if TYPE_CHECKING:
    from epipole.scene import StereoRig
    from epipole.stereo import RectifiedRig


_SIGMAS = ("focal_sigma_px", "baseline_sigma", "principal_offset_sigma_px")


def run_stereo(
    paths: tuple[Path, ...],
    config: StereoConfig,
    options: RigOptions,
    calibrated: CalibrationOptions,
    of_model: tuple[Path | None, tuple[str, str] | None],
) -> bool:
    """One pair, many pairs, or two pictures of a model; whether all pairs were measured.

    Raises:
        ConfigError: what was given does not say which pair.
    """
    workspace, pair = of_model
    if workspace is not None or pair is not None:
        if workspace is None or pair is None or len(paths) != 1:
            raise ConfigError("a pair of a model is given as: --workspace W --pair A B OUT")
        if calibrated != CalibrationOptions() or options != RigOptions():
            raise ConfigError(
                "the model says where its cameras are: give no calibration, focal length or baseline"
            )
        with waiting_for_kernels():
            from epipole.api import stereo_of_model

            result = stereo_of_model(workspace, pair[0], pair[1], paths[0], config)
        show_stereo(result)
        return True
    if len(paths) != 3:
        raise ConfigError(f"expected LEFT RIGHT OUT, got {len(paths)} paths")
    left, right, out = paths
    from epipole.stereo.batch import is_many

    if is_many(left, right):
        with progress_on_screen() as progress:
            from epipole.api import stereo_many

            batch = stereo_many(left, right, out, config, rig_of(left, right, options, calibrated), progress)
        show_batch(batch)
        if not (batch.done or batch.earlier):
            raise ConfigError("no pair could be measured")
        return not batch.problems
    with waiting_for_kernels():
        from epipole.api import stereo

        result = stereo(left, right, out, config, rig_of(left, right, options, calibrated))
    show_stereo(result)
    return True


def run_doctor(
    left: Path, right: Path, options: RigOptions, calibrated: CalibrationOptions, *, as_json: bool
) -> bool:
    """Examine and print; whether nothing is wrong."""
    with waiting_for_kernels():
        from epipole.api import examine_stereo

        found = examine_stereo(left, right, rig_of(left, right, options, calibrated))
    if as_json:
        from json import dumps

        content = asdict(found) | {
            "cause": found.cause.value,
            "vertical_map_px": found.vertical_map_px.tolist(),
            "calibration_error_px": found.calibration_error_px,
        }
        print(dumps(_without_nan(content), indent=2))
    else:
        show_diagnosis(found)
    return found.is_healthy


def _without_nan(content: object) -> object:
    """The same with null for numbers that JSON does not know."""
    if isinstance(content, dict):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    if isinstance(content, float):
        return float(content) if np.isfinite(content) else None
    return content


def rig_of(
    left: Path, right: Path, options: RigOptions, calibrated: CalibrationOptions
) -> RectifiedRig | StereoRig | None:
    """What the options and files say of the cameras.

    Raises:
        ConfigError: both a calibration and a rectified rig are given, or a part of the latter is missing.
        FileFormatError: a calibration cannot be read.
    """
    from epipole.stereo.depth import rectified_rig_of, rig_from_options

    if calibrated.cameras and not calibrated.calibration:
        raise ConfigError("--cameras chooses two of the cameras of a calibration: give one")
    if calibrated.calibration:
        sigmas = {name: getattr(options, name) for name in _SIGMAS}
        if _without_sigmas(options) != RigOptions():
            raise ConfigError(
                "give a calibration, or focal_px, baseline and the like of a rectified pair, not both"
            )
        from epipole.io.calibration_files import read_stereo_rig

        rig = read_stereo_rig(*calibrated.calibration, size=_size_of_first(left), cameras=calibrated.cameras)
        if not any(sigmas.values()):
            return rig
        flat = rectified_rig_of(rig)
        if flat is None:
            raise ConfigError(
                "standard deviations are for calibrations whose cameras stand side by side already, without covariance"
            )
        return replace(flat, **sigmas)
    if options.focal_px is None and options.baseline is None:
        return rig_from_options(options, (1, 1))
    return rig_from_options(options, _size_of_first(left) or _size_of_first(right) or (1, 1))


def _without_sigmas(options: RigOptions) -> RigOptions:
    return replace(options, focal_sigma_px=0.0, baseline_sigma=0.0, principal_offset_sigma_px=0.0)


def _size_of_first(path: Path) -> tuple[int, int] | None:
    """Width and height of a picture, or of the first of a folder; None for video."""
    from epipole.io.photographs import list_photographs, read_header
    from epipole.io.video import is_video

    if is_video(path):
        import cv2

        capture = cv2.VideoCapture(str(path))
        size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        return size if min(size) > 0 else None
    if path.is_dir():
        names = list_photographs(path).names
        if not names:
            return None
        path = path / names[0]
    header = read_header(path)
    return header.width, header.height
