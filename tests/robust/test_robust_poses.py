"""Poses beyond the plain one: rigs, verticals, unknown focal length; alignment; PROSAC; covariance by simulation."""

import numpy as np
import pytest
from scipy.stats import chi2

from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.errors import ShapeError
from epipole.geometry import Rigid3, Rotation3, Similarity3, from_homogeneous, sampson_error, to_homogeneous
from epipole.robust import (
    Reason,
    estimate_absolute_pose,
    estimate_fundamental_matrix,
    estimate_homography,
    estimate_pose_and_focal,
    estimate_relative_pose,
    estimate_rig_pose,
    estimate_rigid,
    estimate_similarity,
    estimate_upright_motion,
    estimate_upright_pose,
    estimate_upright_similarity,
)
from epipole.synthetic.problems import absolute_pose_problem, dominant_plane_problem, two_view_problem
from whole import IS_WHOLE

CAMERA = Camera(CameraModel.PINHOLE, 1280, 960, np.array([800.0, 800.0, 639.5, 479.5]))
TRIALS = 100 if IS_WHOLE else 50


def angle_deg(a, b):
    return np.degrees((Rotation3(a.rotation) @ Rotation3(b.rotation).inverse()).angle_rad())


def within_band(squared, freedom):
    """Normalized squared errors whose 90 and 99 % quantiles are the chi-square ones, to what `TRIALS` can tell."""
    for level in (0.9, 0.99):
        inside = np.mean(np.array(squared) < chi2.ppf(level, freedom))
        assert abs(inside - level) < 4.0 * np.sqrt(level * (1 - level) / TRIALS) + 0.01, (level, inside)


def test_covariance_of_an_absolute_pose_covers_the_truth():
    squared = []
    for seed in range(TRIALS):
        p = absolute_pose_problem(120, 0.2, 1.0, seed)
        found = estimate_absolute_pose(p.points_in_world, p.pixels, p.camera, RansacConfig(max_error_px=4))
        xi = (p.cam_from_world @ found.model.inverse()).log()
        squared.append(xi @ np.linalg.solve(found.covariance, xi))
        assert 0.8 < found.noise_px < 1.2
    within_band(squared, 6)


def test_covariance_of_a_relative_pose_covers_the_truth():
    """Of matches that are all right: wrong ones that lie on their line by chance are in no covariance."""
    squared = []
    for seed in range(TRIALS):
        p = two_view_problem(100, 0.0, 0.7, seed)
        found = estimate_relative_pose(
            p.pixels1, p.pixels2, p.camera1, p.camera2, RansacConfig(max_error_px=3)
        )
        truth = p.cam2_from_cam1
        # The shortest change: a rotation from the left, and the direction's step.
        phi = (Rotation3(truth.rotation) @ Rotation3(found.model.rotation).inverse()).log()
        rho = truth.translation - found.model.translation - np.cross(phi, found.model.translation)
        xi = np.concatenate([rho, phi])
        assert np.linalg.matrix_rank(found.covariance, tol=1e-9 * np.trace(found.covariance)) == 5
        squared.append(xi @ np.linalg.pinv(found.covariance, rcond=1e-8, hermitian=True) @ xi)
    within_band(squared, 5)


def test_covariance_of_a_homography_covers_the_truth(rng):
    H = np.array([[1.05, 0.02, 12.0], [-0.03, 0.98, -7.0], [2e-5, -1e-5, 1.0]])
    unit = H / np.linalg.norm(H)
    scale = np.diag([1.0, 1.0, 1e-3])  # entries of one size
    squared = []
    for _ in range(TRIALS):
        x1 = rng.uniform(0, 1000, (100, 2))
        x2 = from_homogeneous(to_homogeneous(x1) @ H.T) + 0.8 * rng.normal(size=(100, 2))
        found = estimate_homography(x1, x2, RansacConfig(max_error_px=4))
        sign = np.sign((found.model * unit).sum())
        error = (sign * unit - found.model).ravel()
        grow = np.kron(np.linalg.inv(scale), scale).diagonal()
        covariance = grow[:, None] * found.covariance * grow
        values, vectors = np.linalg.eigh(covariance)
        along = vectors[:, 1:].T @ (grow * error)
        squared.append((along**2 / values[1:]).sum())
    within_band(squared, 8)


def test_covariance_of_an_alignment_covers_the_truth(rng):
    truth = Similarity3(np.asarray(2.5), Rotation3.exp(rng.normal(size=3)).matrix, 5 * rng.normal(size=3))
    squared = []
    for seed in range(TRIALS):
        x = rng.normal(size=(80, 3))
        y = truth.apply(x) + 0.05 * rng.normal(size=x.shape)
        y[:20] = 10 * rng.normal(size=(20, 3))
        found = estimate_similarity(x, y, RansacConfig(max_error_px=0.3, seed=seed))
        xi = (truth @ found.model.inverse()).log()
        squared.append(xi @ np.linalg.solve(found.covariance, xi))
    within_band(squared, 7)


