"""Vector quantization: a codebook of 256 numbers for scalars, and a palette of rows for the harmonics.

Both use Lloyd's iteration (1982) from a start determined by the data, so the output is deterministic.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from epipole import _parallel

CODES, PALETTE = 256, 65536
"""Most numbers and rows that the format allows."""
_BINS, _STEPS_OF_CODES = 256, 50
_GROUPS, _STEPS, _STEPS_OF_GROUPS, _ROUNDS = 64, 6, 6, 4
_SAMPLE, _TOGETHER = 1 << 15, 1 << 12


def codebook_of(values: Float32[np.ndarray, "*shape"], power: float = 0.0) -> Float32[np.ndarray, " 256"]:
    """The numbers that values are rounded to, in ascending order: the values themselves if there are at most 256.

    Values are sorted once, so that a step of Lloyd's iteration is a search for the 255 boundaries.

    Args:
        values: the values to quantize.
        power: a value v has the weight exp(power v).
    """
    ordered = np.sort(values, axis=None)
    first = np.flatnonzero(np.diff(ordered, prepend=np.float32(-np.inf)))
    if len(first) <= CODES:
        return np.pad(ordered[first], (0, CODES - len(first)), mode="edge")
    ordered = ordered.astype(np.float64)
    weights = np.exp(power * (ordered - ordered[-1]))
    sums = np.concatenate([[0.0], np.cumsum(weights * ordered)])
    masses = np.concatenate([[0.0], np.cumsum(weights)])
    codes = _spread(ordered, weights)
    for _ in range(_STEPS_OF_CODES):
        borders = np.searchsorted(ordered, 0.5 * (codes[1:] + codes[:-1]))
        edges = np.concatenate([[0], borders, [len(ordered)]])
        mass = np.diff(masses[edges])
        means = np.diff(sums[edges]) / np.maximum(mass, 1e-300)
        moved = np.sort(np.where(mass > 0, means, codes))
        if np.array_equal(moved, codes):
            break
        codes = moved
    return codes.astype(np.float32)


def _spread(ordered: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Initial codes, as dense as the cube root of the values' density, optimal for many codes (Panter and Dite, 1951)."""
    counts, edges = np.histogram(ordered, _BINS, weights=weights)
    fraction = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    wanted = (np.arange(CODES) + 0.5) / CODES * fraction[-1]
    return np.interp(wanted, fraction, edges)


def codes_of(
    values: Float32[np.ndarray, "*shape"], codebook: Float32[np.ndarray, " 256"]
) -> UInt8[np.ndarray, "*shape"]:
    """Index of the nearest codebook number."""
    book = codebook.astype(np.float64)
    return np.searchsorted(0.5 * (book[1:] + book[:-1]), values).astype(np.uint8)


def palette_of(
    rows: Float32[np.ndarray, "n d"], weights: Float[np.ndarray, " n"], size: int
) -> tuple[Float32[np.ndarray, "k d"], Int64[np.ndarray, " n"]]:
    """Palette rows that represent all rows, and the palette index of each row.

    For speed, rows are first divided into groups; each group gets a fraction of the palette proportional to its
    weighted sum of squared deviations, and its own iteration. Groups are stored one after the other.
    """
    if size >= len(rows):
        return rows, np.arange(len(rows))
    stride = -(-len(rows) // _SAMPLE)
    groups = _lloyd(rows[::stride], weights[::stride], min(_GROUPS, size), _STEPS_OF_GROUPS)
    group, away = _nearest(rows, groups)
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(len(groups) + 1))
    fractions = _cells_per_group(np.diff(edges), np.bincount(group, weights * away, len(groups)), size)
    palette, labels, done = [], np.empty(len(rows), np.int64), 0
    for first, last, fraction in zip(edges[:-1], edges[1:], fractions.tolist()):
        own = order[first:last]
        if len(own) == 0:
            continue
        centers = _lloyd(rows[own], weights[own], fraction, _STEPS)
        labels[own] = done + _nearest(rows[own], centers)[0]
        palette.append(centers)
        done += len(centers)
    return np.concatenate(palette), labels


def _cells_per_group(counts: np.ndarray, wanted: np.ndarray, size: int) -> np.ndarray:
    """Palette size per group, at most `size` in total: at least one if not empty, at most its number of rows."""
    fractions = np.minimum(counts, 1)
    for _ in range(_ROUNDS):
        open_groups = np.where(fractions < counts, wanted, 0.0)
        more = np.floor(open_groups / max(open_groups.sum(), 1e-30) * (size - fractions.sum()))
        fractions = np.minimum(counts, fractions + more.astype(np.int64))
    return fractions


def _lloyd(rows: np.ndarray, weights: np.ndarray, size: int, steps: int) -> np.ndarray:
    """Cluster centers; an empty cluster moves to the row with the largest weighted distance."""
    if size >= len(rows):
        return rows
    centers = rows[np.linspace(0, len(rows) - 1, size).astype(np.int64)]
    for _ in range(steps):
        label, distance = _nearest(rows, centers)
        order = np.argsort(label, kind="stable")
        counts = np.bincount(label, minlength=size)
        filled = counts > 0
        starts = (np.cumsum(counts) - counts)[filled]
        sums = np.add.reduceat((rows * weights[:, None])[order], starts, axis=0)
        centers = np.empty_like(centers)
        centers[filled] = sums / np.add.reduceat(weights[order], starts)[:, None]
        empty = size - np.count_nonzero(filled)
        centers[~filled] = rows[np.argsort(-weights * distance, kind="stable")[:empty]]
    return centers


def _nearest(rows: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the nearest center of each row, and the squared distance; independent of the number of threads."""
    half = 0.5 * (centers**2).sum(axis=1)
    label, distance = np.empty(len(rows), np.int64), np.empty(len(rows), np.float32)

    def assign(first: int, last: int, _: int) -> None:
        score = half - rows[first:last] @ centers.T
        label[first:last] = score.argmin(axis=1)
        squares = (rows[first:last] ** 2).sum(axis=1)
        distance[first:last] = np.maximum(0.0, squares + 2.0 * score.min(axis=1))

    with _parallel.single_threaded_blas():
        _parallel.map_chunks(assign, len(rows), -(-len(rows) // _TOGETHER))
    return label, distance
