"""A camera drawn and marks learned on the review page."""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from browser import browser_page, needs_browser
from drawn import ALIKE, CORNERS, PITCH_UM, Array, frame_picture, pixel_from_camera
from playwright.sync_api import Browser, Page, expect
from projects import PLACES, PROJECT, Printed, Refusal, command, fiducial_tables, present, write_project
from review_server import comparator, decisions, served, steer

from measure import open_scan
from pipeline import InputError, read_camera
from pipeline.files.decisions_file import Decision, DecisionKind, append_decisions
from pipeline.files.mark_table import MARK_TABLES
from pipeline.files.project_file import read_project, read_undrawn
from pipeline.review.camera_drawing import (
    CameraDrawing,
    ClickedMark,
    FramePlacement,
    camera_path,
    parse_drawing,
    place_frame,
    save_drawing,
)
from pipeline.review.drawing_view import DrawingAnswers, add_vertex, first_drawing, handles, remove_part, take_step
from pipeline.review.pictures import Pictures
from pipeline.review.session import Session

SIZES = {"ring_mm": 0.5, "ring_line_mm": 0.1, "arm_mm": 0.8, "line_mm": 0.1}  # of the marks in the scan
TURN_RAD = 0.004


def true_px(pose: str = "0") -> Array:
    matrix = pixel_from_camera(pose, TURN_RAD)
    return np.array([matrix @ (*place, 1.0) for place in CORNERS])


def place_clicks(places: Array, given: bool = False) -> tuple[ClickedMark, ...]:
    xy = CORNERS if given else [(None, None)] * len(CORNERS)
    return tuple(ClickedMark(str(k), (float(c), float(r)), xy[k - 1]) for k, (c, r) in enumerate(places, 1))


def at_pitch(drawing: CameraDrawing) -> FramePlacement:
    return place_frame(drawing, (400, 400), (PITCH_UM, PITCH_UM), "as the project says")


def measured_px(folder: Path, image: str) -> Array:
    """(4, 2): where the marks of an image were measured."""
    rows = comparator(folder)
    return np.array([[float(rows[image, p][f"{axis}_px"]) for axis in ("col", "row")] for p in "1234"])


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drawing") / "a.tif"
    grey = frame_picture(ALIKE, pixel_from_camera("0", TURN_RAD), 1)
    tifffile.imwrite(path, np.clip(np.rint(grey), 0, 65535).astype(np.uint16))
    return path


@pytest.mark.parametrize("kind", [kind for kind in MARK_TABLES if kind != "polygon"])
def test_a_handle_that_is_dragged_lies_where_it_was_dragged_to(kind: str) -> None:
    """As far as its size allows: a length follows the part of the drag along it; nothing else moves in size."""
    mark = first_drawing(kind, 2.0)
    for handle in handles(mark):
        start = np.array(handle.place_mm)
        along = start / (np.hypot(*start) or 1.0)
        after = handle.dragged(start + 0.3 * along)
        (moved,) = [one for one in handles(after) if one.key == handle.key]
        assert {key for key in after if after[key] != mark.get(key)} <= {handle.key.split(".")[0]}
        again = moved.dragged(np.array(moved.place_mm))
        assert json.dumps(again) == json.dumps(after), handle.key