def upright_similarity(rng):
    heading = Rotation3.exp(np.array([0.0, 0.0, rng.uniform(-3, 3)]))
    return Similarity3(np.asarray(2.5), heading.matrix, 5 * rng.normal(size=3))


def test_covariance_of_an_upright_similarity_covers_the_truth(rng):
    truth, squared = upright_similarity(rng), []
    for seed in range(TRIALS):
        x = rng.normal(size=(80, 3))
        y = truth.apply(x) + 0.05 * rng.normal(size=x.shape)
        y[:20] = 10 * rng.normal(size=(20, 3))
        found = estimate_upright_similarity(x, y, RansacConfig(max_error_px=0.3, seed=seed))
        np.testing.assert_array_equal(found.model.rotation[2], [0.0, 0.0, 1.0])
        xi = (truth @ found.model.inverse()).log()
        squared.append(xi @ np.linalg.pinv(found.covariance, rcond=1e-9) @ xi)
    within_band(squared, 5)


def test_a_straight_path_tells_an_upright_similarity_and_a_plumb_line_does_not(rng):
    truth = upright_similarity(rng)
    x = np.outer(np.linspace(0, 3, 30), [1.0, 0.5, 0.2])
    y = truth.apply(x) + 0.01 * rng.normal(size=x.shape)
    y[:12] = 5 * rng.normal(size=(12, 3))
    found = estimate_upright_similarity(x, y, RansacConfig(max_error_px=0.05))
    assert found.success and not found.inlier_mask[:12].any()
    assert np.abs(found.model.apply(x) - truth.apply(x)).max() < 0.02  # 18 points with 0.01 of noise
    plumb = np.outer(np.arange(30.0), [0.0, 0.0, 1.0])
    assert estimate_upright_similarity(plumb, plumb).reason is Reason.NO_MODEL
    assert estimate_upright_similarity(x[:1], y[:1]).reason is Reason.TOO_FEW


def test_rigid_motion_is_found_among_outliers(rng):
    truth = Rigid3.exp(rng.normal(size=6))
    x = rng.normal(size=(200, 3))
    y = truth.apply(x) + 0.01 * rng.normal(size=x.shape)
    y[:120] = 3 * rng.normal(size=(120, 3))
    found = estimate_rigid(x, y, RansacConfig(max_error_px=0.05))
    assert found.success and found.num_inliers >= 75
    assert np.abs((truth @ found.model.inverse()).log()).max() < 0.01
    line = np.outer(np.arange(30.0), [1.0, 2.0, 3.0])
    assert not estimate_rigid(line, line).success


def test_a_rig_is_placed_by_the_rays_of_all_its_cameras(rng):
    fisheye = Camera(
        CameraModel.OPENCV_FISHEYE, 1000, 1000, np.array([320.0, 320, 499.5, 499.5, 0.02, -0.01, 0.002, 0.0])
    )
    cameras = [CAMERA, fisheye, CAMERA]
    cams_from_rig = Rigid3.exp(
        np.array([[0.3, 0, 0, 0, 0.8, 0], [-0.3, 0, 0.1, 0, -0.9, 0.1], [0, 0.2, 0, 0.3, 0, 0]])
    )
    truth = Rigid3.exp(0.3 * rng.normal(size=6))
    points, pixels, index = [], [], []
    for c, camera in enumerate(cameras):
        inside = rng.uniform([-1, -0.8, 4], [1, 0.8, 8], (60, 3))
        points.append(truth.inverse().apply(cams_from_rig[c].inverse().apply(inside)))
        pixels.append(camera.project(inside) + 0.5 * rng.normal(size=(60, 2)))
        pixels[-1][:25] = rng.uniform(0, 900, (25, 2))
        index.append(np.full(60, c))
    found = estimate_rig_pose(
        np.concatenate(points), np.concatenate(pixels), np.concatenate(index), cameras, cams_from_rig
    )
    assert found.success and found.num_inliers >= 100
    xi = (truth @ found.model.inverse()).log()
    assert np.abs(xi).max() < 5e-3
    assert xi @ np.linalg.solve(found.covariance, xi) < chi2.ppf(0.9999, 6)
    with pytest.raises(ShapeError):
        estimate_rig_pose(points[0], pixels[0], np.full(60, 3), cameras, cams_from_rig)


