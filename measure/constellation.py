"""The frame's place in its scan: the small similarity, in each pose, under which most marks have a response.

Places are complex numbers here, x + iy in mm of the scan's own axes (right, up), so that a similarity is `a w + b`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.candidates import Map, Responses, peaks
from measure.poses import up_from_camera
from measure.shapes import LayoutMark, Mark

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_LEAST_RESPONSE = 0.2  # of a candidate
_LEAST_WEIGHED = 0.1  # of a mark that a placement is refined by
_CANDIDATES = 100  # of each look
_PAIRS = 60  # of marks that hypotheses are made from
_NARROWED = 0.7  # of the tolerance, once a placement is refined
_KEPT = 12  # placements of a pose that are refined
_SLID = 3  # of them, in a lattice, that are moved by its steps
_NEIGHBOURS = 4  # of a mark of a lattice
_ALIKE = 0.5  # of the marks that a step takes to others: they are a lattice
_OUTSIDE_COST = 0.1  # of a mark that a placement puts outside of the scan


@dataclass(frozen=True)
class Bounds:
    """What is known of the placement: scale is 1 within scale_tolerance for the pitch at hand."""

    scale_tolerance: float
    rotation_rad: float
    misfit_mm: float


@dataclass(frozen=True, eq=False)
class Placement:
    """A frame in its scan. score: how much of the constellation answers; supported: how many marks do.

    pixel_from_camera: (2, 3). polarity: of the marks that are not drawn with one, +1 lighter than their surroundings,
    -1 darker. reduction: of the scan, and pitch_mm that it was found with.
    """

    pose: str
    pixel_from_camera: Array
    score: float
    supported: int
    polarity: int
    reduction: int
    pitch_mm: tuple[float, float]

    def same_place(self, other: "Placement") -> bool:
        """Whether both put the frame at the same place and size, however its marks are named."""
        shift = np.hypot(*(self.pixel_from_camera[:, 2] - other.pixel_from_camera[:, 2]))
        sizes = [np.sqrt(abs(np.linalg.det(each.pixel_from_camera[:, :2]))) for each in (self, other)]
        return bool(shift < 10 * self.reduction and abs(sizes[0] / sizes[1] - 1) < 0.01)

    def posed(self, pose: str) -> "Placement":
        """The same place of the frame, its marks named as in another pose."""
        turn = np.linalg.inv(up_from_camera(self.pose)) @ up_from_camera(pose)
        linear = self.pixel_from_camera[:, :2] @ turn
        return replace(self, pose=pose, pixel_from_camera=np.column_stack([linear, self.pixel_from_camera[:, 2]]))


def same_picture(
    marks: Sequence[LayoutMark],
    first: tuple[str, Sequence[int]],
    second: tuple[str, Sequence[int]],
    bounds: Bounds,
) -> bool:
    """Whether two poses, each with the looks of its marks, put like marks in the same places: then one search does
    for both."""
    xy = np.array([mark.xy_mm for mark in marks])
    of_first, of_second = (xy @ up_from_camera(pose).T for pose, _ in (first, second))
    distance = np.hypot(*np.moveaxis(of_first[:, None] - of_second[None], -1, 0))
    nearest = distance.argmin(axis=1)
    close = bool((distance.min(axis=1) < 0.1 * bounds.misfit_mm).all())
    alike = np.array_equal(np.asarray(first[1]), np.asarray(second[1])[nearest])
    polarities = [mark.mark.polarity for mark in marks]
    return close and alike and polarities == [polarities[index] for index in nearest]


def sign_of(mark: Mark, assumed: int) -> int:
    """+1 for a mark lighter than its surroundings, -1 for a darker one: as drawn, or else as assumed."""
    return {"light": 1, "dark": -1, "auto": assumed}[mark.polarity]


def signs_of(marks: Sequence[LayoutMark]) -> set[int]:
    """Which signs the marks can have."""
    return {sign_of(mark.mark, assumed) for mark in marks for assumed in (1, -1)}


def _different(found: Sequence[Placement], marks: Sequence[LayoutMark], tolerance_px: float) -> list[Placement]:
    kept: list[tuple[Placement, Array]] = []
    xy = np.array([mark.xy_mm for mark in marks])
    for placement in found:
        places = xy @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2]
        if all(np.hypot(*(places - other).T).max() > 2 * tolerance_px for _, other in kept):
            kept.append((placement, places))
    return [placement for placement, _ in kept]


class PlacementSearch:
    """The search for placements, in one pose after another, of a frame that bounds are known of."""

    def __init__(
        self, marks: Sequence[LayoutMark], responses: Responses, pitch_mm: tuple[float, float], bounds: Bounds
    ) -> None:
        self.marks, self.responses, self.bounds = marks, responses, bounds
        self.pitch = np.asarray(pitch_mm)
        self.tolerance_px = max(bounds.misfit_mm / float(self.pitch.mean()) / responses.reduction, 1.5)
        self.layers = {
            key: _Layer(map_, responses.origin(key[0]), self.tolerance_px) for key, map_ in responses.maps.items()
        }

    def of_pose(self, pose: str, look_of_mark: Sequence[int]) -> list[Placement]:
        """The best placements of a pose that differ from one another, best first; none where no two marks respond.

        look_of_mark: of the responses' kinds, that of each mark in this pose.
        """
        unsaid = any(mark.mark.polarity == "auto" for mark in self.marks)
        found: list[Placement] = []
        for polarity in (1, -1) if unsaid else (1,):
            signs = [sign_of(mark.mark, polarity) for mark in self.marks]
            layers = [self.layers[key] for key in zip(look_of_mark, signs, strict=True)]
            found += _Constellation(self, pose, layers).placements(polarity)
        found.sort(key=lambda placement: -placement.score)
        return _different(found, self.marks, self.bounds.misfit_mm / float(self.pitch[0]))


class _Layer:
    """The responses to one look, and what is asked of them in every pose."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], tolerance_px: float) -> None:
        self.map, self.origin, self.tolerance_px = map_, origin, tolerance_px

    @cached_property
    def candidates(self) -> Array:
        """(n, 2) px of the reduced scan."""
        return peaks(self.map, _CANDIDATES, _LEAST_RESPONSE)[0] + self.origin

    @cached_property
    def wide(self) -> "_Reach":
        return _Reach(self.map, self.origin, self.tolerance_px)

    @cached_property
    def near(self) -> "_Reach":
        return _Reach(self.map, self.origin, max(_NARROWED * self.tolerance_px, 1.5))

    def highest(self, place: Array, radius_px: float) -> tuple[Array, float]:
        """The highest response about a place (2,) of the reduced scan, and how high; 0 outside of the map."""
        top, height = _highest(self.map, place - self.origin, radius_px)
        return top + self.origin, height