def test_sizes_are_dragged_and_corners_come_and_go() -> None:
    mark = {"kind": "ring-cross", **SIZES, "gap_mm": 0.0, "angle_deg": 30.0}
    c, s = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    by_key = {one.key: one for one in handles(mark)}
    assert by_key["arm_mm"].dragged(np.array([1.2 * c - 0.5 * s, 1.2 * s + 0.5 * c]))["arm_mm"] == pytest.approx(1.2)
    side = 0.56 * np.array([c, s]) + 0.15 * np.array([-s, c])
    assert by_key["line_mm"].dragged(side)["line_mm"] == pytest.approx(0.3)
    ring = 0.65 * np.array([math.cos(math.radians(-22.5)), math.sin(math.radians(-22.5))])
    assert by_key["ring_line_mm"].dragged(ring)["ring_line_mm"] == pytest.approx(0.3)
    turned = by_key["angle_deg"].dragged(-np.array([math.cos(math.radians(45)), math.sin(math.radians(45))]))
    assert turned["angle_deg"] == pytest.approx(45.0)
    mark = {"kind": "polygon", "vertices_mm": [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]]}
    more = add_vertex(mark, np.array([1.0, -0.2]))
    assert more["vertices_mm"] == [[0.0, 0.0], [1.0, -0.2], [2.0, 0.0], [2.0, 2.0]]
    assert remove_part(more, "vertices_mm.1") == mark
    parts = {"kind": "parts", "part": [{"shape": "disk", "center_mm": [0, 0], "radius_mm": 1.0}] * 2}
    assert len(remove_part(parts, "part.0.radius_mm")["part"]) == 1
    for key in ("part", "part.x", "part.7", "vertices_mm.0", "part.7.vertices_mm"):
        with pytest.raises(InputError, match=r"taken out|to take out"):
            remove_part(parts, key)
    for key in ("vertices_mm", "vertices_mm.9", "radius_mm.0"):
        with pytest.raises(InputError, match=r"taken out|to take out"):
            remove_part(more, key)


def test_given_coordinates_or_the_size_of_the_frame_tell_the_pitch() -> None:
    drawing = CameraDrawing("a", {"kind": "dot"}, place_clicks(true_px("90m"), given=True))
    placement = place_frame(drawing, (400, 400), None, "")
    assert placement.pitch_um == pytest.approx((PITCH_UM, PITCH_UM), rel=1e-3)
    np.testing.assert_allclose(placement.pixel_from_camera, pixel_from_camera("90m", TURN_RAD), atol=0.05)
    corners = ((10.0, 20.0), (10.0 + 3400.0, 20.0 + 3400.0))
    drawing = CameraDrawing("a", {"kind": "dot"}, frame_mm=(17.0, 17.0), corners_px=corners)
    assert place_frame(drawing, (4000, 4000), None, "").pitch_um == pytest.approx((5.0, 5.0))
    with pytest.raises(InputError, match="what a pixel of the scan measures is not known"):
        place_frame(CameraDrawing("a", {"kind": "dot"}), (4000, 4000), None, "")


def test_a_fit_finds_places_and_the_size_and_names_what_the_drawing_does_not_fit(scan: Path, tmp_path: Path) -> None:
    """Drawn 10 % too small, and clicked 3 px off."""
    sizes = {key: 0.9 * value for key, value in SIZES.items()}
    drawing = CameraDrawing("a", {"kind": "ring-cross", **sizes}, place_clicks(true_px() + np.array([3.0, -2.0])), "1")
    with open_scan(scan) as opened:
        fitted = take_step(drawing, at_pitch(drawing), {"fit": True}, opened)
    np.testing.assert_allclose([one.px for one in fitted.marks], true_px(), atol=0.05)
    assert fitted.mark["ring_mm"] == pytest.approx(0.5, rel=0.01)
    assert fitted.marks[0].blur_px == pytest.approx(0.8, abs=0.15)
    # The fifth click is on bare ground.
    marks = (*place_clicks(true_px()), ClickedMark("5", (200.0, 230.0)))
    drawing = CameraDrawing("a", {"kind": "ring-cross", **SIZES}, marks, "1", frame_mm=(17.0, 17.0))
    with open_scan(scan) as opened:
        fitted = take_step(drawing, at_pitch(drawing), {"fit": True}, opened)
        assert [bool(one.unfitted) for one in fitted.marks] == [False] * 4 + [True]
        assert fitted.marks[4].px == (200.0, 230.0)
        save_drawing(fitted, at_pitch(fitted), opened, tmp_path / "camera.toml")
    text = (tmp_path / "camera.toml").read_text()
    assert "# The drawing did not fit at 5: as they were clicked.\n" in text
    moved = take_step(replace(fitted, point="5"), at_pitch(fitted), {"drag": "place", "px": [60.0, 60.0]}, opened)
    assert moved.marks[4].unfitted == ""


