"""Model selection: compare film transformations, distortion families and scanner terms on the same observations.

Every candidate is adjusted with the same weights. Nested models are compared by the F-test, any two by Akaike's
criterion, and all by their prediction of points that were left out (`cross_validate`). The simplest model that no
richer one improves significantly is chosen.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import AdjustmentError
from adjust.initial_values.approximations import approximate
from adjust.linear_algebra.small_matrices import applied, inverse, product
from adjust.model_selection.candidates import (
    Bends,
    Candidate,
    CrossValidation,
    Model,
    Nested,
    given_model,
    lenses,
    nested_tests,
    reasons,
    remaining_bends,
    simplest_sufficient,
    transformations,
    verdict,
)
from adjust.model_selection.scanner_choice import choose_bends
from adjust.problem.network import Approximations, Network
from adjust.problem.parameter import description, object_coordinate
from adjust.quality.run import UNCHECKED
from adjust.quality.tested import NO_WEIGHT
from adjust.rank_defect.datum import held_as_known
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

FEWEST_FOLDS, MOST_FOLDS, RAYS_AT_ONCE = 5, 20, 300  # more folds than the fewest have about so many rays each
FEWEST_KNOWN = 10  # fewer known points than this stay in every fit: they define the datum
UM_PER_MM = 1000.0
ROUNDS = 3  # rounds of selecting distortion, scanner terms and transformation in turn

Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class Choice:
    """Result of a model selection: F-tests of neighbours, and sentences on the choice and the rejected candidates.

    chosen: None without a solution.
    """

    given: Model
    candidates: tuple[Candidate, ...]
    tests: tuple[Nested, ...]
    chosen: Candidate | None
    verdict: str
    reasons: tuple[str, ...]


def choose(
    own: Adjustment,
    options: Options | None = None,
    half_mm: Mapping[str, tuple[float, float]] | None = None,
    progress: Progress = lambda _, __: None,
) -> Choice:
    """Compare the models that a network allows.

    Parameters
    ----------
    own : the network adjusted with its own model. All candidates get the weights that robust estimation, data snooping
        and variance components gave its image points.
    options : optional; options of that adjustment.
    half_mm : optional; half the frame by camera, for the self-calibration sets, which are left out unless every camera
        has it.
    progress : called with the name of each model and the number of candidates done.
    """
    options = options or Options()
    half_mm = half_mm or {}
    given = given_model(own.network)
    fits = _Fits(weighted_network(own), options.plain, half_mm, progress, {given.transformation: own})
    chosen, untold = _chosen(fits, given, with_sets=all(camera.name in half_mm for camera in own.network.cameras))
    candidates = tuple(fits.done.values())
    sentences = (*reasons(candidates, chosen), *untold)
    return Choice(given, candidates, nested_tests(candidates), chosen, verdict(given, chosen), sentences)


def _chosen(fits: "_Fits", given: Model, with_sets: bool) -> tuple[Candidate | None, tuple[str, ...]]:
    """Select distortion, scanner terms and transformation in turn until none changes."""
    # Also returns remarks on scanner terms that are not estimable. The scanner terms come before the transformation,
    # since a richer transformation could absorb them.
    film, bends = given.transformation, Bends()
    chosen: Candidate | None = None
    untold: tuple[str, ...] = ()
    for _ in range(ROUNDS):
        chosen = fits.simplest(replace(each, bends=bends) for each in lenses(fits.network, film, with_sets))
        if chosen is None:
            break
        needed, untold = fits.needed_bends(replace(chosen.model, bends=()))
        possible = dict.fromkeys(((), needed, remaining_bends(film, given.bends)))
        bent = fits.simplest(replace(chosen.model, bends=each) for each in possible)
        chosen = bent and fits.simplest(
            replace(bent.model, transformation=each, bends=remaining_bends(each, bent.model.bends))
            for each in transformations(fits.network)
        )
        if chosen is None or (chosen.model.transformation, chosen.model.bends) == (film, bends):
            break
        film, bends = chosen.model.transformation, chosen.model.bends
    return chosen, untold


def weighted_network(own: Adjustment) -> Network:
    """Apply the final weights of an adjustment to the image points; those without weight are left out."""
    observations = own.network.observations
    weights = own.weights if len(own.weights) else np.ones(len(observations))
    factors = np.array([own.variance_factors.get(kind, 1.0) for kind in observations.kind])
    covariance_mm2 = observations.covariance_mm2 * (factors / weights)[:, None, None]
    kept = replace(observations, covariance_mm2=covariance_mm2).only(np.flatnonzero(weights > NO_WEIGHT))
    return replace(own.network, observations=kept)


@dataclass
class _Fits:
    """Candidates adjusted so far, and for each transformation an adjustment that supplies initial values."""

    network: Network
    options: Options
    half_mm: Mapping[str, tuple[float, float]]
    progress: Progress
    starts: dict[str, Adjustment]
    done: dict[Model, Candidate] = field(default_factory=dict)

    def candidate(self, model: Model) -> Candidate:
        if model not in self.done:
            self.progress(model.name, len(self.done))
            self.done[model] = self._candidate(model)
        return self.done[model]

    def simplest(self, models: Iterable[Model]) -> Candidate | None:
        return simplest_sufficient([self.candidate(model) for model in models])

    def needed_bends(self, model: Model) -> tuple[Bends, tuple[str, ...]]:
        """Select significant scanner terms for a model without any; also return remarks on terms not estimable."""
        near = self.starts[model.transformation]
        network = model.build_network(self.network, self.half_mm)
        if not any(image.scanner for image in network.images):
            return (), ()
        try:
            bent, remarks = choose_bends(network, lambda trial: adjust(trial, _start(model, near), self.options))
        except AdjustmentError as error:
            return (), (f"No bend of the scanner was estimated: {error}",)
        return given_model(bent).bends, remarks

    def _candidate(self, model: Model) -> Candidate:
        near = self.starts.get(model.transformation)
        try:
            result = self._from(model, None if near is None or not near.converged else near)
        except AdjustmentError as error:
            return Candidate(model, str(error))
        if result.singular:
            causes = " ".join(f"{description(each.parameters)}: {each.cause}" for each in result.singular)
            return Candidate(model, f"singular. {causes}")
        if not result.converged:
            return Candidate(model, f"no solution: {result.termination}")
        self.starts[model.transformation] = result
        return Candidate(
            model,
            "",
            result.conditions,
            result.unknowns,
            result.redundancy,
            result.vpv,
            result.sigma0,
            cross_validate(result, self.options),
            _correlated(result),
            result.warnings,
        )

    def _from(self, model: Model, near: Adjustment | None) -> Adjustment:
        """Adjust from the values of a similar model, or where that fails from the network's own approximations."""
        network = model.build_network(self.network, self.half_mm)
        if near is not None:
            try:
                result = adjust(network, _start(model, near), self.options)
            except AdjustmentError:
                result = None
            if result is not None and (result.converged or result.singular):
                return result
        return adjust(network, approximate(held_as_known(network, self.options.datum_coordinates)), self.options)


