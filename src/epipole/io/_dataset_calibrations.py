"""Calibrations as data sets bring them: EuRoC's sensor.yaml, KITTI's projection matrices, Middlebury's calib.txt."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io._lens_coefficients import camera_of_coefficients

_MIDDLEBURY = re.compile(r"^\s*(\w+)\s*=\s*(.+?)\s*$", re.MULTILINE)
_KITTI = re.compile(r"^(?:P|P_rect_)(\d+)$")


def named_lines(text: str) -> dict[str, Any] | None:
    """Middlebury's `name=value` lines, or rows of twelve numbers without names (P0, P1 ...); None for other text."""
    if re.match(r"\s*cam0\s*=", text):
        return dict(_MIDDLEBURY.findall(text))
    rows = [line.split() for line in text.splitlines() if line.strip()]
    try:
        matrices = [[float(word) for word in row] for row in rows]
    except ValueError:
        return None
    if not matrices or {len(row) for row in matrices} != {12}:
        return None
    return {f"P{k}": row for k, row in enumerate(matrices)}


def is_euroc(content: Mapping[str, Any]) -> bool:
    """Whether it is a sensor.yaml."""
    return "T_BS" in content and "intrinsics" in content


def is_kitti(content: Mapping[str, Any]) -> bool:
    """Whether it has projection matrices by KITTI's names."""
    return any(_KITTI.match(key) for key in content)


def is_middlebury(content: Mapping[str, Any]) -> bool:
    """Whether it has Middlebury's matrices in brackets."""
    return str(content.get("cam0", "")).startswith("[")


def euroc_cameras(
    files: Sequence[Path], contents: Sequence[Mapping[str, Any]]
) -> tuple[tuple[Camera, ...], Rigid3]:
    """Cameras and their places; T_BS is body_from_cam. The first camera's frame is the rig's."""
    cameras, cams_from_body = [], []
    for path, content in zip(files, contents):
        fx, fy, cx, cy = _floats(path, content, "intrinsics", 4)
        width, height = _floats(path, content, "resolution", 2)
        words = str(content.get("distortion_model", "none"))
        if words not in ("radial-tangential", "radtan", "equidistant", "none"):
            raise FileFormatError(path, f"the distortion_model {words} is not known")
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        d = np.zeros(4) if words == "none" else _floats(path, content, "distortion_coefficients", 4)
        cameras.append(
            camera_of_coefficients(path, (int(width), int(height)), K, d, is_fisheye=words == "equidistant")
        )
        body_from_cam = _floats(path, content, "T_BS", 16).reshape(4, 4)
        cams_from_body.append(Rigid3.from_matrix(body_from_cam).inverse())
    places = [cam_from_body @ cams_from_body[0].inverse() for cam_from_body in cams_from_body]
    return tuple(cameras), Rigid3(
        np.stack([p.rotation for p in places]), np.stack([p.translation for p in places])
    )


def kitti_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """P = K (R | t) of rectified cameras, in which R is 1: t = K^-1 p_4."""
    cameras, offsets = [], []
    for key in sorted((k for k in content if _KITTI.match(k)), key=lambda k: int(_KITTI.sub(r"\1", k))):
        P = _floats(path, content, key, 12).reshape(3, 4)
        sizes = f"S_rect_{key[-2:]}"
        if sizes in content:
            width, height = (int(v) for v in _floats(path, content, sizes, 2))
        elif size is not None:
            width, height = size
        else:
            raise FileFormatError(path, "it does not say how large the pictures are: give their size")
        cameras.append(_pinhole(path, P[:, :3], (width, height)))
        offsets.append(np.linalg.solve(P[:, :3], P[:, 3]))
    # The frame of P0 is KITTI's reference; ours is the first camera's.
    return tuple(cameras), Rigid3(np.repeat(np.eye(3)[None], len(cameras), 0), np.array(offsets) - offsets[0])


def middlebury_cameras(
    path: Path, content: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[tuple[Camera, ...], Rigid3]:
    """cam0, cam1 and the baseline in millimetres, which is then the unit of depth."""
    if "width" in content and "height" in content:
        size = (int(_floats(path, content, "width", 1)[0]), int(_floats(path, content, "height", 1)[0]))
    if size is None:
        raise FileFormatError(path, "the keys width and height are missing")
    cameras = tuple(
        _pinhole(path, _floats(path, content, key, 9).reshape(3, 3), size) for key in ("cam0", "cam1")
    )
    baseline = _floats(path, content, "baseline", 1)[0]
    return cameras, Rigid3(np.repeat(np.eye(3)[None], 2, 0), np.array([[0.0, 0, 0], [-baseline, 0, 0]]))


def _pinhole(path: Path, K: np.ndarray, size: tuple[int, int]) -> Camera:
    try:
        return Camera(CameraModel.PINHOLE, *size, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    except EpipoleError as error:
        raise FileFormatError(path, str(error)) from error


def _floats(path: Path, content: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    """The numbers under a key: a list, a matrix with `data`, or words in a line."""
    if key not in content:
        raise FileFormatError(path, f"the key {key} is missing")
    value = content[key]
    if isinstance(value, Mapping):
        value = value.get("data", ())
    if isinstance(value, str):
        value = re.sub(r"[\[\];,]", " ", value).split()
    try:
        array = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise FileFormatError(path, f"{key} holds something that is no number") from error
    if len(array) != count or not np.isfinite(array).all():
        raise FileFormatError(path, f"{key} should be {count} finite numbers, holds {len(array)}")
    return array
