"""Depth of views for `benchmarks.surfaces`: rendered scenes, a depth camera, and stereo pairs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import epipole
from benchmarks.tasks.stereo import StereoTask, figures, stereo_tasks
from benchmarks.tasks.surface_kitchen import JUDGED_EVERY, Kitchen, prepare_kitchen
from benchmarks.tasks.surface_scenes import PLANS
from benchmarks.tasks.surfaces import NUM_SOURCES, SurfaceScene, prepare_scene, sources_of
from epipole.cameras import Camera
from epipole.dense.depth import SHARED, view_depth
from epipole.dense.view import DenseView
from epipole.geometry import Rigid3
from epipole.scene.view_depth import DepthReason, ViewDepth

RIGHT, WRONG = 0.01, 0.05
"""Relative errors up to which a depth is right, and beyond which it is wrong."""
MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute values of a standard normal distribution."""
CALIBRATIONS = {
    "motorcycle": (994.978, 311.193, 254.877, 31.086, 193.001),
    "cones": (935.0, 224.5, 187.0, 0.0, 160.0),
    "teddy": (935.0, 224.5, 187.0, 0.0, 160.0),
}
"""Focal length, principal point and disparity offset in pixels, baseline in mm. Those of 2003 are nominal: disparities do not depend on them."""


def depth_part(work: Path, _data: Path) -> dict[str, dict[str, float]]:
    """Figures of each rendered scene, over the pixels of all its views."""
    return {name: scene_figures(prepare_scene(name, work)) for name in PLANS}


def scene_figures(scene: SurfaceScene) -> dict[str, float]:
    """Match every view of a scene with its sources, and compare with the exact depth."""
    sources, ranges = sources_of(scene, NUM_SOURCES)
    sums: dict[str, np.ndarray] = {}
    seconds = []
    middle = len(scene.names) // 2
    warm_up = scene.view(middle), [scene.view(j) for j in sources[middle]], ranges[middle]
    view_depth(*warm_up)
    repeated = np.median([_timed(lambda: view_depth(*warm_up))[1] for _ in range(3)], axis=0)
    for k, row in enumerate(sources):
        view, others = scene.view(k), [scene.view(j) for j in row]
        found, one = _timed(lambda: view_depth(view, others, ranges[k]))  # noqa: B023 - called at once
        seconds.append(one)
        for name, pair in counts(scene, k, row, found).items():
            sums[name] = sums.get(name, np.zeros(2)) + pair
    pixels = scene.camera.width * scene.camera.height
    return {
        "views": len(scene.names),
        **{name: float(part / whole) for name, (part, whole) in sums.items() if whole},
        "us per pixel (middle view, median of 3)": 1e6 * float(repeated[0]) / pixels,
        "processor us per pixel (the same)": 1e6 * float(repeated[1]) / pixels,
        "us per pixel (median of the views)": 1e6 * float(np.median(seconds, axis=0)[0]) / pixels,
        "processor us per pixel (median of the views)": 1e6 * float(np.median(seconds, axis=0)[1]) / pixels,
    }


def _timed(run: Callable[[], Any]) -> tuple[Any, np.ndarray]:
    """Result, and (wall, processor) seconds: the latter hardly depend on other work of the machine."""
    wall, processor = time.perf_counter(), time.process_time()
    found = run()
    return found, np.array([time.perf_counter() - wall, time.process_time() - processor])


def counts(scene: SurfaceScene, k: int, sources: list[int], found: ViewDepth) -> dict[str, np.ndarray]:
    """Numerator and denominator of every figure."""
    truth, num = scene.depth(k), scene.num_seeing(k, sources)
    known, is_sky = found.reason == DepthReason.OK, np.isnan(truth)
    with np.errstate(invalid="ignore"):
        error = np.abs(found.depth - truth)
        right, wrong = known & (error <= RIGHT * truth), known & ~(error <= WRONG * truth)
        sigmas = error / found.sigma
    visible, judged = num >= 1, known & ~is_sky
    is_thin = scene.is_thin(k) & visible
    return {
        "visible": _pair(visible, np.ones_like(visible)),
        "known": _pair(known, visible),
        "right": _pair(right, visible),
        "right where two sources see": _pair(right, num >= 2),
        "wrong": _pair(wrong, known),
        "sky with a depth": _pair(known, is_sky),
        "within 1 sigma": _pair(sigmas <= 1.0, judged),
        "within 2 sigma": _pair(sigmas <= 2.0, judged),
        "right on thin things": _pair(right, is_thin),
        "wrong on thin things": _pair(wrong, is_thin),
    }


