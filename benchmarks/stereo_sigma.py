"""Errors of disparities against their standard deviations. `python -m benchmarks.stereo_sigma`; `--fit` recomputes the constants.

The constants are fitted on rendered rooms with even seeds; the table is for odd seeds and the real pairs.
"""

from __future__ import annotations

import argparse
import json
import os
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import table_of
from benchmarks.tasks.stereo import StereoTask, stereo_tasks
from epipole.disparity_search import uncertainty
from epipole.disparity_search.search import match_stereo, match_with_evidence
from epipole.pipelines.stereo.config import StereoConfig
from epipole.synthetic.stereo_rooms import stereo_room

QUANTUM_PX = {"cones": 0.25, "teddy": 0.25, "motorcycle": 0.0, "aloe": 1.0}
"""Quantization step of the ground truth, whose standard deviation is added in quadrature."""
NUM_ROOMS = 300
KNOTS = 16
"""Number of entries in the fitted table."""
PIXELS_PER_ROOM = 10_000
"""Number of pixels of each room in the fit."""
QUANTILE = 0.68
"""The table gives this quantile of the errors as standard deviation."""
MIN_ERROR_PX = 0.03
"""Added to the errors, so that small ones do not dominate the logarithmic fit."""


def coverage(error: np.ndarray, sigma: np.ndarray, quantum_px: float) -> dict[str, float]:
    """Fractions of errors within one sigma, overall and for each fifth by sigma, and area under the sparsification error."""
    within = error <= np.hypot(sigma, quantum_px / np.sqrt(12.0))
    order = np.argsort(sigma, kind="stable")
    fifths = {
        f"fifth {k + 1} %": 100.0 * float(within[part].mean())
        for k, part in enumerate(np.array_split(order, 5))
    }
    count = np.arange(1, len(error) + 1)
    curve, best = np.cumsum(error[order]) / count, np.cumsum(np.sort(error)) / count
    return {
        "within %": 100.0 * float(within.mean()),
        **fifths,
        "median sigma px": float(np.median(sigma)),
        "AUSE px": float((curve - best).mean()),
        "average px": float(error.mean()),
    }


def room_config(disparity: np.ndarray) -> StereoConfig:
    """Options with the disparity range of a rendered pair."""
    return StereoConfig(max_disparity_px=int(np.nanmax(disparity)) + 8)


def fit() -> None:
    """Fit the weights and the table on rooms with even seeds, and print them."""
    rows, errors = [], []
    for seed in range(0, NUM_ROOMS, 2):
        pair = stereo_room(seed)
        found, evidence = match_with_evidence(pair.left, pair.right, room_config(pair.disparity_px))
        error = np.abs(found.disparity_px - pair.disparity_px)
        known = np.isfinite(error)
        sample = np.random.default_rng(seed).permutation(int(known.sum()))[:PIXELS_PER_ROOM]
        rows.append(uncertainty.cues(evidence)[:, known].T[sample].astype(np.float64))
        errors.append(error[known][sample])
    cues, error = np.concatenate(rows), np.concatenate(errors)
    design = np.concatenate([np.ones((len(cues), 1)), cues, cues * cues], axis=1)
    weights, *_ = np.linalg.lstsq(design, np.log(error + MIN_ERROR_PX), rcond=None)
    scores = design @ weights
    order = np.array_split(np.argsort(scores), KNOTS)
    knots = [float(np.median(scores[part])) for part in order]
    sigmas = np.maximum.accumulate([np.quantile(error[part], QUANTILE) for part in order])
    for name, values in (("WEIGHTS", weights), ("SCORES", knots), ("LOG_SIGMAS", np.log(sigmas))):
        print(f"{name} = np.array({np.round(values, 4).tolist()})")


def pandora_areas(connection: Any, data: Path) -> None:
    """Send the areas under the sparsification error of pandora's disparities, sorted by pandora's confidence (ambiguity)."""
    from benchmarks.stereo import match_with_pandora

    rows = {}
    for name, task in stereo_tasks(data).items():
        pair = (task.left, task.right, task.num_disparities)
        disparity, confidence = match_with_pandora([pair], 2, with_confidence=True)[0]
        error = np.abs(disparity - task.truth)
        known = np.isfinite(error) & np.isfinite(confidence)
        # The better sign of two: the ambiguity is a confidence in some versions and an uncertainty in others.
        both = [coverage(error[known], sign * confidence[known], 0.0) for sign in (-1.0, 1.0)]
        found = min(both, key=lambda figures: figures["AUSE px"])
        rows[name] = {key: found[key] for key in ("AUSE px", "average px")}
    connection.send(rows)


def opencv_offset_px(task: StereoTask) -> float:
    """Median offset of StereoBM's disparities from the truth where they nearly agree: the bias of a truncated ground truth."""
    gray = [np.ascontiguousarray(image) for image in (task.left, task.right)]
    disparity = cv2.StereoBM_create(-(-task.num_disparities // 16) * 16, 15).compute(*gray) / 16.0
    error = (disparity - task.truth)[disparity > 0]
    return float(np.median(error[np.abs(error) < 2.0]))


def main() -> None:
    """Print the fractions of errors within their standard deviations and write the results."""
    parser = argparse.ArgumentParser(description="Standard deviations of disparities.")
    parser.add_argument("--fit", action="store_true", help="fit the constants and print them")
    parser.add_argument("--pandora", action="store_true", help="also evaluate pandora's confidence")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    if arguments.fit:
        fit()
        return
    rows: dict[str, Any] = {}
    errors, sigmas = [], []
    for seed in range(1, NUM_ROOMS, 2):
        pair = stereo_room(seed)
        found = match_stereo(pair.left, pair.right, room_config(pair.disparity_px))
        error = np.abs(found.disparity_px - pair.disparity_px)
        errors.append(error[np.isfinite(error)])
        sigmas.append(found.sigma_px[np.isfinite(error)])
    rows["rendered rooms"] = coverage(np.concatenate(errors), np.concatenate(sigmas), 0.0)
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    for name, task in stereo_tasks(data).items():
        found = match_stereo(task.left, task.right, StereoConfig(max_disparity_px=task.num_disparities - 1))
        error = found.disparity_px - task.truth
        known = np.isfinite(error)
        rows[name] = coverage(np.abs(error[known]), found.sigma_px[known], QUANTUM_PX[name])
        if QUANTUM_PX[name] == 1.0:
            offset, sigma = opencv_offset_px(task), found.sigma_px[known]
            rows[f"{name}, truth {offset:+.2f} (OpenCV's)"] = coverage(
                np.abs(error[known] - offset), sigma, 1.0
            )
            random = np.random.default_rng(0)
            exact = random.normal(0.0, sigma) + random.uniform(-0.5, 0.5, len(sigma))
            rows[f"{name}, were all bars exact"] = coverage(np.abs(exact), sigma, 1.0)
    if arguments.pandora:
        ours, theirs = get_context("spawn").Pipe()
        process = get_context("spawn").Process(target=pandora_areas, args=(theirs, data))
        process.start()
        for name, row in ours.recv().items():
            rows[f"{name}, pandora"] = row
        process.join()
    Console(width=150).print(table_of("errors within one sigma", rows))
    arguments.results.mkdir(parents=True, exist_ok=True)
    report = {"machine": describe_machine(2), **rows}
    (arguments.results / "stereo_sigma.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