@pytest.mark.parametrize("tilt_deg", [0.0, 0.5])
def test_a_known_vertical_needs_fewer_samples(tilt_deg):
    """The refined pose is as good as without, even where the vertical is half a degree off."""
    p = absolute_pose_problem(400, 0.7, 1.0, 3)
    tilt = Rotation3.exp(np.radians(tilt_deg) * np.array([1.0, 0.0, 0.0]))
    down_in_cam = tilt.apply(p.cam_from_world.rotation @ np.array([0.0, 0.0, -1.0]))
    config = RansacConfig(max_error_px=3, min_iterations=10, min_inlier_ratio=0.1)
    free = estimate_absolute_pose(p.points_in_world, p.pixels, p.camera, config)
    upright = estimate_upright_pose(p.points_in_world, p.pixels, p.camera, down_in_cam, config=config)
    assert upright.success and upright.num_iterations < free.num_iterations
    assert np.abs((upright.model @ free.model.inverse()).log()).max() < 1e-3
    np.testing.assert_allclose(upright.covariance, free.covariance, rtol=0.05, atol=1e-9)


@pytest.mark.parametrize("tilt_deg", [0.0, 0.3])
def test_known_verticals_of_two_cameras(tilt_deg):
    p = two_view_problem(400, 0.6, 0.7, 5)
    down1 = np.array([0.1, 0.95, -0.2])
    tilt = Rotation3.exp(np.radians(tilt_deg) * np.array([0.0, 0.0, 1.0]))
    down2 = tilt.apply(p.cam2_from_cam1.rotation @ down1)
    config = RansacConfig(max_error_px=2, min_iterations=10, min_inlier_ratio=0.1)
    free = estimate_relative_pose(p.pixels1, p.pixels2, CAMERA, CAMERA, config)
    upright = estimate_upright_motion(p.pixels1, p.pixels2, CAMERA, CAMERA, (down1, down2), config)
    assert upright.success and upright.num_iterations < free.num_iterations
    assert angle_deg(upright.model, free.model) < 0.02
    with pytest.raises(ShapeError):
        estimate_upright_motion(p.pixels1, p.pixels2, CAMERA, CAMERA, (np.zeros(3), down2), config)


def test_pose_and_focal_length_are_found_together():
    squared = []
    for seed in range(40):
        p = absolute_pose_problem(150, 0.4, 0.7, seed)
        found = estimate_pose_and_focal(
            p.points_in_world, p.pixels, p.camera.K[:2, 2], RansacConfig(max_error_px=3)
        )
        assert found.success
        assert abs(found.model.focal_px / 800.0 - 1.0) < 0.03
        xi = (p.cam_from_world @ found.model.cam_from_world.inverse()).log()
        error = np.append(xi, np.log(800.0 / found.model.focal_px))
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert 4.0 < np.mean(squared) < 11.0


def test_a_slanted_plane_tells_the_focal_length_and_a_parallel_one_says_it_does_not(rng):
    for seed in range(4):
        p = absolute_pose_problem(100, 0.0, 0.5, seed, planar=True)
        found = estimate_pose_and_focal(p.points_in_world, p.pixels, p.camera.K[:2, 2])
        assert found.success
        assert found.model.focal_px == pytest.approx(800.0, rel=0.01)
    for noise_px in (0.0, 0.5):
        points = np.concatenate([rng.uniform(-2, 2, (100, 2)), np.full((100, 1), 6.0)], axis=1)
        pixels = CAMERA.project(points) + noise_px * rng.normal(size=(100, 2))
        assert not estimate_pose_and_focal(points, pixels, CAMERA.K[:2, 2]).success


def test_ranked_matches_are_tried_first():
    p = two_view_problem(1000, 0.8, 0.7, 2)
    quality = p.inlier_mask + 0.7 * np.random.default_rng(0).random(1000)
    config = RansacConfig(max_error_px=2, min_inlier_ratio=0.05, max_iterations=20_000)
    plain = estimate_relative_pose(p.pixels1, p.pixels2, CAMERA, CAMERA, config)
    ranked = estimate_relative_pose(p.pixels1, p.pixels2, CAMERA, CAMERA, config, quality=quality)
    assert ranked.success and ranked.num_iterations < 0.2 * plain.num_iterations
    assert angle_deg(ranked.model, p.cam2_from_cam1) < 1.0
    with pytest.raises(ShapeError):
        estimate_relative_pose(p.pixels1, p.pixels2, CAMERA, CAMERA, config, quality=quality[:5])


def test_pure_forward_motion():
    p = two_view_problem(500, 0.3, 0.7, 4, kind="forward")
    found = estimate_relative_pose(p.pixels1, p.pixels2, CAMERA, CAMERA, RansacConfig(max_error_px=2))
    assert found.success
    direction = p.cam2_from_cam1.translation
    assert np.degrees(np.arccos(np.clip(direction @ found.model.translation, -1, 1))) < 1.0


