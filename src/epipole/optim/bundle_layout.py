"""How a bundle problem becomes arrays: images, the nodes of the reduced system, and who meets whom."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from epipole import _parallel
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.optim import _bundle_kernels as kernels
from epipole.optim import _bundle_layout_kernels as layout_kernels
from epipole.optim.block_cholesky import BlockPattern
from epipole.optim.bundle_problem import BundleProblem

_LANES = (8, 12, 16, 20)
_CHUNK_OBSERVATIONS = 3000
_MAX_SUMS_BYTES = 256 << 20
_MAX_OBSERVATIONS_OF_A_POINT = np.iinfo(np.int16).max // 3


class BundleState(NamedTuple):
    """What changes."""

    rig_from_world: np.ndarray
    """(frames, 12): R row by row, t"""
    cam_from_rig: np.ndarray
    """(sensors, 12)"""
    params: np.ndarray
    points: np.ndarray


class Images(NamedTuple):
    """The (frame, sensor, camera) that took each image."""

    frame: np.ndarray
    sensor: np.ndarray
    camera: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class BundleLayout:
    """Constant while a problem is solved. Nodes: sensors, shared cameras, kept points, frames, in this order."""

    images: Images
    models: np.ndarray
    """(images,), of their cameras."""
    observations: kernels.Observations
    unknowns: kernels.Unknowns
    entries: kernels.Entries
    sensor_node: np.ndarray
    camera_node: np.ndarray
    """The own node of a camera, or its frame's (its columns then come after the frame's six); -1 if it is held."""
    camera_column: np.ndarray
    point_node: np.ndarray
    frame_node: np.ndarray
    free_params: np.ndarray
    num_free: np.ndarray
    held_mask: np.ndarray
    """(nodes, lanes): columns of nodes that may not change."""
    lanes: tuple[int, ...]
    wide: tuple[int, ...]
    num_chunks: int
    """Pieces that points are handled in."""

    @property
    def num_nodes(self) -> int:
        """Nodes of the reduced system."""
        return len(self.entries.width)

    @property
    def num_border(self) -> int:
        """Nodes before the first frame: those that most others meet."""
        return self.num_nodes - int((self.frame_node >= 0).sum())

    def scene(self, state: BundleState) -> kernels.Scene:
        """A state, image by image."""
        frames, sensors = state.rig_from_world[self.images.frame], state.cam_from_rig[self.images.sensor]
        together = Rigid3(sensors[:, :9].reshape(-1, 3, 3), sensors[:, 9:]) @ Rigid3(
            frames[:, :9].reshape(-1, 3, 3), frames[:, 9:]
        )
        return kernels.Scene(
            motion_rows(together),
            sensors,
            self.models,
            state.params[self.images.camera],
            state.points,
        )

    def moved(self, state: BundleState, step: np.ndarray) -> BundleState:
        """The state after a step (nodes, lanes) of all but the points, which are left to be filled."""
        frames, sensors = state.rig_from_world.copy(), state.cam_from_rig.copy()
        for rows, node in ((frames, self.frame_node), (sensors, self.sensor_node)):
            free = np.flatnonzero(node >= 0)
            if len(free):
                old = Rigid3(rows[free, :9].reshape(-1, 3, 3), rows[free, 9:])
                rows[free] = motion_rows(Rigid3.exp(step[node[free], :6]) @ old)
        params = state.params.copy()
        for rank in range(int(self.num_free.max(initial=0))):
            own = np.flatnonzero(self.num_free > rank)
            params[own, self.free_params[own, rank]] += step[
                self.camera_node[own], self.camera_column[own] + rank
            ]
        return BundleState(frames, sensors, params, np.empty_like(state.points))


def motion_rows(motion: Rigid3) -> np.ndarray:
    """(n, 12): rotations row by row, then translations."""
    return np.concatenate([motion.rotation.reshape(-1, 9), motion.translation], axis=1)


def initial_state(problem: BundleProblem) -> BundleState:
    """The problem's own values."""
    return BundleState(
        motion_rows(problem.rig_from_world),
        motion_rows(problem.cam_from_rig),
        problem.camera_params.copy(),
        np.ascontiguousarray(problem.points_in_world),
    )


