"""One pair from its images to its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.files import write_stereo
from epipole.pipelines.stereo.page import render_page
from epipole.pipelines.stereo.pair import StereoResult, measure_pair
from epipole.pipelines.stereo.pair_files import PairFiles


def measured(files: PairFiles, config: StereoConfig) -> StereoResult:
    """Read the images of a pair and measure it.

    Raises:
        FileFormatError: an image is damaged.
        ShapeError: the sizes of the images do not match each other or the calibration.
        ConfigError: left and right are swapped in the calibration.
        DegenerateGeometryError: the pair cannot be rectified.
    """
    result = measure_pair(*files.read(), config, files.rig)
    return replace(result, warnings=(*files.notes, *result.warnings))


def write_pair(result: StereoResult, folder: Path) -> None:
    """Write all files of a pair, and its report.

    Raises:
        WorkspaceError: a file cannot be written.
    """
    write_stereo(result, folder)
    (folder / "report.html").write_text(render_page(result), encoding="utf-8")


def summary_of_pair(result: StereoResult) -> dict[str, Any]:
    """The content of `summary.json`."""
    known = result.disparities.sigma_px[np.isfinite(result.disparities.sigma_px)]
    return {
        "density": result.disparities.density,
        "median_sigma_px": float(np.median(known)) if known.size else None,
        "error_model": result.error_model,
        "warnings": list(result.warnings),
    }
