"""What pages show against what the library says, over grids of inputs."""

import itertools

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.geometry.disparity import depth_error, depth_to_disparity, disparity_to_depth
from epipole.geometry.epipolar import (
    choose_by_cheirality,
    decompose_essential_matrix,
    epipolar_lines,
    epipoles,
    essential_from_cam2_from_cam1,
    fundamental_from_essential,
    sampson_error,
)
from epipole.geometry.homogeneous import point_line_distance
from epipole.geometry.triangulation import ray_angles_rad, triangulate_linear, triangulate_two_view
from epipole.lesson.scenes import PATH, cases, corridor, house, noise
from epipole.optim import BundleConfig, BundleProblem, adjust_bundle
from epipole.robust import point_covariances, triangulate_points

CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def close(found, wanted, size=1.0):
    """To 1e-9 of itself, or of the size of what it is made from."""
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * size)


def test_disparity(tab):
    tab.open("01_disparity.html")
    for Z, X, B, f, e in itertools.product(
        (0.5, 2.4, 24.0, 40.0), (-0.4, 0.13), (0.02, 0.12, 0.5), (200.0, 800.0), (0.05, 1.0, 3.0)
    ):
        tab.set(Z=Z, X=X, B=B, f=f, e=e)
        shown, d = tab.shown(), depth_to_disparity(Z, f, B).item()
        left, right = (
            Camera("PINHOLE", 10, 10, [f, f, 0.0, 0.0]).project([[x, 0.0, Z]])[0, 0] for x in (X, X - B)
        )
        close([shown["xl"], shown["xr"], shown["d"]], [left, right, d], f)
        close(shown["back"], disparity_to_depth(d, f, B))
        close(shown["dz"], depth_error(Z, f, B, e))
        near, far = (disparity_to_depth(d + k * e, f, B).item() for k in (1, -1))
        close([shown["nearest"], shown["farthest"]], [near, np.inf if np.isnan(far) else far])


def test_the_worked_numbers(tab):
    tab.open("01_disparity.html")
    for button, depth, error in ((0, 2.4, 0.06), (1, 24.0, 6.0)):
        tab.page.locator("button[data-preset]").nth(button).click()
        shown = tab.shown()
        close([shown["back"], shown["dz"]], [depth, error])


def test_the_object_is_dragged(tab):
    tab.open("01_disparity.html")
    box = tab.page.locator("#above").bounding_box()
    tab.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.2 * box["height"])
    held = tab.shown()["back"]
    tab.page.mouse.up()
    assert 2.5 < held < 5.0 and tab.shown()["back"] == held


def test_epipolar_lines(tab):
    tab.open("02_epipolar.html")
    K = CAMERA.K
    places = itertools.product((0.0, 400.0, 639.0), (300.0,), (0.8, 4.5), (-20.0, 0.0))
    motions = (
        (1.0, 0.0, 0.2, -10.0, 0.0, 0.0),
        (-0.3, 0.7, 0.4, 15.0, -20.0, 5.0),
        (0.0, 0.1, 1.0, 0.0, 3.0, -40.0),
    )
    for (u, v, Z, off), (tx, ty, tz, yaw, pitch, roll) in itertools.product(places, motions):
        tab.set(u=u, v=v, Z=Z, off=off, tx=tx, ty=ty, tz=tz, yaw=yaw, pitch=pitch, roll=roll)
        turned = Rotation3.exp(np.deg2rad([-pitch, yaw, roll])).matrix
        motion = Rigid3(turned, np.array([tx, ty, tz])).inverse()
        E = essential_from_cam2_from_cam1(motion)
        F = fundamental_from_essential(E, K, K)
        shown = tab.shown()
        close(tab.matrix("E"), E)
        close(tab.matrix("F"), F)
        close(tab.matrix("K"), K)
        pixel = np.array([[u, v]])
        line = epipolar_lines(F, pixel)[0]
        point = motion.apply(Z * np.linalg.inv(K) @ [u, v, 1.0])
        if point[2] <= 0:
            assert np.isnan(shown["x2"])
            continue
        match = CAMERA.project(point[None]) + off * line[:2]
        size = np.abs(match).max()
        close([shown["x2"], shown["y2"]], match[0], size)
        close(shown["distance"], point_line_distance(match, line[None])[0], size)
        close(shown["sampson"], sampson_error(F, pixel, match)[0], size)
        close(shown["residual"], (np.append(match, 1.0) @ F @ [u, v, 1.0]), size * np.abs(F).max())
        for name, end in zip(("e1", "e2"), epipoles(F)):
            wanted = end[:2] / end[2]
            close([shown[name + "u"], shown[name + "v"]], wanted, np.abs(wanted).max())


