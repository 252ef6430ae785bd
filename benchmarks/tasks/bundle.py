"""Bundle adjustment problems as plain arrays: those of Agarwal et al. (BAL), and synthetic ones of any size.

Cameras have x_cam = R X + t and look along +z with y down; intrinsics are f, cx, cy, k1, k2 of COLMAP's RADIAL model.
"""

from __future__ import annotations

import bz2
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

LossName = Literal["trivial", "huber"]
BAL_FILES = ("problem-16-22106-pre.txt.bz2", "problem-21-11315-pre.txt.bz2")
_CHUNK_OBSERVATIONS = 1 << 19


@dataclass(frozen=True, slots=True, eq=False)
class BundleTask:
    """Initial values and observations. Focal lengths and distortion are free; principal points are fixed."""

    name: str
    rotation: np.ndarray
    """(f, 3, 3)."""
    translation: np.ndarray
    """(f, 3)."""
    camera_of_frame: np.ndarray
    """(f,) int32."""
    params: np.ndarray
    """(c, 5): f, cx, cy, k1, k2."""
    num_distortion: int
    """1: k1 is free and k2 is 0 (SIMPLE_RADIAL); 2: both are free (RADIAL)."""
    points: np.ndarray
    """(p, 3)."""
    frame: np.ndarray
    """(k,) int32, frame of each observation."""
    point: np.ndarray
    """(k,) int32, point of each observation, ascending."""
    pixels: np.ndarray
    """(k, 2)."""
    noise_px: float | None = None
    """Standard deviation of each pixel coordinate, if known."""
    noise_floor: float | None = None
    """`true_noise_floor` of a synthetic task."""


def true_noise_floor(task: BundleTask) -> float | None:
    """Expected minimum of the cost: sigma^2 / 2 per degree of freedom; None if sigma is unknown."""
    if task.noise_px is None:
        return None
    unknowns = 6 * len(task.rotation) + 3 * len(task.points) + (1 + task.num_distortion) * len(task.params)
    return 0.5 * task.noise_px**2 * (2 * len(task.frame) - unknowns + 7)


def project(params: np.ndarray, x_cam: np.ndarray) -> np.ndarray:
    """Pixels of points in camera coordinates, f (1 + k1 r^2 + k2 r^4) (x / z, y / z) + c; row k of `params` is for point k."""
    plane = x_cam[:, :2] / x_cam[:, 2:]
    r2 = np.einsum("ij,ij->i", plane, plane)
    scale = params[:, 0] * (1.0 + r2 * (params[:, 3] + r2 * params[:, 4]))
    return scale[:, None] * plane + params[:, 1:3]


def cost(
    task: BundleTask,
    rotation: np.ndarray,
    translation: np.ndarray,
    params: np.ndarray,
    points: np.ndarray,
    *,
    loss: LossName = "trivial",
    loss_scale_px: float = 1.0,
) -> float:
    """Half the sum of rho(s) over the squared errors s of all observations.

    Huber's rho(s) is s up to scale^2, and 2 scale sqrt(s) - scale^2 above (as in Ceres). Points behind a camera are projected
    by the same formula, as in the BAL paper.
    """
    total = 0.0
    for start in range(0, len(task.frame), _CHUNK_OBSERVATIONS):
        rows = slice(start, start + _CHUNK_OBSERVATIONS)
        f, j = task.frame[rows], task.point[rows]
        x_cam = np.einsum("kij,kj->ki", rotation[f], points[j]) + translation[f]
        error = project(params[task.camera_of_frame[f]], x_cam) - task.pixels[rows]
        squared = np.einsum("ki,ki->k", error, error)
        if loss == "huber":
            beyond = squared > loss_scale_px**2
            squared[beyond] = 2.0 * loss_scale_px * np.sqrt(squared[beyond]) - loss_scale_px**2
        total += float(squared.sum())
    return 0.5 * total


def bal_task(path: Path | str) -> BundleTask:
    """A problem of "Bundle Adjustment in the Large" (Agarwal et al., ECCV 2010), .txt or .txt.bz2.

    Each image has its own f, k1, k2. BAL's cameras look along -z with y up; the conversion is exact.
    """
    path = Path(path)
    text = bz2.decompress(path.read_bytes()) if path.suffix == ".bz2" else path.read_bytes()
    values = np.array(text.split(), np.float64)
    num_frames, num_points, num_observations = values[:3].astype(int)
    rows = values[3 : 3 + 4 * num_observations].reshape(-1, 4)
    rest = values[3 + 4 * num_observations :]
    cameras, points = rest[: 9 * num_frames].reshape(-1, 9), rest[9 * num_frames :].reshape(-1, 3)
    if len(points) != num_points:
        raise ValueError(f"{path.name} has {len(points)} points, but its header says {num_points}.")
    rows = rows[np.argsort(rows[:, 1], kind="stable")]
    flip = np.array([1.0, -1.0, -1.0])  # half a rotation about x
    params = np.zeros((num_frames, 5))
    params[:, [0, 3, 4]] = cameras[:, 6:]
    return BundleTask(
        name=path.name.removesuffix(".bz2").removesuffix(".txt"),
        rotation=flip[:, None] * Rotation.from_rotvec(cameras[:, :3]).as_matrix(),
        translation=cameras[:, 3:6] * flip,
        camera_of_frame=np.arange(num_frames, dtype=np.int32),
        params=params,
        num_distortion=2,
        points=points.copy(),
        frame=rows[:, 0].astype(np.int32),
        point=rows[:, 1].astype(np.int32),
        pixels=rows[:, 2:] * [1.0, -1.0],
    )


