"""The frames of a camera checked together: gross errors, bent film, wrong given coordinates, scanner distortion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, fdtrc

from measure.fiducials.consistency import Explanation, Misfit, explained, scan_sites
from measure.fiducials.doubts import TOLD, Doubt, doubted, observed
from measure.fiducials.frame import may_be_wrong
from measure.fiducials.options import ANY_FILM, BelievedFilm
from measure.fiducials.triangles import by_triangles
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]

_AXES = 2
_BELIEVED_DEGREES = 4.0  # of freedom that the factor is known with beforehand: on real film the edges differ by 1.4
_UNKNOWN_MM = 1.0  # of a pattern of which nothing is believed beforehand
_TOLD_MARKS = 4  # in a sentence


# Marks whose edges put them elsewhere than the match does: damaged ones, or those of a drawing that is not quite true.
#
# Noise explains such a difference by its covariance. Where more is left in many of a camera's marks, their drawings are
# not quite true, or the film's noise is not quite what it is taken for: their median says by what factor the variance
# of the differences is larger, beside 1 as it is believed. A mark that stands out among them too is damaged, and weak;
# any other is known no better than its two places differ, and weak only if that is more than a measured mark may be off
# by.


def by_second_places(frames: Sequence[FrameMeasurement]) -> Iterator[dict[str, Doubt]]:
    """What the second places of each frame's marks say, of those where chance does not make the difference."""
    tested = [[mark for mark in observed(frame) if "second_method_sigmas" in mark.quality] for frame in frames]
    squares = np.array([mark.quality["second_method_sigmas"] ** 2 for own in tested for mark in own])
    by_noise = chdtrc(_AXES, squares) * len(squares)
    among_others = _chances(squares) * len(squares)
    told = iter(zip(by_noise.tolist(), among_others.tolist(), strict=True))
    for own in tested:
        chances = [(mark, *next(told)) for mark in own]
        yield {mark.point: _doubt(mark, among < FALSE_DOUBT) for mark, noise, among in chances if noise < FALSE_DOUBT}


def _chances(squares: Array) -> Array:
    """(n,) that a mark's two places differ by so many standard deviations, squared, as the others' do."""
    others = [np.median(np.delete(squares, n)) for n in range(len(squares))] if len(squares) > 1 else [0.0]
    degrees = MEDIAN_EFFICIENCY * _AXES * (len(squares) - 1)
    factor = (_BELIEVED_DEGREES + degrees * np.array(others) / chdtri(_AXES, 0.5)) / (_BELIEVED_DEGREES + degrees)
    # Differences that are smaller than noise makes them are no reason to ask more of the others.
    return np.asarray(fdtrc(_AXES, _BELIEVED_DEGREES + degrees, squares / _AXES / np.maximum(factor, 1.0)))


def _doubt(mark: MarkMeasurement, is_alone: bool) -> Doubt:
    assert mark.covariance_px2 is not None  # an observation has one
    off_px = float(np.hypot(mark.quality["second_method_col_px"], mark.quality["second_method_row_px"]))
    doubt = Doubt(
        Reason(
            f"its edges put it {off_px:#.2g} px elsewhere, {mark.quality['second_method_sigmas']:.1f} standard "
            "deviations of the difference: it is damaged or unlike its drawing",
            Code.EDGES,
        ),
        off_px,
        Cause.SECOND_METHOD,
    )
    before, after = mark.covariance_px2, mark.covariance_px2 + doubt.px2
    is_told = is_alone or (may_be_wrong(after) and not may_be_wrong(before))
    return doubt if is_told else doubt.without_reason()


# The frames of a camera judged together: what their marks' misfits speak of.
#
# A mark's picture says how well the mark was measured. That marks do not fit the given places under an affine
# transformation says something of the given places, of the scanner, of a frame's film, or of one mark, and often only
# the other frames can tell. The same misfit in all frames in the camera's axes speaks of the given places, in the axes
# of the scan of the scanner, in one frame of its film, at one mark alone of that mark. These are compared as
# hypotheses, each of them a covariance of the misfits. Film is a problem of its frame and a variance of the frame's
# marks; only what speaks of a mark alone makes that mark weak.
#
# Judging changes nothing that was measured: it is made anew from all frames of a camera whenever one comes to them.


