"""Reasons, false-alarm limits and the revision of what measuring gives."""

import ast
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from measure import FrameMeasurement, MarkMeasurement
from measure.flags import LIMITS, NO_REASON, Cause, Code, Reason, Status
from measure.geometry import Affine

ROOT = Path(__file__).parents[2]


def test_every_code_has_a_meaning_and_is_short() -> None:
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)?", code) for code in Code)
    assert all(each.meaning.endswith(".") for each in (*Code, *Cause))


def test_the_page_has_the_table() -> None:
    page = (ROOT / "docs" / "reference" / "statuses.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z-]+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert rows == {str(code): code.meaning for code in Code}
    assert [cause for cause in Cause if f"\n| {cause.shown} " not in page] == []


def test_every_reason_of_the_code_has_a_code() -> None:
    """Each call of Reason in measure and pipeline: a sentence, then at least one code."""
    calls = [
        (f"{file.relative_to(ROOT)}:{node.lineno}", len(node.args))
        for file, node in matching_nodes("Reason(")
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Reason"
    ]
    assert len(calls) > 80
    assert [place for place, arguments in calls if arguments == 1] == []


def test_every_code_is_used() -> None:
    used = {
        node.attr
        for file, node in matching_nodes("Code.")
        if file.name != "flags.py"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "Code"
    }
    assert used == set(Code.__members__)


def matching_nodes(text: str) -> Iterator[tuple[Path, ast.AST]]:
    for package in ("measure", "pipeline"):
        for file in (ROOT / package).rglob("*.py"):
            content = file.read_text(encoding="utf-8")
            if text in content:
                yield from ((file, node) for node in ast.walk(ast.parse(content)))


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
    with pytest.raises(ValueError, match="nonsense"):
        Reason.read("of a later version", "nonsense")


def test_marks_are_filtered_by_their_codes() -> None:
    reasons = {"1": Reason("a", Code.COVERED, Code.SIZE), "2": Reason("b", Code.CONTRAST), "3": Reason("c", Code.SIZE)}
    marks = [
        MarkMeasurement(name, "fiducial", np.zeros(2), None, Status.PREDICTED, why) for name, why in reasons.items()
    ]
    frame = FrameMeasurement("f", tuple(marks))
    assert [mark.point for mark in frame.marks_because(Code.SIZE)] == ["1", "3"]
    assert frame.marks_because(Code.BLUR) == ()


def test_the_page_has_every_limit_with_its_words() -> None:
    page = (ROOT / "docs" / "method" / "search.md").read_text(encoding="utf-8")
    result = page.split("| limit | of | beyond it |\n|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert result == [f"| {float(limit):g} | {limit.of} | {limit.decides} |" for limit in LIMITS.values()]


def test_every_limit_is_used_and_none_stands_elsewhere() -> None:
    files = [file for package in ("measure", "pipeline") for file in (ROOT / package).rglob("*.py")]
    text = {file: file.read_text(encoding="utf-8") for file in files if file.name != "flags.py"}
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