def _pair(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.array([float((part & whole).sum()), float(whole.sum())])


def fit_shared(work: Path) -> dict[str, float]:
    """Fraction of the variance that sources share: errors of the same pixels of the courtyard with three to five agreeing sources."""
    scene = prepare_scene("courtyard", work)
    sources, ranges = sources_of(scene, NUM_SOURCES)
    numbers = range(
        3, NUM_SOURCES + 1
    )  # with two, the sigmas are not scaled by the differences of the sources
    ratios: dict[int, list[np.ndarray]] = {n: [] for n in numbers}
    for k in range(0, len(scene.names), 8):
        others = [scene.view(j) for j in sources[k]]
        found = [view_depth(scene.view(k), others[:n], ranges[k]) for n in numbers]
        agree = [(one.num_agreeing == n) & (one.reason == DepthReason.OK) for n, one in zip(numbers, found)]
        own = np.logical_and.reduce([*agree, np.isfinite(scene.depth(k))])
        for n, one in zip(numbers, found):
            ratios[n].append((np.abs(one.depth - scene.depth(k)) / one.sigma)[own])
    median = {n: float(np.median(np.concatenate(rows))) / MEDIAN_OF_NORMAL for n, rows in ratios.items()}
    extra = np.array([n - 1.0 for n in median])
    variance = np.array(list(median.values())) ** 2 * (1.0 + SHARED * extra)
    slope, constant = np.polyfit(extra, variance, 1)
    named = {f"error in sigmas, {n} sources": value for n, value in median.items()}
    return named | {"SHARED": float(slope / constant)}


def real_part(work: Path, data: Path) -> dict[str, dict[str, float]]:
    """Color images of a kitchen, compared with the depth camera beside them: with the published poses, and with epipole's."""
    kitchen = prepare_kitchen(work, data, NUM_SOURCES)
    return {
        "published poses": kitchen_figures(kitchen, kitchen.published),
        "own poses": kitchen_figures(kitchen, kitchen.own),
    }


def kitchen_figures(kitchen: Kitchen, poses: Rigid3) -> dict[str, float]:
    """Figures over the pixels that both have."""
    rows = range(0, len(kitchen.frames), JUDGED_EVERY)
    errors, sigmas, num_known, num_measured, seconds = [], [], 0, 0, []
    for k in rows:
        view, sources = kitchen.view(k, poses), [kitchen.view(j, poses) for j in kitchen.sources[k]]
        found, one = _timed(lambda: view_depth(view, sources, kitchen.depths[k]))  # noqa: B023 - called at once
        seconds.append(one)
        measured = kitchen.measured(k)
        both = np.isfinite(measured) & (found.reason == DepthReason.OK)
        num_measured, num_known = num_measured + int(np.isfinite(measured).sum()), num_known + int(both.sum())
        errors.append((found.depth / measured - 1.0)[both])
        sigmas.append((np.abs(found.depth - measured) / found.sigma)[both])
    signed = np.concatenate(errors)
    error, width, height = np.abs(signed), kitchen.view(0, poses).camera.width, len(measured)
    return {
        "views": len(rows),
        "sources (mean)": float(np.mean([len(kitchen.sources[k]) for k in rows])),
        "density where the sensor measures": num_known / num_measured,
        "median error": float(np.median(error)),
        "median signed error": float(np.median(signed)),
        "median error without the scale": float(
            np.median(np.abs((1 + signed) / (1 + np.median(signed)) - 1))
        ),
        "within 1 %": float((error <= RIGHT).mean()),
        "wrong": float((error > WRONG).mean()),
        "within 2 sigma": float((np.concatenate(sigmas) <= 2.0).mean()),
        "us per pixel": 1e6 * float(np.median(seconds, axis=0)[0]) / (width * height),
    }


def stereo_part(_work: Path, data: Path) -> dict[str, dict[str, float]]:
    """One source against `match_stereo` on the same pairs."""
    rows = {}
    tasks = stereo_tasks(data)
    for name in CALIBRATIONS:
        task = tasks[name]
        found = epipole.match_stereo(task.left, task.right, max_disparity_px=task.num_disparities - 1)
        rows[f"{name}, match_stereo"] = figures(found.disparity_px, task)
        disparity, sigma = disparity_of_view_depth(task, name)
        both = np.isfinite(disparity) & task.seen
        ratio = (np.abs(disparity - task.truth) / sigma)[both]
        within = {f"within {n} sigma": float((ratio <= n).mean()) for n in (1, 2)}
        rows[f"{name}, view_depth"] = figures(disparity, task) | within
    return rows


def disparity_of_view_depth(task: StereoTask, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Disparities that the depth of the left image corresponds to, and their sigmas; its only source is the right image."""
    focal, cx, cy, offset, baseline = CALIBRATIONS[name]
    height, width = task.left.shape
    views = []
    for side, image, extra, shift in (("left", task.left, 0.0, 0.0), ("right", task.right, offset, baseline)):
        camera = Camera("PINHOLE", width, height, [focal, focal, cx + extra, cy])
        rgb = np.ascontiguousarray(np.repeat(image[..., None], 3, axis=2))
        views.append(DenseView(side, rgb, camera, Rigid3(np.eye(3), np.array([-shift, 0.0, 0.0]))))
    largest, least = task.num_disparities - 1 + offset, max(offset, 1.0)
    found = view_depth(views[0], views[1:], (focal * baseline / largest, focal * baseline / least))
    scale = focal * baseline / found.depth
    return scale - offset, scale * found.sigma / found.depth