@pytest.mark.parametrize(
    ("mark", "statuses"),
    [({"kind": "ring-cross", **SIZES}, {"measured"}), ({"kind": "template", "size_mm": 2.4}, {"measured", "weak"})],
)
def test_a_saved_camera_measures(mark: dict[str, float | str], statuses: set[str], scan: Path, tmp_path: Path) -> None:
    drawing = CameraDrawing("a", mark, place_clicks(true_px()), "1", name="K", frame_mm=(17.0, 17.0))
    with open_scan(scan) as opened:
        camera = save_drawing(drawing, at_pitch(drawing), opened, tmp_path / "camera.toml")
    text = (tmp_path / "camera.toml").read_text()
    assert "xy_mm of 1, 2, 3, 4: from their places in the scan and its pixel, not from a certificate" in text
    assert {one.sigma_mm for one in camera.fiducials} == {(1.0, 1.0)}
    (tmp_path / "project.toml").write_text(PROJECT.replace("*.tif", str(scan)))
    command("measure", tmp_path / "project.toml")
    assert {row["status"] for row in comparator(tmp_path).values()} <= statuses
    np.testing.assert_allclose(measured_px(tmp_path, "a"), true_px(), atol=0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"marks": []}, "click the marks first"),
        ({"frame_mm": [None, None]}, "the frame's size is not known"),
        ({"mark": {"kind": "dot", "radius_mm": -1.0}}, "radius_mm: must be greater than 0"),
        ({"pose": "45"}, "no pose"),
        ({"pitch_um": 0.0}, "more than 0"),
        ({"marks": [{"id": "1", "px": [1.0, 2.0]}] * 2}, "two marks are called '1'"),
        ({"corners_px": "x"}, "the drawing's corners_px"),
    ],
)
def test_what_is_no_camera_is_not_written(change: dict[str, object], words: str, scan: Path, tmp_path: Path) -> None:
    marks = [{"id": one.id, "px": list(one.px)} for one in place_clicks(true_px())]
    given = {"image": "a", "mark": {"kind": "dot", "radius_mm": 0.5}, "marks": marks, "frame_mm": [17.0, 17.0]}

    def save() -> None:
        drawing = parse_drawing(given | change)
        with open_scan(scan) as opened:
            save_drawing(drawing, at_pitch(drawing), opened, tmp_path / "camera.toml")

    with pytest.raises(InputError, match=words):
        save()
    assert not list(tmp_path.iterdir())


