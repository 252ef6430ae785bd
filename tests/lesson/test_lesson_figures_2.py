"""The small figures of pages 3 to 6 show what the paragraphs say."""

import numpy as np
import pytest
from scipy.stats import norm

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.geometry.triangulation import triangulate_two_view
from epipole.lesson.scenes import cases, house
from epipole.robust import point_covariances, triangulate_points
from epipole.robust._loop_kernels import _iterations_needed
from epipole.solvers import solve_p3p

CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def set_pair(tab, value):
    tab.page.locator(f"input[name=pair][value={value}]").check()


def test_the_sign_of_the_translation_moves_the_point_behind_both_cameras(tab):
    tab.open("03_candidates.html")
    depths = {}
    for factor in (1.0, 0.4, -0.4, -1.0):
        tab.set(bs=factor)
        shown = tab.shown()
        assert shown["sign-triple"] == pytest.approx(0.0, abs=1e-12)
        depths[factor] = np.array([shown["sign-z1"], shown["sign-z2"]])
        np.testing.assert_allclose(depths[factor], factor * depths[1.0], rtol=1e-9)
    assert np.all(depths[1.0] > 0)


def test_half_a_rotation_about_the_baseline_changes_the_sign_of_the_essential_matrix(tab):
    """E(angle) = cos(angle) E + sin(angle) G, with G perpendicular to E, so that E(180 degrees) = -E."""
    tab.open("03_candidates.html")
    for angle in (0.0, 30.0, 90.0, 135.0, 180.0):
        tab.set(twist=angle)
        shown = tab.shown()
        assert shown["twist-cosine"] == pytest.approx(np.cos(np.deg2rad(angle)), abs=1e-12)
        is_flat = abs(shown["twist-triple"]) < 1e-9
        assert is_flat == (angle in (0.0, 180.0))


def test_depths_have_another_pair_of_signs_in_each_candidate(tab):
    tab.open("03_candidates.html")
    signs = {}
    for name in "ABCD":
        set_pair(tab, name)
        shown = tab.shown()
        signs[name] = (shown["four-z1"] > 0, shown["four-z2"] > 0)
        assert (shown["four-count"] == 10) == (signs[name] == (True, True))
    assert len(set(signs.values())) == 4


def test_the_probability_of_a_wrong_vote_is_that_of_a_normal_distribution(tab):
    tab.open("03_candidates.html")
    for Z, B, sigma in ((60.0, 0.2, 1.0), (100.0, 0.05, 2.0), (20.0, 0.1, 0.4)):
        tab.set(Zv=Z, Bv=B, sv=sigma)
        shown = tab.shown()
        assert shown["bell-d"] == pytest.approx(520.0 * B / Z)
        wrong = norm.sf(520.0 * B / Z / (np.sqrt(2.0) * sigma))
        assert shown["bell-wrong"] == pytest.approx(100.0 * wrong, rel=1e-7)


def test_both_images_stay_while_the_scene_grows(tab):
    tab.open("04_scale.html")
    rotated = Rotation3.exp(np.deg2rad([0.0, -16.0, 0.0])).matrix
    for k in (0.5, 1.0, 1.6):
        tab.set(kg=k)
        shown, corner = tab.shown(), k * house(5.0)[1:2]
        second = Rigid3(rotated, np.array([1.6 * k, 0.0, 0.0])).inverse()
        for name, cam_from_world in (("grow-u1", Rigid3.identity()), ("grow-u2", second)):
            assert shown[name] == pytest.approx(CAMERA.project(cam_from_world.apply(corner))[0, 0], rel=1e-9)
        assert [shown["grow-baseline"], shown["grow-width"]] == pytest.approx([1.6 * k, 2.0 * k])


def test_an_accelerometer_gives_the_scale_unless_it_has_a_bias(tab):
    tab.open("04_scale.html")
    tab.set(si=1.7, bias=0.0)
    shown = tab.shown()
    assert shown["ride-rms"] == pytest.approx(0.0, abs=1e-9) and shown["ride-best"] == pytest.approx(1.7)
    errors = []
    for bias in (0.05, 0.1, -0.1):
        tab.set(bias=bias)
        shown = tab.shown()
        errors.append(shown["ride-best"] - 1.7)
        # 0.5 bias t^2 in all instants: the RMS of t^2 over 8 s is 64 / sqrt(5).
        assert shown["ride-rms"] == pytest.approx(0.5 * abs(bias) * 64 / np.sqrt(5.0), rel=0.01)
    assert errors[1] == pytest.approx(2 * errors[0]) and errors[2] == pytest.approx(-errors[1])


