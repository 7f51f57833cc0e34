"""Film transformations T: comparator (x, y) to camera (x', y') in mm, m = -1 where the scan is mirrored, else 1.

    none           x' = x                                      y' = y
    congruent      x' = a1 + cos(t) x - m sin(t) y             y' = b1 + sin(t) x + m cos(t) y     t: `angle`, rad
    similarity     x' = a1 + p x - m q y                       y' = b1 + q x + m p y
    affine         x' = a1 + a2 x + a3 y                       y' = b1 + b2 x + b3 y
    projective     the affine ones over d = 1 + c1 x + c2 y
    bilinear       the affine ones + a4 xy                     + b4 xy
    conformal(n)   x' + i y' = Σ (a[k+1] + i b[k+1]) z^k       k = 0..n, z = x + i m y
    polynomial(n)  x' = a1 + a2 x + a3 y + a4 x² + a5 xy + ... of total degree n; y' with b

Parameters are (..., k), coordinates (..., 2). The adjustment estimates the parameters of (x - center) / half, with the
centre and half the extent of an image's observations: the columns are nearly dependent otherwise. m is given for
congruent, similarity and conformal; the parameters of the others include mirroring.

A new one also needs its terms in `measure.fiducials.interior_orientation.film_terms` and an entry in
`adjust.model_selection.model_choice.TRANSFORMATIONS`.
"""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from math import comb

import numpy as np

from adjust.array_types import Array, Mask
from adjust.linear_algebra.small_matrices import NEWTON_STEPS, applied, determinant, solve_pairs

NEWTON_TOLERANCE = 1e-9  # fraction of a coordinate: the remaining error is the square of the last step
HIGHEST_ORDER = 5  # of polynomials: 21 terms an axis, more than fiducial marks of frames determine
MOST_SUBSETS = 100  # minimal subsets of marks that a robust fit tries
GROSS = 13.8  # squared distance, in variances of a coordinate, above which a mark is an outlier (0.1 % point)
PLAINLY = 0.01  # ratio of the squared residuals, mirrored over upright, below which a scan is mirrored
LEAST_VARIANCE_MM2 = 1e-4  # of a coordinate: film deformation and scanner errors reach this
LATTICE = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 8)]), axis=-1).reshape(-1, 2)


class FilmKind(ABC):
    """Formula for x', y' in x, y and its parameters.

    names: parameter names in order; a1 and b1 are the constants.
    """

    names: tuple[str, ...]

    @abstractmethod
    def apply(self, parameters: Array, xy: Array) -> Array:
        """Compute camera coordinates (..., 2) from comparator coordinates (..., 2)."""

    @abstractmethod
    def gradient(self, parameters: Array, xy: Array) -> Array:
        """Derivatives (..., 2, 2) of the camera coordinates with respect to the comparator coordinates."""

    @abstractmethod
    def design(self, parameters: Array, xy: Array, center: Array, half: Array) -> Array:
        """Derivatives (..., 2, k) of the camera coordinates with respect to the centred parameters.

        center (..., 2), half (...).
        """

    @abstractmethod
    def centred_jacobian(self, parameters: Array, center: Array, half: Array) -> Array:
        """Derivatives (..., k, k) of the parameters with respect to the centred parameters."""

    @property
    def degree(self) -> int:
        """Degree in the coordinates; of a fraction, which needs an `inverse` of its own, that of its parts."""
        return 1

    def inverse(self, parameters: Array, camera_xy: Array, center: Array) -> tuple[Array, Mask]:
        """Compute comparator coordinates (n, 2) from camera coordinates, and the mask of those found.

        Notes
        -----
        Newton's method starts at center (2,) or (n, 2), a place in the middle of the image. A point is found where the
        iteration converges and the determinant of the derivatives has the sign that it has at the centre, so that the
        formula does not fold over.
        """
        steps = 1 if self.degree == 1 else NEWTON_STEPS
        xy = np.broadcast_to(center, camera_xy.shape).astype(np.float64)
        at_center = self.gradient(parameters, xy)
        turn = np.sign(determinant(at_center))
        found = np.zeros(len(xy), dtype=bool)
        with np.errstate(over="ignore", invalid="ignore"):
            for number in range(steps):
                gradient = self.gradient(parameters, xy) if number else at_center
                step, regular = _solve_pairs(gradient, self.apply(parameters, xy) - camera_xy)
                xy = xy - step
                settled = np.abs(step).max(axis=-1) <= NEWTON_TOLERANCE * (1.0 + np.abs(xy).max(axis=-1))
                found = regular & (settled | (self.degree == 1))
                if found.all():
                    break
            same_side = np.sign(determinant(self.gradient(parameters, xy))) == turn
        return xy, np.asarray(found & same_side)


