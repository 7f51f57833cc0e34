"""Reasons and their codes: one table, checked against the documentation and against every place that gives a reason."""

import ast
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from measure.flags import NO_REASON, Code, Reason, Status
from measure.results import FrameMeasurement, MarkMeasurement

ROOT = Path(__file__).parents[2]


def test_every_code_has_a_meaning_and_is_short() -> None:
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)?", code) for code in Code)
    assert all(code.meaning.endswith(".") for code in Code)


def test_the_page_has_the_table() -> None:
    page = (ROOT / "docs" / "reference" / "statuses.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z-]+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert rows == {str(code): code.meaning for code in Code}


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
