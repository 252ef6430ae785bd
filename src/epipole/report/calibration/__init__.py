"""The page of a calibration."""

from epipole.report.calibration.page import CalibrationPage as CalibrationPage
from epipole.report.calibration.page import render_calibration_page as render_calibration_page
