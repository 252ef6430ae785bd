"""Scenes of planes, boxes, spheres and height fields with procedural textures. The z axis points up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int64

from epipole._checks import Declared, checked
from epipole.errors import ConfigError, ShapeError
from epipole.synthetic import _render_kernels as kernels

Vector = tuple[float, float, float]
_NUM_PARAMS = 12
_TILE = 11


class Texture(IntEnum):
    """Texture of a surface."""

    RICH = kernels.RICH
    """Detail at all scales without repetition."""
    PLAIN = kernels.PLAIN
    """A single color."""
    TILED = kernels.TILED
    """A repeated patch of the rich texture, in the surface's own axes: surfaces of the same kind, size and seed look identical at any
    position, and a moving surface keeps its texture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Surface(Declared):
    color: Vector = (0.5, 0.5, 0.5)
    texture: Texture = Texture.RICH
    seed: int = 0
    tile_m: float = 1.0
    """Side of the repeated patch (TILED only)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plane(_Surface):
    """A rectangle: center, two orthogonal unit directions, and half sizes along them."""

    center: Vector
    direction_u: Vector
    direction_v: Vector
    half_size: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Box(_Surface):
    """A box: center, half sizes, and rotation about z."""

    center: Vector
    half_size: Vector
    angle_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere(_Surface):
    """A sphere."""

    center: Vector
    radius: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HeightField(_Surface):
    """A wavy ground: center, half sizes in x and y, amplitude and wavelength."""

    center: Vector
    half_size: tuple[float, float]
    amplitude: float
    wavelength: float


Primitive = Plane | Box | Sphere | HeightField


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene(Declared):
    """Primitives stored as arrays."""

    kind: Int64[np.ndarray, " n"]
    params: Float64[np.ndarray, "n 12"]
    texture: Int64[np.ndarray, " n"]
    color: Float64[np.ndarray, "n 3"]
    seed: Int64[np.ndarray, " n"]
    light: Float64[np.ndarray, " 3"]
    """Unit direction toward the light."""

    @staticmethod
    @checked
    def of(primitives: Sequence[Primitive], light: Vector = (0.3, -0.5, 0.81)) -> SyntheticScene:
        """Build a scene from primitives and the direction toward the light.

        Raises:
            ShapeError: there are no primitives.
            ConfigError: a tile_m is not positive and finite.
        """
        if not primitives:
            raise ShapeError("a scene needs at least one primitive")
        if not all(0 < p.tile_m < math.inf for p in primitives):
            raise ConfigError("tile_m must be positive and finite")
        rows = [_row(p) for p in primitives]
        params = np.zeros((len(rows), _NUM_PARAMS))
        for n, (_, values) in enumerate(rows):
            params[n, : len(values)], params[n, _TILE] = values, primitives[n].tile_m
        direction = np.array(light, np.float64)
        return SyntheticScene(
            np.array([kind for kind, _ in rows], np.int64),
            params,
            np.array([int(p.texture) for p in primitives], np.int64),
            np.array([p.color for p in primitives], np.float64),
            np.array([p.seed for p in primitives], np.int64),
            direction / np.linalg.norm(direction),
        )

    def __len__(self) -> int:
        return len(self.kind)


def _row(primitive: Primitive) -> tuple[int, list[float]]:
    if isinstance(primitive, Plane):
        values = [*primitive.center, *primitive.direction_u, *primitive.direction_v, *primitive.half_size]
        return kernels.PLANE, values
    if isinstance(primitive, Box):
        return kernels.BOX, [*primitive.center, *primitive.half_size, primitive.angle_rad]
    if isinstance(primitive, Sphere):
        return kernels.SPHERE, [*primitive.center, primitive.radius]
    values = [*primitive.center, *primitive.half_size, primitive.amplitude, primitive.wavelength]
    return kernels.HEIGHT_FIELD, values
