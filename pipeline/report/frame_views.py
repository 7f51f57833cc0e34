"""What the report shows of each frame: a line of the summary, its marks, residuals, orientation and writing."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from measure.annotations.fields import Line
from measure.flags import CAUSE_MEANING, Status
from measure.geometry import up_from_camera
from measure.results import Covariance
from pipeline.drawing import svg
from pipeline.report import mark_pictures, vectors
from pipeline.report.data import ReportData
from pipeline.report.marks import Frame, Mark
from pipeline.report.numbers import fixed, value_and_sigma
from pipeline.report.verdict import suspect_rows
from pipeline.results.adjustment_record import Quantity, ResidualRecord
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.thumbnail import Thumbnail

_WIDTH_PX = 1000.0  # plates of 20 mm on film of 230 are read
_LEAST_PX = 7.0  # of letters
OPEN_FRAMES = 12  # with more frames, only those with a lost mark are unfolded
PLOT_PX = 330.0
LONGEST_VECTOR_PX = 42.0
_LEAST_TOLD_PX = 0.0005


def written(scan: MeasuredScan | None) -> Markup | None:
    """The scan's outline with its lines of writing in place; None where none was read. Those that the pose's evidence
    quotes stand out."""
    if scan is None or not scan.frame.writing:
        return None
    zoom = _WIDTH_PX / max(scan.width_px, scan.height_px)
    width, height = scan.width_px * zoom, scan.height_px * zoom
    evidence = " ".join(scan.frame.pose.evidence if scan.frame.pose else ())
    drawn = [svg.line([1, width - 1, width - 1, 1], [1, 1, height - 1, height - 1], "scan", closed=True)]
    drawn += [_writing_line(line, zoom, f'"{line.text}"' in evidence) for line in scan.frame.writing]
    return svg.picture(width, height, "What is written about the frame, as it lies in the scan", *drawn, class_="film")


def _writing_line(line: Line, zoom: float, listed_causes: bool) -> Markup:
    """The text over the rectangle in which it was read, turned and mirrored as it lies."""
    outline = [(col * zoom, row * zoom) for col, row in line.outline_px]
    cols, rows = zip(*outline, strict=True)
    center = (sum(cols) / len(cols), sum(rows) / len(rows))
    up = up_from_camera(line.pose)
    sides = max(cols) - min(cols), max(rows) - min(rows)
    size = max(0.8 * min(sides), _LEAST_PX)
    # SVG counts rows downwards, and so do letters.
    matrix = (up[0, 0], -up[1, 0], -up[0, 1], up[1, 1], *center)
    text = svg.tag(
        "text",
        line.text,
        transform=f"matrix({' '.join(f'{value:g}' for value in matrix)})",
        class_="told" if listed_causes else "read",
        font_size=f"{size:.1f}",
        text_anchor="middle",
        dominant_baseline="central",
        textLength=f"{max(sides):.1f}",
        lengthAdjust="spacingAndGlyphs",
    )
    return svg.line(cols, rows, "told" if listed_causes else "read", closed=True) + text


@dataclass(frozen=True)
class Card:
    """A mark's picture and numbers. picture: None where there is no scan to cut it from; causes: what sigma consists
    of; by_edges: how far off the second method puts it."""

    mark: Mark
    picture: Markup | None
    sigma: str
    causes: tuple[tuple[str, str, str], ...]
    by_edges: str
    residual: str
    w: str
    is_suspect: bool


@dataclass(frozen=True)
class FrameView:
    """A frame, ready to print. rms_um: of its residuals along x and y; None where it has none."""

    frame: Frame
    fiducials: str
    targets: str
    rms_um: tuple[float, float] | None
    largest_w: float | None
    cards: tuple[Card, ...]
    hidden: int
    plot: Markup | None
    writing: Markup | None
    orientation: tuple[tuple[str, str, str], ...]
    transformation: tuple[tuple[str, str, str], ...]
    is_open: bool


def frame_views(data: ReportData, shots: list[Frame], every_mark: bool = False) -> list[FrameView]:
    """All frames, drawn to the same scales. every_mark: picture them all, however many."""
    shown = {frame.image: list(frame.marks) for frame in shots} if every_mark else mark_pictures.shown_marks(shots)
    px_per_um, most_px = thumbnail_scale(shots), mark_pictures.stored_px(shown)
    by_image = residuals_by_image(data)
    suspects = suspect_rows(data.adjustment) if data.adjustment else frozenset[ResidualRecord]()
    plots = _plots(data, by_image, suspects, [frame.image for frame in shots if frame.image in by_image])
    views = []
    for frame in shots:
        stored = data.adjustment.images.get(frame.image) if data.adjustment else None
        residuals = by_image.get(frame.image, [])
        cards = tuple(_card(mark, data.thumbnail, px_per_um, most_px, suspects) for mark in shown[frame.image])
        views.append(
            FrameView(
                frame=frame,
                fiducials=_observed_share([mark for mark in frame.marks if mark.is_fiducial]),
                targets=_observed_share([mark for mark in frame.marks if not mark.is_fiducial]),
                rms_um=_rms_um(residuals),
                largest_w=max((abs(row.w) for row in residuals if np.isfinite(row.w)), default=None),
                cards=cards,
                hidden=len(frame.marks) - len(cards),
                plot=plots.get(frame.image),
                writing=written(frame.scan),
                orientation=_quantities(stored.exterior.elements) if stored else (),
                transformation=_quantities(stored.transformation.parameters) if stored else (),
                is_open=len(shots) <= OPEN_FRAMES or (data.totals is None and _lost_fiducial(frame)),
            )
        )
    return views


def thumbnail_scale(shots: list[Frame]) -> float:
    """Page pixels to 1 um of the residual arrows on the marks' pictures."""
    return mark_pictures.arrow_scale([mark for frame in shots for mark in frame.marks])


