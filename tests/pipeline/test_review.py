"""The review page: who may ask, windows of scans, decisions, and a person's whole session in a real browser."""

import json
import shutil
import sqlite3
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from urllib.parse import quote

import cv2
import numpy as np
import pytest
import review_server as review
import tifffile
from browser import browser_page, needs_browser
from playwright.sync_api import Browser, Page, expect
from projects import Capture, Printed, command, copied, write_project

from measure.fiducials.options import Click, FiducialOptions
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement
from pipeline import read_project
from pipeline.archive.review_decisions import after_checks, apply_decisions, before_checks
from pipeline.errors import InputError, WriteError
from pipeline.files.camera_file import CameraFile
from pipeline.files.decisions_file import Decision, DecisionKind, append_decisions, read_decisions, standing
from pipeline.files.project_file import Project
from pipeline.measuring.scan_task import ScanOptions, ScanTask
from pipeline.results.measured_record import MeasuredScan
from pipeline.review.pictures import Pictures, _overlapping_pixels
from pipeline.review.session import Filters, Session


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's folder, measured once."""
    return review.measured_faults(tmp_path_factory.mktemp("review") / "faults")


@pytest.fixture(scope="module")
def server(measured_folder: Path) -> Iterator[review.Served]:
    with review.served(measured_folder / "project.toml") as one:
        yield one


@pytest.fixture
def page(browser: Browser, server: review.Served, measured_folder: Path) -> Iterator[Page]:
    """The page, nothing being decided yet."""
    (measured_folder / "decisions.jsonl").unlink(missing_ok=True)
    with browser_page(browser) as one:
        one.goto(server.address)
        expect(one.locator("#left")).to_contain_text("3 left: 1 frame, 2 marks")
        yield one


def test_the_command_serves_its_project(tmp_path: Path, printed: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    project = write_project(tmp_path / "p", ["a"])

    def serve(given: Project, port: int, who: str | None, opens: bool, say: Callable[[str], None]) -> None:
        assert (given.path, port, who, opens) == (project, 7, "ann", False)
        say("http://127.0.0.1:7/?token=t")

    monkeypatch.setattr("pipeline.review.server.serve", serve)
    lines = printed("review", project, "--no-browser", "--who", "ann", "--port", "7").splitlines()
    assert lines[0] == "http://127.0.0.1:7/?token=t"
    assert f"reseau run {project}" in lines[-1]


def test_only_who_has_the_address_is_answered(server: review.Served) -> None:
    for path in ("/", "/?token=guessed", "/api/queue", "/static/review.js", "/api/frame.png?image=good"):
        assert review.request(server, path)[0] == 403
    cookie = {"Cookie": review.get_cookie(server)}
    status, headers, text = review.request(server, "/api/queue", cookie)
    assert status == 200
    assert json.loads(text)["total"] == 3
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "0.0.0.0:1"])
def test_another_host_name_is_refused(host: str, server: review.Served) -> None:
    assert review.request(server, "/api/queue", {"Cookie": review.get_cookie(server), "Host": host})[0] == 403


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "https://127.0.0.1"])
def test_only_the_page_itself_may_decide(origin: str | None, server: review.Served, measured_folder: Path) -> None:
    decision = {"image": review.GOOD, "point": "1", "kind": "fiducial", "decision": "accept"}
    headers = {"Cookie": review.get_cookie(server)} | ({} if origin is None else {"Origin": origin})
    assert review.request(server, "/api/decide", headers, "POST", json.dumps({"decisions": [decision]}))[0] == 403
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
def test_images_and_marks_are_names_and_never_paths(path: str, server: review.Served) -> None:
    assert review.request(server, path, {"Cookie": review.get_cookie(server)})[0] == 404


