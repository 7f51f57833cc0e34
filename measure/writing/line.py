"""A line of writing in a scan: what it says, where it stands, and which way it lies."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from measure.marks.shapes import Side


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
    def center_px(self) -> tuple[float, float]:
        col, row = (sum(values) / len(self.outline_px) for values in zip(*self.outline_px, strict=True))
        return col, row


def of_one_face(lines: Sequence[Line]) -> tuple[Line, ...]:
    """The lines as they read from the side of the film from which most can be read, those first that say most."""
    faces = [[_best(line, mirrored) for line in lines] for mirrored in (False, True)]
    face = max(faces, key=lambda face: sum(line.legible for line in face))
    return tuple(sorted(face, key=lambda line: (-line.legible, line.center_px)))


def _best(line: Line, mirrored: bool) -> Line:
    poses = [pose for pose in line.ways if pose.endswith("m") == mirrored]
    return replace(line, pose=max(poses, key=lambda pose: line.ways[pose].legible))
