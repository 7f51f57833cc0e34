"""Corrections to given fiducial coordinates where only films determine the marks.

Fiducials alone determine the marks up to the film model: shift, rotation and scale, for affine films also affinity and
shear. Estimable are the residuals after the film model's own transformation to the given coordinates. Distances are
estimable only for congruent films.
"""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.transformation import Film, film_kind, fit_transformation

KEEPS_DISTANCES = ("none", "congruent")
STEPS = 10  # Gauss-Newton steps at most; models that are linear in their parameters need one
STILL_MM = 1e-9


@dataclass(frozen=True, eq=False)
class Corrections:
    """Residuals after the films' transformation to the given coordinates.

    corrections_mm (n, 2): estimated minus given, after it. by_unknowns (2n, 2n + k): derivatives by the estimated
    places and the k parameters of the film.
    """

    transformation: str
    corrections_mm: Array
    by_unknowns: Array


def corrections_to_given(film: Film, places_mm: Array, given_mm: Array) -> Corrections | None:
    """Fit the transformation of the films to the given coordinates; None if it has no redundancy.

    Parameters
    ----------
    film : of one image; all of a camera are of its kind.
    places_mm, given_mm : (n, 2) estimated and given places of the same marks.

    Notes
    -----
    The transformation starts from the comparator of the film. With x the places there, T the film with the design
    matrix D, and T* the transformation with the design matrix G that fits the given places best, corrections are
    T*(x) - given. They change by (I - G (G'G)^-1 G') T*' dx, where dx = T'^-1 (dX - D dp) for changes dX of the places
    and dp of the film.
    """
    if 2 * len(places_mm) <= len(film.parameters):
        return None
    count = len(places_mm)
    source, regular = film.comparator_from_camera(places_mm)
    if not regular.all():
        return None
    back = _block_product(np.eye(2 * count), np.asarray(np.linalg.inv(film.gradient(source)), dtype=np.float64))
    by_unknowns = np.hstack([back, -back @ film.design(source).reshape(2 * count, -1)])
    parameters, mirrored = fit_transformation(film.transformation, source, places_mm)  # initial values
    kind = film_kind(film.transformation, mirrored)
    center, half = source.mean(axis=0), np.array(0.5 * np.ptp(source, axis=0).max())
    for _ in range(STEPS):
        design = kind.design(parameters, source, center, half).reshape(2 * count, -1)
        inverse = np.linalg.pinv(design)
        step = inverse @ (given_mm - kind.apply(parameters, source)).ravel()
        parameters = np.asarray(parameters + kind.centred_jacobian(parameters, center, half) @ step, dtype=np.float64)
        if np.abs(design @ step).max() < STILL_MM:
            break
    projector = np.eye(len(design)) - design @ inverse
    by_source = _block_product(projector, kind.gradient(parameters, source))
    return Corrections(film.transformation, kind.apply(parameters, source) - given_mm, by_source @ by_unknowns)


def _block_product(matrix: Array, by_place: Array) -> Array:
    """Product of a matrix (m, 2n) and a block-diagonal one with blocks (n, 2, 2)."""
    by_pairs = matrix.reshape(len(matrix), -1, 2)
    return np.asarray(np.einsum("inj,njk->ink", by_pairs, by_place).reshape(len(matrix), -1))
