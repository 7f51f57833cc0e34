"""The scan orientation by what is written, by pictures, and by marks that lean to one side."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import cv2
import drawn as draw
import numpy as np
import pytest
from drawn import CORNERS as FRAME_CORNERS
from drawn import Array
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import FrameMeasurement, MatchOptions, ScanWindow, Status, match, measure_fiducials
from measure.annotations.lines import KnownLine, Line, Reading, read_from_one_face
from measure.fiducials.measure_frame import measure_frame, rename_frame
from measure.fiducials.options import FiducialOptions, Reads
from measure.fiducials.scan_orientation import Drawings, MarkSite, OrientedMark, side_in_camera, writing_likelihoods
from measure.fiducials.search import FrameSearch, pitch_hypotheses
from measure.geometry import POSES, pose_in_camera
from measure.marks import shapes

WILD = (shapes.WrittenPlace("left", "90"), shapes.WrittenPlace("right", "270", plate=True))
DECIDED = 7.0
SIZE_PX = 640
CORNERS = ((10.0, -10.0), (-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0))
LAYOUT = draw.lay_out([shapes.MarkShape(draw.RING_CROSS)] * 4, CORNERS, (23.0, 23.0))


def line(text: str, pose: str, side: shapes.Side, share: float = 0.2) -> Line:
    """A line that lies in a pose in the scan, and reads to a share of its characters in the three others along it."""
    turn = int(pose.removesuffix("m")) % 180
    ways = [way for way in POSES if int(way.removesuffix("m")) % 180 == turn]
    legible = {way: len(text) * (1.0 if way == pose else share) for way in ways}
    return Line({way: Reading(text, 0.9, value) for way, value in legible.items()}, pose, ((0.0, 0.0),) * 4, side)


Written = tuple[str, str, shapes.Side]


def view_lines(pose: str, *camera: Written) -> list[Line]:
    """Lines as a scan of that pose shows them, given as they lie in the camera's frame."""
    lines = []
    for text, own, camera_side in camera:
        scan_pose = next(each for each in POSES if pose_in_camera(each, pose) == own)
        sides: Sequence[shapes.Side] = ("left", "right", "top", "bottom")
        side = next(each for each in sides if side_in_camera(each, pose) == camera_side)
        lines.append(line(text, scan_pose, side))
    return lines


def lead(lines: Sequence[Line], pose: str, places: Sequence[shapes.WrittenPlace] = WILD) -> float:
    """The log-odds of a pose against the likeliest other one."""
    of_all = dict(zip(POSES, writing_likelihoods(lines, places, POSES), strict=True))
    return float(of_all[pose] - max(value for name, value in of_all.items() if name != pose))


@pytest.mark.parametrize("pose", POSES)
def test_titles_and_plate_that_read_alike_on_opposite_sides_are_known_by_what_they_say(pose: str) -> None:
    plate: Written = ("WILD 15/4 Nr 13043 152.75", "270", "right")
    title: Written = ("RUN 20 CANBERRA 7/7/89", "90", "left")
    assert lead(view_lines(pose, plate), pose) > DECIDED
    assert lead(view_lines(pose, title), pose) > DECIDED
    assert lead(view_lines(pose, plate, title), pose) > DECIDED


def test_a_line_that_may_be_anybodys_does_not_decide_by_its_place() -> None:
    """Handwriting on the plate's side: upside down it would be a title on its own side."""
    lines = view_lines("0", ("CHECKED BY MILLER", "270", "right"))
    of_all = dict(zip(POSES, writing_likelihoods(lines, WILD, POSES), strict=True))
    assert of_all["180"] - of_all["0"] < DECIDED
    assert of_all["180"] - of_all["180m"] > DECIDED  # but it is not mirrored


