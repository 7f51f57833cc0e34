"""report.html: the verdict, the problems, all marks, and explanations of the numbers."""

from pipeline.report.data import ReportData, ReportedProblem
from pipeline.report.page import render_report, write_report
from pipeline.report.verdict import ReportVerdict, judge
from pipeline.results.thumbnail import Thumbnail

__all__ = ["ReportData", "ReportVerdict", "ReportedProblem", "Thumbnail", "judge", "render_report", "write_report"]
