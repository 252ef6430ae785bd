"""COLMAP models: round trips, the half pixel, old and foreign models, broken files."""

import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from epipole.cameras import CameraModel
from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.io import params_from_colmap, params_to_colmap, read_colmap_model, write_colmap_model
from epipole.scene import Rigs
from io_models import small_model

NAMES = ("cameras", "rigs", "frames", "images", "points3D")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_colmap_model(small_model(), tmp_path / "model")
    return tmp_path / "model"


@pytest.mark.parametrize("text", [False, True])
def test_round_trip_keeps_everything_registered(tmp_path: Path, text: bool) -> None:
    model = small_model()
    write_colmap_model(model, tmp_path, text=text)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        f"{n}.{'txt' if text else 'bin'}" for n in NAMES
    )
    read = read_colmap_model(tmp_path)
    assert read.images.name == model.images.name[:8]
    assert len(read.frames) == 5 and read.is_registered().all()
    np.testing.assert_array_equal(read.cameras.model, model.cameras.model)
    np.testing.assert_allclose(read.cameras.params, model.cameras.params, atol=1e-12)
    assert read.cameras.is_focal_trusted.all() and not read.cameras.is_constant.any()
    np.testing.assert_array_equal(read.rigs.sensor_offsets, model.rigs.sensor_offsets)
    np.testing.assert_allclose(
        read.rigs.cam_from_rig.as_matrix(), model.rigs.cam_from_rig.as_matrix(), atol=1e-14
    )
    np.testing.assert_array_equal(read.images.sensor, model.images.sensor[:8])
    expected = model.cams_from_world()[np.arange(8)]
    np.testing.assert_allclose(read.cams_from_world().as_matrix(), expected.as_matrix(), atol=1e-13)
    np.testing.assert_array_equal(read.points.xyz_in_world, model.points.xyz_in_world)
    np.testing.assert_array_equal(read.points.rgb, model.points.rgb)
    np.testing.assert_array_equal(read.points.error_px, model.points.error_px)
    np.testing.assert_array_equal(read.tracks.offsets, model.tracks.offsets)
    np.testing.assert_array_equal(read.tracks.image, model.tracks.image)
    np.testing.assert_array_equal(read.tracks.keypoint, model.tracks.keypoint)
    for image in range(8):
        np.testing.assert_allclose(
            read.images.keypoints_of(image), model.images.keypoints_of(image), atol=1e-12
        )
    assert abs(read.mean_reprojection_error_px() - model.mean_reprojection_error_px()) < 1e-10


@pytest.mark.parametrize("text", [False, True])
def test_the_same_model_gives_the_same_bytes(tmp_path: Path, text: bool) -> None:
    for name in ("one", "two"):
        write_colmap_model(small_model(), tmp_path / name, text=text)
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()


def test_half_pixel(folder: Path) -> None:
    """(0, 0) in memory is (0.5, 0.5) in the file, for principal points and for keypoints."""
    model = small_model()
    camera = (folder / "cameras.bin").read_bytes()
    assert struct.unpack_from("<4d", camera, 8 + 24) == (500.0, 310.5, 245.5, 0.03)
    image = (folder / "images.bin").read_bytes()
    start = 8 + 4 + 56 + 4 + len(b"rig/a 0.jpg\0") + 8
    np.testing.assert_array_equal(struct.unpack_from("<2d", image, start), model.images.keypoints_px[0] + 0.5)


@pytest.mark.parametrize("model", list(CameraModel))
def test_params_move_the_principal_point_alone(model: CameraModel) -> None:
    params = np.arange(1.0, model.num_params + 1)
    moved = params_to_colmap(model, params) - params
    assert sorted(np.flatnonzero(moved)) == list(model.principal_point_indices)
    assert set(moved) <= {0.0, 0.5}
    np.testing.assert_array_equal(params_from_colmap(model, params_to_colmap(model, params)), params)


def test_params_of_a_model_s_name() -> None:
    assert params_from_colmap("PINHOLE", [500, 500, 320, 240]).tolist() == [500.0, 500.0, 319.5, 239.5]
    for model, params in (("PINHOLE", [500, 320, 240]), ("PINHOLES", [500, 500, 320, 240]), (77, [1.0])):
        with pytest.raises(ConfigError):
            params_to_colmap(model, params)
    with pytest.raises(ShapeError):
        params_from_colmap("PINHOLE", "500,500,320,240")


