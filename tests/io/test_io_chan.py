"""Camera animations as .chan: the order of the rotations, there and back, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io import read_chan, read_model, write_chan
from epipole.io.models.chan import frame_numbers
from epipole.scene import Cameras, Reconstruction, unregistered
from io_models import mappable_model, small_model

EXAMPLE = "1001\t1\t2\t3\t10\t20\t30\t40\n1002 1.5 2 3 10 20 30 40\n"


def written(folder: Path, text: str = EXAMPLE) -> Path:
    (folder / "shot.chan").write_text(text)
    return folder / "shot.chan"


def plates(folder: Path, *names: str, size: tuple[int, int] = (192, 108)) -> None:
    for name in names:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", size).save(folder / "images" / name)


def named(model: Reconstruction, *names: str) -> Reconstruction:
    return replace(model, images=replace(model.images, name=names))


def test_rotations_are_about_z_then_x_then_y(tmp_path: Path) -> None:
    """Of the camera with y up that looks along -z; scipy's lower case is the order about fixed axes."""
    model = read_chan(written(tmp_path), size=(192, 108))
    expected = Rotation.from_euler("zxy", [30, 10, 20], degrees=True).as_matrix()
    right, down, ahead = model.cams_from_world().rotation[0]
    np.testing.assert_allclose([right, -down, -ahead], expected.T, atol=1e-15)
    np.testing.assert_allclose(model.camera_centers_in_world(), [[1, 2, 3], [1.5, 2, 3]], atol=1e-15)
    assert model.images.name == ("1001", "1002") and len(model.cameras) == 1
    camera = model.cameras[0]
    assert camera.model == CameraModel.SIMPLE_PINHOLE and (camera.width, camera.height) == (192, 108)
    np.testing.assert_allclose(camera.params, [54 / np.tan(np.deg2rad(20)), 95.5, 53.5], rtol=1e-14)


def test_no_rotation_looks_along_minus_z(tmp_path: Path) -> None:
    model = read_chan(written(tmp_path, "1 0 0 0 0 0 0 90\n"), size=(100, 100))
    pixels = model.cameras[0].project(model.cams_from_world()[0].apply(np.array([[1.0, 1.0, -2.0]])))
    np.testing.assert_allclose(pixels, [[49.5 + 25, 49.5 - 25]])  # to the right, and up


@pytest.mark.parametrize("numbers", [range(6), range(1001, 1013, 2)])
def test_there_and_back(tmp_path: Path, numbers: range) -> None:
    model = named(mappable_model(), *(f"shot_{n:04d}.png" for n in numbers))
    plates(tmp_path, *model.images.name, size=(640, 480))
    write_chan(model, tmp_path / "shot.chan")
    found = read_model(tmp_path / "shot.chan")
    assert found.images.name == model.images.name
    matrices = model.cams_from_world().as_matrix()
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, rtol=0, atol=1e-12)
    assert (found.cameras[0].width, found.cameras[0].height) == (640, 480)
    np.testing.assert_allclose(found.cameras[0].params, model.cameras[0].params[:3], rtol=1e-13)
    lines = (tmp_path / "shot.chan").read_text().splitlines()
    assert [int(line.split()[0]) for line in lines] == list(numbers)


def test_angles_do_not_jump_between_frames(tmp_path: Path) -> None:
    """Between frames, programs interpolate the numbers."""
    text = "".join(f"{n} 0 0 0 0 {angle} 0 40\n" for n, angle in enumerate(range(150, 250, 10)))
    write_chan(read_chan(written(tmp_path, text), (64, 48)), tmp_path / "again.chan")
    rows = np.loadtxt(tmp_path / "again.chan")
    np.testing.assert_allclose(np.diff(rows[:, 5]), 10.0, atol=1e-9)


def test_images_without_a_pose_have_no_frame(tmp_path: Path) -> None:
    model = named(mappable_model(), "a.png", "b.png", "c.png", "d.png", "e.png", "f.png")
    motions, lost = model.frames.rig_from_world, unregistered(1)
    rotation, translation = motions.rotation.copy(), motions.translation.copy()
    rotation[2], translation[2] = lost.rotation[0], lost.translation[0]
    frames = replace(model.frames, rig_from_world=type(motions)(rotation, translation))
    plates(tmp_path, *model.images.name, size=(640, 480))
    write_chan(replace(model, frames=frames), tmp_path / "shot.chan")
    with pytest.warns(RuntimeWarning, match="images without a frame are not read: 1"):
        found = read_model(tmp_path / "shot.chan")
    assert found.images.name == ("a.png", "b.png", "d.png", "e.png", "f.png")