def _start(model: Model, near: Adjustment) -> Approximations:
    """Values of a similar model, with its distortion if that is of the same family."""
    same = near.network.cameras[0].distortion.family == model.family
    return near.approximations if same else replace(near.approximations, distortion={})


def folds(network: Network, options: Options) -> tuple[frozenset[str], ...]:
    """Divide the object points into folds that are left out together; of very many folds only the first are returned.

    Points in distances or in the datum stay in all fits, and so do known points if there are few.
    """
    held = {name for distance in network.distances for name in (distance.start, distance.end)}
    held |= {object_coordinate(text).id for text in options.datum_coordinates} | set(options.datum_points)
    given = network.coordinates(firm=True)
    known = {point for point in network.observed_points if not np.isnan(given[point]).all()}
    if len(known) < FEWEST_KNOWN:
        held |= known
    free = sorted(network.observed_points - held)
    count = max(FEWEST_FOLDS, int((~network.observations.is_fiducial).sum()) // RAYS_AT_ONCE)
    return tuple(frozenset(free[i::count]) for i in range(min(count, MOST_FOLDS)) if free[i::count])


def cross_validate(adjustment: Adjustment, options: Options) -> CrossValidation | None:
    """Compute the prediction errors of an adjusted model over all folds.

    Rays are predicted from the adjustment without the rays of their fold: of all points with given coordinates, and of
    every second ray of the other points, which the remaining rays must determine; then of the others. With v the
    residuals in unit weight of the rays left out and V their cofactor matrix, the prediction errors are V^-1 v, as in
    data snooping. Returns None where a fold determines something that the others do not, or nothing is predicted.
    """
    run, right, errors, errors_mm = adjustment.run, adjustment.run.end.rows.right, list[Array](), list[Array]()
    back = product(inverse(run.end.by_observation), run.end.rows.root)
    for rows in left_out_rows(adjustment.network, options):
        functions = run.unit_functions[(2 * rows[:, None] + np.arange(2)).ravel()]
        cofactor = np.eye(2 * len(rows)) - run.factor.function_cofactor(functions)
        try:
            np.linalg.cholesky(cofactor - UNCHECKED * np.eye(len(cofactor)))
        except np.linalg.LinAlgError:
            return None
        errors.append(np.asarray(np.linalg.solve(cofactor, right[rows].ravel()), dtype=np.float64).reshape(-1, 2))
        errors_mm.append(applied(back[rows], errors[-1]))
    if not errors:
        return None
    rms, rms_mm = (float(np.sqrt(np.square(np.concatenate(each)).mean())) for each in (errors, errors_mm))
    return CrossValidation(UM_PER_MM * rms_mm, rms, sum(map(len, errors)))


def left_out_rows(network: Network, options: Options) -> Iterator[Indices]:
    """Rows of the rays that are left out together and predicted, see `cross_validate`."""
    names, number = network.observations.numbered_points
    given = network.coordinates(firm=True)
    for points in folds(network, options):
        rows = _rows(network, points)
        point = number[rows]
        is_known = ~np.array([np.isnan(given[names[i]]).any() for i in point], dtype=bool)
        _, first, which = np.unique(point, return_index=True, return_inverse=True)
        second = (np.arange(len(point)) - first[which]) % 2 == 1  # second, fourth, ... ray of its point
        for half in (False, True):
            others = np.bincount(which[second != half], minlength=len(first))[which]
            chosen = rows[np.where(is_known, not half, (second == half) & (others >= 2))]
            if len(chosen):
                yield chosen


def _rows(network: Network, points: frozenset[str]) -> Indices:
    """Rows of some object points, sorted by point and image."""
    observations = network.observations
    named = np.flatnonzero(np.isin(observations.point, list(points)) & ~observations.is_fiducial)
    return np.array(sorted(named, key=lambda row: (observations.point[row], observations.image[row])), dtype=np.intp)


def _correlated(result: Adjustment) -> tuple[tuple[str, str, float], ...]:
    """Pairs of highly correlated interior parameters of a camera, highest first."""
    several = len(result.network.cameras) > 1
    pairs = []
    for each in result.correlations:
        if all(parameter.kind == "interior" for parameter in each.parameters):
            first, second = (one.label if several else one.quantity for one in each.parameters)
            pairs.append((first, second, each.rho))
    return tuple(pairs)
