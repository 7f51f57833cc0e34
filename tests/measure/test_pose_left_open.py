"""Marks that lean to one side, in frames whose pose is left open: what is found is what the pose set finds."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from brute_marks import Array, written_scan
from drawn import scan_of
from drawn_frames import CORNERS, PITCH_UM, frame_picture, layout_of, measured, paint, pixel_from_camera
from scipy.ndimage import gaussian_filter

from measure.detection.localisation import localise
from measure.fiducials import mark_fit
from measure.fiducials.constellation import Placement
from measure.fiducials.measure_frame import measure_frame, rename_frame
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import FrameSearch, pitch_hypotheses
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, polygon, turned_part

HALF_WEDGE = MarkShape(polygon(((0.0, 0.0), (1.4, 0.0), (1.4, 0.8))))
ANGLES = [float(np.degrees(np.arctan2(y, x))) for x, y in CORNERS]
LEANING = layout_of([MarkShape(tuple(turned_part(part, angle) for part in HALF_WEDGE.parts)) for angle in ANGLES])
PITCH = (PITCH_UM, PITCH_UM)
OPTIONS = FiducialOptions()
# Blocks that reach into the frame at the middles of its sides, whose coordinates tell the poses apart.
BLOCK = MarkShape(polygon(((0.0, 0.0), (6.0, 0.0), (6.0, -3.0), (1.2, -3.0))))
FRAME_MM, PX_PER_MM = 30.0, 10.0
UNEVEN = ((11.3, 0.0), (0.0, 11.2), (-11.0, 0.2), (0.1, -11.0))
BLOCKS = FiducialLayout(
    tuple(
        LayoutMark(str(k), place, (0.02, 0.02), MarkShape(tuple(turned_part(part, 90.0 * k) for part in BLOCK.parts)))
        for k, place in enumerate(UNEVEN)
    ),
    (FRAME_MM, FRAME_MM),
)


def test_a_frame_viewed_as_its_mirror_image_is_renamed_as_it_lies(tmp_path: Path) -> None:
    with written_scan(frame_picture(LEANING, pixel_from_camera("0")), tmp_path) as scan:
        found = FrameSearch(scan, LEANING, OPTIONS).search_scan(pitch_hypotheses(scan, LEANING, PITCH, OPTIONS)[0])
        right = next(each for each in found if each.pose == "0")
        mirrored = measure_frame(scan, LEANING, right.posed("0m", right_mm(LEANING)), OPTIONS)
        assert int(mirrored.inliers.sum()) < 4
        frame = rename_frame(scan, mirrored, "0")
        assert frame.inliers.all()
        assert len(frame.clear_fits) == 4
        # It is not replaced by one with fewer marks.
        assert rename_frame(scan, frame, "0m") is frame


def right_mm(layout: FiducialLayout) -> Array:
    return np.array([mark.xy_mm for mark in layout.marks])


@cache
def block_picture(pose: str) -> tuple[Array, Array]:
    """Shadows in a frame on a rough dark border, and pixel_from_camera (2, 3)."""
    rng, size = np.random.default_rng(3), 380
    matrix = pixel_from_camera(pose, center=(190.6, 188.3))
    matrix[:, :2] *= PX_PER_MM / 20.0
    cols_rows = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
    xy = (cols_rows - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    exposed = (np.abs(xy) < FRAME_MM / 2).all(axis=-1).astype(float)
    for mark in BLOCKS.marks:
        paint(exposed, mark.mark, mark.xy_mm, matrix, -1.0, half=75, blur_px=0.01)
    ground = 30000 + 2000 * gaussian_filter(rng.normal(0, 1, (size, size)), 4.0) * 14
    border = 6000 + 1500 * rng.normal(0, 1, (size, size))
    light = gaussian_filter(exposed.clip(0.0, 1.0), 0.8)
    return light * ground + (1 - light) * border + rng.normal(0, 200, (size, size)), matrix


@pytest.mark.study
@pytest.mark.parametrize("pose", ["90m", "180"])
def test_blocks_at_the_border_are_measured_alike_with_their_pose_open_and_set(pose: str) -> None:
    grey, matrix = block_picture(pose)
    truth = right_mm(BLOCKS) @ matrix[:, :2].T + matrix[:, 2]
    for requests in ("auto", pose):
        options = replace(OPTIONS, pose=requests)
        frame = measure_fiducials(scan_of(grey), BLOCKS, (1000 / PX_PER_MM,) * 2, options)
        assert frame.pose is not None
        assert frame.pose.name == pose
        assert [mark.status for mark in frame.marks] == [Status.MEASURED] * 4
        for mark, place in zip(frame.marks, truth, strict=True):
            assert mark.center_px == pytest.approx(place, abs=0.25)


@pytest.mark.study
def test_marks_that_were_found_are_renamed_and_not_sought_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the pose opposite, where the given coordinates are 0.3 mm off; only their settling may look about them."""
    grey, matrix = block_picture("180")
    scan = scan_of(grey)
    start = Placement("180", matrix, 1.0, 4, -1, 4, (1 / PX_PER_MM,) * 2)
    named_rightly = measure_frame(scan, BLOCKS, start, OPTIONS)
    named_wrongly = measure_frame(scan, BLOCKS, start.posed("0", right_mm(BLOCKS)), OPTIONS)
    assert int(named_wrongly.inliers.sum()) == 4
    monkeypatch.setattr(mark_fit, "localise", lambda scan, mark: localise(scan, mark) if mark.search_px < 2 else None)
    frame = rename_frame(scan, named_wrongly, "180")
    assert frame.placement.pose == "180"
    assert int(frame.inliers.sum()) == 4
    for fit, true in zip(frame.fits, named_rightly.fits, strict=True):
        assert fit is not None
        assert true is not None
        np.testing.assert_allclose(fit.center_px, true.center_px, atol=0.02)


@pytest.mark.study
def test_half_wedges_of_any_pose(tmp_path: Path) -> None:
    for seed, pose in enumerate(("90", "180m")):
        matrix = pixel_from_camera(pose)
        grey = frame_picture(LEANING, matrix, seed)
        auto = measured(grey, LEANING, tmp_path)
        placed = measured(grey, LEANING, tmp_path, FiducialOptions(pose=pose))
        view, right = (
            sorted(mark.center_px.tolist() for mark in each.marks if mark.center_px is not None)
            for each in (auto, placed)
        )
        np.testing.assert_allclose(view, right, atol=0.05)
        assert all(mark.status.is_observation for mark in auto.marks)