def residuals_by_image(data: ReportData) -> dict[str, list[ResidualRecord]]:
    rows: dict[str, list[ResidualRecord]] = defaultdict(list)
    for row in data.adjustment.residuals if data.adjustment else ():
        rows[row.image].append(row)
    return dict(rows)


def _plots(
    data: ReportData,
    by_image: dict[str, list[ResidualRecord]],
    suspects: Collection[ResidualRecord],
    images: list[str],
) -> dict[str, Markup]:
    stored = data.adjustment
    if stored is None or not by_image:
        return {}
    scale = vectors.VectorField.of_residuals(stored.residuals).scale(LONGEST_VECTOR_PX)
    frame_mm = {image: data.frame_mm.get(stored.camera_of(image)) for image in images}
    return {
        image: vectors.image_plot(image, by_image[image], frame_mm[image], PLOT_PX, scale, suspects) for image in images
    }


def _card(
    mark: Mark,
    picture_of: Callable[[str, str, str], Thumbnail | None] | None,
    px_per_um: float,
    most_px: float,
    suspects: Collection[ResidualRecord],
) -> Card:
    thumbnail = picture_of(mark.image, mark.point, mark.kind) if picture_of else None
    residual = mark.residual
    return Card(
        mark=mark,
        picture=mark_pictures.drawn(mark, thumbnail, px_per_um, most_px) if thumbnail else None,
        sigma=_sigma(mark),
        causes=_causes(mark.covariance),
        by_edges=_edge_offset(mark.quality),
        residual=", ".join(fixed(v, 1, sign=True) for v in residual.v_um) if residual else "",
        w=fixed(mark.w, 1, sign=True) if mark.w is not None else "no check" if residual else "",
        is_suspect=residual in suspects,
    )


def _edge_offset(quality: Mapping[str, float]) -> str:
    if "second_method_sigmas" not in quality:
        return ""
    off = (fixed(quality[f"second_method_{axis}_px"], 3, sign=True) for axis in ("col", "row"))
    return f"{', '.join(off)} px; {fixed(quality['second_method_sigmas'], 1)} σ"


def _sigma(mark: Mark) -> str:
    parts = []
    if mark.sigma_um is not None:
        parts.append(" × ".join(fixed(sigma, 1) for sigma in mark.sigma_um) + " µm")
    if mark.covariance is not None:
        parts.append(" × ".join(fixed(sigma, 3) for sigma in np.sqrt(np.diag(mark.covariance.px2))) + " px")
    return "; ".join(parts)


def _causes(covariance: Covariance | None) -> tuple[tuple[str, str, str], ...]:
    """What the standard deviation in the scan consists of: cause, size in px, meaning; nothing where it has one cause.
    A thousandth of a pixel is the last digit that is told."""
    sigmas = {} if covariance is None else covariance.sigmas_px
    listed_causes = {cause: sigma for cause, sigma in sigmas.items() if sigma >= _LEAST_TOLD_PX}
    return (
        tuple((str(cause), fixed(sigma, 3), CAUSE_MEANING[cause]) for cause, sigma in listed_causes.items())
        if len(listed_causes) > 1
        else ()
    )


def _observed_share(marks: list[Mark]) -> str:
    """ "8 of 8", with what became of the others."""
    if not marks:
        return "–"
    counts = {status: sum(mark.status is status for mark in marks) for status in Status}
    observed = counts[Status.MEASURED] + counts[Status.WEAK]
    others = ", ".join(
        f"{number} {status}" for status, number in counts.items() if number and status is not Status.MEASURED
    )
    return f"{observed} of {len(marks)}" + (f" ({others})" if others else "")


def _rms_um(residuals: list[ResidualRecord]) -> tuple[float, float] | None:
    if not residuals:
        return None
    v = np.array([row.v_um for row in residuals])
    x, y = np.sqrt((v**2).mean(axis=0))
    return float(x), float(y)


def _quantities(entries: Mapping[str, Quantity]) -> tuple[tuple[str, str, str], ...]:
    return tuple(
        (name, *value_and_sigma(each.value, each.sigma)) for name, each in entries.items() if np.isfinite(each.value)
    )


def _lost_fiducial(frame: Frame) -> bool:
    return any(mark.is_fiducial and mark.is_open for mark in frame.marks)
