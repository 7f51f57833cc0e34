"""What the report shows of frames that were scanned in parts: how well what joins the scans agrees."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from pipeline.report import vectors
from pipeline.report.data import ReportData
from pipeline.report.numbers import fixed
from pipeline.results.adjustment_record import JoinedFrameRecord

PLOT_PX = 420.0
LONGEST_VECTOR_PX = 40.0


@dataclass(frozen=True)
class JoinedView:
    """A frame, ready to print. rms_um: of what is between both sights of a join, in x' and y'; largest: of them, with
    its name. parts: the scans, with the standard deviation of each one's film transformation at its corners."""

    frame: str
    parts: list[tuple[str, str]]
    joins: int
    rms_um: tuple[str, str]
    largest: str
    plot: Markup | None


def joined_views(data: ReportData) -> list[JoinedView]:
    """All frames that were scanned in parts; none where there is no solution."""
    frames = data.adjustment.frames if data.adjustment else {}
    return [_view(name, frame) for name, frame in sorted(frames.items())]


def _view(name: str, frame: JoinedFrameRecord) -> JoinedView:
    parts = [(part, fixed(known.corner_sigma_um, 1)) for part, known in frame.parts.items()]
    joins = frame.joins
    if not joins:
        return JoinedView(name, parts, 0, ("–", "–"), "–", None)
    apart = vectors.VectorField.of_joins(joins)
    lengths_um = np.hypot(*apart.vectors_um.T)
    rms = np.sqrt(np.mean(apart.vectors_um**2, axis=0))
    on = vectors.plane(apart.places_mm, None, PLOT_PX)
    return JoinedView(
        name,
        parts,
        len(joins),
        (fixed(float(rms[0]), 2), fixed(float(rms[1]), 2)),
        f"{joins[int(lengths_um.argmax())].point}: {fixed(float(lengths_um.max()), 1)} µm",
        vectors.all_images_plot(apart, on, apart.scale(LONGEST_VECTOR_PX)),
    )