@pytest.mark.parametrize(
    ("decision", "words"),
    [
        ({"image": "../good", "point": "1", "kind": "fiducial", "decision": "accept"}, "no image or mark '../good'"),
        ({"image": review.GOOD, "point": "9", "kind": "fiducial", "decision": "accept"}, "no image or mark '9'"),
        ({"image": review.BARE, "point": "3", "kind": "fiducial", "decision": "accept"}, "nothing was measured"),
        ({"image": review.GOOD, "point": "1", "kind": "fiducial", "decision": "keep"}, "must be one of accept"),
        ({"image": review.GOOD, "decision": "pose", "pose": "45"}, "pose: must be one of 0"),
        (
            {"image": review.GOOD, "point": "1", "kind": "fiducial", "decision": "place", "col_px": 99999, "row_px": 5},
            "column 99999, row 5 is outside of the scan of",
        ),
        ("accept", "dictionary"),
    ],
)
def test_wrong_decisions_are_refused(
    decision: object, words: str, server: review.Served, measured_folder: Path
) -> None:
    right = {"image": review.GOOD, "point": "1", "kind": "fiducial", "decision": "absent"}
    headers = {"Cookie": review.get_cookie(server), "Origin": server.origin}
    status, _, text = review.request(
        server, "/api/decide", headers, "POST", json.dumps({"decisions": [right, decision]})
    )
    assert status == 400
    assert words in text
    assert not (measured_folder / "decisions.jsonl").exists()


@needs_browser
def test_a_session_by_keyboard_alone_leads_to_the_right_marks(page: Page, measured_folder: Path) -> None:
    rows = review.comparator(measured_folder)
    place_frame_by_keys(page)
    expect(page.locator("#left")).to_contain_text("2 left: 2 marks")
    for done in range(2):
        expect(page.locator("#mark-view")).to_be_visible()
        name = page.locator("#title").inner_text()
        if name.startswith(review.SCRATCHED):  # the other one has no fit
            expect(page.locator("#facts")).to_contain_text("standard deviations")
        page.keyboard.press("n" if name.startswith(review.BARE) else "a")
        expect(page.locator("#left")).not_to_contain_text(f"{2 - done} left")
        if done == 0:
            expect(page.locator("#title")).not_to_have_text(name)
    expect(page.locator("#left")).to_have_text("No open questions. Run reseau measure.")
    result = review.decisions(measured_folder)
    assert {(one["image"], one.get("point"), one["decision"]) for one in result} == {
        (review.BARE, "3", "absent"),
        (review.SCRATCHED, "3", "accept"),
        *((review.TURNED, point, "place") for point in "123"),
    }
    assert all(one["who"] == "ann" and one["fingerprint"] and one["when"] for one in result)
    check_measured_again(measured_folder, rows)


@needs_browser
def test_a_click_in_a_marks_picture_places_it(page: Page, measured_folder: Path) -> None:
    open_entry(page, review.BARE)
    canvas = page.locator("#mark")
    box = canvas.bounding_box()
    assert box is not None
    canvas.click(position={"x": box["width"] / 2 + 56, "y": box["height"] / 2})  # a tenth of the picture's width
    expect(page.locator("#left")).to_contain_text("2 left")
    (one,) = review.decisions(measured_folder)
    assert (one["decision"], one["image"], one["point"]) == ("place", review.BARE, "3")
    off_px = np.array([one["col_px"], one["row_px"]]) - review.mark_px(review.BARE, "3")
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
        review.steer(page, "whole", review.mark_px(review.TURNED, number))
        page.keyboard.press("Enter")
        expect(page.locator("#near")).to_be_focused()
        review.steer(page, "near", review.mark_px(review.TURNED, number))
        page.keyboard.press("Enter")
    page.keyboard.press("m")
    expect(page.locator("#trial")).to_contain_text("4 measured; scan orientation 0.")
    page.keyboard.press("Enter")


def check_measured_again(folder: Path, before: Mapping[tuple[str, str], Mapping[str, str]]) -> None:
    """Measured with the decisions: the rows that they are about changed, and no others."""
    copy = folder.parent / "again"
    try:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
    except shutil.Error:  # the page's server closed its database meanwhile, whose log is then gone
        shutil.copytree(folder, copy, dirs_exist_ok=True)
    command("measure", copy / "project.toml")
    after = review.comparator(copy)
    assert {key for key in before if before[key] != after[key]} == {
        (review.BARE, "3"),
        (review.SCRATCHED, "3"),
        *((review.TURNED, point) for point in "1234"),
    }
    assert after[review.BARE, "3"]["status"] == "absent"
    assert after[review.SCRATCHED, "3"]["status"] == "measured"
    for point in "1234":
        row = after[review.TURNED, point]
        assert row["status"] == "measured", row
        place = np.array([float(row["col_px"]), float(row["row_px"])])
        np.testing.assert_allclose(place, review.mark_px(review.TURNED, point), atol=0.1)


