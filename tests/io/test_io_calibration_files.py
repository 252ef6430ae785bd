"""Calibration files: round trips, the formats of others, and files that are not what they claim."""

import json
import time

import cv2
import numpy as np
import pytest
import yaml

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.camera_topics import camera_topics
from epipole.io.calibration.coefficients import camera_of_coefficients
from epipole.io.calibration.files import (
    CalibrationFile,
    read_calibration,
    read_stereo_rig,
    write_calibration,
    write_opencv_yaml,
    write_ros_yaml,
)
from epipole.pipelines.slam.config import CameraOptions

LENS = Camera(CameraModel.OPENCV, 640, 480, np.array([520.0, 524.0, 315.0, 236.0, -0.25, 0.08, 1e-3, -5e-4]))
FISHEYE = Camera(
    CameraModel.OPENCV_FISHEYE, 640, 480, np.array([230.0, 231.0, 318.0, 242.0, 0.02, -0.01, 0.003, -0.001])
)
MOTION = Rigid3.exp(np.array([-0.12, 0.002, 0.004, 0.01, -0.03, 0.005]))


def pair_of(camera, covariance=None):
    both = Rigid3(np.stack([np.eye(3), MOTION.rotation]), np.stack([np.zeros(3), MOTION.translation]))
    return CalibrationFile((camera, camera), both, covariance)


@pytest.mark.parametrize("camera", [LENS, FISHEYE], ids=["pinhole", "fisheye"])
def test_round_trips(tmp_path, camera):
    covariance = np.diag(np.arange(1.0, 31.0))
    write_calibration(tmp_path / "own.json", pair_of(camera, covariance), {"note": "kept"})
    write_opencv_yaml(tmp_path / "cv.yaml", pair_of(camera))
    rectify = Rigid3.exp(np.array([0, 0, 0, 0.01, 0.02, 0.03])).rotation
    for name, rotation, offset in (("l", rectify, 0.0), ("r", rectify @ MOTION.rotation.T, 1.0)):
        projection = np.column_stack([LENS.K, [0.0, 0.0, 0.0]])
        projection[:, 3] = offset * projection[0, 0] * (rotation @ MOTION.translation)
        write_ros_yaml(tmp_path / f"{name}.yaml", camera, name, rotation, projection)
    files = (["own.json"], ["cv.yaml"], ["l.yaml", "r.yaml"])
    for names in files:
        rig = read_stereo_rig(*[tmp_path / n for n in names])
        assert rig.left.model is camera.model and rig.right.height == 480
        np.testing.assert_allclose(rig.right.params, camera.params, rtol=1e-12)
        np.testing.assert_allclose(rig.right_from_left.as_matrix(), MOTION.as_matrix(), atol=1e-9)
    np.testing.assert_array_equal(read_stereo_rig(tmp_path / "own.json").covariance, covariance)
    single = CalibrationFile((camera,), Rigid3.identity(1))
    for path, write in (
        (tmp_path / "one.json", write_calibration),
        (tmp_path / "one.yaml", write_opencv_yaml),
    ):
        write(path, single)
        np.testing.assert_allclose(read_calibration(path).cameras[0].params, camera.params, rtol=1e-12)
        with pytest.raises(FileFormatError, match="one camera"):
            read_stereo_rig(path)


def test_opencv_reads_what_is_written(tmp_path):
    write_opencv_yaml(tmp_path / "cv.yaml", pair_of(LENS))
    storage = cv2.FileStorage(str(tmp_path / "cv.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("M1").mat(), LENS.K)
    np.testing.assert_allclose(storage.getNode("D2").mat().ravel()[:4], LENS.params[4:])
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    theirs = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), storage.getNode("M1").mat(), storage.getNode("D1").mat()
    )[0]
    np.testing.assert_allclose(LENS.project(points), theirs.reshape(-1, 2), atol=1e-9)


