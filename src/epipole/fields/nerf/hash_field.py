"""A neural radiance field: hashed feature tables, decoded by a small network along rays.

Mildenhall et al., NeRF (2020): a network maps position and direction to density and color, which are integrated along
rays. Mueller et al., Instant-NGP (2022): trained feature tables at several resolutions allow a small network.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import check_count, checked
from epipole._checks.tables import Expected, require_arrays
from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.fields.nerf import _hash_kernels as kernels
from epipole.fields.nerf._voxel_kernels import SHIFT as VOXEL_SHIFT
from epipole.fields.nerf.voxel_field import Voxels, check_room, corners_of, voxels_on
from epipole.fields.rays import Rays, rays_of_camera
from epipole.fields.splat._projection_kernels import harmonics
from epipole.fields.splat._simd_kernels import ROW
from epipole.geometry import Rigid3

FEATURES = 4
"""Features per level."""
SAID = 16
"""Outputs of the first network: density and 15 features."""
BASIS = 16
"""Spherical harmonics of a direction."""
MOST_CELLS = 1 << 27
"""Cells of an exported grid, at most."""
TOGETHER = 1024
"""Rays processed as one task."""
WAVE = 16
"""Samples per ray between two checks for terminated rays."""
DELTA = np.float32(kernels.STEP)
"""Step length, in cells; densities are per cell."""
LEAST_SIGMA = 1e-8


class Room(NamedTuple):
    """Occupancy grid; world point p is at (p - low) / size."""

    occupied: np.ndarray
    """(x, y, z) uint8."""
    blocks: np.ndarray
    """Whether each block of 8 x 8 x 8 cells has an occupied cell."""
    low: np.ndarray
    size: float


class HashField(NamedTuple):
    """Feature tables, network and occupancy."""

    room: Room
    cells: np.ndarray
    """(levels,) cells along the longest side, at each level."""
    tables: np.ndarray
    """(levels, rows, 4) float32."""
    weights: tuple[np.ndarray, ...]
    """(inputs, outputs) of each layer: two for density and 15 features, three for color, with ReLU in between."""


class Samples(NamedTuple):
    """Next samples of rays, with their features and the outputs of the first network."""

    positions: np.ndarray
    counts: np.ndarray
    basis: np.ndarray
    features: np.ndarray
    hidden: np.ndarray
    said: np.ndarray


class Seen(NamedTuple):
    """Visible samples, with their weights and the layers of the color network."""

    kept: np.ndarray
    counts: np.ndarray
    light: np.ndarray
    layers: tuple[np.ndarray, ...]


_HASH = {
    "occupied": Expected("uint8", "x y z", most=1),
    "blocks": Expected("uint8", "_ _ _", most=1),
    "low": Expected("float64", "3"),
    "size": Expected("float64"),
    "cells": Expected("int64", "l", least=1),
    "tables": Expected("float32", f"l r {FEATURES}"),
    "weight_0": Expected("float32", "i a"),
    "weight_1": Expected("float32", f"a {SAID}"),
    "weight_2": Expected("float32", f"{SAID + BASIS} b"),
    "weight_3": Expected("float32", "b c"),
    "weight_4": Expected("float32", "c 3"),
}
"""Arrays of a field."""


def check_hash_field(field: HashField) -> None:
    """Check a neural field.

    Raises:
        ShapeError: an array has the wrong type or shape.
    """
    weights = {f"weight_{n}": one for n, one in enumerate(field.weights)}
    arrays = {**field.room._asdict(), "cells": field.cells, "tables": field.tables, **weights}
    require_arrays(arrays, _HASH, i=FEATURES * len(np.atleast_1d(field.cells)))
    check_room(field.room.occupied.shape, field.room.blocks.shape, field.room.size)


def new_weights(rng: np.random.Generator, levels: int, width: int) -> tuple[np.ndarray, ...]:
    """Random layers that preserve the scale of activations (He et al., 2015)."""
    sizes = (levels * FEATURES, width, SAID), (SAID + BASIS, width, width, 3)
    pairs = [pair for part in sizes for pair in pairwise(part)]
    bounds = [np.sqrt(6.0 / into) for into, _ in pairs]
    return tuple(rng.uniform(-bound, bound, pair).astype(np.float32) for bound, pair in zip(bounds, pairs))


def query_density(field: HashField, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features (n, levels * 4), hidden layer, and density with 15 features (n, 16) at positions (n, 3) in [0, 1]."""
    features = np.empty((len(positions), len(field.cells) * FEATURES), np.float32)
    kernels.encode(positions, field.cells, field.tables, features)
    hidden = features @ field.weights[0]
    np.maximum(hidden, 0.0, out=hidden)
    return features, hidden, hidden @ field.weights[1]


def colored(field: HashField, joined: np.ndarray) -> tuple[np.ndarray, ...]:
    """Layers (n, .) of the color network for inputs (n, 32): the first network's outputs and harmonics."""
    first = joined @ field.weights[2]
    np.maximum(first, 0.0, out=first)
    second = first @ field.weights[3]
    np.maximum(second, 0.0, out=second)
    return joined, first, second, second @ field.weights[4]


def sampled(
    field: HashField,
    rays: Rays,
    pixel_of: np.ndarray,
    view_of: np.ndarray,
    at: np.ndarray,
    most: int,
    capacity: int,
) -> Samples:
    """Next samples of rays, at most `most` per ray and `capacity` in total; advances at (n,)."""
    positions, counts = np.empty((capacity, 4), np.float32), np.empty(len(pixel_of), np.int64)
    basis = np.empty((len(pixel_of), BASIS), np.float32)
    work = np.zeros((2, 3), np.float32)
    found = kernels.sample_rays(
        rays, pixel_of, view_of, field.room, 0, len(pixel_of), most, at, positions, counts, basis, work
    )
    positions = positions[:found]
    return Samples(positions, counts, basis, *query_density(field, positions))


