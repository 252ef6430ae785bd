"""Calibration files next to the images of a sequence; they take precedence over guesses from folder or file names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import EpipoleError, FileFormatError
from epipole.io.calibration.camera_params import refuse_impossible
from epipole.io.calibration.files import read_calibration
from epipole.io.files import file_text

INFOS = ("info.txt", "_info.txt")
"""Info files of BundleFusion, 12-Scenes and ScanNet, `name = value` per line."""
MATRICES = (
    "intrinsics.txt", "camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsic.txt", "calibration.txt", "K.txt",
    "intrinsic/intrinsic_color.txt", "intrinsic_color.txt", "intrinsics_color.txt",
)  # fmt: skip
"""`fx fy cx cy`, or a 3 x 3 or 4 x 4 matrix."""
DEPTH_MATRICES = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "intrinsics_depth.txt")
EXTRINSICS = ("intrinsic/extrinsic_color.txt", "intrinsic/extrinsic_depth.txt")
_CALIBRATIONS = (
    "calib.txt",
    *(f"{stem}.{suffix}" for stem in ("calibration", "camera") for suffix in ("json", "yaml", "yml", "xml")),
)
_DISTORTIONS = ("D.txt", "distortion.txt")
_OFF_CENTER = 0.2
"""Largest distance of the principal point from the image center, as a fraction of the image size. A calibration for
another image size is off by more: by a half for twice the size."""
_SAME_RAYS_RAD = 1e-3
_KEY = re.compile(r"\s*(\w[\w.]*)\s*=(.*)")
_IDENTITY = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SensorInfo:
    """The depth sensor's parameters in an info file."""

    values_per_m: float | None
    camera: Camera | None
    """None: depth is registered to the color images."""
    problem: str
    """Why its depth cannot be used; empty if it can."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationBeside:
    """A calibration found next to the images."""

    camera: Camera | None = None
    source: str = ""
    problem: str = ""
    """Why the calibration found cannot be used; empty if it is used, or none was found."""
    info: SensorInfo | None = None

    @property
    def is_found(self) -> bool:
        """Whether any calibration was found, usable or not."""
        return self.camera is not None or bool(self.problem)


def calibration_beside(folders: Iterable[Path], size: tuple[int, int]) -> CalibrationBeside:
    """The calibration for images of this size from the first folder that has one.

    If several files disagree, or do not fit the images, the result has a problem instead of a camera.
    """
    for folder in folders:
        readers: list[tuple[Path, Callable[[Path, tuple[int, int]], Camera]]] = [
            *((folder / name, _of_calibration_file) for name in _CALIBRATIONS),
            *((folder / name, read_matrix_camera) for name in MATRICES),
            *((folder / name, _of_info) for name in INFOS if is_info(folder / name)),
        ]
        found = _decided([(path, reader) for path, reader in readers if path.is_file()], folder, size)
        if found.is_found:
            return found
    return CalibrationBeside()


def _decided(
    readers: list[tuple[Path, Callable[[Path, tuple[int, int]], Camera]]], folder: Path, size: tuple[int, int]
) -> CalibrationBeside:
    cameras: list[tuple[Path, Camera]] = []
    info = None
    for path, reader in readers:
        try:
            cameras.append((path, reader(path, size)))
            if path.name in INFOS:
                info = sensor_info(path)
        except EpipoleError as error:
            return CalibrationBeside(problem=str(error))
    if not cameras:
        return CalibrationBeside()
    (path, camera), others = cameras[0], cameras[1:]
    for other_path, other in others:
        if not _are_same(camera, other):
            return CalibrationBeside(
                problem=f"{path} and {other_path.name} define different cameras ({camera}; {other})"
            )
    distortion = next((folder / name for name in _DISTORTIONS if (folder / name).is_file()), None)
    if distortion is not None and not camera.model.distortion_indices:
        return CalibrationBeside(
            problem=f"{distortion} has distortion coefficients of an unknown model, and {path.name} has none"
        )
    return CalibrationBeside(camera, path.name, "", info)


def _are_same(one: Camera, other: Camera) -> bool:
    if (one.width, one.height) != (other.width, other.height):
        return False
    grid = np.meshgrid(np.linspace(0, one.width - 1.0, 7), np.linspace(0, one.height - 1.0, 7))
    pixels = np.stack(grid, axis=-1).reshape(-1, 2)
    return bool(np.nanmax(np.abs(one.unproject(pixels) - other.unproject(pixels))) < _SAME_RAYS_RAD)


def check_fits(path: Path, camera: Camera, size: tuple[int, int]) -> Camera:
    """Check that a camera fits images of this size, and return it.

    Raises:
        FileFormatError: it is for another image size, or its numbers are not plausible.
    """
    if (camera.width, camera.height) != size:
        raise FileFormatError(
            path,
            f"it is for images of {camera.width} x {camera.height} pixels, but these are {size[0]} x {size[1]}",
        )
    refuse_impossible(camera, str(path))
    for side, name, index in zip(size, ("cx", "cy"), camera.model.principal_point_indices):
        value = float(camera.params[index])
        if abs(value - 0.5 * (side - 1)) > _OFF_CENTER * side:
            raise FileFormatError(
                path,
                f"{name} = {value:g} is far from the center of images of {size[0]} x {size[1]} pixels: the calibration is probably "
                "for images of another size",
            )
    return camera


def _of_calibration_file(path: Path, size: tuple[int, int]) -> Camera:
    cameras = read_calibration(path, size=size).cameras
    if any(not _are_same(cameras[0], other) for other in cameras[1:]):
        raise FileFormatError(
            path, f"it has {len(cameras)} cameras, and it is unknown which one took these images"
        )
    return check_fits(path, cameras[0], size)


def read_matrix_camera(path: Path, size: tuple[int, int]) -> Camera:
    """Read a camera without distortion: `fx fy cx cy`, or a 3 x 3, 3 x 4 or 4 x 4 matrix; pixel centers are integers.

    Raises:
        FileFormatError: the file has other numbers, or does not fit images of this size.
    """
    lines = [
        line for line in file_text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")
    ]
    try:
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in lines]
    except ValueError as error:
        raise FileFormatError(path, f"expected fx fy cx cy, or a 3 x 3 or 4 x 4 matrix: {error}") from error
    values = [value for row in rows for value in row]
    if len(values) == 4:
        return check_fits(path, _pinhole(path, values, size), size)
    return check_fits(path, _of_matrix(path, values, size), size)


def _of_matrix(path: Path, values: list[float], size: tuple[int, int]) -> Camera:
    """A camera from the nine, twelve or sixteen numbers of a camera matrix in row-major order."""
    count = {9: 3, 12: 4, 16: 4}.get(len(values))
    if count is None or not np.isfinite(values).all():
        raise FileFormatError(
            path,
            f"expected fx fy cx cy, or a 3 x 3 or 4 x 4 matrix of finite numbers, got {len(values)} numbers",
        )
    matrix = np.array(values).reshape(-1, count)
    rest = matrix.copy()
    rest[[0, 1, 0, 1], [0, 1, 2, 2]] = np.eye(*matrix.shape)[[0, 1, 0, 1], [0, 1, 2, 2]]
    if np.abs(rest - np.eye(*matrix.shape)).max() > _IDENTITY:
        raise FileFormatError(path, "not a camera matrix without skew, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return _pinhole(path, matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), size)


def _pinhole(path: Path, params: list[float], size: tuple[int, int]) -> Camera:
    try:
        return Camera(CameraModel.PINHOLE, *size, np.array(params))
    except EpipoleError as error:
        raise FileFormatError(path, str(error)) from error


def is_info(path: Path) -> bool:
    """Whether a file is a sensor's info file, judged by its keys."""
    try:
        lines = file_text(path).splitlines() if path.is_file() else []
    except FileFormatError:
        return False
    return any((match := _KEY.match(line)) and match[1].startswith("m_") for line in lines)


