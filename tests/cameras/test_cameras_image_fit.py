"""A camera goes with its image: turned and scaled as the image is, and refused where it cannot be its camera."""

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.cameras.image_fit import (
    ImagePixels,
    ImageShape,
    camera_of_image,
    described_pixels,
    fit_notes,
    fitted_camera,
    likely_size,
    rotated_camera,
    rotated_pixels,
    with_likely_principal_point,
)
from epipole.errors import ConfigError
from epipole.io.images.pixels import rotation

W, H = 40, 30
LENSES = [
    Camera("SIMPLE_PINHOLE", W, H, [35.0, 18.0, 16.5]),
    Camera("PINHOLE", W, H, [35.0, 38.0, 18.0, 16.5]),
    Camera("SIMPLE_RADIAL", W, H, [35.0, 18.0, 16.5, -0.1]),
    Camera("RADIAL", W, H, [35.0, 18.0, 16.5, -0.1, 0.03]),
    Camera("OPENCV", W, H, [35.0, 38.0, 18.0, 16.5, -0.1, 0.03, 0.02, -0.01]),
    Camera("OPENCV_FISHEYE", W, H, [35.0, 38.0, 18.0, 16.5, -0.1, 0.03, 0.02, -0.01]),
    Camera("FULL_OPENCV", W, H, [35.0, 38.0, 18.0, 16.5, -0.1, 0.03, 0.02, -0.01, 0.01, 0.1, 0.02, 0.01]),
]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_turn_as_the_image_does(orientation):
    stored = np.zeros((H, W), np.uint8)
    stored[5, 11] = 1
    upright = rotation(stored, orientation)
    ((row, column),) = np.argwhere(upright)
    found = rotated_pixels(np.array([[11.0, 5.0]]), (W, H), orientation)
    np.testing.assert_allclose(found, [[column, row]])


@pytest.mark.parametrize("camera", LENSES, ids=lambda c: c.model.name)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_camera_projects_turned_rays_to_turned_pixels(camera, orientation, rng):
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (20, 2)), np.ones(20)])
    axes = rotated_pixels(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (1, 1), orientation)
    turned_rays = np.column_stack([rays[:, :2] @ (axes[1:] - axes[0]), rays[:, 2]])
    expected = rotated_pixels(camera.project(rays), (W, H), orientation)
    rotated = rotated_camera(camera, orientation)
    assert (rotated.width, rotated.height) == ((W, H) if orientation < 5 else (H, W))
    np.testing.assert_allclose(rotated.project(turned_rays), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((40, 30), True),
        ((20, 15), True),
        ((80, 60), True),
        ((13, 10), True),  # 40 / 3 is rounded
        ((4000, 3000), True),
        ((30, 40), False),
        ((40, 31), False),
        ((41, 31), False),  # cropped?
        ((20, 20), False),
        ((400, 290), False),
    ],
)
def test_an_image_is_a_camera_s_at_one_factor(size, expected):
    camera = LENSES[4]
    if not expected:
        with pytest.raises(ConfigError, match=f"for images of 40x30, but the image is {size[0]}x{size[1]}"):
            fitted_camera(camera, *size)
        return
    fitted = fitted_camera(camera, *size)
    ray, ratio = [[0.1, -0.2, 1.0]], np.array(size) / [W, H]
    np.testing.assert_allclose(fitted.project(ray) + 0.5, (camera.project(ray) + 0.5) * ratio)


def test_turned_and_scaled_in_one():
    camera = camera_of_image(LENSES[1], ImageShape(15, 20, 6), ImagePixels.STORED)
    # Turned clockwise: x upright grows against y stored, and y upright with x stored.
    np.testing.assert_allclose(camera.K[:2, 2] + 0.5, [(30 - 17.0) / 2, 18.5 / 2])
    np.testing.assert_allclose([camera.K[0, 0], camera.K[1, 1]], [19.0, 17.5])


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        ([ImageShape(40, 30, 1)], ImagePixels.UPRIGHT),
        ([ImageShape(40, 30, 3)] * 2, ImagePixels.UPRIGHT),  # all turned alike
        ([ImageShape(40, 30, 1), ImageShape(40, 30, 3)], ImagePixels.STORED),  # one sensor
        ([ImageShape(30, 40, 6)], ImagePixels.STORED),
        ([ImageShape(40, 30, 6)], ImagePixels.UPRIGHT),
        ([ImageShape(40, 30, 1), ImageShape(30, 40, 6), ImageShape(15, 20, 8)], ImagePixels.STORED),
    ],
)
def test_sizes_tell_which_pixels_are_described(shapes, expected):
    assert described_pixels((40, 30), shapes) is expected


def test_images_that_fit_neither_way_are_refused():
    with pytest.raises(ConfigError, match="file is for images of 40x30, but these are 30x40"):
        described_pixels((40, 30), [ImageShape(40, 30, 1), ImageShape(30, 40, 1)], "file")
    with pytest.raises(ConfigError, match="these are 30x30"):
        described_pixels((40, 30), [ImageShape(30, 30, 6)])


def test_parameters_without_a_size_are_of_the_images_they_fit():
    portrait = [ImageShape(30, 40, 6)] * 3
    assert likely_size((20.0, 15.0), portrait) == (40, 30)
    assert likely_size((15.0, 20.0), portrait) == (30, 40)
    assert likely_size((20.0, 15.0), [ImageShape(30, 40, 1)]) == (30, 40)
    assert likely_size((20.0, 15.0), [ImageShape(40, 30, 1), ImageShape(30, 40, 8)]) == (40, 30)
    with pytest.raises(ConfigError, match="one size, but there are 30x40, 40x30"):
        likely_size((20.0, 15.0), [ImageShape(40, 30, 1), ImageShape(30, 40, 1)])


def test_what_was_done_with_a_camera_is_said():
    mixed = [ImageShape(40, 30, 1), ImageShape(40, 30, 3)]
    assert fit_notes(LENSES[1], mixed[:1], ImagePixels.UPRIGHT, "file") == []
    (note,) = fit_notes(LENSES[1], mixed, ImagePixels.STORED, "file")
    assert "stored pixels" in note
    (note,) = fit_notes(LENSES[1], mixed[1:], ImagePixels.UPRIGHT, "file")
    assert "describe the upright images" in note
    (note,) = fit_notes(LENSES[1], [ImageShape(20, 15, 1)], ImagePixels.UPRIGHT, "file")
    assert note == "file is for images of 40x30 and was scaled to 20x15"


def test_landscape_parameters_of_portrait_images_are_swapped_and_said():
    portrait = Camera("PINHOLE", 1080, 1920, [1500.0, 1510.0, 959.5, 539.5])
    camera, note = with_likely_principal_point(portrait)
    np.testing.assert_allclose(camera.params, [1510.0, 1500.0, 539.5, 959.5])
    assert "1920x1080" in note and "1080x1920" in note
    right = Camera("PINHOLE", 1080, 1920, [1500.0, 1510.0, 539.5, 959.5])
    assert with_likely_principal_point(right) == (right, "")
    nearly_square = Camera("PINHOLE", 500, 480, [400.0, 400.0, 239.5, 249.5])  # 10 px off may be right
    assert with_likely_principal_point(nearly_square)[0] is nearly_square
