"""Fiducial marks on real scans, where they are at hand."""

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from real_data import DATA, needs
from scipy.ndimage import gaussian_filter, uniform_filter1d

from measure import FiducialOptions, FrameMeasurement, Scan, Status, measure_fiducials, open_scan
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross, ring_cross
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.tone.curve import Tone

SCANS = DATA / "film_scans"
pytestmark = needs("film_scans")

RESEAU = MarkShape(cross(0.97, 0.05), "dark")
RING_CROSS = ring_cross(0.8, 0.17, 1.75, 0.1, 0.08, 45.0)
RESEAU_PITCH_UM = 27.4
MIDDLE_PX = 1072  # a step of the lattice is 356


def square(mark: MarkShape) -> FiducialLayout:
    corners = ((106.0, -106.0), (-106.0, -106.0), (-106.0, 106.0), (106.0, 106.0))
    marks = tuple(LayoutMark(str(k + 1), place, (0.02, 0.02), mark) for k, place in enumerate(corners))
    return FiducialLayout(marks, (230.0, 230.0))


def lattice(steps: int = 2) -> FiducialLayout:
    """The crosses up to so many steps from the middle one."""
    index = range(-steps, steps + 1)
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


def scouted(number: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Lattice indices (n, 2), places (n, 2) px and use (n,) of the crosses that another program's line profiles gave.
    Their lattice may be shifted against ours by whole steps, which an affine transformation does not feel."""
    with (SCANS / "reseau" / f"apollo-{number}_crosses_scout.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = np.array([[float(row[name]) for name in ("i", "j", "x_px", "y_px", "used")] for row in rows])
    return columns[:, :2], columns[:, 2:4], columns[:, 4] == 1


def middle(scan: Scan) -> tuple[Scan, NDArray[np.int64]]:
    """The part that shows the nine crosses in the middle and no others, and its first pixel, at a corner of blocks of
    the file's compression."""
    first = (np.array([scan.width_px, scan.height_px]) - MIDDLE_PX) // 16 * 8
    part = WholePicture(scan.samples(int(first[0]), int(first[1]), MIDDLE_PX, MIDDLE_PX), scan.quantisation_step_dn)
    return Scan(scan.path, part, NO_TAGS), first


@pytest.mark.study
@pytest.mark.parametrize(("number", "steps"), [(11, 1), (11, 2), (15, 2), (16, 2)])  # 17 fits as well a step farther on
def test_the_crosses_of_a_reseau_on_a_landscape(number: int, steps: int) -> None:
    """As many crosses as line profiles found, and on the same crosses no larger residuals: on all of them, those too
    that the profiles' affinity left out, but for the standard deviations of weak ones, and on those that it used."""
    layout = lattice(steps)
    with open_scan(SCANS / "reseau" / f"apollo-{number}.jpg") as scan:
        shown, first = (scan, np.zeros(2)) if steps == 2 else middle(scan)
        options = FiducialOptions() if steps == 2 else FiducialOptions(pose="0")
        result = measure_fiducials(shown, layout, (RESEAU_PITCH_UM, RESEAU_PITCH_UM), options)
    indices, places, used = scouted(number)
    within = np.all((places > first) & (places < first + np.array([shown.width_px, shown.height_px])), axis=1)
    indices, places, used = indices[within], places[within] - first, used[within]
    assert steps == 2 or len(places) == 9
    given, observed = observations(result, layout)
    distance = np.hypot(*np.moveaxis(places[:, None] - observed[None], -1, 0))
    nearest = distance.argmin(axis=1)
    assert len(observed) >= len(places)
    assert len(set(nearest.tolist())) == len(places)
    assert np.median(distance.min(axis=1)) < 0.5
    claims = [mark.covariance_px2 for mark in result.marks if mark.status is Status.WEAK]
    claimed_px2 = sum(float(np.trace(covariance)) for covariance in claims if covariance is not None)
    allowed_px2 = affine_rms_px(indices, places) ** 2 + claimed_px2 / len(observed)
    assert affine_rms_px(given, observed) ** 2 <= allowed_px2
    assert affine_rms_px(given[nearest[used]], observed[nearest[used]]) <= affine_rms_px(indices[used], places[used])


@pytest.mark.study
@pytest.mark.parametrize("change", ["none", "blurred", "halved", "sharpened"])
def test_handwriting_in_two_corners_is_not_taken_for_faint_crosses(change: str) -> None:
    """The pixels are longer one way: only where the pitch as given is doubted the crosses are found in their places."""
    layout = square(MarkShape(cross(1.75, 0.12, 0.25, 45.0), "light"))
    with open_scan(SCANS / "aerial" / "0cec8b13.jpeg") as opened:
        assert opened.pitch_um is not None
        grey, pitch_um = opened.window(0, 0, opened.width_px, opened.height_px), np.array(opened.pitch_um)
    crosses = np.array([(78.2, 83.9), (68.0, 1779.7), (1734.5, 103.0)])  # seen by a person
    if change == "blurred":
        grey = gaussian_filter(grey, 1.0)
    elif change == "sharpened":
        grey = 2 * grey - gaussian_filter(grey, 1.5)
    elif change == "halved":
        rows, cols = np.array(grey.shape) // 2
        grey = grey[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2).mean(axis=(1, 3))
        crosses, pitch_um = crosses / 2 - 0.25, 2 * pitch_um
    stored = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    scan = Scan(Path(change), WholePicture(stored[..., None]), NO_TAGS)
    result = measure_fiducials(scan, layout, (float(pitch_um[0]), float(pitch_um[1])))
    observed = observations(result, layout)[1]
    distance = np.hypot(*np.moveaxis(observed[:, None] - crosses[None], -1, 0))
    assert len(observed) == 3
    assert distance.min(axis=0).max() < 1.0


@pytest.mark.study
@pytest.mark.parametrize("change", ["moved along columns", "stretched to black and white"])
def test_marks_unlike_their_drawing_that_nothing_else_resembles_are_weak(change: str) -> None:
    """Each time one of the ring-crosses, with lines of 0.8 px, had a residual as large as its own contrast."""
    layout = square(MarkShape(RING_CROSS, "light"))
    places = np.array([(198.6, 1776.5), (1871.9, 113.2), (207.6, 105.9), (1863.1, 1786.2)])  # seen by a person
    with open_scan(SCANS / "aerial" / "08320661.jpeg") as opened:
        grey = opened.window(0, 0, opened.width_px, opened.height_px)
    grey = uniform_filter1d(grey, 3, axis=0) if change == "moved along columns" else (grey - 40) * (255 / 160)
    stored = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    scan = Scan(Path(change), WholePicture(stored[..., None]), NO_TAGS).replace_tone(Tone.unknown())
    result = measure_fiducials(scan, layout, (127.0, 127.0))
    observed = observations(result, layout)[1]
    assert len(observed) == 4
    assert np.hypot(*np.moveaxis(observed[:, None] - places[None], -1, 0)).min(axis=0).max() < 0.5


@pytest.mark.study
def test_a_reseau_is_not_detected_in_a_frame_of_another_camera() -> None:
    with open_scan(SCANS / "aerial" / "0cec8b13.jpeg") as scan:
        result = measure_fiducials(scan, lattice(), (RESEAU_PITCH_UM, RESEAU_PITCH_UM))
    assert not any(mark.status.is_observation for mark in result.marks)
    assert "no fiducial was measured" in result.problems[0]


@pytest.mark.study
def test_crosses_of_a_sharpened_scan_are_measured_in_their_places() -> None:
    layout = lattice()
    with (SCANS / "reseau_sharpened" / "apollo17-HFE_places.csv").open(encoding="utf-8") as file:
        places = [(float(row["col_px"]), float(row["row_px"])) for row in csv.DictReader(file)]
    with open_scan(SCANS / "reseau_sharpened" / "apollo17-HFE.jpg") as scan:
        result = measure_fiducials(scan.replace_tone(Tone.unknown()), layout, (22.0, 22.0))
    measured = [mark.center_px for mark in result.marks if mark.status is Status.MEASURED]
    distance = np.hypot(*np.moveaxis(np.array(measured)[:, None] - np.array(places)[None], -1, 0))
    assert (distance.min(axis=0) < 1.2).sum() >= 0.8 * len(places)
    assert distance.min(axis=1).max() < 1.2
