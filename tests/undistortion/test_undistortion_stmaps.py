"""STMaps: the identity one after the other, the project's own undistortion of a grid, and their files."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.image import distortion_stmap, undistort_image, undistorted_camera, undistortion_stmap
from epipole.io import read_colmap_model, write_colmap_model
from epipole.io.images.stmaps import write_stmap
from epipole.pipelines.undistortion.run import undistort
from epipole.scene import Cameras
from io_models import mappable_model, small_model

CAMERAS = {
    "barrel": Camera("OPENCV", 320, 240, [250, 248, 163.0, 117.0, -0.2, 0.05, 1e-3, -2e-3]),
    "pincushion": Camera("RADIAL", 320, 240, [300, 160, 120, 0.1, 0.02]),
    "fisheye": Camera("OPENCV_FISHEYE", 320, 240, [120, 120, 160, 120, 0.02, -0.01, 0, 0]),
    "pinhole": Camera("PINHOLE", 320, 240, [250, 240, 170, 110]),
}


def nuke(image: np.ndarray, stmap: np.ndarray) -> np.ndarray:
    """As the STMap node: coordinates from the bottom left, edges of the image at 0 and 1; bilinear, black outside."""
    height, width = image.shape[:2]
    u = (stmap[..., 0].astype(np.float64) * width - 0.5).astype(np.float32)
    v = ((1.0 - stmap[..., 1].astype(np.float64)) * height - 0.5).astype(np.float32)
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def read_tiff(path: Path) -> np.ndarray:
    """By GDAL, which has nothing to do with the writer."""
    with rasterio.open(path) as file:
        return np.moveaxis(file.read(), 0, -1)


def grid_image(camera: Camera) -> np.ndarray:
    """Lines and a gradient."""
    v, u = np.mgrid[: camera.height, : camera.width]
    lines = np.where((u % 20 < 2) | (v % 20 < 2), 255, 40)
    return np.stack([lines, u % 256, 255 * v // camera.height], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_map_undistorts_as_the_project_does(name: str) -> None:
    camera = CAMERAS[name]
    pinhole, rgb = undistorted_camera(camera), grid_image(camera)
    stmap = undistortion_stmap(camera, pinhole)
    assert stmap.shape == (pinhole.height, pinhole.width, 2) and stmap.dtype == np.float32
    difference = nuke(rgb, stmap).astype(int) - undistort_image(rgb, camera, pinhole)
    assert np.abs(difference).max() <= 3  # positions are rounded to 1/32 of a pixel by OpenCV
    assert np.abs(difference).mean() < 0.1


@pytest.mark.parametrize("name", CAMERAS)
def test_one_after_the_other_is_the_identity(name: str) -> None:
    """Of positions, in pixels: what the distorted image shows at the position that the undistorted one has."""
    camera = CAMERAS[name]
    pinhole = undistorted_camera(camera)
    to_flat, to_distorted = distortion_stmap(camera, pinhole), undistortion_stmap(camera, pinhole)
    assert to_flat.shape == (camera.height, camera.width, 2)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    identity = np.stack([(u + 0.5) / camera.width, 1 - (v + 0.5) / camera.height], axis=-1)
    margin = 1.0 / np.array([pinhole.width, pinhole.height])
    inside = ((to_flat > margin) & (to_flat < 1 - margin)).all(axis=-1)
    assert inside.mean() > (0.3 if name == "fisheye" else 0.7)
    there_and_back = nuke(to_distorted, to_flat)
    error_px = np.abs(there_and_back - identity)[inside] * [camera.width, camera.height]
    assert error_px.max() < 0.05  # of the interpolation between pixels of the map


def test_a_flat_image_is_distorted_as_the_camera_projects() -> None:
    camera = CAMERAS["barrel"]
    pinhole = undistorted_camera(camera)
    stmap = distortion_stmap(camera, pinhole)
    rays = camera.unproject(np.array([[100.0, 60.0]]))
    u, v = pinhole.project(rays)[0]
    np.testing.assert_allclose(
        stmap[60, 100], [(u + 0.5) / pinhole.width, 1 - (v + 0.5) / pinhole.height], atol=1e-7
    )


def test_the_map_without_distortion_is_nukes_identity() -> None:
    """(x + 0.5) / width and (y + 0.5) / height, with y from the bottom: red grows to the right, green upward."""
    camera = CAMERAS["pinhole"]
    for make in (undistortion_stmap, distortion_stmap):
        stmap = make(camera, undistorted_camera(camera))
        np.testing.assert_allclose(stmap[239, 0], [0.5 / 320, 0.5 / 240], atol=1e-6)
        np.testing.assert_allclose(stmap[0, 319], [319.5 / 320, 239.5 / 240], atol=1e-6)


def test_pixels_without_a_ray_are_outside() -> None:
    """A fisheye sees more than 180 degrees, a pinhole camera does not."""
    camera = Camera("OPENCV_FISHEYE", 320, 320, [80, 80, 159.5, 159.5, 0, 0, 0, 0])
    stmap = distortion_stmap(camera, undistorted_camera(camera))
    assert (stmap[0, 0] == -1).all() and (stmap[160, 2] == -1).all()
    assert ((stmap[150:170, 150:170] > 0) & (stmap[150:170, 150:170] < 1)).all()


def test_files_are_floating_point_in_red_and_green(tmp_path: Path) -> None:
    stmap = undistortion_stmap(CAMERAS["barrel"], undistorted_camera(CAMERAS["barrel"]))
    write_stmap(tmp_path / "a.tif", stmap)
    found = read_tiff(tmp_path / "a.tif")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found[..., :2], stmap)
    assert (found[..., 2] == 0).all()
    with pytest.raises(ConfigError, match=r"path must end in .tif or .tiff, got 'a.exr'"):
        write_stmap(tmp_path / "a.exr", stmap)


def test_the_job_writes_maps_of_each_camera(tmp_path: Path) -> None:
    """At the size of the image files, here half of the cameras'; a run without them removes them."""
    model = small_model()
    write_colmap_model(model, tmp_path / "sparse" / "0")
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        half = Camera("PINHOLE", camera.width // 2, camera.height // 2, [100, 100, 0, 0])
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(grid_image(half)).save(tmp_path / "images" / name, quality=100)
    out = undistort(tmp_path, stmaps=True)
    names = [f"camera_{n}_{kind}.tif" for n in (1, 2, 3) for kind in ("distort", "undistort")]
    assert sorted(path.name for path in (out / "stmaps").iterdir()) == names
    flat = read_colmap_model(out / "sparse" / "0")
    for number, name in ((1, "rig/a 0.jpg"), (2, "rig/b0.jpg")):
        to_distorted, to_flat = (
            read_tiff(out / "stmaps" / f"camera_{number}_{kind}.tif") for kind in ("undistort", "distort")
        )
        camera = flat.cameras[number - 1]
        rgb = np.asarray(Image.open(tmp_path / "images" / name))
        assert to_distorted.shape == (camera.height, camera.width, 3) and to_flat.shape == rgb.shape
        difference = nuke(rgb, to_distorted[..., :2]).astype(int) - np.asarray(
            Image.open(out / "images" / name)
        )
        assert np.abs(difference).mean() < 3  # JPEG
    assert not (undistort(tmp_path) / "stmaps").exists() or not list((out / "stmaps").iterdir())


def test_the_model_is_as_without_maps(tmp_path: Path) -> None:
    camera = replace(CAMERAS["barrel"])
    model = replace(mappable_model(), cameras=Cameras.from_list([camera]))
    write_colmap_model(model, tmp_path / "sparse" / "0")
    for name in model.images.name:
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(grid_image(camera)).save(tmp_path / "images" / name)
    one = read_colmap_model(undistort(tmp_path, target=tmp_path / "a") / "sparse" / "0")
    other = read_colmap_model(undistort(tmp_path, target=tmp_path / "b", stmaps=True) / "sparse" / "0")
    np.testing.assert_array_equal(one.cameras.params, other.cameras.params)
