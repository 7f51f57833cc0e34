"""The limits at which something is refused or doubted: one table, and the page that tells of it."""

import re
from pathlib import Path

from measure.flags import LIMITS

ROOT = Path(__file__).parents[2]


def test_the_page_has_every_limit_with_its_words() -> None:
    page = (ROOT / "docs" / "method" / "search.md").read_text(encoding="utf-8")
    result = page.split("| limit | of | beyond it |\n|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert result == [f"| {float(limit):g} | {limit.of} | {limit.decides} |" for limit in LIMITS.values()]


def test_every_limit_is_used_and_none_stands_elsewhere() -> None:
    files = [file for package in ("measure", "pipeline") for file in (ROOT / package).rglob("*.py")]
    text = {file: file.read_text(encoding="utf-8") for file in files if file.name != "flags.py"}
    unused = [name for name in LIMITS if not any(re.search(rf"\b{name}\b", each) for each in text.values())]
    assert not unused
    own = [file.name for file, each in text.items() if re.search(r"^_?CHANCE = ", each, re.MULTILINE)]
    assert not own
