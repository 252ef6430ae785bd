"""OpenSfM's tracks.csv, which is separated by tabs.

A line is an observation: image, track, number of the feature, x, y, then (since version 1) the size of the feature, its
color, and (version 2) two labels. x and y are relative to the image center and divided by the longer side of the image.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from epipole.errors import ConfigError, FileFormatError
from epipole.io.files import file_text
from epipole.io.models.model_file import Observations
from epipole.scene import Reconstruction

HEADER = "OPENSFM_TRACKS_VERSION_v"
_WRITTEN_VERSION = 2
# Number of columns by version; version 0 has no header.
_NUM_COLUMNS = {0: 8, 1: 9, 2: 11}
_INTEGER = re.compile(r"\d{1,9}")
_NO_LABEL = -1


def opensfm_observations(
    path: Path, names: Sequence[str], sizes: np.ndarray, row_of_point: Mapping[str, int]
) -> Observations:
    """The observations in a file of tracks.

    Args:
        path: the file.
        names: of the images; lines of other images are skipped, since the file has the tracks of all images.
        sizes: (n, 2) width and height of each image.
        row_of_point: point of each track that has one.

    Raises:
        FileFormatError: the version is unknown, or a line is not an observation.
    """
    lines = file_text(path).split("\n")
    version = 0
    if lines[0].startswith(HEADER):
        version = {f"{HEADER}{known}": known for known in _NUM_COLUMNS if known}.get(lines[0].strip(), -1)
        if version < 0:
            raise FileFormatError(path, f"line 1: unknown version of tracks {lines[0].strip()[:60]!r}")
        lines[0] = ""
    row_of_image = {name: row for row, name in enumerate(names)}
    rows: list[tuple[int, int, int]] = []
    numbers: list[tuple[str, str]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        words = line.rstrip("\r").split("\t")
        if len(words) != _NUM_COLUMNS[version]:
            raise FileFormatError(
                path,
                f"line {number}: expected {_NUM_COLUMNS[version]} values separated by tabs, got {len(words)}",
            )
        if not _INTEGER.fullmatch(words[2]):
            raise FileFormatError(path, f"line {number}: the feature {words[2][:40]!r} is not a number")
        if words[0] in row_of_image:
            rows.append((row_of_image[words[0]], int(words[2]), row_of_point.get(words[1], -1)))
            numbers.append((words[3], words[4]))
    try:
        coordinates = np.array(numbers, np.float64).reshape(-1, 2)
    except ValueError as error:
        raise FileFormatError(path, f"a position is not a number: {str(error)[:80]}") from error
    if not (np.abs(coordinates) < 2**31).all():
        raise FileFormatError(path, "a position is not finite")
    image, feature, point = np.array(rows, np.int64).reshape(-1, 3).T.copy()
    size = sizes[image]
    pixels = coordinates * size.max(axis=1, initial=1)[:, None] + 0.5 * (size - 1.0)
    return Observations(image, feature, point, pixels)


def track_lines(model: Reconstruction, is_written: np.ndarray) -> Iterator[str]:
    """The lines of a file with the tracks of a model.

    The size of features is unknown and written as one pixel.

    Args:
        model: the model.
        is_written: mask of its images that have a pose.

    Raises:
        ConfigError: an image's name has a tab.
    """
    tracks, points, images = model.tracks, model.points, model.images
    bad = next((name for name in images.name if any(mark in name for mark in "\t\r\n")), None)
    if bad is not None:
        raise ConfigError(f"the image name {bad!r} cannot be written to a file of tracks")
    size = np.stack([model.cameras.width, model.cameras.height], axis=1)[model.camera_of_image]
    longer = size.max(axis=1, initial=1).astype(np.float64)
    positions = (model.observed_pixels() - 0.5 * (size[tracks.image] - 1.0)) / longer[tracks.image][:, None]
    point = tracks.point_of_observation()
    yield f"{HEADER}{_WRITTEN_VERSION}"
    for k in np.flatnonzero(is_written[tracks.image]).tolist():
        image, (x, y) = int(tracks.image[k]), positions[k].tolist()
        color = "\t".join(map(str, points.rgb[point[k]].tolist()))
        yield (
            f"{images.name[image]}\t{point[k]}\t{tracks.keypoint[k]}\t{x!r}\t{y!r}\t{1.0 / longer[image]!r}"
            f"\t{color}\t{_NO_LABEL}\t{_NO_LABEL}"
        )
