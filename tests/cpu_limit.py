"""A plugin of pytest: tests that take more CPU time than a quick test may are listed; those far beyond it fail.

CPU time is counted, so that waiting does not matter. A slow or busy machine still takes two or three times as long for
the same work: the limit that fails a test leaves room for that.
"""

import os
from collections.abc import Generator
from typing import Any

import pytest

LISTED_CPU_S = 2.0
MOST_CPU_S = 6.0
TOO_LONG = """took {0:.1f} s of CPU time, its processes and its own fixtures included; {1:g} s are allowed.
Make it smaller (a smaller picture, fewer frames, a fixture that the module shares), or mark it `study` and keep a quick
test of the same behaviour."""
begin_s = pytest.StashKey[float]()  # CPU time at which the test began; what fixtures take that others share moves it


def cpu_s() -> float:
    """CPU time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.session.stash[begin_s] = cpu_s()


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, Any, Any]:
    before = cpu_s()
    try:
        return (yield)
    finally:
        if fixturedef.scope != "function":
            request.session.stash[begin_s] += cpu_s() - before


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Fails a test that takes too long and is no study."""
    report = yield
    spent_s = cpu_s() - item.session.stash[begin_s]
    if call.when == "call" and report.passed and spent_s > MOST_CPU_S and item.get_closest_marker("study") is None:
        report.outcome, report.longrepr = "failed", TOO_LONG.format(spent_s, MOST_CPU_S)
    if call.when == "call" and spent_s > LISTED_CPU_S and item.get_closest_marker("study") is None:
        report.user_properties.append(("cpu_s", spent_s))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Lists quick tests that took more CPU time than they should."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.getreports(kind)]
    slow = [(spent_s, one.nodeid) for one in reports for name, spent_s in one.user_properties if name == "cpu_s"]
    if slow:
        terminalreporter.section(f"tests of more than {LISTED_CPU_S:g} s of CPU time")
    for spent_s, nodeid in sorted(slow, reverse=True):
        terminalreporter.write_line(f"{spent_s:5.1f} s  {nodeid}")
