"""Coarse placement of a frame in its scan: for each pose, the small similarity under which most marks respond.

Places are complex numbers here, x + iy in mm of the scan's axes (right, up), so that a similarity is `a w + b`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.array_types import Array
from measure.detection.correlation import WIDE, Surroundings
from measure.detection.responses import Key, Responses
from measure.fiducials.interior_orientation import FilmFit
from measure.fiducials.options import TakingLens
from measure.geometry import (
    UP_FROM_CAMERA,
    Complex,
    fit_similarity,
    linear_scale,
    reduced_px,
    scan_px,
    similarity_matrix,
)
from measure.marks.shapes import LayoutMark, Mark, places_mm

FREE_MARKS = 2  # marks that a similarity fits wherever they lie
NARROW = 0.25  # fraction of the tolerance within which marks agree on film that is hardly deformed
_LEAST_WEIGHED = 0.1  # response above which a mark has weight in the refinement of a placement
_PAIRS = 60  # pairs of marks from which hypotheses are made
_FAR = 0.4  # fraction of the largest distance of two marks: nearer pairs determine rotation and scale poorly
_KEPT = 12  # placements of a pose that are refined
_STEPPED = 3  # best placements that are shifted along a lattice of marks
AS_GOOD = 0.9  # of the best score: a lattice whose outer line is not visible has the same under other names
_NEIGHBOURS = 4  # nearest marks, which give the steps of a lattice
_ALIKE = 0.5  # fraction of the marks that a step maps to others: above it they form a lattice
_SAME_PX = 10  # px of the reduced scan: the shift up to which two placements are the same; a mark is some 14 px large
_SAME_SIZE = 0.01  # relative difference of scale up to which they are: 10 px at the frame's edge, 1000 px off
_SAME = 0.1  # fraction of the tolerance: orientations whose marks coincide so closely share their placements
_OUTSIDE_COST = 0.1  # score subtracted for each mark outside the scan
_STEP_MM = 0.01  # mm, step of numerical derivatives
_NARROWED = 0.7  # factor of the tolerance for refined placements
_LEAST_TOLERANCE_PX = 1.5  # px of the reduced scan, accuracy of correlation peaks


class Bounds(NamedTuple):
    """Bounds of a placement: largest deviation of the scale from 1, largest rotation, largest deviation of a mark."""

    scale_tolerance: float
    rotation_rad: float
    misfit_mm: float


@dataclass(frozen=True, eq=False)
class Placement:
    """Place of a frame in its scan.

    Attributes
    ----------
    pose : scan orientation.
    pixel_from_camera : (2, 3) camera mm to pixels; to ideal pixels if the scan was taken through a lens.
    score : sum over the marks of the squared response beyond the background, less a cost for marks outside the scan.
    supported : number of marks that respond.
    polarity : of marks drawn without one: +1 lighter than their surroundings, -1 darker.
    reduction : factor by which the scan was reduced for the search.
    pitch_mm : pixel pitch of the search, across and down.
    surroundings : of the marks in the search.
    lens : of a camera that photographed the film, None for a scanner.
    film : terms of a film deformation model beyond pixel_from_camera, None for an affine one.
    """

    pose: str
    pixel_from_camera: Array
    score: float
    supported: int
    polarity: int
    reduction: int
    pitch_mm: tuple[float, float]
    surroundings: Surroundings = WIDE
    lens: TakingLens | None = None
    film: FilmFit | None = None

    def same_place(self, other: "Placement") -> bool:
        """Whether both put the frame at the same place and size, however its marks are named."""
        shift = np.hypot(*(self.pixel_from_camera[:, 2] - other.pixel_from_camera[:, 2]))
        sizes = [linear_scale(each.pixel_from_camera) for each in (self, other)]
        return bool(shift < _SAME_PX * self.reduction and abs(sizes[0] / sizes[1] - 1) < _SAME_SIZE)

    def places_px(self, camera_mm: Array) -> Array:
        """(n, 2) scan places of marks at camera_mm (n, 2)."""
        ideal = self._ideal_px(camera_mm)
        return ideal if self.lens is None else self.lens.scan_px(ideal)

    def _ideal_px(self, camera_mm: Array) -> Array:
        """(n, 2) places in the ideal image, without the distortion of a taking lens."""
        if self.film is not None:
            return np.asarray(self.film.places_mm(camera_mm) * (1.0, -1.0) / self.pitch_mm)
        return np.asarray(camera_mm @ self.pixel_from_camera[:, :2].T + self.pixel_from_camera[:, 2])

    def linear(self, place_mm: Array) -> Array:
        """(2, 2) derivatives of places_px at a place (2,) of the camera, px per mm."""
        if self.film is None and self.lens is None:
            return self.pixel_from_camera[:, :2]
        steps = place_mm + _STEP_MM * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
        right, left, up, down = self.places_px(steps)
        return np.column_stack([right - left, up - down]) / (2 * _STEP_MM)

    def names(self, places_px: Array, camera_mm: Array) -> NDArray[np.intp]:
        """(k,) index of the mark nearest to each of places_px (k, 2).

        -1 if it is farther away than half the least distance of two marks, or another place is nearer to it.
        """
        own = self.places_px(camera_mm)
        distance = np.hypot(*np.moveaxis(places_px[:, None] - own[None], -1, 0))
        apart = np.hypot(*np.moveaxis(own[:, None] - own[None], -1, 0)) + np.diag(np.full(len(own), np.inf))
        nearest = distance.argmin(axis=1)
        within = distance.min(axis=1) < apart.min() / 2
        is_first = distance.argmin(axis=0)[nearest] == np.arange(len(places_px))
        return np.where(within & is_first, nearest, -1)

    def reorient(self, pose: str, camera_mm: Array) -> "Placement":
        """Convert to another pose at the same place of the frame.

        The marks get other names. A similarity corrects for the differences of the given coordinates camera_mm (n, 2)
        between the old and new marks at the same places.
        """
        turn = np.linalg.inv(UP_FROM_CAMERA[self.pose]) @ UP_FROM_CAMERA[pose]
        linear, shift = self.pixel_from_camera[:, :2] @ turn, self.pixel_from_camera[:, 2]
        film = None if self.film is None else replace(self.film, turn=UP_FROM_CAMERA[pose])
        renamed = replace(self, pose=pose, pixel_from_camera=np.column_stack([linear, shift]), film=film)
        names = renamed.names(self.places_px(camera_mm), camera_mm)
        if film is not None or np.any(names < 0):
            return renamed
        pitch = np.array(self.pitch_mm)
        own, other = self._ideal_px(camera_mm), renamed._ideal_px(camera_mm)[names]
        to, from_ = ((each * pitch) @ (1.0, 1.0j) for each in (own, other))
        correction = similarity_matrix(*fit_similarity(from_, to, np.ones(len(to))))
        before = renamed.pixel_from_camera * pitch[:, None]
        linear, shift = correction[:, :2] @ before[:, :2], before[:, 2] @ correction[:, :2].T + correction[:, 2]
        return replace(renamed, pixel_from_camera=np.column_stack([linear, shift]) / pitch[:, None])


def distinct_places(found: Iterable[Placement], most: int) -> list[Placement]:
    """Return the first placements of different places, at most so many."""
    places = list[Placement]()
    for placement in found:
        if len(places) < most and not any(placement.same_place(other) for other in places):
            places.append(placement)
    return places


def lattice_steps_mm(camera_mm: Array, within_mm: float) -> Array:
    """(n, 2) steps from the middle mark to near ones that map most of the marks (marks, 2) to others."""
    tree, middle = cKDTree(camera_mm), camera_mm.mean(axis=0)
    origin = camera_mm[np.hypot(*(camera_mm - middle).T).argmin()]
    distance, near = (np.ravel(each)[1:] for each in tree.query(origin, k=min(len(camera_mm), _NEIGHBOURS + 1)))
    steps = camera_mm[near[distance > within_mm]] - origin
    onto = [np.mean(tree.query(camera_mm + step)[0] < within_mm) for step in steps]
    return np.asarray(steps[np.array(onto) > _ALIKE])


def same_picture(
    marks: Sequence[LayoutMark], first: tuple[str, Sequence[int]], second: tuple[str, Sequence[int]], within_mm: float
) -> bool:
    """Whether two poses have equal marks at equal places. first, second: pose and kind of template of every mark."""
    xy = places_mm(marks)
    of_first, of_second = (xy @ UP_FROM_CAMERA[pose].T for pose, _ in (first, second))
    distance = np.hypot(*np.moveaxis(of_first[:, None] - of_second[None], -1, 0))
    nearest = distance.argmin(axis=1)
    close = bool((distance.min(axis=1) < within_mm).all())
    alike = np.array_equal(np.asarray(first[1]), np.asarray(second[1])[nearest])
    polarities = [mark.mark.polarity for mark in marks]
    return close and alike and polarities == [polarities[index] for index in nearest]


def mark_sign(mark: Mark, assumed: int) -> int:
    """Sign of a mark: +1 lighter than its surroundings, -1 darker; as drawn, or else as assumed."""
    return {"light": 1, "dark": -1, "auto": assumed}[mark.polarity]


class PlacementSearch:
    """Search for placements of a frame under one pitch, in one scan orientation after another.

    Attributes
    ----------
    steps_mm : (n, 2) steps of a lattice of marks; none if they form no lattice.
    tolerance_px : deviation allowed to a mark, px of the reduced scan.
    same_mm : distance up to which marks of two orientations coincide.
    kinds : by orientation, the kind of template of every mark.
    placements : by orientation. An orientation with equal marks at the places of an earlier one gets the placements of
        that one, converted.
    distinct : orientations whose marks do not coincide, within the tolerance, with those of an earlier one.
    """

    def __init__(
        self,
        marks: Sequence[LayoutMark],
        responses: Responses,
        pitch_mm: tuple[float, float],
        bounds: Bounds,
        lens: TakingLens | None = None,
        every_pose: bool = True,
    ) -> None:
        """every_pose: False to leave out orientations with equal marks at the places of an earlier one."""
        self.marks, self.responses, self.bounds, self.lens = marks, responses, bounds, lens
        self._every_pose = every_pose
        self.camera_mm = places_mm(marks)
        self.pitch_mm, self.pitch = pitch_mm, np.asarray(pitch_mm)
        self.steps_mm = lattice_steps_mm(self.camera_mm, bounds.misfit_mm)
        self.tolerance_px = max(bounds.misfit_mm / float(self.pitch.mean()) / responses.reduction, _LEAST_TOLERANCE_PX)
        self.same_mm = _SAME * bounds.misfit_mm
        self.kinds: dict[str, tuple[int, ...]] = {}
        self.placements: dict[str, list[Placement]] = {}
        self.distinct: list[str] = []

    def search_pose(self, pose: str, kinds: tuple[int, ...]) -> None:
        """Search in an orientation; one equivalent to an earlier one takes over its placements."""
        misfit_mm = self.bounds.misfit_mm
        same, similar = (
            next((known for known in self.kinds.items() if same_picture(self.marks, known, (pose, kinds), mm)), None)
            for mm in (self.same_mm, misfit_mm)
        )
        if same:
            known = self.placements[same[0]] if self._every_pose else ()
            self.placements[pose] = [placement.reorient(pose, self.camera_mm) for placement in known]
        else:
            self.placements[pose] = self.find_placements(pose, kinds)
        self.kinds[pose] = kinds
        if not similar:
            self.distinct.append(pose)

    def key(self, placement: Placement, index: int) -> Key:
        """Key of the responses to a mark, by index, in the orientation and polarity of a placement."""
        return self.kinds[placement.pose][index], mark_sign(self.marks[index].mark, placement.polarity)

    def find_placements(self, pose: str, kinds: Sequence[int]) -> list[Placement]:
        """Find the distinct placements of an orientation, best first; none if no two marks respond.

        kinds: of each mark's template in this orientation.
        """
        unsaid = any(mark.mark.polarity == "auto" for mark in self.marks)
        found: list[Placement] = []
        for polarity in (1, -1) if unsaid else (1,):
            signs = [mark_sign(mark.mark, polarity) for mark in self.marks]
            found += _Constellation(self, pose, list(zip(kinds, signs, strict=True))).placements(polarity)
        kept: list[tuple[Placement, Array]] = []
        for placement in sorted(found, key=lambda placement: -placement.score):
            places = placement.places_px(self.camera_mm)
            apart_px = 2 * self.bounds.misfit_mm / self.pitch_mm[0]
            if all(np.hypot(*(places - other).T).max() > apart_px for _, other in kept):
                kept.append((placement, places))
        return [placement for placement, _ in kept]


class _Constellation:
    """Marks in one pose, each with the key of its responses."""

    def __init__(self, search: PlacementSearch, pose: str, keys: Sequence[Key]) -> None:
        self.search, self.pose, self.keys, self.responses = search, pose, keys, search.responses
        self.camera: Complex = np.asarray(search.camera_mm @ UP_FROM_CAMERA[pose].T @ (1.0, 1.0j), complex)
        self.marks_by_key: dict[Key, list[int]] = {}
        for mark, key in enumerate(keys):
            self.marks_by_key.setdefault(key, []).append(mark)

    def placements(self, polarity: int) -> list[Placement]:
        """Score the hypotheses, and refine the best ones."""
        search, turn = self.search, UP_FROM_CAMERA[self.pose]
        scale, offset = self._hypotheses()
        if len(scale) == 0:
            return []
        scores, _ = self._scores(search.tolerance_px, scale, offset)
        kept = np.argsort(-scores, kind="stable")[:_KEPT]
        stepped = self._step_along_lattice(scale[kept[:_STEPPED]], offset[kept[:_STEPPED]])
        scale, offset = self._refined(np.append(scale[kept], stepped[0]), np.append(offset[kept], stepped[1]))
        scores, supported = self._scores(_narrow_tolerance_px(search.tolerance_px), scale, offset)
        per_mm = np.array([1.0, -1.0])[:, None] / search.pitch[:, None]
        settings = polarity, self.responses.reduction, search.pitch_mm, self.responses.surroundings, search.lens
        return [
            Placement(self.pose, per_mm * np.column_stack([up[:, :2] @ turn, up[:, 2]]), score, count, *settings)
            for up, score, count in zip(
                map(similarity_matrix, scale, offset), scores.tolist(), supported.tolist(), strict=True
            )
        ]

    def _step_along_lattice(self, scale: Complex, offset: Complex) -> tuple[Complex, Complex]:
        """Shift the best hypotheses of a lattice step by step while the score increases: they may be many steps off.

        Returns them and those one step farther that score as well: rivals under other names.
        """
        turned = self.search.steps_mm @ UP_FROM_CAMERA[self.pose].T
        steps = np.append(0.0, turned @ [1.0, 1.0j])
        if len(steps) == 1:
            return scale[:0], offset[:0]
        all_scales, best = np.repeat(scale, len(steps)), np.array([-1])
        while best.any():
            tried = offset[:, None] + scale[:, None] * steps
            scores = self._scores(self.search.tolerance_px, all_scales, tried.ravel())[0]
            best = scores.reshape(tried.shape).argmax(axis=1)
            offset = tried[np.arange(len(best)), best]
        kept = scores >= AS_GOOD * scores.max()
        kept[:: len(steps)] = True  # not a step farther
        return all_scales[kept], tried.ravel()[kept]

    def _complex(self, reduced: Array) -> Complex:
        """Convert places of the reduced scan to mm of the scan's axes."""
        places, lens = scan_px(reduced, self.responses.reduction), self.search.lens
        return np.asarray((places if lens is None else lens.ideal_px(places)) * self.search.pitch @ (1.0, -1.0j))

    def _reduced_px(self, scale: Complex, offset: Complex) -> Array:
        """(n, marks, 2) places of the marks in the reduced scan under similarities (n,)."""
        places, lens = scale[:, None] * self.camera + offset[:, None], self.search.lens
        ideal = np.asarray(np.stack([places.real, -places.imag], axis=-1) / self.search.pitch)
        return reduced_px(ideal if lens is None else lens.scan_px(ideal), self.responses.reduction)

    def _hypotheses(self) -> tuple[Complex, Complex]:
        """All similarities within bounds through two marks and two of their candidates."""
        bounds = self.search.bounds
        candidates = {key: self._complex(self.responses.candidates(key)) for key in self.marks_by_key}
        scales, offsets = [np.zeros(0, complex)], [np.zeros(0, complex)]  # of a layout with one mark there are none
        upright = np.cos(bounds.rotation_rad)
        # Of pairs of distant marks; an even selection if there are too many.
        ends = np.stack(np.triu_indices(len(self.camera), 1))
        length = np.abs(self.camera[ends[0]] - self.camera[ends[1]])
        far = np.flatnonzero(length >= _FAR * length.max(initial=0.0))
        chosen = far[(np.arange(min(len(far), _PAIRS)) * max(1.0, len(far) / _PAIRS)).astype(int)]
        for first, second in ends[:, chosen].T.tolist():
            of_first, of_second = candidates[self.keys[first]], candidates[self.keys[second]]
            base = self.camera[second] - self.camera[first]
            scale = (of_second[None, :] - of_first[:, None]) / base
            size = np.abs(scale)
            allowed = (np.abs(size - 1) < bounds.scale_tolerance) & (scale.real > upright * size)
            at = np.flatnonzero(allowed)
            scales.append(scale.ravel()[at])
            offsets.append(of_first[at // len(of_second)] - scales[-1] * self.camera[first])
        return np.concatenate(scales), np.concatenate(offsets)

    def _scores(self, radius_px: float, scale: Complex, offset: Complex) -> tuple[Array, Array]:
        """Scores of many placements, and numbers of their marks that respond within the radius."""
        nearest = np.rint(self._reduced_px(scale, offset)).astype(int)
        strength, inside = np.empty(nearest.shape[:2]), np.empty(nearest.shape[:2], bool)
        for key, marks in self.marks_by_key.items():
            strength[:, marks], inside[:, marks] = self.responses.dilated(key, radius_px).strength(nearest[:, marks])
        score = strength.sum(axis=1) - _OUTSIDE_COST * (~inside).sum(axis=1)
        return score, (strength > 0).sum(axis=1)

    def _refined(self, scale: Complex, offset: Complex) -> tuple[Complex, Complex]:
        """Refine similarities (n,) by least squares on the highest responses around their predictions."""
        widest = self.search.tolerance_px
        scale, offset = scale.copy(), offset.copy()
        moving = np.ones(len(scale), dtype=bool)
        for tolerance_px in (widest, _narrow_tolerance_px(widest)):
            predicted = self._reduced_px(scale, offset)
            tops, heights = np.empty(predicted.shape), np.empty(predicted.shape[:2])
            for key, marks in self.marks_by_key.items():
                own = predicted[:, marks]
                found = self.responses.highest_about(key, own.reshape(-1, 2), tolerance_px)
                tops[:, marks], heights[:, marks] = found[0].reshape(own.shape), found[1].reshape(own.shape[:2])
            weight = np.maximum(heights - _LEAST_WEIGHED, 0.0)
            moving &= (weight > 0).sum(axis=1) >= 2
            scale[moving], offset[moving] = fit_similarity(self.camera, self._complex(tops[moving]), weight[moving])
        return scale, offset


def _narrow_tolerance_px(tolerance_px: float) -> float:
    """Tolerance of a refined placement."""
    return max(_NARROWED * tolerance_px, _LEAST_TOLERANCE_PX)
