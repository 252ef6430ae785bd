"""Candidate motions for monocular initialization, compared by how well they fit all frames in between.

A plane allows two motions (Faugeras and Lustman 1988), and few points near a plane hardly distinguish them. Each candidate is
optimized together with the frames in between; the wrong one fits worse the further the camera moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, decompose_homography
from epipole.mapping import refine_pose
from epipole.optim import BundleConfig, BundleProblem, Loss, adjust_bundle, with_fixed_gauge
from epipole.robust import estimate_homography, triangulate_points
from epipole.robust.ray_matches import Matches

PLANE_ERROR_PX = 2.0
MIN_TRIANGULATED, JUDGING_ITERATIONS, JUDGING_ROUNDS = 20, 20, 3
JUDGED_FRACTION = 0.8
"""Fraction of the points that count, those that fit best: tracks of the others may have drifted."""
BEFORE_FRACTION = 0.5
"""Minimum fraction of a plane's points in front of the camera. Not all: noise moves an obliquely seen plane behind some of them."""
CLEARLY = 2.0
"""A rival is ruled out at this many times the loss of the best motion. Tracking errors are correlated, so no chi-square test."""
LEAST_ROTATION_DEG, LEAST_ANGLE_DEG = 0.5, 10.0
"""Motions are different if they differ by more than this in rotation or in the direction of translation."""


class Judged(NamedTuple):
    """A candidate motion, optimized with the frames in between."""

    cam_from_first: Rigid3
    loss: float
    """Mean of log(1 + e^2) over the frames and the best JUDGED_FRACTION of the points, e in pixels."""
    median_angle_deg: float
    """Median triangulation angle."""


def motions_of_plane(first_px: np.ndarray, pixels: np.ndarray, camera: Camera, seed: int) -> list[Rigid3]:
    """The motions, |t| = 1, that the dominant plane allows; empty without a plane or without translation.

    Args:
        first_px: (n, 2) in the first frame.
        pixels: the same points now.
        camera: any model.
        seed: random seed.
    """
    rays = camera.unproject(first_px), camera.unproject(pixels)
    use = (rays[0][:, 2] > 0.1) & (rays[1][:, 2] > 0.1)
    on_plane = [camera.focal_px * ray[use, :2] / ray[use, 2:] for ray in rays]
    found = estimate_homography(
        on_plane[0], on_plane[1], RansacConfig(max_error_px=PLANE_ERROR_PX, seed=seed)
    )
    if not found.success:
        return []
    intrinsics = np.diag([camera.focal_px, camera.focal_px, 1.0])
    flat = on_plane[0][found.inlier_mask]
    with suppress(DegenerateGeometryError):
        allowed = decompose_homography(found.model, intrinsics, intrinsics)
        depth = np.column_stack([flat / camera.focal_px, np.ones(len(flat))]) @ allowed.normals_in_cam1.T
        before = (depth > 0).mean(axis=0) >= BEFORE_FRACTION
        moved = np.linalg.norm(allowed.cam2_from_cam1.translation, axis=1)
        return [
            Rigid3(allowed.cam2_from_cam1.rotation[k], allowed.cam2_from_cam1.translation[k] / moved[k])
            for k in np.flatnonzero(before & (moved > 0))
        ]
    return []


def judge(cam_from_first: Rigid3, pixels: np.ndarray, camera: Camera) -> Judged:
    """Optimize a motion from the first frame to the last together with the frames in between.

    Args:
        cam_from_first: |t| = 1.
        pixels: (f, n, 2) of the same points in all frames.
        camera: any model.
    """
    frames, config = len(pixels), BundleConfig(loss=Loss.CAUCHY, max_iterations=JUDGING_ITERATIONS)
    positions = _poses_between(cam_from_first, pixels, camera)
    for _ in range(JUDGING_ROUNDS):
        made = triangulate_points(positions, camera, pixels, max_error_px=PLANE_ERROR_PX)
        good = made.success_mask
        if good.sum() < MIN_TRIANGULATED:
            break
        seen = np.ascontiguousarray(pixels[:, good].swapaxes(0, 1)).reshape(-1, 2)
        problem = _problem(positions, made.points_in_world[good], seen, camera)
        positions = adjust_bundle(with_fixed_gauge(problem), config).rig_from_world
    made = triangulate_points(positions, camera, pixels)
    errors = np.full((frames, pixels.shape[1]), PLANE_ERROR_PX)
    for k in range(frames):
        at = camera.project(positions[k].apply(made.points_in_world))
        off = np.linalg.norm(at - pixels[k], axis=1)
        np.copyto(errors[k], off, where=made.success_mask & (off < PLANE_ERROR_PX))
    last = positions[frames - 1] @ positions[0].inverse()
    angle = (
        float(np.degrees(np.median(made.angles_rad[made.success_mask]))) if made.success_mask.any() else 0.0
    )
    of_points = np.sort(np.log1p(errors**2).mean(axis=0))
    return Judged(last, float(of_points[: round(JUDGED_FRACTION * len(of_points))].mean()), angle)