@pytest.mark.parametrize("text", [False, True])
def test_models_without_rigs_get_one_rig_per_camera(tmp_path: Path, text: bool) -> None:
    model = small_model()
    write_colmap_model(model, tmp_path, text=text)
    for name in ("rigs", "frames"):
        (tmp_path / f"{name}.{'txt' if text else 'bin'}").unlink()
    read = read_colmap_model(tmp_path)
    assert len(read.rigs) == 3 and len(read.frames) == 8
    np.testing.assert_array_equal(read.camera_of_image, model.camera_of_image[:8])
    expected = model.cams_from_world()[np.arange(8)].as_matrix()
    np.testing.assert_allclose(read.cams_from_world().as_matrix(), expected, atol=1e-13)


def test_the_other_kind_of_files_is_removed_and_strangers_stay(folder: Path) -> None:
    (folder / "notes.md").write_text("mine")
    write_colmap_model(small_model(1), folder, text=True)
    assert sorted(p.name for p in folder.iterdir()) == sorted([*(f"{n}.txt" for n in NAMES), "notes.md"])
    read = read_colmap_model(folder)
    np.testing.assert_array_equal(read.points.xyz_in_world, small_model(1).points.xyz_in_world)


def test_a_model_with_nothing_in_it(tmp_path: Path) -> None:
    for text in (False, True):
        model = small_model()
        nothing = np.zeros(0, np.int32)
        empty = replace(
            model,
            frames=replace(
                model.frames, rig_from_world=Rigid3(np.full((6, 3, 3), np.nan), np.full((6, 3), np.nan))
            ),
            points=replace(
                model.points,
                xyz_in_world=np.empty((0, 3)),
                rgb=np.empty((0, 3), np.uint8),
                error_px=np.empty(0),
            ),
            tracks=replace(model.tracks, offsets=np.zeros(1, np.int64), image=nothing, keypoint=nothing),
        )
        write_colmap_model(empty, tmp_path, text=text)
        read = read_colmap_model(tmp_path)
        assert (len(read.images), len(read.points), len(read.cameras)) == (0, 0, 3)


def test_a_camera_that_two_sensors_share_is_written_for_each(tmp_path: Path) -> None:
    model = small_model()
    shared = replace(model, rigs=replace(model.rigs, sensor_camera=np.array([0, 0, 2], np.int32)))
    write_colmap_model(shared, tmp_path)
    read = read_colmap_model(tmp_path)
    assert len(read.cameras) == 4
    for image in range(8):
        mine = shared.cameras[int(shared.camera_of_image[image])]
        np.testing.assert_allclose(
            read.cameras[int(read.camera_of_image[image])].params, mine.params, atol=1e-12
        )


def test_a_sensor_whose_place_on_the_rig_is_not_known(tmp_path: Path) -> None:
    model = small_model()
    cam_from_rig = Rigid3(model.rigs.cam_from_rig.rotation.copy(), model.rigs.cam_from_rig.translation.copy())
    cam_from_rig.rotation[1], cam_from_rig.translation[1] = np.nan, np.nan
    keep = model.images.sensor[model.tracks.image] != 1
    lengths = np.bincount(model.tracks.point_of_observation()[keep], minlength=len(model.points))
    for text in (False, True):
        write_colmap_model(
            replace(model, rigs=replace(model.rigs, cam_from_rig=cam_from_rig)), tmp_path, text=text
        )
        read = read_colmap_model(tmp_path)
        assert len(read.images) == 5
        assert np.isnan(read.rigs.cam_from_rig.translation[1]).all()
        np.testing.assert_array_equal(np.diff(read.tracks.offsets), lengths)


