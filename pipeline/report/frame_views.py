"""Frames in the report: a line of the summary, marks with their pictures, residuals, orientation and writing."""

import base64
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup

from measure.annotations.lines import Line
from measure.flags import Status
from measure.geometry import UP_FROM_CAMERA
from measure.results import ON_FILM
from pipeline.drawing import svg
from pipeline.report import vectors
from pipeline.report.data import Mark, ReportData, ReportedFrame
from pipeline.report.numbers import fixed, fixed_list
from pipeline.report.vectors import LEAST_UM
from pipeline.report.verdict import suspect_rows
from pipeline.results.adjustment_record import ImageRecord
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.image_unit import ImageUnit
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.thumbnail import Thumbnail, stretch
from pipeline.types import Array

SIZE_PX = 92.0  # a picture's width and height on the page
TARGETS = 600  # largest number of target pictures; beyond it only the worst of each frame are shown
LEAST_TARGETS = 4
PICTURES = 1200  # largest number of pictures at full resolution; beyond it they are halved, to limit the file size
ARROW_PX = 34.0  # px, longest arrow

_WIDTH_PX = 1000.0  # px; data plates 20 mm wide on film of 230 mm remain legible
_LEAST_PX = 7.0  # px, smallest letters
LARGE_W = 3.0  # standardised residual above which a mark needs a look
PLOT_PX = 330.0
LONGEST_VECTOR_PX = 42.0
_LEAST_PART = 0.1  # share of the variance above which a cause is listed


