"""Marks that nobody has drawn, shown on the review page in one scan: with keys alone, before anything is measured."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser_page, needs_browser
from brute_marks import Array
from drawn_frames import CORNERS, pixel_from_camera
from drawn_project import PROJECT, write_project
from playwright.sync_api import Browser, Page, expect
from review_pages import comparator, decisions, steer
from review_server import Served, served

from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.decisions_file import Choice, Decision, append_decisions
from pipeline.files.project_file import read_project
from pipeline.review.drawing_view import DrawingAnswers
from pipeline.review.pictures import Pictures
from pipeline.review.requests import Query
from pipeline.review.session import Session

NAMES = ("a", "b", "c")
OFF_MM = 5.0  # of the given coordinates: nothing recurs about them
LEARNED = (
    'name = "K"\nframe_mm = [17.0, 17.0]\n'
    + "".join(
        f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x + OFF_MM}, {y + OFF_MM}]\nmark = "m"\n'
        for number, (x, y) in enumerate(CORNERS, 1)
    )
    + '[mark.m]\nkind = "learned"\nsize_mm = 2.4\n'
)


def true_px(image: str) -> Array:
    """(4, 2): where marks were drawn."""
    matrix = pixel_from_camera("0", 0.004 * (NAMES.index(image) + 1))
    return np.array([matrix @ (*place, 1.0) for place in CORNERS])


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """What `measure` cannot learn by itself."""
    path = write_project(tmp_path / "p", NAMES, PROJECT)
    path.with_name("camera.toml").write_text(LEARNED, encoding="utf-8")
    return path


@pytest.fixture
def server(project: Path) -> Iterator[Served]:
    with served(project) as one:
        yield one


@pytest.mark.study
@needs_browser
def test_marks_are_shown_in_one_scan_by_keys_tried_at_once_and_learned_from_there(
    project: Path, capsys: pytest.CaptureFixture[str], browser: Browser, server: Served
) -> None:
    assert run(["measure", str(project)]) == 2
    assert "reseau review" in capsys.readouterr().err
    with browser_page(browser) as page:
        page.goto(server.address)
        expect(page.locator("#left")).to_have_text("1 left: 1 camera")
        shown = show_marks(page)
        page.keyboard.press("m")
        for name in NAMES:  # its own picture tells nothing of the place in the scan that it is from
            expect(page.locator("#trial")).to_contain_text(
                f"{name}: 4 {'weak' if name == shown else 'measured'}; pose 0."
            )
        expect(page.locator("#tries figure")).to_have_count(12)
        page.keyboard.press("Enter")
        expect(page.locator("#left")).to_have_text("Nothing is left. Run reseau measure.")
    (one,) = decisions(project.parent)
    assert (one["decision"], one["image"], set(one["px"])) == ("learn", shown, set("1234"))
    assert run(["measure", str(project)]) == 0
    assert "Decisions stand behind these marks: 1 of ann." in " ".join(capsys.readouterr().out.split())
    rows = comparator(project.parent)
    places = {
        n: np.array([[float(rows[n, p][f"{axis}_px"]) for axis in ("col", "row")] for p in "1234"]) for n in NAMES
    }
    off = np.array([places[name] - true_px(name) for name in NAMES])
    assert {row["status"] for row in rows.values()} == {"measured"}
    assert np.abs(off).max() < 2.0  # as well as somebody clicks
    assert np.abs(off - off.mean(axis=0)).max() < 0.06  # alike in all frames


def show_marks(page: Page) -> str:
    """The name of the scan that the page offers, its marks clicked by keys."""
    expect(page.locator("#whole")).to_be_focused()
    shown = page.locator("#scan").input_value()
    for number, place in enumerate(true_px(shown), 1):
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
    px = {point: (place + off).tolist() for point, place in zip("1234", true_px("a"), strict=True)}
    with pytest.raises(InputError, match="click 4, too"):
        answers.save_learned(Query({}), {"image": "a", "px": {p: px[p] for p in "123"}, "file": "own"})
    result = answers.save_learned(Query({}), {"image": "a", "px": px, "file": "own"})
    pictures.close()
    assert "own.toml with 4 marks" in result["text"]
    assert 'name it in the project, camera = "own.toml"' in result["text"]
    project.write_text(PROJECT.replace("camera.toml", "own.toml").replace("*.tif", "b.tif"), encoding="utf-8")
    assert run(["measure", str(project)]) == 0
    rows = comparator(project.parent)
    found = np.array([[float(rows["b", p][f"{axis}_px"]) for axis in ("col", "row")] for p in "1234"])
    np.testing.assert_allclose(found - true_px("b"), np.broadcast_to(off, (4, 2)), atol=0.1)


def learn(image: str, points: str = "1234", **rest: Any) -> Decision:
    px = {point: tuple(np.round(place).tolist()) for point, place in zip(points, true_px(image), strict=False)}
    return Decision(image, Choice.LEARN, kind="learned", px=px, **rest)


def test_the_last_scan_that_was_shown_counts_and_undo_takes_it_back(project: Path) -> None:
    path = project.with_name("decisions.jsonl")
    append_decisions(path, [learn("a", who="ann"), learn("c"), Decision("a", Choice.REJECT, "1", "fiducial")])
    assert project_clicks(project) == ("c", "somebody")
    append_decisions(path, [Decision("c", Choice.UNDO, kind="learned")])
    assert project_clicks(project) == ("a", "ann")
    append_decisions(path, [Decision("a", Choice.UNDO), Decision("a", Choice.UNDO, kind="learned")])
    assert project_clicks(project) is None


def project_clicks(project: Path) -> tuple[str, str] | None:
    clicks = read_project(project).default_camera.clicks
    return None if clicks is None else (clicks.scan, clicks.who)


def test_what_the_camera_file_shows_is_not_settled_again(project: Path) -> None:
    with project.with_name("camera.toml").open("a") as camera:
        camera.write('[clicks]\nscan = "b.tif"\n[clicks.px]\n' + "".join(f"{point} = [5, 5]\n" for point in "1234"))
    append_decisions(project.with_name("decisions.jsonl"), [learn("a")])
    assert project_clicks(project) == ("b", "")


def test_marks_that_are_missing_are_named(project: Path) -> None:
    append_decisions(project.with_name("decisions.jsonl"), [learn("a", "123")])
    with pytest.raises(InputError, match="learn the marks of K from a says nothing of 4"):
        read_project(project)


def test_nothing_is_learned_from_another_file_of_the_same_name(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    append_decisions(project.with_name("decisions.jsonl"), [learn("a", fingerprint="0" * 64)])
    assert run(["measure", str(project)]) == 2
    assert "shown in a, whose file is another one since" in capsys.readouterr().err


@pytest.mark.parametrize("px", ["{}", '{"1": [3]}', '{"1": [3, "a"]}', "[]"])
def test_a_line_without_places_is_named(px: str, project: Path) -> None:
    line = json.dumps({"image": "a", "decision": "learn"})[:-1] + f', "px": {px}}}\n'
    project.with_name("decisions.jsonl").write_text(line)
    with pytest.raises(InputError, match="line 1, px: must be columns and rows by fiducial"):
        read_project(project)
