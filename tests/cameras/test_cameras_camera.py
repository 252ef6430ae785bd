"""One camera: what it accepts, what it cannot see, and how it follows its image's size."""

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from epipole.cameras import MAX_PARAMS, Camera, CameraModel, camera_model_named
from epipole.errors import ConfigError, EpipoleError, ShapeError

PINHOLE = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 400.0, 320.0, 240.0]))
FISHEYE = Camera(
    CameraModel.OPENCV_FISHEYE, 640, 480, np.array([200.0, 200.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0])
)


def simple_radial(k: float) -> Camera:
    return Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([400.0, 320.0, 240.0, k]))


def test_known_pixels() -> None:
    pixels = PINHOLE.project([[0.0, 0.0, 5.0], [1.0, 0.5, 2.0]])
    np.testing.assert_allclose(pixels, [[320.0, 240.0], [570.0, 340.0]])
    np.testing.assert_allclose(PINHOLE.K, [[500, 0, 320], [0, 400, 240], [0, 0, 1]])
    assert PINHOLE.focal_px == 450.0
    np.testing.assert_allclose(PINHOLE.padded_params(), [500, 400, 320, 240, *[0] * 8])


def test_brown_radial_by_hand() -> None:
    # a = 0.5, r2 = 0.25: u = 400 * 0.5 * (1 + 0.4 * 0.25) + 320.
    np.testing.assert_allclose(simple_radial(0.4).project([[1.0, 0.0, 2.0]]), [[540.0, 240.0]])


def test_fisheye_sees_beside_and_behind_itself() -> None:
    directions = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, -1.0], [0.0, 0.0, 3.0]])
    expected = [[320 + 200 * np.pi / 2, 240.0], [320.0, 240 - 200 * 3 * np.pi / 4], [320.0, 240.0]]
    np.testing.assert_allclose(FISHEYE.project(directions), expected)
    rays = FISHEYE.unproject(expected)
    np.testing.assert_allclose(
        rays, directions / np.linalg.norm(directions, axis=1, keepdims=True), atol=1e-12
    )


def test_points_that_cannot_be_seen_are_nan() -> None:
    points = [[0.0, 0.0, -1.0], [0.1, 0.2, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.nan], [0.0, 0.0, 1.0]]
    pixels, jac_points, jac_params = PINHOLE.project_with_jacobian(points)
    seen = [False, False, False, False, True]
    for values in (PINHOLE.project(points), pixels):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), seen)
    assert np.isnan(jac_points[[0, 1]]).all() and np.isnan(jac_params[[0, 1]]).all()
    assert np.isfinite(jac_points[4]).all() and np.isfinite(jac_params[4]).all()