def test_the_pointer_chooses_the_pixel(tab):
    tab.open("02_epipolar.html")
    box = tab.page.locator("#first rect").bounding_box()
    tab.page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.75 * box["height"])
    u, v = (float(tab.page.locator(f"#{name}").input_value()) for name in "uv")
    assert (u, v) == (pytest.approx(159.5, abs=1.0), pytest.approx(359.5, abs=1.0))


def test_no_way_between_the_cameras_is_no_line(tab):
    tab.open("02_epipolar.html")
    tab.page.locator("button[data-preset]").last.click()
    shown = tab.shown()
    assert not np.any(tab.matrix("E")) and np.isnan(shown["distance"]) and np.isnan(shown["e2u"])
    assert np.isfinite(shown["x2"])


def test_four_candidates(tab):
    tab.open("03_candidates.html")
    for tx, tz, yaw, far, sigma in itertools.product(
        (0.05, 1.0), (0.0, -0.6), (-12.0, 25.0), (3.0, 12.0), (0.0, 4.0)
    ):
        tab.set(tx=tx, tz=tz, yaw=yaw, far=far, noise=sigma)
        shown = tab.shown()
        motion = Rigid3(Rotation3.exp(np.deg2rad([0.0, yaw, 0.0])).matrix, np.array([tx, 0.0, tz])).inverse()
        corners = house(far)
        rays1, rays2 = (
            CAMERA.unproject(CAMERA.project(where.apply(corners)) + sigma * noise(10, seed))
            for seed, where in enumerate((Rigid3.identity(), motion))
        )
        candidates = decompose_essential_matrix(essential_from_cam2_from_cam1(motion))
        wanted = []
        for k in range(4):
            _, one, other = triangulate_two_view(candidates[k], rays1, rays2)
            angle = np.rad2deg(np.linalg.norm(Rotation3(candidates[k].rotation).log()))
            wanted.append([angle, *candidates[k].translation, ((one > 0) & (other > 0)).sum()])
        found = [
            [shown[f"angle{k}"], *(shown[f"t{k}{a}"] for a in range(3)), shown[f"count{k}"]] for k in range(4)
        ]
        left = list(wanted)
        for row in found:
            nearest = min(left, key=lambda one: np.abs(np.subtract(one, row)).max())
            close(row, nearest)
            left.remove(nearest)
        _, in_front, _ = choose_by_cheirality(candidates, rays1, rays2)
        assert shown["count0"] == in_front.sum()


def test_the_pictures_know_no_size(tab):
    tab.open("04_scale.html")
    turned = Rotation3.exp(np.deg2rad([0.0, -10.0, 0.0])).matrix
    for k, B, W, anchor in itertools.product(
        (0.3, 1.0, 3.0), (0.2, 1.7), (0.5, 11.0), ("none", "baseline", "width")
    ):
        tab.page.locator(f"input[value={anchor}]").check()
        tab.set(k=k, B=B, W=W)
        shown, corners = tab.shown(), house(5.0)
        motion = Rigid3(turned, np.array([1.0, 0.0, 0.0])).inverse()
        for name, where in (("u1", Rigid3.identity()), ("u2", motion)):
            close(shown[name], CAMERA.project(where.apply(corners[1:2]))[0, 0])
        sizes = k * np.array([1.0, 2.0, np.linalg.norm(corners.mean(axis=0))])
        metres = {"none": np.nan, "baseline": B / sizes[0], "width": W / sizes[1]}[anchor]
        close(
            [shown[name] for name in ("baseline", "width", "distance")],
            sizes * np.nan_to_num(metres, nan=1.0),
        )
        close(shown["metres"], metres)
        words = tab.page.locator("#metres").inner_text()
        assert (words == "up to scale") == (anchor == "none")


def test_points_and_their_ellipse(tab):
    tab.open("05_triangulation.html")
    for B, A, Z, X, s, n in itertools.product(
        (0.3, 4.0), (0.0, 3.5), (5.0, 12.0), (-1.0, 2.0), (0.1, 4.0), (0, 39)
    ):
        tab.set(B=B, A=A, Z=Z, X=X, s=s, n=n)
        shown, truth = tab.shown(), np.array([X, 0.2, Z])
        cams = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0.0, 0.0], [-B, 0.0, -A]]))
        exact = np.stack([CAMERA.project(cams[k].apply(truth[None]))[0] for k in range(2)])
        pixels = exact + s * cases()[n].reshape(2, 2)
        first = triangulate_linear(cams, CAMERA.unproject(pixels))
        best = triangulate_points(cams, CAMERA, pixels[:, None]).points_in_world[0]
        spread = point_covariances(cams, CAMERA, truth[None], np.ones((2, 1), bool), s)[0]
        close(shown["angle"], np.rad2deg(ray_angles_rad(truth, np.zeros(3), np.array([B, 0.0, A]))))
        close([shown["sx"], shown["sz"]], np.sqrt(spread[[0, 2], [0, 2]]))
        for name, point in (("linear", first), ("best", best)):
            off = [CAMERA.project(cams[k].apply(point[None]))[0] - pixels[k] for k in range(2)]
            close(shown[name], np.linalg.norm(point - truth), Z)
            close(shown[name + "_px"], np.sqrt(np.mean(np.square(off))), 640)


