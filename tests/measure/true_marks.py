"""Marks with truth for tests and benchmarks: exact areas from `synthetic_images`, and the Cramér-Rao bound of their
places from differences of those pictures. Nothing of `measure` draws here."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import distance_transform_edt, gaussian_filter

from measure.marks.shapes import Bar, Disk, MarkShape, Part, Ring, cross, dot, polygon, ring_cross, ring_dot
from synthetic_images import areas
from synthetic_images.optics import blurred_coverage, reach_px

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Moves = tuple[tuple[float, float, float, float], ...]

# Unknown changes of a mark's linear part, as generators (xx, xy, yx, yy).
TURN, SCALE = (0.0, -1.0, 1.0, 0.0), (1.0, 0.0, 0.0, 1.0)
STRETCH, SHEAR = (1.0, 0.0, 0.0, -1.0), (0.0, 1.0, 1.0, 0.0)
ALL_MOVES = (SCALE, TURN, STRETCH, SHEAR)
GREYS = 4  # gain, offset, two slopes
MARGIN_PX = 8  # of ground about a mark's bounds
MARGIN_BLURS = 4.0  # standard deviations of the blur, about its outline
_OUTLINE_BLUR_PX, _SHOWN = 0.3, 0.02  # what counts as the mark itself
_FOLD = 8  # pixels of a quarter leave bars that cross almost along the pixels 0.001 px off
WHITE = 0.1  # of the variance of grain: the scanner's own noise


@dataclass(frozen=True)
class Kind:
    """A mark of about 10 px a mm. unknown: what a fit of it cannot take for known beside place, blur and greys;
    known: the standard deviation with which the other marks of a frame give these, infinite where they do not."""

    name: str
    shape: MarkShape
    unknown: Moves = (SCALE, TURN)
    known: float = np.inf


FROM_FRAME = 1e-4  # rad: marks known to 0.1 px, a thousand px apart
WING = ((0.0, 0.0), (0.0, 1.8), (1.0, 1.8))
WEDGE = ((0.0, 0.0), (-0.8, 1.8), (0.8, 1.8))
NOTCH = ((-1.2, 0.0), (0.0, -1.0), (1.2, 0.0), (1.2, 1.2), (-1.2, 1.2))
KINDS = (
    Kind("cross", MarkShape(cross(1.5, 0.15))),
    Kind("gap cross", MarkShape(cross(1.5, 0.15, 0.4))),
    Kind("réseau cross", MarkShape(cross(1.0, 0.25))),
    Kind("dot", MarkShape(dot(0.5)), (SCALE,)),
    Kind("ring-cross", MarkShape(ring_cross(1.0, 0.2, 1.6, 0.15, angle_deg=45.0))),
    Kind("ring-dot", MarkShape(ring_dot(1.0, 0.15, 0.25)), (SCALE,)),
    Kind("ellipse", MarkShape(dot(1.0)), (SCALE, STRETCH, SHEAR)),
    Kind("wedge", MarkShape(polygon(WEDGE)), ALL_MOVES, FROM_FRAME),
    Kind("wing", MarkShape(polygon(WING)), ALL_MOVES, FROM_FRAME),
    Kind("notch", MarkShape(polygon(NOTCH)), ALL_MOVES, FROM_FRAME),
)
KIND = {kind.name: kind for kind in KINDS}


@dataclass(frozen=True, eq=False)
class TrueMark:
    """A mark in a window of size x size px: place (2, 3), pixels from mm."""

    kind: Kind
    place: Array
    size: int
    blur_px: float

    @cached_property
    def picture(self) -> Array:
        """(size, size): 1 inside of the mark, 0 outside, seen through the blur."""
        return self._cover(self.place, self.blur_px)

    @cached_property
    def design(self) -> Array:
        """(2 + moves + 1 + GREYS, size, size): what changes with each unknown, for a contrast of 1."""
        row, col = np.mgrid[: self.size, : self.size] / self.size - 0.5
        shifts = np.array([[0.0, 0, 0.05], [0, 0, 0]]), np.array([[0.0, 0, 0], [0, 0, 0.05]])
        columns = [
            (self._cover(self.place + s, self.blur_px) - self._cover(self.place - s, self.blur_px)) / 0.1
            for s in shifts
        ]
        columns += [self._move_derivative(np.reshape(move, (2, 2))) for move in self.kind.unknown]
        columns.append(
            (self._cover(self.place, self.blur_px + 0.02) - self._cover(self.place, self.blur_px - 0.02)) / 0.04
        )
        return np.stack([*columns, self.picture, np.ones_like(col), col, row])

    def bound(self, sigma: float, seen: Mask | None = None, correlation: Array | None = None) -> Array:
        """(2, 2) the least covariance of the place, px², for noise of that standard deviation, contrast 1.

        seen (size, size): the pixels that show the mark. correlation (2 n + 1, 2 n + 1): of the noise at all lags.
        """
        return self._best(sigma, seen, correlation)[0][0]

    def best_errors(
        self,
        noise: Array,
        sigma: float,
        seen: Mask | None = None,
        correlation: Array | None = None,
        told: Array | None = None,
    ) -> Array:
        """(2,) the errors that the best linear estimate makes in this very noise (size, size), contrast 1, and with
        what the frame tells of its moves being off by told (moves,).

        Their mean square is the bound. Beside them, the errors of another method show in few marks what its own mean
        square would show in thousands only.
        """
        (_, by_grey, by_statement), near = self._best(sigma, seen, correlation)
        errors = by_grey @ noise[near]
        return np.asarray(errors if told is None else errors + by_statement @ told)

    def _best(self, sigma: float, seen: Mask | None, correlation: Array | None) -> tuple[tuple[Array, ...], Mask]:
        """The bound, how the best estimate of the place follows from the pixels (2, pixels) and from what the frame
        tells (2, moves), and which pixels these are."""
        near = self.near if seen is None else self.near & seen
        if correlation is None:
            design = self.design[:, near].T
            return self._solved(design, design, sigma), near
        key = (sigma, correlation.tobytes())
        if key not in self._coloured:
            design = self.design[:, near].T
            self._coloured[key] = self._solved(design, cho_solve(cho_factor(_matrix(correlation, near)), design), sigma)
        return self._coloured[key], near

    def _solved(self, design: Array, weighted: Array, sigma: float) -> tuple[Array, ...]:
        normal = design.T @ weighted / sigma**2
        moves = np.arange(2, 2 + len(self.kind.unknown))
        normal[moves, moves] += self.kind.known**-2
        size = np.sqrt(np.diag(normal))
        inverse = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
        return inverse[:2, :2], inverse[:2] @ weighted.T / sigma**2, inverse[:2, moves] * self.kind.known**-2

    @cached_property
    def _coloured(self) -> dict[tuple[float, bytes], tuple[Array, ...]]:
        return {}

    @cached_property
    def near(self) -> Mask:
        """Within MARGIN_PX of the mark's bounds and, so that no fit does better than the bound, at least what
        one takes in of a soft picture."""
        col0, row0, width, height = areas.bounds(mark_areas(self.kind.shape, self.place))
        row, col = np.mgrid[: self.size, : self.size]
        outside = self._cover(self.place, _OUTLINE_BLUR_PX) < _SHOWN
        return np.asarray(
            (col >= col0 - MARGIN_PX)
            & (col < col0 + width + MARGIN_PX)
            & (row >= row0 - MARGIN_PX)
            & (row < row0 + height + MARGIN_PX)
            | (np.asarray(distance_transform_edt(outside)) <= MARGIN_BLURS * self.blur_px)
        )

    def _move_derivative(self, generator: Array) -> Array:
        step = 0.003
        plus, minus = (
            np.column_stack([(np.eye(2) + sign * step * generator) @ self.place[:, :2], self.place[:, 2]])
            for sign in (1, -1)
        )
        return (self._cover(plus, self.blur_px) - self._cover(minus, self.blur_px)) / (2 * step)

    def _cover(self, place: Array, blur_px: float) -> Array:
        outlines = mark_areas(self.kind.shape, place)
        col0, row0, width, height = areas.bounds(outlines)
        reach = reach_px(blur_px)
        col0, row0 = max(col0 - reach, 0), max(row0 - reach, 0)
        width, height = min(width + 2 * reach, self.size - col0), min(height + 2 * reach, self.size - row0)
        view = np.zeros((self.size, self.size))
        shown = blurred_coverage(outlines, col0, row0, width, height, blur_px, _FOLD)
        view[row0 : row0 + height, col0 : col0 + width] = shown
        return view


def mark_areas(shape: MarkShape, pixel_from_mark: Array) -> tuple[areas.Area, ...]:
    """The mark's outlines in px."""
    return tuple(
        tuple(outline @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2] for outline in _area(part))
        for part in shape.parts
    )