def test_kalibrs_chain(tmp_path):
    matrix = MOTION.as_matrix().tolist()
    own = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": LENS.params[:4].tolist(),
        "distortion_coeffs": LENS.params[4:].tolist(),
        "resolution": [640, 480],
    }
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump({"cam0": own, "cam1": {**own, "T_cn_cnm1": matrix}}))
    rig = read_stereo_rig(tmp_path / "chain.yaml")
    np.testing.assert_allclose(rig.left.params, LENS.params)
    np.testing.assert_allclose(rig.right_from_left.translation, MOTION.translation, atol=1e-12)
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump({"cam0": own, "cam1": own}))
    with pytest.raises(FileFormatError, match="T_cn_cnm1 is missing"):
        read_calibration(tmp_path / "bad.yaml")


def test_missing_keys_are_named(tmp_path):
    write_calibration(tmp_path / "own.json", pair_of(LENS))
    content = json.loads((tmp_path / "own.json").read_text())
    del content["cameras"][1]["params"]["k2"]
    (tmp_path / "own.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="k2 is missing"):
        read_calibration(tmp_path / "own.json")
    storage = cv2.FileStorage(str(tmp_path / "part.yml"), cv2.FILE_STORAGE_WRITE)
    for key in ("M1", "M2"):
        storage.write(key, LENS.K)
    storage.release()
    with pytest.raises(FileFormatError, match="D1, D2, R, T missing"):
        read_calibration(tmp_path / "part.yml")
    write_opencv_yaml(tmp_path / "cv.yaml", pair_of(LENS))
    text = (tmp_path / "cv.yaml").read_text().replace("image_width", "image_wide")
    (tmp_path / "cv.yaml").write_text(text)
    with pytest.raises(FileFormatError, match="image_width and image_height"):
        read_calibration(tmp_path / "cv.yaml")
    assert read_calibration(tmp_path / "cv.yaml", size=(640, 480)).cameras[0].width == 640


@pytest.mark.parametrize(
    "content",
    [b"", b"\x00\xff\xfe", b"[1, 2, 3]", b"{", b"%YAML:1.0\n---\n", b"<?xml version='1.0'?><a>", b"a: [1, 2"],
)
def test_files_that_are_none(tmp_path, content):
    (tmp_path / "x.yaml").write_bytes(content)
    with pytest.raises(FileFormatError):
        read_calibration(tmp_path / "x.yaml")


def test_numbers_that_make_no_camera(tmp_path):
    bad = LENS.K.copy()
    bad[0, 0] = -3
    with pytest.raises(FileFormatError, match="focal length"):
        camera_of_coefficients(tmp_path, (640, 480), bad, np.zeros(5), is_fisheye=False)
    bad[0, 0], bad[0, 1] = 500, 30
    with pytest.raises(FileFormatError, match="skew"):
        camera_of_coefficients(tmp_path, (640, 480), bad, np.zeros(5), is_fisheye=False)
    write_calibration(tmp_path / "own.json", pair_of(LENS))
    content = json.loads((tmp_path / "own.json").read_text())
    content["cameras"][1]["cam_from_rig"]["translation"] = [0, 0, 0]
    (tmp_path / "own.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="baseline is zero"):
        read_stereo_rig(tmp_path / "own.json")
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_calibration(tmp_path / "nothing.yaml")


def test_opencvs_longer_lenses(tmp_path, rng, data_dir):
    """Five and eight coefficients project as OpenCV's do, survive the files, and real files with k3 are read."""
    points = rng.uniform([-0.6, -0.6, 1], [0.6, 0.6, 1.0], (100, 3))
    for d in (
        np.array([-0.27, -0.04, 1e-3, -3e-4, 0.24]),
        np.array([0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.1, 0.01]),
    ):
        camera = camera_of_coefficients(tmp_path, (640, 480), LENS.K, d, is_fisheye=False)
        theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.K, d)[0].reshape(-1, 2)
        np.testing.assert_allclose(camera.project(points), theirs, atol=1e-9)
        write_opencv_yaml(tmp_path / "cv.yaml", pair_of(camera))
        np.testing.assert_allclose(
            read_stereo_rig(tmp_path / "cv.yaml").left.params, camera.params, rtol=1e-12
        )
    real = read_calibration(data_dir / "calibration" / "opencv_stereo" / "left_intrinsics.yml").cameras[0]
    assert real.model is CameraModel.FULL_OPENCV
    assert real.params[8] == pytest.approx(0.23839153080878486)
    with pytest.raises(FileFormatError, match="thin prism"):
        camera_of_coefficients(tmp_path, (640, 480), LENS.K, np.full(12, 0.01), is_fisheye=False)


def test_what_would_give_wrong_depth_is_refused(tmp_path):
    write_calibration(tmp_path / "own.json", pair_of(LENS, np.eye(30)))
    good = json.loads((tmp_path / "own.json").read_text())

    def changed(**values):
        (tmp_path / "bad.json").write_text(json.dumps({**good, **values}))
        return tmp_path / "bad.json"

    negative = np.eye(30)
    negative[3, 3] = -1.0
    for matrix in (np.full((30, 30), np.nan), negative, np.triu(np.ones((30, 30)))):
        with pytest.raises(FileFormatError, match="covariance is not a covariance matrix"):
            read_stereo_rig(changed(covariance=matrix.tolist()))
    with pytest.raises(FileFormatError, match="version 99"):
        read_calibration(changed(version=99))
    with pytest.raises(FileFormatError, match="3 cameras"):
        read_stereo_rig(changed(cameras=[*good["cameras"], good["cameras"][1]]))
    still = [
        dict(c, cam_from_rig={"quat_wxyz": [0, 0, 0, 0], "translation": [1, 0, 0]}) for c in good["cameras"]
    ]
    with pytest.raises(FileFormatError, match="quaternion is zero"):
        read_calibration(changed(cameras=still))
    write_ros_yaml(tmp_path / "l.yaml", LENS, "left")
    (tmp_path / "l.yaml").write_text((tmp_path / "l.yaml").read_text().replace("plumb_bob", "foo"))
    with pytest.raises(FileFormatError, match="distortion_model foo"):
        read_calibration(tmp_path / "l.yaml")


def test_the_first_camera_need_not_be_the_rigs_origin(tmp_path):
    moved = Rigid3.exp(np.array([0.3, -0.1, 0.2, 0.1, 0.0, -0.2]))
    both = Rigid3(
        np.stack([moved.rotation, (MOTION @ moved).rotation]),
        np.stack([moved.translation, (MOTION @ moved).translation]),
    )
    write_calibration(tmp_path / "own.json", CalibrationFile((LENS, LENS), both))
    rig = read_stereo_rig(tmp_path / "own.json")
    np.testing.assert_allclose(rig.right_from_left.as_matrix(), MOTION.as_matrix(), atol=1e-12)


def test_euroc_sensors_are_read(data_dir):
    sensors = [
        data_dir / "slam" / "euroc_static" / "mav0" / name / "sensor.yaml" for name in ("cam0", "cam1")
    ]
    rig = read_stereo_rig(*sensors)
    assert rig.left.model is CameraModel.OPENCV and (rig.left.width, rig.left.height) == (752, 480)
    np.testing.assert_allclose(rig.left.params[:4], [458.654, 457.296, 367.215, 248.375])
    assert rig.baseline == pytest.approx(0.11007, abs=1e-5)
    assert rig.right_from_left.translation[0] < 0  # cam1 stands right of cam0
    assert len(read_calibration(sensors[0]).cameras) == 1


def test_kitti_matrices_are_read(data_dir, tmp_path):
    path = data_dir / "slam" / "kitti06_stereo" / "calib.txt"
    with pytest.raises(FileFormatError, match="image size is unknown"):
        read_stereo_rig(path)
    rig = read_stereo_rig(path, size=(1226, 370))
    np.testing.assert_allclose(rig.left.params, [707.0912, 707.0912, 601.8873, 183.1104])
    np.testing.assert_allclose(rig.right_from_left.translation, [-379.8145 / 707.0912, 0, 0])
    first, second = path.read_text().splitlines()
    named = tmp_path / "calib.txt"
    named.write_text(f"P0: {first}\nP1: {second}\nP2: {first}\nP3: {second}\nTr: {first}\n")
    with pytest.raises(FileFormatError, match="choose two"):
        read_stereo_rig(named, size=(1226, 370))
    other = read_stereo_rig(named, size=(1226, 370), cameras=(2, 3))
    assert other.baseline == pytest.approx(rig.baseline)
    for cameras in ((0, 4), (1, 1), (-1, 0)):
        with pytest.raises(FileFormatError, match="not a pair of them"):
            read_stereo_rig(named, size=(1226, 370), cameras=cameras)
    raw = tmp_path / "calib_cam_to_cam.txt"
    raw.write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nS_rect_00: 1.226e+03 3.7e+02\nR_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: {first}\n"
        f"S_rect_01: 1.226e+03 3.7e+02\nP_rect_01: {second}\n"
    )
    assert read_stereo_rig(raw).left.width == 1226
    raw.write_text(f"P0: {first}\nP1: 1 2 3\n")
    with pytest.raises(FileFormatError, match="P1 is not 3 x 4 numbers"):
        read_stereo_rig(raw, size=(4, 4))