def test_frame_numbers() -> None:
    assert frame_numbers(["s2_0010.jpg", "s2_0012.jpg"]) == [10, 12]
    assert frame_numbers(["b/1.png", "a/2.png"]) == [1, 2]
    assert frame_numbers(["b/1.png", "a/1.png"]) == [2, 1]  # not different: by name
    assert frame_numbers(["x.png", "1.png"]) == [2, 1]
    assert frame_numbers(["99999999999999999999.png", "a1.png"]) == [1, 2]
    assert frame_numbers([]) == []


def test_a_zoom_has_several_cameras(tmp_path: Path) -> None:
    model = read_chan(written(tmp_path, EXAMPLE.replace("30 40", "30 50")), size=(192, 108))
    assert len(model.cameras) == 2 and model.cameras[0].focal_px > model.cameras[1].focal_px
    write_chan(model, tmp_path / "again.chan")
    np.testing.assert_allclose(np.loadtxt(tmp_path / "again.chan")[:, 7], [40, 50])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("1002 1.5", "1002.5 1.5", "line 2: the frame 1002.5 is not an integer"),
        ("1002 1.5", "1001 1.5", "the frame 1001 2 times"),
        ("1002 1.5 2", "1002 1.5", "line 2: it has no field of view; export a camera, not an object"),
        ("1002 1.5", "1002 0 1.5", "line 2: 8 finite numbers expected"),
        ("1002 1.5", "1002 nan", "line 2: 8 finite numbers expected"),
        ("1002 1.5", "1002 one", "line 2: not a number"),
        ("30 40", "30 0", "frame 1002: the field of view 0 is not between 0 and 180"),
        ("30 40", "30 180", "frame 1002: the field of view 180 is not"),
        ("30 40", "30 1e-320", "frame 1002:"),
        (EXAMPLE, "# comment\n", "it has no frames"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in EXAMPLE
    with pytest.raises(FileFormatError, match=words):
        read_chan(written(tmp_path, EXAMPLE.replace(old, new)), size=(192, 108))


def test_without_a_size_the_images_are_needed(tmp_path: Path) -> None:
    path = written(tmp_path)
    with pytest.raises(FileFormatError, match="it has no image size, and there is no folder"):
        read_model(path)
    plates(tmp_path, "plate.1001.jpg", "plate.1003.jpg")
    with pytest.raises(FileFormatError, match="has the number of frame 1002"):
        read_model(path)
    plates(tmp_path, "plate.1002.jpg")
    with pytest.warns(RuntimeWarning, match="images without a frame are not read: 1"):
        assert read_model(path).images.name == ("plate.1001.jpg", "plate.1002.jpg")


def test_what_the_format_cannot_store_is_refused(tmp_path: Path) -> None:
    model = mappable_model()

    def with_cameras(*cameras: Camera) -> Reconstruction:
        return replace(model, cameras=Cameras.from_list(list(cameras)))

    distorted = with_cameras(Camera("RADIAL", 640, 480, [500, 320, 240, 0.01, 0]))
    fisheye = with_cameras(Camera("OPENCV_FISHEYE", 640, 480, [500, 500, 320, 240, 0, 0, 0, 0]))
    stretched = with_cameras(Camera("PINHOLE", 640, 480, [500, 600, 320, 240]))
    cameras = [
        Camera("PINHOLE", each.width, each.height, each.params[[0, 0, 1, 2]])
        for each in small_model().cameras
    ]
    rig = replace(small_model(), cameras=Cameras.from_list(cameras))
    for each, words in (
        (distorted, "a .chan file has no distortion: undistort the images first"),
        (fisheye, "a .chan file has no distortion"),
        (stretched, "a .chan file has a single focal length, but this camera has 500 and 600"),
        (rig, "the model has a rig of several"),
    ):
        with pytest.raises(ConfigError, match=words):
            write_chan(each, tmp_path / "a.chan")
    assert not list(tmp_path.iterdir())


def test_several_image_sizes_are_refused(tmp_path: Path) -> None:
    one = read_chan(written(tmp_path), size=(192, 108))
    sizes = [
        Camera("SIMPLE_PINHOLE", 192, 108, [100, 96, 54]),
        Camera("SIMPLE_PINHOLE", 96, 54, [50, 48, 27]),
    ]
    rigs = type(one.rigs).of_single_cameras(2)
    frames = replace(one.frames, rig=np.array([0, 1], np.int32))
    images = replace(one.images, sensor=np.array([0, 1], np.int32))
    model = replace(one, cameras=Cameras.from_list(sizes), rigs=rigs, frames=frames, images=images)
    with pytest.raises(ConfigError, match=r"several sizes \(96 x 54, 192 x 108\)"):
        write_chan(model, tmp_path / "a.chan")