def _area(part: Part) -> areas.Area:
    if isinstance(part, Disk):
        return areas.disk(part.center_mm, part.radius_mm)
    if isinstance(part, Ring):
        return areas.ring(part.center_mm, part.radius_mm, part.line_mm)
    if isinstance(part, Bar):
        return areas.bar(part.from_mm, part.to_mm, part.line_mm)
    return areas.polygon(part.vertices_mm)


def some_mark(kind: Kind, blur_px: float, rng: np.random.Generator, size: int = 0, px_per_mm: float = 10.0) -> TrueMark:
    """A mark of random phase, rotation and scale (5 %) about the middle of its window."""
    if not size:
        extent = max(float(np.abs(outline).max()) for area in mark_areas(kind.shape, np.eye(2, 3)) for outline in area)
        size = 2 * int(extent * 1.05 * 1.42 * px_per_mm + MARGIN_PX + 2 * blur_px + 30) + 1
    turn, scale = rng.uniform(-np.pi, np.pi), px_per_mm * rng.uniform(0.95, 1.05)
    if kind.name == "ellipse":
        linear = _rotation(turn) @ np.diag([0.6, 0.6 * rng.uniform(0.55, 0.95)]) * scale
    else:
        linear = scale * _rotation(turn) @ np.diag([1.0, -1.0])
    return TrueMark(kind, np.column_stack([linear, (size - 1) / 2 + rng.uniform(-0.5, 0.5, 2)]), size, blur_px)


