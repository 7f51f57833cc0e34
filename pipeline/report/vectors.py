"""Residuals as vectors over the camera frame, of one image and of all."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.drawing import svg
from pipeline.report.data import Json
from pipeline.report.numbers import fixed

Array = NDArray[np.float64]

MARGIN_PX = 26.0
FOOT_PX = 30.0
LEAST_UM = 0.01  # a residual drawn at full length: without redundancy they are rounding errors


@dataclass(frozen=True)
class Plane:
    """The camera frame on the page: corners (2, 2) lower left and upper right in mm, y up."""

    corners_mm: Array
    width_px: float

    @property
    def px_per_mm(self) -> float:
        return (self.width_px - 2.0 * MARGIN_PX) / float(self.corners_mm[1, 0] - self.corners_mm[0, 0])

    @property
    def height_px(self) -> float:
        return float(self.corners_mm[1, 1] - self.corners_mm[0, 1]) * self.px_per_mm + 2.0 * MARGIN_PX

    def page(self, xy_mm: Array) -> Array:
        """(n, 2) camera mm to page pixels, y down."""
        low_x, high_y = self.corners_mm[0, 0], self.corners_mm[1, 1]
        return MARGIN_PX + self.px_per_mm * np.stack([xy_mm[:, 0] - low_x, high_y - xy_mm[:, 1]], axis=1)

    def drawn(self) -> Markup:
        (x0, y0), (x1, y1) = self.page(self.corners_mm)
        return svg.tag("rect", x=x0, y=y1, width=x1 - x0, height=y0 - y1, class_="frame")


def plane(residuals: list[Json], frame_mm: tuple[float, float] | None, width_px: float) -> Plane:
    """The camera's frame, or where it is not known or not about the origin (a digital camera), what is observed."""
    xy = places_mm(residuals)
    low, high = xy.min(axis=0), xy.max(axis=0)
    half = 0.5 * np.array(frame_mm) if frame_mm is not None else np.zeros(2)
    if np.all(np.abs([low, high]) <= half):
        low, high = -half, half
    return plane_about(low, high, width_px)


def plane_about(low: Array, high: Array, width_px: float) -> Plane:
    """The rectangle between two corners (2,), with a little room about it."""
    # A single point, or points in a row, still need a plane to stand in.
    room = 0.02 * max(float(np.max(high - low)), 1.0)
    return Plane(np.stack([low - room, high + room]), width_px)


def places_mm(residuals: list[Json]) -> Array:
    """(n, 2) where the observations lie in the camera frame."""
    return np.array([(row["camera_x_mm"], row["camera_y_mm"]) for row in residuals], dtype=float)


def _vectors_um(residuals: list[Json]) -> Array:
    """(n, 2) the residuals along the camera's axes."""
    return np.array([(row["camera_vx_um"], row["camera_vy_um"]) for row in residuals], dtype=float)


def vector_scale(residuals: list[Json], longest_px: float) -> float:
    """Page pixels to 1 um, a round number: all but the largest per cent are shorter than `longest_px`."""
    length = float(np.percentile(np.hypot(*_vectors_um(residuals).T), 99.0))
    return svg.round_step(longest_px / max(length, LEAST_UM))


def image_plot(image: str, residuals: list[Json], on: Plane, px_per_um: float, suspect: list[Json]) -> Markup:
    """The residuals of one image, each with its name and numbers to point at."""
    starts = on.page(places_mm(residuals))
    ends = starts + px_per_um * _vectors_um(residuals) * (1.0, -1.0)
    marks = [
        svg.tag("g", svg.tag("title", _hint(row)), _stroke(start, end, row, suspect))
        for start, end, row in zip(starts, ends, residuals, strict=True)
    ]
    return svg.picture(
        on.width_px,
        on.height_px + FOOT_PX,
        f"Residual vectors of {image}",
        on.drawn(),
        *marks,
        scale_bar(on, px_per_um),
    )


def all_images_plot(residuals: list[Json], on: Plane, px_per_um: float) -> Markup:
    """The residuals of all images in one frame: what they have in common is the camera's, not the film's."""
    starts = on.page(places_mm(residuals))
    ends = starts + px_per_um * _vectors_um(residuals) * (1.0, -1.0)
    is_fiducial = np.array([row["kind"] == "fiducial" for row in residuals])
    return svg.picture(
        on.width_px,
        on.height_px + FOOT_PX,
        "Residual vectors of all images over the camera frame",
        on.drawn(),
        svg.strokes(starts[~is_fiducial], ends[~is_fiducial], "vector target"),
        svg.strokes(starts[~is_fiducial], starts[~is_fiducial], "dot target"),
        svg.strokes(starts[is_fiducial], ends[is_fiducial], "vector fiducial"),
        svg.strokes(starts[is_fiducial], starts[is_fiducial], "dot fiducial"),
        scale_bar(on, px_per_um),
    )


def scale_bar(on: Plane, px_per_um: float) -> Markup:
    """A bar of a round length in um, and under it one of mm."""
    um, mm = svg.round_step(60.0 / px_per_um), svg.round_step(60.0 / on.px_per_mm)
    x = MARGIN_PX
    bars = Markup("")
    for y, length, text in (
        (on.height_px + 4.0, um * px_per_um, f"{um:g} µm (vectors)"),
        (on.height_px + 19.0, mm * on.px_per_mm, f"{mm:g} mm (frame)"),
    ):
        bars += svg.line((x, x, x, x + length, x + length, x + length), (y - 3, y + 3, y, y, y - 3, y + 3), "bar")
        bars += svg.words(x + length + 6.0, y + 4.0, text, "tick")
    return bars


def _stroke(start: Array, end: Array, row: Json, suspect: list[Json]) -> Markup:
    kind = "suspect" if row in suspect else "fiducial" if row["kind"] == "fiducial" else "target"
    at, to = start[None], end[None]
    return svg.strokes(at, to, f"vector {kind}") + svg.strokes(at, at, f"dot {kind}")


def _hint(row: Json) -> str:
    vx, vy = fixed(row["vx_um"], 1, sign=True), fixed(row["vy_um"], 1, sign=True)
    return f"{row['kind']} {row['point']}: v = ({vx}, {vy}) µm in the scan, w = {fixed(row['w'], 1)}"
