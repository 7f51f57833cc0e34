"""Cross-validation over object points: prediction errors of the images of points that were left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.errors import AdjustmentError
from adjust.functional_model.projection import ImageModel
from adjust.initial_values.pose import intersect
from adjust.problem.estimates import adjusted_image, lifted
from adjust.problem.network import Network
from adjust.problem.parameter import object_coordinate
from adjust.problem.problem import number
from adjust.problem.unknowns import Reduction
from adjust.solution.adjustment import Options, settle_datum
from adjust.solution.result import Adjustment
from adjust.solution.reweighting import run
from adjust.validation import validate

FOLDS = 5
FEWEST_KNOWN = 10  # fewer known points than this stay in every fit: they define the datum
UM_PER_MM = 1000.0


@dataclass(frozen=True)
class CrossValidation:
    """Prediction errors of the rays (image points) of left-out points."""

    rms_um: float  # rms per axis, in the comparator
    # the same in standard deviations of the observations; 1 for a perfect model, apart from the errors of the
    # prediction itself
    sigmas: float
    rays: int  # number of predicted rays


def folds(network: Network, options: Options) -> tuple[frozenset[str], ...]:
    """Divide the object points into folds that are left out together.

    Points in distances or in the datum stay in all fits, and so do known points if there are few.
    """
    held = {name for distance in network.distances for name in (distance.start, distance.end)}
    held |= {object_coordinate(text).id for text in options.datum_coordinates} | set(options.datum_points)
    given = network.coordinates(firm=True)
    known = {point for point in network.observed_points if not np.isnan(given[point]).all()}
    if len(known) < FEWEST_KNOWN:
        held |= known
    free = sorted(network.observed_points - held)
    return tuple(frozenset(free[i::FOLDS]) for i in range(FOLDS) if free[i::FOLDS])


def cross_validate(
    adjustment: Adjustment, left_out: Sequence[frozenset[str]], options: Options
) -> CrossValidation | None:
    """Compute the prediction errors of an adjusted model over all folds.

    Returns None where a fold has no solution or there is no prediction. Every fold is adjusted without its points,
    starting from the values of the whole adjustment. A point with all coordinates given is projected from these; on a
    bent board it is displaced by the bend of the whole adjustment. Any other point is intersected from every second of
    its rays and predicted in the others, and vice versa, where the rays determine it.
    """
    errors, rows = np.empty((0, 2)), np.empty(0, dtype=np.intp)
    for points in left_out:
        fitted = _refitted_models(adjustment, points, options)
        if fitted is None:
            return None
        found = _errors(fitted, adjustment, points)
        errors, rows = np.concatenate([errors, found[0]]), np.concatenate([rows, found[1]])
    if not len(rows):
        return None
    covariance = adjustment.network.observations.covariance_mm2[rows]
    normalised = (np.linalg.solve(covariance, errors[..., None])[..., 0] * errors).sum(axis=1)
    rms_um = UM_PER_MM * float(np.sqrt((errors**2).mean()))
    return CrossValidation(rms_um, float(np.sqrt(normalised.mean() / 2)), len(rows))


def _refitted_models(
    adjustment: Adjustment, points: frozenset[str], options: Options
) -> Mapping[str, ImageModel] | None:
    """Adjust without some points, omitting the slow tests; returns the image models, None without a solution."""
    network = adjustment.network
    reduced = replace(
        network,
        points=tuple(point for point in network.points if point.id not in points),
        observations=network.observations.only(
            np.setdiff1d(np.arange(len(network.observations)), _rows(network, points))
        ),
    )
    if reduced.unoriented - network.unoriented:
        return None
    reduction = Reduction.to_centroid(reduced)
    start = reduction.approximations(adjustment.approximations)
    try:
        validate(reduced)
        problem = number(reduction.network(reduced), start, options.method == "elements")
        last = run(settle_datum(problem, options), options)
    except AdjustmentError:
        return None
    if not last.converged:
        return None
    values = reduction.unreduced_values(problem.unknowns, last.end.state.values, reduced)
    fitted = replace(adjustment, network=reduced, parameters=problem.unknowns.parameters, values=values)
    oriented = [image.name for image in reduced.images if image.name not in reduced.unoriented]
    return {name: adjusted_image(fitted, name) for name in oriented}


def _rows(network: Network, points: frozenset[str]) -> Indices:
    """Rows of some object points, sorted by point and image."""
    observations = network.observations
    named = np.flatnonzero(np.isin(observations.point, list(points)) & ~observations.is_fiducial)
    return np.array(sorted(named, key=lambda row: (observations.point[row], observations.image[row])), dtype=np.intp)


def _errors(models: Mapping[str, ImageModel], adjustment: Adjustment, points: frozenset[str]) -> tuple[Array, Indices]:
    """Predicted minus observed comparator coordinates (n, 2) of all predictable rays, and their rows (n,)."""
    network, observations = adjustment.network, adjustment.network.observations
    rows = _rows(network, points)
    names, point = np.unique(np.array(observations.point)[rows], return_inverse=True)
    given = network.coordinates(firm=True)
    known = np.array([given[name] for name in names]).reshape(-1, 3) + lifted(adjustment, names.tolist())
    second = (np.arange(len(point)) - np.searchsorted(point, point)) % 2 == 1  # second, fourth, ... ray of its point
    images = np.array(observations.image)[rows]
    rays_of = {str(image): np.flatnonzero(images == image) for image in np.unique(images)}
    centers, directions = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    for image, at in rays_of.items():
        centers[at], directions[at] = models[image].station, _directions(models[image], observations.xy_mm[rows[at]])
    unknown: Mask = np.asarray(np.isnan(known).any(axis=1))
    errors, predicted_rows = [], []
    for half in (False, True):
        source = unknown[point] & (second == half)
        located = known
        if source.any():
            found, _ = intersect(centers[source], directions[source], point[source], known)
            located = np.where(unknown[:, None], found, known)
        predicted = ~source & (unknown[point] | (not half)) & np.isfinite(located[point]).all(axis=1)
        for image, at in rays_of.items():
            chosen = at[predicted[at]]
            xy_mm, visible = models[image].comparator_from_object(located[point[chosen]])
            errors.append((xy_mm - observations.xy_mm[rows[chosen]])[visible])
            predicted_rows.append(rows[chosen][visible])
    return np.concatenate(errors), np.concatenate(predicted_rows)


def _directions(model: ImageModel, xy_mm: Array) -> Array:
    """(n, 3) directions of rays in object space, from observed comparator points (n, 2)."""
    ideal, _ = model.lens.ideal_from_observed(model.camera_from_comparator(xy_mm))
    in_camera = np.column_stack([ideal - model.lens.interior[1:], np.full(len(ideal), -model.lens.interior[0])])
    return np.asarray(in_camera @ model.rotation)
