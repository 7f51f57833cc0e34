"""Explain residuals larger than the given standard deviations by errors of the model or of the noise.

A hypothesis adds k unknowns to the model. One linearised step from the end of the adjustment without them gives the
decrease of v'Pv to first order. Likely hypotheses are adjusted and tested by the actual decrease,

    F = decrease / (k s²),   s² = max(1, v'Pv / r of the larger model),

chi-square over k where s² = 1. Groups of a partition selected from the data are tested by the smaller of two bounds:
Scheffé's, with the unknowns of all contrasts, and Bonferroni's, over all partitions. All hypotheses of a round share
the level LEVEL. Hypotheses are compared with each other, and with gross errors of single observations, by v'Pv plus
twice the unknowns and the logarithm of the choices (Akaike); those within TOLD_APART of the best are reported with it.

A hypothesis with unknowns for every image stays only where it explains significantly more than every simpler one.

What is left may be noise that is larger than given: residuals of equal variance in all images and independent of their
neighbours, where a standard deviation added to that of all marks, of targets alone or of fiducials alone, or a factor
on those of the given points, makes every group of observations agree, and explains more than gross errors do.

Nothing is reported unless all that is reported removes more than half of the excess of v'Pv over its redundancy.

Where a standard deviation of unmodelled errors was estimated from the residuals, v'Pv equals its redundancy whatever
the model lacks. A hypothesis then has to remove more than half of what is unmodelled; or, where errors are correlated
within images, LEAST_SHARE of v'Pv; groups of images more than a scatter of the images' interior orientations, and
principal distances of their own have to scatter more than principal points.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, product

import numpy as np
from scipy.spatial import KDTree
from scipy.special import chdtr, chdtrc, fdtrc, ndtr

from adjust.array_types import Array, Indices, Mask
from adjust.errors import NoImageError
from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.problem.problem import Problem
from adjust.quality.cofactor import free_cofactor
from adjust.quality.critical_values import Probabilities
from adjust.quality.reliability import DECISIVE, Snooping
from adjust.quality.run import GrossError, Run, residuals
from adjust.quality.variance_components import added_variance, refined_factors
from adjust.rank_defect.diagnosis import singular_directions
from adjust.solution.model_hypotheses import Estimate, ModelHypothesis, continue_problem, model_hypotheses
from adjust.solution.point_hypotheses import point_hypotheses, wrong_points
from adjust.solution.reweighting import again, without

LEVEL = 0.001  # probability of reporting anything where the model is correct
SUSPECTED = 0.05  # p-value of v'Pv below which wrong points are sought
CHECKED = 10  # smallest redundancy for an explanation
ROUNDS = 3  # rounds of explanations, each in addition to those before
MOST_ADJUSTED = 4  # hypotheses adjusted per round
LEFT = 0.5  # fraction of the excess of v'Pv over its redundancy, or of what is unmodelled, that may remain
SECOND_ORDER = 0.05  # of the variance: what displacements of images, linear in their unknowns, may leave of an effect
WORTH = 0.3  # fraction of the largest first-order decrease above which a hypothesis is adjusted
STEPS = 40  # images of another pitch need about 20
LEAST_SHARE = 0.05  # of v'Pv; further lens terms remove up to 0.02 on real boards
FREED = 1e6  # factor on variances at first that leave the given points no redundancy
SETTLED = 1.0  # fall of v'Pv below which displacements need not be found anew: as small as the noise of one residual
TURNS = 8  # adjustments, each with the variance of the one before
ENDING = ("groups", "distances", "principal points", "affinities")  # after which nothing else is sought
OF_IMAGES = ("radial", "decentering", "bow", "pixels", "shear", "drift", "jump", "interior", "groups", "distances")
OF_POINTS = ("board", "disks", "point")
# Kinds of hypotheses with unknowns for every image, and the simpler ones that may explain as much.
GENERAL = {
    "distances": ("drift", "groups"),
    "principal points": OF_IMAGES + OF_POINTS,
    "affinities": (*OF_IMAGES, *OF_POINTS, "principal points"),
    "film": ("pixels", "single film"),
}
GIVEN_LOOSELY = ("datum", "interior")  # groups of priors
FEWEST = 30  # coordinates needed to test the distribution of residuals
NOISE_LEVEL = 0.001  # significance level of each test of the noise hypothesis
NEIGHBOURS = 8  # nearest neighbours searched for one in the same, or in another, image
UNCHECKED = 0.05  # redundancy number below which a residual is not tested


@dataclass(frozen=True)
class Explanation:
    """Significant cause of residuals larger than the given standard deviations.

    Attributes
    ----------
    kind : that of the hypothesis (see `ModelHypothesis`), or "noise".
    cause : cause in words with figures.
    remedy : what to do.
    p : p-value.
    sigma0 : sigma0 without and with the cause in the model.
    """

    kind: str
    cause: str
    remedy: str
    p: float
    sigma0: tuple[float, float]


def explain(
    run: Run, redundancy: int, probabilities: Probabilities, unmodelled: float = 0.0
) -> tuple[tuple[Explanation, ...], Run]:
    """Explanations of residuals larger than the given standard deviations, largest first, and a run that includes them.

    There are none where the adjustment has no solution. unmodelled: share of the variance of the marks that was
    estimated from the residuals.
    """
    if not run.converged or redundancy < CHECKED:
        return (), run
    first = _Model(run, redundancy, probabilities, unmodelled)
    found, last = _forward(first)
    is_noise = last.exceeds(LEVEL) and not last.leaves_second_order(first)
    noises = (_added_noise(last.run, last.redundancy), _wide_control(last.run)) if is_noise else ()
    for words, with_noise, widened in filter(None, noises):
        noisy = replace(last, run=with_noise)
        if not last.gross_errors or (not noisy.gross_errors and noisy.vpv + widened < last.criterion(1.0)):
            found.append(_explanation("noise", words, float(chdtrc(last.redundancy, last.vpv)), last, noisy))
            last = noisy
            break
    left = last.rest[0] / last.rest[1]
    explains = not last.exceeds(LEVEL) or left - 1.0 < LEFT * (first.variance - 1.0)
    return (tuple(found), last.run) if found and explains else ((), run)


def _forward(first: "_Model") -> tuple[list[Explanation], "_Model"]:
    """Add the best hypothesis, and again on what it leaves; also return the model with all."""
    last = before = first
    found = list[Explanation]()
    for _ in range(ROUNDS):
        if found and (not last.exceeds(first.probabilities.family) or last.leaves_second_order(first)):
            break
        base, alike, has_rival = _best_of_bases(last)
        earlier, before = before, base
        if len(alike) == 1 and alike[0].hypothesis:
            points = wrong_points(last.hypothesis, alike[0].hypothesis, alike[0].run)
            # Estimates of the round before are spoilt by the points that were not yet found.
            if last.kind == points.kind == "point" and not points.selection.words:
                found.pop()
                before = earlier
            alike = [replace(alike[0], hypothesis=points)]
        found += [_model_explanation(each, before) for each in alike]
        if not alike or has_rival:
            break
        last = alike[0].with_gross_errors(first.run)
        if len(alike) == 1 and last.kind == "groups":
            last = _separate_lenses(last) or last
        if len(alike) > 1 or last.kind in ENDING:
            break
    return found, last


@dataclass(frozen=True)
class _Model:
    """An adjustment, and its agreement with the observations, with and without gross errors.

    unmodelled: see `explain`. has_suspects: whether to search for gross errors; not done where the simpler model
    has none. hypothesis: addition to the simpler model; p: p-value of the decrease of v'Pv.
    """

    run: Run
    redundancy: int
    probabilities: Probabilities
    unmodelled: float = 0.0
    has_suspects: bool = True
    hypothesis: ModelHypothesis | None = None
    p: float = 1.0

    @property
    def vpv(self) -> float:
        return self.run.end.vpv

    @property
    def variance(self) -> float:
        return self.vpv / self.redundancy

    def exceeds(self, level: float) -> bool:
        """Whether v'Pv is significant at a level (chi-square test)."""
        return bool(chdtrc(self.redundancy, self.vpv) < level)

    def leaves_second_order(self, first: "_Model") -> bool:
        """Whether what is left of the first residuals may be the second order of displaced images."""
        return self.kind in OF_IMAGES and self.variance < SECOND_ORDER * first.variance

    @cached_property
    def _snooping(self) -> Snooping:
        return Snooping(self.run, self.probabilities)

    @cached_property
    def gross_errors(self) -> list[GrossError]:
        return self._snooping.contradictions if self.has_suspects else []

    @cached_property
    def rest(self) -> tuple[float, float]:
        """v'Pv and redundancy without the gross errors."""
        units = [each.unit for each in self.gross_errors]
        return self._snooping.rest(units) if units else (self.vpv, float(self.redundancy))

    @cached_property
    def clean(self) -> "_Model | None":
        """The model adjusted without its gross errors; None where there are none, or without a solution."""
        units = [each.unit for each in self.gross_errors]
        run = without(self.run, units) if units else None
        return replace(self, run=run, redundancy=round(self.rest[1])) if run and run.converged else None

    def with_gross_errors(self, first: Run) -> "_Model":
        """The model adjusted with the weights of a first run, and its gross errors sought."""
        given, weighting = replace(self, has_suspects=True), first.weighting
        if not self.run.weighting.differs(weighting):
            return given
        run = again(self.run, weighting, STEPS)
        regained = int(first.units.sizes[weighting.used & ~self.run.weighting.used].sum())
        return replace(given, run=run, redundancy=self.redundancy + regained) if run.converged else given

    def criterion(self, variance: float, rest: tuple[float, float] | None = None) -> float:
        """v'Pv over a variance without gross errors, plus the cost of removing and choosing these.

        rest: v'Pv and redundancy without them, where these are known better than in the linear model.
        """
        vpv, redundancy = rest or self.rest
        chosen_from = len(self.gross_errors) * float(np.log(len(self.run.units)))
        return vpv / variance + 2.0 * (self.redundancy - redundancy + chosen_from)

    @property
    def kind(self) -> str:
        """Kind of the hypothesis, empty without one."""
        return self.hypothesis.kind if self.hypothesis else ""

    @property
    def costs(self) -> float:
        """Cost of the unknowns and the choice of the hypothesis."""
        return 2.0 * (len(self.hypothesis.added) + self.hypothesis.selection.choices) if self.hypothesis else 0.0

    def is_significant(self, hypothesis: ModelHypothesis, fall: float, level: float, share: float = 1.0) -> bool:
        """Whether a decrease of v'Pv is significant, and of a share of what errors correlated within images cause."""
        excess_fall = fall - len(hypothesis.added) * self.variance
        is_large = excess_fall > share * LEFT * self.unmodelled * self.vpv or (
            # Curled edges of real boards remove up to 0.3 as points beside a line.
            hypothesis.name != "group"
            and excess_fall > max(LEAST_SHARE, hypothesis.selection.share) * self.vpv
            and hypothesis.selection.p_scatter < LEVEL
        )
        return is_large and self.probability(hypothesis, fall) < level

    def probability(self, hypothesis: ModelHypothesis, fall: float) -> float:
        """p-value of a decrease of v'Pv by a hypothesis."""
        single = self._fall_probability(fall, len(hypothesis.added))
        if not hypothesis.selection.contrasts:
            return single
        bonferroni = np.exp(min(0.0, np.log(max(single, 1e-300)) + hypothesis.selection.choices))
        return float(min(bonferroni, self._fall_probability(fall, hypothesis.selection.contrasts)))

    def _fall_probability(self, fall: float, count: int) -> float:
        left = self.redundancy - count
        if fall <= 0.0 or left < 1:
            return 1.0
        variance = (self.vpv - fall) / left
        return float(fdtrc(count, left, fall / (count * variance)) if variance > 1.0 else chdtrc(count, fall))

    def adjust(self, problem: Problem) -> Run | None:
        """Adjust a larger problem from its start with the same weights; None without a solution."""
        with suppress(NoImageError):
            larger = again(replace(self.run, problem=problem), self.run.weighting, STEPS, problem.start())
            return larger if larger.converged else None
        return None

    def _adjust_anew(self, hypothesis: ModelHypothesis) -> Run | None:
        """Adjust with a hypothesis, linearised anew where that led until v'Pv stands still; None without a solution."""
        run = self.adjust(hypothesis.problem)
        for _ in range(TURNS if hypothesis.anew else 0):
            if run is None or hypothesis.anew is None:
                break
            anew = self.adjust(hypothesis.anew(run))
            if anew is None or anew.end.vpv > run.end.vpv - SETTLED:
                break
            run = anew
        return run

    def extend(self, hypothesis: ModelHypothesis, level: float) -> "_Model | None":
        """Add a hypothesis to the model; None without a solution within its limits, or where it is not significant.

        It is tested by the actual decrease of v'Pv, and beside gross errors that it leaves also without them.
        """
        run, (low, high) = self._adjust_anew(hypothesis), hypothesis.limits
        values = None if run is None else run.end.state.values[hypothesis.added]
        if run is None or values is None or not ((values >= low) & (values <= high)).all():
            return None
        fall = self.vpv - run.end.vpv
        if not self.is_significant(hypothesis, fall, level):
            return None
        left, has_suspects = self.redundancy - len(hypothesis.added), bool(self.gross_errors)
        p = self.probability(hypothesis, fall)
        larger = _Model(run, left, self.probabilities, self.unmodelled, has_suspects, hypothesis, p)
        is_rid = not self.gross_errors or len(larger.gross_errors) < len(self.gross_errors)
        return larger if is_rid or self.probability(hypothesis, self.rest[0] - larger.rest[0]) < level else None


