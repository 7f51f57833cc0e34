"""Marks that lean to one side, in frames whose pose is left open: what is found is what the pose set finds."""

from pathlib import Path

import numpy as np
import pytest
from brute_marks import written_scan
from drawn_frames import CORNERS, PITCH_UM, frame_picture, layout_of, measured, pixel_from_camera

from measure.fiducial_options import FiducialOptions
from measure.fiducials import _as_if_set, _in_every_pose
from measure.frames.frame_measurement import measure_frame
from measure.marks.shapes import MarkShape, polygon, turned_part
from measure.search.constellation import Placement
from measure.search.frame_search import FrameSearch
from measure.search.pitches import pitch_hypotheses

HALF_WEDGE = MarkShape(polygon(((0.0, 0.0), (1.4, 0.0), (1.4, 0.8))))
ANGLES = [float(np.degrees(np.arctan2(y, x))) for x, y in CORNERS]
LEANING = layout_of([MarkShape(tuple(turned_part(part, angle) for part in HALF_WEDGE.parts)) for angle in ANGLES])
PITCH = (PITCH_UM, PITCH_UM)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (30.0, -25.0)])
def test_a_frame_seen_as_its_mirror_image_is_found_as_it_lies(shift_px: tuple[float, float], tmp_path: Path) -> None:
    """From a placement in a wrong pose, and from one that is off by more than a mark is sought."""
    matrix = pixel_from_camera("0")
    with written_scan(frame_picture(LEANING, matrix), tmp_path) as scan:
        options = FiducialOptions()
        search, hypotheses = FrameSearch(scan, LEANING, options), pitch_hypotheses(scan, LEANING, PITCH, options)
        found = search.anywhere(hypotheses[0])
        right = next(each for each in found if each.pose == "0")
        moved = Placement(
            **{
                **vars(right),
                "pixel_from_camera": right.pixel_from_camera + np.array([[0, 0, shift_px[0]], [0, 0, shift_px[1]]]),
            }
        )
        mirrored = measure_frame(scan, LEANING, moved.posed("0m"), options)
        assert int(mirrored.belongs.sum()) < 4
        frame = _in_every_pose(search, found, mirrored)
        assert frame.is_whole == (shift_px == (0.0, 0.0))
        frame = _as_if_set(search, hypotheses, measure_frame(scan, LEANING, moved, options))
        assert frame.is_whole


def test_half_wedges_of_any_pose(tmp_path: Path) -> None:
    for seed, pose in enumerate(("90", "180m")):
        matrix = pixel_from_camera(pose)
        grey = frame_picture(LEANING, matrix, seed)
        auto = measured(grey, LEANING, tmp_path)
        placed = measured(grey, LEANING, tmp_path, FiducialOptions(pose=pose))
        seen, right = (
            sorted(mark.center_px.tolist() for mark in each.marks if mark.center_px is not None)
            for each in (auto, placed)
        )
        np.testing.assert_allclose(seen, right, atol=0.05)
        assert all(mark.status.is_observation for mark in auto.marks)
