"""Which of the eight poses a frame has: decided by what breaks its symmetry, or said to be undecided.

Every pose gives the marks found other names. Under the right one their pictures fit (identification dots, unlike
marks), their coordinates fit (asymmetries larger than their standard deviations), and what is written beside the frame
stands on the side of the camera's data strip. All are summed as log-likelihoods; a pose is decided only where it beats
every other by odds of a thousand to one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.fiducial_options import FiducialOptions
from measure.fitting.matching import Match
from measure.frames.frame import Frame
from measure.frames.frame_fit import FrameFit, fit_frame
from measure.frames.frame_sighter import first_search_px
from measure.marks.poses import up_from_camera
from measure.marks.shapes import (
    LEARNED_ORIGIN,
    Disk,
    FiducialLayout,
    LayoutMark,
    Mark,
    MarkShape,
    MarkTemplate,
    Side,
)
from measure.pose.data_strip import Beside, beside_frame, side_in_scan, strip_likelihoods
from measure.pose.pose_pictures import SPOILT, Drawings, Shown, Site
from measure.results import Pose
from measure.scans.scan import Scan
from measure.search.constellation import Placement

Array = NDArray[np.float64]

_DECIDED = 7.0  # log-odds: a thousand to one
_TOLD = 1.0  # log-odds: less than e to one is no evidence worth a sentence
_NAMED = 4.0  # times the gate: how far from where a pose's placement puts a mark it still has its name
_FREE_MM = 1e3  # the standard deviation of a place that is not given
_FILM_DEGREES = 4.0  # of freedom that the standard deviations of film and given places are known with: to a third


@dataclass(frozen=True, eq=False)
class _Verdict:
    """One pose's log-likelihoods, of the pictures (sites,), of the coordinates and of the data strip's side; names: of
    each site's mark, -1 for none; chi_square: of the coordinates."""

    pose: str
    names: tuple[int, ...]
    pictures: Array
    coordinates: float
    chi_square: float
    strip: float = 0.0

    @property
    def total(self) -> float:
        return float(self.pictures.sum()) + self.coordinates + self.strip


