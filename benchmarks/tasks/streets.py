"""Streets of a town as a view graph with tracks, without pixels: input of mapping at any size, with the true poses.

A camera drives along every street of a grid and looks left and right in turn. A point of a facade is detected within a range
of distances, as SIFT detects a structure within a range of sizes. Pairs are the nearest images that share enough points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3, essential_from_cam2_from_cam1, fundamental_from_essential
from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph

BLOCK_M, HALF_STREET_M, STEP_M = 60.0, 8.0, 1.0
POINTS_PER_M = 120.0
"""Points per meter of a facade."""
WIDTH, HEIGHT, FOCAL_PX = 1280, 960, 763.0
LOOK_RAD = np.deg2rad(15.0)
TURN_M = 12
"""Length over which the camera rotates at a corner."""
NEAREST_M, LARGEST_RATIO = 3.0, 2.5
"""Smallest distance of a detection, and largest ratio of the distances at which a point is detected."""
DETECTED, MATCHED, FALSE, LINE_PX = 0.8, 0.7, 0.01, 2.0
"""Probabilities of a detection in sight and of a match; fraction of false matches, and how near to the epipolar line they are."""
NOISE_PX, ROTATION_NOISE_DEG, DIRECTION_NOISE_DEG = 0.5, 0.1, 1.0
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, [FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])
NEIGHBORS, LEAST_MATCHES, MOST_ANGLE_DEG = 20, 30, 50.0


@dataclass(frozen=True, slots=True, eq=False)
class StreetTask:
    """Input of mapping, and the truth."""

    cameras: Cameras
    keypoints: tuple[np.ndarray, ...]
    view_graph: ViewGraph
    cams_from_world: Rigid3

    @property
    def num_images(self) -> int:
        """Number of images."""
        return len(self.keypoints)


def street_task(num_images: int, seed: int = 0) -> StreetTask:
    """A drive of `num_images` images, one each meter."""
    rng = np.random.default_rng(seed)
    streets = 2
    while len(_route(streets)) < num_images:
        streets += 1
    centers, headings = np.split(_route(streets)[:num_images], [3], axis=1)
    cams = _look(centers, headings[:, 0] + LOOK_RAD * np.where(np.arange(num_images) % 2, 1.0, -1.0))
    points = _facades(streets, rng)
    pixels, seen = _detections(cams, points, rng)
    return StreetTask(
        Cameras.from_list([CAMERA], [True], [True]),
        pixels,
        _view_graph(cams, points, pixels, seen, rng),
        cams,
    )


def _route(streets: int) -> np.ndarray:
    """(n, 4) position and heading along all streets in one direction, then in the other."""
    end = BLOCK_M * (streets - 1)
    corners = []
    for k in range(streets):
        ends = [(0.0, k * BLOCK_M), (end, k * BLOCK_M)]
        corners += ends if k % 2 == 0 else ends[::-1]
    last_x = corners[-1][0]
    columns = range(streets) if last_x == 0.0 else range(streets - 1, -1, -1)
    for n, k in enumerate(columns):
        ends = [(k * BLOCK_M, end), (k * BLOCK_M, 0.0)]
        corners += ends if n % 2 == 0 else ends[::-1]
    out = []
    for (x0, y0), (x1, y1) in pairwise(corners):
        length = np.hypot(x1 - x0, y1 - y0)
        if length == 0.0:
            continue
        steps = np.arange(0.0, length, STEP_M) / length
        heading = np.full(len(steps), np.arctan2(y1 - y0, x1 - x0))
        flat = np.zeros(len(steps))
        out.append(np.stack([x0 + steps * (x1 - x0), y0 + steps * (y1 - y0), flat, heading], axis=1))
    route = np.concatenate(out)
    window = np.ones(TURN_M) / TURN_M
    ahead = np.exp(1j * np.pad(route[:, 3], (TURN_M // 2, TURN_M - 1 - TURN_M // 2), mode="edge"))
    route[:, 3] = np.angle(np.convolve(ahead, window, mode="valid"))
    route[:, 2] = 1.6 + 0.05 * np.sin(0.3 * np.arange(len(route)))
    return route


def _look(centers: np.ndarray, yaw: np.ndarray) -> Rigid3:
    """Level cameras that look in these directions; z of the world is up."""
    forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros(len(yaw))], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(yaw), 1))
    rotation = np.stack([right, down, forward], axis=1)
    return Rigid3(rotation, -np.einsum("nab,nb->na", rotation, centers))


def _facades(streets: int, rng: np.random.Generator) -> np.ndarray:
    """Points of both facades of all streets, which have gaps at crossings, and none around the town."""
    end = BLOCK_M * (streets - 1)
    out = []
    for axis in (0, 1):
        count = int(streets * 2 * (end + 2 * HALF_STREET_M) * POINTS_PER_M)
        street = rng.integers(0, streets, count) * BLOCK_M
        along = rng.uniform(-HALF_STREET_M, end + HALF_STREET_M, count)
        across = street + rng.choice([-1.0, 1.0], count) * (HALF_STREET_M + rng.uniform(-0.5, 0.5, count))
        is_border = (across < 0.0) | (across > end)
        kept = is_border | (np.abs(along - BLOCK_M * np.rint(along / BLOCK_M)) > HALF_STREET_M)
        plan = [along, across] if axis == 0 else [across, along]
        out.append(np.stack([*plan, rng.uniform(0.0, 12.0, count)], axis=1)[kept])
    return np.concatenate(out)


def _detections(
    cams: Rigid3, points: np.ndarray, rng: np.random.Generator
) -> tuple[tuple[np.ndarray, ...], list[np.ndarray]]:
    """Pixels of each image, and the points that they show, sorted."""
    nearest_m = NEAREST_M * np.exp(rng.uniform(0.0, np.log(6.0), len(points)))
    centers, street = cams.centers(), _streets_at(points)
    of_camera = _streets_at(cams.centers())
    tree = cKDTree(points[:, :2])
    pixels, seen = [], []
    for i in range(len(centers)):
        near = np.sort(np.array(tree.query_ball_point(centers[i, :2], NEAREST_M * 6 * LARGEST_RATIO), int))
        near = near[((street[near] == of_camera[i]) & (of_camera[i] >= 0)).any(axis=1)]
        at = points[near] @ cams.rotation[i].T + cams.translation[i]
        shown = (at[:, 2] > nearest_m[near]) & (at[:, 2] < LARGEST_RATIO * nearest_m[near])
        near, at = near[shown], at[shown]
        pixel = FOCAL_PX * at[:, :2] / at[:, 2:] + [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
        inside = ((pixel > 0) & (pixel < [WIDTH - 1, HEIGHT - 1])).all(axis=1)
        inside &= rng.random(len(near)) < DETECTED
        seen.append(near[inside])
        pixels.append(pixel[inside] + NOISE_PX * rng.normal(size=(int(inside.sum()), 2)))
    return tuple(pixels), seen


def _streets_at(points: np.ndarray) -> np.ndarray:
    """(n, 2) numbers of the streets in each direction that a point stands in; -1 for none."""
    number = np.rint(points[:, :2] / BLOCK_M).astype(int)
    return np.where(np.abs(points[:, :2] - BLOCK_M * number) < HALF_STREET_M + 1.0, number, -1)


def _view_graph(
    cams: Rigid3,
    points: np.ndarray,
    pixels: tuple[np.ndarray, ...],
    seen: list[np.ndarray],
    rng: np.random.Generator,
) -> ViewGraph:
    centers, forward = cams.centers(), cams.rotation[:, 2]
    _, near = cKDTree(centers).query(centers, k=min(4 * NEIGHBORS, len(centers)))
    pairs: set[tuple[int, int]] = set()
    for i in range(len(centers)):
        alike = near[i][forward[near[i]] @ forward[i] > np.cos(np.deg2rad(MOST_ANGLE_DEG))]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in alike[: NEIGHBORS + 1] if j != i}
    kept, matches, angles = [], [], []
    for i, j in sorted(pairs):
        common, in_i, in_j = np.intersect1d(seen[i], seen[j], assume_unique=True, return_indices=True)
        chosen = rng.random(len(common)) < MATCHED
        if chosen.sum() < LEAST_MATCHES:
            continue
        first, second = in_i[chosen], in_j[chosen].copy()
        for n in np.flatnonzero(rng.random(len(second)) < FALSE):
            on_line = np.flatnonzero(
                _off_line_px(cams[j] @ cams[i].inverse(), pixels[i][first[n]], pixels[j]) < LINE_PX
            )
            second[n] = rng.choice(on_line) if len(on_line) else second[n]
        ray1, ray2 = (_directions(points[common[chosen]] - centers[k]) for k in (i, j))
        angles.append(np.median(np.arccos(np.clip(np.einsum("nd,nd->n", ray1, ray2), -1.0, 1.0))))
        kept.append((i, j))
        matches.append(np.stack([first, second], axis=1).astype(np.int32))
    first, second = np.array(kept, np.int32).T.copy()
    flat = np.concatenate(matches)
    counts = np.array([len(m) for m in matches])
    motions = _noisy(cams[second] @ cams[first].inverse(), rng)
    essential = essential_from_cam2_from_cam1(motions)
    K = CAMERA.K
    return ViewGraph(
        first,
        second,
        np.full(len(kept), PairKind.GENERAL, np.int32),
        counts.astype(np.int32),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        flat[:, 0].copy(),
        flat[:, 1].copy(),
        motions,
        essential,
        np.array([fundamental_from_essential(E, K, K) for E in essential]),
        np.full((len(kept), 3, 3), np.nan),
        np.array(angles),
    )


def _off_line_px(motion: Rigid3, pixel: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances of pixels (n, 2) of the second image from the epipolar line of a pixel of the first."""
    F = fundamental_from_essential(essential_from_cam2_from_cam1(motion), CAMERA.K, CAMERA.K)
    line = F @ [*pixel, 1.0]
    return np.abs(others @ line[:2] + line[2]) / np.hypot(line[0], line[1])


def _directions(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _noisy(motions: Rigid3, rng: np.random.Generator) -> Rigid3:
    """Motions with a translation of length 1, and the noise of estimates from matches."""
    turns = Rotation3.exp(np.deg2rad(ROTATION_NOISE_DEG) * rng.normal(size=(len(motions), 3)))
    direction = _directions(motions.translation)
    noise = np.tan(np.deg2rad(DIRECTION_NOISE_DEG)) * rng.normal(size=direction.shape)
    return Rigid3((turns @ Rotation3(motions.rotation)).matrix, _directions(direction + noise))
