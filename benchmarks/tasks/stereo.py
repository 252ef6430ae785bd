"""Rectified pairs with true disparities, and scores of estimated ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image


@dataclass(frozen=True, eq=False)
class StereoTask:
    """A rectified pair with ground truth."""

    left: np.ndarray
    """(h, w), grayscale."""
    right: np.ndarray
    truth: np.ndarray
    """Disparities of the left image; NaN if unknown."""
    seen: np.ndarray
    """Mask of pixels with ground truth that are visible in the right image."""
    num_disparities: int
    """The search range is 0 to num_disparities - 1."""


def stereo_tasks(data: Path) -> dict[str, StereoTask]:
    """The real pairs by name."""
    return {
        "cones": _middlebury_2003(data / "stereo" / "middlebury_2003" / "cones"),
        "teddy": _middlebury_2003(data / "stereo" / "middlebury_2003" / "teddy"),
        "motorcycle": _motorcycle(data / "stereo" / "motorcycle"),
        "aloe": _aloe(data / "stereo" / "aloe"),
    }


def _gray(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file).convert("L"))


def _middlebury_2003(folder: Path) -> StereoTask:
    left, right = (np.asarray(Image.open(folder / f"disp{k}.png")) / 4.0 for k in (2, 6))
    truth, right_truth = np.where(left > 0, left, np.nan), np.where(right > 0, right, np.nan)
    x = np.arange(truth.shape[1])
    x_right = np.rint(x - np.nan_to_num(truth)).astype(int)
    confirmed = np.take_along_axis(right_truth, np.maximum(x_right, 0), axis=1)
    seen = (x_right >= 0) & (np.abs(confirmed - truth) <= 1)
    return StereoTask(_gray(folder / "im2.png"), _gray(folder / "im6.png"), truth, seen, 64)


def _motorcycle(folder: Path) -> StereoTask:
    truth = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(float)
    truth[~np.isfinite(truth)] = np.nan
    left, right = (_gray(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    return StereoTask(left, right, truth, seen_by_both(truth), 64)


def _aloe(folder: Path) -> StereoTask:
    truth = _gray(folder / "aloeGT.png").astype(float)
    truth[truth == 0] = np.nan
    left, right = (_gray(folder / f"aloe{side}.jpg") for side in "LR")
    return StereoTask(left, right, truth, seen_by_both(truth), 256)


def seen_by_both(truth: np.ndarray) -> np.ndarray:
    """Mask of the pixels that are inside the right image and not occluded there, by warping the ground truth forward."""
    height, width = truth.shape
    known = np.isfinite(truth)
    y, x = np.nonzero(known)
    x_right = x - truth[known]
    nearest = np.full((height, width + 1), -np.inf)
    for column in (np.floor(x_right).astype(int), np.floor(x_right).astype(int) + 1):
        inside = (column >= 0) & (column <= width)
        np.maximum.at(nearest, (y[inside], column[inside]), truth[known][inside])
    column = np.rint(x_right).astype(int)
    out = np.zeros(truth.shape, bool)
    inside = (x_right >= 0) & (column < width)
    rows = y[inside]
    out[rows, x[inside]] = nearest[rows, column[inside]] <= truth[known][inside] + 1.0
    return out


def figures(disparity: np.ndarray, task: StereoTask) -> dict[str, float]:
    """Over pixels visible in both images: density, error rates, mean error, and error rates with holes counted as wrong."""
    error = np.abs(disparity - task.truth)
    known = np.isfinite(disparity) & task.seen
    bad = {f"bad {t} %": 100.0 * float((error[known] > t).mean()) for t in (1, 2, 4)}
    with_holes = np.where(np.isfinite(disparity), error, np.inf)[task.seen]
    return {
        "density %": 100.0 * float(known.sum() / task.seen.sum()),
        **bad,
        "average px": float(error[known].mean()),
        "bad 1 % with holes": 100.0 * float((with_holes > 1).mean()),
        "bad 2 % with holes": 100.0 * float((with_holes > 2).mean()),
    }
