"""Scenes in which different surfaces look the same, with cameras that walk around: a city of equal blocks and a tiled room.

Images of different blocks, or of different walls, have many matches that agree on a wrong motion. Only the ground of the city, posters
and boxes are unique. Lengths are in meters, and the z axis points up. The light comes from above, so all walls are equally bright.
"""

from __future__ import annotations

import numpy as np

from epipole._checks import check_seed, checked
from epipole.geometry import Rigid3
from epipole.synthetic.courtyard import look_at
from epipole.synthetic.scene import Box, Plane, Primitive, SyntheticScene, Texture, Vector

BLOCK_M = 5.0
"""Side of a block, and width of its facades."""
BLOCK_HEIGHT_M = 4.0
STREET_M = 2.0
"""Distance between neighboring blocks."""
SIDEWALK_M = 4.5
"""Distance from the facades to the cameras."""
NUM_CITY_VIEWS = 44

ROOM_M = (6.0, 4.5)
"""Extent of the room in x and y: multiples of the tile, so that all walls start with the same part of it."""
ROOM_HEIGHT_M = 2.6
TILE_M = 1.5
NUM_ROOM_VIEWS = 30

_ABOVE: Vector = (0.0, 0.0, 1.0)


@checked
def city_of_like_blocks(seed: int) -> tuple[SyntheticScene, Rigid3]:
    """Four equal blocks around a crossing, and cameras on a walk around all of them that look at the facades.

    The four facades of a block differ, and each has a balcony. The blocks are copies of each other, rotated by random multiples of 90
    degrees, so each facade exists four times.
    Each facade on the outside has two unique posters, and each block has one unique box in front of its outer corner.

    Args:
        seed: random seed of the textures, posters, boxes and cameras.

    Returns:
        The scene, and cam_from_world of 44 cameras in the order of the walk, of which the last overlaps the first.

    Raises:
        ConfigError: the seed is negative.
    """
    check_seed(seed)
    rng = np.random.default_rng(seed)
    color, texture_seed, reach = _color(rng), _seed(rng), 0.5 * (BLOCK_M + STREET_M)
    things: list[Primitive] = [_floor((40.0, 40.0), _color(rng), _seed(rng))]
    for x, y in ((reach, reach), (-reach, reach), (-reach, -reach), (reach, -reach)):
        first = int(rng.integers(4))
        for n, angle in enumerate(0.5 * np.pi * np.arange(4)):
            out = np.array([np.cos(angle), np.sin(angle)])
            foot = np.array([x, y]) + 0.5 * BLOCK_M * out
            facade = texture_seed + 100 * ((first + n) % 4)
            # The texture repeats beyond the facade only.
            things.append(_wall(foot, out, (BLOCK_M, BLOCK_HEIGHT_M), color, facade, 1.25 * BLOCK_M))
            things.append(_balcony(foot, out, color, facade))
            if out @ (x, y) > 0:
                things.extend(_posters(rng, foot, out, BLOCK_M, (0.7, 1.3)))
        things.append(_box(rng, (1.0 + 3.2 / reach) * np.array([x, y]), 0.5))
    half = reach + 0.5 * BLOCK_M + SIDEWALK_M
    return SyntheticScene.of(things, light=_ABOVE), _city_walk(rng, half)


@checked
def tiled_room(seed: int) -> tuple[SyntheticScene, Rigid3]:
    """A room whose walls and floor repeat one tile, and cameras on a walk around its middle that look at the walls.

    Each wall has two unique posters, and each corner has one unique box.

    Args:
        seed: random seed of the textures, posters, boxes and cameras.

    Returns:
        The scene, and cam_from_world of 30 cameras in the order of the walk, of which the last overlaps the first.

    Raises:
        ConfigError: the seed is negative.
    """
    check_seed(seed)
    rng = np.random.default_rng(seed)
    color, texture_seed = _color(rng), _seed(rng)
    half = 0.5 * np.array(ROOM_M)
    floor = _floor(ROOM_M, color, texture_seed, Texture.TILED)
    ceiling = _floor(ROOM_M, (0.80, 0.79, 0.76), 0, Texture.PLAIN, ROOM_HEIGHT_M)
    things: list[Primitive] = [floor, ceiling]
    for n, angle in enumerate(0.5 * np.pi * np.arange(4)):
        into = -np.array([np.cos(angle), np.sin(angle)])
        foot, width = -half * into, ROOM_M[(n + 1) % 2]
        things.append(_wall(foot, into, (width, ROOM_HEIGHT_M), color, texture_seed, TILE_M))
        things.extend(_posters(rng, foot, into, width, (0.9, 1.8)))
        corner = np.array([np.cos(angle + 0.25 * np.pi), np.sin(angle + 0.25 * np.pi)]) * np.sqrt(2)
        things.append(_box(rng, corner * (half - 0.7), 0.4))
    return SyntheticScene.of(things, light=_ABOVE), _room_walk(rng)


