"""Who changes what measuring gives raises `MEASURE_REVISION`: else results that were kept would be taken for new ones.

Afterwards `python tests/measure/test_revision.py` writes the table anew, revision.json."""

import ast
import json
import pickle
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from drawn import NUMBERED, draw, ellipse, frame_picture, lay_out, make_scan, measure_grey, pixel_from_camera
from scipy.ndimage import gaussian_filter

from measure import FiducialOptions, FrameMeasurement, MarkMeasurement, TargetPrediction, measure_disks
from measure.boards.measure import measure_board
from measure.boards.specs import ChessboardSpec
from measure.flags import LIMITS, NO_REASON, Cause, Code, Reason, Status
from measure.geometry import Affine
from measure.marks.shapes import MarkShape, polygon, rotate_part
from measure.results import MEASURE_REVISION

TABLE = Path(__file__).with_name("revision.json")
PLACE_PX, SIGMA = 1e-4, 0.01  # which processors may make of rounding; SIGMA is a share
WEDGE = polygon([(0.0, 0.0), (0.9, -0.5), (0.9, 0.5)])
WEDGES = lay_out([MarkShape((rotate_part(WEDGE[0], turn),)) for turn in (135.0, 45.0, -45.0, -135.0)])

Row = tuple[str, tuple[float, ...]]  # status; column, row and their standard deviations


def results() -> dict[str, Row]:
    """What measuring gives of a few small pictures, by their kind and the mark."""
    turned, wedges = frame_picture(NUMBERED, pixel_from_camera("90m")), frame_picture(WEDGES, pixel_from_camera("0"))
    frames = {
        "ring-crosses in a pose that is not known": measure_grey(turned, NUMBERED),
        "wedges in coarse steps": measure_grey(np.rint(wedges / 800) * 800, WEDGES, FiducialOptions("0")),
    }
    marks = {f"{kind}: {mark.point}": mark for kind, frame in frames.items() for mark in frame.marks}
    poses = {f"{kind}: pose {frame.pose.name}": ("", ()) for kind, frame in frames.items() if frame.pose}
    marks |= {f"chessboard: {mark.point}": mark for mark in chessboard()}
    marks |= {f"disks: {mark.point}": mark for mark in disks()}
    return {**poses, **{name: _row(mark) for name, mark in marks.items()}}


def chessboard() -> tuple[MarkMeasurement, ...]:
    squares = np.kron(np.indices((4, 5)).sum(axis=0) % 2, np.ones((24, 24)))
    sharp = np.pad(squares, 24, constant_values=1.0)
    grey = gaussian_filter(sharp, 1.0) * 40000.0 + 5000.0 + np.random.default_rng(3).normal(0.0, 300.0, sharp.shape)
    return measure_board(make_scan(grey), ChessboardSpec(4, 3, 10.0)).marks


def disks() -> tuple[MarkMeasurement, ...]:
    """Five of them, predicted a little off."""
    rng = np.random.default_rng(4)
    grey, predictions = 12000.0 + rng.normal(0.0, 400.0, (120, 300)), []
    for number in range(5):
        place, shape = np.array([40.3 + 52 * number, 60.7]), np.diag([6.0, 5.0])
        col0, row0 = np.round(place).astype(int) - 16
        grey[row0 : row0 + 33, col0 : col0 + 33] += 20000 * draw(ellipse(place - (col0, row0), shape), 33, 33, 0.9)
        predictions.append(TargetPrediction(str(number), place + np.array([3.0, -2.0]), shape, 12.0))
    return measure_disks(make_scan(grey), predictions)


def _row(mark: MarkMeasurement) -> Row:
    numbers = [] if mark.center_px is None else mark.center_px.round(5).tolist()
    if mark.covariance_px2 is not None:
        numbers += np.sqrt(np.diag(mark.covariance_px2)).round(6).tolist()
    return str(mark.status), tuple(numbers)


def differing(before: Mapping[str, Row], now: Mapping[str, Row]) -> list[str]:
    """The marks of which something else is measured than before."""
    return sorted(name for name in before.keys() | now.keys() if not _alike(before.get(name), now.get(name)))


def _alike(before: Row | None, now: Row | None) -> bool:
    if before is None or now is None or before[0] != now[0] or len(before[1]) != len(now[1]):
        return False
    numbers, others = np.array(before[1]), np.array(now[1])
    is_near = bool((np.abs(numbers[:2] - others[:2]) <= PLACE_PX).all())
    return is_near and np.allclose(numbers[2:], others[2:], rtol=SIGMA, atol=2e-6)


def test_what_measuring_gives_is_that_of_its_revision() -> None:
    table = json.loads(TABLE.read_text())
    changed = differing(table["results"], results())
    then = "and run python tests/measure/test_revision.py"
    result = f"{len(changed)} marks, such as {', '.join(changed[:3])}, are measured otherwise"
    assert not changed or table["revision"] != MEASURE_REVISION, f"raise MEASURE_REVISION, {then}: {result}"
    assert table["revision"] == MEASURE_REVISION, f"MEASURE_REVISION was raised: {then}"


def test_another_place_or_status_or_sigma_is_noticed() -> None:
    status, numbers = "measured", (10.0, 20.0, 0.01, 0.02)
    before: dict[str, Row] = {"1": (status, numbers), "pose 0": ("", ())}
    assert not differing(before, {**before, "1": (status, (10.00005, *numbers[1:]))})
    others: list[Row] = [
        (status, (10.0002, *numbers[1:])),
        ("weak", numbers),
        (status, (*numbers[:3], 0.0203)),
        (status, numbers[:2]),
    ]
    for other in others:
        assert differing(before, {**before, "1": other}) == ["1"]
    assert differing(before, {"1": before["1"], "pose 90": ("", ())}) == ["pose 0", "pose 90"]


