"""Lines to be drawn."""

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import Similarity3
from epipole.scene import Curve, path_segments


def test_pieces_join_what_is_joined():
    points = np.arange(12.0).reshape(4, 3)
    pieces = path_segments(points, np.array([True, True, False, True]))
    np.testing.assert_array_equal(pieces, [points[[0, 1]], points[[2, 3]]])
    assert path_segments(np.zeros((0, 3)), np.zeros(0, bool)).shape == (0, 2, 3)
    with pytest.raises(ShapeError, match="n = 4"):
        path_segments(points, np.ones(3, bool))


def test_a_curve_moves_with_its_world(rng):
    curve = Curve("a", rng.normal(size=(3, 2, 3)), (1, 2, 3), is_shown=False)
    by = Similarity3.exp(rng.normal(size=7))
    moved = curve.transformed(by)
    np.testing.assert_allclose(moved.segments_in_world[2, 1], by.apply(curve.segments_in_world[2, 1]))
    assert moved.name == "a" and moved.rgb == (1, 2, 3) and not moved.is_shown