def _best_of_bases(model: _Model) -> tuple[_Model, list[_Model], bool]:
    """The model, or that without its gross errors, with the hypotheses that are best beside those that remain.

    Gross errors hide what a model lacks, and what it lacks looks like gross errors.
    """
    bases = (model,) if model.clean is None else (model, model.clean)
    found = [(base, *_best(base)) for base in bases]
    best = [alike[0].with_gross_errors(model.run) for _, alike, _ in found if alike]
    if len(best) < 2:
        return next((each for each in found if each[1]), found[0])
    variance = max(1.0, min(each.rest[0] / each.rest[1] for each in best))
    return found[int(np.argmin([each.criterion(variance) + each.costs for each in best]))]


def _best(model: _Model) -> tuple[list[_Model], bool]:
    """Models with the best significant hypotheses, several where these are not distinguished."""
    # Also returns whether gross errors of single observations explain the residuals as well.
    is_suspicious = model.exceeds(SUSPECTED) or bool(model.gross_errors)
    tested = {board.name for board in model.run.problem.network.boards}
    falls = list[tuple[float, ModelHypothesis]]()
    kinds = (model_hypotheses, point_hypotheses)
    for each in chain(*(kind(model.run, is_suspicious, bool(model.unmodelled)) for kind in kinds)):
        if each.name not in tested:
            at = model.run.linearised(each.problem)
            is_regular = at is not None and not singular_directions(at.rows.numbering, at.state, at.factor)
            falls.append((at.factor.length() ** 2 if at is not None and is_regular else 0.0, each))
    level = LEVEL / max(len(falls), 1)
    worth = WORTH * max((fall for fall, _ in falls), default=0.0)
    likely = [(fall, each) for fall, each in falls if fall > worth and model.is_significant(each, fall, level, WORTH)]
    likely.sort(key=lambda each: -each[0])
    candidates = [model.extend(each, level) for _, each in likely[:MOST_ADJUSTED]]
    found = [each for each in candidates if each is not None]
    if not found:
        return [], False
    # In the linear model a large gross error leaves its second order.
    rest = (model.clean.vpv, float(model.clean.redundancy)) if model.clean else model.rest
    variance = max(1.0, min(vpv / redundancy for vpv, redundancy in (rest, *(each.rest for each in found))))
    for general, special in GENERAL.items():
        found = _drop_nested(found, variance, general, special)
    criteria = [each.criterion(variance) + each.costs for each in found]
    rival = model.criterion(variance, rest) - min(criteria) if model.gross_errors else np.inf
    if rival < -DECISIVE:
        return [], False
    alike = [each for each, own in zip(found, criteria, strict=True) if own < min(criteria) + DECISIVE]
    return alike, bool(rival < DECISIVE)


