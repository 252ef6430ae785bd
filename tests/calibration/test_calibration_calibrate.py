"""Calibration against exact truth: values, standard deviations, spoiled views and corners, what cannot be known."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_views import FISHEYE, LENS, OTHER, RIGHT_FROM_LEFT, board_places, views_of

from epipole.cameras import Camera, CameraModel
from epipole.config import BoardConfig
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.features.boards import BoardView, corners_on_board
from epipole.geometry import Rigid3
from epipole.pipelines.calibration.calibrate import ViewState, calibrate_views
from epipole.pipelines.calibration.comparison import cross_check, projection_difference
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.observations import warp_shapes
from epipole.pipelines.calibration.uncertainty import projection_sigma
from epipole.pipelines.calibration.verdict import assess
from whole import IS_WHOLE, in_whole_run

BOARD = BoardConfig(columns=9, rows=6, square=0.025)
CONFIG = CalibrationConfig(board=BOARD)
SIZE = (640, 480)


def seen_by(cameras, seed, count=20, noise_px=0.1, **more):
    rng = np.random.default_rng(seed)
    motions = [Rigid3(np.eye(3), np.zeros(3)), RIGHT_FROM_LEFT][: len(cameras)]
    return views_of(cameras, motions, board_places(rng, count), BOARD, rng, noise_px, **more)


def test_exact_corners_give_the_exact_camera():
    found = calibrate_views(seen_by([LENS], 0, noise_px=0.0), [SIZE], CONFIG)
    np.testing.assert_allclose(found.cameras[0].params, LENS.params, rtol=1e-5, atol=1e-6)
    assert found.rms_px < 1e-5


def test_fisheye_is_found():
    config = CalibrationConfig(board=BOARD, model="OPENCV_FISHEYE")
    rng = np.random.default_rng(1)
    positions = board_places(rng, 30, (0.12, 0.4), spread=1.2)
    views = views_of([FISHEYE], [Rigid3(np.eye(3), np.zeros(3))], positions, BOARD, rng)
    found = calibrate_views(views, [SIZE], config)
    assert np.nanmedian(projection_difference(FISHEYE, found.cameras[0]).distance_px) < 0.15


@in_whole_run
@pytest.mark.usefixtures("unchecked")
def test_standard_deviations_are_those_of_repeated_calibrations():
    """Normalized errors of all parameters and of the rig's motion over 10 calibrations: the mean square is one."""
    squares = []
    for seed in range(10):
        found = calibrate_views(
            seen_by([LENS, OTHER], 100 + seed, count=12, noise_px=0.2), [SIZE, SIZE], CONFIG
        )
        rig = found.rig()
        estimated = np.flatnonzero(np.diag(rig.covariance))  # the rest is padding
        known = rig.covariance[np.ix_(estimated, estimated)]
        error = np.concatenate(
            [
                rig.left.params - LENS.params,
                rig.right.params - OTHER.params,
                (rig.right_from_left @ RIGHT_FROM_LEFT.inverse()).log(),
            ]
        )
        squares.append(error @ np.linalg.solve(known, error) / 22)
    assert 0.8 < np.mean(squares) < 1.25  # of 10 x 22 unknowns: 1 +- 0.095


@pytest.mark.usefixtures("unchecked")
def test_projected_uncertainty_is_that_of_repeated_calibrations():
    """The spread of a point fixed to the boards, which is what the boards' places carry along."""
    at, errors, sigmas = np.array([[100.0, 80.0], [320.0, 240.0], [560.0, 400.0]]), [], []
    for seed in range(20 if IS_WHOLE else 12):
        rng = np.random.default_rng(7)
        positions = board_places(rng, 12)
        rng = np.random.default_rng(500 + seed)
        views = views_of([LENS], [Rigid3(np.eye(3), np.zeros(3))], positions, BOARD, rng, 0.2)
        found = calibrate_views(views, [SIZE], CONFIG)
        # A point of the truth, carried with every board, seen by the camera that was found.
        points = 5.0 * LENS.unproject(at)
        moved = np.mean(
            [
                (found.state.rig_from_board[v] @ positions[v].inverse()).apply(points)
                for v in range(len(positions))
                if found.view_states[0][v] is ViewState.USED
            ],
            axis=0,
        )
        errors.append(found.cameras[0].project(moved) - at)
        sigmas.append(projection_sigma(found.state, found.uncertainty, 0, at, 5.0))
    spread = np.sqrt([np.linalg.eigvalsh(np.cov(np.array(errors)[:, k].T))[1] for k in range(3)])
    np.testing.assert_allclose(np.mean(sigmas, axis=0), spread, rtol=0.35)


