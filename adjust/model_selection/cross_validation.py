"""Cross-validation over object points: how well a model predicts the images of points that had no part in its fit."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.errors import AdjustmentError
from adjust.functional_model.projection import ImageModel
from adjust.initial_values.intersection import intersect
from adjust.problem.images import approximate_image, lifted
from adjust.problem.network import Approximations, Network
from adjust.problem.parameter import Kind, Parameter, object_coordinate
from adjust.problem.problem import number
from adjust.problem.reduction import Reduction
from adjust.solution.adjustment import Options, settle_datum
from adjust.solution.result import Adjustment
from adjust.solution.reweighting import run
from adjust.validation import validate

Owner = tuple[Kind, str, str]  # of a parameter: its kind, owner and id

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
        for point, on_film in zip(network.observations.point, network.observations.is_fiducial, strict=True)
        if not on_film
    )
    held = {name for distance in network.distances for name in (distance.start, distance.end)}
    held |= {object_coordinate(text).id for text in options.datum_coordinates} | set(options.datum_points)
    known = {point.id for point in network.points if point.id in shown and _given_axes(network, point.id).any()}
    if len(known) < FEWEST_KNOWN:
        held |= known
    free = sorted(set(shown) - held)
    return tuple(frozenset(free[i::FOLDS]) for i in range(FOLDS) if free[i::FOLDS])


def cross_validate(
    adjustment: Adjustment, left_out: Sequence[frozenset[str]], options: Options
) -> CrossValidation | None:
    """The prediction errors of an adjusted model over all folds; None where a fold has no solution or predicts nothing.

    Every fold is adjusted without its points, from the whole's values on. A point of which all coordinates are given is
    projected as it is given, that of a bent board from where the whole's bend puts it. Any other is intersected from
    every second of its rays and predicted in the others, and the other way round, where they locate it.
    """
    network = adjustment.network
    errors, rows = np.empty((0, 2)), np.empty(0, dtype=np.intp)
    for points in left_out:
        fitted = _refitted_models(adjustment, points, options)
        if fitted is None:
            return None
        found = _errors(fitted, adjustment, points)
        errors, rows = np.concatenate([errors, found[0]]), np.concatenate([rows, found[1]])
    if not len(rows):
        return None
    covariance = network.observations.covariance_mm2[rows]
    normalised = (np.linalg.solve(covariance, errors[..., None])[..., 0] * errors).sum(axis=1)
    rms_um = UM_PER_MM * float(np.sqrt((errors**2).mean()))
    return CrossValidation(rms_um, float(np.sqrt(normalised.mean() / 2)), len(rows))


def adjusted_values(adjustment: Adjustment) -> Approximations:
    """The values of an adjustment as a start of another one."""
    values = _values_by_owner(adjustment.parameters, adjustment.values)
    return _as_approximations(adjustment.network, values, adjustment.mirrored)


def _values_by_owner(parameters: Sequence[Parameter], values: Array) -> dict[Owner, Array]:
    """The values of every camera, image, point and so on."""
    collected: dict[Owner, list[float]] = {}
    for each, value in zip(parameters, values.tolist(), strict=True):
        collected.setdefault((each.kind, each.owner, each.id), []).append(value)
    return {owner: np.array(each) for owner, each in collected.items()}


def _as_approximations(network: Network, values: dict[Owner, Array], mirrored: frozenset[str]) -> Approximations:
    interior = {camera: each[:3] for (kind, camera, _), each in values.items() if kind == "interior"}
    return Approximations(
        interior=interior,
        exterior={image.name: values["exterior", image.frame, ""] for image in network.images},
        transformation={image.name: values.get(("film", image.name, ""), np.empty(0)) for image in network.images},
        points={id: each for (kind, _, id), each in values.items() if kind == "point"},
        mirrored=mirrored,
        joins={(frame, point): values["join", frame, point] for frame, point in network.joins},
    )


def _refitted_models(
    adjustment: Adjustment, points: frozenset[str], options: Options
) -> Mapping[str, ImageModel] | None:
    """The images as the other points determine them, without the tests that take longest; None where these do not."""
    network = adjustment.network
    observations = network.observations
    kept = [
        row
        for row, (point, on_film) in enumerate(zip(observations.point, observations.is_fiducial, strict=True))
        if on_film or point not in points
    ]
    reduced = replace(
        network,
        points=tuple(point for point in network.points if point.id not in points),
        observations=observations.only(np.array(kept, dtype=np.intp)),
    )
    if reduced.unoriented - network.unoriented:
        return None
    reduction = Reduction.to_centroid(reduced)
    start = reduction.approximations(adjusted_values(adjustment))
    try:
        validate(reduced)
        problem = number(reduction.network(reduced), start, options.method == "elements")
        last = run(settle_datum(problem, options), options)
    except AdjustmentError:
        return None
    if not last.converged:
        return None
    whole = reduction.unreduced_values(problem.unknowns, last.end.state.values, reduced)
    values = _values_by_owner(problem.unknowns.parameters, whole)
    fitted = _as_approximations(reduced, values, adjustment.mirrored)
    oriented = [image for image in reduced.images if image.name not in reduced.unoriented]
    return {
        image.name: replace(
            (model := approximate_image(reduced, fitted, image.name)),
            lens=model.lens.replaced_values(values["interior", image.camera, ""]),
            bend_parameters=values.get(("scanner", image.scanner, ""), np.empty(0)),
        )
        for image in oriented
    }


def _errors(models: Mapping[str, ImageModel], adjustment: Adjustment, points: frozenset[str]) -> tuple[Array, Array]:
    """Predicted less observed comparator coordinates (n, 2) of all rays that can be predicted, and their rows (n,)."""
    network = adjustment.network
    rays = _rays(adjustment, points)
    centers, directions = np.empty((len(rays.rows), 3)), np.empty((len(rays.rows), 3))
    for image, at in rays.rays_per_image(network).items():
        centers[at] = models[image].station
        directions[at] = _directions(models[image], network.observations.xy_mm[rays.rows[at]])
    unknown = np.asarray(np.isnan(rays.known).any(axis=1))
    given = ~unknown[rays.point]
    errors, rows = [], []
    for half in (False, True):
        source = ~given & (rays.odd == half)
        located = rays.known
        if source.any():
            found, _ = intersect(centers[source], directions[source], rays.point[source], rays.known)
            located = np.where(unknown[:, None], found, rays.known)
        there = np.asarray(np.isfinite(located).all(axis=1))
        predicted = ~source & ~(given & half) & there[rays.point]
        for image, at in rays.rays_per_image(network).items():
            chosen = at[predicted[at]]
            xy_mm, visible = models[image].comparator_from_object(located[rays.point[chosen]])
            errors.append((xy_mm - network.observations.xy_mm[rays.rows[chosen]])[visible])
            rows.append(rays.rows[chosen][visible])
    return np.concatenate(errors), np.concatenate(rows)


@dataclass(frozen=True)
class _Rays:
    """The rays (n,) of some points: their observations, the number of their point, whether second, fourth ... of it.

    known (p, 3): what is given of the points, nan where nothing is.
    """

    rows: Indices
    point: Indices
    odd: Mask
    known: Array

    def rays_per_image(self, network: Network) -> dict[str, Indices]:
        """The rays of every image."""
        images = np.array([network.observations.image[row] for row in self.rows])
        return {str(image): np.flatnonzero(images == image) for image in np.unique(images)}


def _rays(adjustment: Adjustment, points: frozenset[str]) -> _Rays:
    network, observations = adjustment.network, adjustment.network.observations
    ordered = sorted(
        (point, image, row)
        for row, (point, image, on_film) in enumerate(
            zip(observations.point, observations.image, observations.is_fiducial, strict=True)
        )
        if not on_film and point in points
    )
    names = sorted({point for point, _, _ in ordered})
    number = np.array([names.index(point) for point, _, _ in ordered], dtype=np.intp)
    first = np.searchsorted(number, number)
    return _Rays(
        rows=np.array([row for _, _, row in ordered], dtype=np.intp),
        point=number,
        odd=(np.arange(len(number)) - first) % 2 == 1,
        known=np.array([_known_coordinates(network, name) for name in names]).reshape(-1, 3)
        + lifted(adjustment, names),
    )


def _known_coordinates(network: Network, point: str) -> Array:
    """(3,) the coordinates that are given, nan where none is."""
    each = network.point_by_id[point]
    priors = zip((each.X, each.Y, each.Z), _given_axes(network, point), strict=True)
    return np.array([prior.value if prior is not None and given else np.nan for prior, given in priors])


def _directions(model: ImageModel, xy_mm: Array) -> Array:
    """The directions (n, 3) of rays in the object space, from observed comparator points (n, 2)."""
    ideal, _ = model.lens.ideal_from_observed(model.camera_from_comparator(xy_mm))
    in_camera = np.column_stack([ideal - model.lens.interior[1:], np.full(len(ideal), -model.lens.interior[0])])
    return np.asarray(in_camera @ model.rotation)


def _given_axes(network: Network, point: str) -> Mask:
    """(3,) which coordinates of a point are given, exactly or with a standard deviation."""
    each = network.point_by_id[point]
    return np.array([prior is not None and bool(np.isfinite(prior.sigma)) for prior in (each.X, each.Y, each.Z)])
