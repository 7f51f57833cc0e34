"""Which model the data ask for: film transformations and distortion families compared on the same observations.

Every candidate is adjusted with the same weights. Of two of which one contains the other, the F-test of their sums of
squares says whether the richer one is needed; any two are compared by Akaike's criterion; and all by how well they
predict points that had no part in their fit (`adjust.choices.cross_validation`). Chosen is the simplest model that no
richer one is significantly better than.

    F = ((v'Pv_s - v'Pv_r) / (u_r - u_s)) / (v'Pv_r / r_r)  ~  F(u_r - u_s, r_r)
    AIC = v'Pv + 2 u                                            where the given variances are taken as known
    AICc = n ln(v'Pv / n) + 2 K + 2 K (K + 1) / (n - K - 1)     K = u + 1, where their common factor is estimated too

n counts the observations with the priors, u the unknowns. Sources: K. R. Koch, Parameter estimation and hypothesis
testing in linear models, 1999, chapter 4.2; K. P. Burnham and D. R. Anderson, Model selection and multimodel inference,
2002, chapter 2.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from adjust.adjustment import Options, adjust
from adjust.choices.cross_validation import CrossValidation, approximations_of, cross_validate, folds
from adjust.choices.models import Model, given_model, lenses, transformations
from adjust.errors import AdjustmentError
from adjust.initial_values.approximations import approximate
from adjust.network import Network, Transformation
from adjust.quality.reweighting import NO_WEIGHT
from adjust.quality.significance import LEVEL
from adjust.result import Adjustment
from adjust.undetermined.datum_choice import with_held

Array = NDArray[np.float64]

DECISIVE = 10.0  # difference of AICc from which on the worse model has essentially no support (Burnham and Anderson)
HIGH_CORRELATION = 0.95
ROUNDS = 3  # of choosing distortion and transformation in turns

Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class Candidate:
    """A model as it was adjusted. problem: why it has no solution, empty where it has one.

    correlated: pairs of interior parameters that the data hardly tell apart, with their correlation.
    """

    model: Model
    problem: str = ""
    observations: int = 0
    unknowns: int = 0
    redundancy: int = 0
    vpv: float = 0.0
    sigma0: float = 0.0
    cross_validation: CrossValidation | None = None
    correlated: tuple[tuple[str, str, float], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def aic(self) -> float:
        return self.vpv + 2.0 * self.unknowns

    @property
    def aicc(self) -> float:
        """inf where there are too few observations for it."""
        k, n = self.unknowns + 1, self.observations
        if n - k - 1 <= 0:
            return np.inf
        return float(n * np.log(max(self.vpv, np.finfo(float).tiny) / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1))


@dataclass(frozen=True)
class Nested:
    """The F-test of a model against a richer one that contains it."""

    simpler: Model
    richer: Model
    f: float
    degrees: tuple[int, int]
    p: float


@dataclass(frozen=True)
class Choice:
    """All candidates, the F-tests of neighbours, the one chosen (None where none has a solution) and why."""

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

    own: the network as it was adjusted with a model of its own, and the weights that robust estimation, data snooping
    and variance components left its image points there: all candidates are given these. options: those of that
    adjustment. half_mm: by camera half the frame, for the self-calibration sets; without it for every camera they are
    left out.
    """
    options = options or Options()
    half_mm = half_mm or {}
    given = given_model(own.network)
    held = replace(options, robust=False, variance_components=False, snooping=False)
    fits = _Fits(weighed(own), held, half_mm, progress, {given.transformation: own})
    chosen = _chosen(
        fits, given.transformation, with_sets=all(camera.name in half_mm for camera in own.network.cameras)
    )
    candidates = tuple(fits.done.values())
    return Choice(
        given=given,
        candidates=candidates,
        tests=nested_tests(candidates),
        chosen=chosen,
        verdict=_verdict(given, chosen),
        reasons=_reasons(candidates, chosen),
    )


def _chosen(fits: "_Fits", film: Transformation, with_sets: bool) -> Candidate | None:
    """Distortion with a transformation, then the transformation with that distortion, until neither changes."""
    chosen = None
    for _ in range(ROUNDS):
        chosen = simplest_sufficient([fits.of(model) for model in lenses(fits.network, film, with_sets)])
        if chosen is None:
            return None
        films = [replace(chosen.model, transformation=each) for each in transformations(fits.network)]
        chosen = simplest_sufficient([fits.of(model) for model in films])
        if chosen is None or chosen.model.transformation == film:
            break
        film = chosen.model.transformation
    return chosen


