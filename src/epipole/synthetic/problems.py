"""Geometry problems with known answers, for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole._checks import check_count, check_seed, checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Rotation3
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks
from epipole.synthetic.courtyard import look_at

NEAR, FAR = 4.0, 9.0
"""Range of depths in two-view and absolute pose problems; the baseline of two views is 1."""
RING_RADIUS, BALL_RADIUS = 4.0, 1.0
DISTORTION = (-0.05, 0.01, 1e-3, -1e-3)
"""First distortion coefficients of the camera in bundle problems."""
_MOST_ROUNDS = 1000
"""Rounds of sampling points visible in two images; a few suffice if the images overlap."""
START_TWIST, START_POINT, START_FOCAL = 0.01, 0.02, 0.01
"""Standard deviations of a bundle problem's initial values: twist of each camera, points, and focal length (relative)."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewProblem:
    """Matches between two images; the second pixel of an outlier is random."""

    pixels1: Float64[np.ndarray, "n 2"]
    pixels2: Float64[np.ndarray, "n 2"]
    inlier_mask: Bool[np.ndarray, " n"]
    cam2_from_cam1: Rigid3
    """|t| = 1, or 0 for a pure rotation."""
    camera1: Camera
    camera2: Camera
    points_in_cam1: Float64[np.ndarray, "n 3"]
    """Points at pixels1, of outliers too."""
    plane_mask: Bool[np.ndarray, " n"]
    """Points on the plane, if the scene has one."""


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePoseProblem:
    """Points and their pixels; the pixel of an outlier is random."""

    points_in_world: Float64[np.ndarray, "n 3"]
    pixels: Float64[np.ndarray, "n 2"]
    inlier_mask: Bool[np.ndarray, " n"]
    cam_from_world: Rigid3
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructionProblem:
    """The true model with noisy keypoints, and a perturbed model with the same keypoints and tracks."""

    truth: Reconstruction
    start: Reconstruction


@checked
def two_view_problem(
    num_matches: int,
    outlier_ratio: float = 0.0,
    noise_px: float = 0.0,
    seed: int = 0,
    *,
    kind: Literal["general", "planar", "rotation", "forward"] = "general",
    focal_px: float = 800.0,
    size: tuple[int, int] = (1280, 960),
) -> TwoViewProblem:
    """Matches between two images of one camera, with a baseline of 1 and depths of 4 to 9.

    Args:
        num_matches: inliers and outliers together.
        outlier_ratio: fraction of wrong matches.
        noise_px: standard deviation of every coordinate in both images.
        seed: random seed.
        kind: general; planar: all points on one slanted plane; rotation: no baseline; forward: the baseline along
            the first camera's optical axis.
        focal_px: of both cameras.
        size: width and height of both images.

    Raises:
        ConfigError: a value is out of range.
    """
    _check(num_matches, outlier_ratio, noise_px, seed)
    return _two_views(_pinhole(focal_px, size), num_matches, outlier_ratio, noise_px, seed, kind)


@checked
def dominant_plane_problem(
    num_matches: int,
    plane_fraction: float,
    outlier_ratio: float = 0.0,
    noise_px: float = 0.0,
    seed: int = 0,
) -> TwoViewProblem:
    """`two_view_problem` of a scene with a fraction of its points on one slanted plane.

    Args:
        num_matches: inliers and outliers together.
        plane_fraction: fraction of the points on the plane.
        outlier_ratio: fraction of wrong matches.
        noise_px: standard deviation of every coordinate in both images.
        seed: random seed.

    Raises:
        ConfigError: a value is out of range.
    """
    _check(num_matches, outlier_ratio, noise_px, seed)
    if not 0 <= plane_fraction <= 1:
        raise ConfigError(f"plane_fraction must lie in [0, 1], got {plane_fraction}")
    camera = _pinhole(800.0, (1280, 960))
    return _two_views(camera, num_matches, outlier_ratio, noise_px, seed, "planar", plane_fraction)


