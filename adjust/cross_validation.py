"""Cross-validation over object points: how well a model predicts the images of points that had no part in its fit."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.adjustment import Options, adjust
from adjust.errors import AdjustmentError
from adjust.intersection import intersect
from adjust.network import Approximations, Network, Observations
from adjust.projection import ImageModel, adjusted_image
from adjust.result import Adjustment

Array = NDArray[np.float64]

FOLDS = 5
FEWEST_KNOWN = 10  # known points below this number stay in every fold: they carry the datum
UM_PER_MM = 1000.0


@dataclass(frozen=True)
class CrossValidation:
    """Prediction errors of the rays (image points) of left-out points.

    rms_um: per axis, in the comparator. sigmas: the same in the standard deviations of the observations; 1 would be a
    perfect model, but for the errors of what predicts. rays: how many were predicted.
    """

    rms_um: float
    sigmas: float
    rays: int


def folds(network: Network, options: Options) -> tuple[frozenset[str], ...]:
    """The points that are left out together, every point in one fold.

    Points that distances or the datum name stay in all fits, and so do known points where they are few.
    """
    shown = Counter(
        point
        for point, kind in zip(network.observations.point, network.observations.kind, strict=True)
        if kind != "fiducial"
    )
    held = {name for distance in network.distances for name in (distance.start, distance.end)}
    held |= {name.rsplit(".", 1)[0] for name in options.datum_coordinates} | set(options.datum_points)
    known = {point.id for point in network.points if point.id in shown and _given(network, point.id).any()}
    if len(known) < FEWEST_KNOWN:
        held |= known
    free = sorted(set(shown) - held)
    return tuple(frozenset(free[i::FOLDS]) for i in range(FOLDS) if free[i::FOLDS])


def cross_validate(
    adjustment: Adjustment, left_out: Sequence[frozenset[str]], options: Options
) -> CrossValidation | None:
    """The prediction errors of an adjusted model over all folds; None where a fold has no solution or predicts nothing.

    Every fold is adjusted without its points, from the whole's values on. A point of which all coordinates are given is
    projected as it is given. Any other is intersected from every second of its rays and predicted in the others, and
    the other way round; at least two rays are needed.
    """
    network = adjustment.network
    errors = []
    for points in left_out:
        fitted = _fitted_without(adjustment, points, options)
        if fitted is None:
            return None
        errors += _errors(fitted, network, points)
    if not errors:
        return None
    error, covariance = np.array([e for e, _ in errors]), np.array([c for _, c in errors])
    normalised = (np.linalg.solve(covariance, error[..., None])[..., 0] * error).sum(axis=1)
    return CrossValidation(
        UM_PER_MM * float(np.sqrt((error**2).mean())), float(np.sqrt(normalised.mean() / 2)), len(error)
    )


def approximations_of(adjustment: Adjustment) -> Approximations:
    """The values of an adjustment as a start of another one."""
    values: dict[str, list[float]] = {}
    for name, value in zip(adjustment.names, adjustment.values.tolist(), strict=True):
        values.setdefault(name.rsplit(".", 1)[0], []).append(value)

    def of(kind: str) -> dict[str, Array]:
        return {owner[len(kind) :]: np.array(each) for owner, each in values.items() if owner.startswith(kind)}

    images = adjustment.network.images
    transformation = of("T.")
    return Approximations(
        interior={camera: each[:3] for camera, each in of("IO.").items()},
        exterior=of("EO."),
        transformation={image.name: transformation.get(image.name, np.empty(0)) for image in images},
        points=of("PT."),
        mirrored=adjustment.mirrored,
    )


def _fitted_without(adjustment: Adjustment, points: frozenset[str], options: Options) -> Adjustment | None:
    network = adjustment.network
    observations = network.observations
    kept = [
        row
        for row, (point, kind) in enumerate(zip(observations.point, observations.kind, strict=True))
        if kind == "fiducial" or point not in points
    ]
    reduced = replace(
        network,
        points=tuple(point for point in network.points if point.id not in points),
        observations=Observations(
            tuple(observations.image[row] for row in kept),
            tuple(observations.point[row] for row in kept),
            tuple(observations.kind[row] for row in kept),
            observations.xy_mm[kept],
            observations.covariance_mm2[kept],
        ),
    )
    try:
        fitted = adjust(reduced, approximations_of(adjustment), options)
    except AdjustmentError:
        return None
    return fitted if fitted.converged else None


def _errors(fitted: Adjustment, network: Network, points: frozenset[str]) -> list[tuple[Array, Array]]:
    """Predicted less observed comparator coordinates (2,) of every ray, and its covariance (2, 2)."""
    observations = network.observations
    rows: dict[str, list[int]] = {point: [] for point in points}
    for row, (point, kind) in enumerate(zip(observations.point, observations.kind, strict=True)):
        if kind != "fiducial" and point in points:
            rows[point].append(row)
    images = {observations.image[row] for each in rows.values() for row in each}
    models = {image: adjusted_image(fitted, image) for image in sorted(images)}
    errors = []
    for point in sorted(points):
        ordered = sorted(rows[point], key=lambda row: observations.image[row])
        for source, predicted in _halves(network, point, ordered):
            xyz = _located(network, models, point, source)
            if xyz is None:
                continue
            for row in predicted:
                xy_mm, visible = models[observations.image[row]].comparator_from_object(xyz[None])
                if visible[0]:
                    errors.append((xy_mm[0] - observations.xy_mm[row], observations.covariance_mm2[row]))
    return errors


def _halves(network: Network, point: str, rows: list[int]) -> list[tuple[list[int], list[int]]]:
    """What locates the point, and what is then predicted."""
    if _given(network, point).all():
        return [([], rows)]
    return [(a, b) for a, b in ((rows[::2], rows[1::2]), (rows[1::2], rows[::2])) if len(a) > 1]


def _located(network: Network, models: dict[str, ImageModel], point: str, rows: list[int]) -> Array | None:
    """The point as given, or from some of its rays."""
    given = network.point_by_id[point]
    priors = (given.X, given.Y, given.Z)
    known = np.array([
        prior.value if prior is not None and use else np.nan
        for prior, use in zip(priors, _given(network, point), strict=True)
    ])  # fmt: skip
    if not rows:
        return known
    observations = network.observations
    used = [models[observations.image[row]] for row in rows]
    directions = [_direction(model, observations.xy_mm[row]) for model, row in zip(used, rows, strict=True)]
    centers = np.array([model.station for model in used])
    found, _ = intersect(centers, np.array(directions), np.zeros(len(rows), dtype=np.intp), known[None])
    return found[0] if np.isfinite(found[0]).all() else None


def _direction(model: ImageModel, xy_mm: Array) -> Array:
    """The direction of a ray in the object space, from an observed comparator point (2,)."""
    ideal, _ = model.ideal_from_observed(model.camera_from_comparator(xy_mm[None]))
    return np.asarray(np.array([*(ideal[0] - model.interior[1:]), -model.interior[0]]) @ model.rotation)


def _given(network: Network, point: str) -> NDArray[np.bool_]:
    """(3,) which coordinates of a point are given, exactly or with a standard deviation."""
    each = network.point_by_id[point]
    return np.array([prior is not None and bool(np.isfinite(prior.sigma)) for prior in (each.X, each.Y, each.Z)])
