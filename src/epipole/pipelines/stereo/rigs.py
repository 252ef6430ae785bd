"""The cameras of a pair: from options or calibration files, and as a rectified rig if already rectified."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole.cameras import CameraModel
from epipole.errors import ConfigError
from epipole.io.calibration.files import read_stereo_rig
from epipole.io.images.photographs import list_photographs, read_header
from epipole.io.images.video import frame_size, is_video
from epipole.pipelines.stereo.config import RigOptions
from epipole.scene import RectifiedRig, StereoRig

_SIGMAS = ("focal_sigma_px", "baseline_sigma", "principal_offset_sigma_px")
_MAX_FOCAL = 1000.0  # times the longer side; larger values are typing errors
_SAME = 1e-6  # relative: a thousandth of a pixel across an image


def rig_of(left: Path, right: Path, options: RigOptions) -> RectifiedRig | StereoRig | None:
    """The rig from options and calibration files.

    Raises:
        ConfigError: both a calibration and a rectified rig are given, or a parameter of the latter is missing.
        FileFormatError: a calibration cannot be read.
    """
    files = options.calibration
    if options.cameras and not files:
        raise ConfigError("--cameras selects two cameras of a calibration: pass --calibration too")
    if len(files) > 2:
        raise ConfigError(f"--calibration takes one or two files, got {len(files)}")
    if files:
        sigmas = {name: getattr(options, name) for name in _SIGMAS}
        known = replace(options, focal_sigma_px=0.0, baseline_sigma=0.0, principal_offset_sigma_px=0.0)
        if known != RigOptions(calibration=files, cameras=options.cameras):
            raise ConfigError(
                "pass either a calibration, or focal_px, baseline and other parameters of a rectified pair, not both"
            )
        rig = read_stereo_rig(*files, size=_size_of_first(left), cameras=options.cameras)
        if not any(sigmas.values()):
            return rig
        flat = rectified_rig_of(rig)
        if flat is None:
            raise ConfigError(
                "standard deviations can only be given for a calibration that is already rectified and has no covariance"
            )
        return replace(flat, **sigmas)
    if options.focal_px is None and options.baseline is None:
        return rig_from_options(options, (1, 1))
    return rig_from_options(options, _size_of_first(left) or _size_of_first(right) or (1, 1))


def _size_of_first(path: Path) -> tuple[int, int] | None:
    """Width and height of an image, of the first image of a folder, or of a video; None for an empty folder."""
    if is_video(path):
        return frame_size(path)
    if path.is_dir():
        names = list_photographs(path).names
        if not names:
            return None
        path = path / names[0]
    header = read_header(path)
    return header.width, header.height


def rig_from_options(options: RigOptions, size: tuple[int, int]) -> RectifiedRig | None:
    """The rig of a rectified pair with this image size; None if neither focal length nor baseline is given.

    Raises:
        ConfigError: only one of focal length and baseline is given, or the focal length is implausible.
    """
    if options.focal_px is None and options.baseline is None:
        return None
    if options.focal_px is None or options.baseline is None:
        given = "focal_px" if options.baseline is None else "baseline"
        raise ConfigError(f"depth needs both focal_px and baseline, but only {given} was given")
    if options.focal_px > _MAX_FOCAL * max(size):
        raise ConfigError(
            f"focal_px = {options.focal_px:g} is too large for images of {size[0]}x{size[1]} pixels: give it in pixels"
        )
    cx, cy = options.principal_point or ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return RectifiedRig(
        options.focal_px,
        cx,
        cy,
        options.baseline,
        options.principal_offset_px,
        options.focal_sigma_px,
        options.baseline_sigma,
        options.principal_offset_sigma_px,
    )


def rectified_rig_of(rig: StereoRig) -> RectifiedRig | None:
    """The rig as a rectified pair if it already is one (KITTI, Middlebury), so that images need no resampling.

    None for any other rig, and for one with a covariance, which refers to the parameters of both cameras.
    """
    left, right, motion = rig.left, rig.right, rig.right_from_left
    if rig.covariance is not None or (left.width, left.height) != (right.width, right.height):
        return None
    K1, K2 = left.K, right.K
    focal, baseline = float(K1[0, 0]), rig.baseline
    is_flat = (
        not any(camera.params[list(camera.model.distortion_indices)].any() for camera in (left, right))
        and np.allclose([K1[1, 1], K2[0, 0], K2[1, 1]], focal, rtol=_SAME, atol=0)
        and abs(K2[1, 2] - K1[1, 2]) < _SAME * focal
        and np.abs(motion.rotation - np.eye(3)).max() < _SAME
        and np.abs(motion.translation - [-baseline, 0, 0]).max() < _SAME * baseline
    )
    if not is_flat or CameraModel.OPENCV_FISHEYE in (left.model, right.model):
        return None
    return RectifiedRig(
        focal, float(K1[0, 2]), float(K1[1, 2]), baseline, principal_offset_px=float(K2[0, 2] - K1[0, 2])
    )
