"""Control points and GPS on rendered flights, beside COLMAP's similarity: `python -m benchmarks.georeferencing`.

Each flight is rendered and reconstructed once. Of its ground points, five are control points and the others are check points. For
each seed, control points, marks and GPS positions get new errors. A similarity through the same triangulated control points
(COLMAP's `estimate_sim3d`, in a separate process) shows what the adjustment adds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.flights import ORIGIN, Flight, prepare_flight
from epipole import GeoreferenceConfig, Reconstruction, reconstruct
from epipole.geometry import Rigid3, align_points
from epipole.pipelines.georeferencing.georeference import GeoreferencedModel, georeference_model
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints
from epipole.robust import triangulate_points

NUM_CONTROL = 5
CONTROL_SIGMA_M, MARK_SIGMA_PX, GPS_SIGMA_M = 0.02, 0.5, 2.0
CONFIG = GeoreferenceConfig(
    gcp_sigma_m=CONTROL_SIGMA_M,
    gcp_height_sigma_m=CONTROL_SIGMA_M,
    mark_sigma_px=MARK_SIGMA_PX,
    gps_sigma_m=GPS_SIGMA_M,
)


def survey_of(
    flight: Flight, model: Reconstruction, seed: int
) -> tuple[SurveyedPoints, GpsFixes, np.ndarray]:
    """Measurements with errors, and the true positions of the points."""
    rng = np.random.default_rng(1000 + seed)
    row_of = {name: row for row, name in enumerate(model.images.name)}
    chosen = control_rows(flight.points)
    order = np.concatenate([chosen, np.setdiff1d(np.arange(len(flight.points)), chosen)])
    truth = flight.points[order]
    point, image, pixels = [], [], []
    for k, name in enumerate(flight.names):
        for n in np.flatnonzero(flight.is_visible[k, order]).tolist():
            pixel = flight.camera.project(flight.cams_from_world[k].apply(truth[n])[None])[0]
            point.append(n)
            image.append(row_of[name])
            pixels.append(pixel + MARK_SIGMA_PX * rng.normal(size=2))
    measured = truth + CONTROL_SIGMA_M * rng.normal(size=truth.shape)
    surveyed = SurveyedPoints(
        tuple(f"P{n}" for n in range(len(truth))),
        measured,
        measured[:, [1, 0, 2]],
        np.full(truth.shape, CONTROL_SIGMA_M),
        np.arange(len(truth)) < NUM_CONTROL,
        np.array(point),
        np.array(image),
        np.array(pixels),
    )
    fixes = np.full((len(model.images), 3), np.nan)
    centers = flight.cams_from_world.centers()
    fixes[[row_of[name] for name in flight.names]] = centers + GPS_SIGMA_M * rng.normal(size=centers.shape)
    return surveyed, GpsFixes(fixes, np.full(fixes.shape, GPS_SIGMA_M)), truth


def control_rows(points: np.ndarray) -> np.ndarray:
    """The points nearest to the corners of the area, and nearest to its center."""
    low, size = points[:, :2].min(axis=0), np.ptp(points[:, :2], axis=0)
    goals = low + np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0.5]]) * size
    rows: list[int] = []
    for goal in goals:
        distance = np.linalg.norm(points[:, :2] - goal, axis=1)
        distance[rows] = np.inf
        rows.append(int(np.argmin(distance)))
    return np.array(rows)


def triangulated(model: Reconstruction, surveyed: SurveyedPoints) -> np.ndarray:
    """The surveyed points in the model's coordinates."""
    out, cams = np.full((len(surveyed), 3), np.nan), model.cams_from_world()
    for row in range(len(surveyed)):
        own = np.flatnonzero(surveyed.point == row)
        images = surveyed.image[own]
        cameras = [model.cameras[int(model.camera_of_image[i])] for i in images]
        found = triangulate_points(
            Rigid3(cams.rotation[images], cams.translation[images]), cameras, surveyed.pixels[own][:, None]
        )
        out[row] = found.points_in_world[0]
    return out