def least_marks(kind: FilmKind) -> int:
    """Number of marks, of two coordinates each, needed to determine the parameters of a formula."""
    return (len(kind.names) + 1) // 2


@dataclass(frozen=True)
class Identity(FilmKind):
    """x' = x, y' = y."""

    names: tuple[str, ...] = ()

    def apply(self, parameters: Array, xy: Array) -> Array:
        return xy

    def gradient(self, parameters: Array, xy: Array) -> Array:
        return np.broadcast_to(np.eye(2), (*xy.shape[:-1], 2, 2))

    def design(self, parameters: Array, xy: Array, center: Array, half: Array) -> Array:
        return np.zeros((*xy.shape, 0))

    def centred_jacobian(self, parameters: Array, center: Array, half: Array) -> Array:
        return np.zeros((*np.shape(half), 0, 0))

    def inverse(self, parameters: Array, camera_xy: Array, center: Array) -> tuple[Array, Mask]:
        return camera_xy.copy(), np.ones(len(camera_xy), dtype=bool)


@dataclass(frozen=True, eq=False)
class Polynomial(FilmKind):
    """x' = sum of a_k x^p_k y^q_k, y' = sum of b_k x^p_k y^q_k; exponents (p_k, q_k), the constant first.

    mixing (2 t, k): derivatives of the coefficients a, b of t terms with respect to the parameters, orthogonal columns.
    """

    names: tuple[str, ...]
    exponents: tuple[tuple[int, int], ...]
    mixing: Array

    def apply(self, parameters: Array, xy: Array) -> Array:
        return self._combination(parameters, self._terms(xy))

    def gradient(self, parameters: Array, xy: Array) -> Array:
        return np.stack([self._combination(parameters, self._terms(xy, by)) for by in (0, 1)], axis=-1)

    def design(self, parameters: Array, xy: Array, center: Array, half: Array) -> Array:
        terms = self._terms((xy - center) / half[..., None])
        count = len(self.exponents)
        design = np.zeros((*xy.shape, 2 * count), dtype=terms.dtype)
        design[..., 0, :count] = design[..., 1, count:] = terms
        return np.asarray(design @ self.mixing)

    def centred_jacobian(self, parameters: Array, center: Array, half: Array) -> Array:
        count = len(self.exponents)
        result = np.zeros((*np.shape(half), 2 * count, 2 * count))
        for j, (p, q) in enumerate(self.exponents):
            for i, (u, v) in enumerate(self.exponents):
                if u <= p and v <= q:
                    shift = (-center[..., 0]) ** (p - u) * (-center[..., 1]) ** (q - v)
                    result[..., i, j] = comb(p, u) * comb(q, v) * shift / half ** (p + q)
        result[..., count:, count:] = result[..., :count, :count]
        return np.asarray((self.mixing / (self.mixing**2).sum(axis=0)).T @ result @ self.mixing)

    @cached_property
    def degree(self) -> int:
        return max(p + q for p, q in self.exponents)

    def _terms(self, xy: Array, by: int | None = None) -> Array:
        """Monomials (..., terms), or their derivatives with respect to x (0) or y (1)."""
        powers = [np.ones_like(xy)]
        for _ in range(self.degree):
            powers.append(powers[-1] * xy)
        terms = []
        for exponents in self.exponents:
            lowered, factor = list(exponents), 1.0
            if by is not None:
                factor = float(exponents[by])
                lowered[by] = max(exponents[by] - 1, 0)
            terms.append(factor * powers[lowered[0]][..., 0] * powers[lowered[1]][..., 1])
        return np.stack(terms, axis=-1)

    def _combination(self, parameters: Array, terms: Array) -> Array:
        coefficients = parameters @ self.mixing.T
        count = len(self.exponents)
        first, second = coefficients[..., :count], coefficients[..., count:]
        return np.stack([(first * terms).sum(-1), (second * terms).sum(-1)], axis=-1)


