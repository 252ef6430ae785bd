"""Corners of rendered markers are where they were put, whatever lies around the white rim."""

import cv2
import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.features.tags import find_tags
from epipole.synthetic import Plane, SyntheticScene, Texture, look_at, render
from epipole.synthetic.markers import tag_sheet

CAMERA = Camera("PINHOLE", 320, 240, [300.0, 300.0, 159.5, 119.5])
SIDE = 0.2


def seen(color, view, dictionary="APRILTAG_36h11"):
    sheet = tag_sheet(5, SIDE, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), dictionary)
    wall = Plane(
        center=(0, 0.01, 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(5, 5), color=color,
        texture=Texture.PLAIN,
    )  # fmt: skip
    scene = SyntheticScene.of([wall, *sheet], light=(0.0, -1.0, 0.0))
    return cv2.cvtColor(render(scene, CAMERA, view, noise_sigma=2.0, seed=3).rgb, cv2.COLOR_RGB2GRAY)


@pytest.mark.parametrize("color", [(0.2, 0.2, 0.2), (1.0, 1.0, 1.0)])
@pytest.mark.parametrize("position", [(0.1, -1.0, 0.1), (0.8, -1.3, 0.4)])
def test_corners_lie_where_the_marker_ends(color, position):
    # Held askew: the renderer casts two rays across a pixel, and an upright edge would lie on one of them.
    view = look_at(position, (0.0, 0.0, 0.0), (0.3, 0.0, 1.0))
    found = find_tags(seen(color, view), "APRILTAG_36h11")
    assert found.number.tolist() == [5] and "1 marker" in repr(found)
    square = 0.5 * SIDE * np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1.0]])
    off = found.corners[0] - CAMERA.project(view.apply(square))
    assert np.linalg.norm(off, axis=1).max() < 0.25
    # A bias of size is what a scale would feel.
    spread = np.linalg.norm(found.corners[0] - found.corners[0].mean(axis=0), axis=1).sum()
    true = CAMERA.project(view.apply(square))
    assert spread == pytest.approx(np.linalg.norm(true - true.mean(axis=0), axis=1).sum(), rel=0.004)


def test_what_is_no_marker_gives_none():
    view = look_at((0.1, -1.0, 0.1), (0.0, 0.0, 0.0))
    assert len(find_tags(seen((0.3, 0.3, 0.3), view), "4X4_50")) == 0
    assert len(find_tags(np.zeros((20, 20), np.uint8), "4X4_50")) == 0
    assert len(find_tags(np.full((200, 200), 90, np.uint8), "ARUCO_ORIGINAL")) == 0
    far = look_at((0.0, -9.0, 0.0), (0.0, 0.0, 0.0))  # too small to be told
    assert len(find_tags(seen((0.3, 0.3, 0.3), far), "APRILTAG_36h11")) == 0
    with pytest.raises(ConfigError, match="unknown dictionary"):
        find_tags(np.zeros((99, 99), np.uint8), "36h12")


def test_a_number_that_is_seen_twice_is_left_out():
    one = seen((0.3, 0.3, 0.3), look_at((0.1, -1.0, 0.1), (0.0, 0.0, 0.0)))
    assert len(find_tags(np.hstack([one, one]), "APRILTAG_36h11")) == 0