@pytest.mark.parametrize(
    ("written", "places"), [(("KODAK SAFETY FILM", "0", "top"), WILD), (("RUN 20 CANBERRA 7/7/89", "90", "left"), ())]
)
def test_the_films_name_and_unplaced_lines_tell_the_mirror(
    written: Written, places: Sequence[shapes.WrittenPlace]
) -> None:
    of_all = writing_likelihoods(view_lines("90m", written), places, POSES)
    assert of_all[4:] == pytest.approx([0.0] * 4, abs=1e-3)
    assert of_all[:4].max() < -DECIDED


def test_lines_are_read_from_the_face_that_most_reads_from() -> None:
    odd = line("E.S.T.", "180m", "top", share=0.95)
    right = line("DEVELOPMENT", "180", "top")
    assert odd.pose == "180m"
    assert not any(each.pose.endswith("m") for each in read_from_one_face([odd, right]))
    assert [each.text for each in read_from_one_face([odd, right])] == ["DEVELOPMENT", "E.S.T."]


def written_frame() -> Array:
    """Pose "0": four marks alike; titles beside the left, reading upward, a plate to the right, reading downward."""
    grey = draw.frame_picture(LAYOUT, draw.pixel_from_camera("0", 0.004, ((SIZE_PX - 1) / 2,) * 2), size=SIZE_PX)
    border = np.ones(grey.shape, dtype=bool)
    border[90:-90, 90:-90] = False
    grey[border] = 3000 + np.random.default_rng(7).normal(0, 200, int(border.sum()))
    letters = np.zeros(grey.shape, np.uint8)
    cv2.putText(letters, "Nr 13043 152.75", (220, 55), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 1, cv2.LINE_AA)
    letters = np.ascontiguousarray(letters[::-1, ::-1])
    cv2.putText(letters, "RUN 20  CANBERRA  16.5.68", (130, 55), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 1, cv2.LINE_AA)
    return np.asarray(grey + 40.0 * np.rot90(letters))


