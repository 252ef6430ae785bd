"""Cameras in LLFF's poses_bounds.npy: one row of 17 numbers per image, in the order of the image names.

A row is a (3, 5) matrix, then the nearest and the farthest depth. The columns of the matrix are world_from_camera with
the axes (down, right, backwards), and (height, width, focal length) of the full-size images; `images_8` has them
downscaled by 8.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.colmap.binary import read_binary_points
from epipole.io.files import file_bytes
from epipole.io.images.formats import FORMAT_OF_SUFFIX
from epipole.io.images.photographs import read_header
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

LLFF = "poses_bounds.npy"
_POINTS = Path("sparse") / "0" / "points3D.bin"
_COLUMNS = 17
_SIZES = re.compile(r"images(?:_(\d+))?")
_MOST_BYTES = 1 << 28
_ORTHONORMAL_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class LlffScene:
    """The content of an LLFF folder."""

    reconstruction: Reconstruction
    """Image names are relative to `image_folder`; points are those of sparse/0, without tracks."""
    image_folder: Path
    near_far: Float64[np.ndarray, "n 2"]
    """Depth range of each image's scene, in the unit of the cameras."""


@checked
def read_llff(folder: str | Path, max_side_px: int | None = None) -> LlffScene:
    """Read poses_bounds.npy, and the points of sparse/0 if present (they share the world frame).

    Args:
        folder: folder of the file.
        max_side_px: use the largest of the folders `images`, `images_2`, ... whose images are no larger, else the
            smallest; None: the largest.

    Raises:
        FileFormatError: the file is missing, a value is invalid, or the numbers of images and rows differ.
    """
    folder = Path(folder)
    path = folder / LLFF
    rows = _rows(path)
    matrices = rows[:, :15].reshape(-1, 3, 5)
    image_folder, size = _images(folder, max_side_px)
    names = sorted(p.name for p in image_folder.iterdir() if p.suffix.lower() in FORMAT_OF_SUFFIX)
    if len(names) != len(rows):
        raise FileFormatError(path, f"it has {len(rows)} cameras, but {image_folder} has {len(names)} images")
    n = len(rows)
    cameras = [_camera(path, matrix[:, 4], size) for matrix in matrices]
    motions = _cams_from_world(path, matrices)
    numbers = np.arange(n, dtype=np.int32)
    points = _points(folder / _POINTS)
    reconstruction = Reconstruction(
        Cameras.from_list(cameras),
        Rigs.of_single_cameras(n),
        Frames(numbers.copy(), motions, np.full(n, np.nan)),
        Images(tuple(names), numbers, numbers.copy(), np.zeros(n + 1, np.int64), np.empty((0, 2))),
        points,
        Tracks(np.zeros(len(points) + 1, np.int64), np.empty(0, np.int32), np.empty(0, np.int32)),
    )
    return LlffScene(reconstruction, image_folder, rows[:, 15:].copy())


def _rows(path: Path) -> np.ndarray:
    try:
        rows = np.load(io.BytesIO(file_bytes(path, _MOST_BYTES)), allow_pickle=False)
    except (ValueError, EOFError, OSError, SyntaxError, MemoryError, TokenError, TypeError) as error:
        raise FileFormatError(path, f"not an array of numbers ({error})") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != _COLUMNS or not len(rows):
        raise FileFormatError(path, f"not rows of {_COLUMNS} numbers")
    if rows.dtype.kind not in "fiu" or not np.isfinite(rows).all():
        raise FileFormatError(path, "a number is not finite")
    rows = rows.astype(np.float64)
    if not ((rows[:, 15] > 0) & (rows[:, 16] >= rows[:, 15])).all():
        raise FileFormatError(path, "the nearest and furthest depth of an image are not in order")
    return rows


def _images(folder: Path, max_side_px: int | None) -> tuple[Path, tuple[int, int]]:
    """The selected folder of images, and the size of its first image."""
    sizes: list[tuple[int, Path, tuple[int, int]]] = []
    for position in sorted(folder.iterdir()):
        found = _SIZES.fullmatch(position.name)
        if found is None or not position.is_dir():
            continue
        files = sorted(p for p in position.iterdir() if p.suffix.lower() in FORMAT_OF_SUFFIX)
        if files:
            header = read_header(files[0])
            sizes.append((int(found[1] or 1), position, (header.width, header.height)))
    if not sizes:
        raise FileFormatError(folder, "no images found (in images, images_2, images_4 or images_8)")
    sizes.sort(key=lambda one: one[0])
    for _, position, size in sizes:
        if max_side_px is None or max(size) <= max_side_px:
            return position, size
    return sizes[-1][1], sizes[-1][2]


def _camera(path: Path, given: np.ndarray, size: tuple[int, int]) -> Camera:
    """A pinhole camera for the actual image size, with the principal point at the image center."""
    height, width, focal = given.tolist()
    is_possible = height >= 1 and width >= 1 and focal > 0
    fx, fy = (focal * size[0] / width, focal * size[1] / height) if is_possible else (0.0, 0.0)
    if not (0 < fx < np.inf and 0 < fy < np.inf):
        raise FileFormatError(path, f"invalid camera: {width:g} x {height:g}, focal length {focal:g}")
    params = np.array([fx, fy, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)])
    return Camera(CameraModel.PINHOLE, *size, params)


def _cams_from_world(path: Path, matrices: np.ndarray) -> Rigid3:
    down, right, back = (matrices[:, :, k] for k in range(3))
    rotation = np.stack([right, down, -back], axis=2)
    off = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max()
    if off > _ORTHONORMAL_TOLERANCE or (np.linalg.det(rotation) < 0).any():
        raise FileFormatError(path, "a matrix does not contain a rotation")
    return Rigid3(Rotation3.nearest(rotation).matrix, matrices[:, :, 3].copy()).inverse()


def _points(file: Path) -> Points:
    if not file.is_file():
        return Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0))
    table = read_binary_points(file)
    return Points(table.xyz, table.rgb, np.full(len(table.xyz), np.nan))