def lay_out(problem: BundleProblem) -> BundleLayout:
    """Find images, nodes and entries.

    Raises:
        ShapeError: a point has more observations than can be counted (10,922).
    """
    if len(problem.points_in_world) and np.diff(problem.offsets).max() > _MAX_OBSERVATIONS_OF_A_POINT:
        raise ShapeError(f"a point has more than {_MAX_OBSERVATIONS_OF_A_POINT} observations")
    images, image = _images(problem)
    used_camera = np.isin(np.arange(len(problem.params_free)), images.camera)
    free = (problem.params_free > 0) & used_camera[:, None]
    num_free = free.sum(axis=1).astype(np.int64)
    free_params = np.argsort(~free, axis=1, kind="stable").astype(np.int64)
    may_move = problem.frame_free.any(axis=1) & (
        np.bincount(images.frame, minlength=len(problem.frame_free)) > 0
    )
    sensor_free = (
        np.zeros((len(problem.cam_from_rig.translation), 6))
        if problem.sensor_free is None
        else problem.sensor_free
    )
    sensor_moves = sensor_free.any(axis=1) & np.isin(np.arange(len(sensor_free)), images.sensor)
    # A camera that a single image has goes with its frame, if the frame has no other image.
    alone = np.bincount(images.camera, minlength=len(num_free)) == 1
    single = np.bincount(images.frame, minlength=len(may_move)) == 1
    joins = (alone[images.camera] & single[images.frame] & may_move[images.frame]) & (
        num_free[images.camera] > 0
    )
    joined = np.zeros(len(num_free), bool)
    joined[images.camera[joins]] = True
    kept = _kept_points(problem)
    counts = (int(sensor_moves.sum()), int(((num_free > 0) & ~joined).sum()), len(kept), int(may_move.sum()))
    first = [0, *accumulate(counts)]
    sensor_node = _numbered(sensor_moves, first[0])
    camera_node = _numbered((num_free > 0) & ~joined, first[1])
    point_node = np.full(len(problem.points_in_world), -1, np.int64)
    point_node[kept] = first[2] + np.arange(len(kept))
    frame_node = _numbered(may_move, first[3])
    shared_node = camera_node.copy()
    camera_node[images.camera[joins]] = frame_node[images.frame[joins]]
    width = np.repeat([6, 0, 3, 6], counts).astype(np.int64)
    own = np.flatnonzero(num_free > 0)
    np.add.at(width, camera_node[own], num_free[own])
    lanes = _padded(int(width.max(initial=1)))
    has_sensor = sensor_node[images.sensor] >= 0
    wide = _padded(int((6 + num_free[images.camera] + 6 * has_sensor).max(initial=6)))
    rotation, translation = problem.cam_from_rig.rotation, problem.cam_from_rig.translation
    is_identity = (rotation == np.eye(3)).all(axis=(1, 2)) & (translation == 0).all(axis=1)
    nodes = np.stack(
        [frame_node[images.frame], shared_node[images.camera], sensor_node[images.sensor]], axis=1
    )
    unknowns = kernels.Unknowns(
        (problem.frame_free * may_move[:, None])[images.frame],
        num_free[images.camera],
        free_params[images.camera],
        sensor_free[images.sensor].astype(np.float64),
        ~is_identity[images.sensor] | has_sensor,
        nodes,
        _roles(problem, kept),
    )
    held = np.zeros((len(width), len(lanes)), bool)
    held[frame_node[may_move], :6] = problem.frame_free[may_move] == 0
    held[sensor_node[sensor_moves], :6] = sensor_free[sensor_moves] == 0
    entries = _entries(problem, image, nodes, unknowns.role, width)
    observations = kernels.Observations(
        np.ascontiguousarray(problem.offsets),
        image,
        np.ascontiguousarray(problem.pixels),
        np.empty(len(image), bool),
    )
    sums = 8 * len(images.frame) * len(wide) * (len(wide) + 1) + 8 * len(width) * len(lanes)
    # Small problems stay in one piece: handing out a chunk costs as much as a few hundred observations.
    chunks = np.clip(len(image) // _CHUNK_OBSERVATIONS, 1, min(16, max(2, _MAX_SUMS_BYTES // max(sums, 1))))
    return BundleLayout(
        *(
            images,
            np.ascontiguousarray(problem.camera_model[images.camera]),
            observations,
            unknowns,
            entries,
            sensor_node,
            camera_node,
            np.where(joined, 6, 0),
        ),
        *(point_node, frame_node, free_params, num_free, held, lanes, wide, int(chunks)),
    )


def reduced_pattern(layout: BundleLayout, problem: BundleProblem, *, with_points: bool) -> BlockPattern:
    """The pairs of nodes that meet in an image, a prior or, with_points, in a point; sorted by row."""
    n, entries = layout.num_nodes, layout.entries
    keys = [np.arange(n) * (n + 1)]
    if with_points:
        mark, count = np.empty((2, n), np.int64)
        arguments = (entries.start, entries.node, entries.point, entries.by_node, entries.node_start, mark)
        total = layout_kernels.find_pattern(*arguments, count, np.empty(0, np.int64))
        column = np.empty(total, np.int64)
        if total:
            layout_kernels.find_pattern(*arguments, count, column)
        keys.append(np.repeat(np.arange(n), count) * n + column)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        first, second = layout.unknowns.nodes[:, a], layout.unknowns.nodes[:, b]
        both = np.asarray((first >= 0) & (second >= 0))
        keys.append(np.maximum(first, second)[both] * n + np.minimum(first, second)[both])
    for j in np.flatnonzero(layout.point_node >= 0):
        own = layout.point_node[j]
        met = entries.node[entries.start[j] : entries.start[j + 1]].astype(np.int64)
        keys.append(np.maximum(own, met) * n + np.minimum(own, met))
    if problem.priors is not None and problem.priors.distances is not None:
        distances = problem.priors.distances
        ends = layout.point_node[np.stack([distances.first, distances.second])]
        both = np.asarray((ends >= 0).all(axis=0))
        keys.append(ends[:, both].max(axis=0) * n + ends[:, both].min(axis=0))
    unique = np.unique(np.concatenate(keys))
    return BlockPattern(entries.width, unique // max(n, 1), unique % max(n, 1))


def _images(problem: BundleProblem) -> tuple[Images, np.ndarray]:
    """The images, sorted by frame, and which each observation is of."""
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


def _kept_points(problem: BundleProblem) -> np.ndarray:
    """Free points with a known distance: it ties them, so they cannot be eliminated one by one."""
    if problem.priors is None or problem.priors.distances is None:
        return np.empty(0, np.int64)
    ends = np.unique(np.concatenate([problem.priors.distances.first, problem.priors.distances.second]))
    return ends[problem.point_free[ends] > 0]


def _roles(problem: BundleProblem, kept: np.ndarray) -> np.ndarray:
    role = np.where(problem.point_free > 0, kernels.ELIMINATED, kernels.HELD).astype(np.int8)
    role[kept] = kernels.KEPT
    return role


def _numbered(mask: np.ndarray, first: int) -> np.ndarray:
    return np.where(mask, first + np.cumsum(mask) - 1, -1).astype(np.int64)


def _padded(width: int) -> tuple[int, ...]:
    return (0,) * next(size for size in _LANES if size >= width)


def _entries(
    problem: BundleProblem, image: np.ndarray, nodes: np.ndarray, role: np.ndarray, width: np.ndarray
) -> kernels.Entries:
    num_points, num_nodes = len(role), len(width)
    start = np.zeros(num_points + 1, np.int64)
    slot = np.empty((len(image), 3), np.int16)

    def find(node: np.ndarray) -> None:
        _parallel.map_chunks(
            lambda a, b, _: layout_kernels.find_entries(
                problem.offsets, image, nodes, role, a, b, start, node, slot
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
    return kernels.Entries(start, node, slot, point, by_node, node_start, width)
