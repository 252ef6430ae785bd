"""Scenes for the pages: fixed points that the cameras observe, and reproducible pixel noise."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from epipole.geometry import Rigid3, Rotation3

HOUSE = np.array(
    [
        *([x, y, z] for z in (-0.8, 0.8) for x, y in ((-1.0, 0.9), (1.0, 0.9), (1.0, -0.3), (-1.0, -0.3))),
        *([0.0, -1.1, z] for z in (-0.8, 0.8)),
    ]
)
"""Corners of a house centered at the origin: front, back, and the ends of the ridge; y is down."""
EDGES = [
    *([k, (k + 1) % 4] for k in range(4)),
    *([4 + k, 4 + (k + 1) % 4] for k in range(4)),
    *([k, k + 4] for k in range(4)),
    [2, 8],
    [3, 8],
    [6, 9],
    [7, 9],
    [8, 9],
]


def house(distance: float) -> np.ndarray:
    """(10, 3) corners of the house at this distance ahead, slightly rotated."""
    cos, sin = np.cos(0.5), np.sin(0.5)
    rotated = HOUSE @ np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    return np.asarray(rotated) + np.array([0.0, 0.1, distance])


def noise(count: int, seed: int = 0) -> np.ndarray:
    """(count, 2) reproducible pixel noise with unit standard deviation."""
    return np.random.default_rng(seed).normal(size=(count, 2))


def cases(count: int = 40) -> np.ndarray:
    """(count, 4) reproducible noise of two pixels with unit standard deviation."""
    return np.random.default_rng(2).normal(size=(count, 4))


PATH = np.array([[0.55 * k, 0.0, 0.9 * k, 4.0 * k] for k in range(9)])
"""Trajectory of the camera in the PnP page: position, and rotation to the right in degrees."""


def corridor(count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) landmarks along the trajectory, and (cameras, count, 2) pixel noise with unit standard deviation."""
    rng = np.random.default_rng(3)
    positions = rng.uniform([-3.0, -1.2, 3.0], [9.0, 1.2, 15.0], (count, 3))
    return positions, rng.normal(size=(len(PATH), count, 2))