def test_three_spoiled_views_of_ten_are_found_and_the_rest_used():
    views = seen_by([LENS, OTHER], 3, count=10)
    rng = np.random.default_rng(5)
    clean = calibrate_views(
        [[v for k, v in enumerate(own) if k not in (1, 4, 7)] for own in views], [SIZE] * 2, CONFIG
    )
    views[0][1] = BoardView(
        views[0][1].corner, views[0][1].pixels + rng.normal(0, 4.0, views[0][1].pixels.shape)
    )
    views[1][4] = BoardView(views[1][4].corner, rng.permutation(views[1][4].pixels))
    views[1][7] = views[1][8]  # the right camera took this one later: the board had moved
    found = calibrate_views(views, [SIZE] * 2, CONFIG)
    assert found.view_states[0][1] is ViewState.OFF
    assert found.view_states[1][4] in (ViewState.OFF, ViewState.NO_POSE)
    assert ViewState.OFF in (found.view_states[0][7], found.view_states[1][7])
    good = [k for k in range(10) if k not in (1, 4, 7)]
    assert all(found.view_states[c][k] is ViewState.USED for c in (0, 1) for k in good)
    sigma = clean.params_sigma(0)
    assert (np.abs(found.cameras[0].params - clean.cameras[0].params) < 2.0 * sigma).all()
    assert abs(found.rig().baseline - clean.rig().baseline) < 2.0 * clean.baseline_sigma()


def test_wrong_corners_are_left_out_one_by_one():
    views = seen_by([LENS], 9)
    rng = np.random.default_rng(1)
    spoiled = []
    for view in views[0]:
        pixels = view.pixels.copy()
        if len(view):
            wrong = rng.choice(len(view), 3, replace=False)
            pixels[wrong] += rng.choice([-1, 1], (3, 2)) * rng.uniform(2, 30, (3, 2))
        spoiled.append(BoardView(view.corner, pixels))
    found, clean = calibrate_views([spoiled], [SIZE], CONFIG), calibrate_views(views, [SIZE], CONFIG)
    assert 0.9 < found.used_mask.mean() < 0.96
    assert (np.abs(found.cameras[0].params - clean.cameras[0].params) < clean.params_sigma(0)).all()


def test_a_bent_board_is_straightened():
    warp = np.array([2e-3, -1e-3])
    shape = corners_on_board(BOARD)
    shape[:, 2] = warp_shapes(shape) @ warp
    rng = np.random.default_rng(4)
    positions = board_places(rng, 40, tilt=0.9)
    views = views_of([LENS], [Rigid3(np.eye(3), np.zeros(3))], positions, BOARD, rng, shape=shape)
    stiff = calibrate_views(views, [SIZE], CONFIG)
    found = calibrate_views(views, [SIZE], CalibrationConfig(board=BOARD, refine_warp=True))
    sigma = np.sqrt(np.diag(found.uncertainty.theta)[-2:])
    assert (np.abs(found.state.warp - warp) < 4.0 * sigma).all() and (sigma < 1e-4).all()
    assert found.rms_px < 0.2 < 1.2 * stiff.rms_px
    assert (np.abs(found.cameras[0].params - LENS.params) < 4.0 * found.params_sigma(0)).all()


@pytest.mark.usefixtures("unchecked")
def test_a_healthy_calibration_passes_and_poor_ones_say_why():
    views = seen_by([LENS], 12, count=30)
    found = calibrate_views(views, [SIZE], CONFIG)
    check = cross_check(views, found)
    assert check is not None and check.held_out_rms_px < 1.2 * check.fitted_rms_px
    assert check.difference_px[0] < 1.0
    assert assess(found, check).passes
    few = calibrate_views([views[0][:4]], [SIZE], CONFIG)
    verdict = assess(few, cross_check([views[0][:4]], few))
    assert not verdict.passes and "views are used" in verdict.sentence


