"""The review page: who may ask, windows of scans, decisions, and a person's whole session in a real browser."""

import json
import shutil
import tracemalloc
from collections.abc import Iterator, Mapping
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np
import pytest
import tifffile
from browser import browser_page, needs_browser
from playwright.sync_api import Browser, Page, expect
from projects import command
from review_server import (
    BARE,
    GOOD,
    SCRATCHED,
    TURNED,
    Served,
    comparator,
    decisions,
    get_cookie,
    mark_px,
    request,
    served,
    steer,
    write_faults,
)

from pipeline import read_project
from pipeline.files.decisions_file import Choice, Decision
from pipeline.review.pictures import Pictures, _overlapping_pixels
from pipeline.review.session import Filters, Session


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's folder, measured once."""
    project = write_faults(tmp_path_factory.mktemp("review") / "faults")
    assert command("measure", project) == 1
    return project.parent


@pytest.fixture(scope="module")
def server(measured_folder: Path) -> Iterator[Served]:
    with served(measured_folder / "project.toml") as one:
        yield one


@pytest.fixture
def page(browser: Browser, server: Served, measured_folder: Path) -> Iterator[Page]:
    """The page, nothing being decided yet."""
    (measured_folder / "decisions.jsonl").unlink(missing_ok=True)
    with browser_page(browser) as one:
        one.goto(server.address)
        expect(one.locator("#left")).to_contain_text("3 left: 1 frame, 2 marks")
        yield one


def test_only_who_has_the_address_is_answered(server: Served) -> None:
    for path in ("/", "/?token=guessed", "/api/queue", "/static/review.js", "/api/frame.png?image=good"):
        assert request(server, path)[0] == 403
    cookie = {"Cookie": get_cookie(server)}
    status, headers, text = request(server, "/api/queue", cookie)
    assert status == 200
    assert json.loads(text)["total"] == 3
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "0.0.0.0:1"])
def test_another_host_name_is_refused(host: str, server: Served) -> None:
    assert request(server, "/api/queue", {"Cookie": get_cookie(server), "Host": host})[0] == 403


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "https://127.0.0.1"])
def test_only_the_page_itself_may_decide(origin: str | None, server: Served, measured_folder: Path) -> None:
    decision = {"image": GOOD, "point": "1", "kind": "fiducial", "decision": "accept"}
    headers = {"Cookie": get_cookie(server)} | ({} if origin is None else {"Origin": origin})
    assert request(server, "/api/decide", headers, "POST", json.dumps({"decisions": [decision]}))[0] == 403
    assert not (measured_folder / "decisions.jsonl").exists()


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        f"/api/frame.png?image={quote('../faults/good')}",
        "/api/mark?image=good&point=9&kind=fiducial",
        "/api/pose.png?image=good&pose=45",
    ],
)
def test_images_and_marks_are_names_and_never_paths(path: str, server: Served) -> None:
    assert request(server, path, {"Cookie": get_cookie(server)})[0] == 404


@pytest.mark.parametrize(
    ("decision", "words"),
    [
        ({"image": "../good", "point": "1", "kind": "fiducial", "decision": "accept"}, "no image or mark '../good'"),
        ({"image": GOOD, "point": "9", "kind": "fiducial", "decision": "accept"}, "no image or mark '9'"),
        ({"image": BARE, "point": "3", "kind": "fiducial", "decision": "accept"}, "nothing was measured"),
        ({"image": GOOD, "point": "1", "kind": "fiducial", "decision": "keep"}, "must be one of accept"),
        ({"image": GOOD, "decision": "pose", "pose": "45"}, "pose: must be one of 0"),
        ("accept", "dictionary"),
    ],
)
def test_wrong_decisions_are_refused(decision: object, words: str, server: Served, measured_folder: Path) -> None:
    right = {"image": GOOD, "point": "1", "kind": "fiducial", "decision": "absent"}
    headers = {"Cookie": get_cookie(server), "Origin": server.origin}
    status, _, text = request(server, "/api/decide", headers, "POST", json.dumps({"decisions": [right, decision]}))
    assert status == 400
    assert words in text
    assert not (measured_folder / "decisions.jsonl").exists()


@needs_browser
def test_a_session_by_keyboard_alone_leads_to_the_right_marks(page: Page, measured_folder: Path) -> None:
    rows = comparator(measured_folder)
    place_frame_by_keys(page)
    expect(page.locator("#left")).to_contain_text("2 left: 2 marks")
    for done in range(2):
        expect(page.locator("#mark-view")).to_be_visible()
        name = page.locator("#title").inner_text()
        page.keyboard.press("n" if name.startswith(BARE) else "a")
        expect(page.locator("#left")).not_to_contain_text(f"{2 - done} left")
        if done == 0:
            expect(page.locator("#title")).not_to_have_text(name)
    expect(page.locator("#left")).to_have_text("No open questions. Run reseau measure.")
    result = decisions(measured_folder)
    assert {(one["image"], one.get("point"), one["decision"]) for one in result} == {
        (BARE, "3", "absent"),
        (SCRATCHED, "3", "accept"),
        *((TURNED, point, "place") for point in "123"),
    }
    assert all(one["who"] == "ann" and one["fingerprint"] and one["when"] for one in result)
    check_measured_again(measured_folder, rows)


