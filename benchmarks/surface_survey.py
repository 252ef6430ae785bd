"""Height models and orthophotos of rendered drone flights for `benchmarks.surfaces`, against the exact surface seen from above.

Each flight is reconstructed, georeferenced with five control points, and given to `epipole surface --until survey`. The other ground
points are check points. The truth goes to map coordinates by way of PROJ alone, not by way of epipole.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import cv2
import laspy
import numpy as np
import pyproj
import rasterio
from scipy.ndimage import map_coordinates

import epipole
from benchmarks.georeferencing import CONTROL_SIGMA_M, MARK_SIGMA_PX, NUM_CONTROL, control_rows
from benchmarks.measure import REPOSITORY
from benchmarks.tasks.flights import ALTITUDE_M, FOCAL_PX, ORIGIN, Flight, prepare_flight, scene_of
from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io.meshes.ply import ply_columns
from epipole.io.survey.coordinate_systems import coordinates_of
from epipole.synthetic import SyntheticScene, render

THREADS = 2
SEEDS = (101, 102)
"""Of flights that nothing else uses."""
ZONE = 32
EPSG = 32600 + ZONE
GSD_M = ALTITUDE_M / FOCAL_PX
"""Ground sampling distance: a pixel on the mean ground."""
HORIZONTAL_BAR_M, VERTICAL_BAR_M = 2.0 * GSD_M, 3.0 * GSD_M
FAR_M = 1e6
"""Distance of the camera that sees the truth: parallel to 1 mm."""
ON_SURFACE_M = 0.05
"""Difference of heights up to which a point is on the surface seen from above, rather than on a wall or below a roof."""
OPEN_SIDE_M, OPEN_RANGE_M = 1.0, 0.5
"""A point is open if the heights in a square about it differ by less."""
PATCH_SIDE_M, SEARCH_M = 4.0, 1.5
"""Side of the patches whose shift is measured, and largest whole-cell shift."""
PATCH_STEP_M, HEIGHT_STEP_M = 3.0, 0.3
"""Distances of the patches and of the heights that cover the area."""
CELL_M, REACH_M = 0.1, 45.0
"""Side of a cell of the true heights, and distance from the camera centers to which they go."""
LEAST_KNOWN = 0.9
"""Fraction of a patch that must have colors."""
LEAST_FRAMES = 3
"""Number of images in whose frames the area of a flight is."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A raster on the map."""

    values: np.ndarray
    """(bands, rows, columns)."""
    x_min: float
    y_max: float
    cell_m: float
    epsg: int | None

    def at(self, positions: np.ndarray) -> np.ndarray:
        """(n, 2) column and row of eastings and northings; the center of the first cell is (0, 0)."""
        return (positions[:, :2] - [self.x_min, self.y_max]) * [1, -1] / self.cell_m - 0.5

    def sampled(self, positions: np.ndarray) -> np.ndarray:
        """Bilinear values of the first band; NaN outside and beside holes."""
        rows = self.at(positions)[:, ::-1].T
        return np.asarray(map_coordinates(self.values[0].astype(np.float64), rows, order=1, cval=np.nan))


def read_layer(path: Path) -> Layer:
    """A GeoTIFF with square cells; cells without data are NaN if it has a single band."""
    with rasterio.open(path) as file:
        values, to_map = file.read(), file.transform
        if file.count == 1 and file.nodata is not None and not np.isnan(file.nodata):
            values = np.where(values == file.nodata, np.nan, values)
        epsg = None if file.crs is None else file.crs.to_epsg()
    return Layer(values, float(to_map.c), float(to_map.f), float(to_map.a), epsg)


def map_transformer() -> pyproj.Transformer:
    """From meters east, north and up of the origin of the flights to the map."""
    origin = f"+lat_0={ORIGIN.lat_deg} +lon_0={ORIGIN.lon_deg} +h_0={ORIGIN.alt_m} +ellps=WGS84"
    return pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric {origin} +step +inv +proj=cart +ellps=WGS84 "
        f"+step +proj=utm +zone={ZONE} +ellps=WGS84"
    )


