"""Which of the eight poses a frame has: decided by what breaks its symmetry, or said to be undecided.

Every pose gives the marks found other names. Under the right one their pictures fit (identification dots, unlike marks)
and their coordinates fit (asymmetries larger than their standard deviations). Both are summed as log-likelihoods; a
pose is decided only where it beats every other by odds of a thousand to one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.constellation import Placement
from measure.fiducial_options import FiducialOptions
from measure.frame_fit import fit_frame
from measure.matching import Match
from measure.poses import POSES, up_from_camera
from measure.rendering import extent_px, render
from measure.results import Pose
from measure.scan import Scan
from measure.shapes import FiducialLayout, Mark

Array = NDArray[np.float64]

_DECIDED = 7.0  # log-odds: a thousand to one
_PIXELS_PER_DEGREE = 4.0  # of freedom: blur, grain and compression make neighbours alike
_OUTLIER = 4.0  # in standard deviations: beyond it a pixel's misfit counts no more


@dataclass(frozen=True)
class _Verdict:
    """One pose's log-likelihoods, of the pictures and of the coordinates, and how many marks it names."""

    pose: str
    pictures: float
    chi_square: float
    redundancy: int
    named: int


def decide_pose(
    scan: Scan,
    layout: FiducialLayout,
    found: Sequence[Placement],
    fits: Sequence[Match | None],
    weights: Sequence[float] | None,
    options: FiducialOptions,
) -> Pose:
    """The pose, from all poses' placements (the best first) and the fits of the best one's marks, None where a mark
    was not found."""
    seen = [fit for fit in fits if fit is not None]
    judge = _Judge(scan, layout, seen, weights, found[0].pitch_mm, options)
    best_of_pose: dict[str, Placement] = {}
    for placement in found:
        best_of_pose.setdefault(placement.pose, placement)
    verdicts = [judge.verdict(best_of_pose[pose]) for pose in POSES if pose in best_of_pose]
    return _decision([verdict for verdict in verdicts if verdict is not None], len(seen))


class _Judge:
    """Gives verdicts on the marks that were found, whichever names a pose gives them."""

    def __init__(
        self,
        scan: Scan,
        layout: FiducialLayout,
        seen: Sequence[Match],
        weights: Sequence[float] | None,
        pitch_mm: tuple[float, float],
        options: FiducialOptions,
    ) -> None:
        self.layout, self.seen, self.options = layout, seen, options
        self.pitch = np.asarray(pitch_mm)
        self.camera = np.array([mark.xy_mm for mark in layout.marks])
        self.sites = [_Site(scan, [mark.mark for mark in layout.marks], fit, weights) for fit in seen]

    def verdict(self, placement: Placement) -> _Verdict | None:
        """None where the pose names fewer than two of the marks found."""
        matrix = placement.pixel_from_camera
        predicted = self.camera @ matrix[:, :2].T + matrix[:, 2]
        centers = np.array([fit.center_px for fit in self.seen])
        distance = np.hypot(*np.moveaxis((predicted[:, None] - centers[None]) * self.pitch, -1, 0))
        names = [
            int(index) if distance[index, j] < 4 * self.options.gate_mm else -1
            for j, index in enumerate(distance.argmin(axis=0))
        ]
        named = [j for j, name in enumerate(names) if name >= 0]
        if len(named) < 2 or len({names[j] for j in named}) < len(named):
            return None
        camera = self.camera[[names[j] for j in named]]
        up = centers[named] * self.pitch * (1.0, -1.0)
        fit = fit_frame(camera, up, self._sigma([names[j] for j in named], named), up_from_camera(placement.pose))
        linear = np.diag([1.0, -1.0]) @ fit.up_from_camera[:, :2] / self.pitch[:, None]
        pictures = sum(
            site.likelihood(self.layout.marks[name].mark if name >= 0 else None, linear)
            for site, name in zip(self.sites, names, strict=True)
        )
        return _Verdict(placement.pose, pictures, fit.chi_square, fit.redundancy, len(named))

    def _sigma(self, names: Sequence[int], named: Sequence[int]) -> Array:
        given = np.array([min(max(self.layout.marks[name].sigma_mm), 1e3) for name in names])
        measured = np.array([np.sqrt(np.trace(self.seen[j].covariance_px2) / 2) for j in named]) * self.pitch.mean()
        return np.asarray(np.sqrt(given**2 + measured**2 + self.options.film_sigma_mm**2))