def _two_views(
    camera: Camera,
    num_matches: int,
    outlier_ratio: float,
    noise_px: float,
    seed: int,
    kind: str,
    plane_fraction: float = 1.0,
) -> TwoViewProblem:
    rng = np.random.default_rng(seed)
    rotation = Rotation3.exp(_direction(rng) * rng.uniform(0.05, 0.15))
    center = np.array([0.0, 0.0, 1.0]) if kind == "forward" else _direction(rng)
    shift = np.zeros(3) if kind == "rotation" else -rotation.apply(center)
    cam2_from_cam1 = Rigid3(rotation.matrix, shift)
    normal = _slanted_normal(rng) if kind == "planar" else None
    points, pixels1, pixels2 = np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2))
    plane_mask = np.empty(0, bool)
    for _ in range(_MOST_ROUNDS):
        if len(points) == num_matches:
            break
        candidates, seen1, flat = _points_in_view(rng, camera, num_matches + 8, normal, plane_fraction)
        seen2 = camera.project(cam2_from_cam1.apply(candidates))
        inside = _is_inside(camera, seen2)
        points = np.concatenate([points, candidates[inside]])[:num_matches]
        plane_mask = np.concatenate([plane_mask, flat[inside]])[:num_matches]
        pixels1 = np.concatenate([pixels1, seen1[inside]])[:num_matches]
        pixels2 = np.concatenate([pixels2, seen2[inside]])[:num_matches]
    if len(points) < num_matches:
        raise ConfigError(f"images of {camera.width} x {camera.height} pixels have too few points in common")
    pixels1 = pixels1 + noise_px * rng.standard_normal(pixels1.shape)
    pixels2, inlier_mask = _with_noise_and_outliers(rng, camera, pixels2, outlier_ratio, noise_px)
    return TwoViewProblem(pixels1, pixels2, inlier_mask, cam2_from_cam1, camera, camera, points, plane_mask)


@checked
def absolute_pose_problem(
    num_points: int,
    outlier_ratio: float = 0.0,
    noise_px: float = 0.0,
    seed: int = 0,
    *,
    planar: bool = False,
    focal_px: float = 800.0,
    size: tuple[int, int] = (1280, 960),
) -> AbsolutePoseProblem:
    """Points at depths of 4 to 9, seen by a camera with a random pose.

    Args:
        num_points: inliers and outliers together.
        outlier_ratio: fraction of wrong pixels.
        noise_px: standard deviation of every coordinate.
        seed: random seed.
        planar: whether all points are on one slanted plane.
        focal_px: of the camera.
        size: width and height of the image.

    Raises:
        ConfigError: a value is out of range.
    """
    _check(num_points, outlier_ratio, noise_px, seed)
    rng, camera = np.random.default_rng(seed), _pinhole(focal_px, size)
    cam_from_world = Rigid3(
        Rotation3.from_quat_wxyz(rng.standard_normal(4)).matrix, rng.uniform(-10.0, 10.0, 3)
    )
    normal = _slanted_normal(rng) if planar else None
    points_in_cam, pixels, _ = _points_in_view(rng, camera, num_points, normal)
    pixels, inlier_mask = _with_noise_and_outliers(rng, camera, pixels, outlier_ratio, noise_px)
    points_in_world = cam_from_world.inverse().apply(points_in_cam)
    return AbsolutePoseProblem(points_in_world, pixels, inlier_mask, cam_from_world, camera)