@in_whole_run
@pytest.mark.usefixtures("unchecked")
def test_halves_that_disagree_widen_the_standard_deviations():
    """Where the model holds chance explains the halves' difference; where it does not, errors are as large as they say."""
    disagreements = []
    for seed in range(3 if IS_WHOLE else 2):
        views = seen_by([LENS, OTHER], seed, count=12)
        check = cross_check(views, calibrate_views(views, [SIZE] * 2, CONFIG))
        assert check is not None and check.num_unknowns == 22 and check.widening == 1.0
        disagreements.append(check.disagreement)
    assert 0.7 < np.mean(disagreements) < 1.35  # of 2 x 22 unknowns: 1 +- 0.21
    config = CalibrationConfig(board=BOARD, model="PINHOLE")
    views = seen_by([LENS], 3, count=16)
    stiff = calibrate_views(views, [SIZE], config)
    check = cross_check(views, stiff)
    assert check is not None and check.widening > 2.0
    wide = replace(stiff, uncertainty=stiff.uncertainty.widened(check.widening))
    np.testing.assert_allclose(wide.params_sigma(0), check.widening * stiff.params_sigma(0))
    grid = np.array([[320.0, 240.0], [100.0, 80.0]])
    sigmas = [projection_sigma(c.state, c.uncertainty, 0, grid, 1.0) for c in (wide, stiff)]
    np.testing.assert_allclose(sigmas[0], check.widening * sigmas[1])


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_calibrated_is_said():
    views = seen_by([LENS], 0)
    with pytest.raises(DegenerateGeometryError, match="at least 3"):
        calibrate_views([views[0][:2]], [SIZE], CONFIG)
    with pytest.raises(ShapeError, match="the same number of views"):
        calibrate_views([views[0], views[0][:3]], [SIZE, SIZE], CONFIG)
    with pytest.raises(ShapeError, match="corners that are not on the board"):
        calibrate_views([[BoardView(np.array([99]), np.zeros((1, 2)))] * 4], [SIZE], CONFIG)
    flat = Rigid3(np.eye(3), np.array([-0.1, -0.06, 0.5]))
    rng = np.random.default_rng(0)
    positions = [
        Rigid3(flat.rotation, flat.translation + np.array([0.02 * k, 0.01 * k, 0.0])) for k in range(6)
    ]
    frontal = views_of([LENS], [Rigid3(np.eye(3), np.zeros(3))], positions, BOARD, rng)
    found = calibrate_views(frontal, [SIZE], CONFIG)
    assert not assess(found, cross_check(frontal, found)).passes
    assert found.params_sigma(0)[0] > 5.0  # parallel boards do not tell the focal length


def test_projection_difference_ignores_a_turn_of_the_camera():
    same = projection_difference(LENS, LENS)
    assert np.nanmax(same.distance_px) < 1e-6
    params = LENS.params.copy()
    params[2] += 3.0  # nearly a turn by 3 / 520 about the vertical
    moved = projection_difference(LENS, Camera(LENS.model, 640, 480, params))
    assert np.nanmedian(moved.distance_px) < 0.5
    params[0] *= 1.02
    assert np.nanmedian(projection_difference(LENS, Camera(LENS.model, 640, 480, params)).distance_px) > 1.0


def test_a_lens_with_k3_is_found_with_it_only():
    camera = Camera(
        CameraModel.FULL_OPENCV,
        *SIZE,
        np.array([520.0, 524.0, 315.0, 236.0, -0.3, 0.15, 1e-3, -5e-4, -0.08, 0.0, 0.0, 0.0]),
    )
    rng = np.random.default_rng(3)
    views = views_of([camera], [Rigid3(np.eye(3), np.zeros(3))], board_places(rng, 30), BOARD, rng, 0.05)
    found = calibrate_views(views, [SIZE], CalibrationConfig(board=BOARD, model="FULL_OPENCV"))
    sigma = found.params_sigma(0)
    assert (sigma[9:] == 0).all() and (found.cameras[0].params[9:] == 0).all()
    assert (np.abs(found.cameras[0].params - camera.params)[:9] < 4.0 * sigma[:9]).all()
