"""Array layout of a bundle problem: images, nodes of the reduced system, and their couplings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from epipole import _parallel
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.optim import _bundle_arrays as arrays
from epipole.optim import _bundle_layout_kernels as layout_kernels
from epipole.optim.block_cholesky import BlockPattern
from epipole.optim.bundle_problem import BundleProblem

_LANES = (8, 12, 16, 20, 24)
_CHUNK_OBSERVATIONS = 3000
_MAX_SUMS_BYTES = 256 << 20
_FEW_NODES = 1000
_MAX_OBSERVATIONS_OF_A_POINT = np.iinfo(np.int16).max // 3


class BundleState(NamedTuple):
    """The quantities being adjusted."""

    rig_from_world: np.ndarray
    """(frames, 12): R row by row, t."""
    cam_from_rig: np.ndarray
    """(sensors, 12)"""
    params: np.ndarray
    points: np.ndarray


class Images(NamedTuple):
    """The (frame, sensor, camera) of each image."""

    frame: np.ndarray
    sensor: np.ndarray
    camera: np.ndarray


class Nodes(NamedTuple):
    """The node of each quantity; -1 if constant. Numbered in this order: those with most couplings first."""

    sensor: np.ndarray
    camera: np.ndarray
    """The camera's own node, or its frame's if no other image uses either: its columns then come after the frame's six."""
    point: np.ndarray
    """Nodes of points that are not eliminated."""
    frame: np.ndarray
    camera_column: np.ndarray
    """The first column of each camera in its node."""
    width: np.ndarray
    """(nodes,), columns of each node."""

    @property
    def shared_camera(self) -> np.ndarray:
        """The node of each camera that has its own node."""
        return np.where(self.camera_column == 0, self.camera, -1)


@dataclass(frozen=True, slots=True, eq=False)
class BundleLayout:
    """The constant structure of a problem."""

    images: Images
    models: np.ndarray
    """(images,), model of each image's camera."""
    observations: arrays.Observations
    unknowns: arrays.Unknowns
    entries: arrays.Entries
    nodes: Nodes
    free_params: np.ndarray
    num_free: np.ndarray
    fixed_mask: np.ndarray
    """(nodes, lanes): columns of nodes that are constant."""
    lanes: tuple[int, ...]
    wide: tuple[int, ...]
    num_chunks: int
    """Number of chunks into which the points are divided."""

    @property
    def num_nodes(self) -> int:
        """Number of nodes of the reduced system."""
        return len(self.entries.width)

    @property
    def num_border(self) -> int:
        """Number of nodes before the first frame: those with most couplings."""
        return self.num_nodes - int((self.nodes.frame >= 0).sum())

    def scene(self, state: BundleState) -> arrays.Scene:
        """A state, expanded per image."""
        frames, sensors = state.rig_from_world[self.images.frame], state.cam_from_rig[self.images.sensor]
        together = Rigid3(sensors[:, :9].reshape(-1, 3, 3), sensors[:, 9:]) @ Rigid3(
            frames[:, :9].reshape(-1, 3, 3), frames[:, 9:]
        )
        return arrays.Scene(
            motion_rows(together),
            sensors,
            self.models,
            state.params[self.images.camera],
            state.points,
        )

    def moved(self, state: BundleState, step: np.ndarray) -> BundleState:
        """The state after a step (nodes, lanes) of everything but the points, which the caller must fill."""
        frames, sensors = state.rig_from_world.copy(), state.cam_from_rig.copy()
        for rows, node in ((frames, self.nodes.frame), (sensors, self.nodes.sensor)):
            free = np.flatnonzero(node >= 0)
            if len(free):
                old = Rigid3(rows[free, :9].reshape(-1, 3, 3), rows[free, 9:])
                rows[free] = motion_rows(Rigid3.exp(step[node[free], :6]) @ old)
        params = state.params.copy()
        for rank in range(int(self.num_free.max(initial=0))):
            own = np.flatnonzero(self.num_free > rank)
            params[own, self.free_params[own, rank]] += step[
                self.nodes.camera[own], self.nodes.camera_column[own] + rank
            ]
        return BundleState(frames, sensors, params, np.empty_like(state.points))


def motion_rows(motion: Rigid3) -> np.ndarray:
    """(n, 12): rotations row by row, then translations."""
    return np.concatenate([motion.rotation.reshape(-1, 9), motion.translation], axis=1)


def initial_state(problem: BundleProblem) -> BundleState:
    """The problem's initial values."""
    return BundleState(
        motion_rows(problem.rig_from_world),
        motion_rows(problem.cam_from_rig),
        problem.camera_params.copy(),
        np.ascontiguousarray(problem.points_in_world),
    )


