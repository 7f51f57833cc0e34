"""Which lines of decisions.jsonl change nothing, and why: each is named, and none counts."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.archive.judging import judging_of
from pipeline.archive.store import Store
from pipeline.files.decisions_file import About, Choice, Decision, put_on
from pipeline.files.project_file import Project
from pipeline.text.spelling import did_you_mean

if TYPE_CHECKING:
    from pipeline.archive.work import Work

_TOLD = "decisions that do not apply"
_NAMED = 10

Marks = Mapping[tuple[str, str], bool]  # by point and kind whether something was measured


def tell_inapplicable(project: Project, store: Store, digest: str, work: "Work") -> None:
    """Keep, beside a judging, what is to be said of decisions that it could not take in."""
    told = [*unknown_images(project), *_of_known(project, store, digest, work)]
    store.tell(_TOLD, {"digest": digest, "lines": [f"line {number}: {why}" for number, why in sorted(told)]})


def inapplicable(store: Store, digest: str) -> tuple[str, ...]:
    """What is to be said of the decisions that a judging could not take in; the first of them, if they are many."""
    told = store.told(_TOLD) or {}
    return shortened(told["lines"]) if told.get("digest") == digest else ()


def shortened(lines: Sequence[str]) -> tuple[str, ...]:
    """The first of many."""
    left = len(lines) - _NAMED
    return (*lines[:_NAMED], *([f"and {left} lines more"] if left > 0 else []))


def unknown_images(project: Project) -> Iterator[tuple[int, str]]:
    """Lines about images that the project has not, and a last line that was cut short."""
    if project.decisions_cut_short:
        yield project.decisions_cut_short, "is cut short, or has a typing error. Mend the line, or take it out."
    unknown = {one.image for one in project.decisions} - project.scans.keys() if project.scans else set()
    hints = {image: did_you_mean(image, project.scans) for image in sorted(unknown)[:_NAMED]}
    for one in project.decisions if unknown else ():
        if one.image in unknown:
            yield one.line, f"the project has no image {one.image!r}.{hints.get(one.image, '')}"


def _of_known(project: Project, store: Store, digest: str, work: "Work") -> Iterator[tuple[int, str]]:
    for image, decisions in work.decisions.items():
        if image in project.scans:
            yield from _of_image(decisions, work.counting_of(image), _marks(store, digest, image))


def _of_image(
    decisions: Sequence[Decision], counting: Mapping[About, Decision], marks: Marks
) -> Iterator[tuple[int, str]]:
    stacks = dict[About, list[Decision]]()
    for one in decisions:
        if one.decision is Choice.UNDO and not stacks.get(one.about):
            yield one.line, f"there is nothing to undo about {_named(one)}."
        put_on(stacks, one)
    for about, stack in stacks.items():
        if stack and (why := _why(stack[-1], counting.get(about), marks)):
            yield stack[-1].line, why


def _why(one: Decision, counted: Decision | None, marks: Marks) -> str:
    """Why a decision that stands does not apply; "" of one that does."""
    _, point, kind = one.about
    if point and (point, kind) not in marks:
        hint = did_you_mean(point, [name for name, of_kind in marks if of_kind == kind])
        return f"image {one.image!r} has no {kind} {point!r}.{hint}"
    if counted != one:
        return f"what was decided about {_named(one)} is of an earlier result. Look again in `reseau review`."
    if one.decision is Choice.ACCEPT and not marks[point, kind]:
        return f"nothing was measured of {_named(one)} that could be accepted. Place it in `reseau review`."
    return ""


def _named(one: Decision) -> str:
    return f"{one.about[2]} {one.point!r} of image {one.image!r}" if one.point else f"image {one.image!r}"


def _marks(store: Store, digest: str, image: str) -> Marks:
    judging = judging_of(store, digest)
    assert judging is not None  # it was made just now
    db = store.connection
    query = "select result, own_marks from judged_frame where judging = ? and name = ?"
    result, own_marks = db.execute(query, (judging.row, image)).fetchone()
    table, where = ("judged", f"judging = {judging.row:d} and") if own_marks else ("mark", "")
    rows = db.execute(f"select point, kind, causes is not null from {table} where {where} result = ?", (result,))
    return {(point, kind): bool(is_measured) for point, kind, is_measured in rows}
