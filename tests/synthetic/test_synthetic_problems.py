"""The problems hold what they promise: answers, noise, outliers, degeneracies, repeatability."""

import numpy as np
import pytest

from epipole.cameras import CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.synthetic.problems import absolute_pose_problem, bundle_problem, two_view_problem


def is_in_picture(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return ((pixels > -0.5 - 1e-9) & (pixels < np.array(size) - 0.5 + 1e-9)).all(axis=1)


@pytest.mark.parametrize("kind", ["general", "forward", "rotation", "planar"])
def test_two_views_are_exact_without_noise(kind) -> None:
    problem = two_view_problem(200, seed=4, focal_px=700.0, size=(640, 480), kind=kind)
    in_cam2 = problem.cam2_from_cam1.apply(problem.points_in_cam1)
    # u = f x / z + c, written out.
    for points, pixels in ((problem.points_in_cam1, problem.pixels1), (in_cam2, problem.pixels2)):
        assert (points[:, 2] > 0).all()
        np.testing.assert_allclose(700.0 * points[:, :2] / points[:, 2:] + (319.5, 239.5), pixels, atol=1e-9)
        assert is_in_picture(pixels, (640, 480)).all()
    assert problem.inlier_mask.all()
    assert problem.pixels1.shape == problem.pixels2.shape == (200, 2)


def test_epipolar_constraint_separates_inliers() -> None:
    problem = two_view_problem(1000, outlier_ratio=0.4, seed=1)
    assert (~problem.inlier_mask).sum() == 400
    rays1, rays2 = problem.camera1.unproject(problem.pixels1), problem.camera2.unproject(problem.pixels2)
    essential = essential_from_cam2_from_cam1(problem.cam2_from_cam1)
    residual = np.abs(np.einsum("ni,ij,nj->n", rays2, essential, rays1))
    assert residual[problem.inlier_mask].max() < 1e-12
    assert np.median(residual[~problem.inlier_mask]) > 1e-3
    assert is_in_picture(problem.pixels2, (1280, 960)).all()


def test_motions_are_as_asked() -> None:
    general, ahead = two_view_problem(10, seed=2), two_view_problem(10, seed=2, kind="forward")
    rotated = two_view_problem(10, seed=2, kind="rotation")
    assert np.linalg.norm(general.cam2_from_cam1.translation) == pytest.approx(1)
    np.testing.assert_allclose(ahead.cam2_from_cam1.centers(), [0, 0, 1], atol=1e-15)
    assert (rotated.cam2_from_cam1.translation == 0).all()
    assert np.linalg.norm(rotated.cam2_from_cam1.log()[3:]) > 0.04


@pytest.mark.parametrize("planar", [True, False])
def test_planar_points_lie_on_a_plane(planar: bool) -> None:
    points = two_view_problem(300, seed=6, kind="planar" if planar else "general").points_in_cam1
    thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]
    assert thickness < 1e-10 if planar else thickness > 1
    points = absolute_pose_problem(300, seed=6, planar=planar).points_in_world
    thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]
    assert thickness < 1e-10 if planar else thickness > 1


def test_noise_has_the_asked_size() -> None:
    noise_px, n = 0.7, 4000
    two = two_view_problem(n, noise_px=noise_px, seed=3)
    one = absolute_pose_problem(n, noise_px=noise_px, seed=3)
    residuals = [
        two.camera1.project(two.points_in_cam1) - two.pixels1,
        two.camera2.project(two.cam2_from_cam1.apply(two.points_in_cam1)) - two.pixels2,
        one.camera.project(one.cam_from_world.apply(one.points_in_world)) - one.pixels,
    ]
    for residual in residuals:  # the deviation's own deviation is noise / sqrt(4 n) = 0.8 %
        assert residual.std() == pytest.approx(noise_px, rel=0.04)
        assert abs(residual.mean()) < 5 * noise_px / np.sqrt(2 * n)


