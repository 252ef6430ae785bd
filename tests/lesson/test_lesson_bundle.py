"""The page on bundle adjustment: every step against the same with the whole matrix, the end against the library's."""

from itertools import product

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3, align_points
from epipole.lesson.scenes import ring
from epipole.optim import BundleConfig, BundleProblem, adjust_bundle
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")
CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def sampled(*values):
    """Every value once; all combinations in the whole run."""
    return list(product(*values) if IS_WHOLE else zip(*values, strict=True))


def observed(scene, visible, s):
    """(points, cameras) which is seen, and all pixels (points, cameras, 2)."""
    sight = scene.cams_from_world.centers()[None] - scene.points_in_world[:, None]
    cosines = np.einsum("pcx,px->pc", sight / np.linalg.norm(sight, axis=2, keepdims=True), scene.normals)
    pixels = [
        CAMERA.project(camera.apply(scene.points_in_world)) + s * off
        for camera, off in zip(scene.cams_from_world, scene.pixel_noise)
    ]
    return cosines >= np.cos(np.deg2rad(visible)), np.swapaxes(pixels, 0, 1)


def moved_cameras(cams, steps):
    rotation = Rigid3(Rotation3.exp(steps[:, 3:]).matrix, steps[:, :3])
    return rotation @ cams


def disturbed(scene, off):
    shifts = off * scene.camera_shifts
    shifts[0] = 0.0
    return moved_cameras(scene.cams_from_world, shifts), scene.points_in_world + off * scene.point_shifts


def linearized(cams, points, seen, pixels, *, hold_first=True):
    """Residuals and the whole Jacobian, by cameras (turned from the left) and points."""
    point, camera = np.nonzero(seen)
    there = cams[camera].apply(points[point])
    left = pixels[seen] - CAMERA.project(there)
    x, y, z = there.T
    rows = np.zeros((len(there), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 520.0 / z
    rows[:, 0, 2], rows[:, 1, 2] = -520.0 * x / z**2, -520.0 * y / z**2
    k = np.arange(len(there))
    of_cameras = np.zeros((len(there), 2, len(cams), 6))
    of_cameras[k, :, camera] = np.concatenate([rows, np.cross(there[:, None], rows)], axis=2)
    if hold_first:
        of_cameras[:, :, 0] = 0.0
    of_points = np.zeros((len(there), 2, len(points), 3))
    of_points[k, :, point] = rows @ cams.rotation[camera]
    return left.ravel(), np.hstack([part.reshape(left.size, -1) for part in (of_cameras, of_points)])


def whole_adjustment(cams, points, seen, pixels, count):
    """Levenberg-Marquardt with the whole matrix: costs and dampings of every step, and where it ends."""
    damping, growth = 1e-4, 2.0
    left, J = linearized(cams, points, seen, pixels)
    given = [(0.5 * left @ left, damping)]
    for _ in range(count):
        H, g = J.T @ J, J.T @ left
        D = np.diag(H).copy()
        x = np.zeros(len(g))
        x[6:] = np.linalg.solve((H + damping * np.diag(D))[6:, 6:], g[6:])
        tried = (
            moved_cameras(cams, x[: 6 * len(cams)].reshape(-1, 6)),
            points + x[6 * len(cams) :].reshape(-1, 3),
        )
        candidate, J_there = linearized(*tried, seen, pixels)
        before, after, used = 0.5 * left @ left, 0.5 * candidate @ candidate, damping
        gain = (before - after) / (0.5 * x @ (damping * D * x + g))
        if after <= before and gain > 0:
            (cams, points), left, J = tried, candidate, J_there
            damping, growth = max(1e-9, damping * max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3)), 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        given.append((0.5 * left @ left, used))
    return given


def problem_of(cams, points, seen, pixels):
    """For the library."""
    frame_free = np.ones((len(cams), 6))
    frame_free[0] = 0.0
    count = int(seen.sum())
    return BundleProblem(
        rig_from_world=cams,
        cam_from_rig=Rigid3.identity(1),
        camera_model=np.array([int(CAMERA.model)], np.int32),
        camera_params=CAMERA.padded_params()[None],
        points_in_world=points,
        offsets=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        frame=np.nonzero(seen)[1].astype(np.int32),
        sensor=np.zeros(count, np.int32),
        camera=np.zeros(count, np.int32),
        pixels=pixels[seen],
        frame_free=frame_free,
        params_free=np.zeros((1, 12)),
        point_free=np.ones(len(points)),
    )


def camera_error(cams, scene):
    found, truth = cams.centers(), scene.cams_from_world.centers()
    off = align_points(found, truth).apply(found) - truth
    return np.sqrt((off**2).sum(axis=1).mean())


def close(found, wanted, size=1.0):
    """To 1e-9 of itself, or of the size of what it is made from."""
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * size)


def test_every_step_is_that_of_the_whole_matrix(tab):
    tab.open("08_bundle.html")
    scene = ring()
    for visible, s, off in sampled((55.0, 80.0), (0.25, 2.0), (0.5, 0.1)):
        seen, pixels = observed(scene, visible, s)
        start = disturbed(scene, off)
        steps = whole_adjustment(*start, seen, pixels, 12)
        tab.set(visible=visible, s=s, off=off)
        for step in (0, 3, 12):
            tab.set(step=step)
            shown, (cost, damping) = tab.shown(), steps[step]
            close(shown["cost"], cost)
            if step < 12:  # at the end rounding says whether a step lowers the cost
                close(shown["damping"], damping)
            close(shown["rms"], np.sqrt(cost / seen.sum()))
            assert [shown["residuals"], shown["unknowns"]] == [2 * seen.sum(), 234]


def test_it_ends_where_the_library_ends(tab):
    tab.open("08_bundle.html")
    scene = ring()
    # Twelve steps bring a start to its end to nine digits where the noise is not large.
    for visible, s, off in sampled((65.0, 80.0), (0.25, 1.0), (0.3, 0.1)):
        seen, pixels = observed(scene, visible, s)
        tab.set(step=12, visible=visible, s=s, off=off)
        problem = problem_of(*disturbed(scene, off), seen, pixels)
        shown, found = tab.shown(), adjust_bundle(problem, BundleConfig(function_tolerance=0.0))
        close(shown["cost"], found.final_cost)
        close(shown["cameras_off"], camera_error(found.rig_from_world, scene))


def test_what_is_not_zero(tab):
    tab.open("08_bundle.html")
    scene = ring()
    for visible in (55.0, 70.0, 88.0):
        seen, pixels = observed(scene, visible, 0.5)
        tab.set(step=3, visible=visible, s=0.5, off=0.3)
        shown = tab.shown()
        _, J = linearized(*disturbed(scene, 0.3), seen, pixels, hold_first=False)
        together = seen.T.astype(int) @ seen > 0
        used = np.add.reduceat(np.abs(J), [*range(0, 60, 6), *range(60, 240, 3)], axis=1) > 0
        filled = (used * ([6] * 10 + [3] * 60)).sum() / J.size
        close([shown["filled"], shown["filled_s"]], [100 * filled, 100 * together.mean()])
