"""Settings files of ORB-SLAM and OKVIS: cameras, pairs, and what they leave open."""

import numpy as np
import pytest

from epipole.cameras import CameraModel
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import read_calibration, read_stereo_rig

PINHOLE = """%YAML:1.0
#--------------------------------------------------------------------------------------------
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 458.654
Camera1.fy: 457.296
Camera1.cx: 367.215
Camera1.cy: 248.375
Camera1.k1: -0.28340811
Camera1.k2: 0.07395907
Camera1.p1: 0.00019359
Camera1.p2: 1.76187114e-05
Camera.width: 752
Camera.height: 480
Camera.fps: 20
ORBextractor.nFeatures: 1000
"""
SECOND = """
Camera2.fx: 457.587
Camera2.fy: 456.134
Camera2.cx: 379.999
Camera2.cy: 255.238
Camera2.k1: -0.28368365
Camera2.k2: 0.07451284
Camera2.p1: -0.00010473
Camera2.p2: -3.555907e-05
Stereo.ThDepth: 60.0
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [0.999997256477797,-0.002317135723275,-0.000343393120620,0.110074137800478,
         0.002312067192432,0.999898048507103,-0.014090668452683,-0.000156612054392,
         0.000376008102320,0.014089835846691,0.999900662638081,0.000889382785432,
         0,0,0,1.000000000000000]
"""
OLD = """%YAML:1.0
Camera.fx: 718.856
Camera.fy: 718.856
Camera.cx: 607.1928
Camera.cy: 185.2157
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: 1241
Camera.height: 376
Camera.bf: 386.1448
ThDepth: 35
"""
OKVIS = """%YAML:1.0
cameras:
     - {T_SC:
        [ 0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
          0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
         -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
          0.0, 0.0, 0.0, 1.0],
        image_dimension: [752, 480],
        distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
        distortion_type: radialtangential,
        focal_length: [458.654, 457.296],
        principal_point: [367.215, 248.375]}
     - {T_SC:
        [ 0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556,
          0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024,
         -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038,
          0.0, 0.0, 0.0, 1.0],
        image_dimension: [752, 480],
        distortion_coefficients: [-0.28368365, 0.07451284, -0.00010473, -3.555907e-05],
        distortion_type: radialtangential,
        focal_length: [457.587, 456.134],
        principal_point: [379.999, 255.238]}
imu_params:
    a_max: 176.0
"""


@pytest.fixture
def read(tmp_path):
    def read_text(text, **options):
        path = tmp_path / "settings.yaml"
        path.write_text(text)
        return read_calibration(path, **options)

    return read_text


