"""Scenes of the rides: rooms and a corridor, z up, in meters."""

from __future__ import annotations

import numpy as np

from epipole.synthetic.scene import Box, Plane, Primitive, Sphere, SyntheticScene, Texture, Vector

WALL_HEIGHT = 2.6
FURNITURE = (
    # x, y, half sizes, angle, color, seed
    (2.35, 1.85, (0.40, 0.30, 0.45), 0.3, (0.60, 0.42, 0.26), 31),
    (2.45, -0.30, (0.30, 0.55, 0.38), -0.2, (0.35, 0.50, 0.58), 32),
    (2.20, -1.90, (0.35, 0.30, 0.80), 0.5, (0.55, 0.35, 0.42), 33),
    (0.30, -2.10, (0.60, 0.22, 0.50), 0.1, (0.42, 0.52, 0.34), 34),
    (-1.60, -1.95, (0.30, 0.35, 0.60), -0.6, (0.62, 0.55, 0.36), 35),
    (-2.50, -0.60, (0.28, 0.45, 0.90), 0.15, (0.46, 0.40, 0.56), 36),
    (-2.30, 1.40, (0.40, 0.30, 0.42), 0.7, (0.58, 0.46, 0.40), 37),
    (-0.60, 2.15, (0.45, 0.20, 0.70), -0.1, (0.38, 0.46, 0.44), 38),
    (0.90, 2.20, (0.25, 0.18, 0.35), 0.4, (0.64, 0.40, 0.30), 39),
)


def furnished_room() -> SyntheticScene:
    """A room of 6 x 5 x 2.6 m around the origin, floor at z = 0: textured walls, white panels, a white ceiling, boxes."""
    return SyntheticScene.of(furnished_room_things())


def furnished_room_things() -> list[Primitive]:
    """Walls and furniture of the furnished room."""
    white = (0.80, 0.79, 0.76)
    things: list[Primitive] = [
        *_walls(6.0, 5.0, ((0.62, 0.50, 0.42), (0.50, 0.56, 0.62), (0.58, 0.58, 0.46), (0.54, 0.46, 0.56))),
        _slab((-3.0, -2.5), (3.0, 2.5), 0.0, (0.44, 0.38, 0.32), Texture.RICH),
        _slab((-3.0, -2.5), (3.0, 2.5), WALL_HEIGHT, white, Texture.PLAIN),
        # White panels in front of the walls.
        Box(center=(2.94, 0.9, 1.55), half_size=(0.05, 0.65, 0.75), color=white, texture=Texture.PLAIN),
        Box(center=(-1.7, -2.44, 1.6), half_size=(0.8, 0.05, 0.8), color=white, texture=Texture.PLAIN),
        Box(center=(-2.94, 0.8, 1.7), half_size=(0.05, 0.7, 0.6), color=white, texture=Texture.PLAIN),
        Sphere(center=(0.30, -2.05, 1.25), radius=0.25, color=(0.60, 0.45, 0.35), seed=41),
        Sphere(center=(-2.30, 1.40, 1.05), radius=0.22, color=(0.40, 0.50, 0.60), seed=42),
    ]
    for x, y, half, angle, color, seed in FURNITURE:
        things.append(Box(center=(x, y, half[2]), half_size=half, angle_rad=angle, color=color, seed=seed))
    return things


def room_of_four_objects(side: float = 5.0) -> SyntheticScene:
    """A square room with fourfold rotational symmetry: walls and boxes share one texture, the light comes from above.

    Args:
        side: length of the walls, in meters.
    """
    wall, half = (0.56, 0.52, 0.48), 0.5 * side
    things: list[Primitive] = [
        *_walls(side, side, (wall, wall, wall, wall), Texture.TILED, side),
        _slab((-half, -half), (half, half), 0.0, (0.45, 0.43, 0.40), Texture.PLAIN),
        _slab((-half, -half), (half, half), WALL_HEIGHT, (0.80, 0.79, 0.76), Texture.PLAIN),
    ]
    for n in range(4):
        angle = 0.5 * np.pi * n
        for aside, back, box, seed in (
            (-0.9, 0.45, (0.30, 0.45, 0.40), 51),
            (0.5, 0.35, (0.22, 0.30, 0.85), 52),
            (1.3, 0.60, (0.30, 0.25, 0.30), 53),
        ):
            reach = half - back
            x = np.cos(angle) * reach - np.sin(angle) * aside
            y = np.sin(angle) * reach + np.cos(angle) * aside
            things.append(
                Box(
                    center=(float(x), float(y), box[2]), half_size=box, angle_rad=float(angle), seed=seed,
                    color=(0.55, 0.46, 0.40), texture=Texture.TILED, tile_m=4.0,
                )
            )  # fmt: skip
    return SyntheticScene.of(things, light=(0.0, 0.0, 1.0))


