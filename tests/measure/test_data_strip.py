"""The side of the frame that is written on: found in every pose, and not taken for what else stands beside a frame."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from brute_marks import Array, written_scan
from drawn_frames import PITCH_UM, RING_CROSS, frame_picture, layout_of, pixel_from_camera
from scipy.ndimage import gaussian_filter

from measure.fiducials import measure_fiducials
from measure.marks.shapes import MarkShape, Side
from measure.pose.data_strip import Beside, beside_frame, strip_likelihoods
from measure.results import Pose

SIZE_PX = 640
MIDDLE = (SIZE_PX - 1) / 2
FRAME_PX = 460
CORNERS = ((10.0, -10.0), (-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0))
LAYOUT = replace(layout_of([MarkShape(RING_CROSS)] * 4, CORNERS, (23.0, 23.0)), data_strip="left")


def written_frame(written: bool = True) -> Array:
    """Pose "0": four marks alike; writing beside the left, the next frame above, the film's edge and a scribble beside
    the others."""
    rng = np.random.default_rng(7)
    matrix = pixel_from_camera("0", 0.004, (MIDDLE, MIDDLE))
    grey = frame_picture(LAYOUT, matrix, size=SIZE_PX)
    border = np.ones(grey.shape, dtype=bool)
    first = (SIZE_PX - FRAME_PX) // 2
    border[first:-first, first:-first] = False
    grey[border] = 3000 + rng.normal(0, 200, int(border.sum()))
    next_frame = grey[: first - 12]
    next_frame += 5000 + 2500 * gaussian_filter(rng.normal(0, 1, next_frame.shape), 2.0) / 0.14
    grey[-first + 20 :] += 40000
    write(grey, "17", (500, SIZE_PX - first + 16))
    if written:
        turned = np.rot90(grey, -1)
        for col, text in ((110, "RUN 20"), (190, "CST 7300'"), (320, "LENS 153"), (430, "7/7/89")):
            write(turned, text, (col, first - 10))
    return grey


def write(grey: Array, text: str, place: tuple[int, int]) -> None:
    letters = np.zeros(grey.shape, np.uint8)
    cv2.putText(letters, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 255, 1, cv2.LINE_AA)
    grey += 9000.0 * letters / 255


def posed(grey: Array, pose: str) -> Array:
    """As a scan of that pose shows it: mirrored first, then turned counter-clockwise."""
    mirrored = grey[:, ::-1] if pose.endswith("m") else grey
    return np.ascontiguousarray(np.rot90(mirrored, int(pose.rstrip("m")) // 90))


def pose_of(grey: Array, folder: Path) -> Pose:
    with written_scan(grey, folder) as scan:
        pose = measure_fiducials(scan, LAYOUT, (PITCH_UM, PITCH_UM)).pose
    assert pose is not None
    return pose


def test_the_pose_is_one_of_two_that_have_the_writing_on_the_strips_side(tmp_path: Path) -> None:
    found = pose_of(posed(written_frame(), "90m"), tmp_path)
    assert found.name in ("90m", "270")
    assert not found.decided  # writing alone never decides
    assert "speaks for the pose with log-odds 4." in found.evidence[-1]


def test_without_writing_nothing_is_said(tmp_path: Path) -> None:
    found = pose_of(written_frame(written=False), tmp_path)
    assert found.name == "0"
    assert all("data strip" not in sentence for sentence in found.evidence)


def test_only_writing_counts(tmp_path: Path) -> None:
    with written_scan(written_frame(), tmp_path) as scan:
        beside = beside_frame(scan, LAYOUT, pixel_from_camera("0", 0.004, (MIDDLE, MIDDLE)), "0")
    assert beside["left"].written > 0.4 * beside["left"].seen
    assert all(beside[side].written < 0.15 * beside[side].seen for side in ("right", "top", "bottom"))


def test_what_the_scan_does_not_show_says_nothing() -> None:
    unseen = Beside(0, 0)
    assert unseen.log_odds == pytest.approx(0.0)
    beside: dict[Side, Beside] = {"left": unseen, "right": unseen, "top": unseen, "bottom": Beside(40, 40)}
    by_pose = strip_likelihoods(beside, "left", ("0", "90", "180"), 0.01)
    assert by_pose == pytest.approx([np.log(0.01), 0.0, np.log(0.01)], abs=0.02)
