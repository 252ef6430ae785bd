"""Gaussians in SPZ (Niantic): about 64 bytes each, compressed with gzip (up to version 3) or zstd (version 4).

Positions are 24-bit fixed-point numbers (half-precision floats in version 1), opacities and colors bytes, log scales
sixteenths, and harmonics 128ths. Rotations are x, y, z as three bytes up to version 2, and then the three smallest
components with 10 bits each. SPZ's axes are right, up, back: rotated by 180 degrees around x from those of a PLY file.
Specification: github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import zstandard

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, most_unpacked_bytes
from epipole.io.gaussians._finite import MOST_GAUSSIANS, finite_gaussians
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud

_MAGIC = b"NGSP"
_HEAD = struct.Struct("<4sIIBBBB")
"""Magic, version, count, degree of harmonics, fractional bits, flags, and the number of streams in version 4."""
_HEAD_4 = struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_WRITTEN_VERSION, _FRACTIONAL_BITS, _MOST_FRACTIONAL_BITS = 3, 12, 24
_SMALL_BYTES = 1 << 24
"""Unpacked size allowed for any file; larger ones may unpack to a multiple of their size (`most_unpacked_bytes`)."""
_SPARE_BYTES = 1 << 16
"""Space for extensions that may follow the Gaussians."""
_LARGEST_FIXED = (1 << 23) - 1
_COLOR_STEPS = 0.15 * 255.0
_SMALLEST_PART = (1 << 9) - 1
_BY_PI = np.array([1, -1, -1], np.float32)
_BY_PI_WXYZ = np.array([1, 1, -1, -1], np.float32)
_BY_PI_SH = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs of the harmonics after a rotation by 180 degrees around x."""


@checked
def read_spz(path: str | Path) -> GaussianCloud:
    """Read Gaussians in versions 1 to 4; non-finite ones are dropped.

    Raises:
        FileFormatError: not an SPZ file, an unsupported version, truncated or damaged, or without finite Gaussians.
    """
    path = Path(path)
    data = file_bytes(path)
    head, body = _sections_4(path, data) if data[:4] == _MAGIC else _sections(path, data)
    _, version, count, degree, bits, _, _ = head
    higher = NUM_SH[degree] - 1
    at = 0

    def take(size: int) -> np.ndarray:
        nonlocal at
        at += size * count
        return np.frombuffer(body, np.uint8, size * count, at - size * count).reshape(count, size)

    means = _positions(take(6 if version == 1 else 9), version, bits)
    opacity = take(1)[:, 0] / 255.0
    colors = (take(3).astype(np.float32) - 127.5) / np.float32(_COLOR_STEPS)
    log_scales = take(3).astype(np.float32) / 16.0 - 10.0
    quats = _first_three(take(3)) if version < 3 else _smallest_three(take(4))
    above = (take(3 * higher).astype(np.float32).reshape(count, higher, 3) - 128.0) / 128.0
    with np.errstate(divide="ignore"):
        logits = np.log(opacity) - np.log1p(-opacity)
    sh = np.concatenate([colors[:, None], above], axis=1)
    return _rotated_by_pi(finite_gaussians(path, (means, log_scales, quats, logits, sh)))