def on_map(points: np.ndarray) -> np.ndarray:
    """Easting, northing and height of points in meters east, north and up."""
    east, north, up = points.T
    return np.stack(map_transformer().transform(east, north, up), axis=1)


def off_map(positions: np.ndarray) -> np.ndarray:
    """The inverse of `on_map`."""
    x, y, height = positions.T
    return np.stack(map_transformer().transform(x, y, height, direction="INVERSE"), axis=1)


def true_view(scene: SyntheticScene, like: Layer) -> tuple[Layer, np.ndarray]:
    """Exact heights (first band) and colors of the cells of a layer, seen from far above."""
    _, height, width = like.values.shape
    x, y = like.x_min + width / 2 * like.cell_m, like.y_max - height / 2 * like.cell_m
    here, east, south = off_map(
        np.array([[x, y, ORIGIN.alt_m], [x + 1, y, ORIGIN.alt_m], [x, y - 1, ORIGIN.alt_m]])
    )
    size = float(np.linalg.norm(east - here))  # of a meter on the map
    right, down = (east - here) / size, (south - here) / size
    right[2] = down[2] = 0.0
    right /= np.linalg.norm(right)
    down -= (down @ right) * right
    rotation = np.array([right, down / np.linalg.norm(down), [0.0, 0.0, -1.0]])
    focal = FAR_M / (like.cell_m * size)
    camera = Camera("PINHOLE", width, height, [focal, focal, (width - 1) / 2, (height - 1) / 2])
    seen = render(scene, camera, Rigid3(rotation, -rotation @ np.array([here[0], here[1], FAR_M])))
    heights = FAR_M - seen.depth + ORIGIN.alt_m
    return Layer(heights[None], like.x_min, like.y_max, like.cell_m, EPSG), seen.rgb