def test_middlebury_calibrations_are_read(tmp_path):
    path = tmp_path / "calib.txt"
    text = (
        "cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]\ncam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]\n"
        "doffs=31.086\nbaseline=193.001\nwidth=741\nheight=497\nndisp=70\nisint=0\n"
    )
    path.write_text(text)
    rig = read_stereo_rig(path)
    assert (rig.left.width, rig.left.height, rig.baseline) == (741, 497, pytest.approx(193.001))
    assert rig.right.params[2] - rig.left.params[2] == pytest.approx(31.086)
    path.write_text(text.replace("baseline", "base"))
    with pytest.raises(FileFormatError, match="the key baseline is missing"):
        read_stereo_rig(path)
    path.write_text(text.replace("193.001", "far"))
    with pytest.raises(FileFormatError, match="baseline is not 1 numbers"):
        read_stereo_rig(path)


def test_opencvs_own_rectified_matrices_are_not_taken_for_the_cameras(tmp_path):
    """The sample writes R1, R2, P1, P2 and Q beside R and T."""
    d = np.array([[-0.3, 0.1, 0.0, 0.0, 0.0]])
    K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
    rotation, translation = (
        Rigid3.exp(np.array([0, 0, 0, 0.01, 0.02, 0.0])).rotation,
        np.array([-0.12, 0.002, 0.001]),
    )
    rectified = cv2.stereoRectify(K, d, K, d, (640, 480), rotation, translation[:, None])
    for name, values in (
        ("intrinsics.yml", {"M1": K, "D1": d, "M2": K, "D2": d}),
        (
            "extrinsics.yml",
            {"R": rotation, "T": translation} | dict(zip(("R1", "R2", "P1", "P2", "Q"), rectified)),
        ),
    ):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            storage.write(key, value)
        storage.release()
    rig = read_stereo_rig(tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml", size=(640, 480))
    np.testing.assert_allclose(rig.left.params[:5], [500, 501, 320, 240, -0.3])
    np.testing.assert_allclose(rig.right_from_left.translation, translation)
    with pytest.raises(FileFormatError, match="M1, D1, M2, D2 missing"):
        read_stereo_rig(tmp_path / "extrinsics.yml", size=(640, 480))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0 5 0 1 0 6 0 0 1 7\n0.9 0.1 0 5 -0.1 0.9 0 6 0 0 1 7\n", "is not a projection"),  # poses
        ("P0: 1 0 0 0 0 1 0 0 0 0 0 0\nP1: 1 0 0 -1 0 1 0 0 0 0 0 0\n", "is not a projection"),
        ("P0: 2 0 0 0 0 2 0 0 0 0 2 0\nP1: 2 0 0 -1 0 2 0 0 0 0 2 0\n", "is not a projection"),
        ("P0: 0 0 0 0 0 0 0 0 0 0 1 0\nP1: 0 0 0 0 0 0 0 0 0 0 1 0\n", "focal"),
        ("5: hi\n", "missing"),
        ("cam0=[1 0 0; 0 1 0; 0 0 1]\ncam1=\nbaseline=1\nwidth=4\nheight=4\n", "cam1 is not"),
        ("# of mine\ncam0=[9 0 1; 0 9 1; 0 0 1]\nx=a" + 60_000 * " " + "b\n", "width and height"),
        ("cam0=[9 0 1; 0 9 1; 0 0 1]\nwidth=1e30\nheight=4\n", "is not valid"),
        ("T_BS: [0]\nintrinsics: [9, 9, 1, 1]\nresolution: [8, 8]\ncamera_model: omni\n", "model omni"),
        ("T_BS: [0]\nintrinsics: [9, 9, 1, 1]\nresolution: [1e30, 8]\n", "is not valid"),
        (f"T_BS: {16 * [0]}\nintrinsics: [9, 9, 1, 1]\nresolution: [8, 8]\n", "not contain a rotation"),
    ],
)
def test_files_of_data_sets_that_are_not_what_they_claim(tmp_path, text, words):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    start = time.perf_counter()
    with pytest.raises(FileFormatError, match=words):
        read_stereo_rig(path, size=(640, 480)) if "width" not in words else read_stereo_rig(path)
    assert time.perf_counter() - start < 1.0