def ring_task(
    num_frames: int, num_points: int, track_length: int = 6, noise_px: float = 0.7, seed: int = 0
) -> BundleTask:
    """Cameras on a circle around a ball of points; `track_length` consecutive cameras observe each point."""
    if not 2 <= track_length <= num_frames:
        raise ValueError(
            f"track_length must be from 2 to {num_frames} (the number of frames), not {track_length}."
        )
    random = np.random.default_rng(seed)
    angle = np.arange(num_frames) / num_frames * 2.0 * np.pi
    centers = 10.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(num_frames)], axis=1)
    rotation = _looking_along(-centers)
    translation = -np.einsum("fij,fj->fi", rotation, centers)
    points = random.normal(size=(num_points, 3))
    radius = random.uniform(0, 1, num_points) ** (1 / 3) * 3.0
    points *= (radius / np.linalg.norm(points, axis=1))[:, None]
    first = random.integers(0, num_frames, num_points)
    frame = ((first[:, None] + np.arange(track_length)) % num_frames).ravel().astype(np.int32)
    point = np.repeat(np.arange(num_points, dtype=np.int32), track_length)
    params = np.array([[1000.0, 640.0, 480.0, -0.05, 0.0]])
    x_cam = np.einsum("kij,kj->ki", rotation[frame], points[point]) + translation[frame]
    pixels = project(params, x_cam) + random.normal(size=(len(frame), 2)) * noise_px
    error = random.normal(size=(num_frames, 6)) * 0.01
    rotation_error = Rotation.from_rotvec(error[:, 3:]).as_matrix()
    return _synthetic(
        name=f"ring-{num_frames}-{num_points}",
        rotation=rotation_error @ rotation,
        translation=np.einsum("fij,fj->fi", rotation_error, translation) + error[:, :3],
        params=np.array([[1020.0, 640.0, 480.0, 0.0, 0.0]]),
        points=points + random.normal(size=points.shape) * 0.03,
        frame=frame,
        point=point,
        pixels=pixels,
        noise_px=noise_px,
    )


def _synthetic(
    name: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    params: np.ndarray,
    points: np.ndarray,
    frame: np.ndarray,
    point: np.ndarray,
    pixels: np.ndarray,
    noise_px: float,
) -> BundleTask:
    """A task of one SIMPLE_RADIAL camera with known noise."""
    camera = np.zeros(len(rotation), np.int32)
    task = BundleTask(
        name, rotation, translation, camera, params, 1, points, frame, point, pixels, noise_px=noise_px
    )
    return replace(task, noise_floor=true_noise_floor(task))


