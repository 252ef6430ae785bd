"""The numbers in Bundler's bundle.out, and the names in its list of images."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io._named_numbers import is_rotation
from epipole.io.files import file_text, problem_of_name

HEADER = "# Bundle file v0.3"
LIST_FILE = "list.txt"
"""Name of the image list, written beside the model."""

_BUNDLE_SUFFIX, _LIST_SUFFIX = ".bundle.out", ".list.txt"
"""Names of the two files as COLMAP exports them."""
_WITH_FOCAL = re.compile(r"(.*\S)\s+0\s+[0-9.eE+-]+")
"""A line of the list that ends in an initial focal length."""
_PER_CAMERA, _PER_POINT, _PER_VIEW = 15, 7, 4


@dataclass(frozen=True, slots=True, eq=False)
class BundleValues:
    """The content of a file, in Bundler's conventions."""

    intrinsics: np.ndarray
    """(n, 3) f, k1 and k2; f is 0 if the camera is not registered."""
    rotation: np.ndarray
    """(n, 3, 3)"""
    translation: np.ndarray
    """(n, 3)"""
    xyz: np.ndarray
    """(m, 3) points."""
    rgb: np.ndarray
    """(m, 3)"""
    views: np.ndarray
    """(k, 5) camera, keypoint, x, y and the point."""


def bundle_values(path: Path) -> BundleValues:
    """Read a file.

    Raises:
        FileFormatError: another version, truncated, or a value is invalid.
    """
    header, _, text = file_text(path).partition("\n")
    if header.strip() != HEADER:
        raise FileFormatError(path, f"line 1: expected {HEADER!r}, got {header.strip()[:40]!r}")
    words = text.split()
    try:
        num_cameras, num_points = (int(word) for word in words[:2])
        values = np.array(words[2:], np.float64)
    except ValueError as error:
        raise FileFormatError(path, f"not numbers after line 1: {str(error)[:80]}") from error
    if not np.isfinite(values).all():
        raise FileFormatError(path, "it contains numbers that are not finite")
    start = _PER_CAMERA * num_cameras
    if not (num_cameras >= 0 <= num_points and start + _PER_POINT * num_points <= len(values)):
        raise FileFormatError(
            path,
            f"it ends before the last of its {num_cameras} cameras and {num_points} points; check that it is complete",
        )
    cameras = values[:start].reshape(-1, _PER_CAMERA)
    points, views = _points(path, values[start:], num_points)
    index = views[:, :2]
    if (index < 0).any() or (index % 1 != 0).any() or (index >= [num_cameras, 2**31]).any():
        raise FileFormatError(path, "a point refers to a camera or keypoint that does not exist")
    if (cameras[views[:, 0].astype(np.int64), 0] == 0.0).any():
        raise FileFormatError(path, "a point refers to a camera that is not registered (f = 0)")
    rotation = cameras[:, 3:12].reshape(-1, 3, 3)
    for k in np.flatnonzero(cameras[:, 0] != 0.0).tolist():
        if not is_rotation(rotation[k]):
            raise FileFormatError(path, f"camera {k}: its matrix is not a rotation")
    if not ((points[:, 3:] >= 0) & (points[:, 3:] <= 255)).all():
        raise FileFormatError(path, "a color is not from 0 to 255")
    return BundleValues(cameras[:, :3], rotation, cameras[:, 12:], points[:, :3], points[:, 3:], views)


def _points(path: Path, values: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """(m, 6) positions and colors, and the views of all points."""
    points = np.empty((num_points, 6))
    views, at = [], 0
    for point in range(num_points):
        count = float(values[at + 6]) if at + 6 < len(values) else -1.0
        stop = at + _PER_POINT + _PER_VIEW * count
        if not (count >= 0 and count % 1 == 0 and stop <= len(values)):
            raise FileFormatError(path, f"point {point}: its list of views is invalid or incomplete")
        points[point] = values[at : at + 6]
        own = values[at + _PER_POINT : int(stop)].reshape(-1, _PER_VIEW)
        views.append(np.column_stack([own, np.full(len(own), float(point))]))
        at = int(stop)
    if at != len(values):
        raise FileFormatError(path, f"{len(values) - at} unexpected numbers after the last point")
    return points, np.concatenate(views) if views else np.empty((0, _PER_VIEW + 1))


def list_beside(path: Path) -> Path:
    """The list of images: `NAME.list.txt` for `NAME.bundle.out` if it exists, else `list.txt`."""
    if path.name.endswith(_BUNDLE_SUFFIX):
        own = path.with_name(path.name.removesuffix(_BUNDLE_SUFFIX) + _LIST_SUFFIX)
        if own.exists():
            return own
    return path.with_name(LIST_FILE)


def listed_names(path: Path) -> list[str]:
    """The image names in a list, without initial focal lengths.

    Raises:
        FileFormatError: the list is missing, or a name is invalid.
    """
    names = []
    for number, line in enumerate(file_text(path).splitlines(), 1):
        if not line.strip():
            continue
        found = _WITH_FOCAL.fullmatch(line.strip())
        name = (found[1] if found else line.strip()).replace("\\", "/").removeprefix("./")
        if (problem := problem_of_name(name)) is not None:
            raise FileFormatError(path, f"line {number}: {problem}")
        names.append(name)
    return names
