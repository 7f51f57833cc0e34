"""A plugin of pytest: a test that is no study fails where it takes more than 2 s of CPU time of a quiet machine.

CPU time is counted, so that waiting does not matter. A slow or busy machine takes up to twice as long for the same
work: what a test took is divided by how much longer a fixed piece of work takes there and then.
"""

import os
import time
from collections.abc import Generator
from typing import Any

import pytest

MOST_CPU_S = 2.0
YARDSTICK_S = 0.024  # CPU time of the fixed piece of work on a quiet machine of 2026
TOO_LONG = """took {0:.1f} s of CPU time, its processes and its own fixtures included; on a quiet machine {1:g} s
are allowed. Make it smaller (a smaller picture, fewer frames, a fixture that the module shares), or mark it `study`
and keep a quick test of the same behaviour."""
begin_s = pytest.StashKey[float]()  # CPU time at which the test began; what fixtures take that others share moves it


def cpu_s() -> float:
    """CPU time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def slowness(trials: int = 80) -> float:
    """How many times as long as on a quiet machine this process takes now, at least 1: the worst of two seconds, for
    what else a machine does comes and goes, and a sound test must not fail."""
    worst_s = YARDSTICK_S
    for _ in range(trials):
        before = time.process_time()
        sum(number * number % 7 for number in range(300_000))
        worst_s = max(worst_s, time.process_time() - before)
    return worst_s / YARDSTICK_S


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
    quick = item.get_closest_marker("study") is None
    report = yield
    spent_s = cpu_s() - item.session.stash[begin_s]
    if call.when == "call" and report.passed and quick and spent_s > MOST_CPU_S and spent_s > MOST_CPU_S * slowness():
        report.outcome, report.longrepr = "failed", TOO_LONG.format(spent_s, MOST_CPU_S)
    return report
