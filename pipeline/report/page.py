"""Rendering of report.html: a single file, without network access, readable without scripts and in print."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from measure import Status, flags
from pipeline.archive.verdicts import scan_counts
from pipeline.drawing import svg
from pipeline.report import frame_problems
from pipeline.report.camera_views import camera_view, joined_view, scanner_view
from pipeline.report.data import ReportData, ReportedFrame, ReportedProblem, ReportSection, frames
from pipeline.report.fiducials import correction_sentence, figure_plot
from pipeline.report.frame_views import FrameView, arrow_scale, frame_views
from pipeline.report.load import BEST_FIRST, frame_counts, verdict_counts
from pipeline.report.numbers import fixed, fixed_list, significant, value_and_sigma
from pipeline.report.parameters import axes_sentence, group_sentences, spoken_name
from pipeline.report.verdict import A_PRIORI, contradiction, critical_w, judge, lens_sentences, sigma0_bounds
from pipeline.results.adjustment_record import AdjustmentRecord, PointRecord
from pipeline.text.files import write_atomically

LIST_LIMIT = 200  # rows of a long table
LINKS = 3  # largest number of links from a problem to frames
MOST_CARDS = 60  # largest number of marks that need a look
SECTIONS: Mapping[ReportSection, str] = {
    "camera": "Camera",
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


def render_report(data: ReportData) -> str:
    """Render the report as HTML."""
    shots, adjustment = frames(data), data.adjustment
    cameras, scanners, joined = [], [], []
    if adjustment:
        cameras = [camera_view(data, adjustment, *each) for each in adjustment.cameras.items()]
        scanners = [scanner_view(adjustment, data.covariance, *each) for each in adjustment.scanners.items()]
        joined = [joined_view(*each) for each in sorted(adjustment.frames.items())]
    calibrated = any(camera.is_calibrated for camera in cameras)
    places = data.totals.places_px if data.totals else frame_problems.places_px(shots)
    tests = {axis: frame_problems.fraction_test(positions) for axis, positions in places.items() if len(positions)}
    verdict, frame_context = judge(data), _frame_context(data, shots)
    has_sigma0 = adjustment is not None and adjustment.has_sigma0
    context = {
        **_common(data),
        **frame_context,
        "title": "Calibration report" if calibrated or not adjustment else "Film report",
        "calibrated": calibrated,
        "verdict": verdict,
        "problems": [(problem, *_links_and_picture(problem, frame_context["frames"])) for problem in verdict.problems],
        "check": data.check,
        "totals": _totals(data, shots) if data.totals or data.is_film_alone else None,
        "cameras": cameras,
        "lens_reach": {name: sentence for name, sentence, _ in lens_sentences(data)},
        "scanners": scanners,
        "joined": joined,
        "fractions": [(axis, test, frame_problems.fraction_plot(axis, test)) for axis, test in tests.items()],
        "sigma0_bounds": sigma0_bounds(adjustment.variance_factor.redundancy) if adjustment and has_sigma0 else None,
        "points": _points(adjustment) if adjustment else [],
    }
    return _environment().get_template("report.html.j2").render(context)


def render_frame_page(data: ReportData, image: str) -> str:
    """Render the page of one image with all its marks as HTML."""
    shots = [frame for frame in frames(data) if frame.image == image]
    context = _common(data) | _frame_context(data, shots, every_mark=True)
    up = "../" * (image.count("/") + 1)
    return _environment().get_template("frame.html.j2").render({**context, "image": image, "up": up})


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
    functions = (
        value_and_sigma,
        axes_sentence,
        group_sentences,
        spoken_name,
        contradiction,
        correction_sentence,
        figure_plot,
    )
    environment.globals |= {function.__name__: function for function in functions}
    environment.globals |= {"drawing_css": Markup(svg.style()), "a_priori": A_PRIORI, "list_limit": LIST_LIMIT}
    environment.globals |= {"statuses": flags.Status, "least_marks": frame_problems.LEAST_MARKS}
    environment.filters |= {"code": _code, "fixed": fixed, "fixed_list": fixed_list, "significant": significant}
    return environment


def _code(text: str) -> Markup:
    """Text in HTML, with what stands between backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _common(data: ReportData) -> dict[str, object]:
    """What the report and the page of a frame share."""
    return {
        "project": data.project,
        "version": version("reseau"),
        "made_from": ", ".join(f"{name} {fingerprint}" for name, fingerprint in data.made_from.items()) or "memory",
        "unit": data.unit,
        "group_unit": data.common_unit,
        "is_in_pixels": bool(data.image_units),
        "adjustment": data.adjustment,
        "critical_w": critical_w(2 * len(data.adjustment.residuals)) if data.adjustment else 0.0,
        "has_pictures": data.thumbnail is not None,
    }


