"""The small figures of the pages on models, bundle adjustment, pipelines, failures and fields, against the library."""

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
