"""Is a calibration good enough to use? A sentence, and the numbers behind it."""

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
"""Halves of the views differ by twice the whole's standard deviation: four times that is no chance."""
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
    """Judge a calibration by what depth and reconstruction need.

    Args:
        found: with its covariances widened by the check.
        check: of its halves.
        against: further reasons against it.
    """
    failures = list(against)
    widening = 1.0 if check is None else check.widening
    for c, camera in enumerate(found.cameras):
        who = "" if len(found.cameras) == 1 else f"{('left', 'right')[min(c, 1)]} camera: "
        used = sum(state is ViewState.USED for state in found.view_states[c])
        if used < LEAST_VIEWS:
            failures.append(f"{who}only {used} views are used, {LEAST_VIEWS} are wanted")
        covered = coverage(found, c)
        if covered < LEAST_COVERAGE:
            failures.append(
                f"{who}corners cover {100 * covered:.0f} % of the image; beyond them the lens is guessed"
            )
        sigma = _covered_sigma_px(found, c)
        if not sigma <= MOST_SIGMA_PX:
            failures.append(f"{who}projections are known to {sigma:.2f} px only where corners were seen")
        most = max(MOST_DIFFERENCE * sigma / widening, LEAST_DIFFERENCE_PX)
        if check is not None and check.difference_px[c] > most:
            failures.append(
                f"{who}two halves of the views differ by {check.difference_px[c]:.2f} px (median), more than their "
                "errors explain: the lens has another model, or the board bends"
            )
        width, height = camera.width, camera.height
        cx, cy = camera.K[0, 2], camera.K[1, 2]
        if not (0 < cx < width and 0 < cy < height):
            failures.append(f"{who}the principal point lies outside the image")
    if found.rms_px > MOST_RMS_PX:
        failures.append(f"corners lie {found.rms_px:.2f} px off (root mean square)")
    if check is None:
        failures.append("too few views to hold some out")
    elif check.held_out_rms_px > MOST_HELD_OUT * check.fitted_rms_px:
        failures.append(
            f"views that were held out lie {check.held_out_rms_px:.2f} px off, those fitted {check.fitted_rms_px:.2f} px"
        )
    if len(found.cameras) == 2:
        relative = found.baseline_sigma() / found.rig().baseline
        if relative > MOST_BASELINE_SIGMA:
            failures.append(f"the baseline is known to {100 * relative:.1f} % only")
    worst = max(_covered_sigma_px(found, c) for c in range(len(found.cameras)))
    words = f"corners are {found.rms_px:.2f} px off, projections known to {worst:.2f} px where corners were seen (median)"
    if widening > 1.0:
        words += f"; that is {widening:.1f} times what the corners' noise explains, as halves of the views differ by so much"
    if failures:
        return Verdict(False, f"Fail: {'; '.join(failures)}.", tuple(failures))
    return Verdict(True, f"Pass: {words}.", ())


def _covered_sigma_px(found: Calibration, camera: int) -> float:
    """Median over the covered cells of how well far points' projections are known."""
    pixels = covered_pixels(found, camera)
    if not len(pixels):
        return np.inf
    sigma = projection_sigma(found.state, found.uncertainty, camera, pixels, np.inf)
    return float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else np.inf
