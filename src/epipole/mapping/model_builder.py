"""The growing model of a mapper: mutable columns over fixed tracks, which freeze into a Reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, UInt8

from epipole import _parallel
from epipole._checks import check_different, check_index, check_indices, check_squarable, checked
from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.geometry import Rigid3, Similarity3
from epipole.mapping import _track_kernels as kernels
from epipole.mapping.match_components import (
    ComponentChanges,
    MatchComponents,
    check_components,
    rows_of_groups,
)
from epipole.mapping.model_state import Cams, Rows, Snapshot, mean_colors, poses_of
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


class ModelBuilder:
    """A model under construction. Each image is a frame of a separate rig."""

    @checked
    def __init__(
        self,
        cameras: Cameras,
        camera_of_image: Int32[np.ndarray, " n"],
        keypoints: Sequence[Float64[np.ndarray, "_ 2"]],
        components: MatchComponents,
    ) -> None:
        check_components(components, [len(k) for k in keypoints])
        check_indices(camera_of_image, "camera_of_image", len(cameras))
        if len(camera_of_image) != len(keypoints):
            raise ShapeError(f"camera_of_image must have {len(keypoints)} rows, got {len(camera_of_image)}")
        self.cameras = cameras
        self.camera_of_image = camera_of_image.astype(np.int32)
        self.params = cameras.params.copy()
        self.keypoints = keypoints
        self._use(components)
        self.clear()

    def _use(self, components: MatchComponents) -> None:
        """Rows of the components, without points."""
        keypoints, self.components = self.keypoints, components
        starts = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
        stacked = np.concatenate(list(keypoints)) if len(keypoints) else np.zeros((0, 2))
        self.row_image = components.image
        self.row_pixel = np.ascontiguousarray(
            stacked[starts[components.image] + components.keypoint], np.float64
        )
        self.row_component = np.repeat(np.arange(len(components)), np.diff(components.offsets))
        self.longest = int(np.diff(components.offsets).max(initial=1))
        order = np.argsort(self.row_image, kind="stable")
        bounds = np.searchsorted(self.row_image[order], np.arange(len(keypoints) + 1))
        self.rows_of_image = [order[a:b] for a, b in pairwise(bounds)]
        self.row_ray = np.zeros((len(self.row_image), 3))
        for camera in range(len(self.cameras)):
            self.update_rays(camera)
        self.row_point = np.full(len(self.row_image), -1, np.int32)
        self.changes = ComponentChanges(self.row_component, len(components))
        self._filtered = 0, 0.0, 0.0

    def replace_components(self, components: MatchComponents) -> None:
        """Replace the connected keypoints; poses and camera parameters stay, points are removed.

        Raises:
            ShapeError: a component refers to a missing keypoint.
        """
        check_components(components, [len(k) for k in self.keypoints])
        # Released before the new ones are made: they have the size of all matches.
        del (
            self.row_image,
            self.row_pixel,
            self.row_component,
            self.rows_of_image,
            self.row_ray,
            self.row_point,
        )
        self._use(components)
        self._points, self.num_points = np.empty((1024, 3)), 0

    def clear(self) -> None:
        """Remove all poses and points."""
        n = len(self.camera_of_image)
        self.registered = np.zeros(n, bool)
        self.motion = np.full((n, 12), np.nan)
        self.center = np.full((n, 3), np.nan)
        self.row_point = np.full(len(self.row_image), -1, np.int32)
        self._points = np.empty((1024, 3))
        self.num_points = 0
        self.changes.note_all()
        if (self.params != self.cameras.params).any():
            self.set_params(self.cameras.params.copy())

    def snapshot(self) -> Snapshot:
        """Save the current state."""
        return Snapshot(
            self.registered.copy(),
            self.motion.copy(),
            self.row_point.copy(),
            self.points.copy(),
            self.params.copy(),
        )

    def restore(self, state: Snapshot) -> None:
        """Restore a saved state."""
        self.registered, self.row_point = state.registered.copy(), state.row_point.copy()
        self.motion, self.center = state.motion.copy(), np.full((len(state.motion), 3), np.nan)
        self.set_poses(np.flatnonzero(self.registered), self.registered_poses())
        self._points, self.num_points = state.points.copy(), len(state.points)
        self.set_params(state.params.copy())
        self.changes.note_all()

    def set_params(self, params: np.ndarray) -> None:
        """Set the camera parameters, and update the rays of the cameras that changed."""
        changed = np.flatnonzero((params != self.params).any(axis=1))
        self.params = params
        for camera in changed:
            self.update_rays(int(camera))
            self._note_images(np.flatnonzero(self.camera_of_image == camera))

    @property
    def points(self) -> Float64[np.ndarray, "p 3"]:
        """Points in world coordinates; points without observations are unused."""
        return self._points[: self.num_points]

    @checked
    def update_rays(self, camera: int) -> None:
        """Unproject the rows of a camera again after its parameters changed."""
        model = self.camera(camera)
        images = np.flatnonzero(self.camera_of_image == camera)
        if len(images):
            rows = np.concatenate([self.rows_of_image[i] for i in images])
            self.row_ray[rows] = np.nan_to_num(model.unproject(self.row_pixel[rows]))

    @checked
    def camera(self, index: int) -> Camera:
        """The camera with its current parameters."""
        check_index(index, "index", len(self.cameras))
        return replace(self.cameras, params=self.params)[index]

    @checked
    def cam_from_world(self, image: int) -> Rigid3:
        """Pose of one image."""
        check_index(image, "image", len(self.motion))
        return Rigid3(self.motion[image, :9].reshape(3, 3).copy(), self.motion[image, 9:].copy())

    @checked
    def register(self, image: int, cam_from_world: Rigid3) -> None:
        """Register an image with this pose."""
        check_index(image, "image", len(self.motion))
        self.set_poses(
            np.array([image]), Rigid3(cam_from_world.rotation[None], cam_from_world.translation[None])
        )
        self.registered[image] = True

    def set_poses(self, images: np.ndarray, cams_from_world: Rigid3) -> None:
        """Set the poses of images."""
        self.motion[images, :9] = cams_from_world.rotation.reshape(-1, 9)
        self.motion[images, 9:] = cams_from_world.translation
        self.center[images] = cams_from_world.centers()
        self._note_images(images)

    def _note_images(self, images: np.ndarray) -> None:
        self.changes.note(np.concatenate([[], *(self.rows_of_image[i] for i in images)]).astype(np.int64))

    @checked
    def deregister(self, image: int) -> None:
        """Unregister an image and remove its observations."""
        check_index(image, "image", len(self.motion))
        self.registered[image] = False
        self.motion[image] = self.center[image] = np.nan
        self.drop(self.rows_of_image[image])

    def drop(self, rows: np.ndarray) -> None:
        """Remove the points of rows."""
        self.row_point[rows] = -1
        self.changes.note(rows)

    def set_points(self, indices: np.ndarray, xyz: np.ndarray, rows: np.ndarray) -> None:
        """Set the positions of points; `rows` observe them."""
        self._points[indices] = xyz
        self.changes.note(rows)

    def replace_points(self, rows: np.ndarray, point_of_row: np.ndarray, xyz: np.ndarray) -> None:
        """Replace all points by these (p, 3); `rows` (k,) observe them, all others observe none."""
        self._points, self.num_points = np.array(xyz, np.float64), len(xyz)
        self.row_point = np.full(len(self.row_image), -1, np.int32)
        self.row_point[rows] = point_of_row
        self.changes.note_all()

    def registered_poses(self) -> Rigid3:
        """cam_from_world of the registered images."""
        rows = self.motion[self.registered]
        return Rigid3(rows[:, :9].reshape(-1, 3, 3).copy(), rows[:, 9:].copy())

    def living_points(self) -> Float64[np.ndarray, "p 3"]:
        """Points that have observations."""
        return self.points[np.unique(self.row_point[self.row_point >= 0])]

    def move(self, target_from_world: Similarity3) -> None:
        """Transform the model into other coordinates."""
        images = np.flatnonzero(self.registered)
        self.set_poses(images, target_from_world.move_cam_from_source(self.registered_poses()))
        self._points[: self.num_points] = target_from_world.apply(self.points)

    def _kernel_rows(self) -> Rows:
        return Rows(self.row_image, self.row_pixel, self.row_ray, self.row_point)

    def _kernel_cams(self) -> Cams:
        return Cams(
            self.motion, self.center, self.registered, self.camera_of_image, self.cameras.model, self.params
        )

    @checked
    def triangulate(
        self, components: Int64[np.ndarray, " k"], max_error_px: float, min_angle_rad: float
    ) -> int:
        """Triangulate new points from rows without one; returns the number of new observations."""
        check_squarable(max_error_px, "max_error_px")
        check_different(components, "components", len(self.components))
        limit = np.cos(min_angle_rad)

        def work(start: int, stop: int, _: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            sizes = (
                self.components.offsets[components[start:stop] + 1]
                - self.components.offsets[components[start:stop]]
            )
            made = np.empty((int((sizes // 2).clip(max=3).sum()), 3))
            seen = self._kernel_rows(), self._kernel_cams(), self.components.offsets, components, start, stop
            limits = max_error_px**2, limit, self.longest
            count = kernels.triangulate_components(*seen, *limits, made, point_of_row)
            rows = rows_of_groups(self.components.offsets, components[start:stop])
            rows = rows[point_of_row[rows] >= 0]
            return made[:count], rows, point_of_row[rows]

        point_of_row = np.full(len(self.row_image), -1, np.int32)
        added = 0
        for made, rows, local in _parallel.map_chunks(work, len(components)):
            self._grow(len(made))
            self._points[self.num_points : self.num_points + len(made)] = made
            self.row_point[rows] = local + self.num_points
            self.changes.note(rows)
            self.num_points += len(made)
            added += len(rows)
        return added

    @checked
    def extend(self, components: Int64[np.ndarray, " k"], max_error_px: float) -> int:
        """Assign rows without a point to points of their component; returns the number of new observations."""
        check_squarable(max_error_px, "max_error_px")
        check_different(components, "components", len(self.components))
        given = np.full(len(self.row_image), -1, np.int32)
        counts = _parallel.map_chunks(
            lambda a, b, _: kernels.extend_components(
                self._kernel_rows(),
                self._kernel_cams(),
                self.components.offsets,
                components,
                a,
                b,
                self.points,
                max_error_px**2,
                given,
            ),
            len(components),
        )
        rows = np.flatnonzero(given >= 0)
        self.row_point[rows] = given[rows]
        self.changes.note(rows)
        return int(sum(counts))

    @checked
    def filter(self, max_error_px: float, min_angle_rad: float) -> int:
        """Drop rows with large errors, and points with too narrow an angle; returns the number of dropped rows.

        Only components that have changed since the last time are looked at, unless the limits are others.
        """
        check_squarable(max_error_px, "max_error_px")
        time, *limits = self._filtered
        changed = self.changes.since(time if limits == [max_error_px, min_angle_rad] else 0)
        near = rows_of_groups(self.components.offsets, changed)
        near = near[self.row_point[near] >= 0]
        order = near[np.argsort(self.row_point[near], kind="stable")]
        used, starts = np.unique(self.row_point[order], return_index=True)
        offsets = np.append(starts, len(order)).astype(np.int64)
        keep, errors = np.zeros(len(self.row_image), bool), np.empty(len(used))
        limit, points = np.cos(min_angle_rad), self.points[used]
        _parallel.map_chunks(
            lambda a, b, _: kernels.filter_points(
                self._kernel_rows(),
                self._kernel_cams(),
                offsets,
                order,
                a,
                b,
                points,
                max_error_px**2,
                limit,
                keep,
                errors,
            ),
            len(used),
        )
        dropped = near[~keep[near]]
        self.drop(dropped)
        self._filtered = self.changes.now, max_error_px, min_angle_rad
        return len(dropped)

    def rows_by_point(self) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " p1"]]:
        """Rows that have a point, grouped by point, with offsets."""
        rows = np.flatnonzero(self.row_point >= 0)
        order = rows[np.argsort(self.row_point[rows], kind="stable")]
        counts = np.bincount(self.row_point[rows], minlength=self.num_points)
        return order, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def has_point(self, components: Int64[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Which components have at least one point."""
        rows = rows_of_groups(self.components.offsets, components)
        with_point = self.row_component[rows[self.row_point[rows] >= 0]]
        return np.isin(components, with_point)

    @checked
    def points_in_sight(self, image: int) -> tuple[Int64[np.ndarray, " k"], Int32[np.ndarray, " k"]]:
        """(rows, points) that an image sees if its matches are right: the points of its rows' components."""
        check_index(image, "image", len(self.rows_of_image))
        rows = self.rows_of_image[image]
        component = self.row_component[rows]
        near = rows_of_groups(self.components.offsets, component)
        repeats = np.diff(self.components.offsets)[component]
        owner = np.repeat(rows, repeats)
        point = self.row_point[near]
        pairs = np.unique(np.stack([owner[point >= 0], point[point >= 0]], axis=1), axis=0)
        return pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int32)

    def _grow(self, extra: int) -> None:
        need = self.num_points + extra
        if need > len(self._points):
            bigger = np.empty((max(need, 2 * len(self._points)), 3))
            bigger[: self.num_points] = self.points
            self._points = bigger

    @checked
    def freeze(
        self,
        names: Sequence[str],
        colors: Sequence[UInt8[np.ndarray, "_ 3"]] | None = None,
        timestamps_s: Float64[np.ndarray, " n"] | None = None,
    ) -> Reconstruction:
        """The model as an immutable Reconstruction, with only the points that have two or more observations.

        Args:
            names: one per image.
            colors: RGB of every keypoint of every image, (k, 3) uint8; gray 128 if not given.
            timestamps_s: one per image.

        Raises:
            ShapeError: an argument does not have one row per image, or per keypoint.
        """
        for name, given in (("names", names), ("timestamps_s", timestamps_s)):
            if given is not None and len(given) != len(self.keypoints):
                raise ShapeError(f"{name} must have {len(self.keypoints)} rows, got {len(given)}")
        if colors is not None and [len(c) for c in colors] != [len(k) for k in self.keypoints]:
            raise ShapeError("colors must have one row per keypoint")
        order, offsets = self.rows_by_point()
        alive = np.diff(offsets) >= 2
        order = order[alive[self.row_point[order]]]
        offsets = np.concatenate([[0], np.cumsum(np.diff(offsets)[alive])]).astype(np.int64)
        image, keypoint = self.row_image[order], self.components.keypoint[order]
        starts = np.concatenate([[0], np.cumsum([len(k) for k in self.keypoints])]).astype(np.int64)
        rgb = mean_colors(colors, starts[image] + keypoint, offsets)
        model = Reconstruction(
            replace(self.cameras, params=self.params.copy()),
            Rigs.of_single_cameras(len(self.cameras)),
            Frames(
                self.camera_of_image.copy(),
                poses_of(self.registered, self.motion),
                np.full(len(names), np.nan) if timestamps_s is None else np.asarray(timestamps_s, np.float64),
            ),
            Images(
                tuple(names),
                np.arange(len(names), dtype=np.int32),
                self.camera_of_image.copy(),
                starts,
                np.ascontiguousarray(np.concatenate(list(self.keypoints)), np.float64).reshape(-1, 2),
            ),
            Points(self.points[alive].copy(), rgb, np.zeros(len(rgb))),
            Tracks(offsets, image.astype(np.int32), keypoint.astype(np.int32)),
        )
        errors = model.reprojection_errors_px()
        mean = np.add.reduceat(errors, offsets[:-1]) / np.diff(offsets) if len(rgb) else np.zeros(0)
        return replace(model, points=replace(model.points, error_px=mean))
