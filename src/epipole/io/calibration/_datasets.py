"""Calibrations in dataset formats: EuRoC's sensor.yaml, KITTI's projection matrices, Middlebury's calib.txt."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io._named_numbers import numbers_of, size_of
from epipole.io.calibration.camera_chains import camera_of_intrinsics
from epipole.io.calibration.coefficients import require_plain

_KITTI = re.compile(r"(?:P|P_rect_)(\d{1,2})")
_SAME = 1e-6


def named_lines(text: str) -> dict[str, Any] | None:
    """Parse Middlebury's `name=value` lines, or unnamed rows of twelve numbers (P0, P1 ...); None for other text."""
    lines = [line.strip() for line in text.removeprefix("\ufeff").splitlines() if line.strip()]
    if any(line.replace(" ", "").startswith("cam0=") for line in lines):
        parts = (line.partition("=") for line in lines)
        return {name.strip(): value.strip() for name, equals, value in parts if equals}
    try:
        matrices = [[float(word) for word in line.split()] for line in lines]
    except ValueError:
        return None
    if not matrices or {len(row) for row in matrices} != {12}:
        return None
    return {f"P{k}": row for k, row in enumerate(matrices)}


def is_euroc(content: Mapping[str, Any]) -> bool:
    """Whether this is a EuRoC sensor.yaml."""
    return "T_BS" in content and "intrinsics" in content


def is_kitti(content: Mapping[str, Any]) -> bool:
    """Whether it has KITTI's projection matrices, and no OpenCV keys (OpenCV's P1 and P2 are rectified cameras)."""
    is_opencvs = any(key in content for key in ("M1", "K1", "D1", "R", "T", "Q", "cameraMatrix1"))
    return not is_opencvs and bool(_matrices(content))


def is_middlebury(content: Mapping[str, Any]) -> bool:
    """Whether it has Middlebury's matrices in brackets."""
    return str(content.get("cam0", "")).startswith("[")


def euroc_cameras(
    files: Sequence[Path], contents: Sequence[Mapping[str, Any]]
) -> tuple[tuple[Camera, ...], Rigid3]:
    """Cameras and cam_from_rig; T_BS is body_from_cam. The rig's frame is that of the first camera."""
    cameras, cams_from_body = [], []
    for path, content in zip(files, contents):
        size = size_of(path, *numbers_of(path, content, "resolution", 2))
        cameras.append(camera_of_intrinsics(path, size, content, "distortion_coefficients"))
        cams_from_body.append(body_from_camera(path, content).inverse())
    positions = [cam_from_body @ cams_from_body[0].inverse() for cam_from_body in cams_from_body]
    return tuple(cameras), Rigid3(
        np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions])
    )


def body_from_camera(path: Path, content: Mapping[str, Any]) -> Rigid3:
    """EuRoC's T_BS, body_from_camera."""
    body_from_cam = numbers_of(path, content, "T_BS", 4, 4)
    rotation = body_from_cam[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise FileFormatError(path, "T_BS does not contain a rotation")
    if (body_from_cam[3] != [0, 0, 0, 1]).any():
        raise FileFormatError(path, f"T_BS has the last row {body_from_cam[3].tolist()}, not 0 0 0 1")
    return Rigid3.from_matrix(body_from_cam[:3])


def kitti_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """P = K (R | t) of rectified cameras, where R is the identity: t = K^-1 p_4."""
    cameras, offsets = [], []
    for key in _matrices(content):
        P = numbers_of(path, content, key, 3, 4)
        if np.abs(P[2, :3] - [0, 0, 1]).max() > _SAME or max(abs(P[1, 0]), abs(P[0, 1])) > _SAME * abs(
            P[0, 0]
        ):
            raise FileFormatError(path, f"{key} is not a projection K (1 | t) of a rectified camera")
        own_size = f"S_rect_{key[-2:]}"
        if own_size in content:
            width_height = size_of(path, *numbers_of(path, content, own_size, 2))
        elif size is not None:
            width_height = size
        else:
            raise FileFormatError(path, "the image size is unknown: pass it (size=)")
        cameras.append(_pinhole(path, P[:, :3], width_height))
        offsets.append(np.linalg.solve(P[:, :3], P[:, 3]))
    # The frame of P0 is KITTI's reference; ours is the first camera's.
    return tuple(cameras), Rigid3(np.repeat(np.eye(3)[None], len(cameras), 0), np.array(offsets) - offsets[0])


def middlebury_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """cam0, cam1 and the baseline in millimeters, which then are the unit of depth."""
    if "width" in content and "height" in content:
        size = size_of(path, *(numbers_of(path, content, key, 1)[0] for key in ("width", "height")))
    if size is None:
        raise FileFormatError(path, "the keys width and height are missing")
    cameras = tuple(_pinhole(path, numbers_of(path, content, key, 3, 3), size) for key in ("cam0", "cam1"))
    baseline = numbers_of(path, content, "baseline", 1)[0]
    return cameras, Rigid3(np.repeat(np.eye(3)[None], 2, 0), np.array([[0.0, 0, 0], [-baseline, 0, 0]]))


def _matrices(content: Mapping[str, Any]) -> list[str]:
    found = {key: match for key in content if (match := _KITTI.fullmatch(str(key)))}
    return sorted(found, key=lambda key: int(found[key].group(1)))


def _pinhole(path: Path, K: np.ndarray, size: tuple[int, int]) -> Camera:
    require_plain(path, K)
    try:
        return Camera(CameraModel.PINHOLE, *size, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    except EpipoleError as error:
        raise FileFormatError(path, str(error)) from error
