"""The page of a stereo pair."""

from epipole.report.stereo.page import StereoPage as StereoPage
from epipole.report.stereo.page import render_stereo_page as render_stereo_page
