"""File names propose a data set; the calibration beside the images, their size and the depth values decide."""

import shutil

import cv2
import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.io import SequenceKind, read_sequence
from epipole.pipelines.slam.sources.folder import open_sequence

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def intrinsic(f, cx, cy):
    return f"{f} 0 {cx} 0 0 {f} {cy} 0 0 0 1 0 0 0 0 1"


def depth_image(near, far, size=(640, 480)):
    return np.tile(np.linspace(near, far, size[0]), (size[1], 1)).astype(np.uint16)


@pytest.fixture
def numbered(tmp_path):
    """A folder named as 7-Scenes names its files."""

    def make(name="seq-01", size=(640, 480), depth=(900, 3000), depth_size=None):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        for n in range(3):
            cv2.imwrite(str(folder / f"frame-{n:06d}.color.jpg"), np.zeros(size[::-1], np.uint8))
            values = depth_image(*depth, depth_size or size)
            cv2.imwrite(str(folder / f"frame-{n:06d}.depth.png"), values)
        return folder

    return make


def tum_folder(folder, values, size=(640, 480)):
    for name, image in (("rgb", np.zeros(size[::-1], np.uint8)), ("depth", values)):
        (folder / name).mkdir(parents=True)
        cv2.imwrite(str(folder / name / "1.png"), image)
        (folder / f"{name}.txt").write_text(f"1.0 {name}/1.png\n")
    return folder


def test_the_real_seven_scenes_is_read_as_before(data_dir):
    found = read_sequence(data_dir / "slam" / "7scenes")
    assert found.kind is SequenceKind.SEVEN_SCENES and found.warnings == ()
    np.testing.assert_array_equal(found.camera.params, [525.505, 525.505, 320.0, 240.0])
    np.testing.assert_array_equal(found.depth.camera.params, [585.0, 585.0, 320.0, 240.0])
    assert found.depth.unit == pytest.approx(1005.1) and found.depth.depth_from_color is not None


def test_bundlefusion_brings_its_info(data_dir, numbered):
    folder = numbered()
    shutil.copy(data_dir / "faults" / "bundlefusion_info" / "info.txt", folder)
    found = read_sequence(folder)
    assert found.kind is SequenceKind.RGBD_FRAMES and found.camera_source == "info.txt"
    np.testing.assert_array_equal(found.camera.params, [582.871, 582.871, 320.0, 240.0])
    assert found.depth.unit == 1000.0 and found.depth.camera is None and found.depth.depth_from_color is None


@pytest.mark.parametrize("name", ["info.txt", "_info.txt"])
def test_an_info_file_tells_the_depth_sensor_and_its_unit(numbered, name):
    folder = numbered(size=(1296, 968), depth=(4000, 16000), depth_size=(640, 480))
    (folder / name).write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\nm_colorWidth = 1296\nm_colorHeight = 968\n"
        "m_depthWidth = 640\nm_depthHeight = 480\nm_depthShift = 4000\n"
        f"m_calibrationColorIntrinsic = {intrinsic(1170.2, 647.75, 483.75)}\nm_calibrationColorExtrinsic = {IDENTITY}\n"
        f"m_calibrationDepthIntrinsic = {intrinsic(571.6, 319.5, 239.5)}\nm_calibrationDepthExtrinsic = {IDENTITY}\n"
        "m_frames.size = 3\n"
    )
    found = read_sequence(folder)
    assert (found.camera.width, found.camera.params[0]) == (1296, 1170.2)
    assert (found.depth.camera.width, found.depth.camera.params[0], found.depth.unit) == (640, 571.6, 4000.0)
    assert found.depth.unit_source == f"m_depthShift in {name}"


