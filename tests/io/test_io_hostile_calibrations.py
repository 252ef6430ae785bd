"""Calibrations out of damaged files: a clear error, or cameras that can be used, in little memory."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration_files import (
    CalibrationFile,
    read_calibration,
    read_stereo_rig,
    write_calibration,
    write_opencv_yaml,
    write_ros_yaml,
)
from hostile_bytes import assert_motions, read_or_refuse, spoilt

LENS = Camera(CameraModel.OPENCV, 640, 480, np.array([520.0, 524.0, 315.0, 236.0, -0.25, 0.08, 1e-3, -5e-4]))
MOTION = Rigid3.exp(np.array([-0.12, 0.002, 0.004, 0.01, -0.03, 0.005]))
PAIR = CalibrationFile(
    (LENS, LENS),
    Rigid3(np.stack([np.eye(3), MOTION.rotation]), np.stack([np.zeros(3), MOTION.translation])),
    np.eye(30),
)
KALIBR = {
    f"cam{k}": {
        "camera_model": "pinhole",
        "intrinsics": [461.6, 460.3, 362.7, 246.1],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.27, 0.06, 1e-4, -2e-4],
        "resolution": [752, 480],
        **({"T_cn_cnm1": MOTION.as_matrix().tolist()} if k else {}),
    }
    for k in range(2)
}
EUROC = b"""%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, -0.02, 0.0, 1.0, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
MIDDLEBURY = b"""cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]
cam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]
doffs=31.086
baseline=193.001
width=741
height=497
"""
KITTI = b"""S_rect_00: 1.242e+03 3.75e+02
P_rect_00: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
S_rect_01: 1.242e+03 3.75e+02
P_rect_01: 7.2e+02 0 6.1e+02 -3.8e+02 0 7.2e+02 1.7e+02 0 0 0 1 0
"""
KITTI_ROWS = (
    b"7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0\n7.2e+02 0 6.1e+02 -386 0 7.2e+02 170 0 0 0 1 0\n"
)
XML = b"""<?xml version="1.0"?>
<opencv_storage>
<image_width>640</image_width><image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>500 0 320 0 500 240 0 0 1</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>4</cols><dt>d</dt>
<data>-0.1 0.01 0 0</data></distortion_coefficients>
</opencv_storage>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("calibrations")


@pytest.fixture(scope="module")
def valid(folder: Path) -> dict[str, bytes]:
    write_calibration(folder / "own.json", PAIR)
    write_opencv_yaml(folder / "opencv.yaml", PAIR)
    write_ros_yaml(folder / "ros.yaml", LENS, "left")
    out = {name: (folder / name).read_bytes() for name in ("own.json", "opencv.yaml", "ros.yaml")}
    out |= {"kalibr.yaml": yaml.safe_dump(KALIBR).encode(), "euroc.yaml": EUROC, "opencv.xml": XML}
    return out | {"middlebury.txt": MIDDLEBURY, "kitti.txt": KITTI, "kitti_rows.txt": KITTI_ROWS}


NAMES = (
    *("own.json", "opencv.yaml", "ros.yaml", "kalibr.yaml", "euroc.yaml", "opencv.xml"),
    *("middlebury.txt", "kitti.txt", "kitti_rows.txt"),
)


@pytest.mark.parametrize("name", NAMES)
def test_the_files_are_sound(folder: Path, valid: dict[str, bytes], name: str) -> None:
    (folder / name).write_bytes(valid[name])
    assert read_calibration(folder / name, size=(1242, 375)).cameras


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_calibrations(folder: Path, valid: dict[str, bytes], name: str, data: st.DataObject) -> None:
    path = folder / f"spoilt_{name}"
    path.write_bytes(data.draw(spoilt(valid[name], is_text=True)))

    def read() -> CalibrationFile:
        return read_calibration(path, size=(1242, 375))

    found = read_or_refuse(read, names=path.name)
    if found is not None:
        assert len(found.cameras) == len(found.cam_from_rig.translation) > 0
        assert np.isfinite(found.cam_from_rig.as_matrix()).all()
        assert_motions(found.cam_from_rig)
        assert all(0 < side <= 1 << 20 for camera in found.cameras for side in (camera.width, camera.height))


def changed(folder: Path, change) -> Path:
    write_calibration(folder / "changed.json", PAIR)
    content = json.loads((folder / "changed.json").read_text())
    change(content["cameras"][1], content)
    (folder / "changed.json").write_text(json.dumps(content))
    return folder / "changed.json"


OWN = {
    "endless width": lambda camera, _: camera.update(width=float("inf")),
    "a width of 2^40": lambda camera, _: camera.update(width=1 << 40),
    "a parameter of 400 digits": lambda camera, _: camera["params"].update(fx=10**400),
    "a place that is nowhere": lambda camera, _: camera["cam_from_rig"].update(translation=[np.nan] * 3),
    "a quaternion of infinite length": lambda camera, _: camera["cam_from_rig"].update(quat_wxyz=[1e200] * 4),
    "a small covariance": lambda _, content: content.update(covariance=[[1.0]]),
    "no list of cameras": lambda _, content: content.update(cameras=3),
}


@pytest.mark.parametrize("what", list(OWN))
def test_what_own_files_cannot_hold(folder: Path, what: str) -> None:
    path = changed(folder, OWN[what])
    with pytest.raises(FileFormatError, match=r"changed\.json: .+"):
        read_calibration(path)


PLAIN = """image_width: 640
image_height: 480
camera_matrix: {data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_coefficients: {data: [0, 0, 0, 0]}
"""


@pytest.mark.parametrize(
    "line",
    [
        "x: !!int ''",
        "x: !!float _",
        "x: !!bool q",
        "x: !!timestamp q",
        "x: !!binary q",
        "x: *none",
        "? {a: 1}\n: 2",
    ],
)
def test_yaml_that_trips_its_own_reader(folder: Path, line: str) -> None:
    """PyYAML raises IndexError, KeyError and AttributeError for some of these."""
    (folder / "plain.yaml").write_text(PLAIN)
    assert read_calibration(folder / "plain.yaml").cameras[0].params[0] == 500.0
    (folder / "tripping.yaml").write_text(PLAIN + line + "\n")
    with pytest.raises(FileFormatError, match=r"tripping.yaml: it is neither JSON nor YAML"):
        read_calibration(folder / "tripping.yaml")


def test_a_name_that_is_no_text(folder: Path, valid: dict[str, bytes]) -> None:
    (folder / "bytes.yaml").write_bytes(valid["opencv.yaml"].replace(b"image_width", b"\xe9mage_width"))
    with pytest.raises(FileFormatError, match=r"bytes\.yaml: it is neither JSON nor YAML"):
        read_calibration(folder / "bytes.yaml")


def test_a_few_lines_of_aliases_are_not_a_billion_numbers(folder: Path) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
    path = folder / "billion.yaml"
    path.write_text("\n".join([*lines, PLAIN.replace("{data: [0, 0, 0, 0]}", "*a9")]))
    assert read_or_refuse(read_calibration, path, names="alias") is None
    # One list named twice, as PyYAML writes it, is read.
    twice = KALIBR | {"cam1": KALIBR["cam1"] | {"resolution": KALIBR["cam0"]["resolution"]}}
    (folder / "twice.yaml").write_text(yaml.safe_dump(twice))
    assert "*id001" in (folder / "twice.yaml").read_text()
    assert read_stereo_rig(folder / "twice.yaml").right.width == 752


def test_a_place_that_is_no_rotation_is_refused(folder: Path) -> None:
    matrix = MOTION.as_matrix()
    matrix[0, 0] += 0.01
    (folder / "bent.yaml").write_text(
        yaml.safe_dump(KALIBR | {"cam1": KALIBR["cam1"] | {"T_cn_cnm1": matrix.tolist()}})
    )
    with pytest.raises(FileFormatError, match=r"bent\.yaml: T_cn_cnm1 is no motion"):
        read_calibration(folder / "bent.yaml")


ENTITIES = b"""<?xml version="1.0"?>
<!DOCTYPE a [<!ENTITY b "1 1 1 1 1 1 1 1 1 1"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>
<opencv_storage><image_width>&c;</image_width></opencv_storage>
"""


@pytest.mark.parametrize(
    "content",
    [ENTITIES, XML[:200], b"<opencv_storage>" + b"<a>" * 100_000, b"<?xml version='1.0'?><svg></svg>"],
    ids=["entities", "cut", "deep", "a drawing"],
)
def test_xml_that_is_no_calibration(folder: Path, content: bytes) -> None:
    path = folder / "other.xml"
    path.write_bytes(content)
    assert read_or_refuse(read_calibration, path, names="other.xml") is None


def test_opencv_reads_the_same_from_its_own_files(folder: Path, valid: dict[str, bytes]) -> None:
    """What we read without OpenCV's reader is what it reads."""
    for name, matrix, lens in (
        ("opencv.yaml", "M1", "D1"),
        ("opencv.xml", "camera_matrix", "distortion_coefficients"),
    ):
        (folder / name).write_bytes(valid[name])
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_READ)
        camera = read_calibration(folder / name).cameras[0]
        np.testing.assert_allclose(camera.K, storage.getNode(matrix).mat(), rtol=1e-15)
        np.testing.assert_allclose(camera.params[4:8], storage.getNode(lens).mat().ravel()[:4], rtol=1e-15)