def similarity_of_colmap(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, str]:
    """3x4 matrix of COLMAP's similarity, from a separate process; or epipole's, and its name, if pycolmap is missing."""
    data = json.dumps({"source": source.tolist(), "target": target.tolist()})
    code = (
        "import json, sys, numpy as np, pycolmap; d = json.load(sys.stdin);"
        "s = pycolmap.estimate_sim3d(np.array(d['source']), np.array(d['target']));"
        "print(json.dumps(np.asarray(s.matrix()).tolist()))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], input=data, capture_output=True, text=True, check=False
    )
    if found.returncode == 0:
        return np.array(json.loads(found.stdout)), "pycolmap"
    own = align_points(source, target)
    return np.column_stack(
        [float(own.scale) * own.rotation, own.translation]
    ), "Umeyama (pycolmap is not installed)"


def run(num_flights: int, num_seeds: int, work: Path) -> list[dict[str, Any]]:
    """A row of results for each survey."""
    rows: list[dict[str, Any]] = []
    for number in range(num_flights):
        flight = prepare_flight(number, work)
        model = reconstruct(flight.images, work / f"flight_{number}" / "out").models[0]
        assert model.georeference is not None
        for seed in range(number, num_seeds, num_flights):
            surveyed, gps, truth = survey_of(flight, model, seed)
            start = perf_counter()
            found = georeference_model(model, surveyed, gps, CONFIG)
            seconds = perf_counter() - start
            rows.append(
                _row(found, surveyed, truth, model) | {"flight": number, "seed": seed, "seconds": seconds}
            )
    return rows


def _row(
    found: GeoreferencedModel, surveyed: SurveyedPoints, truth: np.ndarray, model: Reconstruction
) -> dict[str, Any]:
    check = ~surveyed.is_control
    off = (found.adjusted.positions_m - truth)[check]
    ratios = np.abs(found.residuals_m / found.sigmas_m)[check]
    points = triangulated(model, surveyed)
    matrix, peer = similarity_of_colmap(points[:NUM_CONTROL], surveyed.position_m[:NUM_CONTROL])
    others = points @ matrix[:, :3].T + matrix[:, 3] - truth
    return {
        "horizontal_m": float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())),
        "vertical_m": float(np.sqrt((off[:, 2] ** 2).mean())),
        "within": (ratios <= 2.0).mean(axis=0).tolist(),
        "all_within": float((ratios <= 2.0).all(axis=1).mean()),
        "sigma_m": found.sigmas_m[check].mean(axis=0).tolist(),
        "warnings": list(found.warnings),
        "peer": peer,
        "peer_horizontal_m": float(np.sqrt((others[check, :2] ** 2).sum(axis=1).mean())),
        "peer_vertical_m": float(np.sqrt((others[check, 2] ** 2).mean())),
    }


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "georeferencing")
    arguments = parser.parse_args()
    rows = run(arguments.flights, arguments.seeds, arguments.work)
    results = REPOSITORY / "benchmarks" / "results" / "georeferencing.json"
    results.write_text(
        json.dumps({"machine": describe_machine(2), "rows": rows}, indent=1) + "\n", encoding="utf-8"
    )

    def middle(key: str) -> float:
        return float(np.median([row[key] for row in rows]))

    within = np.array([row["within"] for row in rows])
    table = Table(title=f"{len(rows)} surveys of {arguments.flights} flights, {NUM_CONTROL} control points")
    for name in ("", "check points, horizontal", "vertical", "time"):
        table.add_column(name)
    table.add_row(
        "epipole",
        f"{1000 * middle('horizontal_m'):.0f} mm",
        f"{1000 * middle('vertical_m'):.0f} mm",
        f"{middle('seconds'):.2f} s",
    )
    table.add_row(
        str(rows[0]["peer"]),
        f"{1000 * middle('peer_horizontal_m'):.0f} mm",
        f"{1000 * middle('peer_vertical_m'):.0f} mm",
        "",
    )
    console = Console(width=120)
    console.print(table)
    console.print(
        f"coordinates within two stated standard deviations: {100 * within.mean():.1f} % "
        f"(east, north, up {', '.join(f'{100 * v:.1f}' for v in within.mean(axis=0))}); "
        f"points with all three: {100 * np.mean([row['all_within'] for row in rows]):.1f} %; "
        f"surveys with at least 90 % of their coordinates: {int((within.mean(axis=1) >= 0.9).sum())} of {len(rows)}; "
        f"mean sigma {np.round(np.mean([row['sigma_m'] for row in rows], axis=0), 3).tolist()} m; "
        f"warnings in {sum(bool(row['warnings']) for row in rows)}; origin {ORIGIN.lat_deg}, {ORIGIN.lon_deg}"
    )


if __name__ == "__main__":
    main()
