"""What the page of a calibration shows."""

from __future__ import annotations

from pathlib import Path

from epipole._version import __version__
from epipole.pipelines.calibration.files import CalibrationRun
from epipole.report.calibration_page import CalibrationPage, render_calibration_page


def render_page(run: CalibrationRun) -> str:
    """The report as one HTML page."""
    names = tuple(tuple(path.name for path in own) for own in run.pictures)
    problems = {Path(name).name: reason for name, reason in run.problems.items()}
    return render_calibration_page(
        CalibrationPage(run.calibration, run.check, run.verdict, names, problems, __version__)
    )