class _Reach:
    """The highest response within a radius of every place, and what chance places answer: nineteen in twenty of them
    stay below it."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], radius_px: float) -> None:
        self.map, self.origin = _dilated(map_, radius_px), origin
        self.chance = max(float(np.percentile(self.map[::3, ::3], 95)), 0.0)

    def share(self, height: float) -> float:
        """Of all places, those that answer as strongly."""
        return float(np.mean(self.map >= height))

    def strength(self, places: NDArray[np.int_]) -> tuple[Array, NDArray[np.bool_]]:
        """How much the places (n, 2) of the reduced scan answer beyond chance, and which of them lie in the map; those
        that do not have no answer."""
        rows, cols = self.map.shape
        col, row = (places - self.origin).T
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        response = np.where(inside, self.map[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)], 0.0).astype(float)
        return np.maximum(np.maximum(response, 0.0) ** 2 - self.chance**2, 0.0), inside


class _Constellation:
    """The marks as one pose names them, each with the layer that answers to it."""

    def __init__(self, search: PlacementSearch, pose: str, layers: Sequence[_Layer]) -> None:
        self.search, self.pose, self.layers = search, pose, layers
        self.responses, self.bounds, self.pitch = search.responses, search.bounds, search.pitch
        turned = np.array([mark.xy_mm for mark in search.marks]) @ up_from_camera(pose).T
        self.camera: Complex = turned[:, 0] + 1j * turned[:, 1]

    def placements(self, polarity: int) -> list[Placement]:
        scale, offset = self._hypotheses()
        if len(scale) == 0:
            return []
        scores, _ = self._scores([layer.wide for layer in self.layers], scale, offset)
        near = [layer.near for layer in self.layers]
        result: list[Placement] = []
        kept = np.argsort(-scores, kind="stable")[:_KEPT]
        for start in (
            *zip(scale[kept], offset[kept], strict=True),
            *self._slid(scale[kept[:_SLID]], offset[kept[:_SLID]]),
        ):
            a, b = self._refined(*map(complex, start))
            score, supported = self._scores(near, np.array([a]), np.array([b]))
            result.append(
                Placement(
                    self.pose,
                    self._pixel_from_camera(a, b),
                    float(score[0]),
                    int(supported[0]),
                    polarity,
                    self.responses.reduction,
                    (float(self.pitch[0]), float(self.pitch[1])),
                )
            )
        return result

    def _slid(self, scale: Complex, offset: Complex) -> list[tuple[complex, complex]]:
        """Of a lattice too large for all its marks to be candidates the best hypothesis may be many steps off: these,
        moved step by step as long as more marks answer. None where the marks are no lattice."""
        steps = np.concatenate([[0.0], self._steps()])
        wide = [layer.wide for layer in self.layers]
        moving = len(steps) > 1
        while moving:
            tried = offset[:, None] + scale[:, None] * steps
            scores = self._scores(wide, np.repeat(scale, len(steps)), tried.ravel())[0].reshape(tried.shape)
            best = scores.argmax(axis=1)
            moving = bool(best.any())
            offset = tried[np.arange(len(best)), best]
        return list(zip(scale, offset, strict=True)) if len(steps) > 1 else []

    def _steps(self) -> Complex:
        """The steps (mm) from the middle mark to the nearest ones that take most marks to others."""
        places = np.stack([self.camera.real, self.camera.imag], axis=1)
        tree = cKDTree(places)
        order = np.argsort(np.hypot(*(places - places.mean(axis=0)).T), kind="stable")
        middle = places[order[0]]
        _, near = tree.query(middle, k=min(len(places), _NEIGHBOURS + 1))
        steps = places[np.ravel(near)[1:]] - middle
        onto = [np.mean(tree.query(places + step)[0] < self.bounds.misfit_mm) for step in steps]
        return np.asarray((steps @ [1.0, 1.0j])[np.array(onto) > _ALIKE])

    def _complex(self, scan_px: Array) -> Complex:
        scaled = scan_px * self.pitch
        return np.asarray(scaled[..., 0] - 1j * scaled[..., 1])

    def _scan_px(self, places: Complex) -> Array:
        return np.asarray(np.stack([places.real, -places.imag], axis=-1) / self.pitch)

    def _hypotheses(self) -> tuple[Complex, Complex]:
        """Every similarity within bounds that takes two marks to two of their candidates."""
        candidates = {layer: self._complex(self.responses.scan_px(layer.candidates)) for layer in set(self.layers)}
        scales, offsets = [np.zeros(0, complex)], [np.zeros(0, complex)]
        for first, second in self._pairs():
            of_first, of_second = candidates[self.layers[first]], candidates[self.layers[second]]
            base = self.camera[second] - self.camera[first]
            scale = (of_second[None, :] - of_first[:, None]) / base
            allowed = (np.abs(np.abs(scale) - 1) < self.bounds.scale_tolerance) & (
                np.abs(np.angle(scale)) < self.bounds.rotation_rad
            )
            i, j = np.nonzero(allowed)
            scales.append(scale[i, j])
            offsets.append(of_first[i] - scale[i, j] * self.camera[first])
        return np.concatenate(scales), np.concatenate(offsets)

    def _pairs(self) -> list[tuple[int, int]]:
        """Pairs of marks far apart, spread evenly over all marks where there are too many."""
        first, second = np.triu_indices(len(self.camera), 1)
        length = np.abs(self.camera[first] - self.camera[second])
        far = np.flatnonzero(length >= 0.4 * length.max())
        step = max(1.0, len(far) / _PAIRS)
        chosen = far[(np.arange(min(len(far), _PAIRS)) * step).astype(int)]
        return list(zip(first[chosen].tolist(), second[chosen].tolist(), strict=True))

    def _scores(self, reached: Sequence[_Reach], scale: Complex, offset: Complex) -> tuple[Array, Array]:
        """Scores and numbers of supporting marks of many placements at once."""
        places = self.responses.reduced_px(self._scan_px(scale[:, None] * self.camera + offset[:, None]))
        nearest = np.rint(places).astype(int)
        answers = [reach.strength(nearest[:, k]) for k, reach in enumerate(reached)]
        strength, inside = (np.stack(each, axis=1) for each in zip(*answers, strict=True))
        score = strength.sum(axis=1) - _OUTSIDE_COST * (~inside).sum(axis=1)
        return score, (strength > 0).sum(axis=1)

    def _refined(self, scale: complex, offset: complex) -> tuple[complex, complex]:
        """The similarity through the responses about its predictions, each weighed by its strength."""
        widest = self.search.tolerance_px
        for tolerance_px in (widest, max(_NARROWED * widest, 1.5)):
            predicted = self.responses.reduced_px(self._scan_px(scale * self.camera + offset))
            found = [layer.highest(place, tolerance_px) for layer, place in zip(self.layers, predicted, strict=True)]
            weight = np.array([max(height - _LEAST_WEIGHED, 0.0) for _, height in found])
            if (weight > 0).sum() < 2:
                break
            places = self._complex(self.responses.scan_px(np.array([place for place, _ in found])))
            mean_from, mean_to = (np.sum(weight * p) / weight.sum() for p in (self.camera, places))
            from_, to = self.camera - mean_from, places - mean_to
            scale = complex(np.sum(weight * np.conj(from_) * to) / np.sum(weight * np.abs(from_) ** 2))
            offset = complex(mean_to - scale * mean_from)
        return scale, offset

    def _pixel_from_camera(self, scale: complex, offset: complex) -> Array:
        turn = np.array([[scale.real, -scale.imag], [scale.imag, scale.real]]) @ up_from_camera(self.pose)
        up = np.column_stack([turn, [offset.real, offset.imag]])
        return np.asarray(np.diag([1.0, -1.0]) @ up / self.pitch[:, None])


def _dilated(map_: Map, radius_px: float) -> Map:
    size = 2 * round(radius_px) + 1
    return np.asarray(cv2.dilate(map_, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))))


def _highest(map_: Map, place: Array, radius_px: float) -> tuple[Array, float]:
    """The highest response about a place, refined by a parabola; height 0 outside of the map."""
    rows, cols = map_.shape
    col0, row0 = np.clip(np.floor(place - radius_px).astype(int), 0, None)
    col1, row1 = np.clip(np.ceil(place + radius_px).astype(int) + 1, None, (cols, rows))
    if col0 >= col1 or row0 >= row1:
        return place, 0.0
    part = map_[row0:row1, col0:col1]
    best = divmod(int(part.argmax()), part.shape[1])
    row, col = best[0] + int(row0), best[1] + int(col0)
    top = np.array([col, row], dtype=float)
    if 0 < col < cols - 1 and 0 < row < rows - 1:
        top += [_vertex(map_[row, col - 1 : col + 2]), _vertex(map_[row - 1 : row + 2, col])]
    return top, float(map_[row, col])


def _vertex(three: Map) -> float:
    """Where the parabola through three values, the middle one the highest, has its top: -0.5 to 0.5."""
    bend = float(three[0] - 2 * three[1] + three[2])
    return float(np.clip((three[0] - three[2]) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
