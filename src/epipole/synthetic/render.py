"""Pictures of a synthetic scene, with exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from epipole import _parallel
from epipole._checks import check_pixels
from epipole._declared import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.synthetic import _render_kernels as kernels
from epipole.synthetic.scene import SyntheticScene


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A picture and its depth."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float64[np.ndarray, "h w"]
    """z in camera coordinates at each pixel's centre; NaN for the sky."""


@checked
def render(
    scene: SyntheticScene, camera: Camera, cam_from_world: Rigid3, *, noise_sigma: float = 0.0, seed: int = 0
) -> Rendering:
    """Cast rays through every pixel (four a pixel for the colour, one for the depth).

    Args:
        scene: what there is.
        camera: any model, distortion included.
        cam_from_world: where the camera stands.
        noise_sigma: standard deviation of the sensor's noise, in grey levels of 255.
        seed: of the noise.

    Raises:
        ConfigError: noise or seed is negative, or the picture too large.
        ShapeError: the camera stands in many places.
    """
    if not 0 <= noise_sigma < np.inf or seed < 0:
        raise ConfigError(f"noise_sigma and seed must not be negative, got {noise_sigma} and {seed}")
    if cam_from_world.batch_shape() != ():
        raise ShapeError(f"cam_from_world must be a single motion, got {cam_from_world.batch_shape()}")
    height, width = camera.height, camera.width
    check_pixels(width, height, 1 << 27)
    rgb, depth = np.zeros((height, width, 3), np.float32), np.full((height, width), np.nan)
    motion = np.concatenate([cam_from_world.rotation.ravel(), cam_from_world.translation])
    columns = (scene.kind, scene.params, scene.texture, scene.color, scene.seed, scene.light)
    params = camera.padded_params()
    _parallel.map_chunks(
        lambda start, stop, _: kernels.render_rows(
            columns, int(camera.model), params, motion, start, stop, width, rgb, depth
        ),
        height,
        16,
    )
    levels = np.float32(255.0) * rgb
    if noise_sigma > 0:
        random = np.random.default_rng(seed)
        levels += np.float32(noise_sigma) * random.standard_normal(levels.shape, np.float32)
    return Rendering(np.clip(np.rint(levels), 0, 255).astype(np.uint8), depth)