@pytest.mark.parametrize("where", [".", ".."])
def test_3dmatch_brings_a_matrix_beside_its_sequences(numbered, where):
    folder = numbered("scene/seq-01")
    (folder / where / "camera-intrinsics.txt").write_text("570.34 0 320\n0 570.34 240\n0 0 1\n")
    found = read_sequence(folder)
    assert found.kind is SequenceKind.RGBD_FRAMES and found.camera.params[0] == 570.34
    assert found.depth.camera is None and found.depth.unit == 1000.0
    # The depth sensor of 7-Scenes, which 3DMatch copies: that set's own calibration goes on to be used.
    (folder / where / "camera-intrinsics.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")
    assert read_sequence(folder).kind is SequenceKind.SEVEN_SCENES


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "m_colorWidth = 1296\nm_calibrationColorIntrinsic = " + intrinsic(583, 320, 240),
            "m_colorWidth is 1296",
        ),
        ("m_colorWidth = 640\n", "m_calibrationColorIntrinsic is missing"),
        ("m_calibrationColorIntrinsic = 583 0 320\n", "3 numbers"),
        (
            "m_calibrationColorIntrinsic = " + intrinsic(583, 320, 240) + "\nm_calibrationTwist = 3",
            "is not supported",
        ),
        (
            "m_calibrationColorIntrinsic = " + intrinsic(583, 320, 240) + "\nwhat else\n",
            "expected name = value",
        ),
        ("m_calibrationColorIntrinsic = " + intrinsic(1166, 640, 480), "images of another size"),
        ("m_calibrationColorIntrinsic = 583 4 320 0 0 583 240 0 0 0 1 0 0 0 0 1", "without skew"),
    ],
)
def test_an_info_file_that_does_not_fit_is_refused_unless_a_camera_is_given(numbered, text, words):
    folder = numbered()
    (folder / "info.txt").write_text(text)
    found = read_sequence(folder)
    assert found.camera is None and words in found.camera_problem
    with pytest.raises(ConfigError, match="--camera-params"):
        open_sequence(found, "auto", None)


def test_depth_that_is_not_registered_by_its_info_is_not_used(numbered):
    folder = numbered()
    moved = "1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"
    (folder / "info.txt").write_text(
        f"m_calibrationColorIntrinsic = {intrinsic(583, 320, 240)}\nm_calibrationDepthExtrinsic = {moved}\n"
    )
    found = read_sequence(folder)
    assert (
        found.depth is None
        and "m_calibrationDepthExtrinsic in info.txt is not the identity" in found.warnings[0]
    )
    with pytest.raises(ConfigError, match="not the identity"):
        open_sequence(found, "rgbd", None)


@pytest.mark.parametrize(
    ("size", "depth", "words"),
    [((1280, 720), (900, 3000), "1280 x 720"), ((640, 480), (4000, 16000), "not in millimeters")],
)
def test_names_of_seven_scenes_with_other_images_get_no_calibration(numbered, size, depth, words):
    found = read_sequence(numbered(size=size, depth=depth))
    assert found.camera is None and words in found.warnings[0]
    with pytest.raises(ConfigError, match=words):
        open_sequence(found, "auto", None)


