"""Frames of three marks: whether their triangle is one that film and scanner can have made of the camera's.

An affine transformation goes through any three marks, so none of them is checked by the others. But a triangle has a
size and a shape, and these are known: from the camera's file and the scan's pitch, to what film and scanner stretch,
and from the camera's other frames, to what these scatter. A triangle that contradicts them at a stated probability
(Bonferroni: divided by the number of tests) has a mark that is off, unless the pitch explains it far better.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtrc, chdtri, fdtrc

from measure.checks.doubts import CHANCE, MEDIAN_EFFICIENCY, TOLD, Doubt, from_others, observed
from measure.covariance import Cause
from measure.film import AFFINITY_SIGMA
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]
_Reason = Callable[[float, Sequence[str]], str]  # from how far a mark is off, mm, and the marks of which it is one

_LEAST_OTHERS = 2  # frames that show a triangle, too: of two alone nobody knows which one is off
_FORM = 3  # numbers of a triangle's form: one of size, two of shape
_STRETCH = AFFINITY_SIGMA**2 / 2 * np.eye(_FORM)  # AFFINITY_SIGMA along each axis: half of it squared in each number


@dataclass(frozen=True, eq=False)
class _Form:
    """How a triangle is seen, against the one given: stretched (3,) in size, and in shape along x' and at 45 degrees
    to it. by_mark: (3, 3, 2), what moving each mark by a mm in x' and y' adds to it; by_pitch: (3, 2), what wrong
    pitches do. sigma_mm: (3,) the marks' own standard deviations. mm: of a pixel. pose: as it lies in its scan."""

    stretched: Array
    by_mark: Array
    by_pitch: Array
    sigma_mm: Array
    mm: float
    pose: str

    def covariance(self, place_mm: Array | float) -> Array:
        """Of stretched: by the marks' own standard deviations and by place_mm in each mark's coordinates."""
        variance = self.sigma_mm**2 + np.broadcast_to(place_mm, 3) ** 2
        return np.asarray(np.einsum("kia,kja,k->ij", self.by_mark, self.by_mark, variance))


def by_given_triangles(
    frames: Sequence[FrameMeasurement], layout: FiducialLayout, pitches_um: Sequence[tuple[float, float]]
) -> Iterator[dict[str, Doubt]]:
    """The marks of each frame of three that is no triangle of the given places in pixels of the given pitch."""
    names = [_names(frame) for frame in frames]
    tests = sum(len(own) == 3 for own in names)
    given = {mark.id: min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks}
    for frame, own, pitch_um in zip(frames, names, pitches_um, strict=True):
        form = _form(frame, own, layout, pitch_um) if len(own) == 3 else None
        yield _against_given(form, own, np.array([given[name] for name in own]), tests) if form else {}


def by_other_triangles(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film_sigma_mm: float,
) -> Iterator[dict[str, Doubt]]:
    """The marks of each frame of three that make another triangle than in the camera's other frames that lie alike."""
    names = [_names(frame) for frame in frames]
    three = [place for place, own in enumerate(names) if len(own) == 3]
    doubts: dict[int, dict[str, Doubt]] = {}
    for own in sorted({names[place] for place in three}):
        seen = [_form(frame, own, layout, pitch_um) for frame, pitch_um in zip(frames, pitches_um, strict=True)]
        forms = {place: form for place, form in enumerate(seen) if form}
        for pose in {form.pose for form in forms.values()}:
            alike = {place: form for place, form in forms.items() if form.pose == pose}
            doubts |= _against_others(
                alike, {place for place in three if names[place] == own}, own, len(three), film_sigma_mm
            )
    for place in range(len(frames)):
        yield doubts.get(place, {})


def _names(frame: FrameMeasurement) -> tuple[str, ...]:
    return tuple(mark.point for mark in observed(frame))


def _against_given(form: _Form, names: Sequence[str], given_mm: Array, tests: int) -> dict[str, Doubt]:
    """Doubts of the marks called names, whose given places are known to given_mm (3,)."""
    covariance = form.covariance(given_mm) + _STRETCH
    if chdtrc(_FORM, _misfit(form.stretched, covariance)) * tests >= CHANCE:
        return {}
    return _doubts(_off(form, form.stretched, covariance), names, form, _from_given, Cause.GIVEN_PLACES)


def _against_others(
    forms: Mapping[int, _Form],
    three: AbstractSet[int],
    names: Sequence[str],
    tests: int,
    film_sigma_mm: float,
) -> dict[int, dict[str, Doubt]]:
    """Doubts of the marks called names by frame, of those that show these three only. forms: of all that show them,
    against one another: the one that is worst off first, and without it the others again."""
    left, doubts = dict(forms), dict[int, dict[str, Doubt]]()
    while len(left) > _LEAST_OTHERS and three & left.keys():
        places = list(left)
        stretched = np.array([form.stretched for form in left.values()])
        measured = np.array([form.covariance(film_sigma_mm) for form in left.values()])
        scatter = _scatter(stretched - np.median(stretched, axis=0), measured) * np.eye(_FORM)
        apart = stretched - [np.median(np.delete(stretched, n, axis=0), axis=0) for n in range(len(places))]
        of_others = (measured.sum(axis=0) - measured) / (len(places) - 1) + scatter
        covariances = measured + scatter + np.pi / 2 / (len(places) - 1) * of_others  # with the median's own
        misfits = np.array([_misfit(*each) for each in zip(apart, covariances, strict=True)])
        worst = max((n for n, place in enumerate(places) if place in three), key=lambda n: misfits[n])
        degrees = MEDIAN_EFFICIENCY * _FORM * (len(places) - 1)
        if fdtrc(_FORM, degrees, misfits[worst] / _FORM) * tests >= CHANCE:
            break
        form = left.pop(places[worst])
        off_mm = _off(form, apart[worst], covariances[worst])
        doubts[places[worst]] = _doubts(off_mm, names, form, from_others, Cause.OTHER_FRAMES)
    return doubts