@pytest.mark.parametrize(("count", "outliers"), [(1000, 0.4), (100, 0.0)])
def test_a_noisy_plane_leaves_the_fundamental_matrix_open(count, outliers):
    for seed in range(10):
        p = two_view_problem(count, outliers, 1.0, seed, kind="planar")
        found = estimate_fundamental_matrix(p.pixels1, p.pixels2, RansacConfig(max_error_px=3.0))
        assert found.reason is Reason.DEGENERATE
        assert np.isinf(found.covariance).all()


@pytest.mark.parametrize("fraction", [0.8, 0.9, 0.95])
def test_a_dominant_plane_does_not_hold_the_fundamental_matrix(fraction):
    """The exact matches off the plane tell; without the way out of the plane half of these are wrong by pixels."""
    errors = []
    for seed in range(20):
        p = dominant_plane_problem(1000, fraction, 0.4, 1.0, seed)
        off = p.points_in_cam1[~p.plane_mask]
        one, two = p.camera1.project(off), p.camera2.project(p.cam2_from_cam1.apply(off))
        found = estimate_fundamental_matrix(p.pixels1, p.pixels2, RansacConfig(max_error_px=2.0))
        assert found.success
        errors.append(np.median(sampson_error(found.model, one, two)))
    assert np.median(errors) < 0.4
    assert max(errors) < 1.5


def test_undetermined_models_are_called_degenerate():
    """Noise-free: a rotation leaves the direction free, a plane leaves F free, a line leaves everything free."""
    rotated = two_view_problem(200, 0.0, 0.0, 0, kind="rotation")
    assert (
        estimate_relative_pose(rotated.pixels1, rotated.pixels2, CAMERA, CAMERA).reason is Reason.DEGENERATE
    )
    plane = two_view_problem(200, 0.0, 0.0, 0, kind="planar")
    assert not estimate_fundamental_matrix(plane.pixels1, plane.pixels2).success
    line = np.stack([np.linspace(0, 900, 50), np.linspace(0, 700, 50)], axis=1)
    for estimate in (estimate_homography, estimate_fundamental_matrix):
        assert not estimate(line, line + 3.0).success
    same = np.full((40, 2), 300.0)
    for estimate in (estimate_homography, estimate_fundamental_matrix):
        assert not estimate(same, same).success
    assert not estimate_absolute_pose(np.ones((40, 3)), same, CAMERA).success


@pytest.mark.parametrize("size", [1e-6, 1e9])
def test_units_do_not_matter(size):
    p = absolute_pose_problem(100, 0.2, 0.5, 1)
    found = estimate_absolute_pose(size * p.points_in_world, p.pixels, p.camera)
    assert found.success
    assert angle_deg(found.model, p.cam_from_world) < 0.2
    np.testing.assert_allclose(found.model.translation / size, p.cam_from_world.translation, atol=0.05)


def test_inputs_with_nothing_in_them():
    none2, none3 = np.zeros((0, 2)), np.zeros((0, 3))
    nan = np.full((30, 2), np.nan)
    assert estimate_homography(none2, none2).reason is Reason.TOO_FEW
    assert estimate_fundamental_matrix(nan, nan).reason is Reason.TOO_FEW
    assert estimate_relative_pose(nan, nan, CAMERA, CAMERA).reason is Reason.TOO_FEW
    assert estimate_absolute_pose(np.full((30, 3), np.inf), nan, CAMERA).reason is Reason.TOO_FEW
    assert estimate_similarity(none3, none3).reason is Reason.TOO_FEW
    assert estimate_pose_and_focal(none3, none2, (0, 0)).reason is Reason.TOO_FEW
    with pytest.raises(ShapeError):
        estimate_homography(np.zeros((5, 3)), none2)
    with pytest.raises(ShapeError):
        estimate_absolute_pose(none3, np.zeros((4, 2)), CAMERA)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-300, 1e200, 1e300])
def test_numbers_at_the_ends_of_floating_point_give_reasons(rng, size):
    a, b, x = size * rng.random((50, 2)), size * rng.random((50, 2)), size * rng.normal(size=(50, 3))
    assert not estimate_homography(a, b).success
    assert not estimate_fundamental_matrix(a, b).success
    assert not estimate_relative_pose(a, b, CAMERA, CAMERA).success
    assert not estimate_absolute_pose(x, a, CAMERA).success
    assert not estimate_pose_and_focal(x, a, (0, 0)).success
    assert not estimate_similarity(x, x).success
