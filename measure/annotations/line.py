"""A line of writing in a scan: what it says, where it stands, and which way it lies."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher

from measure.marks.shapes import Side

_ALIKE = 0.75  # of the characters of a line that is read twice
_PLAINLY = 5.0  # characters by which one way reads better than any other: a thousand to one


@dataclass(frozen=True)
class Reading:
    """What a line says if it lies in one way. confidence: the mean of its characters', 0 to 1; legible: how many of
    them can be read."""

    text: str
    confidence: float
    legible: float


@dataclass(frozen=True)
class Line:
    """One line of writing.

    ways: what is read of it by the pose in which it may lie (that of a writing which lies upright in its own frame);
    only the four along its own direction: a quarter turn is no question. pose: the way that is taken for the right one.
    outline_px: the corners (column, row) of the rectangle about it, clockwise in the scan. side: of the scan, at which
    it stands.
    """

    ways: Mapping[str, Reading]
    pose: str
    outline_px: tuple[tuple[float, float], ...]
    side: Side

    @property
    def text(self) -> str:
        return self.ways[self.pose].text

    @property
    def confidence(self) -> float:
        return self.ways[self.pose].confidence

    @property
    def legible(self) -> float:
        """How many of its characters can be read."""
        return self.ways[self.pose].legible

    @property
    def lead(self) -> float:
        """By how many characters its way reads better than any other."""
        return self.legible - max((way.legible for pose, way in self.ways.items() if pose != self.pose), default=0.0)

    @property
    def center_px(self) -> tuple[float, float]:
        col, row = (sum(values) / len(self.outline_px) for values in zip(*self.outline_px, strict=True))
        return col, row


@dataclass(frozen=True)
class KnownLine:
    """A line that stands at one place on frames that lie alike in their scans.

    pose: the way in which it lies in the scan. outline_mm: its corners from the middle of the exposed frame, as the
    scan shows them, to the right and up.
    """

    text: str
    pose: str
    side: Side
    outline_mm: tuple[tuple[float, float], ...]

    def is_seen_in(self, line: Line) -> bool:
        """Whether it is plainly that line, which may say another number."""
        own, other = without_numbers(self.text), without_numbers(line.text)
        same = SequenceMatcher(None, own, other).ratio() >= _ALIKE
        return same and line.pose == self.pose and line.lead >= _PLAINLY


def without_numbers(text: str) -> str:
    """A text of which frames of a roll have the same: every digit is a 0, and only letters count beside them."""
    return re.sub(r"\d", "0", re.sub(r"[\W_]", "", text.upper()))


def of_one_face(lines: Sequence[Line]) -> tuple[Line, ...]:
    """The lines as they read from the side of the film from which most can be read, those first that say most."""
    faces = [[_best(line, mirrored) for line in lines] for mirrored in (False, True)]
    face = max(faces, key=lambda face: sum(line.legible for line in face))
    return tuple(sorted(face, key=lambda line: (-line.legible, line.center_px)))


def _best(line: Line, mirrored: bool) -> Line:
    poses = [pose for pose in line.ways if pose.endswith("m") == mirrored]
    return replace(line, pose=max(poses, key=lambda pose: line.ways[pose].legible))