def test_a_camera_file_is_not_written_over_unless_it_was_drawn(scan: Path, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('name = "own"\n')
    with pytest.raises(InputError, match=r"own.toml is there already, and was not drawn here"):
        camera_path(tmp_path, "own")
    for name in ("../a", "", ".hidden", "a/b.toml"):
        with pytest.raises(InputError, match="can be no file's name"):
            camera_path(tmp_path, name)
    drawing = CameraDrawing("a", {"kind": "dot", "radius_mm": 0.5}, place_clicks(true_px()), frame_mm=(17.0, 17.0))
    with open_scan(scan) as opened:
        for _ in range(2):
            save_drawing(drawing, at_pitch(drawing), opened, camera_path(tmp_path, "new"))


def test_a_project_whose_camera_is_missing_can_be_opened_to_draw_it(scan: Path, tmp_path: Path) -> None:
    project = tmp_path / "project.toml"
    project.write_text(PROJECT.replace("*.tif", str(scan)).replace("camera.toml", "mine.toml"))
    session = Session(read_undrawn(project), "ann")
    assert (session.camera_name, dict(session.project.cameras)) == ("mine.toml", {})
    alone = read_undrawn(tmp_path / "none.toml", [scan])
    assert list(alone.scans) == ["a"]


@pytest.fixture(scope="module")
def undrawn(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """Folder of a project that has no camera yet, and the address where it is served."""
    folder = tmp_path_factory.mktemp("undrawn")
    (folder / "project.toml").write_text(PROJECT.replace("*.tif", str(scan)))
    with served(folder / "project.toml") as server:
        yield folder, server.address


@needs_browser
def test_a_person_draws_a_camera_and_saves_its_file(browser: Browser, undrawn: tuple[Path, str]) -> None:
    folder, address = undrawn
    with browser_page(browser) as page:
        page.goto(address)
        expect(page.locator("#draw-view")).to_be_visible()  # the project has no camera yet
        expect(page.locator("#draw-pitch-told")).to_contain_text("50.00 × 50.00 µm as the project says")
        box = present(page.locator("#draw-whole").bounding_box())
        for col, row in true_px():
            x, y = box["width"] * col / 400, box["height"] * row / 400
            page.locator("#draw-whole").click(position={"x": x, "y": y})
        expect(page.locator("#draw-marks tr")).to_have_count(4)
        page.locator("#draw-kind").select_option("ring-cross")
        for key in ("ring_mm", "arm_mm"):
            drag_size(page, key, SIZES[key])
        for key in ("line_mm", "ring_line_mm"):
            page.locator(f"#size-{key}").fill(str(SIZES[key]))
            page.locator(f"#size-{key}").press("Enter")
            expect(page.locator(f"#size-{key}")).not_to_be_focused()
        page.locator("#draw-fit").click()
        expect(page.locator("#draw-told")).to_contain_text("Fitted: turned by")
        for key, value in SIZES.items():
            assert float(page.locator(f"#size-{key}").input_value()) == pytest.approx(value, rel=0.05)
        assert page.locator("#draw-left").get_attribute("data-shown")
        for field, text in (("width", "17"), ("height", "17"), ("distance", "30"), ("name", "K")):
            page.locator(f"#draw-{field}").fill(text)
        page.locator("#draw-save").click()
        expect(page.locator("#draw-told")).to_contain_text("camera.toml with 4 marks. Next: reseau measure.")
    camera = read_camera(folder / "camera.toml")
    assert (camera.principal_distance_mm, camera.frame_mm, camera.name) == (30.0, (17.0, 17.0), "K")
    assert [mark.id for mark in camera.fiducials] == ["1", "2", "3", "4"]


def drag_size(page: Page, key: str, value: float) -> None:
    """Its handle, as far as the size is to grow, away from the mark's middle."""
    canvas = page.locator("#draw-mark")
    expect(canvas).to_have_attribute("data-handles", re.compile(f'"{key}"'))
    box, places = present(canvas.bounding_box()), json.loads(canvas.get_attribute("data-handles") or "{}")
    before, arm_mm = (float(page.locator(f"#size-{name}").input_value()) for name in (key, "arm_mm"))
    start = np.array(places[key])
    arm = np.hypot(*(np.array(places["arm_mm"]) - 240)) / arm_mm
    end = start + (start - 240) / np.hypot(*(start - 240)) * arm * (value - before)
    corner, scale = np.array([box["x"] + 1, box["y"] + 1]), box["width"] / 480
    page.mouse.move(*(corner + scale * start))
    page.mouse.down()
    page.mouse.move(*(corner + scale * end), steps=3)
    page.mouse.up()
    is_there = "([field, value]) => Math.abs(document.querySelector(field).value - value) < 0.04"
    page.wait_for_function(is_there, arg=[f"#size-{key}", value])


OFF_MM = 5.0  # of the given coordinates: nothing recurs about them
LEARNED = (
    'name = "K"\nframe_mm = [17.0, 17.0]\n'
    + fiducial_tables({id: (x + OFF_MM, y + OFF_MM) for id, (x, y) in PLACES.items()}, 'mark = "m"\n')
    + '[mark.m]\nkind = "learned"\nsize_mm = 2.4\n'
)


def learned_px(image: str) -> Array:
    """(4, 2): where marks were drawn."""
    matrix = pixel_from_camera("0", 0.004 * ("abc".index(image) + 1))
    return np.array([matrix @ (*place, 1.0) for place in CORNERS])


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """What `measure` cannot learn by itself."""
    path = write_project(tmp_path / "p", "abc", PROJECT)
    path.with_name("camera.toml").write_text(LEARNED)
    return path


@pytest.mark.study
@needs_browser
def test_marks_are_shown_and_learned(project: Path, printed_line: Printed, refusal: Refusal, browser: Browser) -> None:
    assert "reseau review" in refusal("measure", project)
    with served(project) as server, browser_page(browser) as page:
        page.goto(server.address)
        expect(page.locator("#left")).to_have_text("1 left: 1 camera")
        shown = show_marks(page)
        page.keyboard.press("m")
        for name in "abc":  # its own picture tells nothing of the place in the scan that it is from
            expect(page.locator("#trial")).to_contain_text(
                f"{name}: 4 {'weak' if name == shown else 'measured'}; scan orientation 0."
            )
        expect(page.locator("#tries figure")).to_have_count(12)
        page.keyboard.press("Enter")
        expect(page.locator("#left")).to_have_text("No open questions. Run reseau measure.")
    (one,) = decisions(project.parent)
    assert (one["decision"], one["image"], set(one["px"])) == ("learn", shown, set("1234"))
    assert "Decisions stand behind these marks: 1 of ann." in printed_line("measure", project)
    off = np.array([measured_px(project.parent, name) - learned_px(name) for name in "abc"])
    assert {row["status"] for row in comparator(project.parent).values()} == {"measured"}
    assert np.abs(off).max() < 2.0  # as well as somebody clicks
    assert np.abs(off - off.mean(axis=0)).max() < 0.06  # alike in all frames


def show_marks(page: Page) -> str:
    """The name of the scan that the page offers, its marks clicked by keys."""
    expect(page.locator("#whole")).to_be_focused()
    shown = page.locator("#scan").input_value()
    for number, place in enumerate(learned_px(shown), 1):
        page.keyboard.press(str(number))
        steer(page, "whole", place)
        page.keyboard.press("Enter")
        expect(page.locator("#near")).to_be_focused()
        steer(page, "near", place)
        page.keyboard.press("Enter")
    return shown


def test_marks_of_one_scan_are_saved_as_a_camera_file(project: Path) -> None:
    """It measures the other scans at once: their marks lie as much off as the clicks."""
    pictures, off = Pictures(), np.array([1.0, -1.0])
    answers = DrawingAnswers(Session(read_project(project), "ann"), pictures)
    px = {point: (place + off).tolist() for point, place in zip("1234", learned_px("a"), strict=True)}
    with pytest.raises(InputError, match="click 4, too"):
        answers.save_learned({}, {"image": "a", "px": {p: px[p] for p in "123"}, "file": "own"})
    result = answers.save_learned({}, {"image": "a", "px": px, "file": "own"})
    pictures.close()
    assert "own.toml with 4 marks" in result["text"]
    assert 'name it in the project, camera = "own.toml"' in result["text"]
    project.write_text(PROJECT.replace("camera.toml", "own.toml").replace("*.tif", "b.tif"))
    assert command("measure", project) == 0
    found = measured_px(project.parent, "b")
    np.testing.assert_allclose(found - learned_px("b"), np.broadcast_to(off, (4, 2)), atol=0.1)


def learn(image: str, points: str = "1234", **rest: Any) -> Decision:
    px = {point: tuple(np.round(place).tolist()) for point, place in zip(points, learned_px(image), strict=False)}
    return Decision(image, DecisionKind.LEARN, kind="learned", px=px, **rest)


def test_the_last_scan_that_was_shown_counts_but_for_the_camera_files(project: Path) -> None:
    path = project.with_name("decisions.jsonl")
    append_decisions(path, [learn("a", who="ann"), learn("c"), Decision("a", DecisionKind.REJECT, "1", "fiducial")])
    assert project_clicks(project) == ("c", "somebody")
    append_decisions(path, [Decision("c", DecisionKind.UNDO, kind="learned")])
    assert project_clicks(project) == ("a", "ann")
    append_decisions(path, [Decision("a", DecisionKind.UNDO), Decision("a", DecisionKind.UNDO, kind="learned")])
    assert project_clicks(project) is None
    with project.with_name("camera.toml").open("a") as camera:
        camera.write('[clicks]\nscan = "b.tif"\n[clicks.px]\n' + "".join(f"{point} = [5, 5]\n" for point in "1234"))
    append_decisions(project.with_name("decisions.jsonl"), [learn("a")])
    assert project_clicks(project) == ("b", "")


def project_clicks(project: Path) -> tuple[str, str] | None:
    clicks = read_project(project).default_camera.clicks
    return None if clicks is None else (clicks.scan, clicks.who)


def test_nothing_is_learned_from_another_file_of_the_same_name(project: Path, refusal: Refusal) -> None:
    append_decisions(project.with_name("decisions.jsonl"), [learn("a", fingerprint="0" * 64)])
    assert "shown in a, whose file is another one since" in refusal("measure", project)