@pytest.mark.study
@needs_browser
def test_a_marks_frame_takes_another_pose_and_that_back(page: Page, measured_folder: Path) -> None:
    open_entry(page, review.SCRATCHED)
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
    result = [(one["image"], one["decision"], one.get("pose")) for one in review.decisions(measured_folder)]
    assert result == [(review.SCRATCHED, "pose", "90"), (review.SCRATCHED, "undo", None)]


def test_the_next_question_that_is_left_is_reported_wherever_it_stands(measured_folder: Path) -> None:
    """Of the frame and the two marks that are asked about, beginning behind the frame."""
    (measured_folder / "decisions.jsonl").unlink(missing_ok=True)
    session = Session(read_project(measured_folder / "project.toml"), "bob")
    for expected, entry in zip((1, 2), session.page(Filters())["entries"][1:], strict=True):
        assert session.page(Filters(), start=1)["next_left"] == expected
        about = (entry["image"], DecisionKind.ABSENT, entry["point"], "fiducial")
        session.decide([Decision(*about, fingerprint=entry["fingerprint"])])
    assert session.page(Filters(), start=1)["next_left"] == 0
    assert session.page(Filters(question="mark"))["next_left"] == -1


def test_a_mark_of_unknown_precision_is_shown_and_an_unfinished_judging_is_none(
    measured_folder: Path, tmp_path: Path
) -> None:
    session = Session(read_project(copied(measured_folder, tmp_path / "copy")), "bob")
    view = next(view for view in map(session.view, session.project.scans) if view.scan.frame.marks)
    names = [(image, one.point) for image in session.project.scans for one in session.view(image).scan.frame.marks]
    similar = {name: session.similar_frames(*name, "fiducial") for name in names}
    assert any(similar.values())
    unknown = Covariance.from_noise(np.diag([np.inf, np.inf]))
    marks = [replace(mark, covariance=unknown) for mark in view.scan.frame.marks]
    frame = replace(view.scan.frame, marks=tuple(marks))
    shown = replace(view, scan=replace(view.scan, frame=frame)).detail_json(marks[0].point, marks[0].kind)
    assert json.loads(json.dumps(shown, allow_nan=False))["covariance"] is None
    with sqlite3.connect(session.project.measurement_path) as database:  # as `reseau measure` begins one
        columns = [row[1] for row in database.execute("pragma table_info(judging)") if row[1] not in ("id", "digest")]
        values = ", ".join(columns)
        database.execute(f"insert into judging (digest, {values}) select 'unfinished 1', {values} from judging limit 1")
    assert {name: session.similar_frames(*name, "fiducial") for name in names} == similar


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


TASK = ScanTask("a", "a.tif", ScanOptions(cast(CameraFile, SimpleNamespace()), None, FiducialOptions()))


def task_key(task: ScanTask) -> str:
    """A stand-in for the fingerprint: what of the options decisions change."""
    fiducials = task.options.fiducials
    return f"{fiducials.pose} {[(click.point, click.col_px) for click in fiducials.clicks]}"


def no_pose(_: str) -> None:
    """In the stand-in for the store no result tells its pose."""


def mark_decision(choice: DecisionKind, point: str = "1", **rest: Any) -> Decision:
    return Decision("a", choice, point, "fiducial", **rest)


def place(point: str, col_px: float, **rest: Any) -> Decision:
    return mark_decision(DecisionKind.PLACE, point, col_px=col_px, row_px=2.0, **rest)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "decisions.jsonl"


def test_a_line_cut_short_does_not_count_and_the_next_one_stands_by_itself(path: Path) -> None:
    append_decisions(path, [mark_decision(DecisionKind.ACCEPT)])
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"image": "a", "deci')
    assert read_decisions(path) == (mark_decision(DecisionKind.ACCEPT),)
    append_decisions(path, [mark_decision(DecisionKind.REJECT)])
    assert [one.decision for one in read_decisions(path)] == [DecisionKind.ACCEPT, DecisionKind.REJECT]
    path.write_bytes(whole.rstrip(b"\n"))  # as an editor leaves it
    append_decisions(path, [mark_decision(DecisionKind.REJECT)])
    assert [one.decision for one in read_decisions(path)] == [DecisionKind.ACCEPT, DecisionKind.REJECT]