def _frame_context(data: ReportData, shots: list[ReportedFrame], every_mark: bool = False) -> dict[str, Any]:
    """Frames and their marks for the templates."""
    views = frame_views(data, shots, every_mark)
    cards = [card for view in views for card in view.cards if card.needs_review]  # of the worst frame first
    found = {view.frame.image for view in views if not view.is_lost}
    # A frame that was not found is one problem, and of a board's points many may lie outside a picture.
    cards = [
        card
        for card in cards
        if card.mark.status is not Status.ABSENT or (card.mark.is_fiducial and card.mark.image in found)
    ]
    marks = [mark for frame in shots for mark in frame.marks]
    has_fiducials = any(mark.is_fiducial for mark in marks)
    kinds = {mark.kind for mark in marks if not mark.is_fiducial}
    points_word = "targets"
    if "tie" in kinds:
        points_word = "targets and tie points" if "target" in kinds else "tie points"
    px_per_unit = arrow_scale(shots) / data.common_unit.per_um
    arrow = svg.round_step(40.0 / px_per_unit)
    return {
        "frames": views,
        "every_mark": every_mark,
        "cards": [] if every_mark else cards[:MOST_CARDS],
        "hidden_cards": len(cards[MOST_CARDS:]),
        "has_orientations": has_fiducials and any(frame.scan and frame.scan.frame.pose for frame in shots),
        "has_fiducials": has_fiducials,
        "has_points": bool(kinds),
        "has_residuals": any(view.rms for view in views),
        "points_word": points_word,
        "reasons": Counter(code for mark in marks for code in mark.codes).most_common(),
        "arrow_bar": (arrow, arrow * px_per_unit),  # length for the legend of the residual arrows, and its page pixels
    }


def _totals(data: ReportData, shots: Sequence[ReportedFrame]) -> dict[str, object]:
    """Numbers of all frames, of a report that does not show all or of which only fiducials were adjusted."""
    counts, total = verdict_counts(data, shots), frame_counts(data, shots)
    return {
        "sentence": f"{scan_counts(total)}.",
        "shown": len({*(data.measurement or {}), *(row.image for row in data.comparator)}) if data.totals else None,
        "verdicts": [each for each in BEST_FIRST if total[each]],
        "rows": sorted(counts.items()),
        "all": total,
    }


def _links_and_picture(
    problem: ReportedProblem, views: Sequence[FrameView]
) -> tuple[list[tuple[str, str]], Markup | None]:
    """Links of a problem, as text and target, and the picture of its first mark that has one."""
    known = {view.frame.image: view for view in views}
    images = dict.fromkeys((*problem.images, *(image for image, *_ in problem.marks)))
    links = [(image, f"#{known[image].id}") for image in images if image in known][:LINKS]
    if problem.section:
        links.append((SECTIONS[problem.section], f"#{problem.section}"))
    pictures = (
        card.picture
        for image, kind, point in problem.marks
        if image in known
        for card in known[image].cards
        if (card.mark.kind, card.mark.point) == (kind, point) and card.picture
    )
    return links, next(pictures, None)


def _points(adjustment: AdjustmentRecord) -> list[tuple[str, PointRecord]]:
    """Estimated object points, the least precise first."""
    free = [(id, point) for id, point in adjustment.points.items() if any(each.sigma != 0.0 for each in point.axes)]
    return sorted(free, key=lambda item: -np.nan_to_num([each.sigma for each in item[1].axes]).max())
