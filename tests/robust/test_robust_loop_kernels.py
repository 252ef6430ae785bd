"""The robust loop, for every kind of problem, against the interpreter."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.robust import _absolute_pose_kernels as absolute_kernels
from epipole.robust import _loop_kernels as loop
from epipole.robust import (
    absolute_pose,
    estimate,
    estimate_absolute_pose,
    estimate_essential_matrix,
    estimate_fundamental_matrix,
    estimate_homography,
    estimate_motion_and_focals,
    estimate_motion_and_shared_focal,
    estimate_pose_and_focal,
    estimate_relative_pose,
    estimate_rig_pose,
    estimate_rigid,
    estimate_similarity,
    estimate_upright_motion,
    estimate_upright_pose,
    estimate_upright_similarity,
)
from epipole.robust.pairs import _pair_kernels as pair_kernels
from epipole.robust.pairs import batch as pair_batch
from epipole.robust.pairs import two_view
from epipole.robust.pairs._fundamental_kernels import EPIPOLE, SENSE
from epipole.robust.pairs._wide_pair_kernels import fit_wide_motions
from kernel_references import assert_same, assert_same_as_python, both_ways, record_calls, reference_of
from whole import IS_WHOLE

PINHOLE = Camera(CameraModel.PINHOLE, 1000, 800, np.array([900.0, 900.0, 499.5, 399.5]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 1000, 800, np.array([300.0, 310.0, 500.0, 400.0, 0.01, 0, 0, 0]))
CENTER = np.array([499.5, 399.5])
TURN = Rigid3.exp(np.array([-1.0, 0.1, 0.2, 0.0, 0.25, 0.0]))  # about the vertical, for cameras that know it
DOWN = np.array([0.0, 1.0, 0.0])
FEW = RansacConfig(max_error_px=3.0, min_iterations=3, max_iterations=6, min_inliers=8)
# Sums may be taken in any order (`reassoc`), and a descent stops when it gains little.
ORDER = {"rtol": 1e-5, "of_largest": 1e-6}

BEST = 8  # among the loop's arguments


def scene(count: int = 24, plane: bool = False) -> np.ndarray:
    points = np.random.default_rng(3).uniform([-2, -1.6, 4], [2, 1.6, 8], (count, 3))
    if plane:
        points[:, 2] = 5 + 0.3 * points[:, 0]
    return points


def seen(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels with noise, every fourth of them wrong."""
    rng = np.random.default_rng(len(points))
    pixels = camera.project(points) + 0.4 * rng.normal(size=(len(points), 2))
    pixels[::4] = rng.uniform(0, [999, 799], (len(pixels[::4]), 2))
    return pixels


def two_views(camera: Camera = PINHOLE, plane: bool = False) -> tuple[np.ndarray, np.ndarray]:
    points = scene(plane=plane)
    return camera.project(points), seen(camera, TURN.apply(points))


def with_quality() -> np.ndarray:
    return np.where(np.arange(24) % 4 == 0, 0.0, 1.0) + 0.01 * np.arange(24)


def of_rig() -> Any:
    rig = Rigid3.exp(np.array([np.zeros(6), [0.3, 0, 0, 0, 0.1, 0]]))
    index = np.arange(24) % 2
    in_rig = TURN.apply(scene())
    pixels = np.where((index == 0)[:, None], seen(PINHOLE, in_rig), seen(FISHEYE, rig[1].apply(in_rig)))
    return estimate_rig_pose(scene(), pixels, index, [PINHOLE, FISHEYE], rig, FEW)


def moved(scale: float) -> tuple[np.ndarray, np.ndarray, RansacConfig]:
    rng = np.random.default_rng(8)
    target = scale * TURN.apply(scene()) + 0.01 * rng.normal(size=(24, 3))
    target[::4] = rng.normal(size=(6, 3))
    return scene(), target, RansacConfig(max_error_px=0.1, min_iterations=3, max_iterations=6, min_inliers=8)