def test_a_full_disk_takes_all_lines_back(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a roll, decided at once: none of its lines counts, and the message says so."""
    append_decisions(path, [mark_decision(DecisionKind.ACCEPT)])
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("pipeline.text.files.os.fsync", full)
        with pytest.raises(WriteError, match="Nothing was changed there"):
            append_decisions(path, [Decision(f"f{k}", DecisionKind.POSE, pose="90") for k in range(120)])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "decision",
    [
        place("1", float("nan")),
        place("1", 1e300),
        mark_decision(DecisionKind.ACCEPT, window=(0.0, float("inf"), 1.0, 1.0)),
        Decision("a", DecisionKind.LEARN, px={"1": (float("nan"), 0.0)}),
        mark_decision(DecisionKind.ACCEPT, when="now"),
        mark_decision(DecisionKind.ACCEPT, note="\ud800"),
        Decision("a", DecisionKind.ACCEPT),
    ],
)
def test_what_would_not_be_read_is_not_written(decision: Decision, path: Path) -> None:
    with pytest.raises(InputError, match=r"the decision about a.*Nothing was written"):
        append_decisions(path, [mark_decision(DecisionKind.ACCEPT), decision])
    assert not path.exists()


@pytest.mark.parametrize("line", ['{"image": "a" "point": "1"}', "nothing", "{'image': 'a'}"])
def test_a_typing_error_in_the_last_line_is_named(line: str, path: Path) -> None:
    append_decisions(path, [mark_decision(DecisionKind.ACCEPT)])
    with path.open("a") as file:
        file.write(line)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"line 2: is no JSON"):
        read_decisions(path)
    with pytest.raises(InputError, match=r"its last line: is no JSON.*Nothing was written"):
        append_decisions(path, [mark_decision(DecisionKind.REJECT)])
    assert path.read_bytes() == before


@pytest.mark.study
def test_lines_that_do_not_apply_are_named_and_do_not_count(tmp_path: Path, printed_line: Printed) -> None:
    project = write_project(tmp_path / "p", ["a", "b"])
    path = project.with_name("decisions.jsonl")
    unknown = [
        Decision("z", DecisionKind.REJECT, "1", "fiducial", who="ann"),
        mark_decision(DecisionKind.REJECT, "99", who="ann"),
        mark_decision(DecisionKind.UNDO, "2"),
        mark_decision(DecisionKind.REJECT, "3", fingerprint="another result"),
    ]
    append_decisions(path, unknown)
    with path.open("a") as file:
        file.write('{"image": "a", "decision": "reject", "point": "4"')
    words = (
        "line 1: the project has no image 'z'",
        "line 2: image 'a' has no fiducial '99'",
        "line 3: there is nothing to undo about fiducial '2' of image 'a'",
        "line 4: what was decided about fiducial '3' of image 'a' is of an earlier result",
        "line 5: is cut short, or has a typing error",
    )
    for name in ("measure", "report", "status"):
        output = printed_line(name, project, code=1)
        assert [word for word in words if word not in output] == [], name
        assert "Decisions stand behind" not in output


@pytest.mark.study
def test_a_million_lines_are_read_in_little_more_than_their_json_takes(path: Path) -> None:
    """1.3 times as long."""
    line = '{{"image": "box/{0:05d}", "point": "{1}", "kind": "fiducial", "decision": "reject", "who": "ann"}}'
    path.write_text("\n".join(line.format(k % 50_000, k % 8) for k in range(1_000_000)) + "\n")
    began = time.process_time()
    assert len(read_decisions(path)) == 1_000_000
    reading_s, began = time.process_time() - began, time.process_time()
    with path.open("rb") as file:
        for text in file:
            json.loads(text)
    assert reading_s < 2.5 * (time.process_time() - began)


def test_lines_of_all_forms_are_read_in_their_order(path: Path) -> None:
    """Many at once, as of an archive, with blank lines between them."""
    forms: Sequence[tuple[dict[str, Any], Decision]] = [
        ({"image": "a", "point": "7", "decision": "accept"}, Decision("a", DecisionKind.ACCEPT, "7")),
        (
            {"decision": "place", "image": "b", "point": "7", "kind": "target", "col_px": 3, "row_px": 4.5},
            Decision("b", DecisionKind.PLACE, "7", "target", 3.0, 4.5),
        ),
        (
            {"image": "d", "decision": "learn", "px": {"1": [2, 3.5]}, "who": "ann", "window": [0, 1, 2, 3]},
            Decision(
                "d", DecisionKind.LEARN, kind="learned", who="ann", window=(0.0, 1.0, 2.0, 3.0), px={"1": (2.0, 3.5)}
            ),
        ),
        ({"image": "e", "decision": "undo", "row_px": 0.0}, Decision("e", DecisionKind.UNDO, row_px=0.0)),
    ]
    chosen = np.random.default_rng(3).integers(len(forms), size=200).tolist()
    lines = [json.dumps(forms[form][0]) for form in chosen]
    path.write_text("\n \n".join(lines) + "\n")
    read = read_decisions(path)
    assert [one.line for one in read] == list(range(1, 400, 2))
    assert read == tuple(forms[form][1] for form in chosen)
    lines[150] = lines[150].replace("image", "imagine")
    path.write_text("\n \n".join(lines) + "\n")
    with pytest.raises(InputError, match="line 301, imagine: there is no such key"):
        read_decisions(path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"image": "a", "decision": "acept", "point": "1"}', "line 2, decision.*Did you mean 'accept'"),
        ('{"image": "a", "decision": "accept"}', "line 2, point: is missing"),
        ('{"image": "a", "decision": NaN}', "line 2, decision: must be one of accept.* not nan"),
        ('{"image": "a", "decision": "place", "point": "1", "col_px": 1}', "row_px: must be a number of pixels"),
        ('{"image": "a", "decision": "place", "point": "1", "col_px": true, "row_px": 1}', "col_px: must be a number"),
        ('{"image": "a", "decision": "pose", "pose": "91"}', "pose: must be one of"),
        ('{"image": "a", "decision": "pose", "pose": "90", "point": "1"}', "a scan orientation is of the whole scan"),
        ('{"image": "a", "decision": "accept", "point": "1", "when": "now"}', "when: must be a time"),
        ('["a"]', "line 2: must be a JSON object"),
    ],
)
def test_a_wrong_line_is_named(line: str, words: str, path: Path) -> None:
    path.write_text(f'{{"image": "a", "decision": "accept", "point": "1"}}\n{line}\n')
    with pytest.raises(InputError, match=words):
        read_decisions(path)


def test_decisions_count_in_their_order_and_of_their_own_result() -> None:
    accept, reject, undo = (
        mark_decision(choice) for choice in (DecisionKind.ACCEPT, DecisionKind.REJECT, DecisionKind.UNDO)
    )
    about = accept.subject
    assert standing([accept, reject])[about] is reject
    assert standing([accept, reject, undo])[about] is accept
    assert standing([accept, undo, undo, reject])[about] is reject
    assert standing([accept, undo]) == {}
    old = mark_decision(DecisionKind.ACCEPT, fingerprint="another file")
    own = mark_decision(DecisionKind.REJECT, "2", fingerprint=task_key(TASK))
    assert list(apply_decisions(TASK, [old, own], task_key, no_pose)[1].values()) == [own]
    # Accepted, then another mark placed, then, on what was measured from that, one more rejected.
    accept = mark_decision(DecisionKind.ACCEPT, "1", fingerprint=task_key(TASK))
    placed = place("2", 7.0, fingerprint=task_key(TASK))
    now, _ = apply_decisions(TASK, [accept, placed], task_key, no_pose)
    assert now.options.fiducials.clicks == (Click("2", 7.0, 2.0),)
    reject = mark_decision(DecisionKind.REJECT, "3", fingerprint=task_key(now))
    assert set(apply_decisions(TASK, [accept, placed, reject], task_key, no_pose)[1].values()) == {
        accept,
        placed,
        reject,
    }


def test_decisions_about_marks_count_in_the_pose_in_which_they_were_found() -> None:
    placed = place("2", 7.0, fingerprint=task_key(TASK))
    pose = Decision("a", DecisionKind.POSE, pose="90", fingerprint=task_key(TASK))
    late = mark_decision(
        DecisionKind.ACCEPT, "3", fingerprint=task_key(TASK)
    )  # on a page that was not measured anew yet
    now, counting = apply_decisions(TASK, [pose, late], task_key, no_pose)
    assert now.options.fiducials.pose == "90"
    assert list(counting.values()) == [pose]
    other = replace(pose, pose="180")  # somebody thinks again, on that page
    assert apply_decisions(TASK, [pose, other], task_key, no_pose)[0].options.fiducials.pose == "180"
    undone = Decision("a", DecisionKind.UNDO, fingerprint="whatever is shown")
    assert apply_decisions(TASK, [placed, pose, undone], task_key, no_pose)[0].options.fiducials.pose == "auto"
    # Decided on one page, the pose first or last, before it is measured anew.
    early, late = (mark_decision(DecisionKind.ACCEPT, point, fingerprint=task_key(TASK)) for point in "13")
    found = {task_key(TASK): "90"}
    now, counting = apply_decisions(TASK, [early, pose, late], task_key, found.get)
    assert now.options.fiducials.pose == "90"
    assert set(counting.values()) == {early, pose, late}
    found = {task_key(TASK): "180"}
    assert set(apply_decisions(TASK, [pose, late], task_key, found.get)[1].values()) == {pose}


def make_scan(*marks: MarkMeasurement) -> MeasuredScan:
    return MeasuredScan("a.tif", 100, 100, (20.0, 20.0), FrameMeasurement("a", marks))


def weak(point: str, kind: Any = "fiducial") -> MarkMeasurement:
    covariance = Covariance({Cause.NOISE: 0.01 * np.eye(2)})
    return MarkMeasurement(point, kind, np.ones(2), covariance, Status.WEAK, Reason("a scratch", Code.COVERED))


def test_a_mark_becomes_what_was_settled_and_says_by_whom() -> None:
    choices = {"1": DecisionKind.ACCEPT, "2": DecisionKind.REJECT, "3": DecisionKind.ABSENT}
    counting = {one.subject: one for id, choice in choices.items() if (one := mark_decision(choice, id, who="ann"))}
    scan = make_scan(*(weak(point) for point in "1234"))
    before, after = before_checks(scan, counting), after_checks(scan, counting)
    statuses = [Status.WEAK, Status.REJECTED, Status.ABSENT, Status.WEAK]
    assert [mark.status for mark in before.frame.marks] == statuses
    assert [mark.status for mark in after.frame.marks] == [Status.MEASURED, *statuses[1:]]
    assert "accepted by ann: a scratch" in after.frame.marks[0].reason
    assert [mark.reason.code for mark in after.frame.marks] == ["decided covered", "decided", "decided", "covered"]
    assert after.frame.marks[2].center_px is None
    assert after.reviewers == {"ann": 3}
    assert after_checks(scan, {}) == scan
    bare = MarkMeasurement("1", "fiducial", np.ones(2), None, Status.PREDICTED, Reason("not seen", Code.NOT_FOUND))
    one = mark_decision(DecisionKind.ACCEPT)
    assert after_checks(make_scan(bare), {one.subject: one}).frame.marks[0].status is Status.PREDICTED
    one = Decision("a", DecisionKind.PLACE, "1", "target", col_px=50.0, row_px=60.0)
    (mark,) = after_checks(make_scan(weak("1", "target")), {one.subject: one}).frame.marks
    assert mark.status is Status.WEAK
    np.testing.assert_array_equal(np.asarray(mark.center_px), (50.0, 60.0))


def test_what_is_settled_is_not_open_and_commands_say_whose(tmp_path: Path, capsys: Capture, printed: Printed) -> None:
    """A mark that no scan shows needs a look, until a person says that it is not there."""

    project = write_project(tmp_path / "p", ["a"])
    with project.with_name("camera.toml").open("a") as camera:
        camera.write('[[fiducial]]\nid = "5"\nxy_mm = [7.0, 0.0]\nsigma_mm = 0.01\nmark = "m"\n')
    assert command("measure", project) == 1
    append_decisions(project.with_name("decisions.jsonl"), [mark_decision(DecisionKind.ABSENT, "5", who="ann lee")])
    (stale,) = json.loads(printed("status", project, "--json", code=1))["images"].values()
    assert (stale["verdict"], "not applied yet" in stale["why"]) == ("old", True)
    assert command("measure", project) == 0
    verdicts = json.loads(printed("status", project, "--json"))["verdicts"]
    assert (verdicts["decided"]["scans"], verdicts["good"]["scans"], verdicts["look"]["scans"]) == (1, 0, 0)
    result = "Decisions stand behind these marks: 1 of ann lee."
    for name in ("adjust", "report", "check"):
        command(name, project)
        assert result in " ".join(capsys.readouterr().out.split()), name
    assert result in project.parent.joinpath("out", "report.html").read_text()
    assert command("export", project, "csv", tmp_path / "csv") == 0
    assert result in (tmp_path / "csv" / "README.txt").read_text()
