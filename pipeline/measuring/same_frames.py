"""Scans that say, in writing, that they are of one frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from measure.flags import Code, Reason
from measure.results import FrameMeasurement
from pipeline.results.frames_file import said
from pipeline.results.measured_scan import MeasuredScan

_SAME = ("run", "frames", "date")  # that name a frame together with its number


def with_same_frames(scans: Sequence[MeasuredScan], part_of: Callable[[str], str]) -> list[MeasuredScan]:
    """The scans, with a problem where another one says that it is the same frame. part_of: the frame of which an image
    is one of several scans, which are meant to be of one frame."""
    named: dict[tuple[tuple[str, str], ...], list[str]] = {}
    names = {scan.frame.image: _name(scan.frame) for scan in scans}
    for image, name in names.items():
        if name:
            named.setdefault(name, []).append(image)
    return [_told(scan, names[scan.frame.image], named, part_of) for scan in scans]


def _name(frame: FrameMeasurement) -> tuple[tuple[str, str], ...]:
    """What names the frame: its number, and the run, its frames or the date, as far as they are known."""
    values = said(frame.writing or (), ("frame", *_SAME))
    return tuple(values.items()) if "frame" in values and len(values) > 1 else ()


def _told(
    scan: MeasuredScan,
    name: tuple[tuple[str, str], ...],
    named: Mapping[tuple[tuple[str, str], ...], list[str]],
    part_of: Callable[[str], str],
) -> MeasuredScan:
    own = scan.frame.image
    others = [
        image for image in named.get(name, ()) if image != own and not (part_of(own) and part_of(image) == part_of(own))
    ]
    if not name or not others:
        return scan
    told = ", ".join(f"{field} {value}" for field, value in name)
    problem = Reason(
        f"its writing says {told}, and so does that of {' and '.join(others)}: these are scans of one frame, or a line "
        "is misread. Leave one of them out, or look at frames.csv.",
        Code.AMBIGUOUS,
    )
    return replace(scan, frame=replace(scan.frame, problems=(*scan.frame.problems, problem)))