def polynomial(exponents: tuple[tuple[int, int], ...]) -> Polynomial:
    """Make a polynomial with free coefficients."""
    names = tuple(f"{axis}{k}" for axis in "ab" for k in range(1, len(exponents) + 1))
    return Polynomial(names, exponents, np.eye(len(names)))


def whole_polynomial(order: int) -> Polynomial:
    """Make a polynomial with all terms up to a total degree."""
    return polynomial(tuple((degree - q, q) for degree in range(order + 1) for q in range(degree + 1)))


def conformal(order: int, mirrored: bool, names: tuple[str, ...]) -> Polynomial:
    """x' + i y' = sum of (a_k + i b_k) (x + i m y)^(k-1), k = 1 .. order + 1; m = -1 where mirrored."""
    exponents, turn = whole_polynomial(order).exponents, -1j if mirrored else 1j
    powers = np.array([[comb(p + q, q) * turn**q * (p + q == k) for k in range(order + 1)] for p, q in exponents])
    columns = np.stack([powers, 1j * powers], axis=-1).reshape(len(exponents), -1)  # by a_1, b_1, a_2, ...
    return Polynomial(names, exponents, np.concatenate([columns.real, columns.imag]))


@dataclass(frozen=True)
class Congruent(FilmKind):
    """Rotation, shift and a known mirroring: a similarity with p, q the cosine and sine of the angle."""

    mirrored: bool
    names: tuple[str, ...] = ("a1", "b1", "angle")

    def apply(self, parameters: Array, xy: Array) -> Array:
        return parameters[..., :2] + applied(self._turn(parameters), xy)

    def gradient(self, parameters: Array, xy: Array) -> Array:
        return np.broadcast_to(self._turn(parameters), (*xy.shape[:-1], 2, 2))

    def design(self, parameters: Array, xy: Array, center: Array, half: Array) -> Array:
        design = np.zeros((*xy.shape, 3), dtype=np.result_type(parameters, xy))
        design[..., :2] = np.eye(2)
        design[..., 2] = applied(self._turn(parameters, np.pi / 2.0), xy - center)
        return design

    def centred_jacobian(self, parameters: Array, center: Array, half: Array) -> Array:
        result = np.broadcast_to(np.eye(3), (*np.shape(half), 3, 3)).copy()
        result[..., :2, 2] = -applied(self._turn(parameters, np.pi / 2.0), center)
        return result

    def _turn(self, parameters: Array, further: float = 0.0) -> Array:
        """Rotation matrix. Its derivative is the matrix of the angle plus a right angle."""
        c, s = np.cos(parameters[..., 2] + further), np.sin(parameters[..., 2] + further)
        m = -1.0 if self.mirrored else 1.0
        return np.stack([np.stack([c, -m * s], axis=-1), np.stack([s, m * c], axis=-1)], axis=-2)


