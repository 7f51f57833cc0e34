"""What the report shows of each frame: a line of the summary, pictures of its marks, its residuals, its orientation."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from measure.flags import CAUSE_MEANING, Status
from measure.results import Covariance
from pipeline.report import thumbnails, vectors
from pipeline.report.data import Json, ReportData
from pipeline.report.marks import Frame, Mark
from pipeline.report.numbers import fixed, value_and_sigma
from pipeline.report.verdict import suspect_rows
from pipeline.report.writing import written
from pipeline.results.thumbnail import Thumbnail

OPEN_FRAMES = 12  # with more frames, only those with a lost mark are unfolded
PLOT_PX = 330.0
LONGEST_VECTOR_PX = 42.0
_LEAST_TOLD_PX = 0.0005


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
    shown = {frame.image: list(frame.marks) for frame in shots} if every_mark else thumbnails.shown_marks(shots)
    px_per_um, most_px = thumbnail_scale(shots), thumbnails.stored_px(shown)
    by_image = residuals_by_image(data)
    suspect = suspect_rows(data.adjustment) if data.adjustment else []
    plots = _plots(data, by_image, suspect, [frame.image for frame in shots if frame.image in by_image])
    views = []
    for frame in shots:
        stored: Json = data.adjustment["images"].get(frame.image, {}) if data.adjustment else {}
        residuals = by_image.get(frame.image, [])
        cards = tuple(_card(mark, data.thumbnail, px_per_um, most_px, suspect) for mark in shown[frame.image])
        views.append(
            FrameView(
                frame=frame,
                fiducials=_found([mark for mark in frame.marks if mark.is_fiducial]),
                targets=_found([mark for mark in frame.marks if not mark.is_fiducial]),
                rms_um=_rms_um(residuals),
                largest_w=max((abs(row["w"]) for row in residuals if row["w"] is not None), default=None),
                cards=cards,
                hidden=len(frame.marks) - len(cards),
                plot=plots.get(frame.image),
                writing=written(frame.scan),
                orientation=_quantities(stored.get("exterior", {})),
                transformation=_quantities(stored.get("transformation", {})),
                is_open=len(shots) <= OPEN_FRAMES or (data.totals is None and _lost_fiducial(frame)),
            )
        )
    return views


def thumbnail_scale(shots: list[Frame]) -> float:
    """Page pixels to 1 um of the residual arrows on the marks' pictures."""
    return thumbnails.arrow_scale([mark for frame in shots for mark in frame.marks])


def residuals_by_image(data: ReportData) -> dict[str, list[Json]]:
    rows: dict[str, list[Json]] = defaultdict(list)
    for row in data.adjustment["residuals"] if data.adjustment else ():
        rows[row["image"]].append(row)
    return dict(rows)


def camera_of(data: ReportData, image: str) -> str:
    """The camera's name; the only one where the file does not say."""
    if not data.adjustment:
        return ""
    return str(data.adjustment["images"][image].get("camera", next(iter(data.adjustment["cameras"]))))


def _plots(
    data: ReportData, by_image: dict[str, list[Json]], suspect: list[Json], images: list[str]
) -> dict[str, Markup]:
    rows = [row for residuals in by_image.values() for row in residuals]
    if not rows:
        return {}
    scale = vectors.vector_scale(rows, LONGEST_VECTOR_PX)
    frame_mm = {image: data.frame_mm.get(camera_of(data, image)) for image in images}
    return {
        image: vectors.image_plot(
            image, by_image[image], vectors.plane(by_image[image], frame_mm[image], PLOT_PX), scale, suspect
        )
        for image in images
    }


def _card(
    mark: Mark,
    picture_of: Callable[[str, str, str], Thumbnail | None] | None,
    px_per_um: float,
    most_px: float,
    suspect: list[Json],
) -> Card:
    thumbnail = picture_of(mark.image, mark.point, mark.kind) if picture_of else None
    residual = mark.residual
    return Card(
        mark=mark,
        picture=thumbnails.drawn(mark, thumbnail, px_per_um, most_px) if thumbnail else None,
        sigma=_sigma(mark),
        causes=_causes(mark.covariance),
        by_edges=_by_edges(mark.quality),
        residual=f"{fixed(residual['vx_um'], 1, sign=True)}, {fixed(residual['vy_um'], 1, sign=True)}"
        if residual
        else "",
        w=fixed(mark.w, 1, sign=True) if mark.w is not None else "no check" if residual else "",
        is_suspect=residual is not None and residual in suspect,
    )


def _by_edges(quality: Mapping[str, float]) -> str:
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
    told = {cause: sigma for cause, sigma in sigmas.items() if sigma >= _LEAST_TOLD_PX}
    return (
        tuple((str(cause), fixed(sigma, 3), CAUSE_MEANING[cause]) for cause, sigma in told.items())
        if len(told) > 1
        else ()
    )


def _found(marks: list[Mark]) -> str:
    """ "8 of 8", with what became of the others."""
    if not marks:
        return "–"
    counts = {status: sum(mark.status is status for mark in marks) for status in Status}
    observed = counts[Status.MEASURED] + counts[Status.WEAK]
    others = ", ".join(
        f"{number} {status}" for status, number in counts.items() if number and status is not Status.MEASURED
    )
    return f"{observed} of {len(marks)}" + (f" ({others})" if others else "")


def _rms_um(residuals: list[Json]) -> tuple[float, float] | None:
    if not residuals:
        return None
    v = np.array([(row["vx_um"], row["vy_um"]) for row in residuals], dtype=float)
    x, y = np.sqrt((v**2).mean(axis=0))
    return float(x), float(y)


def _quantities(entries: Json) -> tuple[tuple[str, str, str], ...]:
    return tuple(
        (name, *value_and_sigma(quantity["value"], quantity["sigma"]))
        for name, quantity in entries.items()
        if isinstance(quantity, dict) and quantity["value"] is not None
    )


def _lost_fiducial(frame: Frame) -> bool:
    return any(mark.is_fiducial and mark.is_open for mark in frame.marks)