def _drop_nested(found: list[_Model], variance: float, general: str, special: tuple[str, ...]) -> list[_Model]:
    """Keep the special hypotheses, or one with unknowns for every image if it explains significantly more."""
    pairs = [(one, other) for one, other in product(found, found) if one.kind == general and other.kind in special]
    further = [(s.redundancy - g.redundancy, max(0.0, s.vpv - g.vpv) / variance) for g, s in pairs]
    is_needless = any(chdtrc(count, fall) > LEVEL for count, fall in further)
    dropped = (general,) if is_needless else special if further else ()
    return [each for each in found if each.kind not in dropped]


def _separate_lenses(model: _Model) -> _Model | None:
    """Give two groups of images entirely separate lenses; None without a solution, or with fiducial marks."""
    network = model.run.problem.network
    if any(camera.fiducials for camera in network.cameras):
        return None
    problem, old = continue_problem(model.run, network), model.run.problem.unknowns
    unknowns = problem.unknowns
    sigma, start = unknowns.sigma.copy(), unknowns.start.copy()
    for name, at in old.camera.items():
        own = unknowns.camera[name]
        sigma[own], start[own] = old.sigma[at], model.run.end.state.values[at]
    run = model.adjust(replace(problem, unknowns=replace(unknowns, sigma=sigma, start=start)))
    if run is None:
        return None
    added = len(run.numbering.free) - len(model.run.numbering.free)
    return replace(model, run=run, redundancy=model.redundancy - added)