def test_one_camera(read):
    (camera,) = read(PINHOLE).cameras
    assert (camera.model, camera.width, camera.height) == (CameraModel.OPENCV, 752, 480)
    expected = [458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
    np.testing.assert_array_equal(camera.params, expected)
    (with_k3,) = read(PINHOLE + "Camera1.k3: 0.01\n").cameras
    assert with_k3.model == CameraModel.FULL_OPENCV and with_k3.params[8] == 0.01
    fisheye = PINHOLE.replace('"PinHole"', '"KannalaBrandt8"').replace(".p1", ".k3").replace(".p2", ".k4")
    assert read(fisheye).cameras[0].model == CameraModel.OPENCV_FISHEYE


def test_a_pair_with_its_pose(read):
    found = read(PINHOLE + SECOND)
    second_from_first = found.cam_from_rig[1]
    np.testing.assert_allclose(
        second_from_first.inverse().translation, [0.1100741378, -0.000156612, 0.00088938], atol=1e-8
    )
    assert found.cameras[1].params[0] == 457.587
    old_name = (PINHOLE + SECOND).replace("Stereo.T_c1_c2", "Tlr").replace("rows: 4", "rows: 3")
    old_name = old_name.replace(",\n         0,0,0,1.000000000000000]", "]")
    np.testing.assert_array_equal(read(old_name).cam_from_rig.translation, found.cam_from_rig.translation)


def test_the_same_rig_from_okvis(read):
    """EuRoC's cameras, as ORB-SLAM3 and as OKVIS have them."""
    orb, okvis = read(PINHOLE + SECOND), read(OKVIS)
    for one, other in zip(orb.cameras, okvis.cameras):
        np.testing.assert_array_equal(one.params, other.params)
    between = orb.cam_from_rig[1] @ okvis.cam_from_rig[1].inverse()
    assert np.linalg.norm(between.log()) < 1e-3
    assert (
        read(OKVIS.replace("radialtangential", "equidistant")).cameras[0].model == CameraModel.OPENCV_FISHEYE
    )


def test_a_rectified_pair_and_a_depth_camera(read, tmp_path):
    found = read(OLD)
    np.testing.assert_allclose(found.cam_from_rig[1].translation, [-386.1448 / 718.856, 0, 0])
    rig = read_stereo_rig(tmp_path / "settings.yaml")
    assert rig.left.params.tolist() == rig.right.params.tolist()
    assert len(read(OLD + "DepthMapFactor: 5000\n").cameras) == 1
    rectified = PINHOLE.replace('"PinHole"', '"Rectified"') + "Stereo.b: 0.11\n"
    assert read(rectified).cam_from_rig[1].translation[0] == -0.11
    assert read(rectified + SECOND).cam_from_rig[1].translation[0] == -0.11
    without_size = "\n".join(
        line for line in OLD.splitlines() if "width" not in line and "height" not in line
    )
    assert read(without_size, size=(1241, 376)).cameras[0].width == 1241


def test_a_pair_that_is_rectified_by_orb_slam(read):
    raw = OLD
    for side, offset in (("LEFT", 0.0), ("RIGHT", -386.0)):
        raw += f"{side}.K: [700.0, 0, 600, 0, 701.0, 180, 0, 0, 1]\n{side}.D: [0.1, 0.01, 0, 0, 0]\n"
        raw += f"{side}.R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n{side}.P: [720, 0, 600, {offset}, 0, 720, 180, 0, 0, 0, 1, 0]\n"
    found = read(raw + "LEFT.width: 752\nLEFT.height: 480\n")
    assert (found.cameras[0].width, found.cameras[0].height) == (752, 480)
    with pytest.raises(FileFormatError, match="no baseline"):
        read(raw.replace("-386.0", "0.0"))
    with pytest.raises(FileFormatError, match="positive focal length"):
        read(raw.replace("[720", "[0"))
    assert found.cameras[0].model == CameraModel.OPENCV and found.cameras[0].params[0] == 700.0
    np.testing.assert_allclose(found.cam_from_rig[1].translation, [-386.0 / 720, 0, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PINHOLE.replace("PinHole", "Omni"), "Camera.type is Omni"),
        (PINHOLE.replace("Camera1.fy", "Camera1.f"), "Camera1.fy is missing"),
        (PINHOLE.replace("Camera1.p2", "other"), "has k1, k2, p1, not"),
        (
            OLD.replace(".k", ".x").replace(".p", ".y") + 'Camera.type: "KannalaBrandt8"',
            "Camera.k1 to Camera.k4",
        ),
        (PINHOLE + SECOND.replace("Stereo.T_c1_c2", "other"), "Stereo.T_c1_c2 is missing"),
        (PINHOLE + SECOND.replace("0.999997256477797", "2.0"), "not a motion"),
        (PINHOLE + "Stereo.b: 0.11\n", "distortion, but not the second camera"),
        (OLD.replace("386.1448", "-1.0"), "not positive"),
        (OLD.replace("Camera.width: 1241", ""), "Camera.width and Camera.height are missing"),
        (OKVIS.replace("radialtangential", "unknown"), "distortion_type unknown"),
        (OKVIS.replace("focal_length", "focal"), "focal_length is missing"),
    ],
)
def test_what_is_missing_is_named(read, text, message):
    with pytest.raises(FileFormatError, match=message):
        read(text)


def test_the_inverse_of_a_pose_is_not_taken_for_it(read):
    """The second camera of EuRoC is on the right: its center has a positive x in the first."""
    for text in (PINHOLE + SECOND, OKVIS):
        pose: Rigid3 = read(text).cam_from_rig[1]
        assert pose.inverse().translation[0] > 0.1