def _form(
    frame: FrameMeasurement, names: Sequence[str], layout: FiducialLayout, pitch_um: tuple[float, float]
) -> _Form | None:
    """Of the marks called names; None where the frame does not show all, or they lie in a line.

    With z = x' + i y' what is seen is a z + b conj(z) + c: |a| is the size, b / a the shape in the camera's axes.
    """
    seen = {mark.point: mark for mark in observed(frame)}
    places = {mark.id: complex(*mark.xy_mm) for mark in layout.marks}
    if frame.pixel_from_camera is None or not all(name in seen and name in places for name in names):
        return None
    given = np.array([places[name] for name in names])
    design = np.column_stack([given, given.conj(), np.ones(3)])
    if np.linalg.cond(design) > 1e6:
        return None
    x_mm, y_mm = np.array(pitch_um) / 1000
    up = np.array([_right_up_mm(seen[name], x_mm, y_mm) for name in names])
    if np.linalg.det(frame.pixel_from_camera[:, :2]) > 0:  # rows grow downwards: a frame that is mirrored
        up = up.conj()
    shares = np.linalg.inv(design)
    size, shape, _ = shares @ up
    of_shape = shape / size
    turn = (size / abs(size)) ** -2
    mm = float(np.sqrt(x_mm * y_mm))
    by_mark = np.array([[[f.real, -f.imag], [g.real, -g.imag], [g.imag, g.real]] for f, g in shares[:2].T])
    return _Form(
        np.array([abs(size) - 1, of_shape.real, of_shape.imag]),
        by_mark,
        np.array([[1.0, 0.0], [0.0, turn.real], [0.0, turn.imag]]),
        mm * np.array([_sigma_px(seen[name]) for name in names]),
        mm,
        frame.pose.name if frame.pose else "",
    )


def _right_up_mm(mark: MarkMeasurement, x_mm: float, y_mm: float) -> complex:
    assert mark.center_px is not None  # an observation has one
    return complex(mark.center_px[0] * x_mm, -mark.center_px[1] * y_mm)


def _sigma_px(mark: MarkMeasurement) -> float:
    assert mark.covariance_px2 is not None  # an observation has one
    return float(np.sqrt(np.trace(mark.covariance_px2) / 2))


def _misfit(stretched: Array, covariance: Array) -> float:
    return float(stretched @ np.linalg.solve(covariance, stretched))


def _off(form: _Form, stretched: Array, covariance: Array) -> dict[int, float]:
    """How far, mm, each mark is off that alone may explain the stretch, as well as any other within odds of a hundred
    to one; none where wrong pitches explain it better than all of them by as much."""
    pitches, _ = _explained(form.by_pitch, stretched, covariance)
    misfits, moves = zip(*(_explained(moved, stretched, covariance) for moved in form.by_mark), strict=True)
    if pitches + 2 * TOLD < min(misfits):
        return {}
    alike = np.flatnonzero(np.array(misfits) - min(misfits) < 2 * TOLD)
    return {int(mark): float(np.hypot(*moves[mark])) for mark in alike}


def _explained(cause: Array, stretched: Array, covariance: Array) -> tuple[float, Array]:
    """What is left of the misfit when two numbers, times the cause (3, 2), are free, and these numbers."""
    weighed = np.linalg.solve(covariance, cause)
    numbers = np.linalg.solve(cause.T @ weighed, weighed.T @ stretched)
    return _misfit(stretched - cause @ numbers, covariance), np.asarray(numbers)


def _doubts(
    off_mm: Mapping[int, float], names: Sequence[str], form: _Form, told: _Reason, cause: Cause
) -> dict[str, Doubt]:
    alike = [names[mark] for mark in off_mm]
    return {names[mark]: Doubt(told(off, alike), off / form.mm, cause) for mark, off in off_mm.items()}


def _from_given(off_mm: float, names: Sequence[str]) -> str:
    where = "where the given places and the scan's pitch have it"
    if len(names) == 1:
        return f"it lies {off_mm:.2f} mm off {where}: three marks have no other check"
    return (
        f"one of the marks {', '.join(names)} lies off {where}, this one by {off_mm:.2f} mm, or the pitch is wrong: "
        "three marks have no other check"
    )


def _scatter(apart: Array, measured: Array) -> float:
    """The variance that films and scanner add to each number of a form, beside what the marks' own places do, from the
    median: triangles that are off do not widen it."""

    def too_far(variance: float) -> float:
        misfits = [_misfit(each, own + variance * np.eye(_FORM)) for each, own in zip(apart, measured, strict=True)]
        return float(np.median(misfits) - chdtri(_FORM, 0.5))

    return 0.0 if too_far(0.0) <= 0 else float(brentq(too_far, 0.0, float((apart**2).sum(axis=1).max())))
