"""The report: one self-contained HTML page that shows what a reconstruction is and how far to trust it."""

from epipole.report.content import ImageRow as ImageRow
from epipole.report.content import ReportContent as ReportContent
from epipole.report.page import render_report as render_report