def test_errors_of_the_scale_multiply_around_a_loop(tab):
    tab.open("04_scale.html")
    angles = 2 * np.pi * (np.arange(48) + 0.5) / 48
    for percent in (-1.5, 0.0, 1.0):
        tab.set(ed=percent)
        shown, growth = tab.shown(), 1 + percent / 100
        assert shown["drift-scale"] == pytest.approx(growth**48)
        steps = growth ** np.arange(48) * np.exp(1j * angles)
        assert shown["drift-gap"] == pytest.approx(100 * abs(steps.sum()) / 48, abs=1e-9)


def pair_of(*poses):
    return Rigid3(np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses]))


def camera_at(x, z, yaw_deg):
    """cam_from_world of a camera at (x, 0, z) that is rotated to the right."""
    return Rigid3(
        Rotation3.exp(np.deg2rad([0.0, yaw_deg, 0.0])).matrix, np.array([x, 0.0, z], float)
    ).inverse()


def test_rays_that_miss_meet_halfway(tab):
    tab.open("05_triangulation.html")
    truth, gaps = np.array([0.5, 0.1, 3.2]), []
    for off, B in ((0.0, 1.4), (40.0, 1.4), (-60.0, 0.8)):
        tab.set(em=off, Bm=B)
        shown, second = tab.shown(), camera_at(B, 0.0, -14.0)
        pixels = [CAMERA.project(pose.apply(truth[None])) for pose in (Rigid3.identity(), second)]
        rays1, rays2 = CAMERA.unproject(pixels[0]), CAMERA.unproject(pixels[1] + [0.0, off])
        middle = triangulate_two_view(second, rays1, rays2)[0][0]
        assert shown["miss-depth"] == pytest.approx(middle[2], rel=1e-9)
        assert shown["miss-off"] == pytest.approx(np.linalg.norm(middle - truth), abs=1e-9)
        normal = np.cross(
            *(rays @ pose.rotation for rays, pose in ((rays1, Rigid3.identity()), (rays2, second)))
        )
        gap = abs(np.array([B, 0.0, 0.0]) @ normal[0]) / np.linalg.norm(normal)
        assert shown["miss-gap"] == pytest.approx(gap, abs=1e-9)
        gaps.append(gap)
    assert gaps[0] == pytest.approx(0.0, abs=1e-12) and min(gaps[1:]) > 0.1


def test_no_trial_point_has_a_smaller_sum_of_squares(tab):
    tab.open("05_triangulation.html")
    poses = pair_of(Rigid3.identity(), camera_at(1.2, 0.0, -14.0))
    truth = np.array([[0.3, 0.2, 4.0]])
    pixels = np.stack([CAMERA.project(pose.apply(truth)) for pose in poses]) + 9 * cases()[5].reshape(2, 1, 2)
    best = triangulate_points(poses, CAMERA, pixels).points_in_world

    def errors(points):
        return np.array(
            [np.linalg.norm(CAMERA.project(pose.apply(points)) - seen) for pose, seen in zip(poses, pixels)]
        )

    least = (errors(best) ** 2).sum()
    for point in ([0.1, 0.05, 3.2], [0.3, 0.2, 4.0], best[0]):
        tab.set(Xr=point[0], Yr=point[1], Zr=point[2])
        shown, wanted = tab.shown(), errors(np.array([point]))
        assert [shown["trial-first"], shown["trial-second"]] == pytest.approx(wanted, abs=1e-6)
        assert shown["trial-sum"] == pytest.approx((wanted**2).sum(), abs=1e-6)
        assert shown["trial-least"] == pytest.approx(least, rel=1e-6)
        assert shown["trial-sum"] >= shown["trial-least"] - 1e-6


