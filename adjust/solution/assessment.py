"""What an adjustment tells of its observations: residuals and their tests, warnings; computed where it is asked for."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adjust.functional_model.transformation import marks_needed
from adjust.least_squares.iteration import factorise
from adjust.problem.condition_equations import computed_observations
from adjust.problem.parameter import description
from adjust.problem.probabilities import Probabilities
from adjust.problem.problem import Problem
from adjust.problem.result import (
    Cofactor,
    Contradiction,
    Explanation,
    FurtherResidual,
    Group,
    Reliability,
    Residuals,
    Suspect,
    VarianceFactor,
)
from adjust.problem.tested import TestedUnits
from adjust.quality.contradiction import contradictions_of_groups
from adjust.quality.reliability import Misfits, reliability
from adjust.quality.residuals import further_residuals, groups, residuals
from adjust.quality.snooping import contradictions, search, suspects
from adjust.quality.suspicions import is_gross, swapped_numbers, unchecked_orientations
from adjust.quality.variance_components import factor_sigmas
from adjust.quality.variance_factor import variance_factor
from adjust.rank_defect.diagnosis import undetermined, weak_directions
from adjust.rank_defect.flat_valleys import held_directions, inseparable
from adjust.rank_defect.scanner_directions import hardly_told
from adjust.solution.explanations import Explained, explain
from adjust.solution.reweighting import ROUNDS, Run


def conditions_of(run: Run, cofactor: Cofactor) -> int:
    """Equations, without what the adjustment does without; with what pseudo-observations determine."""
    problem = run.problem
    further = sum(len(each.observed) for each in problem.further)
    held = held_directions(problem, cofactor.variances) if problem.pseudo_observed else 0
    return int(TestedUnits(problem).sizes[run.weighting.used].sum()) + further + held


def redundancy_of(run: Run, cofactor: Cofactor) -> int:
    """Equations less unknowns."""
    return conditions_of(run, cofactor) - len(run.numbering.free)


def variance_of(run: Run, redundancy: int) -> VarianceFactor:
    """sigma0 and what it comes from; redundancy: of all."""
    factor = run.solution.factor
    if factor is None:
        return VarianceFactor(float(np.sqrt(run.vpv / redundancy)) if redundancy > 0 else 1.0, max(redundancy, 0))
    return variance_factor(run.numbering, run.end.state, factor, run.weighting, run.vpv, redundancy)


@dataclass(frozen=True)
class RunAssessment:
    """The `Assessment` of a run; nothing is computed twice.

    scaled: the run with the priors that the cofactor matrix has; variance: sigma0, and what it comes from.
    """

    run: Run
    scaled: Run
    cofactor: Cofactor
    variance: VarianceFactor
    probabilities: Probabilities

    @cached_property
    def residuals(self) -> Residuals:
        return residuals(self.run.end.v_mm, self._found, self.run.weighting)

    @cached_property
    def further(self) -> tuple[FurtherResidual, ...]:
        run, delta = self.run, self.probabilities.noncentrality(1)
        of_state = run.problem, run.end.state, run.end.rows.further
        return tuple(further_residuals(*of_state, run.solution.factor, delta))

    @cached_property
    def contradictions(self) -> tuple[Contradiction, ...]:
        run = self.run
        if not run.has_solution or not run.problem.further:
            return ()
        of_state = run.problem, run.end.state, run.end.rows.further
        redundancy, vpv = self._redundancy, self.variance.sigma0**2 * self.variance.redundancy
        return tuple(contradictions_of_groups(*of_state, run.factor, vpv, redundancy))

    @cached_property
    def groups(self) -> Mapping[str, Group]:
        run = self.run
        return groups(run.problem, run.end.state, run.end.v_mm, self._found, run.weighting, self.further)

    @cached_property
    def variance_sigmas(self) -> Mapping[str, float]:
        run, found = self.run, self._found
        if found is None or not run.weighting.factors:
            return {}
        return factor_sigmas(run.numbering, run.end, run.factor, found, run.weighting)

    @cached_property
    def reliability(self) -> Reliability | None:
        run, found = self.run, self._found
        if found is None:
            return None
        at, weights = (run.numbering, run.end, run.factor, found), run.weighting.weights
        return reliability(*at, weights, self.variance.sigma0, self._redundancy, self.probabilities)

    @property
    def explanations(self) -> tuple[Explanation, ...]:
        return self._explained.explanations

    @cached_property
    def _explained(self) -> Explained:
        return explain(self.run, redundancy_of(self.run, self.cofactor), self.probabilities)

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """Of the adjustment with what explains the residuals, so that nothing else is blamed for it."""
        explained = self._explained.run
        if explained is self.run:
            return self._suspects
        variance = variance_of(explained, redundancy_of(explained, self.cofactor))
        return RunAssessment(explained, explained, self.cofactor, variance, self.probabilities)._suspects

    @property
    def _suspects(self) -> tuple[Suspect, ...]:
        run, found = self.run, self._found
        if found is None or self.reliability is None:
            return ()
        tests = search(run.numbering, run.end, run.factor, found, run.weighting, self.probabilities)
        contradicting = contradictions(tests)
        return suspects(tests, contradicting, run.removed, self.reliability, self.probabilities, self._redundancy)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        observations = self.run.problem.network.observations
        unchecked = unchecked_orientations(observations, self.residuals) if self.run.converged else []
        return (*_warnings(self.scaled, self.cofactor), *self._swapped, *unchecked)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        problem = self.run.problem
        return tuple(inseparable(problem, self.run.end.state, self.cofactor.variances)) if self.run.converged else ()

    @property
    def _swapped(self) -> list[str]:
        """Told from where the adjustment starts, whose orientations come of what most marks say: at its end it has bent
        to fit the wrong ones too.
        """
        problem = self.run.problem
        observations = problem.network.observations
        if self.run.converged and not is_gross(observations, self.residuals.v_mm).any():
            return []
        started = computed_observations(problem, problem.start())
        return [] if started is None else swapped_numbers(observations, started - observations.xy_mm)

    @property
    def _redundancy(self) -> int:
        """That sigma0 comes from."""
        return round(self.variance.redundancy)

    @property
    def _found(self) -> Misfits | None:
        return self.run.found if self.run.has_solution else None


def _warnings(last: Run, cofactor: Cofactor) -> list[str]:
    """What the user should look at in a result."""
    problem = last.numbering.problem
    warnings = []
    if last.solution.termination == "iteration limit":
        warnings.append(
            f"The iteration did not stand still within {len(last.solution.history)} steps: the values are not final. "
            f"The largest residuals are those of {_worst(last)}."
        )
    if last.solution.termination == "diverged":
        warnings.append(
            f"The iteration diverged: it came to no minimum. Look for wrong point numbers and wrong approximations; "
            f"the largest residuals are those of {_worst(last)}."
        )
        warnings += [f"Where it ended, the equations are singular: {each.cause}" for each in last.singular]
    if not last.settled:
        warnings.append(
            f"The weights did not settle within {ROUNDS} rounds of robust estimation, variance components or data "
            f"snooping."
        )
    without_priors = factorise(last.numbering, last.end, camera_priors=False)
    weak = weak_directions(problem, last.end.state, last.numbering.free, without_priors, last.singular)
    warnings += [
        f"Practically singular without priors: {description(each.parameters)}. {each.cause} {each.remedy}"
        for each in weak
    ]
    if last.converged:
        warnings += filter(None, [undetermined(problem, last.end.state, cofactor.variances)])
        warnings += hardly_told(problem, last.end.state, last.numbering.free, last.factor, cofactor)
    return warnings + _unseen(problem) + _films_by_targets(problem)


def _worst(last: Run) -> str:
    """The observations with the largest residuals."""
    observations = last.numbering.problem.network.observations
    size = np.abs(last.end.v_mm).max(axis=1)
    rows = np.argsort(-size)[:3]
    return ", ".join(
        f"{observations.kind[i]} {observations.point[i]} in image {observations.image[i]} ({size[i]:.3g} mm)"
        for i in rows
    )


def _unseen(problem: Problem) -> list[str]:
    """What is given and that no image shows."""
    points = [point.id for point in problem.network.points if point.id not in problem.unknowns.point]
    if not points:
        return []
    shown = ", ".join(points[:5]) + (f" and {len(points) - 5} more" if len(points) > 5 else "")
    return [f"No image shows the object points {shown}: they take no part."]


def _films_by_targets(problem: Problem) -> list[str]:
    """Images whose film transformation takes more than their fiducial marks."""
    images = problem.network.images
    shown = np.bincount(problem.image_numbers[problem.is_fiducial], minlength=len(images))
    few = [i for i, image in enumerate(images) if shown[i] < marks_needed(image.transformation)]
    if not few:
        return []
    first = images[few[0]]
    others = f" {len(few) - 1} more images are alike." if len(few) > 1 else ""
    return [
        f"Image {first.name} shows {shown[few[0]]} fiducial marks, and its {first.transformation} transformation takes "
        f"{marks_needed(first.transformation)} of its own: the targets determine the rest of it.{others}"
    ]
