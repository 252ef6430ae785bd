"""The small figures of the pages on models, bundle adjustment, pipelines, failures and fields, against the library."""

import itertools

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.geometry.epipolar import (
    epipolar_lines,
    essential_from_cam2_from_cam1,
    fundamental_from_essential,
)
from epipole.geometry.homogeneous import point_line_distance
from epipole.lesson.scenes import ring
from epipole.optim import Loss, evaluate_loss
from epipole.solvers import solve_homography_dlt

CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def called(tab, expression):
    """The value of an expression on the page that is open."""
    return tab.page.evaluate(f"() => {expression}")


def motion(given):
    return Rigid3(np.array(given["R"]), np.array(given["t"]))


def test_a_homography_maps_a_plane_exactly_and_nothing_else(tab):
    tab.open("07_models.html")
    side = motion(called(tab, "SIDE"))
    for tilt, lift in ((20.0, 0.7), (-35.0, -0.9), (0.0, 0.0)):
        tab.set(tilt=tilt, lift=lift)
        shown, given = tab.shown(), called(tab, f"planeNumbers({{ tilt: {tilt}, lift: {lift} }})")
        points, off = np.array(given["points"]), np.array(given["off"])
        H = solve_homography_dlt(CAMERA.project(points), CAMERA.project(side.apply(points)))
        x = H @ [*CAMERA.project(off[None])[0], 1.0]
        parallax = np.linalg.norm(x[:2] / x[2] - CAMERA.project(side.apply(off[None]))[0])
        assert shown["on"] == pytest.approx(0.0, abs=1e-9)
        assert shown["beside"] == pytest.approx(parallax, rel=1e-6, abs=1e-6)
        assert (shown["beside"] > 1.0) == (lift != 0.0)


def test_a_rotation_moves_all_depths_alike(tab):
    tab.open("07_models.html")
    for yaw in (-12.0, 0.0, 7.0):
        found = called(tab, f"flowNumbers({{ rx: 0, ry: {yaw} }})")
        assert [found["near"], found["far"]] == pytest.approx([0.0, 0.0], abs=1e-9)
    found = called(tab, "flowNumbers({ rx: 0.3, ry: 0 })")
    for point in ("nearest", "farthest"):
        flow = found[point]
        assert flow["from"][0] - flow["to"][0] == pytest.approx(520.0 * 0.3 / flow["depth"])


def test_a_plane_leaves_the_epipole_open(tab):
    tab.open("07_models.html")
    for eu, ev in ((150.0, 60.0), (-200.0, 500.0), (900.0, 100.0)):
        most = called(tab, f"pencilNumbers({{ eu: {eu}, ev: {ev} }}).most")
        assert most["on"] == pytest.approx(0.0, abs=1e-8) and most["off"] > 3.0
    truth = called(tab, "pencilNumbers({ eu: 0, ev: 0 }).epipole")
    found = called(tab, f"pencilNumbers({{ eu: {truth[0]!r}, ev: {truth[1]!r} }})")
    assert found["most"]["off"] == pytest.approx(0.0, abs=1e-8)
    aside = motion(called(tab, "ASIDE"))
    F = fundamental_from_essential(essential_from_cam2_from_cam1(aside), CAMERA.K, CAMERA.K)
    points = np.array(called(tab, "[...WALL_POINTS, ...BESIDE_POINTS]"))
    lines = epipolar_lines(F, CAMERA.project(points))
    assert point_line_distance(np.array([truth]), lines) == pytest.approx(np.zeros(len(points)), abs=1e-8)


def test_residuals_change_only_where_a_camera_or_a_point_is_displaced(tab):
    tab.open("08_bundle.html")
    still, camera, point = (
        called(tab, f"insetNumbers({{ by_camera: {a}, by_point: {b} }})")
        for a, b in ((0, 0), (0.2, 0), (0, 0.2))
    )
    assert [camera["rms"][k] == still["rms"][k] for k in range(3)] == [True, False, True]
    for k in range(3):
        changed = [a != b for a, b in zip(point["images"][k], still["images"][k], strict=True)]
        assert sum(changed) == 1
    scene = ring()
    shown = scene.cams_from_world[called(tab, "SHOWN[1]")]
    moved = Rigid3(shown.rotation, shown.translation + np.array([0.2, 0.0, 0.0]))
    image = camera["images"][1]
    points = scene.points_in_world[[seen["j"] for seen in image]]
    off = CAMERA.project(moved.apply(points)) - [seen["pixel"] for seen in image]
    assert camera["rms"][1] == pytest.approx(np.sqrt(np.mean(off**2)))


def test_blocks_are_those_of_the_normal_matrix(tab):
    tab.open("08_bundle.html")
    for c, p, k in ((5, 12, 3), (2, 4, 12), (12, 40, 5)):
        found = called(tab, f"arrowNumbers({{ c: {c}, p: {p}, k: {k} }})")
        J = np.zeros((found["rows"], found["all"]))
        for row, column, height, width in [*found["J"]["one"], *found["J"]["point"]]:
            J[row : row + height, column : column + width] = np.random.default_rng(row).normal(
                size=(height, width)
            )
        H = np.zeros((found["all"], found["all"]), bool)
        for row, column, height, width in itertools.chain(*found["H"].values()):
            H[row : row + height, column : column + width] = True
        assert np.array_equal(J.T @ J != 0, H) and np.linalg.matrix_rank(J) <= found["all"]
        assert [found["filled"]["J"], found["filled"]["H"]] == pytest.approx(
            [100 * np.mean(J != 0), 100 * H.mean()]
        )


def test_costs_of_a_step_are_those_of_the_page(tab):
    tab.open("08_bundle.html")
    for many, each in ((10, 10), (30, 20)):
        found = called(tab, f"workNumbers({{ many: {many}, each: {each} }})")
        counted = called(
            tab,
            f"operations({{ U: Array({many + 1}), V: Array({many * each}), W: Array({many * each}).fill(Array(TRACK)) }})",
        )
        assert [found["dense"], found["schur"]] == pytest.approx([counted["whole"], counted["reduced"]])


def test_the_pull_is_the_derivative_of_the_loss(tab):
    tab.open("08_bundle.html")
    r, step = np.linspace(0.1, 20.0, 9), 1e-6
    for scale in (0.5, 1.0, 5.0):
        for name, loss in (("squared", Loss.TRIVIAL), ("cauchy", Loss.CAUCHY)):
            above, below = (evaluate_loss(loss, (r + sign * step) ** 2, scale) for sign in (1, -1))
            pull = called(tab, f"{r.tolist()}.map(r => PULLS.{name}(r, {scale}))")
            assert pull == pytest.approx((above - below) / (4 * step), rel=1e-6)
