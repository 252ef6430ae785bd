"""Relative pose through wide lenses: matches at the rim count, and as many pixels as they are."""

import numpy as np
import pytest
from scipy.stats import chi2

from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Rotation3, essential_from_cam2_from_cam1
from epipole.robust import PairKind, PairMatches, estimate_relative_pose, verify_pairs
from epipole.robust.pairs._relative_pose_kernels import RelativePoseProblem
from epipole.robust.pairs._wide_motion_kernels import WideMotionProblem
from epipole.robust.rays import is_wide, rays_on_plane
from epipole.synthetic.problems import two_view_problem
from whole import in_whole_run


def wide_views(seed, half_deg, noise_px=1.0, outliers=0.3, count=800, baseline=1.0):
    """A fisheye's matches, evenly over the sphere within so many degrees off the axis."""
    rng = np.random.default_rng(seed)
    camera = Camera(
        CameraModel.OPENCV_FISHEYE, 1600, 1600, np.array([400.0, 400.0, 799.5, 799.5, 0.01, 0.0, 0.0, 0.0])
    )
    motion = Rigid3.exp(np.concatenate([rng.normal(size=3), 0.1 * rng.normal(size=3)]))
    motion = Rigid3(motion.rotation, baseline * motion.translation / np.linalg.norm(motion.translation))
    cosine, around = rng.uniform(np.cos(np.radians(half_deg)), 1, count), rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    rays = np.stack([sine * np.cos(around), sine * np.sin(around), cosine], axis=1)
    points = rays * rng.uniform(4, 9, (count, 1))
    x1, x2 = camera.project(points), camera.project(motion.apply(points))
    x1, x2 = x1 + noise_px * rng.normal(size=x1.shape), x2 + noise_px * rng.normal(size=x2.shape)
    wrong = rng.random(count) < outliers
    x2[wrong] = rng.uniform(0, 1600, (wrong.sum(), 2))
    return x1, x2, ~wrong, motion, camera


@pytest.mark.parametrize(("half_deg", "bound_deg"), [(60, 0.45), (88, 0.25), (105, 0.15)])
def test_a_wide_lens_keeps_its_rim(half_deg, bound_deg):
    """On the plane z = 1 four in ten matches of a lens of 88 degrees were lost, and none could lie beyond 90."""
    errors, fractions = [], []
    for seed in range(6):
        x1, x2, truth, motion, camera = wide_views(seed, half_deg)
        found = estimate_relative_pose(x1, x2, camera, camera, RansacConfig(max_error_px=2.0))
        assert found.success
        rotation = (Rotation3(found.model.rotation) @ Rotation3(motion.rotation).inverse()).angle_rad()
        cosine = np.clip(found.model.translation @ motion.translation, -1, 1)
        errors.append(np.degrees(max(float(rotation), float(np.arccos(cosine)))))
        fractions.append((found.inlier_mask & truth).sum() / truth.sum())
        assert 0.7 < found.noise_px < 1.3
    assert np.median(errors) < bound_deg
    assert min(fractions) > 0.9


@in_whole_run
def test_the_covariance_of_a_wide_lens_is_that_of_its_errors():
    squared = []
    for seed in range(120):
        x1, x2, _, motion, camera = wide_views(seed, 80, outliers=0.0, count=150)
        found = estimate_relative_pose(x1, x2, camera, camera, RansacConfig(max_error_px=4.0))
        delta = (motion @ found.model.inverse()).log()
        squared.append(delta @ np.linalg.pinv(found.covariance, rcond=1e-9) @ delta)
    assert 0.85 < np.mean(np.array(squared) < chi2.ppf(0.9, 5)) < 0.96


def test_sampson_on_the_rays_of_a_pinhole_is_sampson_on_its_plane(rng):
    p = two_view_problem(300, 0.3, 0.01, 3)
    y1, y2 = (rays_on_plane(p.camera1, x) for x in (p.pixels1, p.pixels2))
    scale = p.camera1.focal_px
    plane = RelativePoseProblem(np.ascontiguousarray(np.concatenate([y1, y2], axis=1).T))
    (rays1, slopes1), (rays2, slopes2) = (
        p.camera1.unproject_with_jacobian(p.pixels1),
        p.camera2.unproject_with_jacobian(p.pixels2),
    )
    columns = [rays1, rays2, *(scale * slopes.reshape(-1, 6) for slopes in (slopes1, slopes2))]
    wide = WideMotionProblem(np.ascontiguousarray(np.concatenate(columns, axis=1).T))
    model = np.zeros(32)
    motion = p.cam2_from_cam1
    model[:9], model[9:12] = motion.rotation.ravel(), motion.translation
    model[12:21] = essential_from_cam2_from_cam1(motion).ravel()
    results = []
    for problem in (plane, wide):
        out = np.empty(300)
        problem.residuals_sq(model, 0.01**2, out)  # as Python
        results.append(out)
    near = results[0] < (0.5 / scale) ** 2
    np.testing.assert_allclose(results[1][near], results[0][near], rtol=2e-3)


@pytest.mark.parametrize(("baseline", "kind"), [(1.0, PairKind.GENERAL), (0.0, PairKind.ROTATION)])
def test_pairs_of_wide_lenses_are_named(baseline, kind):
    pairs, truths = [], []
    for seed in range(8):
        x1, x2, truth, _, camera = wide_views(seed, 88, baseline=baseline)
        pairs.append(PairMatches(x1, x2, camera, camera))
        truths.append(truth)
    for geometry, truth in zip(verify_pairs(pairs, RansacConfig(max_error_px=3.0)), truths):
        assert geometry.kind is kind
        assert (geometry.inlier_mask & truth).sum() > 0.95 * truth.sum()


def test_which_lenses_are_wide():
    def camera(model, *params, size=(1600, 1200)):
        return Camera(model, *size, np.array(params, float))

    assert not is_wide(camera(CameraModel.PINHOLE, 500, 500, 799.5, 599.5))
    assert not is_wide(camera(CameraModel.SIMPLE_RADIAL, 1300, 799.5, 599.5, -0.03))
    assert is_wide(camera(CameraModel.SIMPLE_RADIAL, 700, 799.5, 599.5, -0.1))
    fisheye = (400.0, 400.0, 799.5, 599.5, 0.0, 0.0, 0.0, 0.0)
    assert is_wide(camera(CameraModel.OPENCV_FISHEYE, *fisheye))
    # Its circle lies within the image: the corners have no ray at all.
    assert is_wide(camera(CameraModel.OPENCV_FISHEYE, 200.0, 200.0, *fisheye[2:]))
    assert not is_wide(camera(CameraModel.OPENCV_FISHEYE, 4000.0, 4000.0, *fisheye[2:]))