def shown_marks(shots: list[ReportedFrame]) -> dict[str, list[Mark]]:
    """Select the marks of each frame that get a picture: all fiducials, and all targets or the worst of them."""
    targets = sum(not mark.is_fiducial for frame in shots for mark in frame.marks)
    most = targets if targets <= TARGETS else max(LEAST_TARGETS, TARGETS // len(shots))
    shown = {}
    for frame in shots:
        worst = sorted((mark for mark in frame.marks if not mark.is_fiducial), key=_badness, reverse=True)[:most]
        chosen = {mark.point for mark in worst}
        shown[frame.image] = [mark for mark in frame.marks if mark.is_fiducial or mark.point in chosen]
    return shown


def _badness(mark: Mark) -> tuple[bool, bool, float]:
    """Sort key, larger is worse: rejected, then weak or predicted, then the standardised residual."""
    return (mark.status == "rejected", mark.status in ("weak", "predicted"), abs(mark.w) if mark.w is not None else 0.0)


def arrow_scale(shots: list[ReportedFrame]) -> float:
    """Scale of residual arrows on thumbnails, page pixels per µm: a round number at which the longest arrow fits."""
    lengths = [float(np.hypot(*mark.residual.v_um)) for frame in shots for mark in frame.marks if mark.residual]
    return svg.round_step(ARROW_PX / max(*lengths, LEAST_UM)) if lengths else 1.0


def mark_picture(mark: Mark, thumbnail: Thumbnail, px_per_um: float, most_px: float) -> Markup:
    """Draw the picture with a crosshair at the measured centre, dashed if the mark is not an observation, and the
    residual as an arrow."""
    rows, cols = thumbnail.pixels.shape
    zoom = SIZE_PX / (max(rows, cols) * thumbnail.step_px)  # page pixels to a pixel of the scan
    width, height = cols * thumbnail.step_px * zoom, rows * thumbnail.step_px * zoom
    stretched = stretch(thumbnail.pixels)
    if max(rows, cols) > most_px:
        factor = most_px / max(rows, cols)
        stretched = np.asarray(cv2.resize(stretched, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
    _, png = cv2.imencode(".png", np.rint(stretched).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    address = "data:image/png;base64," + base64.b64encode(png.tobytes()).decode("ascii")
    drawn = [svg.tag("image", href=address, width=width, height=height, class_="chip")]
    if mark.center_px is not None:
        # The centre of the top-left thumbnail pixel lies half a thumbnail pixel inside the picture's edge.
        center = (mark.center_px - thumbnail.origin_px + 0.5 * thumbnail.step_px) * zoom
        ends = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
        starts, stops = center + 5.0 * ends, center + 17.0 * ends
        class_ = "hair" if mark.status.is_observation else "hair guess"
        drawn += [svg.strokes(starts, stops, "halo"), svg.strokes(starts, stops, class_)]
        if mark.residual:
            drawn.append(_arrow(center, mark.residual, px_per_um))
    title = f"{mark.kind} {mark.point} in {mark.image}, {mark.status}: the scan about its measured centre"
    return svg.picture(SIZE_PX, SIZE_PX, title, *drawn, class_="thumb")


def _arrow(start: Array, residual: ResidualRecord, px_per_um: float) -> Markup:
    """Draw the residual from the measured centre; comparator y points up, rows point down."""
    v = px_per_um * np.array([residual.vx_um, -residual.vy_um])
    length = float(np.hypot(*v))
    end = start + v
    shaft = svg.strokes(start[None], end[None], "arrow")
    if length < 4.0:
        return shaft
    back, side = -v / length, np.array([v[1], -v[0]]) / length
    x_head, y_head = np.stack([end + 6.0 * back + 3.0 * side, end, end + 6.0 * back - 3.0 * side], axis=1)
    return svg.strokes(start[None], end[None], "halo") + shaft + svg.line(x_head, y_head, "arrow")


def writing_picture(scan: MeasuredScan | None) -> Markup | None:
    """Draw the scan's outline with its lines of writing in place; None if none was read. Lines quoted as evidence of
    the scan orientation (pose) are highlighted."""
    if scan is None or not scan.frame.writing:
        return None
    zoom = _WIDTH_PX / max(scan.width_px, scan.height_px)
    width, height = scan.width_px * zoom, scan.height_px * zoom
    evidence = " ".join(scan.frame.pose.evidence if scan.frame.pose else ())
    drawn = [svg.line([1, width - 1, width - 1, 1], [1, 1, height - 1, height - 1], "scan", closed=True)]
    drawn += [_writing_line(line, zoom, f'"{line.text}"' in evidence) for line in scan.frame.writing]
    return svg.picture(width, height, "What is written about the frame, as it lies in the scan", *drawn, class_="film")


def _writing_line(line: Line, zoom: float, is_evidence: bool) -> Markup:
    """Draw a text over the rectangle in which it was read, rotated and mirrored as in the scan."""
    outline = [(col * zoom, row * zoom) for col, row in line.outline_px]
    cols, rows = zip(*outline, strict=True)
    center = (sum(cols) / len(cols), sum(rows) / len(rows))
    up = UP_FROM_CAMERA[line.pose]
    sides = max(cols) - min(cols), max(rows) - min(rows)
    size = max(0.8 * min(sides), _LEAST_PX)
    # SVG and the glyphs have y down, `up` has y up: hence the signs.
    matrix = (up[0, 0], -up[1, 0], -up[0, 1], up[1, 1], *center)
    text = svg.tag(
        "text",
        line.text,
        transform=f"matrix({' '.join(f'{value:g}' for value in matrix)})",
        class_="evidence" if is_evidence else "read",
        font_size=f"{size:.1f}",
        text_anchor="middle",
        dominant_baseline="central",
        textLength=f"{max(sides):.1f}",
        lengthAdjust="spacingAndGlyphs",
    )
    return svg.line(cols, rows, "evidence" if is_evidence else "read", closed=True) + text


@dataclass(frozen=True)
class Card:
    """Mark in the report. picture: None without a thumbnail; causes: contributions to its standard deviation in the
    scan, as name, px and meaning; empty if there is only one."""

    mark: Mark
    picture: Markup | None
    causes: tuple[tuple[str, str, str], ...]
    is_suspect: bool
    unit: ImageUnit

    @property
    def needs_review(self) -> bool:
        """Whether the mark is suspect, not plainly measured, or has a large residual."""
        return self.is_suspect or self.mark.status is not Status.MEASURED or abs(self.mark.w or 0.0) > LARGE_W


@dataclass(frozen=True)
class FrameView:
    """Frame in the report.

    Attributes
    ----------
    fiducials, targets : numbers of observed marks, in words.
    rms : of the residuals in x and y, in `unit`; None without an adjustment.
    plot, writing : drawings of the residuals and of the writing around the frame.
    stored : record in adjustment.json, None if not adjusted.
    """

    id: str
    frame: ReportedFrame
    unit: ImageUnit
    fiducials: str
    targets: str
    rms: tuple[float, float] | None
    largest_w: float | None
    cards: tuple[Card, ...]
    plot: Markup | None
    writing: Markup | None
    stored: ImageRecord | None

    @property
    def is_lost(self) -> bool:
        """Whether none of its marks is observed."""
        return not any(mark.status.is_observation for mark in self.frame.marks)

    @property
    def badness(self) -> tuple[bool, float, int]:
        """Sort key, larger is worse: no mark observed, then residuals, then number of open marks."""
        return self.is_lost, math.hypot(*(self.rms or (0.0,))), sum(mark.needs_review for mark in self.frame.marks)


def frame_views(data: ReportData, shots: list[ReportedFrame], every_mark: bool = False) -> list[FrameView]:
    """Views of all frames, the worst first, drawn to common scales. every_mark: show all marks, whatever their
    number."""
    shown = {frame.image: list(frame.marks) for frame in shots} if every_mark else shown_marks(shots)
    px_per_um = arrow_scale(shots)
    most_px = SIZE_PX if sum(len(marks) for marks in shown.values()) <= PICTURES else 0.5 * SIZE_PX
    residuals = data.adjustment.residuals if data.adjustment else ()
    vectors_px_per_um = vectors.VectorField.from_residuals(residuals).scale(LONGEST_VECTOR_PX) if residuals else 1.0
    suspects = suspect_rows(data.adjustment) if data.adjustment else frozenset[ResidualRecord]()
    views = []
    for number, frame in enumerate(shots, 1):
        rows, unit = data.residuals_by_image.get(frame.image, []), data.unit_of_image(frame.image)
        rms = unit.per_um * np.sqrt(np.mean(np.square([row.v_um for row in rows]), axis=0)) if rows else None
        views.append(
            FrameView(
                id=f"frame-{number}",
                frame=frame,
                unit=unit,
                fiducials=_observed_share([mark for mark in frame.marks if mark.is_fiducial]),
                targets=_observed_share([mark for mark in frame.marks if mark.kind not in ON_FILM]),
                rms=None if rms is None else (float(rms[0]), float(rms[1])),
                largest_w=max((abs(row.w) for row in rows if np.isfinite(row.w)), default=None),
                cards=tuple(_card(data, mark, px_per_um, most_px, suspects) for mark in shown[frame.image]),
                plot=_residual_plot(data, frame.image, rows, vectors_px_per_um, suspects) if rows else None,
                writing=writing_picture(frame.scan),
                stored=data.adjustment.images.get(frame.image) if data.adjustment else None,
            )
        )
    return sorted(views, key=lambda view: view.badness, reverse=True)


def _card(data: ReportData, mark: Mark, px_per_um: float, most_px: float, suspects: Collection[ResidualRecord]) -> Card:
    thumbnail = data.thumbnail(mark.image, mark.point, mark.kind) if data.thumbnail else None
    picture = mark_picture(mark, thumbnail, px_per_um, most_px) if thumbnail else None
    sigmas = {} if mark.covariance is None else mark.covariance.sigmas_px
    least = _LEAST_PART * sum(sigma**2 for sigma in sigmas.values())
    parts = [(cause, sigma) for cause, sigma in sigmas.items() if sigma**2 >= least]
    causes = tuple((cause.shown, fixed(sigma, 3), cause.meaning) for cause, sigma in parts)
    is_suspect, unit = mark.residual in suspects, data.unit_of_image(mark.image)
    return Card(mark, picture, causes if len(causes) > 1 else (), is_suspect, unit)


def _residual_plot(
    data: ReportData,
    image: str,
    rows: Sequence[ResidualRecord],
    px_per_um: float,
    suspects: Collection[ResidualRecord],
) -> Markup:
    """Plot the residuals of one image, each with its name and numbers as a tooltip."""
    field, unit = vectors.VectorField.from_residuals(rows), data.unit_of_image(image)
    frame_mm = data.frame_mm.get(data.adjustment.image_camera(image)) if data.adjustment else None
    on = vectors.plane(field.places_mm, frame_mm, PLOT_PX, unit)
    marks = []
    for start, end, row in zip(*field.ends(on, px_per_um), rows, strict=True):
        kind = "suspect" if row in suspects else "fiducial" if row.kind == "fiducial" else "target"
        v = fixed_list((unit.per_um * v for v in row.v_um), unit.decimals, sign=True)
        hint = f"{row.kind} {row.point}: v = ({v}) {unit.short_name} in the scan, w = {fixed(row.w, 1)}"
        marks.append(svg.tag("g", svg.tag("title", hint), vectors.strokes_and_dots(start[None], end[None], kind)))
    return on.picture(f"Residual vectors of {image}", px_per_um, *marks)


def _observed_share(marks: list[Mark]) -> str:
    """Number of observed marks in words, such as "8 of 8", with the statuses of those not plainly measured."""
    if not marks:
        return "–"
    counts = {status: sum(mark.status is status for mark in marks) for status in Status}
    observed = sum(mark.status.is_observation for mark in marks)
    others = ", ".join(f"{n} {status}" for status, n in counts.items() if n and status is not Status.MEASURED)
    return f"{observed} of {len(marks)}" + (f" ({others})" if others else "")
