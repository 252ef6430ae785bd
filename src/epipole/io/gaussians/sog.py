"""Gaussians in SOG, PlayCanvas' format for the web: a zip of images with one pixel per Gaussian, and meta.json.

Means are sign(x) log(1 + |x|) in 16 bits, the upper 8 in a separate image. Rotations omit their largest component
(alpha says which). Log scales and colors are indices into a codebook of 256 numbers. Harmonics above degree 0 are rows
of a palette, stored 64 per image row, whose values also use a codebook. Axes are those of a PLY file. Version 1 has
ranges (mins, maxs) instead of codebooks, and is supported for reading only. Specification: developer.playcanvas.com,
user manual, Gaussian splatting, formats, SOG.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io._named_numbers import numbers_of
from epipole.io.gaussians._finite import MOST_LOGIT, finite_gaussians
from epipole.io.gaussians._sog_files import META, count_of, decoded, in_archive, in_folder, write_archive
from epipole.io.gaussians._sog_palettes import CODES, PALETTE, codebook_of, codes_of, palette_of
from epipole.io.gaussians.morton import interleaved
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.local_origin import ORIGIN

ROW = 64
"""Palette rows per image row."""
_HIGHER = {ROW * 3: 3, ROW * 8: 8, ROW * 15: 15}
"""Number of coefficients above degree 0 by the width of the palette image."""
_FIRST_TAG = 252
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of a quaternion (w, x, y, z) that are stored, by the index of the omitted one."""
_LARGE_COUNT, _SEEN_COUNT = 1.5, 0.5
"""Exponents of weights in the codebook and the palette: few Gaussians are large, but they dominate a render."""
_SMALLEST_PALETTE, _LARGEST = 1024, 6e4
"""Fewest palette rows, and largest coefficient (squares are summed in single precision)."""


@checked
def read_sog(path: str | Path) -> GaussianCloud:
    """Read Gaussians; non-finite ones are dropped.

    Args:
        path: a .sog file, or the meta.json of a folder.

    Raises:
        FileFormatError: the file is in another format, truncated or damaged, or has no finite Gaussian.
    """
    path = Path(path)
    meta, images = in_folder(path) if path.name.lower() == META else in_archive(path)
    count = count_of(path, meta, sum(map(len, images.values())))

    def pixels(part: str, k: int = 0) -> np.ndarray:
        name = meta[part]["files"][k]
        found = decoded(path, name, images[name], count).reshape(-1, 4)
        if len(found) < count:
            raise FileFormatError(path, f"{name!a} has {len(found)} pixels for {count} Gaussians")
        return found[:count]

    means = _means(path, meta["means"], pixels("means"), pixels("means", 1))
    scales, base = (pixels(part) for part in ("scales", "sh0"))
    colors = _table(path, meta, "sh0", 4)
    sh = colors[base, np.arange(4)][:, None, :3]
    if meta.get("shN"):
        name = meta["shN"]["files"][0]
        palette = _palette(path, meta, decoded(path, name, images[name], PALETTE * 15))
        sh = np.concatenate([sh, palette[_labels(path, pixels("shN", 1), len(palette))]], axis=1)
    log_scales = _table(path, meta, "scales", 3)[scales[:, :3], np.arange(3)]
    quats = _quats(path, pixels("quats"))
    origin = numbers_of(path, meta, ORIGIN, 3) if ORIGIN in meta else None
    return finite_gaussians(path, (means, log_scales, quats, colors[base[:, 3], 3], sh), origin)


def _table(path: Path, meta: Mapping[str, Any], part: str, channels: int) -> np.ndarray:
    """(256, channels) float32, the values of an image's codes; the fourth channel is the logit of an opacity.

    Raises:
        FileFormatError: meta.json lacks them.
    """
    given, steps = meta[part], np.linspace(0.0, 1.0, CODES)[:, None]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if "codebook" in given or meta.get("version") == 2:
            logits = np.clip(np.log(steps) - np.log1p(-steps), -MOST_LOGIT, MOST_LOGIT)
            numbers = _codebook(path, part, given.get("codebook"))[:, None]
            return np.concatenate([numbers] * 3 + [logits] * (channels - 3), axis=1).astype(np.float32)
        lows, highs = (numbers_of(path, given, key) for key in ("mins", "maxs"))
        # Harmonics have a single range.
        if any(len(ends) not in (1, channels) for ends in (lows, highs)):
            raise FileFormatError(path, f"{META}: {part} has no mins and maxs of {channels} numbers")
        return np.broadcast_to(lows + steps * (highs - lows), (CODES, channels)).astype(np.float32)


