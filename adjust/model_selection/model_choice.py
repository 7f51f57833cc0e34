"""Model selection: compare film transformations, distortion families and scanner terms on the same observations.

Every candidate is adjusted with the same weights. Nested models are compared by the F-test, any two by Akaike's
criterion, and all by their prediction of points that were left out (`cross_validate`). The simplest model that no
richer one improves significantly is chosen.

    F = ((v'Pv_s - v'Pv_r) / (u_r - u_s)) / (v'Pv_r / r_r)  ~  F(u_r - u_s, r_r)
    AIC = v'Pv + 2 u                                            for known variances
    AICc = n ln(v'Pv / n) + 2 K + 2 K (K + 1) / (n - K - 1)     K = u + 1, variance factor estimated

n counts the observations with the priors, u the unknowns. Sources: K. R. Koch, Parameter estimation and hypothesis
testing in linear models, 1999, chapter 4.2; K. P. Burnham and D. R. Anderson, Model selection and multimodel inference,
2002, chapter 2.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np
from scipy.special import chdtri

from adjust.array_types import Array, Indices
from adjust.errors import AdjustmentError
from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import is_left
from adjust.functional_model.transformation import marks_needed
from adjust.initial_values.approximations import approximate
from adjust.linear_algebra.small_matrices import applied, inverse, product
from adjust.model_selection.scanner_choice import choose_bends, network_with_terms
from adjust.problem.network import Approximations, Network, Transformation
from adjust.problem.observations import Calibration
from adjust.problem.parameter import Parameter, description, object_coordinate
from adjust.quality.critical_values import NO_WEIGHT
from adjust.quality.run import UNCHECKED
from adjust.quality.significance import LEVEL, f_probability
from adjust.rank_defect.datum import held_as_known
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

# Simpler transformations that each transformation contains, simplest first.
TRANSFORMATIONS: Mapping[Transformation, tuple[Transformation, ...]] = {
    "congruent": (),
    "similarity": ("congruent",),
    "affine": ("congruent", "similarity"),
    "conformal(2)": ("congruent", "similarity"),
    "projective": ("congruent", "similarity", "affine"),
    "bilinear": ("congruent", "similarity", "affine"),
    "polynomial(2)": ("congruent", "similarity", "affine", "conformal(2)", "bilinear"),
}

Bends = tuple[tuple[str, tuple[str, ...]], ...]  # (name, terms) of every scanner with terms

SETS = {"ebner": ("b1", "b2"), "legendre(3)": ("a10", "a01")}  # their parameters of affinity and shear
DECISIVE = 10.0  # difference of AICc above which the worse model has essentially no support (Burnham and Anderson)
FEWEST_FOLDS, MOST_FOLDS, RAYS_AT_ONCE = 5, 20, 300  # more folds than the fewest have about so many rays each
FEWEST_KNOWN = 10  # fewer known points than this stay in every fit: they define the datum
ROUNDS = 3  # rounds of selecting distortion, scanner terms and transformation in turn

RULE = (
    "From few unknowns to many, a richer model is taken only where it fits significantly better (F-test at 1 %, or an "
    f"AICc lower by more than {DECISIVE:g}) and predicts points left out better."
)
TILTED = "Projective is what film makes that lay at an angle to scanner or camera, bilinear has no such cause"

Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class Model:
    """Model of a network."""

    transformation: Transformation  # of all images that have one
    # family, parameters: distortion family and estimated parameters of every camera
    family: str = "none"
    parameters: tuple[str, ...] = ()
    bends: Bends = ()  # scanner terms

    @property
    def name(self) -> str:
        """Description: "affine, torlegard k3 k5"; the parameters of a set are not listed."""
        lens = "no distortion" if self.family == "none" else self.family
        shown = () if self.family in SETS else self.parameters
        film = () if self.transformation == "none" else (f"{self.transformation},",)
        bends = (f", bend of scanner {scanner}: {' '.join(terms)}" for scanner, terms in self.bends)
        return " ".join((*film, lens, *shown)) + "".join(bends)

    def contains(self, other: "Model") -> bool:
        """Whether the other model is a special case of this one with some parameters 0."""
        films = (self.transformation, *TRANSFORMATIONS.get(self.transformation, ()))
        same = other.family in (self.family, "none") and set(other.parameters) <= set(self.parameters)
        bends = dict(self.bends)
        same = same and all(set(terms) <= set(bends.get(scanner, ())) for scanner, terms in other.bends)
        return other != self and other.transformation in films and same

    def build_network(self, network: Network, half_mm: Mapping[str, tuple[float, float]]) -> Network:
        """Build the network with this model, its parameters free."""
        cameras = []
        for camera in network.cameras:
            given = camera.distortion
            distortion = replace(
                given,
                family=self.family,
                parameters={name: Prior(0.0, np.inf) for name in self.parameters},
                half_mm=given.half_mm if all(given.half_mm) else half_mm.get(camera.name, given.half_mm),
            )
            cameras.append(replace(camera, distortion=distortion))
        images = tuple(
            image if image.transformation == "none" else replace(image, transformation=self.transformation)
            for image in network.images
        )
        # Earlier calibrations go without the distortion, since it differs between candidates.
        dropped = {
            Parameter.interior(each.name, name) for each in network.cameras for name in each.distortion.parameters
        }
        calibrations = []
        for each in network.calibrations:
            kept = [i for i, parameter in enumerate(each.parameters) if parameter not in dropped]
            covariance = each.covariance[np.ix_(kept, kept)]
            calibrations.append(Calibration(tuple(each.parameters[i] for i in kept), each.values[kept], covariance))
        changed = replace(network, cameras=tuple(cameras), images=images, calibrations=tuple(calibrations))
        return network_with_terms(changed, dict(self.bends))


@dataclass(frozen=True)
class CrossValidation:
    """Prediction errors of the rays (image points) of left-out points."""

    rms_um: float  # rms per axis, in the comparator
    # the same in standard deviations of the observations; 1 for a perfect model, apart from the errors of the
    # prediction itself
    sigmas: float
    rays: int  # number of predicted rays


@dataclass(frozen=True)
class Candidate:
    """Adjusted model."""

    model: Model  # the model
    problem: str = ""  # why it has no solution; empty where it has one
    # observations, unknowns, redundancy: counts
    observations: int = 0
    unknowns: int = 0
    redundancy: int = 0
    # vpv, sigma0: of the adjustment
    vpv: float = 0.0
    sigma0: float = 0.0
    cross_validation: CrossValidation | None = None  # prediction errors
    # pairs of highly correlated interior parameters, with their correlation
    correlated: tuple[tuple[str, str, float], ...] = ()
    warnings: tuple[str, ...] = ()  # of the adjustment

    @property
    def aic(self) -> float:
        return self.vpv + 2.0 * self.unknowns

    @property
    def aicc(self) -> float:
        """AICc; inf with too few observations."""
        k, n = self.unknowns + 1, self.observations
        if n - k - 1 <= 0:
            return np.inf
        return float(n * np.log(max(self.vpv, np.finfo(float).tiny) / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1))


@dataclass(frozen=True)
class Nested:
    """F-test of a model against a richer one that contains it."""

    simpler: Model
    richer: Model
    f: float
    degrees: tuple[int, int]
    p: float


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
    with_sets = all(camera.name in half_mm for camera in own.network.cameras)
    # Distortion, scanner terms and transformation are selected in turn until none changes. The scanner terms come
    # before the transformation, since a richer transformation could absorb them.
    film, bends, bend_remarks = given.transformation, Bends(), tuple[str, ...]()
    for _ in range(ROUNDS):
        chosen = fits.simplest(replace(each, bends=bends) for each in lenses(fits.network, film, with_sets))
        if chosen is None:
            break
        needed, bend_remarks = fits.needed_bends(replace(chosen.model, bends=()))
        possible = dict.fromkeys(((), needed, remaining_bends(film, given.bends)))
        bent = fits.simplest(replace(chosen.model, bends=each) for each in possible)
        chosen = bent and fits.simplest(
            replace(bent.model, transformation=each, bends=remaining_bends(each, bent.model.bends))
            for each in transformations(fits.network)
        )
        if chosen is None or (chosen.model.transformation, chosen.model.bends) == (film, bends):
            break
        film, bends = chosen.model.transformation, chosen.model.bends
    candidates = tuple(fits.done.values())
    sentences = (*reasons(candidates, chosen), *bend_remarks)
    return Choice(given, candidates, nested_tests(candidates), chosen, verdict(given, chosen), sentences)


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
        try:
            result = self._adjust(model)
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
            _high_correlations(result),
            result.warnings,
        )

    def _adjust(self, model: Model) -> Adjustment:
        """Adjust from the values of a similar model, or where that fails from the network's own approximations."""
        network, near = model.build_network(self.network, self.half_mm), self.starts.get(model.transformation)
        if near is not None and near.converged:
            with suppress(AdjustmentError):
                result = adjust(network, _start(model, near), self.options)
                if result.converged or result.singular:
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
    observations, given = network.observations, network.coordinates(firm=True)
    names, number = observations.numbered_points
    for points in folds(network, options):
        named = np.flatnonzero(np.isin(observations.point, list(points)) & ~observations.is_fiducial)
        in_order = sorted(named, key=lambda row: (observations.point[row], observations.image[row]))
        rows = np.array(in_order, dtype=np.intp)
        point = number[rows]
        is_known = ~np.array([np.isnan(given[names[i]]).any() for i in point], dtype=bool)
        _, first, which = np.unique(point, return_index=True, return_inverse=True)
        second = (np.arange(len(point)) - first[which]) % 2 == 1  # second, fourth, ... ray of its point
        for half in (False, True):
            others = np.bincount(which[second != half], minlength=len(first))[which]
            chosen = rows[np.where(is_known, not half, (second == half) & (others >= 2))]
            if len(chosen):
                yield chosen


