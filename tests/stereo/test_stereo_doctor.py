"""The doctor finds what was done to a healthy pair."""

import cv2
import numpy as np
import pytest

from epipole import api
from epipole.cameras import Camera, CameraModel
from epipole.config import BoardConfig
from epipole.errors import ShapeError
from epipole.features.boards import find_board
from epipole.geometry import Rigid3
from epipole.io.calibration.files import read_stereo_rig
from epipole.io.images.photographs import read_gray, read_rgb
from epipole.pipelines.calibration.calibrate import calibrate_views
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.doctor import TYPICAL_SIGMA_PX, Cause, examine
from epipole.pipelines.stereo.pair import measure_pair
from epipole.pipelines.stereo.run import examine_stereo
from epipole.scene import RectifiedRig, StereoRig
from epipole.synthetic.stereo_rooms import stereo_room
from whole import IS_WHOLE

BOARD = BoardConfig(columns=9, rows=6, square=0.025)


@pytest.fixture(scope="module")
def cones(data_dir):
    folder = data_dir / "stereo" / "middlebury_2003" / "cones"
    return read_rgb(folder / "im2.png"), read_rgb(folder / "im6.png")


def rotated(image, matrix):
    height, width = image.shape[:2]
    return cv2.warpPerspective(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)


def about_center(image, inner):
    height, width = image.shape[:2]
    center = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1.0]])
    return np.linalg.inv(center) @ inner @ center


def test_a_healthy_pair_is_healthy(cones):
    found = examine([cones])
    assert found.is_healthy and found.cause is Cause.NONE
    assert found.vertical_median_px < 0.2 and found.num_matches > 300
    assert found.expectations == ()


def test_swapped_pictures(cones):
    assert any("swapped" in p for p in examine([cones[::-1]]).problems)


def test_a_pair_of_far_things_swapped():
    pair = stereo_room(4, (480, 360))
    near = pair.disparity_px[np.isfinite(pair.disparity_px)]
    assert np.median(near) > 2.0
    found = examine([(pair.right, pair.left)])
    assert any("swapped" in p for p in found.problems)
    assert not any("swapped" in p for p in examine([(pair.left, pair.right)]).problems)


WRONG = {
    "pitch": np.array([[1, 0, 0], [0, 1, 3.0], [0, 0, 1]]),
    "yaw": np.array([[1, 0, 0], [0, 1, 0], [1.5e-4, 0, 1.0]]),
    "roll": np.array([[np.cos(0.02), -np.sin(0.02), 0], [np.sin(0.02), np.cos(0.02), 0], [0, 0, 1]]),
    "focal length": np.array([[1.02, 0, 0], [0, 1.02, 0], [0, 0, 1.0]]),
}


@pytest.mark.parametrize("name", list(WRONG) if IS_WHOLE else ["pitch", "yaw"])
def test_a_camera_that_stands_wrong(cones, name):
    left, right = cones
    inner = WRONG[name]
    found = examine([(left, rotated(right, about_center(right, inner)))])
    assert found.cause is Cause.EXTRINSICS and not found.is_healthy
    assert found.after_extrinsics_px < 0.3
    if inner[1, 2]:
        assert found.vertical_signed_px == pytest.approx(3.0, abs=0.2)
        assert np.nanmedian(found.vertical_map_px) == pytest.approx(3.0, abs=0.3)


def test_a_lens_that_was_not_undone(cones):
    left, right = cones
    height, width = right.shape[:2]
    matrix = np.array([[400.0, 0, width / 2], [0, 400.0, height / 2], [0, 0, 1]])
    bent = cv2.undistort(right, matrix, np.array([-0.12, 0.0, 0, 0]))
    found = examine([(left, bent)])
    assert found.cause is Cause.DISTORTION
    assert found.after_distortion_px < 0.8 * found.after_extrinsics_px


