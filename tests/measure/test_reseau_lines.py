"""A réseau of continuous lines: its crossings among stars, drawn line by line with the normal distribution."""

from dataclasses import replace

import numpy as np
from drawn import Array, make_scan
from scipy.special import ndtr

from measure import FiducialOptions, Status, measure_fiducials
from measure.marks.shapes import Bar, Disk, FiducialLayout, LayoutMark, MarkShape, known_outline_mm, limit_to_crossings
from measure.tone.curve import LINEAR

PX_PER_MM, LINE_MM, SIZE_PX, BLUR_PX = 20.0, 0.2, 640, 0.9
STEPS_MM = np.arange(-2, 3) * 5.0
MIDDLE_PX, TURN = np.array([322.3, 317.8]), np.deg2rad(0.4)
BRIGHT = {"0-0": (0.05, -0.1), "3-1": (-0.1, 0.05)}  # stars on crossings, mm beside them


def layout(arm_mm: float = 2.5) -> FiducialLayout:
    cross = MarkShape(
        (Bar((-arm_mm, 0.0), (arm_mm, 0.0), LINE_MM), Bar((0.0, -arm_mm), (0.0, arm_mm), LINE_MM)), "dark"
    )
    marks = (LayoutMark(name, xy, (0.002, 0.002), cross) for name, xy in places_mm().items())
    return FiducialLayout(tuple(marks), (30.0, 30.0))


def places_mm() -> dict[str, tuple[float, float]]:
    return {f"{i}-{j}": (float(x), float(y)) for i, x in enumerate(STEPS_MM) for j, y in enumerate(STEPS_MM)}


def to_px(xy_mm: Array) -> Array:
    c, s = np.cos(TURN), np.sin(TURN)
    return np.asarray(xy_mm @ np.array([[c, s], [-s, c]]) * (PX_PER_MM, -PX_PER_MM) + MIDDLE_PX)


def plate() -> Array:
    """Grey values of a negative."""
    rng, (rows, cols) = np.random.default_rng(5), np.mgrid[:SIZE_PX, :SIZE_PX]
    right, up = (cols - MIDDLE_PX[0]) / PX_PER_MM, (MIDDLE_PX[1] - rows) / PX_PER_MM
    x, y = np.cos(TURN) * right + np.sin(TURN) * up, np.cos(TURN) * up - np.sin(TURN) * right
    covered, blur_mm = np.zeros(rows.shape), BLUR_PX / PX_PER_MM
    for across, along in ((x, y), (y, x)):
        for step in STEPS_MM:
            line = ndtr((LINE_MM / 2 - across + step) / blur_mm) - ndtr((-LINE_MM / 2 - across + step) / blur_mm)
            covered = np.maximum(covered, line * ndtr((11.5 - np.abs(along)) / blur_mm))
    stars = [(place, 1.0, 0.1) for place in rng.uniform(-14, 14, (120, 2))]
    stars += [(np.add(places_mm()[name], off), 20.0, 0.3) for name, off in BRIGHT.items()]
    density = sum(h * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / sigma**2) for at, h, sigma in stars)
    ground = 45000.0 - 9000.0 * covered
    return np.asarray(ground - (ground - 6000.0) * (1 - np.exp(-density)) + rng.normal(0, 300, rows.shape))


def test_crossings_are_measured_with_claims_that_hold_and_those_under_stars_are_not() -> None:
    scan = make_scan(plate()).replace_tone(LINEAR)
    frame = measure_fiducials(scan, layout(), (1000 / PX_PER_MM,) * 2, FiducialOptions("0"))
    good = [mark for mark in frame.marks if mark.status is Status.MEASURED]
    assert len(good) >= 20
    assert not {mark.point for mark in good} & {*BRIGHT}
    places = np.array([mark.center_px for mark in good], dtype=float)
    errors = places - to_px(np.array([places_mm()[mark.point] for mark in good]))
    sigmas = np.sqrt([np.diag(mark.covariance.px2) for mark in good if mark.covariance is not None])
    assert np.abs(errors).max() < 0.05
    assert 0.7 < np.sqrt((errors**2).mean() / (sigmas**2).mean()) < 1.3


def test_lines_that_run_on_are_known_about_their_crossings_only() -> None:
    (limited, *_) = limit_to_crossings(layout()).marks
    assert isinstance(limited.mark, MarkShape)
    assert limited.mark.known_mm == ((-1.0, -1.0), (1.0, 1.0))
    assert np.abs(known_outline_mm(limited.mark)).max() <= 1.0
    assert limit_to_crossings(layout(2.0)) == layout(2.0)  # crosses with gaps between them
    dots = replace(layout(), marks=tuple(replace(m, mark=MarkShape((Disk((0.0, 0.0), 2.4),))) for m in layout().marks))
    assert limit_to_crossings(dots) == dots
