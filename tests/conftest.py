"""What all tests share: none takes long, and the last lines of a run say what was left out for want of data, or of a
browser."""

# ruff: noqa: E402
import os

# One BLAS thread a worker: two on two cores make the small factorisations ten times slower. Before NumPy is imported.
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import browser
import cpu_limit
import plain_environment
import pytest
from real_data import DATA, REASON

LONGEST = ("test_plain_installation.py", "test_workers.py")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(cpu_limit)  # beside conftest.py: fixtures of a session are not of this folder


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What the tests of a file share is made once: all tests of a file stay with one worker. Few tests that take long
    begin first, so that no worker is left with them alone at the end."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.path.name))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = [str(each.longrepr) for each in terminalreporter.stats.get("skipped", [])]
    for reason, need in (
        (REASON, f"real data in {DATA}"),
        (browser.REASON, "a browser: install chromium"),
        (plain_environment.NO_COMPILER, "the compiled loops: install with a C compiler there"),
        (plain_environment.REASON, f"an environment without extras: make {plain_environment.READY}"),
    ):
        count = sum(reason in each for each in skipped)
        if count:
            terminalreporter.write_line(f"LEFT OUT: {count} tests that need {need}", yellow=True)