def _looking_along(direction: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of upright cameras that look along these directions; the world's z is up."""
    z = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


_SPACING_M = 0.5
"""Distance between images along a street."""
_YAWS_DEG = (60.0, 0.0, -60.0, 0.0)
"""Yaw of consecutive images, to the left of the driving direction; forward images connect both sides of the street."""
_PITCH_DEG = 10.0
_MIN_BLOCK_M = 40.0
_HALF_STREET_M, _CAMERA_HEIGHT_M, _ROOF_M, _BAY_DEPTH_M = 8.0, 2.0, 14.0, 0.6
_BEYOND_M = 30.0
"""Length of the facades beyond the last crossing."""
_MAX_DISTANCE_M = 40.0
"""Largest distance from a camera to a point that it observes."""
_VIEW_CENTER_M = 10.0
"""Distance from a camera to the center of its view."""
_CITY_SIZE = (1600.0, 1200.0)
_CITY_PARAMS = (900.0, 800.0, 600.0, -0.05, 0.0)
_CANDIDATES = 24
"""Number of frames near a point that may observe it."""
_TRIES_PER_FRAME = 20
"""After this number of unsuccessful rays, a point gets another frame."""
_CHUNK_POINTS = 100_000


class _Drive(NamedTuple):
    """True cameras of a city; 2D vectors are in the ground plane."""

    rotation: np.ndarray
    center: np.ndarray
    along: np.ndarray
    """(f, 2), driving direction."""
    view_center: np.ndarray
    """(f, 2), position in the middle of the view."""
    crossings: np.ndarray
    """Positions of the crossings along a street; the same for all streets."""


class _Facades(NamedTuple):
    """Points on facades."""

    points: np.ndarray
    inward: np.ndarray
    """(n, 2), direction into the building."""
    frame: np.ndarray
    """(n,), a frame that observes the point."""

    def pick(self, chosen: np.ndarray) -> _Facades:
        return _Facades(*(rows[chosen] for rows in self))


def city_task(num_frames: int, num_points: int, num_observations: int, seed: int = 0) -> BundleTask:
    """A grid of streets, driven one after the other by a car with cameras that look forward and at the facades.

    Each point has two observations or more, from images near it. The initial poses have smooth errors of about 5 cm and 0.2
    degrees without drift; those of the points are 10 cm.

    Raises:
        ValueError: there are fewer than two observations per point, or more than the images can have.
    """
    if num_observations < 2 * num_points:
        raise ValueError(
            f"{num_points} points need at least {2 * num_points} observations, not {num_observations}."
        )
    random = np.random.default_rng(seed)
    drive = _drive(num_frames)
    params, noise_px = np.array([_CITY_PARAMS]), 0.5
    points = np.empty((num_points, 3))
    frame, point = np.empty(num_observations, np.int32), np.empty(num_observations, np.int32)
    pixels = np.empty((num_observations, 2))
    done = 0
    for start in range(0, num_points, _CHUNK_POINTS):
        stop = min(start + _CHUNK_POINTS, num_points)
        end = num_observations * stop // num_points
        x, counts, frames = _part_of_city(drive, (start, stop, num_points), end - done, random)
        index = np.repeat(np.arange(stop - start), counts)
        pixels[done:end] = project(params, _in_camera(drive, frames, x[index]))
        pixels[done:end] += random.normal(size=(end - done, 2)) * noise_px
        frame[done:end], point[done:end] = frames, start + index
        points[start:stop] = x + random.normal(size=x.shape) * (0.1 / np.sqrt(3.0))
        done = end
    rotation, translation = _initial_poses(drive, random)
    return _synthetic(
        name=f"city-{num_frames}-{num_points}",
        rotation=rotation,
        translation=translation,
        params=params * [1.01, 1.0, 1.0, 0.0, 0.0],
        points=points,
        frame=frame,
        point=point,
        pixels=pixels,
        noise_px=noise_px,
    )


def _drive(num_frames: int) -> _Drive:
    """Alternating eastward and northward streets, so that any number of images is connected."""
    length = _SPACING_M * num_frames
    streets = max(2, round(0.5 + np.sqrt(length / 200.0)))
    block = max(length / (2 * streets * (streets - 1)), _MIN_BLOCK_M)
    street, step = np.divmod(_SPACING_M * np.arange(num_frames), block * (streets - 1))
    along = np.where(street[:, None] % 2 == 0, [1.0, 0.0], [0.0, 1.0])
    ground = along * step[:, None] + along[:, ::-1] * (street // 2 * block)[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    yaw = np.deg2rad(np.resize(_YAWS_DEG, num_frames))[:, None]
    level = np.cos(yaw) * along + np.sin(yaw) * left
    pitch = np.deg2rad(_PITCH_DEG)
    direction = np.c_[np.cos(pitch) * level, np.full(num_frames, np.sin(pitch))]
    center = np.c_[ground, np.full(num_frames, _CAMERA_HEIGHT_M)]
    view_center = ground + _VIEW_CENTER_M * level
    return _Drive(_looking_along(direction), center, along, view_center, block * np.arange(streets))


def _in_camera(drive: _Drive, frame: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kj->ki", drive.rotation[frame], points - drive.center[frame])


def _part_of_city(
    drive: _Drive, part: tuple[int, int, int], quota: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points `part` = (start, stop, total) along the drive: positions, numbers of observations, and their frames."""
    start, stop, num_points = part
    first = np.arange(start, stop) * len(drive.center) // num_points
    points, visible = np.empty((stop - start, 3)), np.zeros(stop - start, np.int64)
    frames = np.empty((stop - start, 1 + min(_CANDIDATES, len(drive.center))), np.int32)
    tries = 0
    while len(missing := np.flatnonzero(visible < 2)):
        tries += 1
        if tries % _TRIES_PER_FRAME == 0:
            first[missing] = random.choice(first, len(missing))
        rays, facades = _on_facades(drive, first[missing], random)
        rows = missing[rays]
        points[rows] = facades.points
        frames[rows], visible[rows] = _in_view(drive, facades, random)
    counts = _track_lengths(visible, quota, random)
    chosen = np.arange(frames.shape[1]) < counts[:, None]
    frames = np.sort(np.where(chosen, frames, np.iinfo(np.int32).max), axis=1)
    return points, counts, frames[chosen]


def _on_facades(drive: _Drive, frame: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, _Facades]:
    """Rows of `frame` whose rays through random pixels hit a facade of their street, and the points there."""
    half_width, half_height = 0.5 * np.array(_CITY_SIZE) / _CITY_PARAMS[0]
    ray = np.ones((len(frame), 3))
    ray[:, 0] = random.uniform(-half_width, half_width, len(frame))
    ray[:, 1] = random.uniform(-half_height, half_height, len(frame))
    ray = np.einsum("kji,kj->ki", drive.rotation[frame], ray)
    along, center = drive.along[frame], drive.center[frame]
    across = along[:, ::-1]
    toward = np.einsum("ki,ki->k", ray[:, :2], across)
    depth = _HALF_STREET_M + random.uniform(0.0, _BAY_DEPTH_M, len(frame))
    x = center + ray * (depth / np.maximum(np.abs(toward), 1e-3))[:, None]
    position = np.einsum("ki,ki->k", x[:, :2], along)
    to_crossing = np.abs(position[:, None] - drive.crossings).min(axis=1)
    good = (x[:, 2] > 0.0) & (x[:, 2] < _ROOF_M) & (to_crossing > _HALF_STREET_M)
    good &= (position > -_BEYOND_M) & (position < drive.crossings[-1] + _BEYOND_M)
    good &= np.linalg.norm(x - center, axis=1) < _MAX_DISTANCE_M
    facades = _Facades(x, across * np.sign(toward)[:, None], frame)
    return np.flatnonzero(good), facades.pick(good)


def _in_view(drive: _Drive, facades: _Facades, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Frames near each point, first those that can observe it, and the number of these."""
    x, own = facades.points, facades.frame[:, None].astype(np.int32)
    near, frames = cKDTree(drive.view_center).query(x[:, :2], min(_CANDIDATES, len(drive.center)))
    distance = np.pad(near, ((0, 0), (1, 0)))
    frames = np.concatenate([own, frames.astype(np.int32)], axis=1)
    width = frames.shape[1]
    x_cam = _in_camera(drive, frames.ravel(), np.repeat(x, width, axis=0))
    seen = np.linalg.norm(x_cam, axis=1) < _MAX_DISTANCE_M
    for axis in (0, 1):
        seen &= np.abs(x_cam[:, axis]) <= 0.5 * _CITY_SIZE[axis] / _CITY_PARAMS[0] * x_cam[:, 2] * (1 + 1e-9)
    offset = x[:, None, :2] - drive.center[frames, :2]
    visible = seen.reshape(frames.shape) & (np.einsum("kji,ki->kj", offset, facades.inward) > 1.0)
    visible[:, 1:] &= frames[:, 1:] != own
    key = np.where(visible, distance * random.uniform(0.5, 1.5, distance.shape), np.inf)
    return np.take_along_axis(frames, np.argsort(key, axis=1), axis=1), visible.sum(axis=1)


def _track_lengths(visible: np.ndarray, quota: int, random: np.random.Generator) -> np.ndarray:
    """Random numbers of observations per point, from 2 to `visible`, with the sum `quota`."""
    mean = quota / len(visible)
    counts = np.minimum(2 + random.poisson(mean - 2.0, len(visible)), visible)
    while (missing := quota - int(counts.sum())) != 0:
        movable = np.flatnonzero(counts < visible if missing > 0 else counts > 2)
        if not len(movable):
            raise ValueError(f"The city's images cannot have {mean:.1f} observations per point: use fewer.")
        chosen = random.choice(movable, min(abs(missing), len(movable)), replace=False)
        counts[chosen] += np.sign(missing)
    return counts


def _initial_poses(drive: _Drive, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations with errors of about 0.2 degrees and 5 cm."""
    position = np.arange(len(drive.center)) * _SPACING_M
    smooth = np.zeros((len(position), 6))
    for wavelength in (13.0, 29.0, 61.0):
        phase = random.uniform(0.0, 2.0 * np.pi, 6)
        smooth += np.sin(2.0 * np.pi / wavelength * position[:, None] + phase) * np.sqrt(2.0 / 9.0)
    noise = random.normal(size=(len(position), 6)) / np.sqrt(3.0)
    error_rad = np.deg2rad(0.2) * (0.9 * smooth[:, 3:] + 0.3 * noise[:, 3:])
    center = drive.center + 0.05 * smooth[:, :3] + 0.01 * noise[:, :3]
    rotation = Rotation.from_rotvec(error_rad).as_matrix() @ drive.rotation
    return rotation, -np.einsum("fij,fj->fi", rotation, center)
