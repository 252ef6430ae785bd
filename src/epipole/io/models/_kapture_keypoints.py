"""Kapture's keypoints, points and observations, in the folder `reconstruction`.

Keypoints are binary arrays, one file per image, of the type that `keypoints.txt` gives. (0, 0) is the corner of the image,
as in COLMAP.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.io.files import file_bytes
from epipole.io.models._kapture_tables import TableRow, rows_of, table_text
from epipole.io.models.model_file import Observations, no_points
from epipole.io.names import path_inside
from epipole.scene import Points, Reconstruction

POINTS_FILE, OBSERVATIONS_FILE = "reconstruction/points3d.txt", "reconstruction/observations.txt"
KEYPOINTS = "reconstruction/keypoints"
KEYPOINTS_FILE, KEYPOINT_SUFFIX, KEYPOINTS_ARCHIVE = "keypoints.txt", ".kpt", "keypoints.tar"

_WRITTEN_TYPE, _WRITTEN_DTYPE = "epipole", "float64"
# Names of Python and NumPy.
_DTYPES = {"float": "<f8", "float64": "<f8", "double": "<f8", "float32": "<f4", "single": "<f4"}
_GRAY, _MOST_COLUMNS = 128, 1 << 16


def points_in(folder: Path) -> Points:
    """The points; none if there is no such file.

    Raises:
        FileFormatError: a line is not a point.
    """
    path = folder / POINTS_FILE
    if not path.exists():
        return no_points()
    values = []
    for row in rows_of(path):
        if len(row.values) not in (3, 6):
            raise row.fail(f"a point needs x, y, z, or also r, g, b, got {len(row.values)} values")
        numbers = row.numbers(0)
        if not ((numbers[3:] >= 0) & (numbers[3:] <= 255)).all():
            raise row.fail("a color is not from 0 to 255")
        values.append(np.append(numbers, [_GRAY] * (6 - len(numbers))))
    table = np.array(values).reshape(-1, 6)
    rgb = np.rint(table[:, 3:]).astype(np.uint8)
    return Points(np.ascontiguousarray(table[:, :3]), rgb, np.full(len(table), np.nan))


def observations_in(folder: Path, names: list[str], num_points: int) -> tuple[Observations, list[str]]:
    """The keypoints of the type that most observations use, and warnings about others.

    Args:
        folder: the dataset.
        names: of the images.
        num_points: number of points.

    Raises:
        FileFormatError: a file is missing or damaged, or an observation refers to a missing point or keypoint.
    """
    path = folder / OBSERVATIONS_FILE
    rows, row_of_image = rows_of(path) if path.exists() else [], {name: row for row, name in enumerate(names)}
    counts = Counter({file.parent.name: 0 for file in (folder / KEYPOINTS).glob(f"*/{KEYPOINTS_FILE}")})
    for row in rows:
        row.require(2, "a point and a type of keypoints")
        if len(row.values) % 2:
            raise row.fail("an image without the number of its keypoint")
        counts[row.values[1]] += len(row.values) // 2 - 1
    if not counts:
        return Observations.none(), []
    kind = max(sorted(counts), key=counts.__getitem__)
    warnings = [f"keypoints of other types than {kind} are not read"] if len(counts) > 1 else []
    at = path_inside(folder / KEYPOINTS, kind)
    if (at / KEYPOINTS_ARCHIVE).exists():
        return Observations.none(), [
            f"tracks are not read: the keypoints are packed in {kind}/{KEYPOINTS_ARCHIVE}"
        ]
    keypoints = _keypoints_in(at, names)
    point_of = [np.full(len(own), -1, np.int64) for own in keypoints]
    for row in rows:
        if row.values[1] == kind:
            _add_track(row, row_of_image, point_of, num_points)
    image = np.repeat(np.arange(len(names)), [len(own) for own in keypoints])
    feature = np.concatenate([np.arange(len(own)) for own in keypoints])
    return Observations(image, feature, np.concatenate(point_of), np.concatenate(keypoints)), warnings


def _add_track(
    row: TableRow, row_of_image: dict[str, int], point_of: list[np.ndarray], num_points: int
) -> None:
    point = row.integer(0, "the number of a point")
    if point >= num_points:
        raise row.fail(f"point {point} does not exist")
    for k in range(2, len(row.values), 2):
        image, feature = row_of_image.get(row.values[k]), row.integer(k + 1, "the number of a keypoint")
        if image is None:
            continue
        if feature >= len(point_of[image]):
            raise row.fail(f"keypoint {feature} of {row.values[k][:80]} does not exist")
        if point_of[image][feature] not in (-1, point):
            raise row.fail(f"keypoint {feature} of {row.values[k][:80]} belongs to two points")
        point_of[image][feature] = point


def _keypoints_in(folder: Path, names: list[str]) -> list[np.ndarray]:
    """(n, 2) keypoints of each image; none for images without a file."""
    rows = rows_of(folder / KEYPOINTS_FILE)
    if len(rows) != 1:
        raise FileFormatError(folder / KEYPOINTS_FILE, f"expected one line, got {len(rows)}")
    (row,) = rows
    row.require(3, "name, dtype and dsize")
    dtype = _DTYPES.get(row.values[1].removeprefix("numpy.").removeprefix("np."))
    columns = row.integer(2, "dsize")
    if dtype is None or not 2 <= columns <= _MOST_COLUMNS:
        raise row.fail(f"keypoints of {columns} values of type {row.values[1][:20]!r} are not supported")
    out = []
    for name in names:
        path = path_inside(folder, name + KEYPOINT_SUFFIX)
        data = file_bytes(path) if path.exists() else b""
        if len(data) % (columns * np.dtype(dtype).itemsize):
            raise FileFormatError(
                path, f"{len(data)} bytes are not keypoints of {columns} values of {row.values[1]}"
            )
        pixels = np.frombuffer(data, dtype).reshape(-1, columns)[:, :2].astype(np.float64)
        if not (np.abs(pixels) < 2**31).all():
            raise FileFormatError(path, "it has positions that are not finite")
        out.append(pixels - HALF_PIXEL)
    return out


def write_points(model: Reconstruction, folder: Path, registered: list[int]) -> None:
    """Write points, and the keypoints and observations of images.

    Args:
        model: the model.
        folder: the dataset.
        registered: images to write.
    """
    tracks, points, images = model.tracks, model.points, model.images
    at = folder / KEYPOINTS / _WRITTEN_TYPE
    at.mkdir(parents=True)
    rows = [*map(list.__add__, points.xyz_in_world.tolist(), points.rgb.tolist())]
    (folder / POINTS_FILE).write_text(table_text("X, Y, Z, R, G, B", rows), encoding="utf-8", newline="\n")
    header = table_text("name, dtype, dsize", [(_WRITTEN_TYPE, _WRITTEN_DTYPE, 2)])
    (at / KEYPOINTS_FILE).write_text(header, encoding="utf-8", newline="\n")
    for image in registered:
        file = at / (images.name[image] + KEYPOINT_SUFFIX)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes((images.keypoints_of(image) + HALF_PIXEL).astype("<f8").tobytes())
    is_written = np.isin(tracks.image, registered)
    lines = []
    for point in range(len(points)):
        seen = range(int(tracks.offsets[point]), int(tracks.offsets[point + 1]))
        views = [(images.name[tracks.image[k]], int(tracks.keypoint[k])) for k in seen if is_written[k]]
        if views:
            lines.append([point, _WRITTEN_TYPE, *(value for view in views for value in view)])
    text = table_text("point3d_id, keypoints_type, [image_path, feature_id]*", lines)
    (folder / OBSERVATIONS_FILE).write_text(text, encoding="utf-8", newline="\n")
