"""Gaussians in PlayCanvas' compressed PLY: 16 bytes each, up to 45 for harmonics, in chunks of 256.

Positions and log scales have 11, 10 and 11 bits within their chunk's own range, colors 8 bits (in the range 0 to 1 in
early files, whose chunks have no color range), opacities 8 bits. Rotations omit their largest component (2 bits say
which); the others have 10 bits. Harmonics are bytes for -4 to 4. Axes are those of a PLY file.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.io.gaussians._finite import MOST_GAUSSIANS, finite_gaussians
from epipole.io.gaussians.morton import morton_codes
from epipole.io.gaussians.ply import origin_comment, origin_in_header
from epipole.io.meshes.ply import PLY_TYPES
from epipole.scene.gaussian_cloud import DC, NUM_SH, GaussianCloud

CHUNK = 256
"""Number of Gaussians with common ranges."""

_RANGES = tuple(
    tuple(f"{end}_{mark}{axis}" for end in ("min", "max") for axis in axes)
    for mark, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BITS_OF_THREE, _BITS_OF_COLOR = (11, 10, 11), (8, 8, 8, 8)
_MOST_LOG_SCALE = 20.0
_SH_RANGE = 8.0
_MOST_HEADER = 1 << 16
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of a quaternion (w, x, y, z) that are stored, by the index of the omitted one."""


class _Element(NamedTuple):
    name: str
    num_rows: int
    fields: list[tuple[str, str]]


@checked
def read_compressed_ply(path: str | Path) -> GaussianCloud:
    """Read Gaussians; non-finite ones are dropped.

    Raises:
        FileFormatError: the file is in another format, truncated or damaged, or has no finite Gaussian.
    """
    path = Path(path)
    data = file_bytes(path)
    tables = _tables(path, data)
    vertices, chunks = tables.get("vertex"), tables.get("chunk")
    if vertices is None or chunks is None or len(chunks) * CHUNK < len(vertices):
        raise FileFormatError(path, "damaged compressed PLY: too few chunks for its vertices")
    chunk = np.arange(len(vertices)) // CHUNK

    def within(part: str, bits: tuple[int, ...], names: tuple[str, ...]) -> np.ndarray:
        fractions = _unpacked(_column(path, vertices, part), bits)[:, :3]
        lows, highs = (np.stack([_column(path, chunks, n) for n in names[k : k + 3]], axis=1) for k in (0, 3))
        return lows[chunk] + fractions * (highs - lows)[chunk].astype(np.float64)

    position, scale, color = _RANGES
    means = within("packed_position", _BITS_OF_THREE, position)
    log_scales = within("packed_scale", _BITS_OF_THREE, scale)
    rgba = _unpacked(_column(path, vertices, "packed_color"), _BITS_OF_COLOR)
    has_ranges = all(name in (chunks.dtype.names or ()) for name in color)
    rgb = within("packed_color", _BITS_OF_COLOR, color) if has_ranges else rgba[:, :3]
    with np.errstate(divide="ignore"):
        logits = np.log(rgba[:, 3]) - np.log1p(-rgba[:, 3])
    sh = np.concatenate(
        [((rgb - 0.5) / DC)[:, None], _harmonics(path, tables.get("sh"), len(vertices))], axis=1
    )
    quats = _rotations(_column(path, vertices, "packed_rotation"))
    return finite_gaussians(path, (means, log_scales, quats, logits, sh), origin_in_header(path))


@checked
def write_compressed_ply(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians, sorted by location and rounded. A comment has the cloud's origin if it is not zero.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    cloud = cloud.rows(np.argsort(morton_codes(cloud.means_in_world), kind="stable"))
    n, higher = len(cloud), cloud.sh.shape[1] - 1
    starts = np.arange(0, n, CHUNK)
    colors = 0.5 + DC * cloud.sh[:, 0].astype(np.float64)
    log_scales = np.clip(cloud.log_scales.astype(np.float64), -_MOST_LOG_SCALE, _MOST_LOG_SCALE)
    opacity = 1.0 / (1.0 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    chunks, fractions = [], []
    for values in (cloud.means_in_world.astype(np.float64), log_scales, colors):
        lows, highs = (of.reduceat(values, starts, axis=0) for of in (np.minimum, np.maximum))
        lows, highs = lows.astype("<f4"), highs.astype("<f4")
        chunks += [lows, highs]
        spans = np.repeat((highs - lows).astype(np.float64), CHUNK, axis=0)[:n]
        offsets = values - np.repeat(lows, CHUNK, axis=0)[:n]
        fractions.append(np.divide(offsets, spans, out=np.zeros_like(offsets), where=spans > 0))
    packed = [
        _packed(fractions[0], _BITS_OF_THREE),
        _packed_rotations(cloud.quats_wxyz),
        _packed(fractions[1], _BITS_OF_THREE),
        _packed(np.column_stack([fractions[2], opacity]), _BITS_OF_COLOR),
    ]
    above = np.floor((cloud.sh[:, 1:].transpose(0, 2, 1) / _SH_RANGE + 0.5) * 256.0)
    harmonics = np.clip(above, 0, 255).astype(np.uint8).reshape(n, 3 * higher)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *origin_comment(cloud),
        f"element chunk {len(starts)}",
    ]
    header += [f"property float {name}" for names in _RANGES for name in names]
    header += [f"element vertex {n}", *(f"property uint {name}" for name in _PACKED)]
    if higher:
        header += [f"element sh {n}", *(f"property uchar f_rest_{k}" for k in range(3 * higher))]
    with atomic_write(Path(path)) as part, part.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in [*header, "end_header"]).encode("ascii"))
        stream.write(np.concatenate(chunks, axis=1).tobytes())
        stream.write(np.stack(packed, axis=1).tobytes())
        stream.write(harmonics.tobytes())


