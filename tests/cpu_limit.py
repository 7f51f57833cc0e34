"""A plugin of pytest: a test that is no study fails where it takes long.

CPU time is counted, so that it does not matter what else a machine does.
"""

import os
from collections.abc import Generator
from typing import Any

import pytest

MOST_CPU_S = 2.0
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
    return report