def test_scannet_as_its_reader_exports_it(tmp_path):
    folder = tmp_path / "scene0000_00"
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for n in (10, 9, 0):
        cv2.imwrite(str(folder / "color" / f"{n}.jpg"), np.zeros((968, 1296), np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{n}.png"), depth_image(600, 4000))
        (folder / "pose" / f"{n}.txt").write_text(f"1 0 0 {n}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    for name, text in (
        ("color", intrinsic(1170.2, 647.75, 483.75)),
        ("depth", intrinsic(571.6, 319.5, 239.5)),
    ):
        (folder / "intrinsic" / f"intrinsic_{name}.txt").write_text(text)
        (folder / "intrinsic" / f"extrinsic_{name}.txt").write_text(IDENTITY)
    found = read_sequence(folder)
    assert found.kind is SequenceKind.SCANNET
    assert [frame.image.stem for frame in found.frames] == ["0", "9", "10"]
    assert found.frames[1].timestamp_s == pytest.approx(0.3) and found.frames[1].depth.name == "9.png"
    assert (found.camera.params[0], found.depth.camera.params[0], found.depth.unit) == (1170.2, 571.6, 1000.0)
    (folder / "intrinsic" / "extrinsic_depth.txt").write_text(
        IDENTITY.replace("1 0 0 0 0 1", "1 0 0 0.1 0 1", 1)
    )
    assert read_sequence(folder).depth is None


def test_tum_by_name_with_images_of_another_size_is_refused(tmp_path):
    found = read_sequence(
        tum_folder(tmp_path / "rgbd_dataset_freiburg1_desk", depth_image(2500, 20000), (320, 240))
    )
    with pytest.raises(ConfigError, match=r"freiburg1.*640 x 480 pixels, but these are 320 x 240"):
        open_sequence(found, "auto", None)


def test_a_calibration_beside_tum_lists_goes_before_the_name(tmp_path):
    folder = tum_folder(tmp_path / "rgbd_dataset_freiburg1_desk", depth_image(2500, 20000))
    (folder / "calibration.txt").write_text("481.2 480.0 319.5 239.5\n")
    found = read_sequence(folder)
    assert found.camera.params[0] == 481.2 and found.camera_source == "calibration.txt"


@pytest.mark.parametrize(
    ("values", "unit", "words"),
    [
        (depth_image(2500, 40000), 5000.0, None),
        (
            depth_image(600, 4000),
            1000.0,
            "1000 values per meter",
        ),  # millimeters: at 5000 a tenth of a meter away
        (depth_image(2500, 8000), 5000.0, "1000 would also give plausible distances"),
        (5 * (depth_image(2500, 8000) // 5), 5000.0, None),  # millimeters times five are TUM's
        (depth_image(0, 1), 5000.0, None),
    ],
)
def test_the_unit_of_depth_in_the_layout_of_tum_is_checked(tmp_path, values, unit, words):
    found = read_sequence(tum_folder(tmp_path / "room", values))
    assert found.depth.unit == unit and found.depth.unit_source
    assert [words in said for said in found.warnings] == ([] if words is None else [True])
    given = read_sequence(tmp_path / "room", depth_scale=1250.0)
    assert (given.depth.unit, given.depth.unit_source, given.warnings) == (1250.0, "given", ())


def test_a_depth_scale_that_makes_no_sense(tmp_path, numbered):
    folder = numbered()
    for scale in (0.0, -1000.0, float("nan")):
        with pytest.raises(ConfigError, match="depth_scale"):
            read_sequence(folder, depth_scale=scale)
    for path in folder.glob("*.depth.png"):
        path.unlink()
    with pytest.raises(ConfigError, match="needs depth images"):
        read_sequence(folder, depth_scale=1000.0)


def plain_folder(folder, size=(640, 480)):
    folder.mkdir()
    for n in range(3):
        cv2.imwrite(str(folder / f"{n}.png"), np.zeros(size[::-1], np.uint8))
    return folder


def test_intrinsics_beside_images_are_used(tmp_path, data_dir):
    found = read_sequence(data_dir / "slam" / "kitti00_mono")
    np.testing.assert_array_equal(found.camera.params, [718.856, 718.856, 607.1928, 185.2157])
    assert found.camera_source == "intrinsics.txt"
    folder = plain_folder(tmp_path / "images")
    assert read_sequence(folder).camera is None
    (folder / "K.txt").write_text("500 0 320\n0 510 240\n0 0 1\n")
    np.testing.assert_array_equal(read_sequence(folder).camera.params, [500.0, 510.0, 320.0, 240.0])
    (folder / "intrinsics.txt").write_text("# fx fy cx cy\n500, 510, 320, 240\n")
    assert read_sequence(folder).camera is not None
    (folder / "intrinsics.txt").write_text("505 510 320 240\n")
    assert "define different cameras" in read_sequence(folder).camera_problem
    (folder / "intrinsics.txt").unlink()
    (folder / "D.txt").write_text("-0.3 0.1 0 0\n")
    assert "D.txt has distortion coefficients" in read_sequence(folder).camera_problem


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("718.856 718.856 607.1928 185.2157\n", "images of another size"),
        ("0.9 0.9 0.5 0.5\n", "is not plausible for a camera"),
        ("500 500 320\n", "3 numbers"),
        ("fx 500\n", "could not convert"),
        ("500 500 320 nan\n", "must be finite"),
        ("-500 500 320 240\n", "must be positive"),
    ],
)
def test_intrinsics_that_do_not_fit_are_refused(tmp_path, text, words):
    folder = plain_folder(tmp_path / "images")
    (folder / "intrinsics.txt").write_text(text)
    found = read_sequence(folder)
    assert found.camera is None and words in found.camera_problem and "intrinsics.txt" in found.camera_problem


def test_a_calib_file_of_images_of_another_size_is_refused(tmp_path):
    for name in ("image_0", "image_1"):
        plain_folder(tmp_path / name)
    rows = (f"P{k}: 1000 0 600 {-500 * k} 0 1000 200 0 0 0 1 0\n" for k in range(2))
    (tmp_path / "calib.txt").write_text("".join(rows))
    found = read_sequence(tmp_path)
    assert found.camera is None and found.rig is None
    with pytest.raises(ConfigError, match="images of another size"):
        open_sequence(found, "stereo", None)