if __name__ == "__main__":
    written = {"revision": MEASURE_REVISION, "results": results()}
    TABLE.write_text(json.dumps(written, indent=0, ensure_ascii=False) + "\n")


ROOT = Path(__file__).parents[2]


def test_every_code_has_a_meaning_and_is_short() -> None:
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)?", code) for code in Code)
    assert all(each.meaning.endswith(".") for each in (*Code, *Cause))


def test_the_page_has_the_table() -> None:
    page = (ROOT / "docs" / "reference" / "statuses.md").read_text()
    rows = dict(re.findall(r"^\| `([a-z-]+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert rows == {str(code): code.meaning for code in Code}
    assert [cause for cause in Cause if f"\n| {cause.shown} " not in page] == []


def test_every_reason_of_the_code_has_a_code() -> None:
    """Each call of Reason in measure and pipeline: a sentence, then at least one code."""
    calls = [
        (f"{file.relative_to(ROOT)}:{node.lineno}", len(node.args))
        for file, node in nodes()
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Reason"
    ]
    assert len(calls) > 80
    assert [place for place, arguments in calls if arguments == 1] == []


def test_every_code_is_used() -> None:
    used = {
        node.attr
        for file, node in nodes()
        if file.name != "flags.py"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "Code"
    }
    assert used == set(Code.__members__)


@cache
def nodes() -> list[tuple[Path, ast.AST]]:
    """Of the files of measure and pipeline that name a reason or a code."""
    files = [file for package in ("measure", "pipeline") for file in (ROOT / package).rglob("*.py")]
    contents = {file: file.read_text() for file in files}
    named = {file: each for file, each in contents.items() if "Reason(" in each or "Code." in each}
    return [(file, node) for file, each in named.items() for node in ast.walk(ast.parse(each))]


def test_joined_reasons_keep_their_codes_once_each() -> None:
    faint, covered = Reason("it is faint", Code.CONTRAST), Reason("half of it is gone", Code.COVERED, Code.CONTRAST)
    both = Reason.combine((faint, NO_REASON, covered))
    assert both == "it is faint; half of it is gone"
    assert both.codes == (Code.CONTRAST, Code.COVERED)
    assert both.code == "contrast covered"
    assert not Reason.combine((NO_REASON, NO_REASON))


def test_a_reason_survives_processes_and_files() -> None:
    reason = Reason("its place is outside", Code.OUTSIDE, Code.NOT_FOUND)
    for again in (pickle.loads(pickle.dumps(reason)), Reason.read(str(reason), reason.code)):
        assert (again, again.codes) == (reason, reason.codes)
    assert Reason.read("of an earlier version", "").codes == ()
    assert Reason.read("of another version", "edges outside").codes == (Code.OUTSIDE,)


def test_marks_are_filtered_by_their_codes() -> None:
    reasons = {"1": Reason("a", Code.COVERED, Code.SIZE), "2": Reason("b", Code.CONTRAST), "3": Reason("c", Code.SIZE)}
    marks = [MarkMeasurement(id, "fiducial", np.zeros(2), None, Status.PREDICTED, why) for id, why in reasons.items()]
    frame = FrameMeasurement("f", tuple(marks))
    assert [mark.point for mark in frame.marks_because(Code.SIZE)] == ["1", "3"]
    assert frame.marks_because(Code.BLUR) == ()


def test_the_page_has_every_limit_with_its_words() -> None:
    page = (ROOT / "docs" / "method" / "search.md").read_text()
    result = page.split("| limit | of | beyond it |\n|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert result == [f"| {float(limit):g} | {limit.of} | {limit.decides} |" for limit in LIMITS.values()]


def test_every_limit_is_used_and_none_stands_elsewhere() -> None:
    files = [file for package in ("measure", "pipeline") for file in (ROOT / package).rglob("*.py")]
    text = {file: file.read_text() for file in files if file.name != "flags.py"}
    unused = [name for name in LIMITS if not any(re.search(rf"\b{name}\b", each) for each in text.values())]
    assert not unused
    own = [file.name for file, each in text.items() if re.search(r"^_?CHANCE = ", each, re.MULTILINE)]
    assert not own


QUARTER = Affine(np.array([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0]]))  # a quarter turn at twice the size, then (5, 1) farther


def test_an_affine_transformation_takes_points_there_and_back_and_of_two_the_first_first() -> None:
    points = np.array([[[1.0, 0.0], [0.0, 3.0]]])
    np.testing.assert_allclose(QUARTER.apply(points), [[[5.0, 3.0], [-1.0, 1.0]]])
    np.testing.assert_allclose(QUARTER.inverse.apply(QUARTER.apply(points)), points)
    assert QUARTER.scale == pytest.approx(2.0)
    assert Affine.from_linear(np.diag([4.0, -1.0])).scale == pytest.approx(2.0)
    stretch, point = Affine.from_linear(np.diag([3.0, 1.0]), (0.0, 1.0)), np.array([1.0, 1.0])
    np.testing.assert_allclose(QUARTER.compose(stretch).apply(point), [1.0, 7.0])
    np.testing.assert_allclose(stretch.compose(QUARTER).apply(point), [9.0, 4.0])