def write_control(flight: Flight, seed: int, path: Path, base_m: float = 0.0) -> np.ndarray:
    """Write a gcp_list.txt of five points with errors, heights above `base_m`; returns the rows of the others."""
    rng = np.random.default_rng(1000 + seed)
    chosen = control_rows(flight.points)
    measured = on_map(flight.points[chosen] + CONTROL_SIGMA_M * rng.normal(size=(NUM_CONTROL, 3)))
    lines = [f"EPSG:{EPSG}"]
    for k, name in enumerate(flight.names):
        pixels = flight.camera.project(flight.cams_from_world[k].apply(flight.points[chosen]))
        marks = pixels + MARK_SIGMA_PX * rng.normal(size=pixels.shape)
        for n in np.flatnonzero(flight.is_visible[k, chosen]).tolist():
            x, y, z = measured[n]
            lines.append(f"{x:.4f} {y:.4f} {z - base_m:.4f} {marks[n, 0]:.2f} {marks[n, 1]:.2f} {name} P{n}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return np.setdiff1d(np.arange(len(flight.points)), chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Matcher:
    """An orthophoto and the true one, as gray levels on the same cells."""

    found: np.ndarray
    wanted: np.ndarray
    known: np.ndarray
    """1 where the orthophoto has a color."""
    layer: Layer

    def shift_at(self, position: np.ndarray) -> np.ndarray:
        """Meters east and north by which the orthophoto is displaced about a position of the map; NaN if that cannot be measured.

        Whole cells by normalized correlation, then fractions by ECC (Evangelidis and Psarakis 2008).
        """
        cell_m = self.layer.cell_m
        half, reach = round(PATCH_SIDE_M / cell_m / 2), round(SEARCH_M / cell_m)
        u, v = np.rint(self.layer.at(position[None])[0]).astype(int).tolist()
        far, (height, width) = half + reach, self.found.shape
        if min(u, v) < far or u + far >= width or v + far >= height:
            return np.full(2, np.nan)
        near = np.s_[v - half : v + half + 1, u - half : u + half + 1]
        wide = np.s_[v - far : v + far + 1, u - far : u + far + 1]
        if self.known[near].mean() < LEAST_KNOWN:
            return np.full(2, np.nan)
        scores = cv2.matchTemplate(self.found[wide], self.wanted[near], cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
        start = np.array([[1, 0, column], [0, 1, row]], np.float32)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
        words = self.wanted[near], self.found[wide], start, cv2.MOTION_TRANSLATION, stop, self.known[wide], 3
        try:
            moved = cv2.findTransformECC(*words)[1][:, 2].astype(np.float64) - reach
        except cv2.error:  # it does not converge
            return np.full(2, np.nan)
        return np.asarray(moved * [cell_m, -cell_m])

    def shifts_at(self, positions: np.ndarray) -> np.ndarray:
        """(n, 2)."""
        return np.array([self.shift_at(position) for position in positions])


def matcher_of(photo: Layer, scene: SyntheticScene) -> Matcher:
    """Compare an orthophoto, with an empty border, with the colors of the scene."""
    border = round((PATCH_SIDE_M / 2 + SEARCH_M) / photo.cell_m) + 2
    values = np.pad(photo.values, ((0, 0), (border, border), (border, border)))
    size = border * photo.cell_m
    photo = Layer(values, photo.x_min - size, photo.y_max + size, photo.cell_m, photo.epsg)
    wanted = cv2.cvtColor(true_view(scene, photo)[1], cv2.COLOR_RGB2GRAY)
    found = cv2.cvtColor(np.ascontiguousarray(values[:3].transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    known = (values[3] > 0).astype(np.uint8)
    return Matcher(found.astype(np.float32), wanted.astype(np.float32), known, photo)


def area_of(flight: Flight) -> Layer:
    """Cells about the flight, without values."""
    centers = on_map(flight.cams_from_world.centers())[:, :2]
    (x_min, y_min), (x_max, y_max) = (
        np.floor(centers.min(axis=0)) - REACH_M,
        np.ceil(centers.max(axis=0)) + REACH_M,
    )
    shape = 1, round((y_max - y_min) / CELL_M), round((x_max - x_min) / CELL_M)
    return Layer(np.zeros(shape, np.uint8), float(x_min), float(y_max), CELL_M, EPSG)


def num_frames(flight: Flight, points: np.ndarray) -> np.ndarray:
    """Number of images in whose frames points are, hidden or not."""
    count = np.zeros(len(points), int)
    for k in range(len(flight.names)):
        u, v = flight.camera.project(flight.cams_from_world[k].apply(points)).T
        with np.errstate(invalid="ignore"):
            count += (u >= 0) & (v >= 0) & (u <= flight.camera.width - 1) & (v <= flight.camera.height - 1)
    return count


def covered_cells(flight: Flight, truth: Layer, step_m: float) -> np.ndarray:
    """Easting, northing and true height of cells about `step_m` apart that enough frames contain."""
    step = round(step_m / truth.cell_m)
    _, height, width = truth.values.shape
    rows, columns = (part.ravel() for part in np.mgrid[0:height:step, 0:width:step])
    x, y = truth.x_min + (columns + 0.5) * truth.cell_m, truth.y_max - (rows + 0.5) * truth.cell_m
    cells = np.stack([x, y, truth.values[0, rows, columns]], axis=1)
    return np.asarray(cells[num_frames(flight, off_map(cells)) >= LEAST_FRAMES])


def is_open(truth: Layer, positions: np.ndarray) -> np.ndarray:
    """Whether the true surface about positions is smooth: no roof edge is near."""
    side = np.linspace(-OPEN_SIDE_M / 2, OPEN_SIDE_M / 2, 11)
    about = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    heights = truth.sampled((positions[:, None, :2] + about).reshape(-1, 2)).reshape(len(positions), -1)
    return np.asarray(np.ptp(heights, axis=1) < OPEN_RANGE_M)


def error_figures(name: str, errors: np.ndarray, bar: float) -> dict[str, float]:
    """Fraction within a bar (an unknown error is not), and statistics of the known absolute errors in meters."""
    known = np.abs(errors[np.isfinite(errors)])
    if not len(known):
        return {f"{name}: known": 0.0, f"{name}: within the bar": 0.0}
    return {
        f"{name}: known": float(np.isfinite(errors).mean()),
        f"{name}: within the bar": float((known <= bar).sum() / len(errors)),
        f"{name}: RMS, m": float(np.sqrt((known**2).mean())),
        f"{name}: median, m": float(np.median(known)),
        f"{name}: largest, m": float(known.max()),
    }


def product_figures(
    flight: Flight, scene: SyntheticScene, check: np.ndarray, folder: Path, base_m: float = 0.0
) -> dict[str, Any]:
    """Figures of `dsm.tif` (heights above `base_m`) and `orthophoto.tif` of a folder at the check points and everywhere."""
    model, photo = read_layer(folder / "dsm.tif"), read_layer(folder / "orthophoto.tif")
    truth, _ = true_view(scene, area_of(flight))
    matcher, points = matcher_of(photo, scene), on_map(flight.points[check])
    from_above = np.abs(truth.sampled(points) - points[:, 2]) < ON_SURFACE_M
    points = points[from_above & is_open(truth, points)]
    vertical, shifts = model.sampled(points) + base_m - points[:, 2], matcher.shifts_at(points)
    cells = covered_cells(flight, truth, HEIGHT_STEP_M)
    patches = covered_cells(flight, truth, PATCH_STEP_M)
    return {
        "GSD, horizontal bar, vertical bar, m": [
            round(bar, 4) for bar in (GSD_M, HORIZONTAL_BAR_M, VERTICAL_BAR_M)
        ],
        "EPSG of dsm.tif, orthophoto.tif": f"{model.epsg}, {photo.epsg}",
        "cells, m": f"{model.cell_m:g}, {photo.cell_m:g}",
        "check points": len(check),
        "check points, open and seen from above": len(points),
        **error_figures("check points, vertical", vertical, VERTICAL_BAR_M),
        "check points, vertical: mean, m": float(np.nanmean(vertical)),
        **error_figures("check points, horizontal", np.linalg.norm(shifts, axis=1), HORIZONTAL_BAR_M),
        "check points, horizontal: mean east and north, m": np.round(np.nanmean(shifts, axis=0), 4).tolist(),
        **error_figures("all heights", model.sampled(cells) + base_m - cells[:, 2], VERTICAL_BAR_M),
        **error_figures(
            "all patches of the orthophoto",
            np.linalg.norm(matcher.shifts_at(patches), axis=1),
            HORIZONTAL_BAR_M,
        ),
    }


def pose_figures(flight: Flight, model: epipole.Reconstruction) -> dict[str, float]:
    """Errors of the camera centers after georeferencing, in meters."""
    origin, known = model.georeference, model.is_registered()
    assert origin is not None
    found = coordinates_of(origin.lat_lon_alt_of(model.cams_from_world().centers()[known]), f"EPSG:{EPSG}")
    row_of = {name: row for row, name in enumerate(flight.names)}
    rows = [row_of[model.images.name[k]] for k in np.flatnonzero(known)]
    off = found - on_map(flight.cams_from_world.centers()[rows])
    return {
        "camera centers, horizontal RMS, m": float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())),
        "camera centers, vertical RMS, m": float(np.sqrt((off[:, 2] ** 2).mean())),
    }


def file_figures(flight: Flight, surface: Path, model: epipole.Reconstruction) -> dict[str, Any]:
    """Coordinate system of `cloud.laz`, and largest differences from the coordinates of `cloud.ply` and from PROJ, in millimeters."""
    origin, columns = model.georeference, ply_columns(surface / "cloud.ply")
    assert origin is not None
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    stored = laspy.read(surface / "cloud.laz")
    expected = coordinates_of(origin.lat_lon_alt_of(points), f"EPSG:{EPSG}")
    own = coordinates_of(ORIGIN.lat_lon_alt_of(flight.points), f"EPSG:{EPSG}")
    same = len(stored.points) == len(points)
    difference = float(np.abs(np.asarray(stored.xyz) - expected).max()) if same else np.nan
    crs = stored.header.parse_crs()
    return {
        "EPSG of cloud.laz": None if crs is None else crs.to_epsg(),
        "points of cloud.laz": len(stored.points),
        "points of cloud.ply": len(points),
        "cloud.laz from cloud.ply, mm": 1000 * difference,
        "coordinates from PROJ, mm": 1000 * float(np.abs(own - on_map(flight.points)).max()),
    }


class Clock:
    """Seconds of the steps of a run; those of the processor hardly depend on other work of the machine."""

    def __init__(self) -> None:
        """Start the first step."""
        self.seconds: dict[str, float] = {}
        self._last = perf_counter(), process_time()

    def stop(self, step: str) -> None:
        """End a step, and start the next."""
        now = perf_counter(), process_time()
        self.seconds[f"{step}, s"] = now[0] - self._last[0]
        self.seconds[f"{step}, processor s"] = now[1] - self._last[1]
        self._last = now


def survey_part(work: Path, _data: Path) -> dict[str, dict[str, Any]]:
    """Figures of each flight, and times."""
    rows = {}
    for seed in SEEDS:
        flight = prepare_flight(seed, work / "flights")
        out = work / "survey" / str(seed)
        shutil.rmtree(out, ignore_errors=True)
        check = write_control(flight, seed, out / "gcp_list.txt")
        clock = Clock()
        epipole.reconstruct(flight.images, out / "model", threads=THREADS)
        clock.stop("reconstruct")
        found = epipole.georeference(out / "model", gcp=out / "gcp_list.txt", threads=THREADS)
        clock.stop("georeference")
        made = epipole.surface(found.out, out / "surface", until="survey", threads=THREADS)
        clock.stop("surface")
        rows[f"flight {seed}"] = {
            "images": f"{int(found.model.is_registered().sum())} of {len(flight.names)}",
            **pose_figures(flight, found.model),
            **product_figures(flight, scene_of(seed), check, out / "surface"),
            **file_figures(flight, out / "surface", found.model),
            **clock.seconds,
            **{f"surface, {stage}, s": seconds for stage, seconds in made.summary["timings_s"].items()},
            "warnings": list(made.warnings),
        }
    return rows


def survey_peers_part(work: Path, _data: Path, python: str) -> dict[str, dict[str, Any]]:
    """PyOrthomosaic on the same photographs and control points, in a Python that has it."""
    script = REPOSITORY / "benchmarks" / "peers" / "pyorthomosaic_survey.py"
    rows: dict[str, dict[str, Any]] = {}
    for seed in SEEDS:
        flight = prepare_flight(seed, work / "flights")
        out = work / "survey_peers" / str(seed)
        shutil.rmtree(out, ignore_errors=True)
        # Its heights are above the mean ground: with others, it puts the control points behind the cameras.
        check = write_control(flight, seed, out / "gcp_list.txt", ORIGIN.alt_m)
        words = [python, str(script), str(flight.images), str(out / "gcp_list.txt"), str(out / "products")]
        done = subprocess.run([*words, str(CONTROL_SIGMA_M)], capture_output=True, text=True, check=False)
        (out / "log.txt").write_text(done.stdout + done.stderr, encoding="utf-8")
        if done.returncode:
            rows[f"flight {seed}, pyOrthomosaic"] = {"error": done.stderr.strip().splitlines()[-1]}
            continue
        times = json.loads((out / "products" / "seconds.json").read_text(encoding="utf-8"))
        figures = product_figures(flight, scene_of(seed), check, out / "products", ORIGIN.alt_m)
        rows[f"flight {seed}, pyOrthomosaic"] = {**figures, **times}
    return rows