@checked
def bundle_problem(
    num_cameras: int,
    num_points: int,
    track_length: int,
    noise_px: float = 0.0,
    seed: int = 0,
    *,
    model: CameraModel = CameraModel.SIMPLE_RADIAL,
) -> ReconstructionProblem:
    """A ring of images of one camera around a ball of points; neighbors on the ring share points.

    Args:
        num_cameras: images on the ring.
        num_points: points in the ball, without occlusion.
        track_length: consecutive images on the ring that observe each point.
        noise_px: standard deviation of every keypoint coordinate.
        seed: random seed.
        model: of the camera of all images.

    Raises:
        ConfigError: a value is out of range.
    """
    check_count(num_cameras, "num_cameras", 1 << 16)
    _check(num_points, 0.0, noise_px, seed)
    if not 1 <= track_length <= num_cameras:
        raise ConfigError(f"track_length must lie between 1 and {num_cameras} cameras, got {track_length}")
    rng = np.random.default_rng(seed)
    camera, cams_from_world = _ring_camera(model), _ring(num_cameras)
    xyz = rng.standard_normal((num_points, 3))
    xyz *= BALL_RADIUS * rng.random((num_points, 1)) ** (1 / 3) / np.linalg.norm(xyz, axis=1, keepdims=True)
    first = rng.integers(num_cameras, size=(num_points, 1))
    image = np.sort((first + np.arange(track_length)) % num_cameras, axis=1).astype(np.int32).ravel()
    seen = camera.project(cams_from_world[image].apply(np.repeat(xyz, track_length, axis=0)))
    pixels = seen + noise_px * rng.standard_normal((len(image), 2))
    truth = _assemble(camera, cams_from_world, xyz, image, pixels, track_length)
    return ReconstructionProblem(truth, _perturbed(truth, rng))


def _check(count: int, outlier_ratio: float, noise_px: float, seed: int) -> None:
    check_seed(seed)
    check_count(count, "the number of points")
    if not 0 <= outlier_ratio <= 1:
        raise ConfigError(f"outlier_ratio must lie in [0, 1], got {outlier_ratio}")
    if not 0 <= noise_px < np.inf:
        raise ConfigError(f"noise_px must be finite and not negative, got {noise_px}")


def _pinhole(focal_px: float, size: tuple[int, int]) -> Camera:
    model = CameraModel.PINHOLE
    return Camera(model, *size, model.initial_params(focal_px, *size))


def _direction(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _slanted_normal(rng: np.random.Generator) -> Float64[np.ndarray, " 3"]:
    """11 to 29 degrees from the optical axis."""
    angle = rng.uniform(0.0, 2 * np.pi)
    tilt = rng.uniform(0.2, 0.5)
    return np.array([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)])


