"""Laws of the camera models: there and back, Jacobians against differences, OpenCV's formulas, compiled = read."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.cameras import _camera_kernels as kernels

WIDTH, HEIGHT = 640, 480
PARAMS = {
    CameraModel.SIMPLE_PINHOLE: [520.0, 321.5, 236.25],
    CameraModel.PINHOLE: [520.0, 498.0, 321.5, 236.25],
    CameraModel.SIMPLE_RADIAL: [520.0, 321.5, 236.25, -0.12],
    CameraModel.RADIAL: [520.0, 321.5, 236.25, 0.08, -0.03],
    CameraModel.OPENCV: [520.0, 498.0, 321.5, 236.25, -0.2, 0.05, 1.5e-3, -2e-3],
    CameraModel.FULL_OPENCV: [
        *(520.0, 498.0, 321.5, 236.25, 0.35, 0.12, 1.5e-3, -2e-3),
        *(0.02, 0.5, 0.15, 0.01),
    ],
    CameraModel.OPENCV_FISHEYE: [260.0, 255.0, 321.5, 236.25, 0.03, -0.01, 4e-3, -1e-3],
}


def mild_lens(model: CameraModel, seed: int) -> np.ndarray:
    """Parameters anywhere, of a distortion that has an inverse in all of the image."""
    rng = np.random.default_rng(seed)
    out = np.empty(model.num_params)
    out[list(model.focal_indices)] = rng.uniform(400.0, 2000.0, len(model.focal_indices))
    out[list(model.principal_point_indices)] = rng.uniform([250.0, 180.0], [390.0, 300.0])
    lens = rng.uniform(-0.03, 0.03, len(model.distortion_indices))
    if model in (CameraModel.OPENCV, CameraModel.FULL_OPENCV):
        lens[2:4] *= 0.05  # decentering is small
    out[list(model.distortion_indices)] = lens
    return out


LENSES = {f"{m.name}-{k}": (m, mild_lens(m, k) if k else PARAMS[m]) for m in CameraModel for k in range(4)}


@pytest.fixture(params=list(LENSES))
def camera(request: pytest.FixtureRequest) -> Camera:
    """The lens above, and three others."""
    model, params = LENSES[request.param]
    return Camera(model, WIDTH, HEIGHT, np.array(params))


def picture_grid() -> np.ndarray:
    """Pixels over the whole image with its corners, and the principal point."""
    u, v = np.meshgrid(np.linspace(-0.5, WIDTH - 0.5, 17), np.linspace(-0.5, HEIGHT - 0.5, 13))
    return np.vstack([np.column_stack([u.ravel(), v.ravel()]), [[321.5, 236.25]]])


def points_in_view(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    pixels = picture_grid()
    return camera.unproject(pixels) * rng.uniform(0.3, 20, (len(pixels), 1))


def differences(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Central differences of f along the last axis of x: (..., rows, columns)."""
    columns = []
    for c, step in enumerate(steps):
        shift = np.zeros(len(steps))
        shift[c] = step
        columns.append((f(x + shift) - f(x - shift)) / (2 * step))
    return np.stack(columns, axis=-1)


def test_every_model_has_parameters_here() -> None:
    assert set(PARAMS) == set(CameraModel)


def test_pixels_there_and_back(camera: Camera, rng: np.random.Generator) -> None:
    pixels = picture_grid()
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-15)
    depth = rng.uniform(0.01, 1e4, (len(pixels), 1))
    np.testing.assert_allclose(camera.project(rays * depth), pixels, atol=1e-9)


def test_points_there_and_back(camera: Camera, rng: np.random.Generator) -> None:
    points = points_in_view(camera, rng)
    rays = camera.unproject(camera.project(points))
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-12)


def test_projection_equals_opencv(camera: Camera, rng: np.random.Generator) -> None:
    points = points_in_view(camera, rng)
    zero = np.zeros(3)
    if camera.model is CameraModel.OPENCV_FISHEYE:
        expected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, camera.params[4:])
    else:
        distortion = np.zeros(8)
        values = camera.params[list(camera.model.distortion_indices)]
        distortion[: len(values)] = values
        expected, _ = cv2.projectPoints(points, zero, zero, camera.K, distortion)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_undistorted_models_are_the_calibration_matrix(rng: np.random.Generator) -> None:
    points = np.column_stack([rng.normal(size=(50, 2)), rng.uniform(1, 9, 50)])
    for model, params in PARAMS.items():
        straight = np.array(params)
        straight[list(model.distortion_indices)] = 0.0
        camera = Camera(model, WIDTH, HEIGHT, straight)
        if model is CameraModel.OPENCV_FISHEYE:  # equidistant: the image radius is f times the angle
            rho = np.linalg.norm(points[:, :2], axis=1)
            seen = points[:, :2] / rho[:, None] * np.arctan2(rho, points[:, 2])[:, None]
        else:
            seen = points[:, :2] / points[:, 2:]
        expected = seen @ camera.K[:2, :2].T + camera.K[:2, 2]
        np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


