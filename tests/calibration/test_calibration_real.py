"""Real boards against OpenCV and against known lenses."""

import json

import cv2
import numpy as np
import pytest

from epipole import api
from epipole.cameras import Camera, CameraModel
from epipole.config import BoardConfig
from epipole.features.boards import BoardView, find_board
from epipole.io.calibration.files import read_calibration, read_stereo_rig
from epipole.io.images.photographs import read_gray
from epipole.pipelines.calibration.calibrate import ViewState, calibrate_views
from epipole.pipelines.calibration.comparison import projection_difference
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.coverage import covered_pixels

SIZE = (640, 480)
BOARD = BoardConfig(columns=9, rows=6, square=0.025)


@pytest.fixture(scope="module")
def pair_views(data_dir):
    folder = data_dir / "calibration" / "opencv_stereo"
    names = [f"{k:02d}.jpg" for k in range(1, 15) if k != 10]
    return [
        [find_board(read_gray(folder / f"{side}{n}"), BOARD) for n in names] for side in ("left", "right")
    ]


def opencv_stereo(views):
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = 0.025 * np.mgrid[:9, :6].T.reshape(-1, 2)
    boards = [board] * len(views[0])
    left, right = ([v.pixels.astype(np.float32) for v in own] for own in views)
    options = {"flags": cv2.CALIB_FIX_K3}
    one = cv2.calibrateCamera(boards, left, SIZE, None, None, **options)
    two = cv2.calibrateCamera(boards, right, SIZE, None, None, **options)
    return cv2.stereoCalibrate(
        *(boards, left, right, one[1], one[2], two[1], two[2], SIZE),
        flags=cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(3, 200, 1e-9),
    )


def test_a_real_pair_is_no_worse_than_opencvs(pair_views):
    rms, k1, _, k2, _, _, translation, *_ = opencv_stereo(pair_views)
    every = CalibrationConfig(board=BOARD, outlier_factor=1e6, max_view_factor=1e6)
    same = calibrate_views(pair_views, [SIZE] * 2, every)
    assert same.used_mask.all() and same.rms_px <= 1.01 * rms
    found = calibrate_views(pair_views, [SIZE] * 2, CalibrationConfig(board=BOARD))
    assert found.rms_px <= 1.01 * rms
    assert abs(found.rig().baseline - np.linalg.norm(translation)) < found.baseline_sigma()
    for c, matrix in enumerate((k1, k2)):
        assert (np.abs(found.cameras[c].params[:2] - np.diag(matrix)[:2]) < found.params_sigma(c)[:2]).all()


def test_ten_real_views_with_three_spoiled(pair_views):
    whole = calibrate_views(pair_views, [SIZE] * 2, CalibrationConfig(board=BOARD))
    views = [list(own[:10]) for own in pair_views]
    clean = calibrate_views(
        [[v for k, v in enumerate(own) if k not in (2, 5, 8)] for own in views],
        [SIZE] * 2,
        CalibrationConfig(board=BOARD),
    )
    rng = np.random.default_rng(0)
    views[0][2] = BoardView(views[0][2].corner, views[0][2].pixels[::-1].copy())
    views[1][5] = views[1][6]
    views[1][8] = BoardView(views[1][8].corner, views[1][8].pixels + rng.normal(0, 5, (54, 2)))
    found = calibrate_views(views, [SIZE] * 2, CalibrationConfig(board=BOARD))
    left_out = {k for k in range(10) if any(found.view_states[c][k] is not ViewState.USED for c in (0, 1))}
    assert left_out == {2, 5, 8}
    assert abs(found.rig().baseline - clean.rig().baseline) < 2.0 * clean.baseline_sigma()
    for c in (0, 1):
        difference = np.abs(found.cameras[c].params[:2] - whole.cameras[c].params[:2])
        assert (difference < 3.0 * found.params_sigma(c)[:2]).all()


def test_the_command_on_a_folder_of_pairs(data_dir, tmp_path, pair_views):
    run = api.calibrate(data_dir / "calibration" / "opencv_stereo", tmp_path, CalibrationConfig(board=BOARD))
    assert run.verdict.passes and len(run.calibration.cameras) == 2
    page = (tmp_path / "report.html").read_text()
    assert "Pass:" in page and "left01.jpg" in page and ">nan" not in page
    ours = read_stereo_rig(tmp_path / "calibration.json")
    theirs = read_stereo_rig(tmp_path / "opencv.yaml")
    ros = read_stereo_rig(tmp_path / "ros_left.yaml", tmp_path / "ros_right.yaml")
    assert ours.covariance is not None and theirs.covariance is None
    widened = json.loads((tmp_path / "calibration.json").read_text())["about"]["sigmas_widened_by"]
    assert run.check is not None and widened == run.check.widening > 1.5
    plain = calibrate_views(pair_views, [SIZE] * 2, CalibrationConfig(board=BOARD))
    np.testing.assert_allclose(ours.covariance, widened**2 * plain.rig().covariance, rtol=1e-6)
    for other in (theirs, ros):
        np.testing.assert_allclose(other.left.params, ours.left.params, rtol=1e-9)
        np.testing.assert_allclose(
            other.right_from_left.as_matrix(), ours.right_from_left.as_matrix(), atol=1e-9
        )
    assert read_calibration(tmp_path / "opencv.yaml").cameras[1].width == 640


def test_a_known_wide_lens(data_dir):
    folder = data_dir / "slam" / "ar_cube"
    board = BoardConfig(columns=9, rows=6, square=0.04)
    views = [find_board(read_gray(path), board) for path in sorted((folder / "images").iterdir())]
    assert len(views) == 37 and all(len(view) == 54 for view in views)
    matrix, (k1, k2) = np.loadtxt(folder / "K.txt"), np.loadtxt(folder / "D.txt")
    focal = matrix[0, 0]
    params = np.array(
        [focal, matrix[1, 1], matrix[0, 2], matrix[1, 2], k1 * focal**2, k2 * focal**4, 0.0, 0.0]
    )
    known = Camera(CameraModel.OPENCV, 752, 480, params)
    # The given lens has two radial coefficients of the radius in pixels: so has ours for the whole image.
    radial = calibrate_views([views], [(752, 480)], CalibrationConfig(board=board, model="RADIAL"))
    assert np.nanmedian(projection_difference(known, radial.cameras[0]).distance_px) < 0.5
    found = calibrate_views([views], [(752, 480)], CalibrationConfig(board=board))
    assert found.rms_px < 0.06
    seen = projection_difference(known, found.cameras[0], covered_pixels(found, 0))
    assert np.nanmedian(seen.distance_px) < 0.5