class _Site:
    """A place where a mark was found, with the window that every pose's mark is compared with."""

    def __init__(self, scan: Scan, marks: Sequence[Mark], fit: Match, weights: Sequence[float] | None) -> None:
        self.fit = fit
        reach = max(_reach_px(mark, fit.pixel_from_mark[:, :2]) for mark in marks)
        col0, row0 = np.floor(fit.center_px - reach - 4).astype(int)
        width = height = int(np.ceil(2 * reach)) + 10
        self.window = scan.window(int(col0), int(row0), width, height, weights).astype(float)
        self.center = fit.center_px - (col0, row0)
        self.known: list[tuple[Array, float]] = []
        self.noise_dn = fit.noise_dn

    def likelihood(self, mark: Mark | None, linear: Array) -> float:
        """The log-likelihood of the window under a mark (None: bare background), up to a constant."""
        height, width = self.window.shape
        row, col = np.mgrid[:height, :width].astype(float)
        columns = [np.ones_like(row), col / width, row / height]
        if mark is not None:
            rendering = render(mark, np.column_stack([linear, self.center]), width, height, self.fit.blur_px)
            shown = [rendering.value, rendering.by_col, rendering.by_row]
            for other, known in self.known:
                if np.abs(other - shown[0]).max() < 0.05:
                    return known
            columns += shown
        design = np.stack([column.ravel() for column in columns], axis=1)
        grey = self.window.ravel()
        residuals = grey - design @ np.linalg.lstsq(design, grey, rcond=None)[0]
        relative = np.minimum(np.abs(residuals) / max(self.noise_dn, 1e-9), _OUTLIER)
        result = float(-np.sum(relative**2) / 2 / _PIXELS_PER_DEGREE)
        if mark is not None:
            self.known.append((shown[0], result))
        return result


def _reach_px(mark: Mark, linear: Array) -> float:
    """How far the mark reaches from its centre, along columns or rows, however it is turned by quarters."""
    return float(np.abs(extent_px(mark, np.column_stack([linear, np.zeros(2)]))).max())


def _decision(verdicts: Sequence[_Verdict], seen: int) -> Pose:
    """Compare the poses, after scaling coordinate misfits by what the best pose itself leaves unexplained."""
    if not verdicts:
        return Pose("0", False, (f"no pose names the {seen} marks that were found.",))
    first = max(verdicts, key=lambda verdict: verdict.pictures - verdict.chi_square / 2)
    unexplained = max(1.0, first.chi_square / max(first.redundancy, 1))

    def total(verdict: _Verdict) -> float:
        return verdict.pictures - verdict.chi_square / 2 / unexplained

    best = max(verdicts, key=total)
    alike = [verdict.pose for verdict in verdicts if total(best) - total(verdict) < _DECIDED]
    if len(alike) > 1:
        return Pose(
            alike[0],
            False,
            (
                f"nothing in the {seen} marks found tells the poses {', '.join(alike)} apart: "
                f"their pictures and given coordinates are alike; {alike[0]} is assumed.",
            ),
        )
    others = [verdict for verdict in verdicts if verdict is not best]
    if not others:
        return Pose(best.pose, True, (f"no other pose explains the {seen} marks found.",))
    rival = max(others, key=total)
    pictures = best.pictures - rival.pictures
    coordinates = (rival.chi_square - best.chi_square) / 2 / unexplained
    return Pose(
        best.pose,
        True,
        (
            f"the marks' pictures speak for it against the next best pose {rival.pose} with log-odds {pictures:.1f}.",
            f"their given coordinates with log-odds {coordinates:.1f}.",
        ),
    )