def test_cameras_that_do_not_expose_together(data_dir):
    folder = data_dir / "slam" / "kitti06_stereo"
    names = [sorted((folder / side).iterdir())[:12:2] for side in ("image_l", "image_r")]
    left, right = ([read_rgb(p) for p in own] for own in names)
    rig = RectifiedRig(707.0912, 601.8873, 183.1104, 379.8145 / 707.0912)
    together = examine(list(zip(left, right)), rig)
    assert together.is_healthy and not any("synchronous" in words for words in together.notes)
    # Either camera late: the rig turns and rises in between, so that the rows' offset changes from pair to pair.
    for one, other in [(left[:-1], right[1:])] + IS_WHOLE * [(left[1:], right[:-1])]:
        apart = examine(list(zip(one, other)), rig)
        assert not apart.is_healthy and any("not synchronous" in p for p in apart.problems)
    steps = [examine([(a, b)], rig).vertical_median_px for a, b in zip(left[:2], right[:2])]
    assert max(steps) < 0.6


def test_the_table_is_the_lessons_formula():
    rig = RectifiedRig(800.0, 319.5, 239.5, 0.12)
    blank = np.zeros((480, 640), np.uint8)
    found = examine([(blank, blank)], rig)
    assert found.cause is Cause.UNKNOWN and np.isnan(found.vertical_median_px)
    by_depth = {e.depth: e for e in found.expectations}
    assert by_depth[10.0].from_matching == pytest.approx(100 / 96 * TYPICAL_SIGMA_PX)
    assert np.isnan(by_depth[10.0].from_calibration)
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([800.0, 800.0, 319.5, 239.5]))
    covariance = np.zeros((30, 30))
    covariance[24, 24] = 0.0012**2  # of the translation along x: one part in a hundred of the baseline
    calibrated = StereoRig(camera, camera, Rigid3(np.eye(3), np.array([-0.12, 0, 0])), covariance)
    table = {e.depth: e for e in examine([(blank, blank)], calibrated).expectations}
    assert table[10.0].from_calibration == pytest.approx(0.1, rel=0.01)


def test_odd_units_and_unusable_input(cones):
    assert any("millimeters" in n for n in examine([cones], RectifiedRig(400.0, 225, 187, 160.0)).notes)
    assert any("too short" in p for p in examine([cones], RectifiedRig(400.0, 225, 187, 1e-4)).problems)
    with pytest.raises(ShapeError, match="no pair"):
        examine([])
    with pytest.raises(ShapeError, match="the same size"):
        examine([(cones[0], cones[1][:100])])


def test_the_call_on_files(data_dir):
    folder = data_dir / "stereo" / "middlebury_2003" / "cones"
    assert examine_stereo(folder / "im2.png", folder / "im6.png").is_healthy


def test_pictures_exchanged_under_their_calibration_are_told(data_dir):
    folder = data_dir / "slam" / "euroc_static" / "mav0"
    rig = read_stereo_rig(folder / "cam0" / "sensor.yaml", folder / "cam1" / "sensor.yaml")
    left, right = (read_rgb(sorted((folder / cam / "data").glob("*.png"))[0]) for cam in ("cam0", "cam1"))
    assert examine([(left, right)], rig).is_healthy
    assert any("exchanged, their rows match" in p for p in examine([(right, left)], rig).problems)


def test_repeated_corners_do_not_spoil_the_rows(data_dir):
    """Most features of a chessboard match wrongly: that is no fault of the calibration."""
    folder = data_dir / "calibration" / "opencv_stereo"
    views = [
        [find_board(read_gray(folder / f"{side}{k:02d}.jpg"), BOARD) for k in (1, 2, 3, 5)]
        for side in ("left", "right")
    ]
    rig = calibrate_views(views, [(640, 480)] * 2, CalibrationConfig(board=BOARD)).rig()
    for number in ["02"] + IS_WHOLE * ["03"]:
        pair = [read_rgb(folder / f"{side}{number}.jpg") for side in ("left", "right")]
        warnings = measure_pair(*pair, StereoConfig(max_disparity_px=127), rig).warnings
        assert not any("not rectified" in words for words in warnings)