@dataclass(frozen=True, eq=False)
class Judgement:
    """frames: with the statuses, covariances and problems that all frames together give. film_sigma_mm: of each frame,
    along an axis; what is believed beforehand where the frames do not contradict it."""

    frames: tuple[FrameMeasurement, ...]
    film_sigma_mm: tuple[float, ...]


def judged(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film: BelievedFilm = ANY_FILM,
) -> Judgement:
    """All measured frames of one camera, judged. pitches_um: of each scan, in x and y; film: what is believed of it
    beforehand."""
    checked = [doubted(frame, own) for frame, own in zip(frames, by_second_places(frames), strict=True)]
    checked, films = _by_misfits(checked, layout, film)
    for place, told in by_triangles(checked, layout, pitches_um, film.sigma_mm).items():
        frame = _with_film(doubted(checked[place], told.doubts), told.film_mm**2)
        checked[place] = replace(frame, problems=(*frame.problems, *([told.problem] if told.problem else [])))
        films[place] = float(np.hypot(films[place], told.film_mm))
    return Judgement(tuple(checked), tuple(films))


def _by_misfits(
    frames: Sequence[FrameMeasurement], layout: FiducialLayout, film: BelievedFilm
) -> tuple[list[FrameMeasurement], list[float]]:
    """The frames with what their misfits say, and the film's standard deviation in each."""
    found = {place: Misfit.of(frame, layout) for place, frame in enumerate(frames)}
    misfits = {place: each for place, each in found.items() if each is not None}
    if not misfits:
        return list(frames), [film.sigma_mm] * len(frames)
    given = np.array([min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks])
    shared, problem = _shared(misfits, {place: frames[place] for place in misfits}, layout, given, film.sigma_mm)
    result, films = [], []
    for place, frame in enumerate(frames):
        own_mm, own_problems = _film_of(shared, place, layout, film.sigma_mm)
        doubts, extra_mm2 = _doubts(shared, place, layout), 0.0
        if own_mm > film.sigma_mm:
            extra_mm2 = own_mm**2 - film.added_later_mm**2
        problems = (*frame.problems, *own_problems, *([problem] if problem and place in misfits else []))
        result.append(replace(_with_film(doubted(frame, doubts), extra_mm2), problems=problems))
        films.append(own_mm)
    return result, films


def _shared(
    misfits: Mapping[int, Misfit],
    frames: Mapping[int, FrameMeasurement],
    layout: FiducialLayout,
    given_mm: Array,
    film_mm: float,
) -> tuple[Explanation, Reason]:
    """What explains the misfits best: the given places being right, or wrong, or the scanner bending all scans; and a
    sentence where it is not the first."""
    if len(misfits) == 1:
        return explained(misfits, given_mm, 0.0, film_mm), NO_REASON
    by_places = _with_pattern(misfits, given_mm, film_mm)
    poses = [pose.name if (pose := frame.pose) else "0" for frame in frames.values()]
    is_clear = by_places.chance_of_pattern >= FALSE_DOUBT
    is_quiet = not (by_places.film.is_more or any(each.film_mm or each.off_mm for each in by_places.frames.values()))
    if is_clear and (is_quiet or len(set(poses)) == 1):
        return explained(misfits, given_mm, 0.0, film_mm), NO_REASON
    if len(set(poses)) == 1:
        return by_places, _of_places(by_places, layout, " The scanner may do the same: all frames lie alike in it.")
    sites = scan_sites(list(misfits.values()), poses)
    turned = {
        place: each.widened(given_mm[each.index] ** 2).in_scan_axes(pose, sites)
        for (place, each), pose in zip(misfits.items(), poses, strict=True)
    }
    by_scanner = _with_pattern(turned, np.zeros(len(sites)), film_mm)
    lead = by_scanner.log_evidence - by_places.log_evidence
    if lead > TOLD and by_scanner.chance_of_pattern < FALSE_DOUBT:
        return by_scanner, _of_scanner(by_scanner)
    if is_clear:
        return explained(misfits, given_mm, 0.0, film_mm), NO_REASON
    return by_places, _of_places(by_places, layout, "" if lead < -TOLD else " The scanner may do the same.")