def _high_correlations(result: Adjustment) -> tuple[tuple[str, str, float], ...]:
    """Pairs of highly correlated interior parameters of a camera, highest first."""
    several = len(result.network.cameras) > 1
    pairs = []
    for each in result.correlations:
        if all(parameter.kind == "interior" for parameter in each.parameters):
            first, second = (one.label if several else one.quantity for one in each.parameters)
            pairs.append((first, second, each.rho))
    return tuple(pairs)


def given_model(network: Network) -> Model:
    """Model of a network: distortion of the first camera, film transformation of the images, scanner terms."""
    films = [image.transformation for image in network.images if image.transformation != "none"]
    distortion = network.cameras[0].distortion
    estimated = [name for name, prior in distortion.parameters.items() if prior.sigma > 0.0]
    names = tuple(name for name in parameter_names(distortion.family) if name in estimated)
    # in one order, whichever the user gives, so that equal models compare as such
    bends = tuple((scanner.name, tuple(sorted(scanner.terms))) for scanner in network.scanners if scanner.terms)
    return Model(films[0] if films else "none", distortion.family if names else "none", names, bends)


def remaining_bends(film: Transformation, bends: Bends) -> Bends:
    """Scanner terms that a film transformation does not absorb."""
    left = ((scanner, tuple(term for term in terms if is_left(film, term))) for scanner, terms in bends)
    return tuple((scanner, terms) for scanner, terms in left if terms)


