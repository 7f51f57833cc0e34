"""Faint marks beside the frame's edge, as overexposed film shows them: found at a closer look, and none elsewhere."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from brute_marks import placed
from drawn import scan_of
from drawn_frames import layout_of, paint

from measure.detection.correlation import CLOSE, WIDE, Surroundings
from measure.fiducials import measure_frame
from measure.fiducials.constellation import NARROW, Placement
from measure.fiducials.frame import Frame
from measure.fiducials.mark_fit import Detection
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import MarkShape, polygon, turned_part
from measure.results import MarkFit

PX_PER_MM = 20.0
HALF_MM = 5.5
AT_MM = 4.4
MIDDLE_PX = 150.3
WING = polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35)))
PLACES = [(x, y) for x in (-AT_MM, AT_MM) for y in (-AT_MM, AT_MM)]


def wing(x: float, y: float) -> MarkShape:
    """It points away from the frame's middle."""
    return MarkShape(tuple(turned_part(part, float(np.degrees(np.arctan2(y, x)))) for part in WING))


@pytest.mark.study
@pytest.mark.parametrize("contrast", [4500.0, 0.0])
def test_wings_are_found_next_to_an_edge_that_is_nine_times_as_strong(contrast: float) -> None:
    rng = np.random.default_rng(3)
    grey = np.full((300, 300), 55000.0)
    edge = slice(round(MIDDLE_PX - HALF_MM * PX_PER_MM), round(MIDDLE_PX + HALF_MM * PX_PER_MM))
    grey[edge, edge] = 13000.0
    matrix = placed(PX_PER_MM, (MIDDLE_PX, MIDDLE_PX))
    layout = layout_of([wing(*place) for place in PLACES], PLACES, (2 * HALF_MM, 2 * HALF_MM))
    for mark in layout.marks:
        paint(grey, mark.mark, mark.xy_mm, matrix, -contrast, blur_px=0.9)
    grey += rng.normal(0.0, 900.0, grey.shape)
    result = measure_fiducials(
        scan_of(grey), layout, (1000 / PX_PER_MM,) * 2, FiducialOptions(pose="0", pitch_is_right=True)
    )
    if not contrast:
        assert {mark.status for mark in result.marks} == {Status.ABSENT}
        return
    for found, given in zip(result.marks, layout.marks, strict=True):
        assert found.status is Status.WEAK, found
        assert found.center_px is not None
        assert np.hypot(*(found.center_px - matrix @ (*given.xy_mm, 1.0))) < 0.5


@pytest.mark.parametrize(
    ("surroundings", "chance", "is_taken"), [(CLOSE, 5e-4, True), (CLOSE, 5e-3, False), (WIDE, 5e-4, False)]
)
def test_at_closer_matching_marks_are_taken_that_noise_seldom_makes_for_all_together_decide(
    surroundings: Surroundings, chance: float, is_taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    faint = cast(MarkFit, SimpleNamespace(likeness=0.1, significance=3.0))
    monkeypatch.setattr(
        measure_frame,
        "detect_mark",
        lambda _, expected, __: Detection(expected.center_px, True, faint, false_alarms=chance),
    )
    matrix = placed(PX_PER_MM, (MIDDLE_PX, MIDDLE_PX))
    layout = layout_of([wing(*place) for place in PLACES], PLACES, (2 * HALF_MM, 2 * HALF_MM))
    placement = Placement("0", matrix, 1.0, 4, 1, 1, (1 / PX_PER_MM,) * 2, surroundings)
    frame = Frame.from_placement(scan_of(np.zeros((300, 300))), layout, placement, FiducialOptions())
    frame = measure_frame._detect(frame, range(4), frame.first_search_px(NARROW))
    assert [detection.fit is faint for detection in frame.detections] == [is_taken] * 4