def simplest_sufficient(candidates: Sequence[Candidate]) -> Candidate | None:
    """The simplest candidate that no richer one is significantly better than; None where none has a solution."""
    chosen = None
    for candidate in sorted(_solved(candidates), key=lambda each: (each.unknowns, each.vpv)):
        if chosen is None or _is_better(candidate, chosen):
            chosen = candidate
    return chosen


def _is_better(richer: Candidate, simpler: Candidate) -> bool:
    """Whether a model is significantly better than one of no more unknowns, and predicts better too."""
    a, b = richer.cross_validation, simpler.cross_validation
    if a is not None and b is not None and a.sigmas >= b.sigmas:
        return False
    if a is None and b is not None:
        return False
    if richer.model.contains(simpler.model):
        return f_test(simpler, richer).p < LEVEL
    return simpler.aicc - richer.aicc > DECISIVE


def f_test(simpler: Candidate, richer: Candidate) -> Nested:
    """Whether the richer of two nested models leaves less than chance would."""
    more, redundancy = richer.unknowns - simpler.unknowns, richer.redundancy
    variance = richer.vpv / redundancy if redundancy > 0 else 1.0
    f = max(simpler.vpv - richer.vpv, 0.0) / more / variance
    p = stats.f.sf(f, more, redundancy) if redundancy > 0 else stats.chi2.sf(f * more, more)
    return Nested(simpler.model, richer.model, float(f), (more, redundancy), float(p))


def nested_tests(candidates: Sequence[Candidate]) -> tuple[Nested, ...]:
    """Of all neighbours: pairs of which one contains the other with no candidate between them."""
    solved = _solved(candidates)
    models = [each.model for each in solved]
    return tuple(
        f_test(simpler, richer)
        for richer in solved
        for simpler in solved
        if richer.model.contains(simpler.model)
        and richer.unknowns > simpler.unknowns
        and not any(richer.model.contains(each) and each.contains(simpler.model) for each in models)
    )


def _solved(candidates: Sequence[Candidate]) -> list[Candidate]:
    return [each for each in candidates if not each.problem]


def weighed(own: Adjustment) -> Network:
    """The network with the weights that its image points ended with in an adjustment; without those that have none."""
    observations = own.network.observations
    weights = own.weights if len(own.weights) else np.ones(len(observations))
    factors = np.array([own.variance_factors.get(kind, 1.0) for kind in observations.kind])
    covariance_mm2 = observations.covariance_mm2 * (factors / weights)[:, None, None]
    kept = replace(observations, covariance_mm2=covariance_mm2).only(np.flatnonzero(weights > NO_WEIGHT))
    return replace(own.network, observations=kept)


@dataclass
class _Fits:
    """The candidates adjusted so far, and per transformation an adjustment from whose values others start."""

    network: Network
    options: Options
    half_mm: Mapping[str, tuple[float, float]]
    progress: Progress
    starts: dict[str, Adjustment]
    done: dict[Model, Candidate] = field(default_factory=dict)

    def of(self, model: Model) -> Candidate:
        if model not in self.done:
            self.progress(model.name, len(self.done))
            self.done[model] = self._adjusted(model)
        return self.done[model]

    def _adjusted(self, model: Model) -> Candidate:
        near = self.starts.get(model.transformation)
        try:
            result = self._from(model, None if near is None or not near.converged else near)
        except AdjustmentError as error:
            return Candidate(model, str(error))
        if result.singular:
            causes = " ".join(f"{', '.join(each.parameters)}: {each.cause}" for each in result.singular)
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
            cross_validate(result, folds(result.network, self.options), self.options),
            _correlated(result),
            result.warnings,
        )

    def _from(self, model: Model, near: Adjustment | None) -> Adjustment:
        """Adjusted from the values of a model near to it, or where that leads nowhere from the images themselves."""
        if near is not None:
            try:
                result = adjust(self._network(model, near), approximations_of(near), self.options)
            except AdjustmentError:
                result = None
            if result is not None and (result.converged or result.singular):
                return result
        network = self._network(model, None)
        return adjust(network, approximate(with_held(network, self.options.datum_coordinates)), self.options)

    def _network(self, model: Model, near: Adjustment | None) -> Network:
        """The network with a model, parameters that the near one has too starting at its values."""
        same = near is not None and near.network.cameras[0].distortion.family == model.family
        values = dict(zip(near.names, near.values.tolist(), strict=True)) if near is not None and same else {}
        return model.of(self.network, values, self.half_mm)