def transformations(network: Network) -> tuple[Transformation, ...]:
    """Film transformations for which every image has enough fiducial marks; "none" for images without films."""
    filmed = [i for i, image in enumerate(network.images) if image.transformation != "none"]
    if not filmed:
        return ("none",)
    marks = network.image_numbers[network.observations.has_kind("fiducial")]
    fewest = np.bincount(marks, minlength=len(network.images))[filmed].min()
    return tuple(kind for kind in TRANSFORMATIONS if marks_needed(kind) <= fewest)


def lenses(network: Network, transformation: Transformation, with_sets: bool) -> tuple[Model, ...]:
    """Candidate lens models: no distortion, the ladder of the camera's family (else Torlegård's), the sets.

    Each rung is also tried with b1 where no film transformation absorbs the scale difference of x and y. The network's
    own model is added if missing. Without object points, a lens cannot be estimated: the only candidate is no
    distortion.
    """
    if len(network.idle_cameras) == len(network.cameras):
        return (Model(transformation),)
    own_family = network.cameras[0].distortion.family
    ladder = own_family if family(own_family).ladder else "torlegard"
    rungs = [tuple(names.split()) for names in family(ladder).ladder]
    has_affinity = "b1" in parameter_names(ladder) and not any("b1" in rung for rung in rungs)  # b1 may be another term
    models = [Model(transformation)]
    for rung in rungs:
        models.append(Model(transformation, ladder, rung))
        if transformation == "none" and has_affinity:
            models.append(Model(transformation, ladder, (*rung, "b1")))
    if with_sets:
        for name, affinity in SETS.items():
            films = (transformation, *TRANSFORMATIONS.get(transformation, ()))
            taken = affinity if "affine" in films else ()  # absorbed by the film transformation
            models.append(Model(transformation, name, tuple(p for p in parameter_names(name) if p not in taken)))
    own = replace(given_model(network), transformation=transformation, bends=())
    return tuple(models if own in models else [*models, own])


def simplest_sufficient(candidates: Sequence[Candidate]) -> Candidate | None:
    """Select the simplest candidate that no richer one improves significantly; None without a solution.

    Of transformations with equally many unknowns, a later one in `TRANSFORMATIONS` has to be significantly better.
    """
    chosen, rank = None, {kind: number for number, kind in enumerate(TRANSFORMATIONS)}
    solved = [each for each in candidates if not each.problem]
    for candidate in sorted(solved, key=lambda one: (one.unknowns, rank.get(one.model.transformation, 0), one.vpv)):
        if chosen is None or _is_better(candidate, chosen):
            chosen = candidate
    return chosen


def _is_better(richer: Candidate, simpler: Candidate) -> bool:
    """Whether a model is significantly better than one with no more unknowns, and also predicts better."""
    a, b = richer.cross_validation, simpler.cross_validation
    if a is not None and b is not None and a.sigmas >= b.sigmas:
        return False
    if a is None and b is not None:
        return False
    if richer.model.contains(simpler.model):
        return f_test(simpler, richer).p < LEVEL
    return simpler.aicc - richer.aicc > DECISIVE