def _info_values(path: Path) -> dict[str, list[float]]:
    """Numbers by key.

    Raises:
        FileFormatError: a line is malformed, or a calibration key is not supported.
    """
    out: dict[str, list[float]] = {}
    known = {f"m_calibration{what}" for what in _CALIBRATION_KEYS}
    for number, line in enumerate(file_text(path).splitlines(), 1):
        if not line.strip():
            continue
        match = _KEY.match(line)
        if match is None:
            raise FileFormatError(path, f"line {number}: expected name = value")
        key = match[1]
        if key.startswith("m_calibration") and key not in known:
            raise FileFormatError(path, f"line {number}: the calibration key {key} is not supported")
        if key in known or key in _NUMBER_KEYS:
            try:
                out[key] = [float(word) for word in match[2].split()]
            except ValueError as error:
                raise FileFormatError(path, f"line {number}: {error}") from error
            if not out[key] or not np.isfinite(out[key]).all():
                raise FileFormatError(path, f"line {number}: {key} has no numbers, or has non-finite numbers")
    return out


_CALIBRATION_KEYS = ("ColorIntrinsic", "ColorExtrinsic", "DepthIntrinsic", "DepthExtrinsic")
_NUMBER_KEYS = ("m_colorWidth", "m_colorHeight", "m_depthWidth", "m_depthHeight", "m_depthShift")


def _of_info(path: Path, size: tuple[int, int]) -> Camera:
    values = _info_values(path)
    if "m_calibrationColorIntrinsic" not in values:
        raise FileFormatError(path, "the key m_calibrationColorIntrinsic is missing")
    for key, side in zip(_NUMBER_KEYS[:2], size):
        if key in values and values[key] != [side]:
            raise FileFormatError(
                path, f"{key} is {values[key][0]:g}, but the images are {size[0]} x {size[1]}"
            )
    return check_fits(path, _of_matrix(path, values["m_calibrationColorIntrinsic"], size), size)


def sensor_info(path: Path) -> SensorInfo:
    """Read the depth parameters from an info file.

    Raises:
        FileFormatError: a line is malformed, or the numbers are not a valid camera.
    """
    values = _info_values(path)
    shift = values.get("m_depthShift")
    if shift is not None and not (len(shift) == 1 and 0 < shift[0] < 1e6):
        raise FileFormatError(path, "m_depthShift is not one positive number")
    per_m = None if shift is None else shift[0]
    for key in ("m_calibrationColorExtrinsic", "m_calibrationDepthExtrinsic"):
        if not is_identity(values.get(key)):
            return SensorInfo(
                per_m, None, f"{key} in {path.name} is not the identity: the depth is not registered"
            )
    own = values.get("m_calibrationDepthIntrinsic")
    size = values.get("m_depthWidth"), values.get("m_depthHeight")
    if own is None or own == values.get("m_calibrationColorIntrinsic") or size[0] is None or size[1] is None:
        return SensorInfo(per_m, None, "")
    return SensorInfo(per_m, _of_matrix(path, own, (int(size[0][0]), int(size[1][0]))), "")


def is_identity(values: list[float] | None) -> bool:
    """Whether sixteen numbers are the 4 x 4 identity; True for None."""
    if values is None:
        return True
    return len(values) == 16 and bool(np.abs(np.reshape(values, (4, 4)) - np.eye(4)).max() <= _IDENTITY)
