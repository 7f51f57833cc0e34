"""How far measuring is and how long it takes, in words."""

import io

import pytest
from rich.console import Console

from pipeline.progress import Reporter, time_left
from pipeline.terminal import PlainConsole
from pipeline.text.wording import count_sentence


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "about a minute left"),
        (110.0, "about 2 minutes left"),
        (3000.0, "about 50 minutes left"),
        (9000.0, "about 2.5 hours left"),
    ],
)
def test_the_rest_takes_so_long(seconds: float, words: str) -> None:
    assert time_left(seconds) == words


def lines(quiet: bool = False, terminal: bool = False) -> list[str]:
    text = io.StringIO()
    console = PlainConsole(file=text, width=200, force_terminal=terminal, quiet=quiet)
    with Reporter(console).stage("measured") as count:
        for done in range(1, 31):
            count("scans, 2 of 5 groups", done, 30, left_s=200.0)
    return text.getvalue().splitlines()


def test_thirty_scans_are_two_lines_where_there_is_no_terminal() -> None:
    """The first and the last: between them lines come at intervals only."""
    assert lines() == [
        "measured 1 of 30 scans, 2 of 5 groups, about 3 minutes left",
        "measured 30 of 30 scans, 2 of 5 groups",
    ]


def test_a_terminal_has_one_line_and_who_is_quiet_none() -> None:
    assert any("measured 30 of 30 scans, 2 of 5 groups" in line for line in lines(terminal=True))
    assert lines(quiet=True) == lines(quiet=True, terminal=True) == []
    assert Reporter(quiet=True)._console.quiet
    assert isinstance(Reporter()._console, Console)


def test_scans_are_counted_in_one_form() -> None:
    rest = {"without a camera": 3, "broken": 0}
    assert count_sentence("can be measured", 15, 18, rest) == "15 of 18 scans can be measured (3 without a camera)"
    assert count_sentence("measured", 1, 1, {}) == "1 of 1 scan measured"
