"""PatchMatch with slanted windows, measured against semi-global matching on the scenes of `benchmarks.surfaces`.

Red-black propagation and random refinement of planes (Galliani, Lasinger and Schindler, ICCV 2015), from coarse to fine, with a
bilaterally weighted correlation (Schoenberger et al., ECCV 2016) of the two best sources.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.surface_depth import RIGHT, WRONG
from benchmarks.tasks.surface_scenes import PLANS
from benchmarks.tasks.surfaces import NUM_SOURCES, SurfaceScene, prepare_scene, sources_of
from epipole import _parallel
from epipole._jit import kernel
from epipole.dense.depth import view_depth
from epipole.dense.view import DenseView, intrinsics_of
from epipole.scene.view_depth import DepthReason

REACH = 5
"""Largest distance of a sample of the window from its center, in rows and columns (pixels)."""
STEP = 2
"""Distance between samples of the window, in pixels."""
TAPS = 36
"""Samples of the window."""
COLOR_SIGMA = 12.0
"""Standard deviation of the window's weights, in gray levels; as in `dense/_edge_kernels.py`."""
SPACE_SIGMA = 5.0
"""Standard deviation of the window's weights, in pixels."""
LEAST_VARIANCE = 4.0
"""Smallest variance of a window, in squared gray levels."""
HIDDEN = 2.0
"""Cost of a source that does not show the window."""
NEIGHBORS = np.array([(-1, 0), (1, 0), (0, -1), (0, 1), (-5, 0), (5, 0), (0, -5), (0, 5)], np.int64)
"""Rows and columns; odd distances, so that all are of the other color."""
SCALES = (4, 2, 1)
"""Side of a pixel at each level."""
ROUNDS = (4, 3, 2)
"""Iterations at each level."""
REFINED = 3
"""Random changes of a plane in each iteration."""
THRESHOLDS = np.linspace(0.05, 1.5, 30)
"""Largest costs that are tried."""
MOST_WRONG = 0.02
"""Largest fraction of wrong pixels, as asked of `view_depth`."""
VIEWS = 2
"""Views of each scene that are judged."""


@kernel
def hash_of(a, b, c, d):
    """A number in [0, 1) of four integers, the same in every run."""
    x = (a * 73856093) ^ (b * 19349663) ^ (c * 83492791) ^ (d * 49979687)
    for _ in range(2):
        x = (x ^ (x >> 15)) * 2246822519 & 0xFFFFFFFF
        x = (x ^ (x >> 13)) * 3266489917 & 0xFFFFFFFF
    return (x & 0xFFFFFF) / 16777216.0


@kernel
def window_of(gray, u, v, weights, values):
    """Bilateral weights (sum 1) and centered values of the window of a pixel; returns the weighted variance."""
    height, width = gray.shape
    center, total, mean, square, n = gray[v, u], 0.0, 0.0, 0.0, 0
    for i in range(-REACH, REACH + 1, STEP):
        for j in range(-REACH, REACH + 1, STEP):
            value = gray[min(max(v + i, 0), height - 1), min(max(u + j, 0), width - 1)]
            color = (value - center) / COLOR_SIGMA
            w = np.exp(-0.5 * (color * color + (i * i + j * j) / (SPACE_SIGMA * SPACE_SIGMA)))
            weights[n], values[n] = w, value
            total, mean, square = total + w, mean + w * value, square + w * value * value
            n += 1
    mean /= total
    for n in range(TAPS):
        weights[n], values[n] = weights[n] / total, values[n] - mean
    return square / total - mean * mean


