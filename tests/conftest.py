"""What all tests share: the last line of a run says what was left out for want of data."""

import pytest
from real_data import DATA, REASON


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    left_out = [each for each in terminalreporter.stats.get("skipped", []) if REASON in str(each.longrepr)]
    if left_out:
        terminalreporter.write_line(f"LEFT OUT: {len(left_out)} tests that need real data in {DATA}", yellow=True)
