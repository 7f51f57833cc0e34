"""Fiducial marks on real scans, where they are at hand."""

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from measure.fiducials import measure_fiducials
from measure.results import FrameMeasurement
from measure.scan import open_scan
from measure.shapes import FiducialLayout, LayoutMark, MarkShape, cross, ring_cross

SCANS = Path(__file__).parents[3] / "shared" / "data" / "film_scans"
pytestmark = pytest.mark.skipif(not SCANS.exists(), reason="the real scans are not beside the project")

WILD = MarkShape(ring_cross(0.80, 0.17, 1.75, 0.10, 0.08, 45.0), "light")
RESEAU = MarkShape(cross(0.97, 0.05), "dark")
RESEAU_PITCH_UM = 27.4


def square(mark: MarkShape) -> FiducialLayout:
    corners = ((106.0, -106.0), (-106.0, -106.0), (-106.0, 106.0), (106.0, 106.0))
    marks = tuple(LayoutMark(str(k + 1), place, (0.02, 0.02), mark) for k, place in enumerate(corners))
    return FiducialLayout(marks, (230.0, 230.0))


def lattice() -> FiducialLayout:
    index = range(-2, 3)
    marks = [LayoutMark(f"{i},{j}", (10.0 * i, 10.0 * j), (0.005, 0.005), RESEAU) for j in index for i in index]
    return FiducialLayout(tuple(marks), (53.0, 53.0))


def affine_rms_px(given: NDArray[np.float64], seen: NDArray[np.float64]) -> float:
    """Per point."""
    design = np.column_stack([given, np.ones(len(given))])
    residuals = seen - design @ np.linalg.lstsq(design, seen, rcond=None)[0]
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def observations(result: FrameMeasurement, layout: FiducialLayout) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pairs = [
        (given.xy_mm, mark.center_px)
        for mark, given in zip(result.marks, layout.marks, strict=True)
        if mark.status.is_observation
    ]
    return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])


@pytest.mark.parametrize("name", ["000b3b38", "08320661", "0b50b18e"])
def test_all_four_corners_of_the_wild_frames(name: str) -> None:
    layout = square(WILD)
    with open_scan(SCANS / "aerial" / f"{name}.jpeg") as scan:
        result = measure_fiducials(scan, layout, scan.pitch_um)
    given, seen = observations(result, layout)
    assert len(seen) == 4
    assert affine_rms_px(given, seen) < 0.8
    assert result.pose is not None
    assert result.pose.decided or "is assumed" in result.pose.evidence[0]


def test_the_crosses_of_a_reseau_on_a_landscape() -> None:
    layout = lattice()
    with open_scan(SCANS / "reseau" / "apollo-11.jpg") as scan:
        result = measure_fiducials(scan, layout, (RESEAU_PITCH_UM, RESEAU_PITCH_UM))
    with (SCANS / "reseau" / "apollo-11_crosses_scout.csv").open() as file:
        scouted = [row for row in csv.DictReader(file) if row["used"] == "1"]
    places = np.array([[float(row["x_px"]), float(row["y_px"])] for row in scouted])
    indices = np.array([[float(row["i"]), float(row["j"])] for row in scouted])
    given, seen = observations(result, layout)
    nearest = np.hypot(*np.moveaxis(seen[:, None] - places[None], -1, 0)).min(axis=1)
    assert np.median(nearest) < 0.3
    assert len(seen) >= 20
    assert affine_rms_px(given, seen) < 1.1 * affine_rms_px(indices, places)