def _codebook(path: Path, part: str, given: Any) -> np.ndarray:
    """256 numbers. If the first one is missing, as in early files, it is set one mean step below the second (as PlayCanvas)."""
    if not isinstance(given, list) or len(given) != CODES:
        raise FileFormatError(path, f"{META} does not have the {CODES} codebook numbers of {part}")
    name = f"the codebook of {part}"
    numbers = numbers_of(path, {name: given[1:]}, name, CODES - 1)
    step = (numbers[-1] - numbers[0]) / (CODES - 1)
    first = [numbers[0] - step] if given[0] is None else numbers_of(path, {name: given[:1]}, name, 1)
    return np.concatenate([first, numbers])


def _means(path: Path, given: Mapping[str, Any], lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    lows, highs = (numbers_of(path, given, key, 3) for key in ("mins", "maxs"))
    codes = lower[:, :3] + 256.0 * upper[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        logs = lows + codes / 65535.0 * (highs - lows)
        return np.asarray(np.sign(logs) * np.expm1(np.abs(logs)))


def _quats(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Quaternions, with the omitted component computed from the unit length."""
    left_out = pixels[:, 3].astype(np.int64) - _FIRST_TAG
    if left_out.min() < 0:
        problem = f"a rotation has the alpha {left_out.min() + _FIRST_TAG}, not {_FIRST_TAG} to 255"
        raise FileFormatError(path, problem)
    kept = (pixels[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    quats = np.zeros((len(pixels), 4), np.float32)
    np.put_along_axis(quats, _OTHERS[left_out], kept.astype(np.float32), axis=1)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (kept**2).sum(axis=1)))
    np.put_along_axis(quats, left_out[:, None], largest[:, None].astype(np.float32), axis=1)
    return quats


def _palette(path: Path, meta: Mapping[str, Any], pixels: np.ndarray) -> np.ndarray:
    """(rows, coefficients, 3) float32."""
    height, width = pixels.shape[:2]
    higher, given = _HIGHER.get(width), meta["shN"]
    if higher is None or not 1 <= height * ROW <= PALETTE:
        raise FileFormatError(path, f"a palette of {width} x {height} pixels does not match any degree")
    if "bands" in given and given["bands"] != {3: 1, 8: 2, 15: 3}[higher]:
        raise FileFormatError(
            path, f"the palette has {higher} harmonics, not those of {given['bands']!a} bands"
        )
    size = given.get("count", height * ROW)
    if not isinstance(size, int) or size < 1:
        raise FileFormatError(path, f"{META} has no palette size")
    codes = pixels.reshape(-1, higher, 4)[:size, :, :3]
    return _table(path, meta, "shN", 3)[codes, np.arange(3)]


def _labels(path: Path, pixels: np.ndarray, size: int) -> np.ndarray:
    labels = pixels[:, 0] + 256 * pixels[:, 1].astype(np.int64)
    if labels.max() >= size:
        raise FileFormatError(path, f"a label points to row {labels.max()} of a palette of {size}")
    return labels


@checked
def write_sog(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians as SOG version 2, sorted by location and rounded; non-finite ones are dropped.

    Raises:
        ConfigError: no Gaussian is finite.
        WorkspaceError: the file cannot be written.
    """
    path = Path(path)
    try:
        cloud = finite_gaussians(path, _arrays(cloud), cloud.origin_in_world)
    except FileFormatError as error:
        raise ConfigError(f"none of {len(cloud)} Gaussians is finite; nothing to write") from error
    logs = np.sign(cloud.means_in_world) * np.log1p(np.abs(cloud.means_in_world.astype(np.float64)))
    lows, highs = logs.min(axis=0), logs.max(axis=0)
    codes = np.rint(65535.0 / np.maximum(highs - lows, 1e-30) * (logs - lows)).astype(np.uint32)
    order = np.argsort(interleaved(codes), kind="stable")
    cloud, codes = cloud.rows(order), codes[order]
    scales, colors = codebook_of(cloud.log_scales, _LARGE_COUNT), codebook_of(cloud.sh[:, 0])
    images = {
        "means_l.webp": _rows_of_pixels(codes & 255),
        "means_u.webp": _rows_of_pixels(codes >> 8),
        "scales.webp": _rows_of_pixels(codes_of(cloud.log_scales, scales)),
        "quats.webp": _rows_of_pixels(_smallest_three(cloud.quats_wxyz)),
        "sh0.webp": _rows_of_pixels(
            np.c_[codes_of(cloud.sh[:, 0], colors), np.rint(255.0 * _opacity(cloud))]
        ),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "epipole"},
        "count": len(cloud),
        "means": {"mins": lows.tolist(), "maxs": highs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    if cloud.origin_in_world.any():
        meta[ORIGIN] = cloud.origin_in_world.tolist()
    if cloud.sh_degree:
        meta["shN"] = _add_harmonics(cloud, images)
    write_archive(path, meta, images)


def _arrays(cloud: GaussianCloud) -> tuple[np.ndarray, ...]:
    return cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh


def _opacity(cloud: GaussianCloud) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(cloud.opacity_logits.astype(np.float64), -99.0, 99.0)))


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """(n, 4): three components of a unit quaternion, and the index of the omitted one, whose sign is made positive."""
    unit = quats / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    sign = np.sign(np.take_along_axis(unit, largest[:, None], axis=1))
    kept = np.take_along_axis(unit, _OTHERS[largest], axis=1) * sign
    return np.c_[np.rint(255.0 * (kept / np.sqrt(2.0) + 0.5)), _FIRST_TAG + largest]


def _add_harmonics(cloud: GaussianCloud, images: dict[str, np.ndarray]) -> dict[str, Any]:
    """Add the two images of the harmonics; returns their entry in meta.json."""
    n, higher = len(cloud), cloud.sh.shape[1] - 1
    rows = np.clip(cloud.sh[:, 1:], -_LARGEST, _LARGEST).reshape(n, -1)
    palette, labels = palette_of(rows, _seen(cloud), _palette_size(n))
    codebook = codebook_of(palette)
    height = -(-len(palette) // ROW)
    image = np.zeros((height * ROW * higher, 3), np.uint8)
    image[: len(palette) * higher] = codes_of(palette, codebook).reshape(-1, 3)
    images["shN_centroids.webp"] = image.reshape(height, ROW * higher, 3)
    images["shN_labels.webp"] = _rows_of_pixels(np.c_[labels & 255, labels >> 8, np.zeros(n)])
    return {
        "count": len(palette),
        "bands": cloud.sh_degree,
        "codebook": codebook.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _seen(cloud: GaussianCloud) -> np.ndarray:
    """(n,) float32 visibility independent of position: (opacity^2 times the area of the ellipse) to a power."""
    area = np.sort(cloud.log_scales, axis=1)[:, 1:].sum(axis=1, dtype=np.float64)
    seen = (_opacity(cloud) ** 2 * np.exp(area - area.max())) ** _SEEN_COUNT
    return np.maximum(seen / seen.max(), 1e-6).astype(np.float32)


def _palette_size(count: int) -> int:
    """The largest power of two up to the number of Gaussians, as in PlayCanvas' writer; half of it loses 6 dB in renders."""
    return min(PALETTE, max(_SMALLEST_PALETTE, 1 << max(0, count.bit_length() - 1)))


def _rows_of_pixels(values: np.ndarray) -> np.ndarray:
    """(h, w, 3 or 4) uint8, one pixel per row of `values` in a nearly square image; black after the end."""
    width = -(-int(np.ceil(np.sqrt(len(values)))) // 4) * 4
    height = -(-len(values) // (4 * width)) * 4
    out = np.zeros((height * width, values.shape[1]), np.uint8)
    out[: len(values)] = values
    return out.reshape(height, width, -1)