def _with_pattern(misfits: Mapping[int, Misfit], sigma_mm: Array, film_mm: float) -> Explanation:
    """With a pattern beyond its sites' standard deviations, as large as it is: what is not believed beforehand speaks
    against a hypothesis by how much room it takes."""
    wide = explained(misfits, sigma_mm, _UNKNOWN_MM, film_mm)
    size_mm = float(np.sqrt(np.mean(wide.pattern.mm**2)))
    return explained(misfits, sigma_mm, max(size_mm, film_mm), film_mm)


def _of_places(shared: Explanation, layout: FiducialLayout, rest: str) -> Reason:
    off = {mark.id: float(np.hypot(*xy)) for mark, xy in zip(layout.marks, shared.pattern.mm, strict=True)}
    return Reason(
        f"in all frames of the camera the marks lie beside the given coordinates in the same way, "
        f"{_told(off)}, under an affine transformation: their standard deviations allow that with a probability of "
        f"{shared.chance_of_pattern:.1g}. Look whether these are the coordinates of this camera.{rest}",
        Code.OFF_GIVEN,
    )


def _of_scanner(shared: Explanation) -> Reason:
    most = float(np.hypot(*shared.pattern.mm.T).max())
    return Reason(
        f"all scans are bent in the same way in the scanner's axes, by up to {most:.3f} mm beside an affine "
        f"transformation (probability of chance {shared.chance_of_pattern:.1g}): the scanner does it.",
        Code.BENT_SCANS,
    )


def _told(off_mm: Mapping[str, float]) -> str:
    """Those marks farthest off, with their distances."""
    worst = sorted(off_mm, key=lambda name: -off_mm[name])[:_TOLD_MARKS]
    rest = f", {len(off_mm) - len(worst)} others by less" if len(off_mm) > len(worst) else ""
    return ", ".join(f"{name} by {off_mm[name]:.3f} mm" for name in worst) + rest


def _film_of(shared: Explanation, place: int, layout: FiducialLayout, believed_mm: float) -> tuple[float, list[Reason]]:
    """The film's standard deviation in a frame, and sentences where it stands out."""
    frame = shared.frames.get(place)
    if frame is None or frame.film_mm is None:
        return (shared.film.sigma_mm if shared.film.is_more else believed_mm), []
    alone = len(shared.frames) == 1
    off = frame.under(shared.film).distances_mm(shared.expected_mm(place)[0])
    names = [layout.marks[index].id for index in frame.misfit.index]
    told = _told(dict(zip(names, off.tolist(), strict=True)))
    than = "the given coordinates" if alone else "what the camera's frames have in common"
    cause = (
        "Film or scanner bent it, or the coordinates are not those of this camera; one frame does not tell."
        if alone
        else "Its film is bent, or was moved while it was scanned."
    )
    return frame.film_mm, [
        Reason(
            f"no affine transformation takes {than} to its marks, which lie off, {told}; film makes as much with a "
            f"probability of {frame.chance:.1g}. {cause} Its marks count as known to {1000 * frame.film_mm:.0f} um.",
            Code.BENT_FRAME,
        )
    ]


def _doubts(shared: Explanation, place: int, layout: FiducialLayout) -> dict[str, Doubt]:
    """The marks of a frame that alone are off."""
    frame = shared.frames.get(place)
    if frame is None:
        return {}
    alone = len(shared.frames) == 1
    doubts = {}
    for number, off in frame.off_mm.items():
        name = layout.marks[frame.misfit.index[number]].id
        has_it = "the other marks have it, more than film and given places explain"
        if not alone:
            has_it = "the camera's other frames have it, more than they scatter"
        doubts[name] = Doubt(
            Reason(f"it lies {off:.3f} mm from where {has_it}", Code.OFF_GIVEN if alone else Code.OFF_FRAMES),
            off / frame.misfit.mm,
            Cause.GIVEN_PLACES if alone else Cause.OTHER_FRAMES,
        )
    return doubts


def _with_film(frame: FrameMeasurement, variance_mm2: float) -> FrameMeasurement:
    """With what the film adds to the covariance of each of its fiducials."""
    if variance_mm2 <= 0 or frame.px_per_mm is None:
        return frame
    added = variance_mm2 * frame.px_per_mm**2 * np.eye(2)
    marks = tuple(
        replace(mark, covariance=mark.covariance.plus(Cause.FILM, added))
        if mark.kind == "fiducial" and mark.status.is_observation and mark.covariance is not None
        else mark
        for mark in frame.marks
    )
    return replace(frame, marks=marks)