def decide_pose(
    scan: Scan, layout: FiducialLayout, placements: Sequence[Placement], frame: Frame, options: FiducialOptions
) -> Pose:
    """The pose, from a placement for each (at the place of the frame that was measured in one of them)."""
    seen = [fit for fit in frame.fits if fit is not None]
    missed = frame.missed_px
    named = [
        each
        for each in (_Named.of(placement, layout, seen, missed, options) for placement in placements)
        if each is not None
    ]
    if not named:
        return _decision([], layout, len(seen))
    scan_from_up = frame.pixel_from_camera[:, :2] @ np.linalg.inv(up_from_camera(frame.placement.pose))
    blur_px = float(np.median([fit.blur_px for fit in seen]))
    drawings = Drawings([mark.mark for mark in layout.marks], scan_from_up, blur_px)
    reach_px = first_search_px(frame.placement, layout, options)
    sites = [Site(scan, fit, fit.center_px, frame.weights, drawings, reach_px) for fit in seen]
    # Where no mark was found the others tell what one looks like: under another pose there may be one after all.
    usual = sorted(seen, key=lambda fit: abs(fit.contrast_dn))[len(seen) // 2]
    sites += [Site(scan, usual, place, frame.weights, drawings, reach_px) for place in missed]

    def of_site(index: int) -> Array:
        return sites[index].likelihoods([each.shown(index, layout) for each in named])

    pictures = np.array(scan.each(of_site, range(len(sites)))).reshape(len(sites), len(named))
    verdicts = [each.verdict(pictures[:, index]) for index, each in enumerate(named)]
    if layout.data_strip is None or not frame.accepted:
        return _decision(verdicts, layout, len(seen))
    beside = beside_frame(scan, layout, frame.pixel_from_camera, frame.placement.pose)
    likelihoods = strip_likelihoods(beside, layout.data_strip, [verdict.pose for verdict in verdicts], SPOILT)
    verdicts = [replace(each, strip=own) for each, own in zip(verdicts, likelihoods.tolist(), strict=True)]
    pose = _decision(verdicts, layout, len(seen))
    return replace(pose, evidence=(*pose.evidence, *_of_strip(verdicts, pose.name, beside, layout.data_strip)))


def _of_strip(verdicts: Sequence[_Verdict], pose: str, beside: Mapping[Side, Beside], strip: Side) -> tuple[str, ...]:
    """What the data strip says of the pose."""
    own = next(verdict.strip for verdict in verdicts if verdict.pose == pose)
    others = [verdict.strip for verdict in verdicts]
    lead = max(own - min(others), own - max(others), key=abs)
    if abs(lead) <= _TOLD:
        return ()
    side = side_in_scan(strip, pose)
    counts = ", ".join(f"{name} {each.written} of {each.seen}" for name, each in beside.items() if each.seen)
    return (
        f"the camera's data strip would lie on the {side} of the scan, where film is written on in so many places "
        f"beside the frame: {counts}. That speaks {'for' if lead > 0 else 'against'} the pose with log-odds "
        f"{abs(lead):.1f}.",
    )


@dataclass(frozen=True, eq=False)
class _Named:
    """The places of marks, found or missed, by the names that a pose gives them (-1: none), and the frame through those
    found, if there are two."""

    pose: str
    names: tuple[int, ...]
    fit: FrameFit | None

    @classmethod
    def of(
        cls,
        placement: Placement,
        layout: FiducialLayout,
        seen: Sequence[Match],
        missed: Sequence[Array],
        options: FiducialOptions,
    ) -> "_Named | None":
        """None where the pose names fewer than two of the marks found, having two, or gives two the same name."""
        pitch, camera = np.asarray(placement.pitch_mm), np.array([mark.xy_mm for mark in layout.marks])
        predicted = camera @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2]
        centers = np.array([*(fit.center_px for fit in seen), *missed])
        distance = np.hypot(*np.moveaxis((predicted[:, None] - centers[None]) * pitch, -1, 0))
        nearest = distance.argmin(axis=0)
        near = distance.min(axis=0) < _NAMED * options.gate_mm
        names = np.where(near, nearest, -1)
        if len(np.unique(names[near])) < near.sum():
            return None
        near, centers = near[: len(seen)], centers[: len(seen)]
        if near.sum() < 2:
            alone = cls(placement.pose, tuple(names.tolist()), None)
            return alone if len(seen) < 2 else None
        own = names[: len(seen)][near]
        given = np.array([_given_sigma_mm(layout.marks[name]) for name in own])
        measured = np.array([np.sqrt(np.trace(fit.covariance_px2) / 2) for fit in seen])[near] * pitch.mean()
        sigma = np.sqrt(given**2 + measured**2 + options.film_sigma_mm**2)
        up = centers[near] * pitch * (1.0, -1.0)
        fit = fit_frame(camera[own], up, sigma, up_from_camera(placement.pose))
        return cls(placement.pose, tuple(names.tolist()), fit)

    def shown(self, site: int, layout: FiducialLayout) -> Shown:
        name = self.names[site]
        return Shown(None if name < 0 else layout.marks[name].mark, up_from_camera(self.pose))

    def verdict(self, pictures: Array) -> _Verdict:
        """The coordinates' likelihood is Student's: nobody knows the film's standard deviation well."""
        if self.fit is None:
            return _Verdict(self.pose, self.names, pictures, 0.0, 0.0)
        degrees = _FILM_DEGREES + max(self.fit.redundancy, 0)
        coordinates = -degrees / 2 * float(np.log1p(self.fit.chi_square / _FILM_DEGREES))
        return _Verdict(self.pose, self.names, pictures, coordinates, self.fit.chi_square)


