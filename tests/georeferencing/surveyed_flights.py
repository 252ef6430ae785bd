"""Simulated flights: a model with pixel noise in arbitrary coordinates, control points, GPS, and the truth."""

from dataclasses import dataclass, replace

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.mapping import adjust_reconstruction
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints
from epipole.scene import Georeference, Reconstruction

ORIGIN = Georeference(48.2, 11.6, 520.0)
SIZE, FOCAL_PX, HEIGHT_M = (1000, 750), 900.0, 50.0
NOISE_PX, MARK_SIGMA_PX, GPS_SIGMA_M = 0.5, 0.7, 2.0
CONTROL_SIGMA_M = np.array([0.02, 0.02, 0.03])
CORNERS = np.array([[0.1, 0.1], [0.8, 0.1], [0.1, 0.75], [0.8, 0.75], [0.5, 0.5]])
NUM_CONTROL, NUM_CHECK = len(CORNERS), 8


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    model: Reconstruction
    surveyed: SurveyedPoints
    gps: GpsFixes
    truth: np.ndarray
    """(n, 3) of the surveyed points."""
    centers: np.ndarray
    """(i, 3) of the cameras."""
    camera: Camera
    true_poses: Rigid3


def flight(seed: int, rows: int = 4, columns: int = 6, num_points: int = 700) -> Flight:
    """A flight of lines in alternating directions, straight down."""
    rng = np.random.default_rng(seed)
    camera = Camera("SIMPLE_RADIAL", *SIZE, [FOCAL_PX, SIZE[0] / 2 - 0.5, SIZE[1] / 2 - 0.5, -0.03])
    step = np.array([0.3, 0.35]) * SIZE / np.array(FOCAL_PX) * HEIGHT_M
    poses, centers = _poses(rng, rows, columns, step)
    extent = step * [columns, rows]
    points = np.column_stack([rng.uniform(-10, extent + 5, (num_points, 2)), 3 * rng.normal(size=num_points)])
    image, point, pixels = _observed(camera, poses, points, NOISE_PX, rng)
    many = np.bincount(point, minlength=num_points) >= 3
    keep = many[point]
    rank = np.cumsum(many) - 1
    exact = Reconstruction.from_observations(
        poses, camera, points[many], image[keep], rank[point[keep]], pixels[keep]
    )
    model, _ = adjust_reconstruction(exact)
    anywhere = Similarity3(np.asarray(0.13), Rotation3.exp(rng.normal(size=3)).matrix, 5 * rng.normal(size=3))
    plan = np.concatenate([CORNERS, rng.uniform(0.1, 0.85, (NUM_CHECK, 2))]) * extent
    truth = np.column_stack([plan, 2 * rng.normal(size=len(plan))])
    mark_image, mark_point, marks = _observed(camera, poses, truth, MARK_SIGMA_PX, rng)
    measured = truth + CONTROL_SIGMA_M * rng.normal(size=truth.shape)
    surveyed = SurveyedPoints(
        tuple(f"P{n}" for n in range(len(truth))),
        measured,
        measured[:, [1, 0, 2]],
        np.tile(CONTROL_SIGMA_M, (len(truth), 1)),
        np.arange(len(truth)) < NUM_CONTROL,
        mark_point,
        mark_image,
        marks,
    )
    fixes = centers + GPS_SIGMA_M * rng.normal(size=centers.shape)
    gps = GpsFixes(fixes, np.tile(GPS_SIGMA_M * np.array([1.0, 1.0, 2.0]), (len(fixes), 1)))
    return Flight(model.transformed(anywhere), surveyed, gps, truth, centers, camera, poses)


def _poses(rng: np.random.Generator, rows: int, columns: int, step: np.ndarray) -> tuple[Rigid3, np.ndarray]:
    rotations, centers = [], []
    for row in range(rows):
        for column in range(columns):
            a = (0.0 if row % 2 == 0 else np.pi) + 0.03 * rng.normal()
            down = np.array([[np.cos(a), np.sin(a), 0], [np.sin(a), -np.cos(a), 0], [0, 0, -1]])
            rotations.append(Rotation3.exp(0.04 * rng.normal(size=3)).matrix @ down)
            centers.append([column * step[0], row * step[1], HEIGHT_M] + rng.normal(size=3) * [0.5, 0.5, 0.7])
    rotation, center = np.array(rotations), np.array(centers)
    return Rigid3(rotation, -np.einsum("nij,nj->ni", rotation, center)), center


def _observed(
    camera: Camera, poses: Rigid3, points: np.ndarray, sigma_px: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, point and pixel of each observation."""
    image, point, pixels = [], [], []
    for k in range(len(poses)):
        at = camera.project(poses[k].apply(points))
        own = np.flatnonzero(((at > 5) & (at < np.array(SIZE) - 6)).all(axis=1))
        image += [k] * len(own)
        point += own.tolist()
        pixels.append(at[own] + sigma_px * rng.normal(size=(len(own), 2)))
    return np.array(image), np.array(point), np.concatenate(pixels)


def with_positions(surveyed: SurveyedPoints, position_m: np.ndarray) -> SurveyedPoints:
    return replace(surveyed, position_m=position_m, exchanged_m=position_m[:, [1, 0, 2]])


def gcp_text(of: Flight, *, header: str = "WGS84", columns: tuple[int, int, int] = (1, 0, 2)) -> str:
    """The survey as gcp_list.txt, longitude first; check points by their name."""
    lines = [header]
    table = ORIGIN.lat_lon_alt_of(of.surveyed.position_m)
    for k, row in enumerate(of.surveyed.point.tolist()):
        prefix = "" if of.surveyed.is_control[row] else "CHK-"
        numbers = [f"{table[row, c]:.12f}" for c in columns] + [f"{v:.3f}" for v in of.surveyed.pixels[k]]
        image = of.model.images.name[int(of.surveyed.image[k])]
        lines.append("\t".join([*numbers, image, prefix + of.surveyed.name[row]]))
    return "\n".join(lines) + "\n"
