"""The scene of the demo and the tests: a small courtyard, and camera poses around it."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks import as_vector, check_count, checked
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.synthetic.scene import Box, HeightField, Plane, Sphere, SyntheticScene


def look_at(center: Any, target: Any, up: Any = (0.0, 0.0, 1.0)) -> Rigid3:
    """cam_from_world of a camera at `center` that looks at `target`, with `up` pointing upwards in the image.

    Raises:
        ShapeError: an argument is not a vector (3,).
        DegenerateGeometryError: `center` and `target` coincide, or the viewing direction is parallel to `up`.
    """
    center = as_vector(center, "center")
    forward = as_vector(target, "target") - center
    right = np.cross(forward, as_vector(up, "up"))
    if np.linalg.norm(forward) == 0 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise DegenerateGeometryError("the viewing direction must be neither zero nor along `up`")
    z, x = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([x, np.cross(z, x), z])
    return Rigid3(rotation, -rotation @ center)


def courtyard() -> SyntheticScene:
    """Ground, two walls in a corner, crates and balls, about five meters across."""
    return SyntheticScene.of(
        [
            Plane(
                center=(0, 2.4, 1.2), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(2.6, 1.4),
                color=(0.62, 0.48, 0.40), seed=101,
            ),
            Plane(
                center=(-2.5, 0.2, 1.1), direction_u=(0, 1, 0), direction_v=(0, 0, 1), half_size=(2.3, 1.3),
                color=(0.50, 0.56, 0.60), seed=201,
            ),
            Box(center=(-0.9, 0.7, 0.45), half_size=(0.45, 0.40, 0.50), angle_rad=0.4, color=(0.60, 0.45, 0.28), seed=301),
            Box(center=(0.9, 1.1, 0.30), half_size=(0.55, 0.35, 0.38), angle_rad=-0.3, color=(0.40, 0.52, 0.38), seed=401),
            Box(center=(0.2, -0.5, 0.20), half_size=(0.28, 0.28, 0.30), angle_rad=0.9, color=(0.55, 0.38, 0.45), seed=501),
            Sphere(center=(-1.5, -0.4, 0.40), radius=0.42, color=(0.55, 0.50, 0.60), seed=601),
            Sphere(center=(1.5, 0.0, 0.35), radius=0.36, color=(0.62, 0.55, 0.35), seed=701),
            HeightField(
                center=(0, 0, 0), half_size=(3.2, 3.2), amplitude=0.10, wavelength=1.3, color=(0.45, 0.42, 0.36), seed=11
            ),
        ]
    )  # fmt: skip


@checked
def courtyard_views(num_views: int = 24) -> Rigid3:
    """cam_from_world on an arc of 100 degrees in front of the corner, at varying heights, looking at its center.

    Raises:
        ConfigError: num_views is less than 1.
    """
    if num_views < 1:
        raise ConfigError(f"num_views must be at least 1, got {num_views}")
    check_count(num_views, "num_views")
    angles = np.deg2rad(np.linspace(-95.0, 5.0, num_views))
    height = 1.5 + 0.25 * np.sin(np.arange(num_views) * 1.9)
    reach = 4.6 + 0.3 * np.cos(np.arange(num_views) * 1.3)
    views = [
        look_at((r * np.cos(a) - 0.2, r * np.sin(a), h), (-0.2 + 0.15 * np.sin(3 * a), 0.4, 0.6))
        for a, h, r in zip(angles, height, reach)
    ]
    return Rigid3(np.stack([v.rotation for v in views]), np.stack([v.translation for v in views]))