def corridor_with_a_bend() -> SyntheticScene:
    """A corridor 2.2 m wide along +x from -1.8 to 6.6 m, then along +y to 7 m; the wall ahead at the bend is white."""
    rich = [
        # from, to (x, y), color
        ((-1.8, -1.1), (6.6, -1.1), (0.60, 0.52, 0.42)),
        ((-1.8, 1.1), (4.4, 1.1), (0.48, 0.55, 0.60)),
        ((-1.8, -1.1), (-1.8, 1.1), (0.56, 0.44, 0.50)),
        ((6.6, 2.0), (6.6, 7.0), (0.52, 0.58, 0.44)),
        ((4.4, 1.1), (4.4, 7.0), (0.58, 0.48, 0.46)),
        ((4.4, 7.0), (6.6, 7.0), (0.46, 0.48, 0.62)),
    ]
    pale = (0.80, 0.79, 0.76)
    things: list[Primitive] = [
        _wall(start, stop, color, seed=71 + n) for n, (start, stop, color) in enumerate(rich)
    ]
    things.append(_wall((6.6, -1.1), (6.6, 2.0), pale, texture=Texture.PLAIN))
    for low, high, plain in (
        ((-1.8, -1.1), (3.9, 1.1), False),
        ((3.9, -1.1), (6.6, 2.0), True),
        ((4.4, 2.0), (6.6, 7.0), False),
    ):
        things.append(_slab(low, high, 0.0, (0.45, 0.40, 0.36), Texture.PLAIN if plain else Texture.RICH))
        things.append(_slab(low, high, WALL_HEIGHT, pale, Texture.PLAIN))
    for x, y, half, seed in (
        (1.5, 0.95, (0.35, 0.20, 0.50), 81),
        (3.0, -0.95, (0.25, 0.20, 0.80), 82),
        (4.6, 3.5, (0.25, 0.40, 0.45), 83),
        (6.4, 5.6, (0.22, 0.30, 0.90), 84),
    ):
        things.append(Box(center=(x, y, half[2]), half_size=half, color=(0.55, 0.45, 0.36), seed=seed))
    return SyntheticScene.of(things)


def _wall(
    start: tuple[float, float],
    stop: tuple[float, float],
    color: Vector,
    *,
    seed: int = 0,
    texture: Texture = Texture.RICH,
) -> Plane:
    offset = np.subtract(stop, start)
    length = float(np.linalg.norm(offset))
    return Plane(
        center=(0.5 * (start[0] + stop[0]), 0.5 * (start[1] + stop[1]), 0.5 * WALL_HEIGHT),
        direction_u=(float(offset[0]) / length, float(offset[1]) / length, 0.0), direction_v=(0.0, 0.0, 1.0),
        half_size=(0.5 * length, 0.5 * WALL_HEIGHT), color=color, seed=seed, texture=texture,
    )  # fmt: skip


def _slab(
    low: tuple[float, float], high: tuple[float, float], z: float, color: Vector, texture: Texture
) -> Plane:
    return Plane(
        center=(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), z),
        direction_u=(1, 0, 0), direction_v=(0, 1, 0),
        half_size=(0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1])), color=color, seed=21, texture=texture,
    )  # fmt: skip


def _walls(
    width: float,
    depth: float,
    colors: tuple[Vector, Vector, Vector, Vector],
    texture: Texture = Texture.RICH,
    tile_m: float = 1.0,
) -> list[Plane]:
    """Four walls around the origin, at +x, +y, -x, -y; identical if tiled, different if rich."""
    out = []
    for n, color in enumerate(colors):
        angle = 0.5 * np.pi * n
        out_x, out_y = round(float(np.cos(angle))), round(float(np.sin(angle)))
        reach, across = (0.5 * width, 0.5 * depth) if n % 2 == 0 else (0.5 * depth, 0.5 * width)
        out.append(
            Plane(
                center=(out_x * reach, out_y * reach, 0.5 * WALL_HEIGHT),
                direction_u=(-float(out_y), float(out_x), 0.0), direction_v=(0.0, 0.0, 1.0),
                half_size=(across, 0.5 * WALL_HEIGHT), color=color, texture=texture, tile_m=tile_m,
                seed=11 if texture == Texture.TILED else 11 + n,
            )
        )  # fmt: skip
    return out
