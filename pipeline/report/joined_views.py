"""What the report shows of frames that were scanned in parts: how well what joins the scans agrees."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from pipeline.report import vectors
from pipeline.report.data import Json, ReportData
from pipeline.report.numbers import fixed

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
    frames: Json = (data.adjustment or {}).get("frames", {})
    return [_view(name, frame) for name, frame in sorted(frames.items())]


def _view(name: str, frame: Json) -> JoinedView:
    parts = [(part, fixed(known["corner_sigma_um"], 1)) for part, known in frame["parts"].items()]
    joins = frame["joins"]
    if not joins:
        return JoinedView(name, parts, 0, ("–", "–"), "–", None)
    apart_um = np.array([(join["dx_um"], join["dy_um"]) for join in joins])
    worst = joins[int(np.argmax(np.hypot(*apart_um.T)))]
    rows = [
        {
            "kind": "join",
            "camera_x_mm": join["x_mm"],
            "camera_y_mm": join["y_mm"],
            "camera_vx_um": join["dx_um"],
            "camera_vy_um": join["dy_um"],
        }
        for join in joins
    ]
    rms = np.sqrt(np.mean(apart_um**2, axis=0))
    return JoinedView(
        name,
        parts,
        len(joins),
        (fixed(float(rms[0]), 2), fixed(float(rms[1]), 2)),
        f"{worst['point']}: {fixed(float(np.hypot(worst['dx_um'], worst['dy_um'])), 1)} µm",
        vectors.all_images_plot(
            rows, vectors.plane(rows, None, PLOT_PX), vectors.vector_scale(rows, LONGEST_VECTOR_PX)
        ),
    )