def seen(field: HashField, samples: Samples, left: np.ndarray) -> Seen:
    """Weights and colors of samples until rays are opaque; updates the transmittance left (n,)."""
    n = len(samples.said)
    light, kept, counts = np.empty((n, 3), np.float32), np.empty(n, np.int64), np.empty_like(samples.counts)
    found = kernels.weigh(samples.said, samples.counts, DELTA, left, light, kept, counts)
    kept, light = kept[:found], light[:found]
    joined = np.empty((found, SAID + BASIS), np.float32)
    kernels.join(samples.said, kept, counts, samples.basis, joined)
    return Seen(kept, counts, light, colored(field, joined))


@checked
def render_hash(
    field: HashField, camera: Camera, cam_from_world: Rigid3, background: Float32[np.ndarray, " 3"]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Image (h, w, 3), depth (h, w) along rays times coverage in world units, and the number of network queries.

    Raises:
        ShapeError: the arrays of the field do not match, or the pose is not a single pose.
        ConfigError: the camera has too many pixels to render.
    """
    check_hash_field(field)
    rays, total = rays_of_camera(camera, cam_from_world), camera.width * camera.height
    image = np.zeros((total, 4), np.float32)

    def render(start: int, stop: int, _: int) -> int:
        return _render_rays(field, rays, np.arange(start, stop), image[start:stop], background)

    with _parallel.single_threaded_blas():
        samples = _parallel.map_chunks(render, total, -(-total // TOGETHER))
    depth = image[:, 3].reshape(camera.height, camera.width) * np.float32(field.room.size)
    return image[:, :3].reshape(camera.height, camera.width, 3), depth, sum(samples)


def _render_rays(
    field: HashField, rays: Rays, pixels: np.ndarray, image: np.ndarray, background: np.ndarray
) -> int:
    """Render in waves, so that samples behind opaque ones are not queried; returns the number of queries."""
    alive, total = np.arange(len(pixels)), 0
    at, left = np.full(len(pixels), -0.5, np.float32), np.ones(len(pixels), np.float32)
    views = np.zeros(len(pixels), np.int64)
    while len(alive):
        own_at, own_left = at[alive], left[alive]
        samples = sampled(field, rays, pixels[alive], views[alive], own_at, WAVE, WAVE * len(alive))
        part = seen(field, samples, own_left)
        rendered = np.zeros((len(alive), 4), np.float32)
        kernels.compose(part.layers[-1], part.light, samples.positions, part.kept, part.counts, rendered)
        image[alive] += rendered
        at[alive], left[alive] = own_at, own_left
        total += len(samples.said)
        alive = alive[(own_left >= kernels.OVER) & np.isfinite(own_at)]
    image[:, :3] += left[:, None] * background
    return total


@checked
def voxels_of(field: HashField, finer: int = 2) -> Voxels:
    """Convert to an explicit grid with `finer` cells along each cell.

    Colors are sampled along six axes and fitted with harmonics of degree 1.

    Raises:
        ShapeError: the arrays of the field do not match.
        ConfigError: `finer` is not positive, or there would be too many cells.
    """
    check_hash_field(field)
    if finer < 1:
        raise ConfigError(f"finer must be positive, got {finer}")
    check_count(field.room.occupied.size * finer**3, "the cells of the grid", MOST_CELLS)
    room = field.room
    cells = room.occupied.astype(bool)
    for axis in range(3):
        cells = cells.repeat(finer, axis)
    corners = np.argwhere(corners_of(cells)).astype(np.float32)
    positions = np.zeros((len(corners), 4), np.float32)
    positions[:, :3] = np.minimum(corners / np.float32(max(cells.shape)), np.float32(1.0 - 1e-6))
    values = np.zeros((len(corners), ROW), np.float32)

    def ask(start: int, stop: int, _: int) -> None:
        said = query_density(field, positions[start:stop])[2]
        sigma = np.exp(np.minimum(said[:, 0] + kernels.SHIFT, kernels.LARGEST_RAW))
        values[start:stop, 0] = np.maximum(sigma, LEAST_SIGMA) + np.log(
            -np.expm1(-np.maximum(sigma, LEAST_SIGMA))
        )
        values[start:stop, 1:13] = _degree_1(field, said)

    with _parallel.single_threaded_blas():
        _parallel.map_chunks(ask, len(corners), -(-len(corners) // TOGETHER))
    values[:, 0] -= VOXEL_SHIFT
    return voxels_on(cells, room.low, room.size / finer, room.size, values)


def _degree_1(field: HashField, said: np.ndarray) -> np.ndarray:
    """(n, 12) harmonics of degree 0 and 1 of the colors along six axes, whose mean square matches the sphere's."""
    total = np.zeros((len(said), 4, 3), np.float32)
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        basis = np.zeros(BASIS, np.float32)
        harmonics(*axis.tolist(), BASIS, basis)
        direction = np.broadcast_to(basis, (len(said), BASIS))
        color = 1.0 / (1.0 + np.exp(-colored(field, np.concatenate([said, direction], axis=1))[-1]))
        total += basis[None, :4, None] * (color - np.float32(0.5))[:, None]
    return (total * np.float32(4.0 * np.pi / 6.0)).reshape(len(said), 12)