@checked
def write_spz(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians as version 3, rounded; coordinates are relative to the cloud's origin, which the format cannot store.

    Positions have 12 fractional bits, fewer if the scene is wider than 4096 units.

    Raises:
        ConfigError: a position is outside the format's range.
        WorkspaceError: the file cannot be written.
    """
    cloud = _rotated_by_pi(cloud)
    farthest = float(np.abs(cloud.means_in_world).max(initial=0.0))
    bits = next((b for b in range(_FRACTIONAL_BITS, 0, -1) if farthest * 2**b <= _LARGEST_FIXED), None)
    if bits is None:
        raise ConfigError(f"SPZ cannot store the coordinate {farthest:.3g}: write a PLY or SOG file")
    fixed = np.rint(cloud.means_in_world.astype(np.float64) * 2**bits).astype("<i4")
    opacity = 1.0 / (1.0 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    parts = [
        fixed.view(np.uint8).reshape(len(cloud), 3, 4)[..., :3],
        _bytes(255.0 * opacity),
        _bytes(_COLOR_STEPS * cloud.sh[:, 0] + 127.5),
        _bytes(16.0 * (cloud.log_scales + 10.0)),
        _packed_rotations(cloud.quats_wxyz),
        _bytes(128.0 * cloud.sh[:, 1:] + 128.0),
    ]
    head = _HEAD.pack(_MAGIC, _WRITTEN_VERSION, len(cloud), cloud.sh_degree, bits, 0, 0)
    packed = gzip.compress(head + b"".join(part.tobytes() for part in parts), 6, mtime=0)
    with atomic_write(Path(path)) as part:
        part.write_bytes(packed)


def _rotated_by_pi(cloud: GaussianCloud) -> GaussianCloud:
    """Rotate by 180 degrees around x."""
    return replace(
        cloud,
        means_in_world=cloud.means_in_world * _BY_PI,
        quats_wxyz=cloud.quats_wxyz * _BY_PI_WXYZ,
        sh=cloud.sh * _BY_PI_SH[: cloud.sh.shape[1], None],
        origin_in_world=cloud.origin_in_world * _BY_PI + 0.0,
    )


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _section_sizes(version: int, degree: int) -> list[int]:
    """Bytes per Gaussian in each section: positions, opacities, colors, scales, rotations, harmonics."""
    return [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * (NUM_SH[degree] - 1)]


def _check_head(path: Path, head: tuple, versions: tuple[int, ...], num_bytes: int) -> None:
    """Check a header before anything is unpacked.

    Raises:
        FileFormatError: the header is invalid, or has more Gaussians than `num_bytes` compressed bytes can contain.
    """
    magic, version, count, degree, bits = head[:5]
    if magic != _MAGIC:
        raise FileFormatError(path, "not an SPZ file; export or copy it again")
    if version not in versions:
        raise FileFormatError(path, f"unsupported SPZ version {version} (not 1 to 4)")
    if count > MOST_GAUSSIANS:
        raise FileFormatError(path, f"{count} Gaussians are more than the limit of {MOST_GAUSSIANS}")
    if degree >= len(NUM_SH):
        raise FileFormatError(path, f"unsupported harmonics of degree {degree} (not 0 to {len(NUM_SH) - 1})")
    if not (version == 1 or 0 <= bits <= _MOST_FRACTIONAL_BITS):
        raise FileFormatError(path, f"damaged SPZ file: positions with {bits} fractional bits")
    if count * sum(_section_sizes(version, degree)) > most_unpacked_bytes(num_bytes, _SMALL_BYTES):
        raise FileFormatError(path, f"{count} Gaussians cannot fit into {num_bytes} bytes")


def _sections(path: Path, data: bytes) -> tuple[tuple, bytes]:
    """Header and sections of versions 1 to 3: one gzip stream, unpacked only up to the size given by its header."""
    unpack = zlib.decompressobj(31)
    try:
        start = unpack.decompress(data, _HEAD.size)
        if len(start) < _HEAD.size:
            raise FileFormatError(path, "not an SPZ file; export or copy it again")
        head = _HEAD.unpack(start)
        _check_head(path, head, (1, 2, 3), len(data))
        size = head[2] * sum(_section_sizes(head[1], head[3]))
        found = unpack.decompress(unpack.unconsumed_tail, size + _SPARE_BYTES)
    except (zlib.error, MemoryError) as error:
        raise FileFormatError(path, f"not an SPZ file ({error}); export or copy it again") from error
    if len(found) < size:
        raise FileFormatError(path, f"damaged SPZ file: only {len(found)} of {size} bytes are present")
    if len(found) >= size + _SPARE_BYTES:
        raise FileFormatError(path, f"it unpacks to more bytes than its {head[2]} Gaussians need")
    return head, found


def _sections_4(path: Path, data: bytes) -> tuple[tuple, bytes]:
    """Header and sections of version 4: one zstd stream for each non-empty section."""
    if len(data) < _HEAD_4.size:
        raise FileFormatError(path, "damaged SPZ file: its header is truncated")
    *head, at = _HEAD_4.unpack_from(data)
    _check_head(path, tuple(head), (4,), len(data))
    sizes = [head[2] * size for size in _section_sizes(head[1], head[3]) if size]
    first = at + len(sizes) * _SIZES.size
    if head[6] != len(sizes) or at < _HEAD_4.size or first > len(data):
        raise FileFormatError(path, f"damaged SPZ file: {head[6]} streams, expected {len(sizes)}")
    out = []
    for k, size in enumerate(sizes):
        packed, promised = _SIZES.unpack_from(data, at + k * _SIZES.size)
        if promised != size or packed > len(data) - first:
            raise FileFormatError(path, f"damaged SPZ file: stream {k} of {packed} bytes for {promised}")
        try:
            with zstandard.ZstdDecompressor().stream_reader(
                io.BytesIO(data[first : first + packed])
            ) as stream:
                found = stream.read(size + 1)
        except (zstandard.ZstdError, MemoryError) as error:
            raise FileFormatError(path, f"damaged SPZ file ({error})") from error
        if len(found) != size:
            raise FileFormatError(path, f"damaged SPZ file: stream {k} does not unpack to {size} bytes")
        out.append(found)
        first += packed
    return tuple(head), b"".join(out)


def _positions(packed: np.ndarray, version: int, bits: int) -> np.ndarray:
    if version == 1:
        return np.ascontiguousarray(packed).view("<f2").astype(np.float64)
    wide = np.zeros((len(packed), 3, 4), np.uint8)
    wide[..., 1:] = packed.reshape(-1, 3, 3)
    return (wide.reshape(-1, 12).view("<i4") >> 8) / float(1 << bits)  # the arithmetic shift extends the sign


def _first_three(packed: np.ndarray) -> np.ndarray:
    """Quaternions from x, y and z; w follows from the unit length."""
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1)))
    return np.column_stack([w, xyz]).astype(np.float32)


def _smallest_three(packed: np.ndarray) -> np.ndarray:
    """Quaternions from the three smallest of (x, y, z, w), 10 bits of sign and size each, the last one lowest."""
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0].astype(np.int64)
    largest = bits >> 30
    xyzw = np.zeros((len(bits), 4))
    for axis in (3, 2, 1, 0):
        is_kept = largest != axis
        size = (bits & _SMALLEST_PART) / (_SMALLEST_PART * np.sqrt(2.0))
        xyzw[:, axis] = np.where(is_kept, np.where(bits & (_SMALLEST_PART + 1), -size, size), 0.0)
        bits = np.where(is_kept, bits >> 10, bits)
    left_out = np.sqrt(np.maximum(0.0, 1.0 - (xyzw**2).sum(axis=1)))
    np.put_along_axis(xyzw, largest[:, None], left_out[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def _packed_rotations(quats_wxyz: np.ndarray) -> np.ndarray:
    """The inverse of `_smallest_three`."""
    xyzw = quats_wxyz[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1.0, 1.0)
    packed = largest.astype(np.int64)
    for axis in range(4):
        size = np.minimum(np.rint(np.abs(xyzw[:, axis]) * np.sqrt(2.0) * _SMALLEST_PART), _SMALLEST_PART)
        part = np.where(xyzw[:, axis] < 0, _SMALLEST_PART + 1, 0) + size.astype(np.int64)
        packed = np.where(largest == axis, packed, packed << 10 | part)
    return packed.astype("<u4")
