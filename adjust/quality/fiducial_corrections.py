"""Corrections to given fiducial coordinates where films alone hold the marks' figure.

Fiducials alone tell the figure up to what every film transformation takes up: a shift, a turn and a scale, of affine
films affinity and shear besides. What is estimable are the residuals of the film model's own transformation to the
given coordinates. Distances are estimable of congruent films alone.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.transformation import Film, film_kind, film_parameter_names
from adjust.initial_values.fiducial_fit import fit_transformation

KEEPS_DISTANCES = ("none", "congruent")
STEPS = 10  # of Gauss and Newton; formulas that are linear in their parameters take one
STILL_MM = 1e-9


@dataclass(frozen=True, eq=False)
class Corrections:
    """What is left of a transformation to the given coordinates, of the kind that the films have in common.

    corrections_mm (n, 2): estimated less given after it. by_unknowns (2n, 2n + k): their derivatives by the estimated
    places and by the k parameters of the first film; k is 0 where the transformation does not begin in its comparator.
    """

    transformation: str
    corrections_mm: Array
    by_unknowns: Array


def common_transformation(kinds: Collection[str]) -> str:
    """What films of all these kinds take up: the transformation that each of them contains."""
    for least in (*KEEPS_DISTANCES, *(kinds if len(set(kinds)) == 1 else ())):
        if least in kinds:
            return least
    conformal = [kind for kind in kinds if kind.startswith(("similarity", "conformal"))]
    if conformal:
        return "similarity" if len(conformal) < len(kinds) else min(conformal, key=_parameters)
    polynomial = [kind for kind in kinds if kind.startswith("polynomial")]
    return min(polynomial, key=_parameters) if len(polynomial) == len(kinds) else "affine"


def _parameters(kind: str) -> int:
    return len(film_parameter_names(kind))


def corrections_to_given(films: Sequence[Film], places_mm: Array, given_mm: Array) -> Corrections | None:
    """Fit what the films have in common to the given coordinates; None where it takes up all that the marks tell.

    places_mm, given_mm (n, 2): of the same marks, estimated and given. The transformation goes from the comparator of
    the first film, if that is of the common kind: only there is the figure what such a film makes of it.

    With x the places in the comparator, T the film with the design matrix D, and T* the transformation with the design
    matrix G that fits the given places best, corrections are T*(x) - given. They change by (I - G (G'G)^-1 G') T*' dx,
    where dx = T'^-1 (dX - D dp) for changes dX of the places and dp of the film: what moves both alike changes nothing.
    """
    common = common_transformation([film.transformation for film in films])
    if 2 * len(places_mm) <= _parameters(common):
        return None
    count = len(places_mm)
    source, by_unknowns = places_mm, np.eye(2 * count)
    if films[0].transformation == common:
        source, regular = films[0].comparator_from_camera(places_mm)
        if not regular.all():
            return None
        by_unknowns = _comparator_by_unknowns(films[0], source)
    parameters, mirrored = fit_transformation(common, source, places_mm)  # which agree, as marks hardly do
    kind = film_kind(common, mirrored)
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
    return Corrections(common, kind.apply(parameters, source) - given_mm, by_source @ by_unknowns)


def _comparator_by_unknowns(film: Film, xy_mm: Array) -> Array:
    """The derivatives (2n, 2n + k) of comparator coordinates by the camera's and by the film's parameters."""
    kind, half = film_kind(film.transformation, film.mirrored), np.array(0.5 * np.ptp(xy_mm, axis=0).max())
    center = xy_mm.mean(axis=0)
    by_film = kind.design(film.parameters, xy_mm, center, half).reshape(2 * len(xy_mm), -1)
    by_film = by_film @ np.linalg.inv(kind.centred_jacobian(film.parameters, center, half))
    back = _block_product(np.eye(2 * len(xy_mm)), np.asarray(np.linalg.inv(film.gradient(xy_mm)), dtype=np.float64))
    return np.hstack([back, -back @ by_film])


def _block_product(matrix: Array, by_place: Array) -> Array:
    """A matrix (m, 2n) times that with the blocks (n, 2, 2) on its diagonal."""
    by_pairs = matrix.reshape(len(matrix), -1, 2)
    return np.asarray(np.einsum("inj,njk->ink", by_pairs, by_place).reshape(len(matrix), -1))