def test_a_folder_has_the_files_of_a_pair(tmp_path):
    camera = Camera("PINHOLE", 64, 48, [50, 50, 31.5, 23.5])
    projection = np.column_stack([camera.K, [-50 * 0.12, 0, 0]])
    write_ros_yaml(tmp_path / "left.yaml", camera, "left")
    with pytest.raises(
        FileFormatError, match=r"a folder without a calibration: expected .*left\.yaml and right\.yaml"
    ):
        read_calibration(tmp_path)
    write_ros_yaml(tmp_path / "right.yaml", camera, "right", np.eye(3), projection)
    rig = CameraOptions(calibration=tmp_path).rig((64, 48))
    assert rig.baseline == pytest.approx(0.12)
    assert read_stereo_rig(tmp_path / "left.yaml", tmp_path / "right.yaml").baseline == rig.baseline
    assert camera_topics(tmp_path) == ()
    with pytest.raises(ConfigError, match="has 2 cameras"):
        CameraOptions(calibration=tmp_path).camera((64, 48))
    for name in ("left.yml", "right.yml"):
        write_ros_yaml(tmp_path / name, camera, "other", np.eye(3), projection)
    with pytest.raises(FileFormatError, match="several calibrations: pass the files, left"):
        read_calibration(tmp_path)
    own = tmp_path / "own"
    own.mkdir()
    write_calibration(own / "calibration.json", CalibrationFile((camera,), Rigid3.identity(1)))
    for name in ("left", "right"):  # as `epipole calibrate` writes them
        write_ros_yaml(own / f"ros_{name}.yaml", camera, name, np.eye(3), projection)
    assert len(read_calibration(own).cameras) == 1
    for name in ("left", "right"):
        (own / f"ros_{name}.yaml").rename(own / f"{name}.yaml")
    with pytest.raises(
        FileFormatError, match=r"several calibrations: pass the files, calibration\.json or left"
    ):
        read_calibration(own)
