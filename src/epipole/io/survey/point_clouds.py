"""Point clouds on a map, as LAZ files (LAS 1.4, compressed), by way of laspy and lazrs.

Coordinates are 32-bit multiples of a step from an offset: 1 mm, or finer for models of less than 500 m.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole._checks import Declared, as_path, checked
from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.files import open_file, require_file
from epipole.io.survey._laz_headers import (
    SIGMA,
    crs_text,
    decoded_by_lazrs,
    known_crs,
    laspy_module,
    new_header,
    written_by_lazrs,
)
from epipole.io.survey._laz_layout import require_sound_chunks, require_sound_header

_STEP_M = 1e-3
"""Largest step of coordinates, unless the extent needs a larger one."""
_STEP_OF_EXTENT = 2e-6
"""Largest step as a fraction of the extent, so that coordinates are rounded by at most a millionth of it."""
_LEAST_STEP, _MOST_EXTENT = 1e-30, 1e30
_MOST_STEPS, _MOST_OFFSET_STEPS = 2**31 - 1, 1e8
"""Largest multiple of the step, and the largest one that rounding of the offset may cause."""
_BATCH = 1 << 18
"""Points that are converted at a time."""


class LazChunk(NamedTuple):
    """A part of a point cloud."""

    points: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    sigma: Float32[np.ndarray, " n"] | None = None
    """Standard deviations in meters."""
    classification: UInt8[np.ndarray, " n"] | None = None
    """Classes of LAS 1.4, such as 2 for ground; None: 0, never classified."""


@dataclass(frozen=True, slots=True, eq=False)
class LazPoints(Declared):
    """The points of a LAS or LAZ file."""

    points: Float64[np.ndarray, "n 3"]
    """Easting, northing and height."""
    rgb: UInt8[np.ndarray, "n 3"] | None
    """None if the file has no colors."""
    sigma: Float32[np.ndarray, " n"] | None
    """Standard deviations in meters; None if the file has none."""
    classification: UInt8[np.ndarray, " n"]
    """Classes of LAS."""
    crs: str | None
    """EPSG:number, or WKT; None if the file has no coordinate system."""

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        colors = "no" if self.rgb is None else "with"
        return f"LazPoints({len(self)}, {colors} colors, {self.crs or 'unknown CRS'})"


@checked
def write_laz(
    path: str | Path,
    points: Float64[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    *,
    crs: str | None = None,
    sigma: Float32[np.ndarray, " n"] | None = None,
    classification: UInt8[np.ndarray, " n"] | None = None,
) -> None:
    """Write points with colors as LAZ: LAS 1.4, point format 7.

    Coordinates are rounded to 1 mm, or to a millionth of the extent if that is less. Beyond an extent of 4000 km, 32-bit
    numbers need a larger step.

    Args:
        path: the file.
        points: easting, northing and height; finite.
        rgb: colors, 0 to 255.
        crs: the coordinate system, such as EPSG:32632; None if it is unknown.
        sigma: standard deviations in meters, for the extra dimension `sigma`.
        classification: classes of LAS 1.4, such as 2 for ground.

    Raises:
        ShapeError: the arrays do not match, or a coordinate is not finite.
        ConfigError: the coordinate system is unknown.
        WorkspaceError: the file cannot be written.
        MissingDependencyError: laspy, lazrs or pyproj is not installed.
    """
    bounds = np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else None
    if bounds is not None and not np.isfinite(bounds).all():
        raise ShapeError("points must be finite; remove those with NaN or infinite coordinates")
    write_laz_chunks(path, [LazChunk(points, rgb, sigma, classification)], bounds=bounds, crs=crs)


def write_laz_chunks(
    path: str | Path,
    chunks: Iterable[LazChunk | tuple[Any, ...]],
    *,
    bounds: Float64[np.ndarray, "2 3"] | None = None,
    crs: str | None = None,
) -> None:
    """Write a point cloud in parts, of which one is in memory at a time; otherwise as `write_laz`.

    Args:
        path: the file.
        chunks: parts of the cloud, or tuples (points, rgb, sigma, classification), of which the last two may be missing;
            all of them with standard deviations, or none.
        bounds: the smallest and the largest coordinates, which determine the rounding; None: those of the first part.
        crs: the coordinate system, such as EPSG:32632; None if it is unknown.

    Raises:
        ShapeError: the arrays do not match, a coordinate is not finite, or a point is too far outside `bounds`.
        ConfigError: the coordinate system is unknown, or a part is not a tuple of arrays.
        WorkspaceError: the file cannot be written.
        MissingDependencyError: laspy, lazrs or pyproj is not installed.
    """
    target, bounds, crs = _options(as_path(path), bounds, crs)
    laspy, system = laspy_module(), known_crs(crs)
    try:
        each = iter(chunks)
    except TypeError as error:
        raise ConfigError(f"chunks must be parts of a point cloud, got {chunks!r:.60}") from error
    with atomic_write(target) as part, part.open("w+b") as stream:
        writer, is_uncertain = None, False
        for number, chunk in enumerate(each):
            columns = _columns_of(chunk, number)
            has_sigma = columns.sigma is not None
            if number and has_sigma != is_uncertain:
                raise ShapeError(f"chunks[{number}]: give sigma for all parts, or for none")
            is_uncertain = has_sigma
            if not len(columns.points):
                continue
            if writer is None:
                step, offset = _rounding(_bounds_of(columns.points) if bounds is None else bounds)
                writer = _Writer(stream, new_header(laspy, step, offset, system, has_sigma))
            writer.write(columns)
        if writer is None:
            step, offset = _rounding(np.zeros((2, 3)) if bounds is None else bounds)
            writer = _Writer(stream, new_header(laspy, step, offset, system, is_uncertain))
        writer.finish()


def require_laspy() -> None:
    """Check that laspy and lazrs are installed, before work whose result needs them.

    Raises:
        MissingDependencyError: one is not.
    """
    laspy_module()


class _Writer:
    """A LAZ file that is being written."""

    def __init__(self, stream: BinaryIO, header: Any) -> None:
        import laspy

        self._header = header
        with written_by_lazrs():
            self._out = laspy.LasWriter(
                stream, header, do_compress=True, laz_backend=laspy.LazBackend.LazrsParallel, closefd=False
            )

    def write(self, chunk: LazChunk) -> None:
        for start in range(0, len(chunk.points), _BATCH):
            rows = slice(start, start + _BATCH)
            record = self._record(
                LazChunk(*(None if column is None else column[rows] for column in chunk))  # type: ignore[arg-type]
            )
            with written_by_lazrs():
                self._out.write_points(record)

    def finish(self) -> None:
        with written_by_lazrs():
            self._out.close()

    def _record(self, chunk: LazChunk) -> Any:
        from laspy.point.record import PackedPointRecord

        steps = np.rint((chunk.points - self._header.offsets) / self._header.scales)
        if not (np.abs(steps) <= _MOST_STEPS).all():  # not for NaN
            problem = "points must be finite, and near the bounds"
            raise ShapeError(f"{problem}; write_laz_chunks without bounds uses those of the first part")
        record = PackedPointRecord.zeros(len(steps), self._header.point_format)
        for axis, name in enumerate("XYZ"):
            record.array[name] = steps[:, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            record.array[name] = chunk.rgb[:, channel].astype(np.uint16) * np.uint16(257)
        record["return_number"] = np.ones(len(steps), np.uint8)
        record["number_of_returns"] = np.ones(len(steps), np.uint8)
        if chunk.sigma is not None:
            record.array[SIGMA] = chunk.sigma
        if chunk.classification is not None:
            record["classification"] = chunk.classification
        return record


@checked
def read_laz(path: str | Path) -> LazPoints:
    """Read the points of a LAS or LAZ file, with colors, classes, and standard deviations as of `write_laz`.

    Args:
        path: the file.

    Raises:
        FileFormatError: not a LAS or LAZ file, truncated or damaged.
        MissingDependencyError: laspy, lazrs or pyproj is not installed.
    """
    path = Path(path)
    laspy = laspy_module()
    num_bytes = require_file(path)
    with open_file(path) as stream, decoded_by_lazrs(path):
        require_sound_header(path, stream, num_bytes)
        header = laspy.LasHeader.read_from(stream)
        names = set(header.point_format.dimension_names)
        count = header.point_count
        points = np.empty((count, 3))
        rgb = np.empty((count, 3), np.uint16) if "red" in names else None
        sigma = np.empty(count, np.float32) if SIGMA in names else None
        classification = np.empty(count, np.uint8)
        start = 0
        for record in _records(path, stream, header):
            rows = slice(start, start + len(record))
            for axis, name in enumerate("XYZ"):
                points[rows, axis] = record[name] * header.scales[axis] + header.offsets[axis]
            if rgb is not None:
                for channel, name in enumerate(("red", "green", "blue")):
                    rgb[rows, channel] = record[name]
            if sigma is not None:
                sigma[rows] = np.asarray(record[SIGMA])
            classification[rows] = np.asarray(record["classification"])
            start = rows.stop
        if not np.isfinite(points).all():
            raise FileFormatError(path, "a coordinate is not finite: its scale or offset is damaged")
        return LazPoints(
            points, None if rgb is None else _bytes_of(rgb), sigma, classification, crs_text(header)
        )


def _records(path: Path, stream: BinaryIO, header: Any) -> Iterator[Any]:
    """The points in batches."""
    import laspy
    import lazrs
    from laspy.point.record import PackedPointRecord

    size, reader = header.point_format.size, None
    stream.seek(header.offset_to_point_data)
    if header.are_points_compressed and header.point_count:
        packings = header.vlrs.get("LasZipVlr")
        if not packings:
            raise FileFormatError(path, "the points are compressed, but the LASzip record is missing")
        require_sound_chunks(path, stream, header, lazrs.LazVlr(packings[0].record_data))
        reader = laspy.LazBackend.Lazrs.create_reader(stream, header)
    for start in range(0, header.point_count, _BATCH):
        num = min(_BATCH, header.point_count - start)
        data = stream.read(num * size) if reader is None else reader.read_n_points(num)
        if len(data) < num * size:
            raise FileFormatError(path, f"the file ends inside its {header.point_count} points")
        yield PackedPointRecord.from_buffer(data, header.point_format)


@checked
def _options(
    path: Path, bounds: Float64[np.ndarray, "2 3"] | None, crs: str | None
) -> tuple[Path, Float64[np.ndarray, "2 3"] | None, str | None]:
    return path, bounds, crs


@checked
def _columns(
    points: Float64[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    sigma: Float32[np.ndarray, " n"] | None = None,
    classification: UInt8[np.ndarray, " n"] | None = None,
) -> LazChunk:
    return LazChunk(points, rgb, sigma, classification)


def _columns_of(chunk: Any, number: int) -> LazChunk:
    if not isinstance(chunk, tuple | list) or not 2 <= len(chunk) <= 4:
        problem = f"chunks[{number}] must be (points, rgb, sigma, classification)"
        raise ConfigError(f"{problem}, got {type(chunk).__name__}")
    return _columns(*chunk)


def _bounds_of(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _rounding(bounds: np.ndarray) -> tuple[float, np.ndarray]:
    """Step of the coordinates, a power of ten, and their offset: the middle, rounded down to whole meters.

    Raises:
        ShapeError: the bounds are not finite, or too large.
    """
    if not (np.isfinite(bounds).all() and np.abs(bounds).max() < _MOST_EXTENT):
        raise ShapeError(
            "points must be finite, and at most 1e30; remove those with NaN or infinite coordinates"
        )
    lower, upper = bounds.min(axis=0), bounds.max(axis=0)
    extent = float((upper - lower).max())
    if extent == 0.0:
        return _STEP_M, lower
    step = min(_STEP_M, 10.0 ** math.floor(math.log10(max(_STEP_OF_EXTENT * extent, _LEAST_STEP))))
    step = max(step, 10.0 ** math.ceil(math.log10(extent / (2 * _MOST_STEPS - 4 * _MOST_OFFSET_STEPS))))
    unit = min(1.0, _MOST_OFFSET_STEPS * step)
    return step, np.floor((lower + upper) / 2 / unit) * unit


def _bytes_of(rgb: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Colors 0 to 255 from 16-bit ones; some programs write 8-bit values as they are."""
    return (rgb >> (8 if rgb.size and rgb.max() > 255 else 0)).astype(np.uint8)