@dataclass(frozen=True)
class Projective(FilmKind):
    """x' = (a1 + a2 x + a3 y) / d, y' = (b1 + b2 x + b3 y) / d, d = 1 + c1 x + c2 y."""

    names: tuple[str, ...] = ("a1", "a2", "a3", "b1", "b2", "b3", "c1", "c2")

    def apply(self, parameters: Array, xy: Array) -> Array:
        numerators = parameters[..., [0, 3]] + applied(self._linear(parameters), xy)
        return numerators / self._denominator(parameters, xy)[..., None]

    def gradient(self, parameters: Array, xy: Array) -> Array:
        bent = self.apply(parameters, xy)[..., :, None] * parameters[..., None, 6:]
        return (self._linear(parameters) - bent) / self._denominator(parameters, xy)[..., None, None]

    def design(self, parameters: Array, xy: Array, center: Array, half: Array) -> Array:
        u, v = np.moveaxis((xy - center) / half[..., None], -1, 0)
        camera_xy = self.apply(parameters, xy)
        design = np.zeros((*xy.shape, 8), dtype=camera_xy.dtype)
        for row in (0, 1):
            terms = np.stack([np.ones_like(u), u, v], axis=-1)
            design[..., row, 3 * row : 3 * row + 3] = terms
            design[..., row, 6:] = -camera_xy[..., row, None] * terms[..., 1:]
        centred = self._denominator(parameters, xy) / self._denominator(parameters, center)
        return design / centred[..., None, None]

    def centred_jacobian(self, parameters: Array, center: Array, half: Array) -> Array:
        """Derivatives (..., 8, 8); the numerators differ by the factor d(center), and d(0) = 1 adds its derivative."""
        factor = self._denominator(parameters, center)[..., None]
        result = np.zeros((*np.shape(half), 8, 8))
        size = half[..., None]
        for first in (0, 3):
            result[..., first, first] = factor[..., 0]
            result[..., first, first + 1 : first + 3] = -factor * center / size
            result[..., [first + 1, first + 2], [first + 1, first + 2]] = factor / size
        result[..., [6, 7], [6, 7]] = factor / size
        result[..., :, 6:] += parameters[..., :, None] * (factor * center / size)[..., None, :]
        return result

    def inverse(self, parameters: Array, camera_xy: Array, center: Array) -> tuple[Array, Mask]:
        bent = camera_xy[..., :, None] * parameters[..., None, 6:]
        solution, regular = _solve_pairs(self._linear(parameters) - bent, camera_xy - parameters[..., [0, 3]])
        same_side = self._denominator(parameters, solution) * self._denominator(parameters, center) > 0.0
        return solution, np.asarray(regular & same_side)  # beyond the horizon the image is upside down

    def _linear(self, parameters: Array) -> Array:
        return np.stack([parameters[..., 1:3], parameters[..., 4:6]], axis=-2)

    def _denominator(self, parameters: Array, xy: Array) -> Array:
        return np.asarray(1.0 + (parameters[..., 6:] * xy).sum(-1))


def _solve_pairs(matrix: Array, right: Array) -> tuple[Array, Mask]:
    """Solutions (n, 2) of 2x2 systems (n, 2, 2), and the mask (n,) of regular matrices."""
    det = determinant(matrix)
    regular = np.isfinite(det) & (det != 0.0)
    return solve_pairs(matrix, right, regular, det), regular


FILM_NAMES = ("none", "congruent", "similarity", "affine", "projective", "bilinear", "conformal(n)", "polynomial(n)")


@lru_cache
def film_kind(spelling: str, mirrored: bool = False) -> FilmKind:
    """Return the formula of a transformation by its name. Raises ValueError, listing the names, for any other."""
    match spelling:
        case "none":
            return Identity()
        case "congruent":
            return Congruent(mirrored)
        case "similarity":
            return conformal(1, mirrored, ("a1", "b1", "p", "q"))
        case "affine":
            return whole_polynomial(1)
        case "projective":
            return Projective()
        case "bilinear":
            return polynomial(((0, 0), (1, 0), (0, 1), (1, 1)))
    name, order = _name_and_order(spelling)
    if name == "polynomial":
        return whole_polynomial(order)
    return conformal(order, mirrored, tuple(f"{axis}{k}" for k in range(1, order + 2) for axis in "ab"))