PROBLEMS: dict[str, Callable[[], Any]] = {
    "absolute pose": lambda: estimate_absolute_pose(
        scene(), seen(FISHEYE, TURN.apply(scene())), FISHEYE, FEW
    ),
    "absolute pose, ranked": lambda: estimate_absolute_pose(
        scene(), seen(PINHOLE, TURN.apply(scene())), PINHOLE, FEW, quality=with_quality()
    ),
    "rig pose": of_rig,
    "upright pose": lambda: estimate_upright_pose(
        scene(), seen(PINHOLE, TURN.apply(scene())), PINHOLE, DOWN, DOWN, FEW
    ),
    "pose and focal": lambda: estimate_pose_and_focal(
        scene(), seen(PINHOLE, TURN.apply(scene())), CENTER, FEW
    ),
    "relative pose": lambda: estimate_relative_pose(*two_views(), PINHOLE, PINHOLE, FEW),
    "relative pose, ranked": lambda: estimate_relative_pose(
        *two_views(), PINHOLE, PINHOLE, FEW, quality=with_quality()
    ),
    "wide motion": lambda: estimate_relative_pose(*two_views(FISHEYE), FISHEYE, FISHEYE, FEW),
    "essential": lambda: estimate_essential_matrix(*two_views(), PINHOLE, PINHOLE, FEW),
    "upright motion": lambda: estimate_upright_motion(*two_views(), PINHOLE, PINHOLE, (DOWN, DOWN), FEW),
    "fundamental": lambda: estimate_fundamental_matrix(*two_views(), FEW),
    "plane": lambda: estimate_fundamental_matrix(*two_views(plane=True), FEW),
    "homography": lambda: estimate_homography(*two_views(plane=True), FEW),
    "shared focal": lambda: estimate_motion_and_shared_focal(*two_views(), CENTER, FEW),
    "two focals": lambda: estimate_motion_and_focals(*two_views(), CENTER, CENTER, FEW),
    "rigid": lambda: estimate_rigid(*moved(1.0)),
    "similarity": lambda: estimate_similarity(*moved(2.5)),
    "upright similarity": lambda: estimate_upright_similarity(*moved(2.5)),
    "nothing agrees": lambda: estimate_homography(
        np.zeros((9, 2)), np.random.default_rng(1).normal(size=(9, 2)), FEW
    ),
}


CALLERS = {
    loop.ransac: estimate,
    pair_kernels.fit_motions: pair_batch,
    fit_wide_motions: pair_batch,
    pair_kernels.fit_fundamentals: two_view,
    pair_kernels.fit_homographies: two_view,
}


@pytest.mark.parametrize("name", [name for name in PROBLEMS if IS_WHOLE or name != "wide motion"])
@reference_of(
    loop.ransac,
    pair_kernels.fit_motions,
    fit_wide_motions,
    pair_kernels.fit_fundamentals,
    pair_kernels.fit_homographies,
)
def test_searches(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    calls = {kernel: record_calls(monkeypatch, module, kernel) for kernel, module in CALLERS.items()}
    PROBLEMS[name]()
    assert any(calls.values())
    for kernel, recorded in calls.items():
        for arguments in recorded:
            ours, theirs = both_ways(kernel, *arguments)
            if "focal" in name:
                for _, after in (ours, theirs):
                    turn_epipole(after[BEST])
            # A model takes the first numbers of its row.
            assert_same(ours, theirs, only_written=True, **ORDER)


def turn_epipole(model: np.ndarray) -> None:
    """Epipole and sense of the lines count together: the sign of either alone is rounding's."""
    sign = np.sign(model[SENSE])
    model[SENSE : EPIPOLE + 3] *= sign


def unproject_and_turn(
    camera: Camera, cam_from_rig: Rigid3, points: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """Points, rays and J, all in the rig, and where the camera is there; (15, n)."""
    rays = camera.unproject(pixels)
    _, jacobian, _ = camera.project_with_jacobian(rays)
    rotation = cam_from_rig.rotation
    origin = np.broadcast_to(cam_from_rig.inverse().translation, points.shape)
    return np.hstack([points, rays @ rotation, (jacobian @ rotation).reshape(-1, 6), origin]).T


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@reference_of(absolute_kernels.pack_rays)
def test_rays_are_packed(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, camera: Camera) -> None:
    points, pixels = rng.normal(size=(7, 3)), rng.uniform(0, 800, (7, 2))
    pixels[3], pixels[4] = np.nan, 1e9
    cam_from_rig = TURN
    position = np.append(cam_from_rig.rotation.ravel(), cam_from_rig.translation)
    arguments = (int(camera.model), camera.padded_params(), position, points, pixels)
    for order in (np.array([5, 3, 0, 4, 6]), np.array([2]), np.empty(0, np.int64)):
        items = np.empty((absolute_pose.ROWS, len(order)))
        _, (*_, items) = assert_same_as_python(absolute_kernels.pack_rays, *arguments, order, items)
        expected = unproject_and_turn(camera, cam_from_rig, points[order], pixels[order])
        seen_mask = np.isfinite(expected).all(axis=0)
        np.testing.assert_array_equal(np.isfinite(items).all(axis=0), seen_mask)
        np.testing.assert_allclose(items[:, seen_mask], expected[:, seen_mask], rtol=1e-9, atol=1e-9)
