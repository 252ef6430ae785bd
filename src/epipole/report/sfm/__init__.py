"""The page of a reconstruction: what it is and how far to trust it."""

from epipole.report.sfm.content import ImageRow as ImageRow
from epipole.report.sfm.content import ReportContent as ReportContent
from epipole.report.sfm.page import render_report as render_report