def _points_in_view(
    rng: np.random.Generator,
    camera: Camera,
    count: int,
    plane_normal: np.ndarray | None,
    plane_fraction: float = 1.0,
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Points in camera coordinates, their exact pixels (uniform over the image), and the mask of those on the plane."""
    pixels = _anywhere(rng, camera, count)
    rays = camera.unproject(pixels)
    rays = rays / rays[:, 2:]
    plane_mask = np.full(count, plane_normal is not None)
    if plane_normal is not None and plane_fraction < 1.0:
        plane_mask &= rng.random(count) < plane_fraction
    depth = np.ones(count) if plane_mask.all() else rng.uniform(NEAR, FAR, count)
    if plane_normal is not None:
        # n . x = n_z (NEAR + FAR) / 2: the plane intersects the optical axis at the mean depth.
        on_plane = 0.5 * (NEAR + FAR) * plane_normal[2] / (rays @ plane_normal)
        depth = np.where(plane_mask, on_plane, depth)
    return rays * depth[:, None], pixels, plane_mask


def _anywhere(rng: np.random.Generator, camera: Camera, count: int) -> Float64[np.ndarray, "n 2"]:
    return rng.uniform(-0.5, (camera.width - 0.5, camera.height - 0.5), (count, 2))


def _is_inside(camera: Camera, pixels: np.ndarray) -> Bool[np.ndarray, " n"]:
    return np.all((pixels >= -0.5) & (pixels <= (camera.width - 0.5, camera.height - 0.5)), axis=1)


def _with_noise_and_outliers(
    rng: np.random.Generator, camera: Camera, pixels: np.ndarray, outlier_ratio: float, noise_px: float
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    n = len(pixels)
    noisy = pixels + noise_px * rng.standard_normal((n, 2))
    outliers = rng.permutation(n)[: round(outlier_ratio * n)]
    noisy[outliers] = _anywhere(rng, camera, len(outliers))
    inlier_mask = np.ones(n, bool)
    inlier_mask[outliers] = False
    return noisy, inlier_mask


def _ring_camera(model: CameraModel) -> Camera:
    width, height = 1280, 960
    params = model.initial_params(1000.0, width, height)
    for index, coefficient in zip(model.distortion_indices, DISTORTION):
        params[index] = coefficient
    return Camera(model, width, height, params)


def _ring(num_cameras: int) -> Rigid3:
    """cams_from_world that look at the origin from a wavy circle."""
    angles = 2 * np.pi * np.arange(num_cameras) / num_cameras
    views = [
        look_at(
            (RING_RADIUS * np.cos(a), RING_RADIUS * np.sin(a), 0.8 + 0.5 * np.sin(2 * a)), (0.0, 0.0, 0.0)
        )
        for a in angles
    ]
    return Rigid3(np.stack([v.rotation for v in views]), np.stack([v.translation for v in views]))


def _assemble(
    camera: Camera,
    cams_from_world: Rigid3,
    xyz: np.ndarray,
    image: Int32[np.ndarray, " k"],
    pixels: np.ndarray,
    track_length: int,
) -> Reconstruction:
    """Observations are in track order; keypoints are stored image by image."""
    num_images, num_points = len(cams_from_world), len(xyz)
    order = np.argsort(image, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=num_images))]).astype(np.int64)
    keypoint = np.empty(len(image), np.int32)
    keypoint[order] = np.arange(len(image)) - offsets[image[order]]
    rgb = np.clip(127.5 + 110.0 * xyz / BALL_RADIUS, 0, 255).astype(np.uint8)
    model = Reconstruction(
        Cameras.from_list([camera]),
        Rigs.of_single_cameras(1),
        Frames(np.zeros(num_images, np.int32), cams_from_world, np.full(num_images, np.nan)),
        Images(
            tuple(f"ring_{i:04d}.jpg" for i in range(num_images)),
            np.arange(num_images, dtype=np.int32),
            np.zeros(num_images, np.int32),
            offsets,
            pixels[order],
        ),
        Points(xyz, rgb, np.full(num_points, np.nan)),
        Tracks(track_length * np.arange(num_points + 1, dtype=np.int64), image, keypoint),
    )
    return _with_errors(model)


def _with_errors(model: Reconstruction) -> Reconstruction:
    """The model with each point's mean reprojection error (all tracks have the same length)."""
    if not len(model.points):
        return model
    mean = model.reprojection_errors_px().reshape(len(model.points), -1).mean(axis=1)
    return replace(model, points=replace(model.points, error_px=mean))


def _perturbed(truth: Reconstruction, rng: np.random.Generator) -> Reconstruction:
    """The model with random errors in poses, points and focal length, and without distortion."""
    twists = START_TWIST * rng.standard_normal((len(truth.frames), 6))
    rig_from_world = Rigid3.exp(twists) @ truth.frames.rig_from_world
    xyz = truth.points.xyz_in_world + START_POINT * rng.standard_normal((len(truth.points), 3))
    params, model = truth.cameras.params.copy(), truth.cameras[0].model
    params[:, list(model.focal_indices)] *= 1.0 + START_FOCAL * rng.standard_normal()
    params[:, list(model.distortion_indices)] = 0.0
    moved = replace(
        truth,
        cameras=replace(truth.cameras, params=params),
        frames=replace(truth.frames, rig_from_world=rig_from_world),
        points=replace(truth.points, xyz_in_world=xyz),
    )
    return _with_errors(moved)
