"""Whether the lengths of a camera file are mm: metres or um taken for them are off by a thousand beside the frame."""

import math
from collections.abc import Sequence

import numpy as np

from measure.marks import shapes
from measure.marks.rendering import extent_px
from pipeline.text.tables import Table

FIELD_RATIO = 50.0  # of principal distance and half the diagonal, either way: 2.3 degrees of field to 178

Drawing = shapes.Mark | shapes.LearnedMark | None


def check_units(
    table: Table,
    frame_mm: tuple[float, float],
    distance_mm: float | None,
    fiducials: Sequence[tuple[Table, shapes.Point, Drawing]],
) -> None:
    """Raises InputError for lengths that are impossible in a frame of that size.

    distance_mm: the principal distance, None where it is not given. fiducials: each one's table, place and mark.
    """
    frame = f"the frame of {frame_mm[0]:g} x {frame_mm[1]:g} mm"
    half_diagonal = math.hypot(*frame_mm) / 2
    if distance_mm is not None and not 1 / FIELD_RATIO < distance_mm / half_diagonal < FIELD_RATIO:
        raise table.error("principal_distance_mm", f"{distance_mm:g} mm is impossible for {frame}. Give both in mm.")
    places = [xy for _, xy, _ in fiducials]
    apart_mm = float(np.ptp(places, axis=0).max()) if len(places) > 1 else math.inf
    for entry, xy, mark in fiducials:
        size_mm = _size_mm(mark)
        if max(map(abs, xy)) > 2 * max(frame_mm):
            raise entry.error("xy_mm", f"lies far outside of {frame}. Give mm from its middle.")
        if apart_mm < max(frame_mm) / FIELD_RATIO:
            raise entry.error("xy_mm", f"all fiducials lie within {apart_mm:.3g} mm, in {frame}. Give mm.")
        if size_mm > min(frame_mm) / 2:
            raise entry.error("mark", f"is drawn {size_mm:.4g} mm large, in {frame}. Give its sizes in mm.")


def _size_mm(mark: Drawing) -> float:
    """Width or height, whichever is larger; 0 where nothing is drawn, or the frame's edges themselves are."""
    if mark is None or isinstance(mark, shapes.FrameCorner):
        return 0.0
    if isinstance(mark, shapes.LearnedMark):
        return mark.size_mm
    return float(np.ptp(extent_px(mark, np.eye(2, 3)), axis=0).max())
