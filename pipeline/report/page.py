"""Rendering of report.html: a single file, without network access, readable without scripts and in print."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from measure import flags
from pipeline.drawing import svg
from pipeline.report import frame_problems
from pipeline.report.camera_views import camera_views, scanner_views
from pipeline.report.data import Frame, Problem, ReportData, frames
from pipeline.report.frame_views import FrameView, arrow_scale, cards_to_show, frame_views
from pipeline.report.load import totals_view
from pipeline.report.numbers import fixed, fixed_list, significant, value_and_sigma
from pipeline.report.parameters import axes_sentence, group_sentences, spoken_name
from pipeline.report.vectors import joined_view
from pipeline.report.verdict import A_PRIORI, contradiction, critical_w, judge, lens_sentences, sigma0_bounds
from pipeline.results.adjustment_record import AdjustmentRecord, PointRecord
from pipeline.results.image_unit import FILM_UNIT
from pipeline.text.files import write_atomically
from pipeline.types import Array

LIST_LIMIT = 200  # rows of a long table
LINKS = 3  # largest number of links from a problem to frames
SECTIONS = {
    "frames": "Frames",
    "coverage": "Coverage",
    "fiducials": "Fiducial marks",
    "reliability": "Reliability",
    "check": "Check against OpenCV",
    "fractions": "Histograms",
}


def write_report(data: ReportData, path: Path) -> None:
    """Write the report. Raises InputError if the file cannot be written; an earlier one is then kept."""
    write_atomically(path, render_report(data))


def write_frame_page(data: ReportData, image: str, path: Path) -> None:
    """Write the page of one image with all its marks. Raises InputError if the file cannot be written."""
    write_atomically(path, render_frame_page(data, image))


def render_frame_page(data: ReportData, image: str) -> str:
    """Render the page of one image with all its marks as HTML."""
    shots = [frame for frame in frames(data) if frame.image == image]
    context = _common(data) | _frame_context(data, shots, every_mark=True)
    up = "../" * (image.count("/") + 1)
    return _environment().get_template("frame.html.j2").render({**context, "image": image, "up": up})


def render_report(data: ReportData) -> str:
    """Render the report as HTML."""
    return _environment().get_template("report.html.j2").render(_context(data))


@cache
def _environment() -> Environment:
    """Template environment, shared by all reports of a process."""
    environment = Environment(
        loader=PackageLoader("pipeline.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["drawing_css"] = Markup(svg.style())
    words = (value_and_sigma, axes_sentence, group_sentences)
    environment.globals |= {function.__name__: function for function in words}
    environment.filters |= {"code": _code, "fixed": fixed, "fixed_list": fixed_list, "significant": significant}
    return environment


def _code(text: str) -> Markup:
    """Text in HTML, with what stands between backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _context(data: ReportData) -> dict[str, object]:
    shots = frames(data)
    adjustment = data.adjustment
    cameras = camera_views(data)
    calibrated = any(camera.is_calibrated for camera in cameras)
    places = data.totals.places_px if data.totals else frame_problems.places_px(shots)
    verdict, frame_context = judge(data), _frame_context(data, shots)
    return {
        **_common(data),
        **frame_context,
        "title": "Calibration report" if calibrated or not adjustment else "Film report",
        "calibrated": calibrated,
        "verdict": verdict,
        "problems": [_problem_view(problem, frame_context["frames"]) for problem in verdict.problems],
        "check": data.check,
        "totals": totals_view(data, shots),
        "contradiction": lambda test: contradiction(test, adjustment.cameras if adjustment else {}),
        "spoken": lambda name: spoken_name(name, adjustment.cameras if adjustment else ()),
        "cameras": cameras,
        "lens_reach": {name: sentence for name, sentence, _ in lens_sentences(data)},
        "scanners": scanner_views(data),
        "joined": [(name, joined_view(each)) for name, each in sorted(adjustment.frames.items())] if adjustment else [],
        "fractions": list(_fractions(places)),
        "least_marks": frame_problems.LEAST_MARKS,
        "sigma0_bounds": sigma0_bounds(adjustment.variance_factor.redundancy)
        if adjustment and adjustment.has_sigma0
        else None,
        "a_priori": A_PRIORI,
        "points": _points(adjustment) if adjustment else [],
        "list_limit": LIST_LIMIT,
    }