def _model_explanation(larger: _Model, model: _Model) -> Explanation:
    """Describe a hypothesis by the estimates of its unknowns in the adjustment that includes them."""
    assert larger.hypothesis is not None
    hypothesis, run, coordinates = larger.hypothesis, larger.run, 2 * len(model.run.end.v_mm)
    covariance_mm2 = model.run.problem.network.observations.covariance_mm2
    sigma_um = UM_PER_MM * float(np.sqrt(np.mean(np.trace(covariance_mm2, axis1=1, axis2=2)) / 2.0))
    explained_um = sigma_um * float(np.sqrt(max(model.vpv - larger.vpv, 0.0) / coordinates))
    # The covariance is scaled by the variance factor of the larger model where that exceeds 1: what it leaves
    # unexplained is noise to its unknowns.
    vpv, redundancy = run.group_sums(run.weighting.used)
    variance = max(vpv / redundancy, 1.0) if redundancy >= 1.0 else 1.0
    positions = hypothesis.added if hypothesis.shown is None else hypothesis.shown
    covariance = variance * free_cofactor(run.end).part(positions)
    estimate = Estimate(run.end.state.values[positions], np.sqrt(np.diag(covariance)), covariance, explained_um)
    return _explanation(hypothesis.kind, hypothesis.words(estimate), larger.p, model, larger)