def test_a_rig_around_an_imu_is_given_its_first_camera_as_reference(tmp_path: Path) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    model = read_colmap_model(tmp_path)
    imu_pose = Rigid3.exp([0.1, 0.2, 0.3, 0.3, -0.2, 0.1])  # camera 3 from the IMU
    quat = " ".join(map(str, _quat_wxyz(imu_pose.rotation)))
    t = " ".join(map(str, imu_pose.translation))
    rigs = (tmp_path / "rigs.txt").read_text().splitlines()
    rigs[-1] = f"2 2 IMU 1 CAMERA 3 1 {quat} {t}"
    (tmp_path / "rigs.txt").write_text("\n".join(rigs))
    frames = (tmp_path / "frames.txt").read_text().splitlines()
    for row, line in enumerate(frames):
        words = line.split()
        if not line.startswith("#") and words[1] == "2":
            cam_from_world = Rigid3.from_quat_wxyz(np.array(words[2:6], float), np.array(words[6:9], float))
            imu_from_world = imu_pose.inverse() @ cam_from_world
            pose = [*_quat_wxyz(imu_from_world.rotation), *imu_from_world.translation]
            frames[row] = " ".join([*words[:2], *map(repr, map(float, pose)), *words[9:]])
    (tmp_path / "frames.txt").write_text("\n".join(frames))
    read = read_colmap_model(tmp_path)
    np.testing.assert_allclose(
        read.cams_from_world().as_matrix(), model.cams_from_world().as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(read.rigs.cam_from_rig.as_matrix()[2], np.eye(4), atol=1e-12)


def _quat_wxyz(rotation: np.ndarray) -> np.ndarray:
    w = 0.5 * np.sqrt(1 + np.trace(rotation))
    r = rotation
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))])