def test_a_run_warns_of_what_spoils_it(cones, data_dir):
    left, right = cones
    teddy = read_rgb(data_dir / "stereo" / "middlebury_2003" / "teddy" / "im6.png")
    blank = np.zeros_like(left)
    config = StereoConfig(max_disparity_px=63)
    for pair, words in (
        ((left, right), None),
        ((right, left), "swapped"),
        ((left, np.roll(right, 5, axis=0)), "4.9 px off their rows"),
        ((left, teddy), "the same scene"),
        ((blank, blank), "blank, dark or blurred"),
        ((left, left), "the same image"),
    ):
        warnings = measure_pair(*pair, config).warnings
        assert (warnings == ()) if words is None else (len(warnings) == 1 and words in warnings[0])


def test_gray_beside_color_and_sixteen_bits(cones, tmp_path):
    left, right = cones
    color, gray, deep = (tmp_path / f"{name}.png" for name in ("color", "gray", "deep"))
    cv2.imwrite(str(color), left[..., ::-1])
    shade = cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)
    cv2.imwrite(str(gray), shade)
    cv2.imwrite(str(deep), shade.astype(np.uint16) * 257)
    config = StereoConfig(max_disparity_px=63)
    whole = measure_pair(left, right, config).disparities
    for other in (gray, deep):
        found = api.stereo(color, other, tmp_path / other.stem, config)
        assert found.disparities.density == pytest.approx(whole.density, abs=0.01) and found.warnings == ()


def test_what_tells_nothing_is_not_healthy(cones, data_dir):
    left, _ = cones
    teddy = read_rgb(data_dir / "stereo" / "middlebury_2003" / "teddy" / "im6.png")
    for pair, words in (
        ((left, teddy), "too few for a diagnosis"),
        ((np.zeros_like(left),) * 2, "too few for a diagnosis"),
        ((left, left), "the same image"),
    ):
        found = examine([pair])
        assert not found.is_healthy and any(words in p for p in found.problems)


def test_a_turned_picture_and_a_range_too_small_are_noticed(cones):
    left, right = cones
    angle = np.deg2rad(2.0)
    inner = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    tilted = measure_pair(left, rotated(right, about_center(right, inner)), StereoConfig(max_disparity_px=63))
    assert any("off their rows" in w for w in tilted.warnings)
    for options in ({"max_disparity_px": 12}, {"min_disparity_px": 100, "max_disparity_px": 140}):
        assert any(
            "outside the search range" in w
            for w in measure_pair(left, right, StereoConfig(**options)).warnings
        )


def test_a_blank_right_picture_gives_nothing(cones):
    left, _ = cones
    found = measure_pair(left, np.zeros_like(left), StereoConfig(max_disparity_px=63))
    assert found.disparities.density == 0 and found.warnings


def test_every_cause_makes_a_sentence():
    """Offsets in waves are no rotation, no distortion; each cause's text comes after "likely cause"."""
    pair = stereo_room(3, (640, 480))
    height, width = pair.right.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    wavy = cv2.remap(pair.right, x, y + 4 * np.sin(x / 25), cv2.INTER_LINEAR)
    found = examine([(pair.left, wavy)])
    assert found.cause is Cause.UNCLEAR
    assert found.problems[0].endswith(
        "likely cause: blur, rolling shutter or moving objects (neither rig nor distortion explains the offsets)"
    )
    tilted = examine([(pair.left, cv2.remap(pair.right, x, y + 3, cv2.INTER_LINEAR))])
    assert "; likely cause: the rig's geometry (" in tilted.problems[0]
    blank = np.zeros((480, 640), np.uint8)
    assert (
        examine([(blank, blank)])
        .problems[0]
        .startswith("0 features match, too few for a diagnosis: the images")
    )