def _city_walk(rng: np.random.Generator, half: float) -> Rigid3:
    """Cameras on a square of half side `half` with rounded corners, perpendicular to the walk up to a few degrees."""
    radius = SIDEWALK_M + 0.5
    straight, arc = 2.0 * (half - radius), 0.5 * np.pi * radius
    length = 4.0 * (straight + arc)
    views = []
    for along in (rng.uniform() + np.arange(NUM_CITY_VIEWS)) * length / NUM_CITY_VIEWS:
        side, rest = divmod(along, straight + arc)
        angle = 0.5 * np.pi * side + max(0.0, rest - straight) / radius
        start = np.array([half - radius, min(rest, straight) - 0.5 * straight])
        c, s = np.cos(0.5 * np.pi * side), np.sin(0.5 * np.pi * side)
        middle = np.array([c * start[0] - s * start[1], s * start[0] + c * start[1]])
        out = np.array([np.cos(angle), np.sin(angle)])
        center = middle + (radius + rng.uniform(-0.4, 0.4)) * out
        views.append(_view(rng, center, -out, 1.7, -0.2))
    return _batch(views)


def _room_walk(rng: np.random.Generator) -> Rigid3:
    """Cameras on an ellipse around the middle of the room that look outward."""
    views, offset = [], rng.uniform()
    for angle in 2.0 * np.pi * (offset + np.arange(NUM_ROOM_VIEWS)) / NUM_ROOM_VIEWS:
        out = np.array([np.cos(angle), np.sin(angle)])
        center = (0.5 * np.array(ROOM_M) - 1.9) * out + rng.uniform(-0.1, 0.1, 2)
        views.append(_view(rng, center, out, 1.5, -0.15))
    return _batch(views)


def _view(
    rng: np.random.Generator, center: np.ndarray, forward: np.ndarray, height: float, slope: float
) -> Rigid3:
    """A camera over `center` (2,) that looks along `forward` (2,), with random height, yaw and slope as of a hand."""
    yaw = np.arctan2(forward[1], forward[0]) + rng.uniform(-0.07, 0.07)
    eye = np.array([*center, height + rng.uniform(-0.15, 0.15)])
    forward_in_world = np.array([np.cos(yaw), np.sin(yaw), slope + rng.uniform(-0.03, 0.03)])
    return look_at(eye, eye + forward_in_world)


def _batch(views: list[Rigid3]) -> Rigid3:
    return Rigid3(np.stack([v.rotation for v in views]), np.stack([v.translation for v in views]))


def _wall(
    foot: np.ndarray,
    out: np.ndarray,
    size: tuple[float, float],
    color: Vector,
    seed: int,
    tile_m: float,
) -> Plane:
    """A wall of `size` (width, height) over `foot` (2,); seen from `out` (2,), its texture starts at the lower left corner."""
    return Plane(
        center=(float(foot[0]), float(foot[1]), 0.5 * size[1]),
        direction_u=(-float(out[1]), float(out[0]), 0.0), direction_v=_ABOVE,
        half_size=(0.5 * size[0], 0.5 * size[1]), color=color, seed=seed, texture=Texture.TILED, tile_m=tile_m,
    )  # fmt: skip


def _floor(
    size: tuple[float, float],
    color: Vector,
    seed: int,
    texture: Texture = Texture.RICH,
    height: float = 0.0,
) -> Plane:
    """A horizontal rectangle of `size` in x and y around the z axis."""
    return Plane(
        center=(0.0, 0.0, height), direction_u=(1.0, 0.0, 0.0), direction_v=(0.0, 1.0, 0.0),
        half_size=(0.5 * size[0], 0.5 * size[1]), color=color, seed=seed, texture=texture, tile_m=TILE_M,
    )  # fmt: skip


def _balcony(foot: np.ndarray, out: np.ndarray, color: Vector, seed: int) -> Box:
    """A box on the wall over `foot`, in the same position and with the same texture on each wall of the same seed."""
    center = foot + 0.2 * out + 0.8 * np.array([-out[1], out[0]])
    return Box(
        center=(float(center[0]), float(center[1]), 2.2), half_size=(0.4, 0.9, 0.35),
        angle_rad=float(np.arctan2(out[1], out[0])), color=color, seed=seed, texture=Texture.TILED, tile_m=4.0,
    )  # fmt: skip


def _posters(
    rng: np.random.Generator,
    foot: np.ndarray,
    out: np.ndarray,
    width: float,
    heights: tuple[float, float],
) -> list[Plane]:
    """Two unique posters, 2 cm in front of the wall over `foot`, one in each half, at random positions within `heights`."""
    right, posters = np.array([-out[1], out[0]]), []
    for side in (-0.25, 0.25):
        half = rng.uniform(0.35, 0.6, 2)
        aside = side * width + rng.uniform(-0.5, 0.5) * (0.5 * width - 2.0 * half[0] - 0.2)
        center = foot + 0.02 * out + aside * right
        poster = Plane(
            center=(float(center[0]), float(center[1]), rng.uniform(*heights)),
            direction_u=(float(right[0]), float(right[1]), 0.0), direction_v=_ABOVE,
            half_size=(half[0], half[1]), color=_color(rng), seed=_seed(rng),
        )  # fmt: skip
        posters.append(poster)
    return posters


def _box(rng: np.random.Generator, center: np.ndarray, largest: float) -> Box:
    """A unique box on the ground near `center` (2,), with half sides up to `largest`."""
    half = largest * rng.uniform(0.5, 1.0, 3)
    x, y = center + rng.uniform(-0.5, 0.5, 2) * largest
    return Box(
        center=(x, y, half[2]), half_size=(half[0], half[1], half[2]), angle_rad=rng.uniform(0.0, np.pi),
        color=_color(rng), seed=_seed(rng),
    )  # fmt: skip


def _color(rng: np.random.Generator) -> Vector:
    return rng.uniform(0.3, 0.65), rng.uniform(0.3, 0.65), rng.uniform(0.3, 0.65)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1_000_000))