def test_the_ellipse_has_the_ratio_of_its_angle(tab):
    tab.open("05_triangulation.html")
    point = np.array([[0.0, 0.0, 6.0]])
    for angle, sigma in ((4.0, 1.0), (30.0, 0.5), (90.0, 2.0)):
        tab.set(theta=angle, sn=sigma)
        shown = tab.shown()
        half = np.deg2rad(angle / 2)
        poses = pair_of(
            *(camera_at(6 * k * np.sin(half), 6 - 6 * np.cos(half), -k * angle / 2) for k in (-1, 1))
        )
        spread = point_covariances(poses, CAMERA, point, np.ones((2, 1), bool), sigma)[0]
        axes = np.sqrt(np.linalg.eigvalsh(spread[np.ix_([0, 2], [0, 2])]))
        assert [shown["ellipse-short"], shown["ellipse-long"]] == pytest.approx(axes, rel=1e-9)
        assert shown["ellipse-ratio"] == pytest.approx(1 / np.tan(half), rel=1e-9)
        assert shown["ellipse-law"] == pytest.approx(shown["ellipse-ratio"], rel=1e-9)


def test_residuals_of_a_guess_are_zero_at_the_true_pose(tab):
    tab.open("06_pnp.html")
    landmarks, truth = house(5.0), camera_at(0.4, 0.3, -6.0)
    for x, z, yaw in ((0.4, 0.3, -6.0), (0.0, -0.5, 4.0), (-1.0, 1.0, 20.0)):
        tab.set(gx=x, gz=z, gyaw=yaw)
        shown, guess = tab.shown(), camera_at(x, z, yaw)
        off = CAMERA.project(guess.apply(landmarks)) - CAMERA.project(truth.apply(landmarks))
        assert shown["pose-rms"] == pytest.approx(np.sqrt(np.mean(off**2)), abs=1e-9)
        assert shown["pose-position"] == pytest.approx(np.hypot(x - 0.4, z - 0.3), abs=1e-9)
        assert shown["pose-rotation"] == pytest.approx(abs(yaw + 6.0), abs=1e-9)
        assert (shown["pose-rms"] < 1e-9) == (x == 0.4)


def test_poses_of_three_points_are_those_of_the_library(tab):
    tab.open("06_pnp.html")
    angles, counts = np.deg2rad([0.0, 120.0, 240.0]), set()
    triangle = np.column_stack([2 * np.cos(angles), 2 * np.sin(angles), 0 * angles])
    for x, distance in ((0.2, 3.6), (1.5, 2.5), (1.0, 2.5), (-0.5, 2.3), (1.6, 4.4)):
        tab.set(cx=x, cz=distance)
        rays = triangle - [x, 0.15, -distance]
        wanted = solve_p3p(triangle, rays)
        found = tab.page.evaluate(
            "values => posesNumbers(values).poses.map(p => p.pose.t)", {"cx": x, "cz": distance}
        )
        assert len(found) == len(wanted.translation) == tab.shown()["poses-count"]
        np.testing.assert_allclose(sorted(found), sorted(wanted.translation.tolist()), atol=1e-6)
        assert tab.shown()["poses-best"] == pytest.approx(0.0, abs=1e-6)
        counts.add(len(found))
    assert {1, 4} <= counts


def test_samples_of_ransac_are_those_of_the_library(tab):
    tab.open("06_pnp.html")
    for outliers, confidence in ((50.0, 99.0), (75.0, 99.9), (10.0, 90.0)):
        tab.set(po=outliers, pc=confidence)
        for name, size in (("three", 3), ("six", 6)):
            wanted = _iterations_needed.py_func(1 - outliers / 100, size, confidence / 100, 0, 10**9)
            assert tab.shown()[f"samples-{name}"] in (wanted, wanted + 1)  # the library rounds down


def test_steps_alternate_between_cameras_and_points(tab):
    tab.open("06_pnp.html")
    counts = []
    for _ in range(8):
        shown = tab.shown()
        counts.append((shown["steps-cameras"], shown["steps-points"]))
        tab.page.locator("#next-step").click()
    gained = np.diff(counts, axis=0)
    np.testing.assert_array_equal(gained[:, 0], [1, 0, 1, 0, 1, 0, 1])
    assert np.all(gained[0::2, 1] == 0) and np.all(gained[1::2, 1] > 0)
    assert (tab.shown()["steps-cameras"], tab.shown()["steps-points"]) == counts[0]  # from the start again