def _common(data: ReportData) -> dict[str, object]:
    return {
        "project": data.project,
        "version": version("reseau"),
        "made_from": ", ".join(f"{name} {fingerprint}" for name, fingerprint in data.made_from.items()) or "memory",
        "unit": data.unit,
        "group_unit": next(iter(data.image_units.values()), FILM_UNIT),
        "adjustment": data.adjustment,
        "critical_w": critical_w(2 * len(data.adjustment.residuals)) if data.adjustment else 0.0,
        "has_pictures": data.thumbnail is not None,
        "meaning": {status: status.meaning for status in flags.Status},
        "codes": {code: code.meaning for code in flags.Code},
    }


def _frame_context(data: ReportData, shots: list[Frame], every_mark: bool = False) -> dict[str, Any]:
    views = frame_views(data, shots, every_mark)
    cards, hidden = cards_to_show(views)
    marks = [mark for frame in shots for mark in frame.marks]
    has_fiducials = any(mark.is_fiducial for mark in marks)
    return {
        "frames": views,
        "every_mark": every_mark,
        "cards": [] if every_mark else cards,
        "hidden_cards": hidden,
        "has_orientations": has_fiducials and any(frame.scan and frame.scan.frame.pose for frame in shots),
        "has_fiducials": has_fiducials,
        "has_points": any(not mark.is_fiducial for mark in marks),
        "has_residuals": any(view.rms for view in views),
        "points_word": _points_word(shots),
        "reasons": Counter(code for frame in shots for mark in frame.marks for code in mark.codes).most_common(),
        "arrow_bar": _arrow_bar(data, shots),
    }


def _problem_view(problem: Problem, views: Sequence[FrameView]) -> dict[str, object]:
    """Problem as printed: cause, details, remedy, links (text, target) and picture of its first mark."""
    known = {view.frame.image: view for view in views}
    images = dict.fromkeys((*problem.images, *(image for image, *_ in problem.marks)))
    links = [(image, f"#{known[image].id}") for image in images if image in known][:LINKS]
    if problem.section:
        links.append((SECTIONS[problem.section], f"#{problem.section}"))
    marks = (
        card
        for image, kind, point in problem.marks
        if image in known
        for card in known[image].cards
        if (card.mark.kind, card.mark.point) == (kind, point)
    )
    picture = next((card.picture for card in marks if card.picture), None)
    words = {"cause": problem.cause, "detail": problem.detail, "remedy": problem.remedy}
    return {**words, "links": links, "picture": picture}


def _points_word(shots: list[Frame]) -> str:
    """Word for the marks other than fiducials."""
    kinds = {mark.kind for frame in shots for mark in frame.marks if not mark.is_fiducial}
    if "tie" not in kinds:
        return "targets"
    return "targets and tie points" if "target" in kinds else "tie points"


def _fractions(places: Mapping[str, Array]) -> Iterator[tuple[str, frame_problems.FractionTest, Markup]]:
    """Yield axis, test of the fractional parts and its plot; nothing without pixel positions."""
    for axis, positions in places.items():
        if len(positions):
            test = frame_problems.fraction_test(positions)
            yield axis, test, frame_problems.fraction_plot(axis, test)


def _arrow_bar(data: ReportData, shots: list[Frame]) -> tuple[float, float]:
    """Round length for the legend of the residual arrows, and its page pixels."""
    px_per_unit = arrow_scale(shots) / next(iter(data.image_units.values()), FILM_UNIT).per_um
    length = svg.round_step(40.0 / px_per_unit)
    return length, length * px_per_unit


def _points(adjustment: AdjustmentRecord) -> list[tuple[str, PointRecord]]:
    """Estimated object points, the least precise first."""
    free = [(id, point) for id, point in adjustment.points.items() if any(each.sigma != 0.0 for each in point.axes)]
    return sorted(free, key=lambda item: -np.nan_to_num([each.sigma for each in item[1].axes]).max())