def _explanation(kind: str, words: tuple[str, str], p: float, without: _Model, larger: _Model) -> Explanation:
    sigma0 = float(np.sqrt(without.variance)), float(np.sqrt(larger.variance))
    p_text = f"p = {p:.1g}" if p > 1e-99 else "p < 1e-99"
    figures = f"with this in the model σ₀ falls from {sigma0[0]:.3g} to {sigma0[1]:.3g} ({p_text})"
    return Explanation(kind, f"{words[0]}; {figures}.", words[1], p, sigma0)


# Marks, their kinds, and the key of their standard deviation in a project.
KINDS = (
    ("marks", ("target", "tie", "fiducial"), "sigma_target_um"),
    ("targets", ("target", "tie"), "sigma_target_um"),
    ("fiducials", ("fiducial",), "sigma_fiducial_um"),
)


# Cause and remedy, the adjustment with it, and the change of minus twice the logarithm of the likelihood beside v'Pv.
Noise = tuple[tuple[str, str], Run, float]


def _added_noise(run: Run, redundancy: int) -> Noise | None:
    """Adjust with a standard deviation added to those of marks that explains all residuals; None where none does."""
    if not _is_noise(run):
        return None
    network, v_mm = run.problem.network, run.end.v_mm
    kind, covariance = np.array(network.observations.kind), network.observations.covariance_mm2
    variances, axes = np.linalg.eigh(covariance / run.weighting.weights[: len(v_mm), None, None])
    squares = np.einsum("nij,ni->nj", axes, v_mm) ** 2
    for marks, kinds, key in KINDS:
        members = np.isin(kind, kinds)
        if marks != "marks" and members.all():
            continue
        others = run.end.vpv - float((squares[members] / variances[members]).sum())
        added = added_variance(squares[members], variances[members], redundancy - others)
        if added is None:
            continue
        larger = covariance + np.where(members, added, 0.0)[:, None, None] * np.eye(2)
        observations = replace(network.observations, covariance_mm2=larger)
        problem = replace(run.problem, network=replace(network, observations=observations))
        noisy = again(replace(run, problem=problem), run.weighting, STEPS, run.end.state)
        if noisy.converged and _groups_agree(noisy):
            share = run.redundancies[: len(v_mm)][members].mean()
            widened = float(share * np.log1p(added / variances[members]).sum())
            added_um = UM_PER_MM * float(np.sqrt(added))
            given_um = UM_PER_MM * float(np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2) / 2.0)))
            words = (
                f"The standard deviations given to the {marks} are too small everywhere: the residuals are plain "
                f"noise, alike in all images; {added_um:.3g} µm added to the {given_um:.3g} µm given (in quadrature) "
                "explains all",
                f"Give film_sigma_um = {added_um:.3g} under [adjust], which is added to the sigma of every mark, or "
                f"larger sigmas in comparator.csv or {key}.",
            )
            return words, noisy, widened
    return None


