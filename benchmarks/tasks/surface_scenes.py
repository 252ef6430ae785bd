"""Scenes of the surface benchmark: the courtyard, things that are a few centimeters thin, and open terrain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from epipole.geometry import Rigid3
from epipole.synthetic import (
    Box,
    HeightField,
    Plane,
    Sphere,
    SyntheticScene,
    courtyard,
    courtyard_views,
    look_at,
)
from epipole.synthetic.scene import Primitive, Vector

FENCE_M, WALL_M = 6.0, 2.2
"""Length of the fence, and its distance from the wall behind it."""
ALTITUDE_M, LOW_M = 40.0, 18.0
"""Altitudes of the nadir images and of the oblique ones, above the mean ground."""
AREA_M = 24.0
"""Half side of the area with houses and trees."""


@dataclass(frozen=True, slots=True, eq=False)
class ScenePlan:
    """What is rendered, and from where."""

    scene: SyntheticScene
    cams_from_world: Rigid3
    behind: SyntheticScene | None = None
    """The scene without its thin things."""


def courtyard_plan() -> ScenePlan:
    """24 views of the courtyard of `epipole demo`."""
    return ScenePlan(courtyard(), courtyard_views(24))


def thin_plan() -> ScenePlan:
    """20 views of a fence of posts, rails, boards and poles, 1 to 4 cm thick, in front of walls."""
    behind: list[Primitive] = [
        Plane(
            center=(0, WALL_M, 1.4), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(5.5, 1.7),
            color=(0.60, 0.52, 0.42), seed=2101,
        ),
        Plane(
            center=(-4.4, 0.2, 1.4), direction_u=(0, 1, 0), direction_v=(0, 0, 1), half_size=(2.4, 1.7),
            color=(0.48, 0.54, 0.60), seed=2201,
        ),
        HeightField(
            center=(0, 0, 0), half_size=(7, 7), amplitude=0.06, wavelength=1.7, color=(0.44, 0.45, 0.36), seed=2301
        ),
    ]  # fmt: skip
    steps, k = np.linspace(-2.5, 2.5, 20), np.arange(20)
    views = [
        look_at((x, -3.6 + 0.3 * np.cos(1.3 * n), 1.3 + 0.3 * np.sin(1.9 * n)), (0.45 * x, 0.4, 0.85))
        for x, n in zip(steps.tolist(), k.tolist())
    ]
    return ScenePlan(SyntheticScene.of([*behind, *_fence()]), _stacked(views), SyntheticScene.of(behind))


def _fence() -> list[Primitive]:
    half = 0.5 * FENCE_M
    bars: list[tuple[Vector, Vector, float]] = [((0, 0, z), (half, 0.015, 0.015), 0.0) for z in (0.35, 1.15)]
    bars += [((x, 0, 0.75), (0.02, 0.02, 0.75), 0.0) for x in np.linspace(-half, half, 5).tolist()]
    bars += [((x, -0.03, 0.72), (0.02, 0.01, 0.6), 0.0) for x in np.arange(-half + 0.2, -0.2, 0.17).tolist()]
    bars += [((x, -0.02, 0.72), (0.006, 0.006, 0.6), 0.3) for x in np.arange(0.2, half - 0.1, 0.13).tolist()]
    bars += [((1.4, -0.5, z), (1.0, 0.005, 0.005), 0.2) for z in (0.55, 0.95)]
    bars += [((-0.9, -0.7, 1.1), (0.015, 0.015, 1.1), 0.5), ((0.5, 0.9, 1.0), (0.02, 0.02, 1.0), 0.1)]
    bars += [((-2.0, -0.9, 0.7), (0.5, 0.3, 0.015), 0.4)]  # a table
    for x, y in ((-0.42, -0.22), (-0.42, 0.22), (0.42, -0.22), (0.42, 0.22)):
        cos, sin = np.cos(0.4), np.sin(0.4)
        leg = (float(-2.0 + cos * x - sin * y), float(-0.9 + sin * x + cos * y), 0.33)
        bars.append((leg, (0.02, 0.02, 0.36), 0.4))
    rng = np.random.default_rng(3)
    return [
        Box(center=center, half_size=size, angle_rad=angle, color=_color(rng), seed=2400 + 40 * n)
        for n, (center, size, angle) in enumerate(bars)
    ]


def terrain_plan() -> ScenePlan:
    """16 nadir images and 16 low oblique ones of hills with houses and trees."""
    rng = np.random.default_rng(8)
    things: list[Primitive] = [
        HeightField(
            center=(0, 0, 0), half_size=(150, 150), amplitude=4.0, wavelength=60.0, color=(0.44, 0.48, 0.36), seed=3101
        )
    ]  # fmt: skip
    for n, (x, y) in enumerate(rng.uniform(-AREA_M, AREA_M, (9, 2)).tolist()):
        size = tuple(rng.uniform((2.5, 2.5, 3.0), (5.0, 5.0, 6.5)).tolist())
        angle = float(rng.uniform(0, np.pi))
        things.append(
            Box(center=(x, y, 1.0), half_size=size, angle_rad=angle, color=_color(rng), seed=3200 + 40 * n)
        )
    for n, (x, y) in enumerate(rng.uniform(-1.3 * AREA_M, 1.3 * AREA_M, (26, 2)).tolist()):
        crown, seed = float(rng.uniform(1.2, 2.4)), 4000 + 40 * n
        trunk: Vector = (0.15, 0.15, 3.5)
        things += [
            Box(center=(x, y, 2.5), half_size=trunk, color=(0.40, 0.34, 0.28), seed=seed),
            Sphere(center=(x, y, 6.0 + crown), radius=crown, color=(0.36, 0.48, 0.30), seed=seed + 20),
        ]
    return ScenePlan(SyntheticScene.of(things), _flight(rng))


def _flight(rng: np.random.Generator) -> Rigid3:
    """Four nadir lines of four images, and two low lines that look inward, 30 degrees down."""
    views = []
    for line, y in enumerate((-13.5, -4.5, 4.5, 13.5)):
        for x in (-12.0, -4.0, 4.0, 12.0):
            at = np.array([x if line % 2 == 0 else -x, y, ALTITUDE_M]) + rng.normal(size=3) * [0.5, 0.5, 0.8]
            below = at + [0, 0, -ALTITUDE_M] + 1.5 * rng.normal(size=3) * [1, 1, 0]
            views.append(look_at(at, below, (0.0, 1.0, 0.0)))
    for side in (-1.0, 1.0):
        for x in np.linspace(-17.5, 17.5, 8).tolist():
            at = np.array([x, 36.0 * side, LOW_M]) + rng.normal(size=3) * [0.4, 0.4, 0.4]
            ahead = np.array([-0.15 * x, -31.0 * side, -LOW_M])
            views.append(look_at(at, at + ahead))
    return _stacked(views)


def _stacked(views: list[Rigid3]) -> Rigid3:
    return Rigid3(np.stack([v.rotation for v in views]), np.stack([v.translation for v in views]))


def _color(rng: np.random.Generator) -> Vector:
    red, green, blue = rng.uniform(0.34, 0.64, 3).tolist()
    return red, green, blue


PLANS: dict[str, Callable[[], ScenePlan]] = {
    "courtyard": courtyard_plan,
    "thin things": thin_plan,
    "open terrain": terrain_plan,
}
