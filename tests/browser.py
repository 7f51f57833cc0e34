"""The browser that tests of pages drive: the system's Chromium."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Page, sync_playwright

REASON = "there is no Chromium"
_FOUND = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

needs_browser = pytest.mark.skipif(_FOUND is None, reason=REASON)


@contextmanager
def browser_page(width: int = 1300) -> Iterator[Page]:
    """An empty page. A fault in the scripts of what it shows fails the test."""
    faults = list[str]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_FOUND, args=["--no-sandbox"])
        page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("dialog", lambda dialog: faults.append(dialog.message))
        yield page
        browser.close()
    assert faults == []