@kernel
def cost_in_source(image, A, b, u, v, plane, weights, values, variance):
    """One minus the weighted correlation; the pixel (x, y) of inverse depth q is at A (x, y, 1) + b q in the source."""
    height, width = image.shape
    q, qu, qv = plane
    sx, sy, sz = (
        A[0, 0] * u + A[0, 1] * v + A[0, 2] + b[0] * q,
        A[1, 0] * u + A[1, 1] * v + A[1, 2] + b[1] * q,
        A[2, 0] * u + A[2, 1] * v + A[2, 2] + b[2] * q,
    )
    ux, uy, uz = A[0, 0] + b[0] * qu, A[1, 0] + b[1] * qu, A[2, 0] + b[2] * qu
    vx, vy, vz = A[0, 1] + b[0] * qv, A[1, 1] + b[1] * qv, A[2, 1] + b[2] * qv
    mean, square, cross, n = 0.0, 0.0, 0.0, 0
    for i in range(-REACH, REACH + 1, STEP):
        for j in range(-REACH, REACH + 1, STEP):
            z = sz + j * uz + i * vz
            if not z > 0.0:
                return HIDDEN
            x, y = (sx + j * ux + i * vx) / z, (sy + j * uy + i * vy) / z
            if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
                return HIDDEN
            c, a = int(x), int(y)
            s, p = x - c, y - a
            top = (1.0 - s) * image[a, c] + s * image[a, c + 1]
            value = (1.0 - p) * top + p * ((1.0 - s) * image[a + 1, c] + s * image[a + 1, c + 1])
            w = weights[n]
            mean, square, cross = mean + w * value, square + w * value * value, cross + w * value * values[n]
            n += 1
    spread = square - mean * mean
    return 1.0 if spread < 0.25 * LEAST_VARIANCE else 1.0 - cross / np.sqrt(spread * variance)


@kernel
def cost_of(images, As, bs, u, v, plane, weights, values, variance):
    """Mean of the two smallest costs of the sources."""
    one = two = HIDDEN
    for s in range(len(images)):
        c = cost_in_source(images[s], As[s], bs[s], u, v, plane, weights, values, variance)
        if c < one:
            one, two = c, one
        elif c < two:
            two = c
    return 0.5 * (one + two)


@kernel
def random_plane(q, k, u, v, seed, size, normal):
    """The plane of inverse depth q at a pixel, its normal moved at random by `size` (in units of its length)."""
    x, y = (u - k[2]) / k[0], (v - k[3]) / k[1]
    nx = normal[0] + size * (2.0 * hash_of(u, v, seed, 1) - 1.0)
    ny = normal[1] + size * (2.0 * hash_of(u, v, seed, 2) - 1.0)
    nz = normal[2]
    along = nx * x + ny * y + nz
    if along < 0.15 * np.sqrt(nx * nx + ny * ny + nz * nz):  # nearly along the ray
        return q, 0.0, 0.0
    return q, q * nx / (k[0] * along), q * ny / (k[1] * along)


@kernel
def changed_plane(q, qu, qv, k, u, v, reach, round_, change):
    """A random change of a plane: of its inverse depth (change 0), of its normal (1) or of both (2), smaller in later rounds."""
    size, seed = 0.5 ** (round_ + change), 100 * round_ + change + 8
    tq = q
    if change != 1:
        tq = q + 0.1 * size * reach * (2.0 * hash_of(u, v, seed, 0) - 1.0)
    if change == 0 or not tq > 0.0:
        return tq, qu * tq / q, qv * tq / q
    nx, ny, nz = qu * k[0], qv * k[1], q - qu * (u - k[2]) - qv * (v - k[3])
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return random_plane(tq, k, u, v, seed, size, (nx / length, ny / length, nz / length))


@kernel
def start_rows(gray, images, As, bs, k, depths, memory, start, stop, planes, costs):
    """Random planes and their costs."""
    weights, values = memory
    near, far = 1.0 / depths[0], 1.0 / depths[1]
    for v in range(start, stop):
        for u in range(gray.shape[1]):
            variance = window_of(gray, u, v, weights, values)
            if planes[v, u, 0] == 0.0:
                q = far + (near - far) * hash_of(u, v, 7, 0)
                plane = random_plane(q, k, u, v, 7, 1.0, (0.0, 0.0, 1.0))
                planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = plane
            plane = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            costs[v, u] = HIDDEN
            if variance >= LEAST_VARIANCE:
                costs[v, u] = cost_of(images, As, bs, u, v, plane, weights, values, variance)


