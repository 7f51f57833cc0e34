"""How long measuring takes, in words."""

import pytest

from pipeline.archive.work import duration


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.24, "0.2 s"), (5.46, "5.5 s"), (14.6, "15 s"), (110.0, "110 s"), (300.0, "5 minutes"), (9000.0, "2.5 hours")],
)
def test_a_scan_takes_so_long(seconds: float, words: str) -> None:
    """110 s were "1.1e+02 s"."""
    assert duration(seconds, 1) == words
