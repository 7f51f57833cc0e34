"""Layouts of marks looked for in thumbnails of one scan. What is looked for is the boldest marks of each: cameras in
which these are alike, and lie alike, share one search."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.fiducials.camera_recognition import Answer, answer, seen
from measure.fiducials.frame import Frame
from measure.fiducials.hypotheses import Hypotheses, PitchHypothesis, longer, pitch_hypotheses
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Polygon, thinnest_mm
from measure.scans.opening import thumbnail
from measure.scans.scan import Scan

_LARGEST_PX = 1600  # of what is searched: of aerial film a seventh of a millimetre, about as wide as fine lines
_COARSE_PX = 1024  # the same while the pitch is sought: fine lines are half a pixel wide then
_SOLID_PX = 800  # of solid marks, which are some millimetres large
_COARSE_SOLID_PX = 512  # of these while the pitch is sought
_PITCH_TOLERANCE = 0.02  # of the pitch that a layout came to
_STRETCHES = (-0.025, 0.025)  # of pixels longer one way: each reaches those of 1.1 to 3.9 % of an aerial camera
_ALIKE_MM = 0.1  # two cameras whose marks lie so near to one another look alike in a scan
_BOLD = 4  # marks that are looked for, at least
_ENOUGH = 12  # marks that are looked at: of more, as of a lattice, only every second
_STRETCH = (1.08, 0.93)  # of the layout that only chance can find: no film is so deformed


@dataclass(frozen=True, eq=False)
class Tried:
    """A layout of the marks that are looked at, its boldest marks, and how a picture of the scan answers to these under
    hypotheses about its pitch; before: how many others had been tried."""

    layout: FiducialLayout
    bold: FiducialLayout
    picture: Scan
    hypotheses: Hypotheses
    before: int
    answer: Answer


class LayoutSearch:
    """The search in one scan, or in a thumbnail of it that its marks can be looked at in."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._fine = thumbnail(scan, _LARGEST_PX)
        self._coarse, self._solid, self._coarse_solid = (
            thumbnail(self._fine, side_px) for side_px in (_COARSE_PX, _SOLID_PX, _COARSE_SOLID_PX)
        )
        self._known: list[Tried] = []

    def at_pitch(self, layout: FiducialLayout, pitch_um: tuple[float, float]) -> Tried:
        """At the scan's pitch."""
        return self._as_given(layout, pitch_um, lambda given: [given], 0)

    def longer_one_way(self, layout: FiducialLayout, pitch_um: tuple[float, float]) -> Tried:
        """With pixels that are longer one way than the other, by more than a search at the scan's pitch allows for."""
        return self._as_given(layout, pitch_um, lambda given: [longer(given, each) for each in _STRETCHES], 1)

    def _as_given(
        self,
        layout: FiducialLayout,
        pitch_um: tuple[float, float],
        hypotheses: Callable[[PitchHypothesis], Hypotheses],
        before: int,
    ) -> Tried:
        """By hypotheses that follow from a given pitch."""
        bold = _boldest(layout)
        picture = self._solid if all(_is_solid(mark) for mark in bold.marks) else self._fine
        times = self._scan.width_px / picture.width_px
        options = FiducialOptions(pitch_is_right=True)
        ((given,), *_) = pitch_hypotheses(picture, bold, (times * pitch_um[0], times * pitch_um[1]), options)
        return self._tried(_some(layout), bold, picture, hypotheses(given), before)

    def at_any_pitch(self, layout: FiducialLayout) -> Tried:
        """Where the frame may fill the scan, its pixels being square."""
        bold = _boldest(layout)
        picture = self._coarse_solid if all(_is_solid(mark) for mark in bold.marks) else self._coarse
        return self._tried(_some(layout), bold, picture, pitch_hypotheses(picture, bold, None, FiducialOptions())[0])

    def refined(self, coarse: Tried) -> Tried:
        """At the pitch that the best answer came to, in a larger picture."""
        if not coarse.answer.placements:
            return coarse
        linear = coarse.answer.placements[0].pixel_from_camera[:, :2]
        picture = self._solid if coarse.picture is self._coarse_solid else self._fine
        pitch_mm = coarse.picture.width_px / picture.width_px / float(np.sqrt(abs(np.linalg.det(linear))))
        hypothesis = PitchHypothesis((pitch_mm, pitch_mm), _PITCH_TOLERANCE, (pitch_mm, pitch_mm))
        return self._tried(coarse.layout, coarse.bold, picture, [hypothesis], len(coarse.hypotheses))

    def stretched(self, tried: Tried) -> Tried:
        """The same with marks in wrong places."""
        layout, bold = _stretched(tried.layout), _stretched(tried.bold)
        return self._tried(layout, bold, tried.picture, tried.hypotheses, tried.before)

    def seen(self, tried: Tried) -> Frame | None:
        """The frame as its marks look."""
        return seen(self._scan, tried.layout, tried.answer, self._scan.width_px / tried.picture.width_px)

    def _tried(
        self, layout: FiducialLayout, bold: FiducialLayout, picture: Scan, hypotheses: Hypotheses, before: int = 0
    ) -> Tried:
        for known in self._known:
            if known.picture is picture and known.hypotheses == hypotheses and same_marks(known.bold.marks, bold.marks):
                return replace(known, layout=layout)
        answered = answer(picture, bold, hypotheses, before)
        self._known.append(Tried(layout, bold, picture, hypotheses, before, answered))
        return self._known[-1]


def same_marks(first: Sequence[LayoutMark], second: Sequence[LayoutMark]) -> bool:
    """Whether a scan cannot tell the marks of two layouts apart."""
    return len(first) == len(second) and all(
        repr(a.mark) == repr(b.mark) and np.hypot(a.xy_mm[0] - b.xy_mm[0], a.xy_mm[1] - b.xy_mm[1]) < _ALIKE_MM
        for a, b in zip(first, second, strict=True)
    )


def _boldest(layout: FiducialLayout) -> FiducialLayout:
    """The marks that are the plainest to see, where they are enough: solid ones, or else those of the widest lines."""
    groups: dict[float, list[LayoutMark]] = {}
    for mark in layout.marks:
        groups.setdefault(np.inf if _is_solid(mark) else thinnest_mm(mark.mark), []).append(mark)
    enough = [width for width, marks in groups.items() if len(marks) >= _BOLD]
    return replace(layout, marks=tuple(groups[max(enough)])) if enough else layout


def _some(layout: FiducialLayout) -> FiducialLayout:
    """As many marks as tell whether they are there."""
    return replace(layout, marks=layout.marks[:: 1 if len(layout.marks) <= _ENOUGH else 2])


def _is_solid(mark: LayoutMark) -> bool:
    return isinstance(mark.mark, MarkShape) and all(isinstance(part, Polygon) for part in mark.mark.parts)


def _stretched(layout: FiducialLayout) -> FiducialLayout:
    x, y = _STRETCH
    marks = tuple(replace(mark, xy_mm=(x * mark.xy_mm[0], y * mark.xy_mm[1])) for mark in layout.marks)
    return replace(layout, marks=marks)