def _wide_control(run: Run) -> Noise | None:
    """Adjust with larger standard deviations of the given points that explain all residuals; None where none do."""
    control = (run.units.groups == "control") & run.weighting.used
    vpv, freedom = run.group_sums(control)
    is_held = freedom < CHECKED <= control.sum()  # by standard deviations that leave them no redundancy
    if run.weighting.factors or not (is_held or (freedom >= CHECKED and chdtrc(freedom, vpv) <= NOISE_LEVEL)):
        return None
    wide = replace(run, weighting=replace(run.weighting, factors={"control": FREED if is_held else 1.0}))
    for _ in range(TURNS):
        wide = again(wide, refined_factors(wide), STEPS)
        if not wide.converged:
            return None
    if not (_is_noise(wide) and _groups_agree(wide)):
        return None
    factor, (_, freedom) = wide.weighting.factors["control"], wide.group_sums(control)
    words = (
        "The standard deviations given to the object points are too small everywhere, by a factor of "
        f"{np.sqrt(factor):.2g}: the marks agree with each other, and the points' "
        "differences from them are plain noise",
        "Give sX, sY and sZ as the points have them, or variance_components = true under [adjust].",
    )
    # The logarithm of the likelihood changes by the group's redundancy, f / (f + q) of each coordinate, times d ln f.
    count = int(run.units.sizes[control].sum())
    q = factor * (count / freedom - 1.0)
    return words, wide, count * float(np.log((factor + q) / (1.0 + q)))


def _is_noise(run: Run) -> bool:
    """Whether standardised residuals are homogeneous over images and independent of neighbours."""
    v = residuals(run)
    checked: Mask = np.asarray((v.redundancy > UNCHECKED).all(axis=1))
    if 2 * checked.sum() < FEWEST:
        return False
    w, redundancy, images = v.w[checked], v.redundancy[checked], run.problem.image_numbers[checked]
    # All images have the same mean square: chi-square test.
    shares, freedom = (np.bincount(images, each.sum(axis=1)) for each in (w**2 * redundancy, redundancy))
    present = freedom > 1.0
    variance = shares.sum() / freedom.sum()
    square = ((shares[present] / variance - freedom[present]) ** 2 / (2.0 * freedom[present])).sum()
    if present.sum() >= 2 and not chdtrc(present.sum() - 1, square) > NOISE_LEVEL:
        return False
    # Sums of products of residuals, of expectation 0 if independent, are not significantly positive.
    for products in _neighbour_products(run, checked, w, images):
        if len(products) > 2:
            z = products.sum() / np.sqrt(2.0 * (products**2).sum())  # factor 2: most pairs of neighbours occur twice
            if ndtr(-z) < 0.5 * NOISE_LEVEL:
                return False
    return True


def _neighbour_products(run: Run, checked: Mask, w: Array, images: Indices) -> Iterator[Array]:
    """Products of residuals (n, 2) of neighbours in an image, in different images, and of a point in different images.

    The residuals of a point are rotated into object axes.
    """
    places = run.end.computed_mm[checked]
    apart = 10.0 * float(np.ptp(places, axis=0).max())
    for at, same_image in ((np.column_stack([places, apart * images]), True), (places, False)):
        near = np.asarray(KDTree(at).query(at, min(NEIGHBOURS, len(at)))[1])
        wanted = (images[near] == images[:, None]) == same_image
        wanted &= near != np.arange(len(w))[:, None]
        rows = np.flatnonzero(wanted.any(axis=1))
        yield (w[rows] * w[near[rows, wanted[rows].argmax(axis=1)]]).sum(axis=1)
    points = np.array(run.problem.network.observations.point)[checked]
    order = np.lexsort((images, points))
    in_object = np.einsum("nji,nj->ni", run.end.state.rotations[images][:, :2], w)[order]
    yield (in_object[1:] * in_object[:-1]).sum(axis=1)[points[order][1:] == points[order][:-1]]


def _groups_agree(run: Run) -> bool:
    """Whether every group of observations agrees with its standard deviations, in a two-sided test but for values that
    are given with larger ones than they need."""
    for name in np.unique(run.units.groups):
        vpv, freedom = run.group_sums((run.units.groups == name) & run.weighting.used)
        below = 1.0 if name in GIVEN_LOOSELY else chdtr(freedom, vpv)
        if freedom > 1.0 and min(below, chdtrc(freedom, vpv)) < NOISE_LEVEL:
            return False
    return True
