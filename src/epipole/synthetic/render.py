"""Rendering of synthetic scenes, with exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from epipole import _parallel
from epipole._checks import MOST_RENDERED_PIXELS, check_pixels, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.synthetic import _render_kernels as kernels
from epipole.synthetic.scene import SyntheticScene


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """An image and its depth."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float64[np.ndarray, "h w"]
    """z in camera coordinates at each pixel's center; NaN for the sky."""


@checked
def render(
    scene: SyntheticScene, camera: Camera, cam_from_world: Rigid3, *, noise_sigma: float = 0.0, seed: int = 0
) -> Rendering:
    """Render an image by ray casting (four rays per pixel for color, one for depth).

    Args:
        scene: the scene.
        camera: any model, distortion included.
        cam_from_world: a single pose.
        noise_sigma: standard deviation of the sensor noise, in gray levels of 255.
        seed: random seed of the noise.

    Raises:
        ConfigError: noise or seed is negative, or the image is too large.
        ShapeError: cam_from_world is a batch.
    """
    if not 0 <= noise_sigma < np.inf or seed < 0:
        raise ConfigError(f"noise_sigma and seed must not be negative, got {noise_sigma} and {seed}")
    if cam_from_world.batch_shape() != ():
        raise ShapeError(
            f"cam_from_world must be a single pose, got a batch of {cam_from_world.batch_shape()}"
        )
    rgb, depth = _blank(camera)
    _add_exposure(scene, camera, cam_from_world, rgb, depth)
    levels = np.float32(255.0) * rgb
    if noise_sigma > 0:
        random = np.random.default_rng(seed)
        levels += np.float32(noise_sigma) * random.standard_normal(levels.shape, np.float32)
    return Rendering(np.clip(np.rint(levels), 0, 255).astype(np.uint8), depth)


@checked
def render_exposures(
    scene: SyntheticScene, camera: Camera, cam_from_world: Rigid3, *, gain: float = 1.0
) -> Rendering:
    """Render an image taken by a moving camera, with rolling shutter and motion blur.

    Each row is rendered from the camera's pose at its readout; motion blur is the mean of several exposures. The scene is static.

    Args:
        scene: the scene.
        camera: any model, distortion included.
        cam_from_world: poses (exposures, rows); a single row is a global shutter.
        gain: brightness of the image; values are clipped at white.

    Returns:
        The image, and the depth of its middle exposure, each row relative to the pose of that row.

    Raises:
        ConfigError: the gain is negative or not finite, or the image is too large.
        ShapeError: the shape of the poses is not (exposures, rows), or there are none.
    """
    if not 0 <= gain < np.inf:
        raise ConfigError(f"gain must not be negative, got {gain}")
    shape = cam_from_world.batch_shape()
    if len(shape) != 2 or shape[0] < 1 or shape[1] not in (1, camera.height):
        raise ShapeError(f"cam_from_world must be (exposures, 1 or {camera.height} rows), got {shape}")
    rgb, depth = _blank(camera)
    for n in range(shape[0]):
        one = depth if n == shape[0] // 2 else np.empty_like(depth)
        _add_exposure(scene, camera, cam_from_world[n], rgb, one)
    levels = np.float32(255.0 * gain / shape[0]) * rgb
    return Rendering(np.clip(np.rint(levels), 0, 255).astype(np.uint8), depth)


def _blank(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    height, width = camera.height, camera.width
    check_pixels(width, height, MOST_RENDERED_PIXELS)
    return np.zeros((height, width, 3), np.float32), np.full((height, width), np.nan)


def _add_exposure(
    scene: SyntheticScene, camera: Camera, cam_from_world: Rigid3, rgb: np.ndarray, depth: np.ndarray
) -> None:
    """Add an image to rgb and write its depth, with one pose for the image or one per row."""
    height, width = depth.shape
    rotation, translation = cam_from_world.rotation.reshape(-1, 9), cam_from_world.translation.reshape(-1, 3)
    motion = np.concatenate([rotation, translation], axis=1)
    columns = (scene.kind, scene.params, scene.texture, scene.color, scene.seed, scene.light)
    given = (columns, int(camera.model), camera.padded_params())

    def render_rows(start: int, stop: int, _: int) -> None:
        if len(motion) == 1:
            kernels.render_rows(*given, motion[0], start, stop, width, rgb, depth)
            return
        for row in range(start, stop):
            kernels.render_rows(*given, motion[row], row, row + 1, width, rgb, depth)

    _parallel.map_chunks(render_rows, height, 16)