@kernel
def update_rows(gray, images, As, bs, k, depths, memory, round_, color, start, stop, planes, costs):
    """Planes of the neighbors, and random changes, for the pixels of one color."""
    weights, values = memory
    near, far = 1.0 / depths[0], 1.0 / depths[1]
    height, width = gray.shape
    for v in range(start, stop):
        for u in range((v + color) % 2, width, 2):
            variance = window_of(gray, u, v, weights, values)
            if variance < LEAST_VARIANCE:
                continue
            best, q, qu, qv = costs[v, u], planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            for n in range(len(NEIGHBORS) + REFINED):
                if n < len(NEIGHBORS):
                    i, j = NEIGHBORS[n, 0], NEIGHBORS[n, 1]
                    y, x = v + i, u + j
                    if y < 0 or x < 0 or y >= height or x >= width:
                        continue
                    tu, tv = planes[y, x, 1], planes[y, x, 2]
                    tq = planes[y, x, 0] - tu * j - tv * i
                else:
                    change = n - len(NEIGHBORS)
                    tq, tu, tv = changed_plane(q, qu, qv, k, u, v, near - far, round_, change)
                if not (tq >= far and tq <= near):
                    continue
                cost = cost_of(images, As, bs, u, v, (tq, tu, tv), weights, values, variance)
                if cost < best:
                    best, q, qu, qv = cost, tq, tu, tv
            costs[v, u], planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = best, q, qu, qv


def patch_match(
    view: DenseView, sources: Sequence[DenseView], depths: tuple[float, float], finest: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) depth and cost of each pixel, by planes at the pixel sizes of SCALES down to `finest`."""
    planes = np.zeros((0, 0, 3))
    for side, rounds in zip(SCALES, ROUNDS):
        if side >= finest:
            planes, costs = _level(view, sources, depths, side, rounds, planes)
    size = view.camera.width, view.camera.height
    depth, cost = (
        np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_NEAREST))
        for one in (1.0 / planes[..., 0], costs)
    )
    return depth, cost


def _level(
    view: DenseView,
    sources: Sequence[DenseView],
    depths: tuple[float, float],
    side: int,
    rounds: int,
    coarser: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) planes and (h, w) costs of pixels of a side, from the coarser planes, or from random ones where there are none."""
    gray, *images = (_gray(one, side) for one in (view, *sources))
    k = _intrinsics(view, side)
    inverse = np.linalg.inv(_matrix(k))
    relative = [one.cam_from_world @ view.cam_from_world.inverse() for one in sources]
    Ks = [_matrix(_intrinsics(one, side)) for one in sources]
    As = np.array([K @ one.rotation @ inverse for K, one in zip(Ks, relative)])
    bs = np.array([K @ one.translation for K, one in zip(Ks, relative)])
    planes = _finer(coarser, gray.shape) if coarser.size else np.zeros((*gray.shape, 3))
    costs = np.empty(gray.shape)
    given = gray, np.stack(images), As, bs, k, np.array(depths)
    _parallel.map_chunks(lambda a, b, _: start_rows(*given, _memory(), a, b, planes, costs), len(gray))
    for n in range(rounds):
        for color in (0, 1):
            update = partial(_update, given, n, color, planes, costs)
            _parallel.map_chunks(update, len(gray))
    return planes, costs


def _update(
    given: tuple[Any, ...], n: int, color: int, planes: np.ndarray, costs: np.ndarray, *rows: int
) -> None:
    update_rows(*given, _memory(), n, color, rows[0], rows[1], planes, costs)