def _given_sigma_mm(mark: LayoutMark) -> float:
    """What was found under one name has that learned mark's origin; under another one it would lie elsewhere."""
    origin_mm = LEARNED_ORIGIN * mark.mark.learned_mm if isinstance(mark.mark, MarkTemplate) else 0.0
    return float(np.hypot(min(max(mark.sigma_mm), _FREE_MM), origin_mm))


def _decision(verdicts: Sequence[_Verdict], layout: FiducialLayout, found: int) -> Pose:
    """The likeliest pose, and what speaks for it. found: marks, beside which the places of missed ones count too."""
    if not verdicts:
        return Pose("0", False, ("no pose names the marks that were found.",))
    best = max(verdicts, key=lambda verdict: verdict.total)
    alike = [verdict for verdict in verdicts if best.total - verdict.total < _DECIDED]
    others = sorted((v for v in verdicts if v not in alike), key=lambda verdict: -verdict.total)
    against = _against(best, others[0], layout) if others else ()
    if len(alike) == 1:
        return Pose(best.pose, True, against or (f"no other pose explains the {found} marks found.",))
    names = ", ".join(verdict.pose for verdict in alike)
    lead = best.total - alike[0].total
    if lead > _TOLD:
        equal = [verdict.pose for verdict in alike if verdict is not best and best.total - verdict.total < _TOLD]
        as_likely = f"as likely as {', '.join(equal)} and " if equal else ""
        return Pose(
            best.pose,
            False,
            (
                f"the {found} marks found do not tell the poses {names} apart with certainty: {best.pose} is assumed, "
                f"{as_likely}likelier than {alike[0].pose} by log-odds of only {lead:.1f}.",
                *against,
            ),
        )
    return Pose(
        alike[0].pose,
        False,
        (
            f"nothing in the {found} marks found tells the poses {names} apart: "
            f"their pictures and given coordinates are alike; {alike[0].pose} is assumed.",
            *against,
        ),
    )


def _against(best: _Verdict, rival: _Verdict, layout: FiducialLayout) -> tuple[str, ...]:
    """What speaks for the best pose against the likeliest of those that it rules out, a sentence each."""
    sentences = []
    by_site = best.pictures - rival.pictures
    if by_site.sum() > _TOLD:
        telling = [site for site in np.argsort(-by_site, kind="stable").tolist() if by_site[site] > _TOLD]
        kinds = sorted({_difference(best.names[site], rival.names[site], layout) for site in telling})
        sentences.append(
            f"{' and '.join(kinds)} at {len(telling)} of {len(by_site)} marks speak against the next best pose "
            f"{rival.pose} with log-odds {by_site.sum():.1f}."
        )
    asymmetry = float(np.sqrt(max(rival.chi_square - best.chi_square, 0.0)))
    if abs(best.coordinates - rival.coordinates) > _TOLD:
        word = "against" if best.coordinates > rival.coordinates else "for"
        sentences.append(
            f"the asymmetry of the marks' given coordinates, {asymmetry:.1f} sigmas, speaks {word} pose {rival.pose} "
            f"with log-odds {abs(best.coordinates - rival.coordinates):.1f}."
        )
    return tuple(sentences)


def _difference(one: int, other: int, layout: FiducialLayout) -> str:
    """What two marks of the camera are told apart by."""
    if one < 0 or other < 0:
        return "marks where the other pose has none"
    (core, dots), (other_core, other_dots) = (_drawn(layout.marks[index].mark) for index in (one, other))
    if core != other_core:
        return "unlike marks"
    return "identification dots" if dots != other_dots else "the marks' directions"


def _drawn(mark: Mark) -> tuple[object, int]:
    """A mark's figure, whichever way it is turned, and how many dots stand beside it."""
    if not isinstance(mark, MarkShape):
        return mark, 0
    dots = [part for part in mark.parts if isinstance(part, Disk) and part.center_mm != (0.0, 0.0)]
    rest = [part for part in mark.parts if part not in dots]
    return sorted(type(part).__name__ for part in rest), len(dots)