def _correlated(result: Adjustment) -> tuple[tuple[str, str, float], ...]:
    """Pairs of interior parameters of a camera that are highly correlated, the highest first."""
    pairs = []
    for camera in result.network.cameras:
        owner = f"IO.{camera.name}."
        names = [name for name in result.names if name.startswith(owner)]
        cofactor = result.cofactor_of(names)
        free = np.flatnonzero(np.diag(cofactor) > 0.0)
        scale = np.sqrt(np.diag(cofactor)[free])
        correlation = cofactor[np.ix_(free, free)] / np.outer(scale, scale)
        shown = [names[i].removeprefix("IO." if len(result.network.cameras) > 1 else owner) for i in free]
        pairs += [
            (shown[i], shown[j], float(correlation[i, j]))
            for i, j in zip(*np.triu_indices(len(free), 1), strict=True)
            if abs(correlation[i, j]) > HIGH_CORRELATION
        ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


def _verdict(given: Model, chosen: Candidate | None) -> str:
    if chosen is None:
        return "No model has a solution."
    text = f"The data ask for {chosen.model.name}."
    if chosen.model == given:
        text += " That is the model as it is given."
    low, high = (float(np.sqrt(stats.chi2.ppf(p, chosen.redundancy) / chosen.redundancy)) for p in (0.005, 0.995))
    if chosen.redundancy > 0 and not low <= chosen.sigma0 <= high:
        text += (
            f" Its sigma0 of {chosen.sigma0:.2f} is not what the given standard deviations allow, {low:.2f} to "
            f"{high:.2f}: they are not right, or no candidate is."
        )
    return text


def _reasons(candidates: Sequence[Candidate], chosen: Candidate | None) -> tuple[str, ...]:
    """A sentence on every other candidate that differs from the chosen one in distortion or in transformation alone."""
    if chosen is None:
        return tuple(f"{each.model.name}: {each.problem}" for each in candidates)
    near = [
        each
        for each in candidates
        if each is not chosen
        and (
            each.model.transformation == chosen.model.transformation
            or (each.model.family, each.model.parameters) == (chosen.model.family, chosen.model.parameters)
        )
    ]
    return tuple(_reason(each, chosen) for each in near)


def _reason(other: Candidate, chosen: Candidate) -> str:
    name = other.model.name
    if other.problem:
        return f"{name} cannot be had: {other.problem}"
    predicts = _prediction(other, chosen)
    if chosen.model.contains(other.model):
        test = f_test(other, chosen)
        return f"{name} is too simple: {_f_words(test)}; {predicts}."
    if other.model.contains(chosen.model) and other.unknowns > chosen.unknowns:
        test = f_test(chosen, other)
        needless = "adds nothing that is significant" if test.p >= LEVEL else "fits significantly better"
        return f"{name} {needless}: {_f_words(test)}; {predicts}."
    better = "higher" if other.aicc >= chosen.aicc else "lower"
    size = "richer" if other.unknowns > chosen.unknowns else "no richer"
    return f"{name}, {size}, has an AICc {abs(other.aicc - chosen.aicc):.1f} {better}; {predicts}."


def _f_words(test: Nested) -> str:
    chance = f"p = {test.p:.3f}" if test.p >= 0.001 else "p < 0.001"
    return f"F({test.degrees[0]}, {test.degrees[1]}) = {test.f:.3g}, {chance}"


def _prediction(other: Candidate, chosen: Candidate) -> str:
    a, b = other.cross_validation, chosen.cross_validation
    if a is None or b is None:
        return "it was not cross-validated" if a is None else "the chosen one was not cross-validated"
    return f"it predicts points left out to {a.rms_um:.2f} um, the chosen one to {b.rms_um:.2f} um"