def _tables(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Elements by name, as declared in the header.

    Raises:
        FileFormatError: not the header of a binary file without lists, or the file is truncated.
    """
    end = data.find(b"end_header", 0, _MOST_HEADER)
    at = data.find(b"\n", end) + 1
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    if end < 0 or at < 1 or ["format", "binary_little_endian", "1.0"] not in lines:
        raise FileFormatError(path, "damaged compressed PLY (no header of a little-endian binary file)")
    elements: list[_Element] = []
    for words in lines:
        try:
            if words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1].fields.append((words[2], f"<{PLY_TYPES[words[1]]}"))
        except (KeyError, IndexError, ValueError) as error:
            problem = f"its header has {' '.join(words)[:60]!r}"
            raise FileFormatError(path, f"damaged compressed PLY: {problem}") from error
    tables = {}
    for name, count, fields in elements:
        if not 0 <= count <= MOST_GAUSSIANS or len(dict(fields)) < len(fields) or not fields:
            raise FileFormatError(path, f"damaged compressed PLY: {count} rows in element {name}")
        dtype = np.dtype(fields)
        if count * dtype.itemsize > len(data) - at:
            raise FileFormatError(path, f"the file is truncated: it should contain {count} rows of {name}")
        tables[name] = np.frombuffer(data, dtype, count, at)
        at += count * dtype.itemsize
    return tables


def _column(path: Path, table: np.ndarray, name: str) -> np.ndarray:
    if name not in (table.dtype.names or ()):
        raise FileFormatError(path, f"damaged compressed PLY: {name} is missing")
    return np.asarray(table[name])


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """(n, len(bits)) numbers from 0 to 1; the first one is in the uppermost bits."""
    left, out, wide = sum(bits), [], words.astype(np.int64)
    for count in bits:
        left -= count
        out.append((wide >> left & ((1 << count) - 1)) / ((1 << count) - 1))
    return np.stack(out, axis=1)


def _packed(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    words = np.zeros(len(fractions), np.int64)
    for column, count in zip(fractions.T, bits):
        most = (1 << count) - 1
        words = words << count | np.clip(np.rint(most * column), 0, most).astype(np.int64)
    return words.astype("<u4")


def _rotations(words: np.ndarray) -> np.ndarray:
    """Quaternions, with the omitted component computed from the unit length."""
    kept = (_unpacked(words, (2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2.0)
    largest = words.astype(np.int64) >> 30
    quats = np.zeros((len(words), 4))
    np.put_along_axis(quats, _OTHERS[largest], kept, axis=1)
    left_out = np.sqrt(np.maximum(0.0, 1.0 - (kept**2).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], left_out[:, None], axis=1)
    return quats.astype(np.float32)


def _packed_rotations(quats_wxyz: np.ndarray) -> np.ndarray:
    unit = quats_wxyz / np.linalg.norm(quats_wxyz.astype(np.float64), axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    kept = np.take_along_axis(unit, _OTHERS[largest], axis=1) * sign
    return _packed(np.column_stack([largest / 3.0, kept / np.sqrt(2.0) + 0.5]), (2, 10, 10, 10))


def _harmonics(path: Path, table: np.ndarray | None, count: int) -> np.ndarray:
    """(n, k, 3) coefficients above degree 0."""
    if table is None:
        return np.zeros((count, 0, 3), np.float32)
    num = len(table.dtype.names or ())
    if len(table) != count or num % 3 or num // 3 + 1 not in NUM_SH:
        raise FileFormatError(path, f"{len(table)} rows of {num} harmonics do not match any degree")
    steps = np.stack([_column(path, table, f"f_rest_{k}") for k in range(num)], axis=1).astype(np.float32)
    values = np.where(steps == 0, 0.0, np.where(steps == 255, 1.0, (steps + 0.5) / 256.0))
    return np.asarray(_SH_RANGE * (values - 0.5)).reshape(count, 3, num // 3).transpose(0, 2, 1)
