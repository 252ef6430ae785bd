"""Rows of a made-up image against the interpreter, for every lens, shape and texture, and of nothing."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.synthetic import Box, HeightField, Plane, Sphere, SyntheticScene, Texture, look_at
from epipole.synthetic import _render_kernels as kernels
from kernel_references import assert_same_as_python, reference_of
from whole import in_whole_run

WIDTH, HEIGHT = 6, 4
CAMERAS = {
    "pinhole": Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([5.0, 5.0, 2.5, 1.5])),
    "opencv": Camera(CameraModel.OPENCV, WIDTH, HEIGHT, np.array([5, 5, 2.5, 1.5, -0.1, 0.02, 1e-3, -2e-3])),
    "fisheye": Camera(CameraModel.OPENCV_FISHEYE, WIDTH, HEIGHT, np.array([4, 4, 2.5, 1.5, 0.02, 0, 0, 0])),
}
VIEW = look_at(np.array([4.0, -3.0, 2.5]), (0.1, 0.2, 0.4))
MOTION = np.concatenate([VIEW.rotation.ravel(), VIEW.translation])


def scene(texture: Texture) -> SyntheticScene:
    return SyntheticScene.of(
        [
            Sphere(center=(0, 0, 0.8), radius=0.7, texture=texture, seed=3),
            Box(center=(0.8, 0.6, 0.4), half_size=(0.5, 0.4, 0.6), angle_rad=0.3, texture=texture, seed=4),
            Plane(
                center=(-1, 0, 1),
                direction_u=(1, 0, 0),
                direction_v=(0, 0.6, 0.8),
                half_size=(1, 1),
                texture=texture,
            ),
            HeightField(
                center=(0, 0, 0), half_size=(3, 3), amplitude=0.1, wavelength=1.0, texture=texture, seed=5
            ),
        ]
    )


@in_whole_run
@pytest.mark.parametrize("lens", list(CAMERAS))
@pytest.mark.parametrize("texture", list(Texture))
@reference_of(kernels.render_rows)
def test_rows_are_drawn(lens: str, texture: Texture) -> None:
    camera, shown = CAMERAS[lens], scene(texture)
    columns = (shown.kind, shown.params, shown.texture, shown.color, shown.seed, shown.light)
    given = (int(camera.model), camera.padded_params(), MOTION)
    seen = 0
    for rows in ((0, HEIGHT), (1, 2), (3, 3)):
        rgb, depth = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH), np.nan)
        _, (*_, rgb, depth) = assert_same_as_python(
            kernels.render_rows, columns, *given, *rows, WIDTH, rgb, depth, rtol=1e-12, atol=1e-12
        )
        others = np.delete(np.arange(HEIGHT), np.arange(*rows))
        assert not rgb[others].any() and np.isnan(depth[others]).all()
        seen += np.isfinite(depth).sum()
    assert seen > 5
    nothing = (*(column[:0] for column in columns[:5]), columns[5])
    _, (*_, depth) = assert_same_as_python(
        kernels.render_rows, nothing, *given, 0, HEIGHT, WIDTH, rgb, np.full((HEIGHT, WIDTH), np.nan)
    )
    assert np.isnan(depth).all()
