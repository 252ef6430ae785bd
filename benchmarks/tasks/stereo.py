"""Rectified pairs with true disparities, and what an answer is worth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image


@dataclass(frozen=True, eq=False)
class StereoTask:
    """A pair and its truth."""

    left: np.ndarray
    """(h, w) grey."""
    right: np.ndarray
    truth: np.ndarray
    """Disparities of the left image, NaN where unknown."""
    seen: np.ndarray
    """Pixels with a truth that the right image sees too."""
    num_disparities: int
    """0 ... num_disparities - 1 are looked for."""


def stereo_tasks(data: Path) -> dict[str, StereoTask]:
    """The real pairs by name."""
    return {
        "cones": _middlebury_2003(data / "stereo" / "middlebury_2003" / "cones"),
        "teddy": _middlebury_2003(data / "stereo" / "middlebury_2003" / "teddy"),
        "motorcycle": _motorcycle(data / "stereo" / "motorcycle"),
        "aloe": _aloe(data / "stereo" / "aloe"),
    }


def _grey(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file).convert("L"))


def _middlebury_2003(folder: Path) -> StereoTask:
    truth, theirs = (np.asarray(Image.open(folder / f"disp{k}.png")) / 4.0 for k in (2, 6))
    truth, theirs = np.where(truth > 0, truth, np.nan), np.where(theirs > 0, theirs, np.nan)
    x = np.arange(truth.shape[1])
    there = np.rint(x - np.nan_to_num(truth)).astype(int)
    confirmed = np.take_along_axis(theirs, np.maximum(there, 0), axis=1)
    seen = (there >= 0) & (np.abs(confirmed - truth) <= 1)
    return StereoTask(_grey(folder / "im2.png"), _grey(folder / "im6.png"), truth, seen, 64)


def _motorcycle(folder: Path) -> StereoTask:
    truth = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(float)
    truth[~np.isfinite(truth)] = np.nan
    left, right = (_grey(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    return StereoTask(left, right, truth, seen_by_both(truth), 64)


def _aloe(folder: Path) -> StereoTask:
    truth = _grey(folder / "aloeGT.png").astype(float)
    truth[truth == 0] = np.nan
    left, right = (_grey(folder / f"aloe{side}.jpg") for side in "LR")
    return StereoTask(left, right, truth, seen_by_both(truth), 256)


def seen_by_both(truth: np.ndarray) -> np.ndarray:
    """Pixels that lie in the right image with nothing nearer in the same place: the truth warped forward."""
    height, width = truth.shape
    known = np.isfinite(truth)
    y, x = np.nonzero(known)
    there = x - truth[known]
    nearest = np.full((height, width + 1), -np.inf)
    for column in (np.floor(there).astype(int), np.floor(there).astype(int) + 1):
        inside = (column >= 0) & (column <= width)
        np.maximum.at(nearest, (y[inside], column[inside]), truth[known][inside])
    column = np.rint(there).astype(int)
    out = np.zeros(truth.shape, bool)
    inside = (there >= 0) & (column < width)
    rows = y[inside]
    out[rows, x[inside]] = nearest[rows, column[inside]] <= truth[known][inside] + 1.0
    return out


def figures(disparity: np.ndarray, task: StereoTask) -> dict[str, float]:
    """Of the pixels both images see: share answered, share of wrong answers, average error, and with holes as wrong."""
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
