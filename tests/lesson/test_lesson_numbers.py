"""What pages show against what the library says, over grids of inputs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

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
from epipole.lesson.scenes import PATH, cases, corridor, house, noise, wall
from epipole.optim import BundleConfig, BundleProblem, adjust_bundle
from epipole.robust import PairKind, point_covariances, triangulate_points, verify_pair
from epipole.robust.pairs._model_selection_kernels import _gric
from epipole.solvers import solve_fundamental_eight_point, solve_homography_dlt
from pairwise import pairwise
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")
CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def close(found, wanted, size=1.0):
    """To 1e-9 of itself, or of the size of what it is made from."""
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * size)


def test_disparity(tab):
    tab.open("01_disparity.html")
    for Z, X, B, f, e in pairwise(
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
    tab.page.locator("#above").scroll_into_view_if_needed()
    box = tab.page.locator("#above").bounding_box()
    tab.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.2 * box["height"])
    fixed = tab.shown()["back"]
    tab.page.mouse.up()
    assert 2.5 < fixed < 5.0 and tab.shown()["back"] == fixed


def test_epipolar_lines(tab):
    tab.open("02_epipolar.html")
    K = CAMERA.K
    motions = (
        (1.0, 0.0, 0.2, -10.0, 0.0, 0.0),
        (-0.3, 0.7, 0.4, 15.0, -20.0, 5.0),
        (0.0, 0.1, 1.0, 0.0, 3.0, -40.0),
    )
    cases = pairwise((0.0, 400.0, 639.0), (300.0,), (0.8, 4.5), (-20.0, 0.0), motions)
    for u, v, Z, off, (tx, ty, tz, yaw, pitch, roll) in cases:
        tab.set(u=u, v=v, Z=Z, off=off, tx=tx, ty=ty, tz=tz, yaw=yaw, pitch=pitch, roll=roll)
        rotated = Rotation3.exp(np.deg2rad([-pitch, yaw, roll])).matrix
        motion = Rigid3(rotated, np.array([tx, ty, tz])).inverse()
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
    tab.page.locator("#pictures").scroll_into_view_if_needed()
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
    for tx, tz, yaw, far, sigma in pairwise((0.05, 1.0), (0.0, -0.6), (-12.0, 25.0), (3.0, 12.0), (0.0, 4.0)):
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
        counts = [shown[f"count{k}"] for k in range(4)]
        assert max(counts) == in_front.sum()
        chosen = [tab.page.locator(f"#row{k}").get_attribute("class") == "best" for k in range(4)]
        assert chosen == [count == max(counts) for count in counts]
        # The true one is told, whichever wins.
        true = [k for k in range(4) if tab.page.locator(f"#true{k}").inner_text()]
        (k,) = true
        close([shown[f"t{k}{a}"] for a in range(3)], motion.translation / np.linalg.norm(motion.translation))
        close(shown[f"angle{k}"], abs(yaw))


def test_the_pictures_know_no_size(tab):
    tab.open("04_scale.html")
    rotated = Rotation3.exp(np.deg2rad([0.0, -10.0, 0.0])).matrix
    for k, B, W, anchor in pairwise((0.3, 1.0, 3.0), (0.2, 1.7), (0.5, 11.0), ("none", "baseline", "width")):
        tab.page.locator(f"input[value={anchor}]").check()
        tab.set(k=k, B=B, W=W)
        disabled = [tab.page.locator(f"#{name}").is_disabled() for name in "BW"]
        assert disabled == [anchor != "baseline", anchor != "width"]
        shown, corners = tab.shown(), house(5.0)
        motion = Rigid3(rotated, np.array([1.0, 0.0, 0.0])).inverse()
        for name, where in (("u1", Rigid3.identity()), ("u2", motion)):
            close(shown[name], CAMERA.project(where.apply(corners[1:2]))[0, 0])
        sizes = k * np.array([1.0, 2.0, np.linalg.norm(corners.mean(axis=0))])
        meters = {"none": np.nan, "baseline": B / sizes[0], "width": W / sizes[1]}[anchor]
        close(
            [shown[name] for name in ("baseline", "width", "distance")],
            sizes * np.nan_to_num(meters, nan=1.0),
        )
        close(shown["meters"], meters)
        words = tab.page.locator("#meters").inner_text()
        assert (words == "up to scale") == (anchor == "none")


def test_points_and_their_ellipse(tab):
    tab.open("05_triangulation.html")
    for B, A, Z, X, s, n in pairwise((0.3, 4.0), (0.0, 3.5), (5.0, 12.0), (-1.0, 2.0), (0.1, 4.0), (0, 39)):
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
        close([shown["short"], shown["long"]], np.sqrt(np.linalg.eigvalsh(spread[np.ix_([0, 2], [0, 2])])))
        rays = CAMERA.unproject(pixels)
        apart = np.cross(*rays)
        close(shown["gap"], abs(np.array([B, 0.0, A]) @ apart) / np.linalg.norm(apart))
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
    found = adjust_bundle(problem, BundleConfig(function_tolerance=0.0))
    # Once more from there: the cost tells its minimum to half of the digits only.
    again = replace(problem, rig_from_world=found.rig_from_world, points_in_world=found.points_in_world)
    return adjust_bundle(again, BundleConfig(function_tolerance=0.0))


def trajectory(step, s, most):
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
            rows = [j for j in known if not np.isnan(last[j, 0])]
            count = min(most, len(rows))
            rows = [rows[k * len(rows) // count] for k in range(count)]
            start, positions = cameras[-1][None], [known[j] for j in rows]
            cameras.append(adjusted(start, positions, last[rows], camera_is_free=True).rig_from_world[0])
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
    for step, s, most in (
        (0, 1.0, 30),
        (1, 4.0, 4),
        (6, 0.0, 30),
        (13, 1.0, 60),
        (7, 1.5, 12),
        *(((7, 1.5, 20), (3, 2.0, 6)) if IS_WHOLE else ()),
    ):
        tab.set(step=step, s=s, most=most)
        shown, (truth, cameras, known, used) = tab.shown(), trajectory(step, s, most)
        last, right = cameras[-1], truth[len(cameras) - 1]
        assert [shown[name] for name in ("seen", "cameras", "points")] == [used, len(cameras), len(known)]
        apart = np.linalg.norm(last.inverse().translation - right.inverse().translation)
        rotated = np.rad2deg(np.linalg.norm(Rotation3(last.rotation @ right.rotation.T).log()))
        off = np.median([np.linalg.norm(point - landmarks[j]) for j, point in known.items()])
        # An adjustment ends where the last digit of its cost does: 1e-9 of the way in meters, and of a radian.
        for name, wanted, size in (
            ("camera_off", apart, 10.0),
            ("turn_off", rotated, 57.3),
            ("points_off", off, 10.0),
        ):
            close(shown[name], wanted, size)


def signed_sampson(F, one, two):
    products = np.einsum("ni,ij,nj->n", np.c_[two, np.ones(len(two))], F, np.c_[one, np.ones(len(one))])
    return np.sign(products) * sampson_error(F, one, two)


def best_essential(one, two, start):
    """Residuals of the essential matrix with the smallest sum of squares."""
    inverse = np.linalg.inv(CAMERA.K)
    t = start.translation if np.linalg.norm(start.translation) > 1e-9 else np.array([1.0, 0.0, 0.0])

    def residuals(x):
        motion = Rigid3(Rotation3.exp(x[:3]).matrix @ start.rotation, t / np.linalg.norm(t) + x[3:])
        F = inverse.T @ essential_from_cam2_from_cam1(motion) @ inverse
        return signed_sampson(F, one, two)

    return least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=0.1).fun


def test_which_model(tab):
    tab.open("07_models.html")
    positions, noise_px = wall()
    chosen = {"H": PairKind.PLANAR, "R": PairKind.ROTATION, "E": PairKind.GENERAL, "S": PairKind.NO_MOTION}
    known = ((0.0, 1.5, -8.0), (3.0, 0.0, -8.0), (3.0, 1.5, -8.0), (3.0, 0.0, 0.0))
    sampled = pairwise((0.0, 0.4, 3.0), (0.0, 1.5), (0.0, -8.0), (0.25, 2.0))
    for relief, tx, yaw, s in {*sampled, *((*one, 0.25) for one in known)}:
        at = {"relief": relief, "tx": tx, "yaw": yaw, "s": s}
        tab.set(**at)
        shown = tab.shown()
        x, y, deep = positions.T
        points = np.column_stack([x, y, 6 + 0.3 * x - 0.2 * y + relief * deep])
        motion = Rigid3(Rotation3.exp(np.deg2rad([0.0, yaw, 0.0])).matrix, np.array([tx, 0.0, 0.0])).inverse()
        one, two = (
            CAMERA.project(where.apply(points)) + s * off
            for where, off in zip((Rigid3.identity(), motion), noise_px)
        )
        rays1, rays2 = (CAMERA.unproject(pixels) for pixels in (one, two))
        rays1, rays2 = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (rays1, rays2))
        u, _, vt = np.linalg.svd(rays2.T @ rays1)
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        off = {"F": sampson_error(solve_fundamental_eight_point(one, two), one, two)}
        off["E"] = best_essential(one, two, motion)
        homographies = {
            "H": solve_homography_dlt(one, two),
            "R": CAMERA.K @ R @ np.linalg.inv(CAMERA.K),
            "S": np.eye(3),
        }
        for name, H in homographies.items():
            seen = np.c_[one, np.ones(len(one))] @ H.T
            off[name] = np.linalg.norm(seen[:, :2] / seen[:, 2:] - two, axis=1) / np.sqrt(2.0)
        criteria = {}
        for name, d, k in (
            ("F", 3.0, 7.0),
            ("E", 3.0, 5.0),
            ("H", 2.0, 8.0),
            ("R", 2.0, 3.0),
            ("S", 2.0, 0.0),
        ):
            rest = np.minimum(off[name] ** 2 / s**2, 2 * (4 - d)).sum()
            criteria[name] = float(_gric.py_func(rest, len(one), d, k))
            close(shown[f"rms-{name}"], np.sqrt(np.mean(np.square(off[name]))))
            if name != "E":
                close(shown[f"gric-{name}"], criteria[name])
        # The sum of squares is flat where it is least, and tells E to half of its digits; the criterion's
        # cut sum is not flat there. So it is compared for the page's own E.
        F = np.array(tab.page.evaluate("values => modelNumbers(values).found.E.model", at))
        rest = np.minimum(sampson_error(F, one, two) ** 2 / s**2, 2.0).sum()
        close(shown["gric-E"], float(_gric.py_func(rest, len(one), 3.0, 5.0)))
        best = min(criteria, key=criteria.get)
        assert tab.page.locator(f"#verdict-{best}").inner_text() == "selected"
        if (relief, tx, yaw) in known:
            assert verify_pair(one, two, CAMERA, CAMERA, is_calibrated=True).kind is chosen[best]