def test_absolute_pose_is_exact_for_inliers_only() -> None:
    problem = absolute_pose_problem(500, outlier_ratio=0.3, seed=8)
    in_cam = problem.cam_from_world.apply(problem.points_in_world)
    errors = np.linalg.norm(problem.camera.project(in_cam) - problem.pixels, axis=1)
    assert problem.inlier_mask.sum() == 350
    assert errors[problem.inlier_mask].max() < 1e-8
    assert np.median(errors[~problem.inlier_mask]) > 50


@pytest.mark.parametrize("model", [pytest.param(m, id=m.name) for m in CameraModel])
def test_bundle_truth_is_exact_without_noise(model: CameraModel) -> None:
    problem = bundle_problem(8, 60, track_length=3, seed=2, model=model)
    assert problem.truth.reprojection_errors_px().max() < 1e-9
    assert problem.start.mean_reprojection_error_px() > 3
    assert problem.truth.cameras[0].model == model
    pixels = problem.truth.images.keypoints_px
    assert is_in_picture(pixels, (1280, 960)).all()


def test_bundle_tracks() -> None:
    truth = bundle_problem(7, 50, track_length=4, seed=5).truth
    assert len(truth.tracks) == 50
    assert (np.diff(truth.tracks.offsets) == 4).all()
    rows = truth.tracks.image.reshape(50, 4)
    assert (np.diff(rows, axis=1) > 0).all()
    # Next to each other on the ring of seven: the gaps around it are 1, 1, 1 and 4.
    gaps = np.diff(np.column_stack([rows, rows[:, 0] + 7]), axis=1)
    np.testing.assert_array_equal(np.sort(gaps, axis=1), np.tile([1, 1, 1, 4], (50, 1)))
    assert len(np.unique(truth.keypoint_rows())) == len(truth.images.keypoints_px) == 200


def test_bundle_noise_and_shared_keypoints() -> None:
    problem = bundle_problem(10, 1000, track_length=4, noise_px=0.5, seed=9)
    mean_sq = (problem.truth.reprojection_errors_px() ** 2).mean()
    assert np.sqrt(mean_sq / 2) == pytest.approx(0.5, rel=0.05)
    first = problem.truth.reprojection_errors_px().reshape(1000, 4).mean(axis=1)
    np.testing.assert_allclose(problem.truth.points.error_px, first)
    assert problem.start.images is problem.truth.images
    assert problem.start.tracks is problem.truth.tracks
    moved = problem.start.points.xyz_in_world - problem.truth.points.xyz_in_world
    assert moved.std() == pytest.approx(0.02, rel=0.1)


def test_same_seed_same_problem() -> None:
    first, again, other = (two_view_problem(50, 0.2, 1.0, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.pixels2, again.pixels2)
    assert (first.pixels2 != other.pixels2).any()
    one, two = (bundle_problem(5, 20, 3, 1.0, seed=1) for _ in range(2))
    np.testing.assert_array_equal(one.start.points.xyz_in_world, two.start.points.xyz_in_world)


def test_none_and_all_wrong() -> None:
    empty = two_view_problem(0)
    assert empty.pixels1.shape == (0, 2)
    assert isinstance(empty.cam2_from_cam1, Rigid3)
    assert not absolute_pose_problem(20, outlier_ratio=1.0).inlier_mask.any()
    assert len(bundle_problem(3, 0, 2).truth.points) == 0


def test_misuse_is_refused() -> None:
    with pytest.raises(ConfigError, match="outlier_ratio"):
        two_view_problem(10, outlier_ratio=1.5)
    with pytest.raises(ConfigError, match="noise_px"):
        absolute_pose_problem(10, noise_px=-1.0)
    with pytest.raises(ConfigError, match="track_length"):
        bundle_problem(3, 10, track_length=4)
    with pytest.raises(ConfigError, match="negative"):
        two_view_problem(-1)