def lay_out(problem: BundleProblem) -> BundleLayout:
    """Find images, nodes and entries.

    Raises:
        ShapeError: a point has more than 10,922 observations.
    """
    if len(problem.points_in_world) and np.diff(problem.offsets).max() > _MAX_OBSERVATIONS_OF_A_POINT:
        raise ShapeError(f"a point has more than {_MAX_OBSERVATIONS_OF_A_POINT} observations")
    images, image = _images(problem)
    free = (problem.params_free > 0) & np.isin(np.arange(len(problem.params_free)), images.camera)[:, None]
    num_free = free.sum(axis=1).astype(np.int64)
    free_params = np.argsort(~free, axis=1, kind="stable").astype(np.int64)
    role = _roles(problem)
    nodes = _number_nodes(problem, images, num_free, role)
    unknowns = _unknowns(problem, images, nodes, num_free, free_params, role)
    lanes = _padded(int(nodes.width.max(initial=1)))
    columns = 6 + num_free[images.camera] + 6 * (nodes.sensor[images.sensor] >= 0)
    wide = _padded(int(columns.max(initial=6)))
    fixed = np.zeros((len(nodes.width), len(lanes)), bool)
    moving, rotating = nodes.frame >= 0, nodes.sensor >= 0
    fixed[nodes.frame[moving], :6] = problem.frame_free[moving] == 0
    fixed[nodes.sensor[rotating], :6] = _sensor_free(problem)[rotating] == 0
    observations = arrays.Observations(
        np.ascontiguousarray(problem.offsets),
        image,
        np.ascontiguousarray(problem.pixels),
        np.empty(len(image), bool),
        np.ones(len(role)) if problem.point_sigma_px is None else 1.0 / problem.point_sigma_px,
    )
    sums = 8 * len(images.frame) * len(wide) * (len(wide) + 1) + 8 * len(nodes.width) * len(lanes)
    # Small problems stay in one chunk: dispatching one costs as much as a few hundred observations.
    chunks = np.clip(len(image) // _CHUNK_OBSERVATIONS, 1, min(16, max(2, _MAX_SUMS_BYTES // max(sums, 1))))
    return BundleLayout(
        images=images,
        models=np.ascontiguousarray(problem.camera_model[images.camera]),
        observations=observations,
        unknowns=unknowns,
        entries=_entries(problem, image, unknowns, nodes.width),
        nodes=nodes,
        free_params=free_params,
        num_free=num_free,
        fixed_mask=fixed,
        lanes=lanes,
        wide=wide,
        num_chunks=int(chunks),
    )


def _number_nodes(problem: BundleProblem, images: Images, num_free: np.ndarray, role: np.ndarray) -> Nodes:
    num_frames = len(problem.frame_free)
    used = np.bincount(images.frame, minlength=num_frames)
    may_move = problem.frame_free.any(axis=1) & (used > 0)
    sensor_free = _sensor_free(problem)
    may_rotate = sensor_free.any(axis=1) & np.isin(np.arange(len(sensor_free)), images.sensor)
    alone = np.bincount(images.camera, minlength=len(num_free)) == 1
    joins = alone[images.camera] & (used[images.frame] == 1) & may_move[images.frame]
    joins &= num_free[images.camera] > 0
    joined = np.zeros(len(num_free), bool)
    joined[images.camera[joins]] = True
    masks = (may_rotate, (num_free > 0) & ~joined, role == arrays.KEPT, may_move)
    counts = [int(mask.sum()) for mask in masks]
    first = [0, *accumulate(counts)]
    sensor, camera, point, frame = (_numbered(mask, at) for mask, at in zip(masks, first, strict=False))
    camera[images.camera[joins]] = frame[images.frame[joins]]
    width = np.repeat([6, 0, 3, 6], counts).astype(np.int64)
    own = np.flatnonzero(num_free > 0)
    np.add.at(width, camera[own], num_free[own])
    return Nodes(sensor, camera, point, frame, np.where(joined, 6, 0), width)


def _unknowns(
    problem: BundleProblem,
    images: Images,
    nodes: Nodes,
    num_free: np.ndarray,
    free_params: np.ndarray,
    role: np.ndarray,
) -> arrays.Unknowns:
    rotation, translation = problem.cam_from_rig.rotation, problem.cam_from_rig.translation
    is_identity = (rotation == np.eye(3)).all(axis=(1, 2)) & (translation == 0).all(axis=1)
    of_sensor = nodes.sensor[images.sensor]
    return arrays.Unknowns(
        (problem.frame_free * (nodes.frame >= 0)[:, None])[images.frame],
        num_free[images.camera],
        free_params[images.camera],
        _sensor_free(problem).astype(np.float64)[images.sensor],
        ~is_identity[images.sensor] | (of_sensor >= 0),
        np.stack([nodes.frame[images.frame], nodes.shared_camera[images.camera], of_sensor], axis=1),
        role,
    )


def _sensor_free(problem: BundleProblem) -> np.ndarray:
    fixed = np.zeros((len(problem.cam_from_rig.translation), 6))
    return fixed if problem.sensor_free is None else problem.sensor_free


def reduced_pattern(layout: BundleLayout, problem: BundleProblem, *, with_points: bool) -> BlockPattern:
    """The pairs of nodes with a common image, prior or, with_points, point; sorted by row."""
    n, entries = layout.num_nodes, layout.entries
    keys = [np.arange(n) * (n + 1)]
    if with_points:
        mark, count = np.empty((2, n), np.int64)
        arguments = (entries.start, entries.node, entries.point, entries.by_node, entries.node_start, mark)
        # With few nodes there is room for all pairs; otherwise count the pairs first.
        space = n * (n + 1) // 2 if n < _FEW_NODES else 0
        column = np.empty(space, np.int64)
        total = layout_kernels.find_pattern(*arguments, count, column)
        if total and not space:
            column = np.empty(total, np.int64)
            layout_kernels.find_pattern(*arguments, count, column)
        column = column[:total]
        keys.append(np.repeat(np.arange(n), count) * n + column)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        first, second = layout.unknowns.nodes[:, a], layout.unknowns.nodes[:, b]
        both = np.asarray((first >= 0) & (second >= 0))
        keys.append(np.maximum(first, second)[both] * n + np.minimum(first, second)[both])
    for j in np.flatnonzero(layout.nodes.point >= 0):
        own = layout.nodes.point[j]
        met = entries.node[entries.start[j] : entries.start[j + 1]].astype(np.int64)
        keys.append(np.maximum(own, met) * n + np.minimum(own, met))
    if problem.priors is not None and problem.priors.distances is not None:
        distances = problem.priors.distances
        ends = layout.nodes.point[np.stack([distances.first, distances.second])]
        both = np.asarray((ends >= 0).all(axis=0))
        keys.append(ends[:, both].max(axis=0) * n + ends[:, both].min(axis=0))
    for path in () if problem.priors is None else problem.priors.paths:
        own = layout.nodes.frame[path.frames]
        first, second = np.meshgrid(own[own >= 0], own[own >= 0])
        keys.append((np.maximum(first, second) * n + np.minimum(first, second)).ravel())
    unique = np.unique(np.concatenate(keys))
    return BlockPattern(entries.width, unique // max(n, 1), unique % max(n, 1))


def _images(problem: BundleProblem) -> tuple[Images, np.ndarray]:
    """The images, sorted by frame, and the image of each observation."""
    frame, sensor, camera = problem.frame, problem.sensor, problem.camera
    num_sensors, num_cameras = len(problem.cam_from_rig.translation), max(len(problem.camera_params), 1)
    key = (frame.astype(np.int64) * num_sensors + sensor) * num_cameras + camera
    span = len(problem.frame_free) * num_sensors * num_cameras
    if span <= max(10 * len(key), 1 << 20):  # a table rather than a sort of all observations
        present = np.zeros(span, bool)
        present[key] = True
        unique = np.flatnonzero(present)
        rank = np.zeros(span, np.int32)
        rank[unique] = np.arange(len(unique))
        image = rank[key]
    else:
        unique, inverse = np.unique(key, return_inverse=True)
        image = inverse.astype(np.int32)
    rest, by_camera = np.divmod(unique, num_cameras)
    by_frame, by_sensor = np.divmod(rest, num_sensors)
    return Images(by_frame, by_sensor, by_camera), image


def _roles(problem: BundleProblem) -> np.ndarray:
    """Free points are eliminated, unless a prior concerns them: a distance couples two, a position adds terms to one."""
    role = np.where(problem.point_free > 0, arrays.ELIMINATED, arrays.FIXED).astype(np.int8)
    if problem.priors is None:
        return role
    concerned = [np.zeros(0, np.int64)]
    if problem.priors.distances is not None:
        concerned += [problem.priors.distances.first, problem.priors.distances.second]
    if problem.priors.points is not None:
        concerned.append(problem.priors.points.point)
    rows = np.concatenate(concerned)
    role[rows[problem.point_free[rows] > 0]] = arrays.KEPT
    return role


def _numbered(mask: np.ndarray, first: int) -> np.ndarray:
    return np.where(mask, first + np.cumsum(mask) - 1, -1).astype(np.int64)


def _padded(width: int) -> tuple[int, ...]:
    return (0,) * next(size for size in _LANES if size >= width)


def _entries(
    problem: BundleProblem, image: np.ndarray, unknowns: arrays.Unknowns, width: np.ndarray
) -> arrays.Entries:
    num_points, num_nodes = len(unknowns.role), len(width)
    start = np.zeros(num_points + 1, np.int64)
    slot = np.empty((len(image), 3), np.int16)

    def find(node: np.ndarray) -> None:
        _parallel.map_chunks(
            lambda a, b, _: layout_kernels.find_entries(
                problem.offsets, image, unknowns.nodes, unknowns.role, a, b, start, node, slot
            ),
            num_points,
        )

    find(np.empty(0, np.int32))
    np.cumsum(start, out=start)
    node = np.empty(start[-1], np.int32)
    if len(node):
        find(node)
    else:
        slot[:] = -1
    node_start = np.zeros(num_nodes + 1, np.int64)
    np.cumsum(np.bincount(node, minlength=num_nodes), out=node_start[1:])
    point, by_node = np.empty(len(node), np.int32), np.empty(len(node), np.int64)
    layout_kernels.sort_by_node(start, node, point, by_node, node_start, np.empty(num_nodes, np.int64))
    return arrays.Entries(start, node, slot, point, by_node, node_start, width)
