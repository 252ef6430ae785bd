"""Arguments that would lead kernels beyond arrays, or a library round for ever."""

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.fields.exposure import color_match
from epipole.fields.photometric import psnr
from epipole.scene import Mesh


def test_meshes_are_checked():
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
