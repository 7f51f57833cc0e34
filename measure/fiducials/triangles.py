"""Frames of three marks: whether their triangle is one that film and scanner can have made of the camera's.

An affine transformation goes through any three marks, so none of them is checked by the others. But a triangle has a
size and a shape, and these are known: from the camera's other frames, to what these scatter, and from the camera's
file and the scan's pitch, to what film and scanner stretch. A triangle that contradicts them at a stated probability
(Bonferroni: divided by the number of tests) is explained by one of its marks, where that alone does it far better than
all else, by stretched film or wrong pitches likewise, or by neither: then it is a problem of its frame.
"""

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtrc, chdtri, fdtrc, logsumexp

from measure.fiducials.doubts import TOLD, Doubt, observed
from measure.fiducials.options import AFFINITY_SIGMA, MOST_BENT_MM, SCATTER_MM
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]

_MARKS = 3
_LEAST_OTHERS = 2  # frames that show a triangle, too: of two alone nobody knows which one is off
_FORM = 3  # numbers of a triangle's form: one of size, two of shape
_STRETCH = AFFINITY_SIGMA**2 / 2 * np.eye(_FORM)  # AFFINITY_SIGMA along each axis: half of it squared in each number
_MOST_STRETCHED = 0.05  # a pitch may be wrong by more than film or scanner stretch
_WIDTHS = 24  # standard deviations, from the least to the most


@dataclass(frozen=True)
class Contradiction:
    """What follows from a triangle that contradicts what is known of it: doubts of its marks by their names, or a
    problem of the frame and the standard deviation of film that it adds to its marks."""

    doubts: Mapping[str, Doubt] = field(default_factory=dict)
    problem: Reason = NO_REASON
    film_mm: float = 0.0


@dataclass(frozen=True)
class _Against:
    """What a triangle contradicts: where that has its marks, and the cause that this is."""

    where: str
    cause: Cause
    code: Code


_GIVEN = _Against("where the given places and the scan's pitch have {}", Cause.GIVEN_PLACES, Code.OFF_GIVEN)
_OTHERS = _Against("where the camera's other frames have {}", Cause.OTHER_FRAMES, Code.OFF_FRAMES)


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


def by_triangles(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film_sigma_mm: float,
) -> dict[int, Contradiction]:
    """By frame, of those of three marks, what contradicts the camera's other frames that lie alike, or else the given
    places in pixels of the given pitch."""
    names = {place: _names(frame) for place, frame in enumerate(frames) if len(observed(frame)) == _MARKS}
    found = dict[int, Contradiction]()
    for own in sorted(set(names.values())):
        seen = [_form(frame, own, layout, pitch_um) for frame, pitch_um in zip(frames, pitches_um, strict=True)]
        forms = {place: form for place, form in enumerate(seen) if form}
        three = {place for place in forms if names.get(place) == own}
        for pose in {form.pose for form in forms.values()}:
            alike = {place: form for place, form in forms.items() if form.pose == pose}
            found |= _against_others(alike, three & alike.keys(), own, len(names), film_sigma_mm)
        given = {mark.id: min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks}
        for place in three - found.keys():
            told = _against_given(forms[place], own, np.array([given[name] for name in own]), len(names))
            found |= {place: told} if told else {}
    return found


def _names(frame: FrameMeasurement) -> tuple[str, ...]:
    return tuple(mark.point for mark in observed(frame))


def _against_given(form: _Form, names: Sequence[str], given_mm: Array, tests: int) -> Contradiction | None:
    """Of the marks called names, whose given places are known to given_mm (3,)."""
    covariance = form.covariance(given_mm) + _STRETCH
    chance = float(chdtrc(_FORM, _misfit(form.stretched, covariance)))
    if chance * tests >= FALSE_DOUBT:
        return None
    return _explained(form, form.stretched, covariance, names, _GIVEN, chance)


