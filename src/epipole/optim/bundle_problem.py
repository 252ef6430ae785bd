"""The input of bundle adjustment: poses, intrinsics, points, observations and priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int32, Int64

from epipole._checks import Declared, check_fields, checked
from epipole.cameras import MAX_PARAMS, Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3

NUM_PARAMS = MAX_PARAMS


@dataclass(frozen=True, slots=True, eq=False)
class PointDistances(Declared):
    """Known distances between points: a scale bar, a calibration object."""

    first: Int64[np.ndarray, " d"]
    second: Int64[np.ndarray, " d"]
    distance: Float64[np.ndarray, " d"]
    sigma: Float64[np.ndarray, " d"]
    """Standard deviations, in world units."""


@dataclass(frozen=True, slots=True, eq=False)
class PointPositions(Declared):
    """Measured positions of points: control points of a survey."""

    point: Int64[np.ndarray, " d"]
    """Rows of the points; each at most once."""
    expected: Float64[np.ndarray, "d 3"]
    sigma: Float64[np.ndarray, "d 3"]
    """Standard deviation of each coordinate, in world units; infinite if it was not measured."""


@runtime_checkable
class PathFactors(Protocol):
    """A term over many frames that optimizes its own inner unknowns, such as the measurements of an IMU."""

    @property
    def frames(self) -> Int64[np.ndarray, " n"]:
        """Rows of the frames."""
        ...

    def linearized(
        self, rig_from_world: Rigid3
    ) -> tuple[float, Float64[np.ndarray, "n 6"], Float64[np.ndarray, "n 6 n 6"]]:
        """Half the sum of squares at poses of the frames, its gradient and matrix by xi of exp(xi) @ rig_from_world."""
        ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BundlePriors(Declared):
    """Prior knowledge besides the images; each part is optional and adds half its squared, weighted error.

    Standard deviations are relative to pixels with a standard deviation of one.
    """

    position_in_world: Float64[np.ndarray, "f 3"] | None = None
    """Expected frame centers (GPS); NaN rows for none. Cauchy loss with a scale of one standard deviation."""
    position_sigma: float | Float64[np.ndarray, "f 3"] = 1.0
    """Standard deviations of the expected centers, in world units: one number, or one per axis."""
    rig_from_world: Rigid3 | None = None
    """Expected motions of the frames (odometry, an earlier adjustment)."""
    rig_information: Float64[np.ndarray, "f 6 6"] | None = None
    """Inverse covariances of log(rig_from_world expected^-1), (translation, rotation); zero for none."""
    down_in_rig: Float64[np.ndarray, "f 3"] | None = None
    """Measured unit direction of gravity (an accelerometer at rest); NaN rows for none."""
    down_in_world: tuple[float, float, float] = (0.0, 0.0, -1.0)
    down_sigma_rad: float = 0.02
    params_expected: Float64[np.ndarray, "c 12"] | None = None
    """Expected camera parameters."""
    params_sigma: Float64[np.ndarray, "c 12"] | None = None
    """Standard deviations of the camera parameters; infinite for no prior."""
    points: PointPositions | None = None
    distances: PointDistances | None = None
    paths: tuple[PathFactors, ...] = ()

    @checked
    def check(self, num_frames: int, num_cameras: int, num_points: int) -> None:
        """Check that the priors match a problem of this size.

        Raises:
            ShapeError: an array has the wrong shape, or an index refers to a missing point or frame.
            ConfigError: a standard deviation is not positive, or an information matrix is not positive definite.
        """
        frames, cameras = (num_frames, 3), (num_cameras, NUM_PARAMS)
        shapes = {"position_in_world": frames, "down_in_rig": frames, "rig_information": (num_frames, 6, 6)}
        shapes |= {"params_expected": cameras, "params_sigma": cameras}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ShapeError(f"{name} must be {shape}, got {array.shape}")
        if np.shape(self.position_sigma) not in ((), frames):
            raise ShapeError(f"position_sigma must be one number or {frames}")
        if self.rig_from_world is not None and self.rig_from_world.batch_shape() != (num_frames,):
            raise ShapeError(f"rig_from_world must have {num_frames} rows")
        sigmas = {"position_sigma": self.position_sigma, "down_sigma_rad": self.down_sigma_rad}
        sigmas["params_sigma"] = 1.0 if self.params_sigma is None else self.params_sigma
        if self.points is not None:
            self._check_points(num_points)
            sigmas["the points' sigma"] = self.points.sigma
        if self.distances is not None:
            sigmas["the distances' sigma"] = self.distances.sigma
            ends = np.concatenate([self.distances.first, self.distances.second])
            if len(ends) and not (ends.min() >= 0 and ends.max() < num_points):
                raise ShapeError(f"a distance refers to a point that does not exist (there are {num_points})")
            if (self.distances.first == self.distances.second).any():
                raise ShapeError("a distance connects a point to itself")
        for path in self.paths:
            if len(path.frames) and not (path.frames.min() >= 0 and path.frames.max() < num_frames):
                raise ShapeError(f"a path refers to a frame that does not exist (there are {num_frames})")
        if not (np.isfinite(self.down_in_world).all() and np.any(self.down_in_world)):
            raise ConfigError(f"down_in_world must be a direction, got {self.down_in_world}")
        for name, sigma in sigmas.items():
            if not (np.asarray(sigma) > 0).all():
                raise ConfigError(f"{name} must be positive")
        if self.rig_information is not None:
            known = self.rig_information[self.rig_information.any(axis=(1, 2))]
            if not (np.isfinite(known).all() and (np.linalg.eigvalsh(known) > 0).all()):
                raise ConfigError("rig_information must be zero or positive definite")

    def _check_points(self, num_points: int) -> None:
        assert self.points is not None
        point, expected = self.points.point, self.points.expected
        if len(point) and not (point.min() >= 0 and point.max() < num_points):
            raise ShapeError(f"a position belongs to a point that does not exist (there are {num_points})")
        if len(np.unique(point)) < len(point):
            raise ShapeError("a point has two measured positions")
        if not (np.isfinite(expected) | np.isinf(self.points.sigma)).all():
            raise ConfigError("a measured position is not finite")

    @property
    def fixes_gauge(self) -> bool:
        """Whether a prior constrains position, orientation or scale of the model, which images leave free."""
        return self.fixes_position or self.down_in_rig is not None or self.distances is not None

    @property
    def fixes_position(self) -> bool:
        """Whether a prior constrains the positions of frames or points."""
        at = self.position_in_world is not None and bool(
            np.isfinite(self.position_in_world).all(axis=1).any()
        )
        at |= self.points is not None and bool(np.isfinite(self.points.sigma).any())
        return at or (self.rig_information is not None and bool(self.rig_information.any()))


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """A problem with f frames, s sensors of their rig, c cameras, p points and k observations.

    Observations are grouped by point: those of point j are rows offsets[j] to offsets[j + 1]. Each refers to its frame (an
    instant with a rig pose), its sensor (a mounting on the rig) and its camera (intrinsics). Without rigs there is one sensor.
    """

    rig_from_world: Rigid3
    """One row per frame."""
    cam_from_rig: Rigid3
    """One row per sensor; identity for a single camera."""
    camera_model: Int32[np.ndarray, " c"]
    camera_params: Float64[np.ndarray, "c 12"]
    """Zeros after the parameters of the model: `Camera.padded_params`."""
    points_in_world: Float64[np.ndarray, "p 3"]
    offsets: Int64[np.ndarray, " p1"]
    """p + 1 numbers, increasing from 0 to k."""
    frame: Int32[np.ndarray, " k"]
    sensor: Int32[np.ndarray, " k"]
    camera: Int32[np.ndarray, " k"]
    pixels: Float64[np.ndarray, "k 2"]
    frame_free: Float64[np.ndarray, "f 6"]
    """1 where a tangent component (translation, rotation) of a frame may change, else 0."""
    params_free: Float64[np.ndarray, "c 12"]
    """1 where a camera parameter may change, else 0."""
    point_free: Float64[np.ndarray, " p"]
    """1 where a point may move, else 0."""
    sensor_free: Float64[np.ndarray, "s 6"] | None = None
    """1 where a tangent component of cam_from_rig may change, else 0; None: all constant."""
    point_sigma_px: Float64[np.ndarray, " p"] | None = None
    """Standard deviation of each point's pixels, relative to that of usual ones; None: one."""
    priors: BundlePriors | None = None

    @staticmethod
    @checked
    def from_tracks(
        cams_from_world: Rigid3,
        cameras: Camera | Sequence[Camera],
        points_in_world: Float64[np.ndarray, "p 3"],
        image: Int64[np.ndarray, " k"],
        point: Int64[np.ndarray, " k"],
        pixels: Float64[np.ndarray, "k 2"],
    ) -> BundleProblem:
        """A problem of single images with free poses and points, and constant intrinsics.

        Args:
            cams_from_world: pose of each image.
            cameras: one for all images, or one per image.
            points_in_world: initial positions.
            image: image index of each observation, in any order.
            point: point index of each observation.
            pixels: pixel coordinates of each observation.

        Raises:
            ShapeError: array sizes do not match, or an observation refers to a missing image or point.
            ConfigError: the number of cameras is neither one nor the number of images.
        """
        if len(cams_from_world.batch_shape()) != 1:
            raise ShapeError(
                f"cams_from_world must have a batch of one axis, got {cams_from_world.batch_shape()}"
            )
        num_images, num_points = len(cams_from_world.translation), len(points_in_world)
        all_cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
        if len(all_cameras) not in (1, num_images):
            raise ConfigError(f"cameras must be one, or one per image ({num_images}), got {len(all_cameras)}")
        if len(point) and not 0 <= point.min() <= point.max() < num_points:
            raise ShapeError(f"point must be from 0 to {num_points - 1}, got {point.min()} to {point.max()}")
        order = np.argsort(point, kind="stable")
        frame = image[order].astype(np.int32)
        return BundleProblem(
            rig_from_world=cams_from_world,
            cam_from_rig=Rigid3.identity(1),
            camera_model=np.array([int(c.model) for c in all_cameras], np.int32),
            camera_params=np.stack([c.padded_params() for c in all_cameras]),
            points_in_world=points_in_world,
            offsets=np.concatenate([[0], np.cumsum(np.bincount(point, minlength=num_points))]).astype(
                np.int64
            ),
            frame=frame,
            sensor=np.zeros(len(frame), np.int32),
            camera=np.zeros(len(frame), np.int32) if len(all_cameras) == 1 else frame.copy(),
            pixels=pixels[order],
            frame_free=np.ones((num_images, 6)),
            params_free=np.zeros((len(all_cameras), NUM_PARAMS)),
            point_free=np.ones(num_points),
        )

    def __post_init__(self) -> None:
        """Check the arrays.

        Raises:
            ShapeError: array sizes do not match, or an index or mask is invalid.
            ConfigError: a prior's standard deviation is not positive.
        """
        check_fields(self)
        for name in ("rig_from_world", "cam_from_rig"):
            if len(getattr(self, name).batch_shape()) != 1:
                raise ShapeError(
                    f"{name} must have a batch of one axis, got {getattr(self, name).batch_shape()}"
                )
        num_frames, num_sensors = len(self.rig_from_world.translation), len(self.cam_from_rig.translation)
        num_points, num_seen, num_cameras = (
            len(self.points_in_world),
            len(self.pixels),
            len(self.camera_params),
        )
        lengths = {
            "frame_free": (len(self.frame_free), num_frames),
            "camera_model": (len(self.camera_model), num_cameras),
            "params_free": (len(self.params_free), num_cameras),
            "point_free": (len(self.point_free), num_points),
            "offsets": (len(self.offsets), num_points + 1),
            "sensor_free": (num_sensors if self.sensor_free is None else len(self.sensor_free), num_sensors),
            "point_sigma_px": (
                num_points if self.point_sigma_px is None else len(self.point_sigma_px),
                num_points,
            ),
        }
        lengths |= {name: (len(getattr(self, name)), num_seen) for name in ("frame", "sensor", "camera")}
        for name, (found, wanted) in lengths.items():
            if found != wanted:
                raise ShapeError(f"{name} must have {wanted} rows, got {found}")
        if self.offsets[0] != 0 or self.offsets[-1] != num_seen or (np.diff(self.offsets) < 0).any():
            raise ShapeError(f"offsets must increase from 0 to the number of observations, {num_seen}")
        for name, size in (("frame", num_frames), ("sensor", num_sensors), ("camera", num_cameras)):
            index = getattr(self, name)
            if len(index) and not (index.min() >= 0 and index.max() < size):
                raise ShapeError(f"an observation refers to a {name} that does not exist (there are {size})")
        for name in ("frame_free", "params_free", "point_free", "sensor_free"):
            free = getattr(self, name)
            if free is not None and not ((free == 0) | (free == 1)).all():
                raise ShapeError(f"{name} must be 0 or 1")
        check_models(self.camera_model)
        if (
            self.point_sigma_px is not None
            and not ((self.point_sigma_px > 0) & np.isfinite(self.point_sigma_px)).all()
        ):
            raise ConfigError("point_sigma_px must be positive and finite")
        if self.priors is not None:
            self.priors.check(num_frames, num_cameras, num_points)

    def __repr__(self) -> str:
        return (
            f"BundleProblem({len(self.rig_from_world)} frames, {len(self.camera_params)} cameras, "
            f"{len(self.points_in_world)} points, {len(self.pixels)} observations)"
        )