def _name_and_order(spelling: str) -> tuple[str, int]:
    form = re.fullmatch(r"(conformal|polynomial)\((\d+)\)", spelling)
    if form and 1 <= int(form[2]) <= HIGHEST_ORDER:
        return form[1], int(form[2])
    why = ""
    if form:
        why = f" its order must be from 1 to {HIGHEST_ORDER};"
    elif spelling in ("conformal", "polynomial"):
        why = f' it lacks its order, as in "{spelling}(2)";'
    possible = f"{', '.join(FILM_NAMES)}, with the order n from 1 to {HIGHEST_ORDER}"
    raise ValueError(f"there is no transformation {spelling!r}:{why} possible are {possible}")


def film_parameter_names(spelling: str) -> tuple[str, ...]:
    """Names of a transformation's parameters in order."""
    return film_kind(spelling).names


def marks_needed(spelling: str) -> int:
    """Number of fiducial marks that determine a transformation without redundancy."""
    return least_marks(film_kind(spelling))


@lru_cache
def fewest_marks(spelling: str) -> int:
    """Number of fiducial marks that initial values need: those of the simplest transformation of the family."""
    lower = simpler(spelling)
    return fewest_marks(lower) if lower else marks_needed(spelling)


def simpler(spelling: str) -> str | None:
    """Return the transformation of the same family that needs fewer marks, or None."""
    if spelling in ("projective", "bilinear", "polynomial(2)"):
        return "affine"
    if spelling == "conformal(2)":
        return "similarity"
    if spelling.startswith(("conformal", "polynomial")):
        name, order = _name_and_order(spelling)
        return f"{name}({order - 1})" if order > 1 else None
    return None


def polynomial_order(spelling: str) -> int:
    """Order of a conformal or general polynomial; 1 for all other transformations."""
    return _name_and_order(spelling)[1] if spelling.startswith(("conformal", "polynomial")) else 1


def follows_tilts(spelling: str) -> bool:
    """Whether a transformation can absorb the effect of a small camera tilt: x' + t x'², y' + t x'y'.

    A projective transformation absorbs it exactly, a polynomial as long as it is nearly affine, a conformal one
    together with decentering distortion.
    """
    return spelling == "projective" or (simpler(spelling) is not None and spelling != "bilinear")


