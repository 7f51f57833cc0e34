"""report.html: the verdict, the problems, every mark, and what each number means."""

from pipeline.report.data import Problem, ReportData
from pipeline.report.page import render_report, write_report
from pipeline.report.verdict import ReportVerdict, judge
from pipeline.results.thumbnail import Thumbnail

__all__ = ["Problem", "ReportData", "ReportVerdict", "Thumbnail", "judge", "render_report", "write_report"]