def wall(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points of a wall (across, down, depth -1 to 1), and (2, count, 2) pixel noise of unit deviation."""
    rng = np.random.default_rng(4)
    return rng.uniform([-2.4, -1.8, -1.0], [2.6, 1.8, 1.0], (count, 3)), rng.normal(size=(2, count, 2))


class Ring(NamedTuple):
    """Cameras in a circle around a round tower, and their disturbances."""

    cams_from_world: Rigid3
    """(c,)"""
    points_in_world: np.ndarray
    """(p, 3)"""
    normals: np.ndarray
    """(p, 3) directions from which the points are best visible."""
    pixel_noise: np.ndarray
    """(c, p, 2) with unit standard deviation."""
    camera_shifts: np.ndarray
    """(c, 6) translations, and rotations in radians, of an initialization that is off by one meter."""
    point_shifts: np.ndarray
    """(p, 3)"""


def ring(num_cameras: int = 10, num_points: int = 60) -> Ring:
    """A tower of radius 1.2 m seen from 4 m."""
    rng = np.random.default_rng(5)
    rotations = 2 * np.pi * np.arange(num_cameras) / num_cameras
    facing = Rotation3.exp(np.column_stack([0 * rotations, rotations, 0 * rotations]))
    world_from_cams = Rigid3(facing.matrix, facing.apply(np.array([0.0, 0.0, -4.0])))
    around, down = rng.uniform([0.0, -0.9], [2 * np.pi, 0.9], (num_points, 2)).T
    normals = np.column_stack([np.sin(around), 0 * around, np.cos(around)])
    return Ring(
        world_from_cams.inverse(),
        1.2 * normals + np.column_stack([0 * down, down, 0 * down]),
        normals,
        rng.normal(size=(num_cameras, num_points, 2)),
        rng.normal(size=(num_cameras, 6)) * [1.0, 1.0, 1.0, 0.15, 0.15, 0.15],
        rng.normal(size=(num_points, 3)),
    )


class Orbit(NamedTuple):
    """Cameras in half a circle around the house."""

    cams_from_world: Rigid3
    """(c,)"""
    points_in_world: np.ndarray
    """(p, 3) along the edges of the house."""
    normals: np.ndarray
    """(p, 3) directions from which the points are best visible."""
    pixel_noise: np.ndarray
    """(c, p, 2) with unit standard deviation."""


def orbit(num_cameras: int = 7) -> Orbit:
    """The house seen from 4.5 m, every 28 degrees."""
    rng = np.random.default_rng(6)
    rotations = np.deg2rad(28.0) * (np.arange(num_cameras) - 1.0)
    facing = Rotation3.exp(np.column_stack([0 * rotations, rotations, 0 * rotations]))
    world_from_cams = Rigid3(facing.matrix, facing.apply(np.array([0.0, -0.15, -4.5])))
    ends = HOUSE[np.array(EDGES)]
    along = np.array([0.2, 0.4, 0.6, 0.8])[:, None, None]
    points = np.concatenate([HOUSE, (ends[:, 0] * (1 - along) + ends[:, 1] * along).reshape(-1, 3)])
    normals = points * [1.0, 0.0, 1.0]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 0.3)
    noise_px = rng.normal(size=(num_cameras, len(points), 2))
    return Orbit(world_from_cams.inverse(), points, normals, noise_px)


def nearest_descriptors(count: int = 150) -> np.ndarray:
    """(count, 3) angle to the nearest and the second nearest descriptor, and whether the nearest is the right one.

    Two thirds of the descriptors have a counterpart in the other image, disturbed by noise; one in ten has a twin
    there, too, as a repeated pattern has.
    """
    rng = np.random.default_rng(7)
    mixing = rng.normal(size=(6, 128))

    def described(latent: np.ndarray) -> np.ndarray:
        values = np.maximum(latent @ mixing, 0.0)
        return values / np.linalg.norm(values, axis=1, keepdims=True)

    latent = rng.normal(size=(count, 6))
    paired, twins = 2 * count // 3, count // 10
    disturbed = latent[:paired] + 0.13 * rng.normal(size=(paired, 6))
    again = latent[:twins] + 0.13 * rng.normal(size=(twins, 6))
    others = described(np.concatenate([disturbed, again, rng.normal(size=(count, 6))]))
    angles = np.arccos(np.clip(described(latent) @ others.T, -1.0, 1.0))
    order = np.argsort(angles, axis=1)
    rows = np.arange(count)
    is_right = (order[:, 0] == rows) & (rows < paired)
    return np.column_stack([angles[rows, order[:, 0]], angles[rows, order[:, 1]], is_right])


def odometry_noise(count: int = 36) -> np.ndarray:
    """(count, 3) reproducible noise of motions in the plane (x, y, angle) with unit standard deviation."""
    return np.random.default_rng(8).normal(size=(count, 3))


def scene_of(page: str) -> dict[str, Any]:
    """Data for a page's script, by the page's name."""
    if page in ("epipolar", "candidates", "scale"):
        corners = house(5.0)
        return {
            "corners": corners.tolist(),
            "edges": EDGES,
            "noise": [noise(len(corners), seed).tolist() for seed in (0, 1)],
        }
    if page == "triangulation":
        return {"corners": [], "edges": [], "noise": cases().tolist()}
    if page == "pnp":
        landmarks, noise_px = corridor()
        return {
            "corners": landmarks.tolist(),
            "edges": [],
            "noise": noise_px.tolist(),
            "path": PATH.tolist(),
            "house": {"corners": house(5.0).tolist(), "edges": EDGES},
        }
    if page == "models":
        positions, noise_px = wall()
        return {"corners": positions.tolist(), "edges": [], "noise": noise_px.tolist()}
    if page == "bundle":
        return _given(ring())
    if page == "pipeline":
        return _given_orbit(orbit())
    return {}


def _given_orbit(scene: Orbit) -> dict[str, Any]:
    cameras = zip(scene.cams_from_world.rotation.tolist(), scene.cams_from_world.translation.tolist())
    return {
        "corners": scene.points_in_world.tolist(),
        "edges": EDGES,
        "normals": scene.normals.tolist(),
        "cameras": [{"R": R, "t": t} for R, t in cameras],
        "noise": scene.pixel_noise.tolist(),
        "nearest": nearest_descriptors().tolist(),
        "odometry": odometry_noise().tolist(),
    }


def _given(scene: Ring) -> dict[str, Any]:
    cameras = zip(scene.cams_from_world.rotation.tolist(), scene.cams_from_world.translation.tolist())
    return {
        "corners": scene.points_in_world.tolist(),
        "edges": [],
        "normals": scene.normals.tolist(),
        "cameras": [{"R": R, "t": t} for R, t in cameras],
        "noise": {
            "pixels": scene.pixel_noise.tolist(),
            "cameras": scene.camera_shifts.tolist(),
            "points": scene.point_shifts.tolist(),
        },
    }
