"""The browser that tests of pages drive: the system's Chromium, started once for a file's tests."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

REASON = "there is no Chromium"
_FOUND = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

needs_browser = pytest.mark.skipif(_FOUND is None, reason=REASON)


@contextmanager
def started_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_FOUND, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def browser_page(browser: Browser) -> Iterator[Page]:
    """An empty page, without cookies of earlier ones. A fault in the scripts of what it shows fails the test."""
    faults = list[str]()
    context = browser.new_context(viewport={"width": 1300, "height": 900})
    page = context.new_page()
    page.set_default_timeout(20_000)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("dialog", lambda dialog: faults.append(dialog.message))
    yield page
    context.close()
    assert faults == [], faults
