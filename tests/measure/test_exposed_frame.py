"""The exposed frame's edges, and faint marks that are found by where these put them."""

import numpy as np
import pytest
from brute_marks import placed
from drawn import drawn, scan_of
from drawn_frames import layout_of, paint
from numpy.typing import NDArray

from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.marks.shapes import MarkShape, dot
from measure.search.exposed_frame import exposed_frame
from measure.status import Status

Array = NDArray[np.float64]

CENTER = np.array([158.4, 143.7])
SIZE = (240.0, 200.0)
WIDTH, HEIGHT = 320, 290
PX_PER_MM = 20.0
PLACES = [(x, y) for x in (-4.2, 4.2) for y in (-3.9, 3.9)]
DOT = MarkShape(dot(0.22), "light")


def frame(turn_rad: float, inside_dn: float, outside_dn: float) -> Array:
    """A frame turned from the columns toward the rows."""
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)

    def inside(col: Array, row: Array) -> Array:
        right, down = col - CENTER[0], row - CENTER[1]
        along, down = cos * right + sin * down, cos * down - sin * right
        return np.asarray((np.abs(along) < SIZE[0] / 2) & (np.abs(down) < SIZE[1] / 2))

    return outside_dn + (inside_dn - outside_dn) * drawn(inside, WIDTH, HEIGHT, 0.8, fineness=4)


@pytest.mark.parametrize(("turn_rad", "inside_dn", "outside_dn"), [(0.03, 52000.0, 9000.0), (-0.055, 9000.0, 52000.0)])
def test_a_frame_is_found_by_its_edges(turn_rad: float, inside_dn: float, outside_dn: float) -> None:
    grey = frame(turn_rad, inside_dn, outside_dn)
    grey[195:240, 10:80] = 30000.0  # a label over an edge
    grey += np.random.default_rng(1).normal(0.0, 1500.0, grey.shape)
    found = exposed_frame(scan_of(grey), (SIZE[0] * 1.006, SIZE[1] * 1.006), 0.015, 0.1)
    assert found is not None
    assert np.hypot(*(found.center_px - CENTER)) < 1.5
    assert np.abs(found.size_px - SIZE).max() < 3.0
    assert found.turn_rad == pytest.approx(turn_rad, abs=0.004)


def test_a_picture_without_edges_shows_no_frame() -> None:
    grey = np.random.default_rng(2).normal(30000.0, 3000.0, (HEIGHT, WIDTH))
    assert exposed_frame(scan_of(grey), SIZE, 0.015, 0.1) is None


@pytest.mark.parametrize("contrast_dn", [3500.0, 0.0])
def test_faint_dots_are_found_where_the_edges_put_them(contrast_dn: float) -> None:
    rng = np.random.default_rng(2)
    grey = frame(0.0, 50000.0, 8000.0) + rng.normal(0.0, 2000.0, (HEIGHT, WIDTH))
    matrix = placed(PX_PER_MM, (float(CENTER[0]), float(CENTER[1])))
    for place in PLACES:
        paint(grey, DOT, place, matrix, contrast_dn, half=12, blur_px=0.9)
    layout = layout_of([DOT] * 4, PLACES, (SIZE[0] / PX_PER_MM, SIZE[1] / PX_PER_MM))
    options = FiducialOptions(pose="0", pitch_is_right=True)
    result = measure_fiducials(scan_of(grey), layout, (1000 / PX_PER_MM,) * 2, options)
    if not contrast_dn:
        assert {mark.status for mark in result.marks} == {Status.ABSENT}
        return
    for found, place in zip(result.marks, PLACES, strict=True):
        assert found.status is Status.WEAK, found
        assert found.center_px is not None
        assert np.hypot(*(found.center_px - matrix @ (*place, 1.0))) < 1.0


def test_the_edges_themselves_are_no_marks() -> None:
    grey = frame(0.03, 50000.0, 8000.0)
    found = exposed_frame(scan_of(grey), SIZE, 0.015, 0.1)
    assert found is not None
    corner = CENTER + found.rotation @ (np.array(SIZE) / 2)
    inward = found.rotation @ (np.array([-20.0, -20.0]))
    reach = np.array([10.0, 10.0])
    free = found.free_of_edges(np.stack([corner, corner + inward, corner - inward]), -reach, reach)
    assert free.tolist() == [False, True, True]