@needs_browser
def test_a_click_in_a_marks_picture_places_it(page: Page, measured_folder: Path) -> None:
    open_entry(page, BARE)
    canvas = page.locator("#mark")
    box = canvas.bounding_box()
    assert box is not None
    canvas.click(position={"x": box["width"] / 2 + 56, "y": box["height"] / 2})  # a tenth of the picture's width
    expect(page.locator("#left")).to_contain_text("2 left")
    (one,) = decisions(measured_folder)
    assert (one["decision"], one["image"], one["point"]) == ("place", BARE, "3")
    off_px = np.array([one["col_px"], one["row_px"]]) - mark_px(BARE, "3")
    assert off_px == pytest.approx((0.1 * one["window"][2], 0.0), abs=1.0)


def open_entry(page: Page, image: str) -> None:
    """Its name is shown as text."""
    page.locator("#queue button", has_text=image).first.click()
    expect(page.locator("#title")).to_contain_text(image)
    expect(page.locator("#mark-view")).to_be_visible()
    assert page.locator("main img, nav img").count() == 0


def place_frame_by_keys(page: Page) -> None:
    """The cursor goes from the middle of the scan to near a mark, then exactly to it, three times."""
    expect(page.locator("#whole")).to_be_focused()
    for number in "123":
        page.keyboard.press(number)
        steer(page, "whole", mark_px(TURNED, number))
        page.keyboard.press("Enter")
        expect(page.locator("#near")).to_be_focused()
        steer(page, "near", mark_px(TURNED, number))
        page.keyboard.press("Enter")
    page.keyboard.press("m")
    expect(page.locator("#trial")).to_contain_text("4 measured; pose 0.")
    page.keyboard.press("Enter")


def check_measured_again(folder: Path, before: Mapping[tuple[str, str], Mapping[str, str]]) -> None:
    """Measured with the decisions: the rows that they are about changed, and no others."""
    copy = folder.parent / "again"
    try:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
    except shutil.Error:  # the page's server closed its database meanwhile, whose log is then gone
        shutil.copytree(folder, copy, dirs_exist_ok=True)
    command("measure", copy / "project.toml")
    after = comparator(copy)
    assert {key for key in before if before[key] != after[key]} == {
        (BARE, "3"),
        (SCRATCHED, "3"),
        *((TURNED, point) for point in "1234"),
    }
    assert after[BARE, "3"]["status"] == "absent"
    assert after[SCRATCHED, "3"]["status"] == "measured"
    for point in "1234":
        row = after[TURNED, point]
        assert row["status"] == "measured", row
        place = np.array([float(row["col_px"]), float(row["row_px"])])
        np.testing.assert_allclose(place, mark_px(TURNED, point), atol=0.1)


@pytest.mark.study
@needs_browser
def test_a_marks_frame_takes_another_pose_and_that_back(page: Page, measured_folder: Path) -> None:
    open_entry(page, SCRATCHED)
    page.keyboard.press("f")
    expect(page.locator("#whole-view")).to_be_visible()
    expect(page.locator('#poses button[aria-pressed="true"]')).to_contain_text("0")
    page.keyboard.press("2")
    expect(page.locator("#left")).to_have_text("2 left: 1 frame, 1 mark")  # its mark will have another name
    expect(page.locator("#pose-view")).to_be_hidden()
    page.keyboard.press("f")
    expect(page.locator('#poses button[aria-pressed="true"]')).to_contain_text("90")
    page.keyboard.press("2")
    expect(page.locator("#left")).to_have_text("3 left: 1 frame, 2 marks")
    result = [(one["image"], one["decision"], one.get("pose")) for one in decisions(measured_folder)]
    assert result == [(SCRATCHED, "pose", "90"), (SCRATCHED, "undo", None)]


def test_the_next_question_that_is_left_is_reported_wherever_it_stands(measured_folder: Path) -> None:
    """Of the frame and the two marks that are asked about, beginning behind the frame."""
    (measured_folder / "decisions.jsonl").unlink(missing_ok=True)
    session = Session(read_project(measured_folder / "project.toml"), "bob")
    for expected, entry in zip((1, 2), session.page(Filters())["entries"][1:], strict=True):
        assert session.page(Filters(), start=1)["next_left"] == expected
        about = (entry["image"], Choice.ABSENT, entry["point"], "fiducial")
        session.decide([Decision(*about, fingerprint=entry["fingerprint"])])
    assert session.page(Filters(), start=1)["next_left"] == 0
    assert session.page(Filters(question="mark"))["next_left"] == -1


def test_a_wide_window_takes_little_memory_and_shows_the_scan_in_its_place(tmp_path: Path) -> None:
    """60,000 px of a scan of 700: 125 px become one. Strips of the whole window were held at once: gigabytes."""
    grey = np.zeros((700, 700), np.uint8)
    grey[375:] = 250
    tifffile.imwrite(tmp_path / "a.tif", grey)
    pictures = Pictures()
    tracemalloc.start()
    png = pictures.window(str(tmp_path / "a.tif"), -250, -250, 60_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    pictures.close()
    assert peak < 20e6
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown is not None
    assert shown.shape == (480, 480)
    assert set(np.unique(shown[:2])) == set(np.unique(shown[8:])) == {128}  # beyond the scan
    assert shown[2:5, 2:7].max() == 0
    assert shown[5:7, 2:7].min() == 255
    rng = np.random.default_rng(4)
    for start, extent, side, step in zip(*rng.integers((-100, 1, 1, 2), (120, 80, 30, 9), (500, 4)).T, strict=True):
        touching = [k for k in range(side) if start + k * step < extent and start + (k + 1) * step > 0]
        assert list(_overlapping_pixels(int(start), int(extent), int(side), int(step))) == touching
