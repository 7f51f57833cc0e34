"""What a person does on the review page, and what comes of it."""

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from brute_marks import Array
from playwright.sync_api import Page


def steer(page: Page, view: str, place_px: Array) -> None:
    """Arrow keys until the cursor, which the page tells, is there to a step of them."""
    page.keyboard.press("ArrowRight")
    before = cursor(page, view)
    page.keyboard.press("ArrowRight")
    step = cursor(page, view) - before
    for axis, (less, more) in enumerate((("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))):
        left = (place_px - cursor(page, view))[axis]
        for _ in range(round(abs(left) / step[0])):
            page.keyboard.press(more if left > 0 else less)


def cursor(page: Page, view: str) -> Array:
    return np.array(json.loads(page.locator(f"#{view}").get_attribute("data-cursor") or "null"), dtype=float)


def decisions(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "decisions.jsonl").read_text(encoding="utf-8").splitlines()]


def comparator(folder: Path) -> Mapping[tuple[str, str], Mapping[str, str]]:
    lines = (folder / "comparator.csv").read_text(encoding="utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {(row["image"], row["point"]): row for row in rows}
