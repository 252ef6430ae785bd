"""Arguments that would lead kernels beyond arrays, or a library round for ever."""

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.dense.tsdf import DistanceVolume
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.fields.exposure import color_match
from epipole.fields.photometric import psnr
from epipole.geometry import Rigid3
from epipole.scene import Mesh

CAMERA = Camera("PINHOLE", 8, 6, [8.0, 8.0, 3.5, 2.5])
GOOD = {
    "depth": np.ones((6, 8), np.float32),
    "coverage": np.ones((6, 8), np.float32),
    "rgb": np.ones((6, 8, 3), np.float32),
}


def volume(**given):
    return DistanceVolume(**{"low": -np.ones(3), "high": np.ones(3), "voxels": 4} | given)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"depth": np.ones((3, 4), np.float32)}, ShapeError),
        ({name: part[:3] for name, part in GOOD.items()}, ShapeError),
        ({"coverage": np.ones((3, 8), np.float32)}, ShapeError),
        ({"rgb": np.ones((6, 8, 1), np.float32)}, ShapeError),
        ({"depth": np.array(["far"] * 48).reshape(6, 8)}, ShapeError),
        ({"cam_from_world": Rigid3.identity(2)}, ShapeError),
        ({"cam_from_world": Rigid3(np.eye(3), np.full(3, 1e300))}, ShapeError),
        ({"camera": Camera("RADIAL", 8, 6, [8.0, 3.5, 2.5, 0.1, 0.1])}, ConfigError),
    ],
)
def test_no_image_is_fused_that_is_not_its_cameras(change, error):
    given = {"camera": CAMERA, "cam_from_world": Rigid3.identity()} | GOOD
    volume().add(**given)
    with pytest.raises(error):
        volume().add(**given | change)


def test_boxes_and_meshes_are_checked():
    for given in ({"low": np.full(3, np.nan)}, {"high": np.full(3, 1e300)}, {"high": -np.ones(3)}):
        with pytest.raises(DegenerateGeometryError):
            volume(**given)
    for voxels in (0, -1, 2**40):
        with pytest.raises(ConfigError):
            volume(voxels=voxels)
    with pytest.raises(ShapeError, match="faces"):
        Mesh(np.eye(3), np.array([[0, 1, 3]]), np.zeros((3, 3), np.uint8))


@pytest.mark.parametrize("function", [color_match, psnr])
def test_images_that_are_empty_or_not_finite_are_not_compared(function):
    image = np.full((4, 5, 3), 0.5, np.float32)
    broken = image.copy()
    for value in (np.nan, np.inf):
        broken[0, 0, 0] = value
        for both in ((image, broken), (broken, image)):
            with pytest.raises(ShapeError, match="finite"):
                function(*both)
    with pytest.raises(ShapeError):
        function(image[:0], image[:0])