def f_test(simpler: Candidate, richer: Candidate) -> Nested:
    """Test two nested models by the F-test."""
    more, redundancy = richer.unknowns - simpler.unknowns, richer.redundancy
    variance = richer.vpv / redundancy if redundancy > 0 else 1.0
    f = max(simpler.vpv - richer.vpv, 0.0) / more / variance
    return Nested(simpler.model, richer.model, f, (more, redundancy), f_probability(f, more, redundancy))


def nested_tests(candidates: Sequence[Candidate]) -> tuple[Nested, ...]:
    """Test all neighbouring pairs: one contains the other, with no candidate between them."""
    solved = [each for each in candidates if not each.problem]
    return tuple(
        f_test(simpler, richer)
        for richer, simpler in permutations(solved, 2)
        if richer.model.contains(simpler.model)
        and richer.unknowns > simpler.unknowns
        and not any(richer.model.contains(each.model) and each.model.contains(simpler.model) for each in solved)
    )


def verdict(given: Model, chosen: Candidate | None) -> str:
    if chosen is None:
        return "No model has a solution."
    text = f"Selected: {chosen.model.name}{', the given model' if chosen.model == given else ''}."
    if chosen.redundancy <= 0:
        return text
    low, high = (float(np.sqrt(chdtri(chosen.redundancy, above) / chosen.redundancy)) for above in (0.995, 0.005))
    if chosen.sigma0 > high:
        text += (
            f" Its sigma0 of {chosen.sigma0:.3f} is above {high:.3f}, which the given standard deviations allow: they "
            "are too small, or no candidate is right."
        )
    elif chosen.sigma0 < low:
        text += f" Its sigma0 of {chosen.sigma0:.3f} is below {low:.3f}: the given standard deviations are too large."
    return text


def reasons(candidates: Sequence[Candidate], chosen: Candidate | None) -> tuple[str, ...]:
    """State the rule, and why every candidate that differs from the chosen one in one respect only was not chosen.

    Respects are distortion, transformation and scanner terms.
    """
    if chosen is None:
        return tuple(f"{each.model.name}: {each.problem}" for each in candidates)

    def respects(model: Model) -> tuple[object, ...]:
        return (model.family, model.parameters), model.transformation, model.bends

    own = respects(chosen.model)
    differences = (sum(a != b for a, b in zip(respects(each.model), own, strict=True)) for each in candidates)
    return (RULE, *(_reason(each, chosen) for each, count in zip(candidates, differences, strict=True) if count == 1))


def _reason(other: Candidate, chosen: Candidate) -> str:
    name, difference, more = other.model.name, other.aicc - chosen.aicc, other.unknowns - chosen.unknowns
    if other.problem:
        return f"{name} has no solution: {other.problem}"
    if chosen.model.contains(other.model):
        return f"{name} is too simple: what it lacks is significant, {_f_words(f_test(other, chosen))}."
    if other.model.contains(chosen.model) and more > 0:
        test = f_test(chosen, other)
        if test.p >= LEVEL:
            return f"{name} is not needed: what it adds is not significant, {_f_words(test)}."
        return f"{name} fits significantly better, {_f_words(test)}{_prediction(other, chosen)}."
    size = f"with {abs(more)} {'more' if more > 0 else 'fewer'} unknowns" if more else "with as many unknowns"
    aicc = f"its AICc is {abs(difference):.1f} {'higher' if difference >= 0 else 'lower'}"
    if difference > DECISIVE:
        return f"{name}, {size}, fits worse for its unknowns: {aicc}."
    if difference < -DECISIVE:
        return f"{name}, {size}, fits better: {aicc}{_prediction(other, chosen)}."
    films = chosen.model.transformation, other.model.transformation
    cause = f". {TILTED}" if films == ("projective", "bilinear") else ""
    return f"{name}, {size}, fits about as well: {aicc}, and only more than {DECISIVE:g} decides{cause}."


def _prediction(other: Candidate, chosen: Candidate) -> str:
    """Compare the predictions of a candidate that fits better with those of the chosen one; "" where it is as good."""
    theirs, own = other.cross_validation, chosen.cross_validation
    if theirs is None:
        return ", but cannot be tested on points left out"
    if own is None or theirs.sigmas < own.sigmas:
        return ""
    figures = f"{theirs.sigmas:.3g} and {own.sigmas:.3g} standard deviations off"
    return f", but predicts points left out no better than the selected one ({figures})"


def _f_words(test: Nested) -> str:
    p_text = f"p = {test.p:.3f}" if test.p >= 0.001 else "p < 0.001"
    f = f"{test.f:.3g}" if test.f < 1000.0 else f"{test.f:.0f}"
    return f"F({test.degrees[0]}, {test.degrees[1]}) = {f}, {p_text}"