def _rotation(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _matrix(correlation: Array, seen: Mask) -> Array:
    """The correlation matrix of the pixels seen."""
    reach = correlation.shape[0] // 2
    place = np.argwhere(seen)
    lag = place[:, None] - place[None]
    far = np.abs(lag).max(axis=2) > reach
    return np.where(far, 0.0, correlation[tuple(np.moveaxis(np.clip(lag, -reach, reach) + reach, -1, 0))])


def grainy(size: int, grain_px: float, rng: np.random.Generator) -> Array:
    """(size, size) white noise after a Gaussian, and a share of white noise, of unit variance in all."""
    reach = int(np.ceil(4 * grain_px))
    smooth = gaussian_filter(rng.standard_normal((size + 2 * reach,) * 2), grain_px)[reach:-reach, reach:-reach]
    unit = smooth * 2 * grain_px * np.sqrt(np.pi)
    return np.asarray(np.sqrt(1 - WHITE) * unit + np.sqrt(WHITE) * rng.standard_normal((size, size)))


def grain_correlation(grain_px: float, reach: int = 9) -> Array:
    """(2 reach + 1, 2 reach + 1) the autocorrelation of `grainy`."""
    index = np.arange(-reach, reach + 1)
    correlation = (1 - WHITE) * np.exp(-(index[:, None] ** 2 + index[None] ** 2) / (4 * grain_px**2))
    correlation[reach, reach] = 1.0
    return np.asarray(correlation)


def whitened_rms(errors: Sequence[Array], covariances: Sequence[Array]) -> float:
    """rms of errors (2,) in units of their own standard deviations."""
    whitened = [np.linalg.solve(np.linalg.cholesky(c), e) for e, c in zip(errors, covariances, strict=True)]
    return float(np.sqrt(np.mean(np.square(whitened))))