def test_fisheye_cannot_see_its_own_center_nor_straight_back() -> None:
    points = [[0.0, 0.0, 0.0], [0.0, 0.0, -2.0], [np.nan, 0.0, 1.0], [0.0, 0.0, 2.0]]
    seen = [False, False, False, True]
    pixels, jac_points, _ = FISHEYE.project_with_jacobian(points)
    np.testing.assert_array_equal(np.isfinite(FISHEYE.project(points)).all(axis=1), seen)
    np.testing.assert_array_equal(np.isfinite(pixels).all(axis=1), seen)
    np.testing.assert_array_equal(np.isfinite(jac_points).all(axis=(1, 2)), seen)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_fisheye_jacobian_holds_in_any_unit_of_length(scale: float) -> None:
    point = np.array([[0.3, -0.2, 1.0], [0.1, 0.4, -0.8]])
    at_one = FISHEYE.project_with_jacobian(point)
    scaled = FISHEYE.project_with_jacobian(point * scale)
    np.testing.assert_allclose(scaled[0], at_one[0])
    np.testing.assert_allclose(scaled[1] * scale, at_one[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(scaled[2], at_one[2], rtol=1e-9, atol=1e-9)


def test_fisheye_jacobian_on_and_beside_the_axis() -> None:
    jac = FISHEYE.project_with_jacobian([[0.0, 0.0, 2.0], [1e-10, 0.0, 2.0], [1e-6, 0.0, 2.0]])[1]
    expected = np.array([[100.0, 0.0, 0.0], [0.0, 100.0, 0.0]])
    np.testing.assert_allclose(jac, np.broadcast_to(expected, (3, 2, 3)), rtol=1e-6, atol=1e-3)


def test_where_the_distortion_folds_there_is_no_ray() -> None:
    # k = -0.4: r (1 - 0.4 r^2) is greatest, 0.6086, at r = 0.9129; 400 times that is 243.4 pixels.
    camera = simple_radial(-0.4)
    rays = camera.unproject([[320 + 243.0, 240.0], [320 + 244.0, 240.0], [np.nan, 240.0]])
    np.testing.assert_array_equal(np.isfinite(rays).all(axis=1), [True, False, False])
    assert rays[0, 0] / rays[0, 2] < 0.9129
    rays, jac = camera.unproject_with_jacobian([[330.0, 240.0], [320 + 300.0, 240.0]])
    assert np.isfinite(jac[0]).all() and np.isnan(jac[1]).all()


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda m: m.name)
@pytest.mark.parametrize("count", [0, 1, 3])
def test_any_number_of_points(model: CameraModel, count: int) -> None:
    camera = Camera(model, 64, 48, model.initial_params(50.0, 64, 48))
    points = np.tile([0.0, 0.0, 2.0], (count, 1))
    pixels, jac_points, jac_params = camera.project_with_jacobian(points)
    np.testing.assert_allclose(pixels, np.tile([31.5, 23.5], (count, 1)))
    assert jac_points.shape == (count, 2, 3) and jac_params.shape == (count, 2, model.num_params)
    rays, jac = camera.unproject_with_jacobian(pixels)
    np.testing.assert_allclose(rays, np.tile([0.0, 0.0, 1.0], (count, 1)), atol=1e-15)
    assert jac.shape == (count, 3, 2)


def test_arguments_are_not_written_to() -> None:
    points = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, -1.0]])
    before, params = points.copy(), PINHOLE.params.copy()
    PINHOLE.project_with_jacobian(points)
    PINHOLE.scaled_to(320, 240)
    np.testing.assert_array_equal(points, before)
    np.testing.assert_array_equal(PINHOLE.params, params)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match="points_in_cam"):
        PINHOLE.project(np.zeros((4, 2)))
    with pytest.raises(ShapeError, match=r"pixels.*transpose"):
        PINHOLE.unproject(np.zeros((2, 7)))
    with pytest.raises(ShapeError, match="pixels"):
        PINHOLE.unproject([320.0, 240.0])


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ([500.0, 320.0, 240.0], "4 parameters"),
        ([500.0, np.nan, 320.0, 240.0], "fy"),
        ([500.0, 500.0, np.inf, 240.0], "cx"),
        ([500.0, -1.0, 320.0, 240.0], "focal length must be positive, got -1"),
        ([0.0, 500.0, 320.0, 240.0], "focal length must be positive, got 0"),
    ],
)
def test_wrong_parameters_are_refused(params: list[float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Camera(CameraModel.PINHOLE, 640, 480, np.array(params))


@pytest.mark.parametrize("size", [(0, 480), (640, -1)])
def test_a_picture_has_pixels(size: tuple[int, int]) -> None:
    with pytest.raises(ConfigError, match="size"):
        Camera(CameraModel.PINHOLE, *size, np.array([500.0, 500.0, 320.0, 240.0]))


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (320, 480)])
def test_scaling_keeps_the_edges_of_the_picture(size: tuple[int, int]) -> None:
    scaled = PINHOLE.scaled_to(*size)
    assert (scaled.width, scaled.height) == size
    corners = np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]])
    moved = (corners + 0.5) * np.array(size) / (640, 480) - 0.5
    np.testing.assert_allclose(scaled.unproject(moved), PINHOLE.unproject(corners), atol=1e-14)


def test_scaling_keeps_the_distortion() -> None:
    camera = simple_radial(-0.1)
    half = camera.scaled_to(320, 240)
    points = np.array([[0.3, -0.2, 1.0], [0.1, 0.4, 1.2]])
    np.testing.assert_allclose(half.project(points), (camera.project(points) + 0.5) / 2 - 0.5)


def test_models_by_name() -> None:
    for model in CameraModel:
        assert camera_model_named(f" {model.name.lower()} ") is model
    with pytest.raises(ConfigError, match="SIMPLE_RADIAL"):
        camera_model_named("pin hole")


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda m: m.name)
def test_parameters_are_accounted_for(model: CameraModel) -> None:
    indices = [*model.focal_indices, *model.principal_point_indices, *model.distortion_indices]
    assert sorted(indices) == list(range(model.num_params)) and model.num_params <= MAX_PARAMS
    names = model.param_names
    assert [names[i] for i in model.principal_point_indices] == ["cx", "cy"]
    assert all(names[i].startswith("f") for i in model.focal_indices)
    assert all(names[i][0] in "kp" for i in model.distortion_indices)