def test_projection_does_not_depend_on_the_distance(camera: Camera, rng: np.random.Generator) -> None:
    rays = camera.unproject(picture_grid())
    for distance in (1e-6, 1.0, 1e9):
        np.testing.assert_allclose(camera.project(rays * distance), picture_grid(), atol=1e-8)


def test_jacobian_by_points(camera: Camera, rng: np.random.Generator) -> None:
    points = points_in_view(camera, rng)
    pixels, jac_points, _ = camera.project_with_jacobian(points)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-10)
    distance = np.linalg.norm(points, axis=1)[:, None, None]
    # Differences at distance 1, where one step fits all points; the Jacobian falls with the distance.
    expected = differences(camera.project, points / distance[..., 0], np.full(3, 1e-6))
    np.testing.assert_allclose(jac_points * distance, expected, rtol=1e-6, atol=1e-4)
    # Moving along the ray changes nothing.
    np.testing.assert_allclose(jac_points @ points[:, :, None], 0.0, atol=1e-9)


def test_jacobian_by_params(camera: Camera, rng: np.random.Generator) -> None:
    points = points_in_view(camera, rng)
    jac_params = camera.project_with_jacobian(points)[2]
    steps = np.full(len(camera.params), 1e-4)
    steps[list(camera.model.distortion_indices)] = 1e-6
    expected = differences(lambda p: replace(camera, params=p).project(points), camera.params, steps)
    assert jac_params.shape == (len(points), 2, camera.model.num_params)
    np.testing.assert_allclose(jac_params, expected, rtol=1e-6, atol=1e-5)


def test_jacobian_of_unprojection(camera: Camera) -> None:
    pixels = picture_grid()
    rays, jac = camera.unproject_with_jacobian(pixels)
    np.testing.assert_array_equal(rays, camera.unproject(pixels))
    np.testing.assert_allclose(jac, differences(camera.unproject, pixels, np.full(2, 1e-3)), atol=1e-8)
    # A direction stays a unit vector, and projecting undoes unprojecting.
    np.testing.assert_allclose((rays[:, None] @ jac)[:, 0], 0.0, atol=1e-14)
    jac_project = camera.project_with_jacobian(rays)[1]
    np.testing.assert_allclose(jac_project @ jac, np.broadcast_to(np.eye(2), (len(pixels), 2, 2)), atol=1e-11)


@pytest.mark.parametrize("tangential", [0.0, 2e-3])
def test_strong_distortion_comes_back_up_to_its_fold(tangential: float, rng: np.random.Generator) -> None:
    radius = np.linspace(0, 1.5, 60)
    bearing = np.exp(1j * rng.uniform(0, 2 * np.pi, 60))
    for _ in range(200):
        k1, k2 = rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)
        params = np.array([400.0, 400.0, 320.0, 240.0, k1, k2, tangential, -tangential])
        camera = Camera(CameraModel.OPENCV, WIDTH, HEIGHT, params)
        slope = 1 + 3 * k1 * radius**2 + 5 * k2 * radius**4
        folded = np.flatnonzero(slope < 0.1)
        stop = folded[0] if len(folded) else len(radius)
        plane = (radius * bearing)[:stop]
        points = np.column_stack([plane.real, plane.imag, np.ones(stop)])
        rays = camera.unproject(camera.project(points))
        np.testing.assert_allclose(rays / rays[:, 2:], points, atol=1e-7)
        if not (slope < 0).any():
            continue
        # A pixel anywhere has either no ray or one before the fold, never one of the roots beyond it.
        rays = camera.unproject(rng.uniform(-400, 1100, (100, 2)))
        found = rays[np.isfinite(rays[:, 0])]
        fold = np.sqrt(min(r for r in np.roots([5 * k2, 3 * k1, 1]).real if r > 0))
        assert (np.hypot(found[:, 0], found[:, 1]) < 1.06 * fold * found[:, 2]).all()


def test_radii_fold_and_come_back() -> None:
    for d0, d1 in ((-0.3, 0.0), (0.4, -0.1), (0.1, 0.2), (-0.2, 0.05), (0.0, 0.0)):
        fold = kernels.fold_radius(d0, d1)
        if np.isfinite(fold):
            assert 1 + 3 * d0 * fold**2 + 5 * d1 * fold**4 == pytest.approx(0.0, abs=1e-12)
        for r in (0.1, 0.5, 0.7):
            target = r * (1 + d0 * r**2 + d1 * r**4)
            assert kernels.undistorted_radius(d0, d1, fold, target) == pytest.approx(r, rel=1e-10)