def check_models(models: Int32[np.ndarray, " c"]) -> None:
    """Check that all numbers are camera models.

    Raises:
        ConfigError: a number is not a camera model.
    """
    known = [int(model) for model in CameraModel]
    if not np.isin(models, known).all():
        wrong = int(models[~np.isin(models, known)][0])
        raise ConfigError(f"unknown camera model {wrong}: models are numbered {known[0]} to {known[-1]}")


@checked
def free_params_mask(
    models: Int32[np.ndarray, " c"],
    *,
    focal: bool = True,
    principal_point: bool = False,
    distortion: bool = True,
) -> Float64[np.ndarray, "c 12"]:
    """Mask of free intrinsics, by kind of parameter.

    Raises:
        ConfigError: a number is not a camera model.
    """
    check_models(models)
    mask = np.zeros((len(models), NUM_PARAMS))
    for row, model in enumerate(models):
        kind = CameraModel(int(model))
        mask[row, list(kind.focal_indices)] = float(focal)
        mask[row, list(kind.principal_point_indices)] = float(principal_point)
        mask[row, list(kind.distortion_indices)] = float(distortion)
    return mask


@checked
def with_fixed_gauge(problem: BundleProblem) -> BundleProblem:
    """Fix the seven degrees of freedom that images leave open: one frame, and one coordinate of a second.

    The frame with most observations is fixed. Of the frame farthest from it, the component of its translation tangent along
    the line between both (the largest, in its own axes) is fixed, which fixes the scale. Fixing components, rather than
    correcting a solved step, keeps the predicted decrease valid. Nothing is fixed if prior positions or two constant frames
    constrain the gauge already.
    """
    free = problem.frame_free.copy()
    counts = np.bincount(problem.frame, minlength=len(free))
    movable = np.flatnonzero(free.any(axis=1) & (counts > 0))
    if len(movable) < 2 or not free[movable].all():
        return problem
    if problem.priors is not None and problem.priors.fixes_position:
        return problem
    if (counts[~free.any(axis=1)] > 0).sum() >= 2:
        return problem
    first = movable[np.argmax(counts[movable])]
    free[first] = 0.0
    centers = problem.rig_from_world.centers()
    others = movable[movable != first]
    second = others[np.argmax(np.linalg.norm(centers[others] - centers[first], axis=1))]
    along = problem.rig_from_world.rotation[second] @ (centers[second] - centers[first])
    free[second, np.argmax(np.abs(along))] = 0.0
    return replace(problem, frame_free=free)