def test_model_numbers_are_those_of_colmap() -> None:
    numbers = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4}
    numbers |= {"OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
    assert {m.name: int(m) for m in CameraModel} == numbers


def test_the_text_of_a_camera_tells_its_parameters() -> None:
    assert repr(PINHOLE) == "Camera(PINHOLE, 640x480, fx 500, fy 400, cx 320, cy 240)"


def test_a_model_by_its_name_or_number_and_parameters_in_any_sequence() -> None:
    wanted = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 400, 320, 240]))
    for model in ("PINHOLE", " pinhole", 1):
        found = Camera(model, 640, 480, (500, 400, 320, 240))
        assert found.model is CameraModel.PINHOLE and repr(found) == repr(wanted)
        np.testing.assert_array_equal(found.project([[0.1, 0.2, 1.0]]), wanted.project([[0.1, 0.2, 1.0]]))
    assert repr(replace(wanted, width=9)) == "Camera(PINHOLE, 9x480, fx 500, fy 400, cx 320, cy 240)"
    assert repr(pickle.loads(pickle.dumps(wanted))) == repr(wanted)


@pytest.mark.parametrize(
    ("model", "params", "words"),
    [
        ("PINHOL", [1.0], "unknown camera model 'PINHOL': use one of SIMPLE_PINHOLE, PINHOLE"),
        (99, [1.0], "model must be one of SIMPLE_PINHOLE, .*, got 99"),
        ("PINHOLE", [1.0, 2.0], r"PINHOLE has 4 parameters \(fx, fy, cx, cy\), got 2"),
        ("PINHOLE", "1,2,3,4", "params must be an array of numbers"),
        ("PINHOLE", None, "params must be an array of numbers"),
    ],
)
def test_what_is_no_camera(model: object, params: object, words: str) -> None:
    with pytest.raises(EpipoleError, match=words):
        Camera(model, 640, 480, params)


K = np.array([[500.0, 0.0, 320.5], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), CameraModel.PINHOLE),
        (np.zeros((1, 5)), CameraModel.PINHOLE),
        ([-0.1, 0.02, 1e-3, -2e-3], CameraModel.OPENCV),
        ([-0.1, 0.02, 1e-3, -2e-3, 0.0], CameraModel.OPENCV),
        ([-0.1, 0.02, 1e-3, -2e-3, 0.01], CameraModel.FULL_OPENCV),
        ([-0.1, 0.02, 1e-3, -2e-3, 0.01, 0.1, -0.01, 2e-3, *[0.0] * 6], CameraModel.FULL_OPENCV),
    ],
)
def test_a_camera_of_opencv_projects_as_opencv_does(distortion, model, rng) -> None:
    camera = Camera.from_K(K, (640, 480), distortion)
    points = rng.uniform([-1, -0.7, 3], [1, 0.7, 5], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.ravel(distortion))
    assert camera.model is model
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_a_fisheye_of_opencv_projects_as_opencv_does(rng) -> None:
    coefficients = np.array([0.05, -0.01, 2e-3, -1e-3])
    camera = Camera.from_K(K, (640, 480), coefficients, is_fisheye=True)
    points = rng.uniform([-1, -0.7, 1], [1, 0.7, 5], (50, 3))
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, coefficients)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_what_is_no_calibration_of_opencv_is_refused() -> None:
    for matrix in (K + np.eye(3, k=1), 2 * K, np.full((3, 3), np.nan), K.T):
        with pytest.raises(ConfigError, match="K must be"):
            Camera.from_K(matrix, (640, 480))
    with pytest.raises(ShapeError, match="K must be"):
        Camera.from_K(K[:2], (640, 480))
    with pytest.raises(ConfigError, match="12 nonzero coefficients"):
        Camera.from_K(K, (640, 480), np.full(12, 0.01))
    with pytest.raises(ConfigError, match="5 nonzero coefficients"):
        Camera.from_K(K, (640, 480), np.full(5, 0.01), is_fisheye=True)
    with pytest.raises(ConfigError, match="finite"):
        Camera.from_K(K, (640, 480), [np.nan] * 4)
