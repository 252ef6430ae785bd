"""Verdict on a calibration: pass or fail, with the numbers behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from epipole.pipelines.calibration.calibrate import Calibration, ViewState
from epipole.pipelines.calibration.comparison import CrossCheck
from epipole.pipelines.calibration.coverage import coverage, covered_pixels
from epipole.pipelines.calibration.uncertainty import projection_sigma

LEAST_VIEWS = 8
MOST_RMS_PX = 1.0
LEAST_COVERAGE = 0.4
MOST_SIGMA_PX = 0.5
MOST_DIFFERENCE = 8.0
"""In standard deviations of the full calibration. Halves of the views differ by 2 of them; 8 is not chance."""
LEAST_DIFFERENCE_PX = 0.3
MOST_HELD_OUT = 1.5
MOST_BASELINE_SIGMA = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Pass or fail, and why."""

    passes: bool
    sentence: str
    failures: tuple[str, ...]


def assess(found: Calibration, check: CrossCheck | None, against: Sequence[str] = ()) -> Verdict:
    """Check a calibration against the needs of depth and reconstruction.

    Args:
        found: the calibration, with its covariances widened by the check.
        check: cross-validation of its halves.
        against: further reasons to fail.
    """
    failures = list(against)
    widening = 1.0 if check is None else check.widening
    for c, camera in enumerate(found.cameras):
        who = "" if len(found.cameras) == 1 else f"{('left', 'right')[min(c, 1)]} camera: "
        used = sum(state is ViewState.USED for state in found.view_states[c])
        if used < LEAST_VIEWS:
            failures.append(f"{who}only {used} views are used, {LEAST_VIEWS} are needed")
        covered = coverage(found, c)
        if covered < LEAST_COVERAGE:
            failures.append(
                f"{who}corners cover only {100 * covered:.0f} % of the image, beyond which the model is extrapolated"
            )
        sigma = _covered_sigma_px(found, c)
        if not sigma <= MOST_SIGMA_PX:
            failures.append(f"{who}the projection uncertainty is {sigma:.2f} px even where corners were seen")
        most = max(MOST_DIFFERENCE * sigma / widening, LEAST_DIFFERENCE_PX)
        if check is not None and check.difference_px[c] > most:
            failures.append(
                f"{who}two halves of the views differ by {check.difference_px[c]:.2f} px (median), more than their "
                "uncertainty explains: another camera model is needed, or the board is bent"
            )
        width, height = camera.width, camera.height
        cx, cy = camera.K[0, 2], camera.K[1, 2]
        if not (0 < cx < width and 0 < cy < height):
            failures.append(f"{who}the principal point lies outside the image")
    if found.rms_px > MOST_RMS_PX:
        failures.append(f"the reprojection error is {found.rms_px:.2f} px (RMS)")
    if check is None:
        failures.append("too few views for cross-validation")
    elif check.held_out_rms_px > MOST_HELD_OUT * check.fitted_rms_px:
        failures.append(
            f"the reprojection error is {check.held_out_rms_px:.2f} px in held-out views, but {check.fitted_rms_px:.2f} px in fitted ones"
        )
    if len(found.cameras) == 2:
        relative = found.baseline_sigma() / found.rig().baseline
        if relative > MOST_BASELINE_SIGMA:
            failures.append(f"the standard deviation of the baseline is {100 * relative:.1f} %")
    worst = max(_covered_sigma_px(found, c) for c in range(len(found.cameras)))
    words = f"reprojection error {found.rms_px:.2f} px (RMS), projection uncertainty {worst:.2f} px (median where corners were seen)"
    if widening > 1.0:
        words += f"; this uncertainty is widened by {widening:.1f}, since halves of the views differ more than corner noise explains"
    if failures:
        return Verdict(False, f"Fail: {'; '.join(failures)}.", tuple(failures))
    return Verdict(True, f"Pass: {words}.", ())


def _covered_sigma_px(found: Calibration, camera: int) -> float:
    """Median projection uncertainty of distant points over the covered cells."""
    pixels = covered_pixels(found, camera)
    if not len(pixels):
        return np.inf
    sigma = projection_sigma(found.state, found.uncertainty, camera, pixels, np.inf)
    return float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else np.inf
