"""Pictures of marks in the scan, with the measured centre and its residual overlaid."""

import base64

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.drawing import svg
from pipeline.report.marks import Frame, Mark
from pipeline.report.vectors import LEAST_UM
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.thumbnail import Thumbnail

SIZE_PX = 92.0  # a picture's width and height on the page
TARGETS = 600  # largest number of target pictures; beyond it only the worst of each frame are shown
LEAST_TARGETS = 4
PICTURES = 1200  # largest number of pictures at full resolution; beyond it they are halved, to limit the file size
ARROW_PX = 34.0  # px, longest arrow


def shown_marks(shots: list[Frame]) -> dict[str, list[Mark]]:
    """Select the marks of each frame that get a picture: all fiducials, and all targets or the worst of them."""
    targets = sum(not mark.is_fiducial for frame in shots for mark in frame.marks)
    most = targets if targets <= TARGETS else max(LEAST_TARGETS, TARGETS // len(shots))
    return {frame.image: _worst(frame, most) for frame in shots}


def stored_px(shown: dict[str, list[Mark]]) -> float:
    """Largest stored width of a picture."""
    return SIZE_PX if sum(len(marks) for marks in shown.values()) <= PICTURES else 0.5 * SIZE_PX


def _worst(frame: Frame, most: int) -> list[Mark]:
    targets = sorted((mark for mark in frame.marks if not mark.is_fiducial), key=_badness, reverse=True)[:most]
    chosen = {mark.point for mark in targets}
    return [mark for mark in frame.marks if mark.is_fiducial or mark.point in chosen]


def _badness(mark: Mark) -> tuple[bool, bool, float]:
    """Sort key, larger is worse: rejected, then weak or predicted, then the standardised residual."""
    return (
        mark.status == "rejected",
        mark.status in ("weak", "predicted"),
        abs(mark.w) if mark.w is not None else 0.0,
    )


def arrow_scale(marks: list[Mark]) -> float:
    """Scale of residual arrows, page pixels per µm: a round number at which the longest arrow fits."""
    lengths = [float(np.hypot(*mark.residual.v_um)) for mark in marks if mark.residual]
    return svg.round_step(ARROW_PX / max(*lengths, LEAST_UM)) if lengths else 1.0


def mark_picture(mark: Mark, thumbnail: Thumbnail, px_per_um: float, most_px: float) -> Markup:
    """Draw the picture with a crosshair at the measured centre and the residual as an arrow."""
    rows, cols = thumbnail.pixels.shape
    zoom = SIZE_PX / (max(rows, cols) * thumbnail.step_px)  # page pixels to a pixel of the scan
    width, height = cols * thumbnail.step_px * zoom, rows * thumbnail.step_px * zoom
    image = svg.tag("image", href=_png_uri(thumbnail.pixels, most_px), width=width, height=height, class_="chip")
    overlay = Markup("")
    if mark.center_px is not None:
        # The centre of the top-left thumbnail pixel lies half a thumbnail pixel inside the picture's edge.
        x, y = (mark.center_px - thumbnail.origin_px + 0.5 * thumbnail.step_px) * zoom
        overlay = _crosshair(x, y, mark) + (_arrow(x, y, mark.residual, px_per_um) if mark.residual else Markup(""))
    return svg.picture(SIZE_PX, SIZE_PX, _description(mark), image, overlay, class_="thumb")


def _png_uri(pixels: NDArray[np.generic], most_px: float) -> str:
    """Encode grey values as an 8-bit PNG data URI, stretched between the 0.1 and 99.9 percentiles."""
    grey = pixels.astype(np.float64)
    low, high = np.percentile(grey, [0.1, 99.9])
    stretched = np.clip((grey - low) / max(high - low, 1e-12), 0.0, 1.0) * 255.0
    if max(grey.shape) > most_px:
        factor = most_px / max(grey.shape)
        stretched = cv2.resize(stretched, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".png", np.rint(stretched).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def _crosshair(x: float, y: float, mark: Mark) -> Markup:
    """Draw four ticks that leave the centre visible; dashed if the mark is not an observation."""
    ends = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
    at = np.array([x, y])
    class_ = "hair" if mark.status.is_observation else "hair guess"
    return svg.strokes(at + 5.0 * ends, at + 17.0 * ends, "halo") + svg.strokes(
        at + 5.0 * ends, at + 17.0 * ends, class_
    )


def _arrow(x: float, y: float, residual: ResidualRecord, px_per_um: float) -> Markup:
    """Draw the residual from the measured centre; comparator y points up, rows point down."""
    v = px_per_um * np.array([residual.vx_um, -residual.vy_um])
    length = float(np.hypot(*v))
    start = np.array([x, y])
    end = start + v
    shaft = svg.strokes(start[None], end[None], "arrow")
    if length < 4.0:
        return shaft
    back, side = -v / length, np.array([v[1], -v[0]]) / length
    x_head, y_head = np.stack([end + 6.0 * back + 3.0 * side, end, end + 6.0 * back - 3.0 * side], axis=1)
    return svg.strokes(start[None], end[None], "halo") + shaft + svg.line(x_head, y_head, "arrow")


def _description(mark: Mark) -> str:
    return f"{mark.kind} {mark.point} in {mark.image}, {mark.status}: the scan about its measured centre"