def _against_others(
    forms: Mapping[int, _Form],
    three: AbstractSet[int],
    names: Sequence[str],
    tests: int,
    film_sigma_mm: float,
) -> dict[int, Contradiction]:
    """Of the marks called names by frame, of those that show these three only. forms: of all that show them, against
    one another: the one that is worst off first, and without it the others again."""
    left, found = dict(forms), dict[int, Contradiction]()
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
        chance = float(fdtrc(_FORM, degrees, misfits[worst] / _FORM))
        if chance * tests >= FALSE_DOUBT:
            break
        form = left.pop(places[worst])
        found[places[worst]] = _explained(form, apart[worst], covariances[worst], names, _OTHERS, chance)
    return found


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


def _explained(
    form: _Form, stretched: Array, covariance: Array, names: Sequence[str], against: _Against, chance: float
) -> Contradiction:
    """What explains a stretch that chance does not: one mark that is off, if that does it far better than all else;
    pitches or film that are stretched more than is believed, which any affine transformation takes; or nobody knows
    what, and then all three marks are known no better than the triangle fits."""
    pitches = _log_density_wider(form.by_pitch, stretched, covariance, (AFFINITY_SIGMA, _MOST_STRETCHED))
    marks = [_log_density_wider(moved, stretched, covariance, (SCATTER_MM, MOST_BENT_MM)) for moved in form.by_mark]
    best = int(np.argmax(marks))
    if marks[best] - max(pitches, *np.delete(marks, best)) > TOLD:
        weighed = np.linalg.solve(covariance, form.by_mark[best])
        off_mm = float(np.hypot(*np.linalg.solve(form.by_mark[best].T @ weighed, weighed.T @ stretched)))
        told = f"it lies {off_mm:.2f} mm off {against.where.format('it')}: three marks have no other check"
        return Contradiction({names[best]: Doubt(Reason(told, against.code), off_mm / form.mm, against.cause)})
    off_mm = float(np.sqrt(_misfit(stretched, form.covariance(1.0) - form.covariance(0.0)) / _FORM))
    problem = (
        f"its three marks {', '.join(names)} lie off {against.where.format('them')}, by about {off_mm:.2f} mm; film "
        f"and scanner make as much with a probability of {chance:.1g}, and nothing else checks three marks."
    )
    if pitches - max(marks) > TOLD or max(marks) - _log_density(covariance, stretched) < TOLD:
        told = "Film that is stretched more, or a wrong pitch, explains it best: look whether the pitch is right."
        return Contradiction(problem=Reason(f"{problem} {told}", Code.BENT_FRAME, Code.PITCH))
    told = f"One of the marks is off, or the pitch is wrong. They count as known to {1000 * off_mm:.0f} um."
    return Contradiction(problem=Reason(f"{problem} {told}", against.code), film_mm=off_mm)


def _misfit(stretched: Array, covariance: Array) -> float:
    return float(stretched @ np.linalg.solve(covariance, stretched))


def _log_density(covariance: Array, stretched: Array) -> float:
    return -float(np.linalg.slogdet(covariance)[1] + _misfit(stretched, covariance)) / 2


def _log_density_wider(cause: Array, stretched: Array, covariance: Array, range_: tuple[float, float]) -> float:
    """Of what is stretched where two numbers, times the cause (3, 2), vary by a standard deviation of which only the
    range is known."""
    spreads = [covariance + width**2 * cause @ cause.T for width in np.geomspace(*range_, _WIDTHS)]
    return float(logsumexp([_log_density(spread, stretched) for spread in spreads]) - np.log(_WIDTHS))


def _scatter(apart: Array, measured: Array) -> float:
    """The variance that films and scanner add to each number of a form, beside what the marks' own places do, from the
    median: triangles that are off do not widen it."""

    def too_far(variance: float) -> float:
        misfits = [_misfit(each, own + variance * np.eye(_FORM)) for each, own in zip(apart, measured, strict=True)]
        return float(np.median(misfits) - chdtri(_FORM, 0.5))

    return 0.0 if too_far(0.0) <= 0 else float(brentq(too_far, 0.0, float((apart**2).sum(axis=1).max())))