def adjusted(cams_from_world, points, pixels, *, camera_is_free):
    """Cameras that all see all points (or the points alone) moved to where they explain the pixels best, to the last digit."""
    v, n = len(cams_from_world), len(points)
    problem = BundleProblem(
        rig_from_world=cams_from_world,
        cam_from_rig=Rigid3.identity(1),
        camera_model=np.array([int(CAMERA.model)], np.int32),
        camera_params=CAMERA.padded_params()[None],
        points_in_world=np.asarray(points),
        offsets=v * np.arange(n + 1, dtype=np.int64),
        frame=np.tile(np.arange(v, dtype=np.int32), n),
        sensor=np.zeros(v * n, np.int32),
        camera=np.zeros(v * n, np.int32),
        pixels=np.asarray(pixels).reshape(-1, 2),
        frame_free=np.full((v, 6), float(camera_is_free)),
        params_free=np.zeros((1, 12)),
        point_free=np.full(n, float(not camera_is_free)),
    )
    return adjust_bundle(problem, BundleConfig(function_tolerance=0.0))


def way(step, s, most):
    """Cameras that are placed, known points, and how many pixels the last step used."""
    landmarks, noise_px = corridor()
    truth = [
        Rigid3(Rotation3.exp(np.deg2rad([0.0, yaw, 0.0])).matrix, np.array(center)).inverse()
        for *center, yaw in PATH
    ]
    pixels = []
    for motion, off in zip(truth, noise_px):
        there = motion.apply(landmarks)
        seen = CAMERA.project(there) + s * off
        inside = ((seen >= 0) & (seen <= [639, 479])).all(axis=1) & (there[:, 2] >= 0.5)
        pixels.append(np.where(inside[:, None], seen, np.nan))
    cameras, known, used = truth[:2], {}, 0
    for k in range(step + 1):
        last = pixels[len(cameras)] if k % 2 else pixels[len(cameras) - 1]
        if k % 2:
            rows = [j for j in known if not np.isnan(last[j, 0])][:most]
            start, places = cameras[-1][None], [known[j] for j in rows]
            cameras.append(adjusted(start, places, last[rows], camera_is_free=True).rig_from_world[0])
            used = len(rows)
            continue
        seen = ~np.isnan(np.array(pixels[: len(cameras)])[..., 0])
        new = [j for j in np.flatnonzero(seen[-1] & seen[:-1].any(axis=0)) if j not in known]
        first, used, fresh = seen[:-1].argmax(axis=0), 0, {}
        for c in {int(first[j]) for j in new}:
            rows = [j for j in new if first[j] == c]
            two = cameras[c], cameras[-1]
            pair = Rigid3(np.stack([one.rotation for one in two]), np.stack([one.translation for one in two]))
            both = np.stack([pixels[c][rows], last[rows]])
            found = triangulate_points(pair, CAMERA, both, min_angle_rad=np.deg2rad(1.5))
            good = found.success_mask
            best = adjusted(
                pair, found.points_in_world[good], both[:, good].swapaxes(0, 1), camera_is_free=False
            )
            fresh |= dict(zip(np.array(rows)[good].tolist(), best.points_in_world))
            used += 2 * int(good.sum())
        known |= dict(sorted(fresh.items()))
    return truth, cameras, known, used


def test_a_camera_on_its_way(tab):
    tab.open("06_pnp.html")
    landmarks, _ = corridor()
    for step, s, most in ((0, 1.0, 30), (1, 4.0, 4), (6, 0.0, 30), (13, 1.0, 60), (7, 1.5, 12)):
        tab.set(step=step, s=s, most=most)
        shown, (truth, cameras, known, used) = tab.shown(), way(step, s, most)
        last, right = cameras[-1], truth[len(cameras) - 1]
        assert [shown[name] for name in ("seen", "cameras", "points")] == [used, len(cameras), len(known)]
        apart = np.linalg.norm(last.inverse().translation - right.inverse().translation)
        turned = np.rad2deg(np.linalg.norm(Rotation3(last.rotation @ right.rotation.T).log()))
        off = np.median([np.linalg.norm(point - landmarks[j]) for j, point in known.items()])
        # An adjustment ends where the last digit of its cost does: 1e-9 of the way in metres, and of a radian.
        for name, wanted, size in (
            ("camera_off", apart, 10.0),
            ("turn_off", turned, 57.3),
            ("points_off", off, 10.0),
        ):
            close(shown[name], wanted, size)
