"""Rectified pairs of random synthetic rooms with exact disparities, for fitting and testing stereo."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import MOST_RENDERED_PIXELS, check_pixels, check_seed, checked
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, depth_to_disparity
from epipole.synthetic.courtyard import look_at
from epipole.synthetic.render import render
from epipole.synthetic.scene import Box, HeightField, Plane, Primitive, Sphere, SyntheticScene, Texture

_BLURS_PX, _NOISES = (0.0, 0.5, 0.8, 1.2), (0.5, 1.0, 2.0, 3.0, 5.0)
_ROW_ERROR_PX = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """A rectified pair with ground truth."""

    left: UInt8[np.ndarray, "h w"]
    right: UInt8[np.ndarray, "h w"]
    disparity_px: Float64[np.ndarray, "h w"]
    """Of the left image; NaN for the sky."""
    camera: Camera
    """Both cameras."""
    baseline: float


@checked
def stereo_room(seed: int, size: tuple[int, int] = (480, 360)) -> StereoPair:
    """A wall, a wavy floor and several objects, seen by two cameras with random sharpness, contrast and noise.

    As in real pairs, rows match only to a fraction of a pixel, and half of the images are JPEG-compressed.

    Args:
        seed: random seed; selects the room.
        size: width and height.

    Raises:
        ConfigError: the seed is negative, or the image is too large.
    """
    check_seed(seed)
    check_pixels(*size, MOST_RENDERED_PIXELS)
    rng = np.random.default_rng(seed)
    scene = _room(rng)
    focal = size[0] * rng.uniform(0.8, 1.2)
    baseline = rng.uniform(0.08, 0.3)
    left_from_world = look_at((0, 0, 0.1), (rng.uniform(-0.3, 0.3), 5, 0.1))
    return _photographed(scene, size, focal, baseline, left_from_world, rng)


@checked
def stereo_street(
    seed: int, size: tuple[int, int] = (640, 480), focal_px: float = 800.0, baseline: float = 0.12
) -> StereoPair:
    """A street between walls, with objects at 2 to 30 m and the image quality of the rooms.

    Args:
        seed: random seed; selects the street.
        size: width and height.
        focal_px: of both cameras.
        baseline: in meters.

    Raises:
        ConfigError: the seed is negative, or the image is too large.
    """
    check_seed(seed)
    check_pixels(*size, MOST_RENDERED_PIXELS)
    rng = np.random.default_rng(seed)
    ground = HeightField(
        center=(0, 20, -1.2),
        half_size=(8, 22),
        amplitude=0.02,
        wavelength=1.5,
        color=_color(rng),
        seed=_seed(rng),
    )
    end = Plane(
        center=(0, rng.uniform(34, 40), 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(30, 20),
        color=_color(rng), seed=_seed(rng),
    )  # fmt: skip
    things: list[Primitive] = [ground, end]
    for side in (-1.0, 1.0):
        wall = Plane(
            center=(side * rng.uniform(4, 6), 20, 1), direction_u=(0, 1, 0), direction_v=(0, 0, 1),
            half_size=(18, 3), color=_color(rng), seed=_seed(rng),
        )  # fmt: skip
        things.append(wall)
    for depth in np.geomspace(2.0, 30.0, 16):
        aside, height = rng.uniform(-0.35, 0.35) * depth, rng.uniform(-1.0, 0.5) * min(1.0, depth / 4)
        box = Box(
            center=(aside, depth, height), half_size=(0.07 * depth, 0.05, 0.07 * depth),
            angle_rad=rng.uniform(-0.5, 0.5), color=_color(rng), seed=_seed(rng),
        )  # fmt: skip
        things.append(box)
    left_from_world = look_at((0, 0, 0.1), (rng.uniform(-0.1, 0.1), 5, 0.0))
    return _photographed(SyntheticScene.of(things), size, focal_px, baseline, left_from_world, rng)


def _photographed(
    scene: SyntheticScene,
    size: tuple[int, int],
    focal: float,
    baseline: float,
    left_from_world: Rigid3,
    rng: np.random.Generator,
) -> StereoPair:
    width, height = size
    params = np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
    camera = Camera(CameraModel.PINHOLE, width, height, params)
    pitch, roll = rng.normal(0.0, _ROW_ERROR_PX / focal), rng.normal(0.0, 2.0 * _ROW_ERROR_PX / width)
    right_from_left = Rigid3.exp(np.array([0, 0, 0, pitch, 0, roll])) @ Rigid3(
        np.eye(3), np.array([-baseline, 0.0, 0.0])
    )
    left = render(scene, camera, left_from_world)
    right = render(scene, camera, right_from_left @ left_from_world)
    contrast, noise, blur = rng.uniform(0.25, 1.0), rng.choice(_NOISES), rng.choice(_BLURS_PX)
    gain = rng.uniform(0.85, 1.15) if rng.random() < 0.5 else 1.0
    quality = int(rng.integers(80, 98)) if rng.random() < 0.5 else None
    images = [
        _photograph(image.rgb, rng, contrast, noise, blur, exposure, quality)
        for image, exposure in ((left, 1.0), (right, gain))
    ]
    disparity = np.asarray(depth_to_disparity(left.depth, focal, baseline))
    return StereoPair(images[0], images[1], disparity, camera, baseline)


def _room(rng: np.random.Generator) -> SyntheticScene:
    depth, tilt = rng.uniform(5, 12), rng.uniform(-0.5, 0.5)
    wall = Plane(
        center=(0, depth, 0), direction_u=(np.cos(tilt), np.sin(tilt), 0), direction_v=(0, 0, 1),
        half_size=(12, 8), color=_color(rng), seed=_seed(rng),
    )  # fmt: skip
    floor = HeightField(
        center=(0, depth / 2, -1.4), half_size=(8, 8), amplitude=rng.uniform(0, 0.15),
        wavelength=rng.uniform(0.5, 2), color=_color(rng), seed=_seed(rng),
    )  # fmt: skip
    return SyntheticScene.of([wall, floor, *(_thing(rng, depth) for _ in range(rng.integers(4, 14)))])


def _thing(rng: np.random.Generator, depth: float) -> Primitive:
    center = (rng.uniform(-2.5, 2.5), rng.uniform(2.0, depth), rng.uniform(-1.2, 1.5))
    color, seed = _color(rng), _seed(rng)
    texture = Texture.PLAIN if rng.random() < 0.1 else Texture.RICH
    kind = rng.integers(3)
    if kind == 0:
        return Sphere(center=center, radius=rng.uniform(0.1, 0.7), color=color, seed=seed, texture=texture)
    angle = rng.uniform(0, np.pi)
    if kind == 1:
        half = (rng.uniform(0.05, 0.6), rng.uniform(0.05, 0.6), rng.uniform(0.05, 0.6))
        return Box(center=center, half_size=half, angle_rad=angle, color=color, seed=seed, texture=texture)
    return Plane(
        center=center, direction_u=(np.cos(angle), np.sin(angle), 0), direction_v=(0, 0, 1),
        half_size=(rng.uniform(0.1, 0.8), rng.uniform(0.1, 0.8)), color=color, seed=seed, texture=texture,
    )  # fmt: skip


def _color(rng: np.random.Generator) -> tuple[float, float, float]:
    return rng.uniform(0.15, 0.85), rng.uniform(0.15, 0.85), rng.uniform(0.15, 0.85)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1_000_000))


def _photograph(
    rgb: np.ndarray,
    rng: np.random.Generator,
    contrast: float,
    noise: float,
    blur_px: float,
    gain: float,
    jpeg_quality: int | None,
) -> UInt8[np.ndarray, "h w"]:
    gray: np.ndarray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if blur_px > 0:
        gray = cv2.GaussianBlur(gray, (0, 0), blur_px)
    gray = ((gray - 110.0) * contrast + 110.0) * gain + rng.normal(0.0, noise, gray.shape)
    image = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    if jpeg_quality is None:
        return image
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), np.uint8)
