"""What the end of a command suggests, by what came out."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.archive.verdicts import Verdict
from pipeline.commands.shared import command_step, print_next, summary_steps
from pipeline.report.verdict import ReportVerdict
from pipeline.summary import Summary

PROJECT = Path("my project.toml")


def summary(*files: str, adjustment: Any = None, parts: int = 0, frames: Any = None, **verdicts: int) -> Any:
    """One that has what the steps depend on."""
    counts = {Verdict[name]: count for name, count in verdicts.items()}
    paths = {word: Path("out", word) for word in files}
    return Summary(
        ReportVerdict("look", "", (), ()),
        frames or {"a": {"measured": 4}},
        {},
        adjustment,
        None,
        paths,
        verdicts=counts,
        parts=parts,
    )


def adjustment(is_calibrated: bool) -> Any:
    return SimpleNamespace(converged=True, cameras={"a": SimpleNamespace(is_calibrated=is_calibrated)})


@pytest.mark.parametrize(
    ("given", "steps"),
    [
        (summary("measurement"), ["reseau run 'my project.toml'"]),
        (summary("measurement", FAILED=2), ["reseau measure 'my project.toml' --retry", "reseau run"]),
        (summary("measurement", OLD=1, WAITING=2), ["reseau measure 'my project.toml'  # 3 scans", "reseau run"]),
        (summary("adjustment", "covariance", adjustment=adjustment(True)), ["reseau check", "reseau report"]),
        (summary("report", adjustment=adjustment(True)), ["open out/report", "reseau export"]),
        (summary("report", adjustment=adjustment(False), LOOK=1, POOR=1), ["open", "reseau review", "reseau resample"]),
        (summary("measurement", frames={"a": {"absent": 4}}, POOR=1), ["reseau cameras --scan SCAN", "reseau review"]),
        (summary("part 1 of 8", parts=8), ["reseau merge 'my project.toml' out/measurement.*-of-8.db"]),
    ],
)
def test_a_summary_calls_for_what_mends_it_then_for_the_next_stage(given: Any, steps: list[str]) -> None:
    found = list(summary_steps(PROJECT, given))
    assert len(found) == len(steps)
    for step, begins in zip(found, steps, strict=True):
        assert step.startswith(begins)


def test_three_steps_at_most_are_printed_each_once_and_none_next_to_json(capsys: pytest.CaptureFixture[str]) -> None:
    print_next(False, "a", "a", "b", command_step("run", PROJECT, why="c"), "d")
    assert capsys.readouterr().out == "Next: a\nNext: b\nNext: reseau run 'my project.toml'  # c\n"
    print_next(True, "a")
    assert capsys.readouterr().out == ""
