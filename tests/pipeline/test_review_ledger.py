"""Decisions read on as others write them: what stands is what a reading of the whole file gives."""

import random
from pathlib import Path

from pipeline.files.decision import Choice, Decision
from pipeline.files.decisions_file import append_decisions, read_decisions, standing
from pipeline.review.session import Ledger


def some(rng: random.Random, count: int) -> list[Decision]:
    choices = (Choice.ACCEPT, Choice.REJECT, Choice.UNDO)
    return [
        Decision(rng.choice("abc"), rng.choice(choices), rng.choice("12"), "fiducial", note=str(rng.random()))
        for _ in range(count)
    ]


def check(ledger: Ledger, path: Path) -> None:
    stands = standing(read_decisions(path))
    assert {about: ledger.get(about) for about in stands} == dict(stands)
    for image in "abc":
        assert {one.subject: one for one in ledger.image_decisions(image)} == {
            a: o for a, o in stands.items() if a[0] == image
        }


def test_only_what_is_new_is_reported(tmp_path: Path) -> None:
    path, rng = tmp_path / "decisions.jsonl", random.Random(3)
    ledger = Ledger(path)
    assert ledger.update() == frozenset()  # there is no file yet
    append_decisions(path, some(rng, 5))
    assert ledger.update() is None
    for count in (1, 40, 3):
        new = some(rng, count)
        append_decisions(path, new)
        assert ledger.update() == frozenset(one.image for one in new)
        assert ledger.update() == frozenset()
        check(ledger, path)


def test_a_file_that_is_another_one_is_read_anew(tmp_path: Path) -> None:
    """Taken from version control, edited in its place, cut short by a crash, gone."""
    path, rng = tmp_path / "decisions.jsonl", random.Random(4)
    ledger = Ledger(path)
    append_decisions(path, some(rng, 30))
    ledger.update()
    other = tmp_path / "other"
    append_decisions(other, some(rng, 60))
    other.replace(path)
    assert ledger.update() is None
    check(ledger, path)
    text = path.read_text().replace('"reject"', '"accept"') + path.read_text()
    path.write_text(text)
    assert ledger.update() is None
    check(ledger, path)
    with path.open("a") as file:
        file.write('{"image": "a", "deci')
    ledger.update()
    append_decisions(path, some(rng, 3))
    assert ledger.update() is None
    check(ledger, path)
    path.unlink()
    assert ledger.update() is None
    check(ledger, path)
