"""Interior orientation by weighted least squares: a similarity, an affinity with a prior, and the terms of the film
deformation model."""

from dataclasses import dataclass

import numpy as np

from measure.array_types import Array

AFFINITY_SIGMA = 5e-3  # relative stretch: a few parts in ten thousand by film, several thousandths by an office scanner
_LINEAR = [0, 1, 4, 5]  # indices of the unknowns of the affine model without the shift
_FREE = 0.03  # fraction of the frame's radius: prior standard deviation of free stretch, shear and film terms
_WITHIN_AFFINE = ("none", "congruent", "similarity", "affine")  # film models without terms beyond an affine one
_INVERSIONS = 6  # iterations of the inversion of a perspective, each correction a fiftieth of the one before


def interleaved(*columns: tuple[Array, Array]) -> Array:
    """(2n, k) design matrix from k columns, each given as (n,) in x and (n,) in y; rows x1, y1, x2, ..."""
    return np.stack([np.stack(each, axis=1).ravel() for each in columns], axis=1)


def film_terms(model: str, places: Array, measured: Array | None = None) -> Array:
    """Columns (2n, k) of a film model's design matrix in addition to an affine transformation.

    Parameters
    ----------
    model : projective, bilinear, conformal(n) or polynomial(n); the models in `_WITHIN_AFFINE`, and those of order 1,
        have no further terms.
    places : (n, 2) given places.
    measured : (n, 2) measured places, with which the equations of a projective transformation are linear (DLT). None:
        it is linearised.

    Raises
    ------
    ValueError
        If the model is not known: marks would be tested against plain affine film.
    """
    x, y = places.T
    u, v = places.T if measured is None else measured.T
    none = np.zeros_like(x)
    name, _, order = model.rstrip(")").partition("(")
    powers = range(2, int(order) + 1) if order.isdigit() else range(0)
    if name == "projective":
        return interleaved((u * x, v * x), (u * y, v * y))
    if name == "bilinear":
        return interleaved((x * y, none), (none, x * y))
    if name in _WITHIN_AFFINE or (name in ("conformal", "polynomial") and order == "1"):
        return np.zeros((2 * len(places), 0))
    if name == "conformal" and powers:
        z = [(x + 1j * y) ** power for power in powers]
        return interleaved(*[(each.real, each.imag) for each in z], *[(-each.imag, each.real) for each in z])
    if name == "polynomial" and powers:
        terms = [x ** (degree - q) * y**q for degree in powers for q in range(degree + 1)]
        return interleaved(*[(each, none) for each in terms], *[(none, each) for each in terms])
    known = ", ".join((*_WITHIN_AFFINE, "projective", "bilinear", "conformal(n)", "polynomial(n)"))
    raise ValueError(f"the film model is {model!r}; one of {known} is right")


@dataclass(frozen=True, eq=False)
class FilmFit:
    """Fitted film model with terms beyond an affine transformation, in units of radius_mm.

    turn (2, 2): of the scan orientation; center_mm (2,): centroid of the marks in the scan; affine (2, 3): affine part;
    terms (k,): coefficients of the further terms.
    """

    model: str
    turn: Array
    radius_mm: float
    center_mm: Array
    affine: Array
    terms: Array

    def places_mm(self, camera_mm: Array) -> Array:
        """Transform places (n, 2) in the camera to the scan (right, up), (n, 2)."""
        given = camera_mm @ self.turn.T / self.radius_mm
        straight = given @ self.affine[:, :2].T + self.affine[:, 2]
        places = straight
        for _ in range(_INVERSIONS):
            places = straight + (film_terms(self.model, given, places) @ self.terms).reshape(-1, 2)
        return np.asarray(places * self.radius_mm + self.center_mm)


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Interior orientation.

    Attributes
    ----------
    up_from_camera : (2, 3) affine transformation from camera mm to the scan's mm (right, up); the best approximation
        where a film model has further terms.
    chi_square, redundancy : including the pseudo-observations of affinity and film terms.
    linear_sigma : rms of the standard deviations of rotation (rad), scale, stretch and shear.
    film : transformation with a film model; None for an affine one.
    """

    up_from_camera: Array
    chi_square: float
    redundancy: int
    linear_sigma: float
    film: FilmFit | None = None


def fit_frame(camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array, model: str = "affine") -> FrameFit:
    """Fit the interior orientation to n >= 2 marks; raises ValueError for fewer.

    Parameters
    ----------
    camera_mm, up_mm : (n, 2) given places, and measured ones in the scan (right, up).
    sigma_mm : (n,) standard deviations.
    turn : (2, 2) rotation, and mirror if any, of the scan orientation; the similarity is estimated relative to it.
    model : film deformation model.
    """
    if len(camera_mm) < 2:
        raise ValueError(f"{len(camera_mm)} marks do not determine a frame; two or more do")
    given, film = camera_mm @ turn.T, None
    radius_mm, center_mm = float(np.hypot(*given.T).max()), up_mm.mean(axis=0)
    unit, measured = given / radius_mm, (up_mm - center_mm) / radius_mm
    terms = film_terms(model, unit, measured)
    if terms.shape[1]:
        solution, inverse, chi_square = _solve(unit, measured, sigma_mm / radius_mm, terms, _FREE)
        affine = np.column_stack([_linear(solution, np.eye(2)), solution[2:4]])
        film = FilmFit(model, turn, radius_mm, center_mm, affine, solution[6:])
        places = film.places_mm(camera_mm)
        design = np.column_stack([camera_mm, np.ones(len(camera_mm))])
        best = np.linalg.lstsq(design, places, rcond=None)[0].T if np.linalg.matrix_rank(design) == 3 else affine
        up_from_camera = np.asarray(best, dtype=np.float64)
    else:
        solution, inverse, chi_square = _solve(given, up_mm, sigma_mm, terms, AFFINITY_SIGMA)
        up_from_camera = np.column_stack([_linear(solution, turn), solution[2:4]])
    sigma = float(np.sqrt(np.sum(inverse[_LINEAR] ** 2, axis=1).mean()) / np.hypot(*solution[:2]))
    return FrameFit(up_from_camera, chi_square, 2 * len(camera_mm) - 4, sigma, film)


def _linear(solution: Array, turn: Array) -> Array:
    """(2, 2) matrix of rotation and scale, stretch and shear, after turn."""
    a, b, _, _, stretch, shear = solution[:6]
    return np.asarray(np.array([[a + stretch, -b + shear], [b + shear, a - stretch]]) @ turn)


def _solve(
    given: Array, measured: Array, sigma: Array, terms: Array, affinity_sigma: float
) -> tuple[Array, Array, float]:
    """Least squares with pseudo-observations: solution, pseudo-inverse of the design, chi-square."""
    x, y = given.T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate([np.stack([x, -y, one, none, x, y], axis=1), np.stack([y, x, none, one, -y, x], axis=1)])
    rows = np.hstack([rows, np.concatenate([terms[::2], terms[1::2]])])
    values, weight = measured.T.ravel(), np.tile(1 / sigma, 2)
    prior = np.zeros((2 + terms.shape[1], 6 + terms.shape[1]))
    prior[0, 4] = prior[1, 5] = 1 / affinity_sigma
    prior[2:, 6:] = np.eye(terms.shape[1]) / _FREE
    design = np.concatenate([rows * weight[:, None], prior])
    right = np.concatenate([values * weight, np.zeros(len(prior))])
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / size) / size[:, None]
    solution = inverse @ right
    return solution, inverse, float(np.sum((design @ solution - right) ** 2))