def _poses_between(cam_from_first: Rigid3, pixels: np.ndarray, camera: Camera) -> Rigid3:
    """cams_from_first (f,): the frames in between are localized in the points of the first and the last."""
    frames = len(pixels)
    ends = Rigid3.stack([Rigid3.identity(), cam_from_first])
    made = triangulate_points(ends, camera, pixels[[0, -1]], min_angle_rad=np.radians(0.1))
    good = made.success_mask
    out, position = [Rigid3.identity()], Rigid3.identity()
    for k in range(1, frames - 1):
        if good.sum() >= MIN_TRIANGULATED:
            for scale in (15.0, 1.0):
                position = refine_pose(
                    made.points_in_world[good], pixels[k][good], camera, position, loss_scale=scale
                ).cam_from_world
        out.append(position)
    out.append(cam_from_first)
    return Rigid3.stack(out)


def _problem(positions: Rigid3, points: np.ndarray, pixels: np.ndarray, camera: Camera) -> BundleProblem:
    """Bundle adjustment of points that all frames observe."""
    frames, count = len(positions), len(points)
    one = np.zeros(frames * count, np.int32)
    return BundleProblem(
        positions,
        Rigid3(np.eye(3)[None], np.zeros((1, 3))),
        np.array([int(camera.model)], np.int32),
        camera.padded_params()[None],
        points.copy(),
        frames * np.arange(count + 1, dtype=np.int64),
        np.tile(np.arange(frames, dtype=np.int32), count),
        one,
        one,
        pixels,
        np.ones((frames, 6)),
        np.zeros((1, len(camera.padded_params()))),
        np.ones(count),
    )


def rival_of(best: Judged, judged: Sequence[Judged]) -> Judged | None:
    """A different motion that fits nearly as well as the best; None if there is none."""
    near = [one for one in judged if one.loss < CLEARLY * best.loss]
    others = [one for one in near if are_apart(one.cam_from_first, best.cam_from_first)]
    return min(others, key=lambda one: one.loss, default=None)


def median_angle_deg(
    cam_from_first: Rigid3, first_px: np.ndarray, pixels: np.ndarray, camera: Camera
) -> float:
    """Median triangulation angle of the points under a motion, in degrees; 0 if none can be triangulated."""
    ends = Rigid3.stack([Rigid3.identity(), cam_from_first])
    made = triangulate_points(ends, camera, np.stack([first_px, pixels]), max_error_px=PLANE_ERROR_PX)
    return (
        float(np.degrees(np.median(made.angles_rad[made.success_mask]))) if made.success_mask.any() else 0.0
    )


def median_off_px(cam_from_first: Rigid3, first_px: np.ndarray, pixels: np.ndarray, camera: Camera) -> float:
    """Median epipolar error of a motion, in pixels (tangent Sampson error: Terekhov and Larsson, ICCV 2023)."""
    length = max(float(np.linalg.norm(cam_from_first.translation)), 1e-12)
    matches = Matches(first_px, pixels, camera, camera)
    off = matches.sampson(cam_from_first.rotation, cam_from_first.translation / length)
    return float(np.nanmedian(np.abs(off)))


def are_apart(
    one: Rigid3, other: Rigid3, rotation_deg: float = LEAST_ROTATION_DEG, angle_deg: float = LEAST_ANGLE_DEG
) -> bool:
    """Whether two motions between the same frames differ in rotation or in the direction of translation."""
    rotation = np.degrees(np.linalg.norm((one @ other.inverse()).log()[3:]))
    lengths = np.linalg.norm(one.translation) * np.linalg.norm(other.translation)
    cosine = float(one.translation @ other.translation) / max(float(lengths), 1e-12)
    return bool(rotation > rotation_deg or cosine < np.cos(np.radians(angle_deg)))
