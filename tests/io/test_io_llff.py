"""LLFF's poses_bounds.npy: axes, sizes, points; and files that are wrong."""

import numpy as np
import pytest
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io.models.llff import LLFF, read_llff
from epipole.synthetic import look_at


def write_scene(folder, count=3, sizes=((1, 80, 60), (4, 20, 15))):
    """A folder of images in two sizes, and cameras around the middle; returns their poses."""
    positions = [look_at((np.sin(k), -4.0, 0.3 * k), (0, 0, 0)) for k in range(count)]
    rows = []
    for position in positions:
        world = position.inverse()
        right, down, ahead = world.rotation.T
        matrix = np.stack([down, right, -ahead, world.translation, [60.0, 80.0, 70.0]], axis=1)
        rows.append([*matrix.reshape(-1), 2.0, 9.0])
    folder.mkdir(exist_ok=True)
    np.save(folder / LLFF, np.array(rows))
    for factor, width, height in sizes:
        own = folder / ("images" if factor == 1 else f"images_{factor}")
        own.mkdir()
        for k in range(count):
            Image.new("RGB", (width, height), (10 * k, 0, 0)).save(own / f"{k}.png")
    return positions


def test_cameras_are_those_that_were_written(tmp_path):
    positions = write_scene(tmp_path / "a")
    scene = read_llff(tmp_path / "a")
    model = scene.reconstruction
    assert scene.image_folder.name == "images" and model.images.name == ("0.png", "1.png", "2.png")
    for k, position in enumerate(positions):
        np.testing.assert_allclose(model.cams_from_world()[k].as_matrix(), position.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(model.cameras[0].params, [70, 70, 39.5, 29.5])
    np.testing.assert_array_equal(scene.near_far, np.tile([2.0, 9.0], (3, 1)))
    assert len(model.points) == 0


def test_the_size_of_pictures_is_chosen(tmp_path):
    write_scene(tmp_path / "a")
    scene = read_llff(tmp_path / "a", max_side_px=40)
    assert scene.image_folder.name == "images_4"
    np.testing.assert_allclose(scene.reconstruction.cameras[0].params, [17.5, 17.5, 9.5, 7.0])
    assert read_llff(tmp_path / "a", max_side_px=4).image_folder.name == "images_4"


def test_fern_points_lie_before_its_cameras(data_dir):
    scene = read_llff(data_dir / "fields" / "fern", max_side_px=800)
    model = scene.reconstruction
    assert len(model.images.name) == 20 and len(model.points) == 10_091
    for k in range(20):
        depth = model.cams_from_world()[k].apply(model.points.xyz_in_world)[:, 2]
        near, far = scene.near_far[k]
        assert 0.9 * near < np.quantile(depth, 0.02) and np.quantile(depth, 0.9) < 1.1 * far


def test_wrong_files(tmp_path):
    write_scene(tmp_path / "a")
    rows = np.load(tmp_path / "a" / LLFF)

    def refused(array, words):
        np.save(tmp_path / "a" / LLFF, array)
        with pytest.raises(FileFormatError, match=words):
            read_llff(tmp_path / "a")

    refused(rows[:2], "it has 2 cameras")
    refused(rows[:, :15], "17 numbers")
    refused(np.where(np.arange(17) == 3, np.nan, rows), "not finite")
    refused(np.where(np.arange(17) == 15, -1.0, rows), "in order")
    refused(np.where(np.arange(17) == 14, 0.0, rows), "invalid camera")
    narrow = rows.copy()
    narrow[:, 9], narrow[:, 14] = (
        1e300,
        1e-100,
    )  # width and focal length: their ratio is 0 in double precision
    refused(narrow, "invalid camera")
    refused(2 * rows, "rotation")
    (tmp_path / "a" / LLFF).write_bytes(b"\x93NUMPY\x01\x00 nothing")
    with pytest.raises(FileFormatError, match="not an array"):
        read_llff(tmp_path / "a")
    with pytest.raises(FileFormatError):
        read_llff(tmp_path)
