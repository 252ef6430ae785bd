"""A model's images are read in the pixels that its cameras describe, at any scale: by sizes, colors, and who made it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera
from epipole.cameras.image_fit import inverse_orientation, rotated_pixels
from epipole.errors import FileFormatError
from epipole.io import read_colmap_model, write_colmap_model
from epipole.io.images.photographs import read_rgb
from epipole.io.images.pixels import rotation
from epipole.io.images.rgba import read_rgba
from epipole.io.models.images import ModelImages
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import gather_field_images
from epipole.pipelines.sfm.page.scene import image_loader
from epipole.pipelines.undistortion.run import undistort
from epipole.scene import Cameras, Reconstruction, Rigs
from io_models import mappable_model

W, H = 64, 48


def stored_picture(seed: int) -> np.ndarray:
    """Smooth colors without any symmetry."""
    small = np.random.default_rng(seed).integers(0, 255, (4, 5, 3), np.uint8)
    return np.asarray(Image.fromarray(small).resize((W, H), Image.Resampling.BICUBIC))


def write(path: Path, pixels: np.ndarray, orientation: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


def model_of(orientation: int, *, of_stored: bool, has_colors: bool = True) -> Reconstruction:
    """A model of images 64x48 whose keypoints and camera are of stored or of upright pixels."""
    model, rng = mappable_model(), np.random.default_rng(5)
    size = (W, H) if of_stored or orientation < 5 else (H, W)
    camera = Camera("SIMPLE_RADIAL", *size, [50.0, size[0] / 2, size[1] / 2, 0.01])
    n = len(model.images)
    names = tuple(f"photo{k}.png" for k in range(n))
    stored = rng.uniform(0, [W - 1, H - 1], model.images.keypoints_px.shape)
    keypoints = stored if of_stored else rotated_pixels(stored, (W, H), orientation)
    rgb = np.zeros_like(model.points.rgb)
    if has_colors:  # of the first observation, whose image is the same as all others
        first = model.images.keypoint_offsets[model.tracks.image] + model.tracks.keypoint
        for point, (start, end) in enumerate(zip(model.tracks.offsets[:-1], model.tracks.offsets[1:])):
            keypoints[first[start:end]] = keypoints[first[start]]
            x, y = np.rint(stored[first[start]]).astype(int)
            rgb[point] = stored_picture(0)[y, x]
    return replace(
        model,
        cameras=Cameras.from_list([camera]),
        rigs=Rigs.of_single_cameras(1),
        frames=replace(model.frames, rig=np.zeros(len(model.frames), np.int32)),
        images=replace(model.images, name=names, sensor=np.zeros(n, np.int32), keypoints_px=keypoints),
        points=replace(model.points, rgb=rgb),
    )


def write_images(folder: Path, model: Reconstruction, orientation: int, scale: int = 1) -> None:
    image = np.asarray(Image.fromarray(stored_picture(0)).resize((W // scale, H // scale)))
    for name in model.images.name:
        write(folder / name, image, orientation)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("of_stored", [True, False])
def test_colors_and_sizes_tell_what_is_described(tmp_path, orientation, of_stored):
    model = model_of(orientation, of_stored=of_stored)
    write_images(tmp_path, model, orientation)
    found = ModelImages(model, tmp_path, is_own=of_stored)  # the mark says the opposite
    image = found.find("photo0.png")
    expected = stored_picture(0) if of_stored else rotation(stored_picture(0), orientation)
    np.testing.assert_array_equal(image.read(), expected)


@pytest.mark.parametrize("is_own", [True, False])
def test_without_colors_the_maker_decides(tmp_path, is_own):
    model = model_of(3, of_stored=True, has_colors=False)
    write_images(tmp_path, model, 3)
    expected = rotation(stored_picture(0), 3) if is_own else stored_picture(0)
    np.testing.assert_array_equal(
        ModelImages(model, tmp_path, is_own=is_own).find("photo1.png").read(), expected
    )


def test_half_of_the_size_halves_the_camera(tmp_path):
    model = model_of(6, of_stored=True)
    write_images(tmp_path, model, 6, scale=2)
    image = ModelImages(model, tmp_path, is_own=False).find("photo0.png")
    assert (image.camera.width, image.camera.height, image.orientation) == (W // 2, H // 2, 1)
    np.testing.assert_allclose(image.camera.focal_px, 25.0)


def test_an_image_of_another_shape_is_refused(tmp_path):
    model = model_of(1, of_stored=True)
    write(tmp_path / "photo0.png", np.zeros((H, H, 3), np.uint8), 1)
    images = ModelImages(model, tmp_path, is_own=False)
    with pytest.raises(FileFormatError, match="is 48 x 48, but its camera 64 x 48"):
        images.find("photo0.png")
    assert images.loader(100)("photo0.png") is None


@pytest.fixture(params=[(3, 1), (6, 1), (1, 2), (8, 2)], ids=str)
def stored_workspace(request, tmp_path) -> tuple[Path, int]:
    """COLMAP's output: a model of stored pixels beside images with EXIF orientation, of full or half size."""
    orientation, scale = request.param
    model = model_of(orientation, of_stored=True)
    write_colmap_model(model, tmp_path / "sparse" / "0")
    write_images(tmp_path / "images", model, orientation, scale)
    return tmp_path, scale


def test_undistort_and_fields_read_what_the_model_describes(stored_workspace):
    workspace, scale = stored_workspace
    small = np.asarray(Image.fromarray(stored_picture(0)).resize((W // scale, H // scale)), np.float64)
    done = undistort(workspace)
    pinhole = read_colmap_model(done / "sparse" / "0").cameras[0]
    rgb = read_rgb(done / "images" / "photo0.png").astype(np.float64)
    assert rgb.shape == (pinhole.height, pinhole.width, 3)
    np.testing.assert_allclose(pinhole.focal_px, 50.0 / scale)
    middle = np.s_[6:-6, 6:-6]
    left, top = (small.shape[1] - rgb.shape[1]) // 2, (small.shape[0] - rgb.shape[0]) // 2
    own = small[top : top + rgb.shape[0], left : left + rgb.shape[1]]
    assert np.abs(rgb - own)[middle].mean() < 12 < np.abs(rgb - own[::-1, ::-1])[middle].mean()
    (view, *_), loaded = (
        gather_field_images(workspace, FieldOptions(test_every=0)).train,
        image_loader(workspace / "images", read_colmap_model(workspace / "sparse" / "0"))("photo0.png"),
    )
    np.testing.assert_array_equal(view.image, rgb.astype(np.uint8))
    np.testing.assert_array_equal(loaded, small.astype(np.uint8))


@pytest.mark.parametrize("orientation", [1, 3, 6, 7])
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_pixels_are_read_as_stored_where_asked(tmp_path, orientation, suffix):
    path = tmp_path / f"a.{suffix}"
    write(path, stored_picture(1), orientation)
    stored = np.asarray(stored_picture(1), int)
    assert np.abs(read_rgb(path, orientation=1).astype(int) - stored).mean() < 4
    assert np.abs(read_rgb(path).astype(int) - rotation(stored_picture(1), orientation)).mean() < 4


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_transparent_images_are_turned_as_others_are(tmp_path, suffix):
    rgba = np.dstack([stored_picture(2), stored_picture(3)[..., :1]])
    write(tmp_path / f"a.{suffix}", rgba, 6)
    np.testing.assert_array_equal(read_rgba(tmp_path / f"a.{suffix}"), rotation(rgba, 6))
    np.testing.assert_array_equal(read_rgba(tmp_path / f"a.{suffix}", orientation=1), rgba)
    assert inverse_orientation(6) == 8