def _memory() -> tuple[np.ndarray, np.ndarray]:
    return np.empty(TAPS), np.empty(TAPS)


def _gray(view: DenseView, side: int) -> np.ndarray:
    gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    size = view.camera.width // side, view.camera.height // side
    return gray if side == 1 else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


def _intrinsics(view: DenseView, side: int) -> np.ndarray:
    fx, fy, cx, cy = intrinsics_of(view.camera)
    return np.array([fx / side, fy / side, (cx + 0.5) / side - 0.5, (cy + 0.5) / side - 0.5])


def _matrix(k: np.ndarray) -> np.ndarray:
    return np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]])


def _finer(planes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The planes of the coarser level at the centers of pixels half as large."""
    v, u = (np.minimum(np.arange(n) // 2, m - 1) for n, m in zip(shape, planes.shape))
    finer = planes[np.ix_(v, u)]
    dv, du = ((np.arange(n) + 0.5) / 2 - 0.5 - at for n, at in zip(shape, (v, u)))
    finer[..., 0] += finer[..., 1] * du + finer[..., 2] * dv[:, None]
    finer[..., 1:] /= 2
    return finer


def patch_match_part(work: Path, _data: Path) -> dict[str, dict[str, float]]:
    """PatchMatch at full and half resolution, beside `view_depth`: some views of each scene."""
    return {
        f"{name}, {method}": row
        for name in PLANS
        for method, row in _compared(prepare_scene(name, work)).items()
    }


def _compared(scene: SurfaceScene) -> dict[str, dict[str, float]]:
    sources, ranges = sources_of(scene, NUM_SOURCES)
    rows = np.linspace(0, len(scene.names) - 1, VIEWS).astype(int)
    pixels = scene.camera.width * scene.camera.height
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    times: dict[str, list[float]] = {}
    first = rows[0]
    view_depth(scene.view(first), [scene.view(j) for j in sources[first]], ranges[first])  # compiles
    patch_match(scene.view(first), [scene.view(j) for j in sources[first]], ranges[first], SCALES[0])
    for k in rows:
        given = scene.view(k), [scene.view(j) for j in sources[k]], ranges[k]
        for method in ("semi-global", "PatchMatch", "PatchMatch, half size"):
            started = time.perf_counter()
            if method == "semi-global":
                depth = view_depth(*given)
                pair = depth.depth, np.where(depth.reason == DepthReason.OK, 0.0, np.inf)
            else:
                pair = patch_match(*given, finest=2 if "half" in method else 1)
            times.setdefault(method, []).append((time.perf_counter() - started) / pixels * 1e6)
            found.setdefault(method, []).append(pair)
    visible = [scene.num_seeing(k, sources[k]) >= 1 for k in rows]
    truth = [scene.depth(k) for k in rows]
    return {
        method: _figures(pairs, truth, visible) | {"us per pixel": float(np.median(times[method]))}
        for method, pairs in found.items()
    }


def _figures(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], truth: Sequence[np.ndarray], visible: Sequence[np.ndarray]
) -> dict[str, float]:
    """Right and wrong pixels at the threshold of the cost that keeps most right ones with at most 2 % wrong, or else fewest wrong."""
    depth, cost = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
    exact, seen = np.concatenate([t.ravel() for t in truth]), np.concatenate([v.ravel() for v in visible])
    with np.errstate(invalid="ignore"):
        error = np.abs(depth / exact - 1.0)
        right, wrong = seen & (error <= RIGHT), ~(error <= WRONG)
    figures = []
    for most in THRESHOLDS:
        kept = cost <= most
        figures.append(((right & kept).sum() / seen.sum(), (wrong & kept).sum() / max(kept.sum(), 1), most))
    allowed = [row for row in figures if row[1] <= MOST_WRONG]
    best = max(allowed) if allowed else min(figures, key=lambda row: row[1])
    return {"right": float(best[0]), "wrong": float(best[1]), "largest cost": float(best[2])}