def measure_picture(
    pose: str, places: tuple[shapes.WrittenPlace, ...], reads: Reads = "pose", known_lines: tuple[KnownLine, ...] = ()
) -> FrameMeasurement:
    grey = written_frame()
    grey = np.rot90(grey[:, ::-1] if pose.endswith("m") else grey, int(pose.rstrip("m")) // 90)
    scan = draw.make_scan(np.ascontiguousarray(grey))
    options = FiducialOptions(writing=reads, known_lines=known_lines)
    return measure_fiducials(scan, replace(LAYOUT, writing=places), (draw.PITCH_UM, draw.PITCH_UM), options)


@parametrize_with_studies("pose", ["270", "90m"])
def test_the_pose_of_a_frame_with_marks_alike_is_settled_by_its_writing(pose: str) -> None:
    found = measure_picture(pose, WILD).pose
    assert found is not None
    assert (found.name, found.decided) == (pose, True)
    assert "RUN20CANBERRA" in found.evidence[-1].replace(" ", "")
    assert "log-odds 8.0" in found.evidence[-1]


@pytest.mark.study
def test_where_no_place_is_known_frames_are_named_so_that_their_writing_is_upright() -> None:
    found = measure_picture("180m", ()).pose
    assert found is not None
    assert not found.decided
    assert pose_in_camera(found.writing, found.name) == "0"
    assert "in which most of what is written is upright" in found.evidence[0]
    assert "is evidence against orientation 0 with log-odds 8.0" in found.evidence[1]


def test_nothing_is_read_where_nobody_asks_and_a_mirror_is_not_assumed() -> None:
    silent = measure_picture("90m", WILD, "none")
    assert silent.writing is None
    assert draw.found_pose(silent) == ("0", False)


TITLE = KnownLine("RUN 31  CANBERRA  17.6.69", "90", "left", ((-13.9, -9.0), (-13.9, 2.0), (-13.1, 2.0), (-13.1, -9.0)))


def test_a_frame_that_lies_as_others_of_its_roll_is_read_only_where_their_line_stands() -> None:
    alike = measure_picture("0", WILD, known_lines=(TITLE,))
    assert [(each.side, each.pose) for each in alike.writing or ()] == [("left", "90")]
    assert draw.found_pose(alike) == ("0", True)


@pytest.mark.study
@pytest.mark.parametrize("pose", ["180", "0m"])
def test_a_frame_that_lies_otherwise_is_read_as_a_whole(pose: str) -> None:
    """The plate lies where the title is looked for, or the title itself in a mirror."""
    other = measure_picture(pose, WILD, known_lines=(TITLE,))
    assert {each.side for each in other.writing or ()} == {"left", "right"}
    assert draw.found_pose(other) == (pose, True)


def test_a_known_line_is_one_that_says_the_same_and_lies_so_plainly() -> None:
    assert TITLE.matches(line("RUN 20  CANBERRA  16.5.68", "90", "left"))
    assert not TITLE.matches(line("RUN 20  CANBERRA  16.5.68", "90m", "left"))
    assert not TITLE.matches(line("RUN 20  CANBERRA  16.5.68", "270", "left"))
    assert not TITLE.matches(line("PROPERTY OF THE ARCHIVE", "90", "left"))
    assert not TITLE.matches(line("RUN 20  CANBERRA  16.5.68", "90", "left", share=0.9))


SIDE = 61
FLIP = np.diag([1.0, -1.0])
BLOCK = np.zeros((SIDE, SIDE), np.uint8)
BLOCK[:, :24], BLOCK[18:43, :36], BLOCK[28:40, :45] = 1, 1, 1  # of the border, reaching into the frame, lopsided


def test_a_block_among_landscape_shows_which_way_it_is_turned() -> None:
    """A block steady in its chip, in landscapes as rough as it is deep, in each of its four directions; also where the
    place is another mark's, which slid along an edge that both have."""
    template = shapes.MarkTemplate(
        np.where(BLOCK > 0, 20.0, 150.0),
        1000.0,
        (30, 30),
        polarity="light",
        steady=cv2.dilate(BLOCK, np.ones((5, 5))) > 0,
    )
    turned = [np.diag([x, y]).astype(float) for x in (1, -1) for y in (-1, 1)]
    for index, (linear, shift_px) in enumerate(zip(turned, (0.0, 4.0, 4.0, 0.0), strict=True)):
        site = among_landscape(template, linear, shift_px)
        result = site.likelihoods([OrientedMark(template, FLIP @ each) for each in turned])
        assert result.argmax() == index
        assert np.sort(result)[-2] < -4.0


def among_landscape(template: shapes.MarkTemplate, linear: NDArray[np.float64], slid_px: float) -> MarkSite:
    rng = np.random.default_rng(0)
    landscape = cv2.GaussianBlur(rng.normal(0.0, 1.0, (3 * SIDE, 3 * SIDE)), (0, 0), 4.0)
    grey = 150.0 + 45.0 * landscape / landscape.std()
    shown = BLOCK[:: int(-linear[1, 1]), :: int(linear[0, 0])] > 0
    grey[SIDE : 2 * SIDE, SIDE : 2 * SIDE][shown] = 20.0
    grey = np.clip(np.rint(grey + rng.normal(0.0, 1.5, grey.shape)), 0, 255)
    scan = draw.make_scan(grey, 255)
    place = np.column_stack([linear, [SIDE + 30.0, SIDE + 30.0]])
    fit = match(ScanWindow(grey), template, place, MatchOptions(freedom="shift", estimate_blur=False))
    return MarkSite(scan, fit, fit.center_px + slid_px, None, Drawings([template], FLIP, 0.0), 5.0)


HALF_WEDGE = shapes.MarkShape(shapes.polygon(((0.0, 0.0), (1.4, 0.0), (1.4, 0.8))))
ANGLES = [float(np.degrees(np.arctan2(y, x))) for x, y in FRAME_CORNERS]
LEANING = draw.lay_out(
    [shapes.MarkShape(tuple(shapes.rotate_part(part, angle) for part in HALF_WEDGE.parts)) for angle in ANGLES]
)
PITCH = (draw.PITCH_UM, draw.PITCH_UM)
OPTIONS = FiducialOptions()
# Blocks that reach into the frame at the middles of its sides, whose coordinates tell the poses apart.
POSE_LEFT_OPEN_BLOCK = shapes.MarkShape(shapes.polygon(((0.0, 0.0), (6.0, 0.0), (6.0, -3.0), (1.2, -3.0))))
FRAME_MM, PX_PER_MM = 30.0, 10.0
UNEVEN = ((11.3, 0.0), (0.0, 11.2), (-11.0, 0.2), (0.1, -11.0))
BLOCKS = shapes.FiducialLayout(
    tuple(
        shapes.LayoutMark(
            str(k),
            place,
            (0.02, 0.02),
            shapes.MarkShape(tuple(shapes.rotate_part(part, 90.0 * k) for part in POSE_LEFT_OPEN_BLOCK.parts)),
        )
        for k, place in enumerate(UNEVEN)
    ),
    (FRAME_MM, FRAME_MM),
)


def test_a_frame_viewed_as_its_mirror_image_is_renamed_as_it_lies() -> None:
    scan = draw.make_scan(draw.frame_picture(LEANING, draw.pixel_from_camera("0")))
    hypotheses = pitch_hypotheses(scan, LEANING, PITCH, OPTIONS)[0]
    found = FrameSearch(scan, LEANING, OPTIONS).search_scan(OPTIONS, hypotheses)
    right = next(each for each in found.placements if each.pose == "0")
    mirrored = measure_frame(scan, LEANING, right.reorient("0m", right_mm(LEANING)), OPTIONS)
    assert int(mirrored.inliers.sum()) < 4
    frame = rename_frame(mirrored, "0")
    assert frame.inliers.all()
    assert len(frame.clear_fits) == 4
    # It is not replaced by one with fewer marks.
    assert rename_frame(frame, "0m") is frame


def right_mm(layout: shapes.FiducialLayout) -> Array:
    return np.array([mark.xy_mm for mark in layout.marks])


@cache
def block_picture(pose: str) -> tuple[Array, Array]:
    """Shadows in a frame on a rough dark border, and pixel_from_camera (2, 3)."""
    rng, size = np.random.default_rng(3), 380
    matrix = draw.pixel_from_camera(pose, center=(190.6, 188.3))
    matrix[:, :2] *= PX_PER_MM / 20.0
    cols_rows = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
    xy = (cols_rows - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    exposed = (np.abs(xy) < FRAME_MM / 2).all(axis=-1).astype(float)
    for mark in BLOCKS.marks:
        draw.paint(exposed, mark.mark, mark.xy_mm, matrix, -1.0, half=75, blur_px=0.01)
    ground = 30000 + 2000 * gaussian_filter(rng.normal(0, 1, (size, size)), 4.0) * 14
    border = 6000 + 1500 * rng.normal(0, 1, (size, size))
    light = gaussian_filter(exposed.clip(0.0, 1.0), 0.8)
    return light * ground + (1 - light) * border + rng.normal(0, 200, (size, size)), matrix


@parametrize_with_studies(
    ("pose", "requested"), [("180", "auto"), ("180", "180"), ("90m", "auto"), ("90m", "90m")], quick=(1,)
)
def test_blocks_at_the_border_are_measured_alike_with_their_pose_open_and_set(pose: str, requested: str) -> None:
    grey, matrix = block_picture(pose)
    truth = right_mm(BLOCKS) @ matrix[:, :2].T + matrix[:, 2]
    frame = measure_fiducials(draw.make_scan(grey), BLOCKS, (1000 / PX_PER_MM,) * 2, replace(OPTIONS, pose=requested))
    assert frame.pose is not None
    assert frame.pose.name == pose
    assert not frame.problems
    statuses = [mark.status for mark in frame.marks]
    assert statuses.count(Status.MEASURED) >= 3  # of one the standard deviation is at the limit
    assert {*statuses} <= {Status.MEASURED, Status.WEAK}
    for mark, place in zip(frame.marks, truth, strict=True):
        assert mark.center_px == pytest.approx(place, abs=0.25)