@dataclass(frozen=True)
class Film:
    """Film transformation of one image."""

    transformation: str  # name of the transformation
    parameters: Array  # (k,) in the order of `film_parameter_names`
    center_mm: Array  # (2,) comparator coordinates of a place in the middle of the image
    mirrored: bool = False  # whether the scan is mirrored

    def camera_from_comparator(self, xy_mm: Array) -> Array:
        """Compute camera coordinates (n, 2) from comparator coordinates (n, 2), mm."""
        return self._kind.apply(self.parameters, xy_mm)

    def gradient(self, xy_mm: Array) -> Array:
        """Derivatives (n, 2, 2) of the camera coordinates with respect to the comparator coordinates."""
        return self._kind.gradient(self.parameters, xy_mm)

    def comparator_from_camera(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Compute comparator coordinates (n, 2) from camera coordinates (n, 2), mm, and the mask of those found."""
        return self._kind.inverse(self.parameters, xy_mm, self.center_mm)

    def design(self, xy_mm: Array) -> Array:
        """Derivatives (n, 2, k) of the camera coordinates with respect to the parameters."""
        return self._kind.design(self.parameters, xy_mm, np.zeros(2), np.ones(()))

    @property
    def _kind(self) -> FilmKind:
        return film_kind(self.transformation, self.mirrored)


def fit_transformation(transformation: str, comparator_mm: Array, camera_mm: Array) -> tuple[Array, bool]:
    """Fit a film transformation to fiducial marks, robustly against gross errors.

    Parameters
    ----------
    comparator_mm, camera_mm : (n, 2) measured and calibrated coordinates of the same marks, at least `fewest_marks`.

    Returns
    -------
    Parameters in the order of `film_parameter_names`, and whether the scan is mirrored.

    Notes
    -----
    Least squares on all marks if they agree; otherwise on the inliers of a least-trimmed-squares estimate over minimal
    subsets. A projective transformation is fitted to its equations multiplied by the denominator. With too few marks
    for the transformation, the simpler one of its family that they determine is fitted instead. A scan is mirrored if a
    mirrored similarity has far smaller residuals; two marks, or marks on a line, do not decide this and count as
    upright.
    """
    if transformation == "none":
        return np.zeros(0), False
    mirrored = False
    if len(comparator_mm) >= 3:
        kinds = [film_kind("similarity", is_mirrored) for is_mirrored in (False, True)]
        squared = _complex_square(kinds[0], _fit(kinds[0], comparator_mm, camera_mm), comparator_mm, camera_mm)
        if not _agree(squared):
            costs = [_robust_fit(each, comparator_mm, camera_mm)[1] for each in kinds]
            mirrored = costs[1] < PLAINLY * costs[0]
    kind = film_kind(transformation, mirrored)
    if marks_needed(transformation) > len(comparator_mm) and (lower := simpler(transformation)):
        parameters, _ = fit_transformation(lower, comparator_mm, camera_mm)
        lattice = comparator_mm.mean(axis=0) + _half(comparator_mm) * LATTICE
        return _fit(kind, lattice, film_kind(lower, mirrored).apply(parameters, lattice)), mirrored
    return _robust_fit(kind, comparator_mm, camera_mm)[0], mirrored


def _robust_fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> tuple[Array, float]:
    """Fit by least trimmed squares; returns the parameters and the trimmed sum of squared distances."""
    n, fewest = len(comparator_mm), least_marks(kind)
    half = (n + fewest + 1) // 2
    best = _fit(kind, comparator_mm, camera_mm)
    squared = _complex_square(kind, best, comparator_mm, camera_mm)
    best_cost = float(np.sort(squared)[:half].sum())
    if half == n or _agree(squared):
        return best, best_cost
    if comb(n, fewest) <= MOST_SUBSETS:
        kept = np.array(list(combinations(range(n), fewest)))
    else:
        generator = np.random.default_rng(0)
        kept = np.array([generator.permutation(n)[:fewest] for _ in range(MOST_SUBSETS)])
    for _ in range(3):
        candidates = _fit(kind, comparator_mm[kept], camera_mm[kept])
        squared = _complex_square(kind, candidates[:, None], comparator_mm, camera_mm)
        kept = np.argsort(squared, axis=1, kind="stable")[:, :half]
    costs = np.take_along_axis(squared, kept, axis=1).sum(axis=1)
    if costs.min() < best_cost:
        best, best_cost = candidates[costs.argmin()], float(costs.min())
    variance = best_cost / (2 * half - len(kind.names))
    agree = _complex_square(kind, best, comparator_mm, camera_mm) < GROSS * max(variance, LEAST_VARIANCE_MM2)
    return _fit(kind, comparator_mm[agree], camera_mm[agree]), best_cost


def _agree(squared: Array) -> bool:
    """Whether all residuals are within what film deformation and scanner errors explain."""
    return bool((squared < GROSS * LEAST_VARIANCE_MM2).all())


def _complex_square(kind: FilmKind, parameters: Array, comparator_mm: Array, camera_mm: Array) -> Array:
    with np.errstate(all="ignore"):  # a subset of poor geometry may map other marks to infinity
        squared = ((kind.apply(parameters, comparator_mm) - camera_mm) ** 2).sum(axis=-1)
    return np.where(np.isfinite(squared), squared, np.inf)


def _fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> Array:
    """Least-squares parameters (..., u) of centred marks (..., n, 2); of minimum norm where they are rank-deficient."""
    center, half = comparator_mm.mean(axis=-2, keepdims=True), _half(comparator_mm)
    target = camera_mm.mean(axis=-2, keepdims=True)
    xy, moved = comparator_mm - center, camera_mm - target
    match kind:
        case Identity():
            return np.zeros((*half.shape, 0))
        case Congruent():
            m = -1.0 if kind.mirrored else 1.0
            (x, y), (u, v) = np.moveaxis(xy, -1, 0), np.moveaxis(moved, -1, 0)
            turn = np.zeros((*half.shape, 3))
            turn[..., 2] = np.arctan2((x * v - m * y * u).sum(axis=-1), (x * u + m * y * v).sum(axis=-1))
            turn[..., :2] = target[..., 0, :] - kind.apply(turn, center[..., 0, :])
            return turn
        case Projective():
            return _projective(xy / half[..., None, None], moved, center, half, target)
    nothing = np.zeros(len(kind.names))
    design = kind.design(nothing, comparator_mm, center, half[..., None])
    parameters = applied(kind.centred_jacobian(nothing, center[..., 0, :], half), _least_squares(design, moved))
    parameters[..., [kind.names.index("a1"), kind.names.index("b1")]] += target[..., 0, :]
    return parameters


def _least_squares(design: Array, values: Array) -> Array:
    """Minimum-norm least-squares solution (..., u); design (..., n, 2, u), values (..., n, 2)."""
    rows = design.reshape(*design.shape[:-3], -1, design.shape[-1])
    smallest = max(rows.shape[-2:]) * float(np.finfo(np.float64).eps)  # relative to the largest one, as lstsq
    inverse: Array = np.linalg.pinv(rows, rcond=smallest).astype(np.float64)
    return applied(inverse, values.reshape(*values.shape[:-2], -1))


def _half(xy_mm: Array) -> Array:
    """(...) half the longer side of the bounding box of marks (..., n, 2); 1 where it is 0."""
    half = np.ptp(xy_mm, axis=-2).max(axis=-1) / 2.0
    return np.where(half > 0.0, half, 1.0)


def _projective(xy: Array, moved: Array, center: Array, half: Array, target: Array) -> Array:
    """Solve x' (1 + c1 x + c2 y) = a1 + a2 x + a3 y, and likewise for y', after Hartley's normalisation."""
    size = _half(moved)[..., None, None]
    rows = np.zeros((*xy.shape, 8))
    for row in (0, 1):
        rows[..., row, 3 * row] = 1.0
        rows[..., row, 3 * row + 1 : 3 * row + 3] = xy
        rows[..., row, 6:] = -xy * moved[..., row, None] / size
    solved = _least_squares(rows, moved / size)
    unit = np.concatenate([solved, np.ones_like(solved[..., :1])], axis=-1)[..., [1, 2, 0, 4, 5, 3, 6, 7, 8]]
    matrix = _scaled(size[..., 0, 0], target[..., 0, :]) @ unit.reshape(*half.shape, 3, 3)
    matrix = matrix @ np.linalg.inv(_scaled(half, center[..., 0, :]))
    flat = (matrix / matrix[..., 2:, 2:]).reshape(*half.shape, 9)
    return np.asarray(flat[..., [2, 0, 1, 5, 3, 4, 6, 7]])


def _scaled(size: Array, origin: Array) -> Array:
    """Homogeneous matrices (..., 3, 3) that scale by size (...) and then shift to origin (..., 2)."""
    matrix = np.zeros((*size.shape, 3, 3))
    matrix[..., [0, 1], [0, 1]], matrix[..., :2, 2], matrix[..., 2, 2] = size[..., None], origin, 1.0
    return matrix