@pytest.mark.parametrize(
    ("line", "model", "params"),
    [
        (
            "SIMPLE_RADIAL_FISHEYE 640 480 500 310.5 245.5 0.1",
            "OPENCV_FISHEYE",
            [500, 500, 310, 245, 0.1, 0, 0, 0],
        ),
        (
            "RADIAL_FISHEYE 640 480 500 310.5 245.5 .1 .2",
            "OPENCV_FISHEYE",
            [500, 500, 310, 245, 0.1, 0.2, 0, 0],
        ),
        ("FISHEYE 640 480 500 505 310.5 245.5", "OPENCV_FISHEYE", [500, 505, 310, 245, 0, 0, 0, 0]),
        ("SIMPLE_FISHEYE 640 480 500 310.5 245.5", "OPENCV_FISHEYE", [500, 500, 310, 245, 0, 0, 0, 0]),
        (
            "FULL_OPENCV 640 480 500 505 310.5 245.5 .1 .2 .3 .4 0 0 0 0",
            "FULL_OPENCV",
            [500, 505, 310, 245, 0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0],
        ),
    ],
)
def test_special_cases_of_known_models_are_read(
    tmp_path: Path, line: str, model: str, params: list[float]
) -> None:
    (tmp_path / "cameras.txt").write_text(f"7 {line}\n")
    for name in ("images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("# nothing\n")
    camera = read_colmap_model(tmp_path).cameras[0]
    assert camera.model.name == model
    np.testing.assert_allclose(camera.params, params)


def test_every_truncation_of_a_binary_file_is_reported(folder: Path) -> None:
    for name in NAMES:
        file = folder / f"{name}.bin"
        whole = file.read_bytes()
        lengths = {*range(0, min(len(whole), 200)), *range(200, len(whole), 997), len(whole) - 1}
        for length in sorted(lengths):
            file.write_bytes(whole[:length])
            with pytest.raises(FileFormatError, match=rf"{name}.bin: byte \d+"):
                read_colmap_model(folder)
        file.write_bytes(whole + b"\0")
        with pytest.raises(FileFormatError, match="1 unexpected bytes after the end"):
            read_colmap_model(folder)
        file.write_bytes(whole)
    assert len(read_colmap_model(folder).images) == 8


def test_counts_that_cannot_be_are_refused_at_once(folder: Path) -> None:
    for name in NAMES:
        file = folder / f"{name}.bin"
        whole = file.read_bytes()
        for count in (2**63, 2**64 - 1, 10**9):
            file.write_bytes(struct.pack("<Q", count) + whole[8:])
            with pytest.raises(FileFormatError, match=f"{count} .* do not fit into the"):
                read_colmap_model(folder)
        file.write_bytes(whole)
    points = bytearray((folder / "points3D.bin").read_bytes())
    points[8 + 43 : 8 + 51] = struct.pack("<Q", 2**62)
    (folder / "points3D.bin").write_bytes(bytes(points))
    with pytest.raises(FileFormatError, match="observations of a point do not fit"):
        read_colmap_model(folder)


def _replace_line(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = folder / f"{name}.txt"
        content = file.read_text()
        assert old in content
        file.write_text(content.replace(old, new, 1))

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            _replace_line("cameras", "1 SIMPLE_RADIAL", "1 LENSLESS"),
            r"cameras.txt: line 4: unknown camera model LENSLESS",
        ),
        (
            _replace_line("cameras", "1 SIMPLE_RADIAL 640", "1 SIMPLE_RADIAL wide"),
            r"cameras.txt: line 4: not a camera",
        ),
        (
            _replace_line("cameras", "640 480 500.0", "640 480 -500.0"),
            r"camera 1: the focal length must be positive",
        ),
        (
            _replace_line("cameras", "640 480 500.0", "640 480 nan"),
            r"camera 1: camera parameter f must be finite",
        ),
        (_replace_line("cameras", "640 480", "0 480"), r"camera 1: invalid image size"),
        (_replace_line("cameras", "2 OPENCV", "1 OPENCV"), r"cameras.txt: camera 1 is defined twice"),
        (_replace_line("cameras", "3 PINHOLE", "9 PINHOLE"), r"images.txt: image 7: camera 3 is not defined"),
        (
            _replace_line("rigs", "CAMERA 3", "CAMERA 2"),
            r"frame 4: image 7 does not belong to camera 3 of its rig",
        ),
        (_replace_line("rigs", "CAMERA 3", "SONAR 3"), r"rigs.txt: line \d+: not a rig"),
        (_replace_line("frames", "1 CAMERA 3 7", "1 CAMERA 3 8"), r"image 8 is in two frames"),
        (_replace_line("frames", "1 CAMERA 3 7", "0"), r"frames.txt: image 7 belongs to no frame"),
        (_replace_line("images", "b1.jpg\n", "b1.jpg\n1 "), r"images.txt: line \d+: not a list of keypoints"),
        (_replace_line("points3D", "\n5 ", "\n6 "), r"points3D.txt: point 6 is defined twice"),
        (_replace_line("points3D", "\n5 ", "\nfive "), r"points3D.txt: line \d+: not a point"),
    ],
)
def test_text_that_contradicts_itself_is_refused(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    change(tmp_path)
    with pytest.raises(FileFormatError, match=message):
        read_colmap_model(tmp_path)


def test_tracks_that_lead_nowhere_are_refused(tmp_path: Path) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    whole = (tmp_path / "points3D.txt").read_text().rstrip("\n")
    for end, message in (("99 0", "point 25: there is no image 99"), ("1 999", "no keypoint 999 in image 1")):
        (tmp_path / "points3D.txt").write_text(f"{whole} {end}\n")
        with pytest.raises(FileFormatError, match=message):
            read_colmap_model(tmp_path)


def test_missing_models_and_places(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(FileFormatError, match="no COLMAP model here"):
        read_colmap_model(tmp_path / "nowhere")
    (folder / "points3D.bin").unlink()
    with pytest.raises(FileFormatError, match=r"points3D\.bin: it does not exist"):
        read_colmap_model(folder)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        write_colmap_model(small_model(), tmp_path / "file")


def test_names_that_would_break_the_file_are_refused(tmp_path: Path) -> None:
    model = small_model()
    for name in ("", "a\nb.jpg", "a\0b.jpg"):
        images = replace(model.images, name=(name, *model.images.name[1:]))
        with pytest.raises(ConfigError, match="cannot be written"):
            write_colmap_model(replace(model, images=images), tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_ids_with_gaps_and_in_any_order(tmp_path: Path) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    expected = read_colmap_model(tmp_path)
    for name in ("cameras", "rigs", "frames", "points3D"):
        file = tmp_path / f"{name}.txt"
        lines = file.read_text().splitlines()
        file.write_text("\n".join([*lines[:3], *lines[:2:-1]]))
    read = read_colmap_model(tmp_path)
    np.testing.assert_array_equal(read.tracks.image, expected.tracks.image)
    np.testing.assert_array_equal(read.points.xyz_in_world, expected.points.xyz_in_world)
    np.testing.assert_array_equal(read.images.frame, expected.images.frame)
    shutil.rmtree(tmp_path)


def test_rigs_of_single_cameras_are_what_a_plain_model_gets(folder: Path) -> None:
    (folder / "rigs.bin").unlink()
    (folder / "frames.bin").unlink()
    rigs, expected = read_colmap_model(folder).rigs, Rigs.of_single_cameras(3)
    np.testing.assert_array_equal(rigs.sensor_camera, expected.sensor_camera)
    np.testing.assert_array_equal(rigs.sensor_offsets, expected.sensor_offsets)
