"""Adjustment of a numbered problem, and its result: estimates, residuals, tests and messages, computed on demand."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import Any, Literal

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.display import CameraPlots, PlottedResult, data_frame
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import Iteration
from adjust.problem import estimates
from adjust.problem.camera import Camera
from adjust.problem.network import STRAIGHT, Approximations
from adjust.problem.parameter import Parameter
from adjust.problem.problem import Problem
from adjust.quality.cofactor import (
    NoCofactor,
    cluster_covariance,
    free_cofactor,
    inner_cofactor,
    larger_covariance,
    prediction_errors,
)
from adjust.quality.critical_values import Probabilities
from adjust.quality.lens_uncertainty import (
    LensReach,
    ProjectionUncertainty,
    lens_reach,
    only_camera,
    projection_uncertainty,
)
from adjust.quality.reliability import Reliability, Snooping, Suspect, reliability
from adjust.quality.run import FurtherResidual, Group, Residuals, Run, further_residuals, groups, residuals
from adjust.quality.significance import (
    CalibrationTest,
    Correlation,
    SignificanceTest,
    calibration_tests,
    correlations,
    significance_tests,
)
from adjust.quality.variance_components import factor_sigmas, variance_factor
from adjust.rank_defect import datum
from adjust.rank_defect.diagnosis import held_directions, inseparable, loose_principal_distances
from adjust.solution.explanations import Explanation, explain
from adjust.solution.options import Options
from adjust.solution.point_hypotheses import diameter_notes
from adjust.solution.reweighting import again, run, without
from adjust.solution.warnings import curved_valley_warnings, film_scale_notes, held_decentering_notes, run_warnings


@dataclass(frozen=True, repr=False)
class Adjustment(estimates.Estimates, PlottedResult):
    """Adjusted network with residuals, tests and messages.

    Attributes
    ----------
    run, scaled : the last adjustment, in reduced coordinates; with the priors used for the cofactor matrix.
    iterations, conditions, unknowns, redundancy : counts.
    vpv : v'Pv.
    singular, history : null directions of a singular network, and the iterations.
    weights : (n,) factors of robust estimation on the weights of the observations; 1 without it.
    variance_factors : estimated variance factors by group.
    remarks : remarks on how the result was obtained; listed first among the warnings.
    coordinate_blunders : by given point, a sentence on the blunder that prevents agreement or a solution; other
        suspects are then consequences of these.
    left_out : reasons by name of the images without an orientation; `network` has the others, and of those with too few
        known points the fiducials.
    unmet : sentences by name of the points whose rays do not meet; `network` has the others.
    misread : sentences on mirrored images; other contradictions are then consequences of these.
    unused : notes on input that is not used; listed first among the notes.
    unmodelled_mm : by camera, the estimated standard deviation of unmodelled errors.
    """

    run: Run
    scaled: Run
    probabilities: Probabilities
    iterations: int
    conditions: int
    unknowns: int
    redundancy: int
    vpv: float
    singular: tuple[estimates.NullDirection, ...]
    history: tuple[Iteration, ...]
    weights: Array = field(default_factory=lambda: np.empty(0))
    variance_factors: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    coordinate_blunders: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    unmet: Mapping[str, str] = field(default_factory=dict)
    misread: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    unmodelled_mm: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def residuals(self) -> Residuals:
        return residuals(self.run)

    @cached_property
    def groups(self) -> Mapping[str, Group]:
        """Groups of observations with their share of v'Pv."""
        return groups(self.run, self.further)

    @cached_property
    def further(self) -> tuple[FurtherResidual, ...]:
        """Residuals of distances and calibrations."""
        return tuple(further_residuals(self.run, self.probabilities.noncentrality(1)))

    @cached_property
    def contradictions(self) -> tuple[CalibrationTest, ...]:
        """Compatibility tests of the images against earlier calibrations."""
        if not self.run.has_solution:
            return ()
        return tuple(calibration_tests(self.run, self.variance.sigma0, self.variance.redundancy))

    @cached_property
    def variance_sigmas(self) -> Mapping[str, float]:
        """Standard deviations of the variance factors."""
        return factor_sigmas(self.run) if self.run.has_solution and self.run.weighting.factors else {}

    @cached_property
    def reliability(self) -> Reliability | None:
        """Baarda's internal and external reliability; None without a solution."""
        return reliability(self.run, self.variance, self.probabilities) if self.run.has_solution else None

    @cached_property
    def correlations(self) -> tuple[Correlation, ...]:
        """High correlations of cameras' parameters, highest first."""
        return correlations(self)

    @cached_property
    def significance(self) -> Mapping[tuple[str, str], tuple[SignificanceTest, ...]]:
        """Significance tests by kind ("interior", "scanner", "board") and owner: single parameters, then groups."""
        return significance_tests(self)

    @property
    def start(self) -> Approximations | None:
        """Initial values of a similar adjustment; None without a solution or with images or points left out."""
        return self.approximations if self.converged and not (self.left_out or self.unmet) else None

    def cluster_covariance_of(self, parameters: Sequence[Parameter]) -> Array | None:
        """Estimate the covariance (k, k) of quantities of cameras or boards by leaving out one image at a time.

        It remains valid where errors within an image are correlated. Fixed quantities have zeros. None without a
        solution or with too few images (`adjust.quality.cofactor`).
        """
        found = cluster_covariance(self.scaled, self.cofactor, self.sigma0**2) if self.converged else None
        return None if found is None else found[np.ix_(*2 * [[self.index(each) for each in parameters]])]

    def larger_covariance_of(self, parameters: Sequence[Parameter]) -> Array:
        """Return the covariance (k, k) of quantities of cameras.

        With an unmodelled error it is enlarged in each direction in which that by leaving out images is larger.
        """
        covariance = self.sigma0**2 * self.cofactor_of(parameters)
        clusters = self.cluster_covariance_of(parameters) if self.unmodelled_mm else None
        return covariance if clusters is None else larger_covariance(covariance, clusters)

    def prediction_errors(self, folds: int) -> Array | None:
        """Cross-validate the images in `folds` groups.

        Returns the (m,) mean squared standardised length of each image's residuals, each group of images predicted from
        the others (`adjust.quality.cofactor`); None without a solution.
        """
        return prediction_errors(self.scaled, self.cofactor, folds) if self.converged else None

    def lens_reach(self, camera: Camera, frame_mm: tuple[float, float] | None = None) -> LensReach | None:
        """Determine how far out the lens of a camera is known; None without a solution or without targets.

        frame_mm: width and height of the image, None where unknown.
        """
        has_lens = self.converged and camera.name not in self.network.idle_cameras
        return lens_reach(self, camera, frame_mm) if has_lens else None

    def projection_uncertainty(
        self, camera: str = "", distance: float = np.inf, places_mm: Array | None = None
    ) -> ProjectionUncertainty:
        """Compute standard deviations of the images of points fixed in the scene.

        Parameters
        ----------
        camera : name; optional where there is one camera
        distance : distance of the points from the camera in object units; default infinite
        places_mm : (..., 2) image places in the camera frame; default a grid over the image

        Notes
        -----
        See docs/method/reliability.md for the effects that are removed. Raises AdjustmentError without a solution, for
        an unknown camera or for one without targets.
        """
        clusters = self.cluster_covariance_of if self.unmodelled_mm else lambda _: None
        return projection_uncertainty(self, clusters, camera, distance, places_mm)

    def plots(self, camera: str = "", pixel_mm: float | None = None) -> CameraPlots:
        """Collect the data for the plots of a camera, optional where there is one.

        pixel_mm: side of a pixel of a digital camera; plots are then in px. Raises AdjustmentError without a solution,
        or for an unknown camera.
        """
        shown = only_camera(self, camera)

        def uncertainty(distance: float) -> tuple[Array, Array]:
            found = self.projection_uncertainty(shown.name, distance)
            return found.places_mm, found.sigma_mm

        observations, v_mm = self.network.observations, self.residuals.v_mm
        rows, observed = estimates.observed_places(self, shown.name, observations.xy_mm)
        _, adjusted = estimates.observed_places(self, shown.name, observations.xy_mm + v_mm)
        lens = estimates.adjusted_lens(self, shown.name)
        keys = [Parameter.interior(shown.name, each) for each in lens.quantities]
        return CameraPlots(
            name=shown.name,
            lens=replace(lens, covariance=self.larger_covariance_of(keys)),
            places_mm=observed,
            vectors_mm=adjusted - observed,
            is_fiducial=observations.is_fiducial[rows],
            images=sum(image.camera == shown.name for image in self.network.images),
            corners_mm=np.array(shown.frame_corners(observed) or (observed.min(axis=0), observed.max(axis=0))),
            uncertainty=uncertainty,
            pixel_mm=pixel_mm,
        )

    def to_pandas(self, table: Literal["parameters", "residuals"] = "parameters") -> Any:
        """Return a table as pandas.DataFrame: one row per quantity or per observation; pandas has to be installed."""
        if table != "residuals":
            columns: dict[str, Any] = {
                name: [getattr(each, name) for each in self.parameters] for name in ("kind", "owner", "id", "quantity")
            }
            return data_frame(columns | {"value": self.values, "sigma": self.sigma0 * np.sqrt(self.cofactor.variances)})
        observations, v = self.network.observations, self.residuals
        columns = {name: getattr(observations, name) for name in ("image", "point", "kind")}
        pairs = {"{}_mm": observations.xy_mm, "v{}_um": 1e3 * v.v_mm, "redundancy_{}": v.redundancy, "w_{}": v.w}
        return data_frame(
            columns | {name.format(axis): pair[:, k] for name, pair in pairs.items() for k, axis in enumerate("xy")}
        )

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """Suspected gross errors, worst first, after accounting for the explanations of all residuals."""
        if self.misread or not self.run.has_solution:
            return ()
        run, variance, tested = self._explanation_run[1], self.variance, self.reliability
        if run is not self.run:
            variance = variance_factor(run, _redundancy(run, self.cofactor))
            tested = reliability(run, variance, self.probabilities)
        search = Snooping(run, self.probabilities)
        found = search.suspects(tested, round(variance.redundancy)) if tested else ()
        units = [each.unit for each in search.contradictions]
        if tested and len(units) > 1 and (clean := without(run, units)).is_tested and clean.converged:
            # In the linear model a large gross error leaves its second order in others.
            is_wrong = clean.statistics.statistic > Snooping(clean, self.probabilities).limits
            agreeing = [tested.tested[unit] for unit in units if not is_wrong[unit]]
            found = tuple(each for each in found if each.tested not in agreeing)
        is_warned = not self.coordinate_blunders or self.run.removed
        return tuple(each for each in found if is_warned or each.tested.point in self.coordinate_blunders)

    @cached_property
    def explanations(self) -> tuple[Explanation, ...]:
        """Explanations of a large sigma0. The suspects are those of an adjustment that includes them in the model."""
        return () if self.misread else self._explanation_run[0]

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings to the user.

        Where coordinate blunders prevent a solution, the warnings on the run are dropped as consequences of these.
        """
        on_film = {image.frame for image in self.network.images}
        titles = "Left out of the adjustment", "Not oriented; its film transformation is adjusted from its fiducials"
        left_out = dict.fromkeys(f"{titles[frame in on_film]}: {reason}" for frame, reason in self.left_out.items())
        own = (
            ()
            if self.coordinate_blunders and not self.converged
            else run_warnings(self.scaled, self.cofactor, self.residuals, self._explanation_run[1])
        )
        curved = curved_valley_warnings(self.run, self.cofactor) if self.converged else ()
        return (
            *self.misread,
            *self.coordinate_blunders.values(),
            *left_out,
            *self.unmet.values(),
            *self.remarks,
            *own,
            *curved,
        )

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Notes that need no action."""
        is_explained = any(each.kind == "disks" for each in self.explanations)
        of_disks = () if is_explained else diameter_notes(self.run)
        notes = (held_decentering_notes, film_scale_notes) if self.converged else ()
        of_interior = (note for each in notes for note in each(self.run, self.cofactor))
        return (*self.unused, *(sentence for _, sentence in self._inseparable.values()), *of_disks, *of_interior)

    @cached_property
    def loose_cameras(self) -> frozenset[str]:
        """Names of the cameras whose principal distance the images hardly determine, as a warning says."""
        run = self.scaled
        if not run.converged:
            return frozenset()
        return frozenset(loose_principal_distances(run.numbering.problem, run.end.state, self.cofactor.variances))

    def inseparable(self, camera: str) -> list[str]:
        """Distortion parameters of a camera that the observations do not separate."""
        return self._inseparable.get(camera, ([], ""))[0]

    @cached_property
    def _inseparable(self) -> dict[str, tuple[list[str], str]]:
        run = self.run
        return inseparable(run.problem, run.end.state, self.cofactor.variances) if run.converged else {}

    @cached_property
    def _explanation_run(self) -> tuple[tuple[Explanation, ...], Run]:
        # Mean share of the estimated standard deviation of unmodelled errors in the variance of targets.
        observations, images = self.network.observations, self.network.images
        added = np.array([self.unmodelled_mm.get(image.camera, 0.0) for image in images])[self.network.image_numbers]
        variance = np.trace(observations.covariance_mm2, axis1=1, axis2=2) / 2.0
        shares = (added**2 / variance)[~observations.is_fiducial]
        unmodelled = float(np.mean(shares)) if len(shares) else 0.0
        return explain(self.run, _redundancy(self.run, self.cofactor), self.probabilities, unmodelled)

    def __repr__(self) -> str:
        return (
            f"Adjustment({self.termination} after {self.iterations} iterations: {self.conditions} conditions, "
            f"{self.unknowns} unknowns, redundancy {self.redundancy}, sigma0 {self.sigma0:.3f})"
        )

    def _repr_html_(self) -> str:
        """Table of the cameras' parameters for notebooks."""
        rows = "".join(
            f"<tr><td>{escape(each.label)}</td><td>{self.value(each):.7g}</td><td>{self.sigma(each):.2g}</td></tr>"
            for each in self.parameters
            if each.kind == "interior"
        )
        head = "<tr><th>parameter</th><th>value</th><th>sigma</th></tr>"
        return f"<p>{escape(repr(self))}</p><table>{head}{rows}</table>"


def _is_fixed(problem: Problem, last: Run) -> bool:
    """Whether a datum was held fixed in a run of a problem."""
    return bool((last.problem.unknowns.sigma != problem.unknowns.sigma).any())


def _cofactor(problem: Problem, last: Run, members: Indices | None) -> estimates.Cofactor:
    """Compute the cofactor matrix in the datum of a run, or with inner constraints over the coordinates `members`."""
    if not last.has_solution:
        return NoCofactor(len(problem.unknowns))
    if members is None or not (last.converged and _is_fixed(problem, last)):
        return free_cofactor(last.end)
    return inner_cofactor(problem, last.end, members)


def _result(given: Problem, last: Run, members: Indices | None, probabilities: Probabilities) -> Adjustment:
    """Make the result of the last run, whose datum was settled in a given problem.

    members: positions of the coordinates with inner constraints, None without a free datum.
    """
    problem = last.problem
    plain = _cofactor(given, last, members)
    redundancy = _redundancy(last, plain)
    variance = variance_factor(last, redundancy)
    scaled = _scaled_run(last, variance)
    return Adjustment(
        network=given.network,
        termination=last.solution.termination,
        iterations=len(last.solution.history),
        conditions=redundancy + len(last.numbering.free),
        unknowns=len(last.numbering.free),
        redundancy=redundancy,
        vpv=last.vpv,
        variance=variance,
        parameters=problem.unknowns.parameters,
        values=np.where(_meaningless(problem), np.nan, last.end.state.values),
        cofactor=plain if scaled is last else _cofactor(given, scaled, members),
        run=last,
        scaled=scaled,
        probabilities=probabilities,
        singular=last.singular if last.solution.termination == "singular" else (),
        history=last.solution.history,
        mirrored=problem.mirrored,
        weights=last.weighting.weights[: len(last.end.v_mm)],
        variance_factors=last.weighting.factors,
    )


def _scaled_run(last: Run, variance: estimates.VarianceFactor) -> Run:
    """Divide the standard deviations of the given values excluded from sigma0 by sigma0."""
    # sigma0 times their cofactors then gives their standard deviations as given.
    if not len(variance.positions):
        return last
    unknowns = last.numbering.problem.unknowns
    sigma = unknowns.sigma.copy()
    sigma[variance.positions] /= variance.sigma0
    numbering = Numbering(replace(last.numbering.problem, unknowns=replace(unknowns, sigma=sigma)))
    end = replace(last.end, rows=replace(last.end.rows, numbering=numbering), factor_nearby=None)
    return replace(last, solution=replace(last.solution, end=end))


def _meaningless(problem: Problem) -> Mask:
    """(n,) mask of quantities without a given value that no observation determines, since no object point is seen."""
    network, unknowns = problem.network, problem.unknowns
    meaningless = np.zeros(len(unknowns), dtype=bool)
    for name in network.unoriented:
        meaningless[unknowns.exterior[name]] = True
    for name in network.idle_cameras & unknowns.camera.keys():
        camera = network.camera_by_name[name]
        given = (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm)
        meaningless[unknowns.camera[name][:3]] = [prior is None for prior in given]
    return meaningless


def _redundancy(run: Run, cofactor: estimates.Cofactor) -> int:
    """Equations minus unknowns, without equations removed and with rank defects held by pseudo-observations."""
    problem = run.problem
    further = sum(len(each.observed) for each in problem.further)
    held = held_directions(problem, cofactor.variances) if problem.pseudo_observed else 0
    return int(run.units.sizes[run.weighting.used].sum()) + further + held - len(run.numbering.free)


def adjust_problem(
    problem: Problem,
    options: Options,
    held: Iterable[int] = (),
    doubted: Collection[int] = (),
    mismatched: Mapping[int, tuple[int, ...]] | None = None,
) -> Adjustment:
    """Adjust a network whose quantities are numbered.

    held: positions of quantities that stay at their start. doubted: positions of quantities whose given values are left
    out at first; mismatched: rows of observations that are left out unless they agree with the rest (see `run`).
    """
    members = datum.chosen_points(problem, options.datum_points)
    solved = settle_datum(problem, options)
    solution = run(replace(solved, unknowns=solved.unknowns.fixed(held)), options, doubted, mismatched or {})
    if options.datum == "free":
        solution = _center_datum(problem, solution, members, options)
    return _result(problem, solution, members if options.datum == "free" else None, options.probabilities)


def settle_datum(problem: Problem, options: Options) -> Problem:
    """Fix a minimal datum in a problem, unless the given values are to define the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(datum.chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        chosen = datum.minimal_datum(problem)
        start = datum.center_datum(problem, problem.start(), chosen).values
        unknowns = replace(unknowns, start=start).fixed_as_given(chosen)
    settled = replace(problem, unknowns=unknowns)
    is_bent = not problem.network.line_of_sight.is_straight
    if is_bent and datum.object_datum(settled, settled.start()).free.shape[1] > 0:
        # Bent lines of sight would determine the datum, but hardly.
        return replace(settled, network=replace(problem.network, line_of_sight=STRAIGHT))
    return settled


def _center_datum(problem: Problem, last: Run, members: Indices, options: Options) -> Run:
    """Transform a run with minimal datum to inner constraints over some coordinates; unchanged where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are free to first order only: the network
    is adjusted again after each transformation.
    """
    if not _is_fixed(problem, last):
        return last
    extent = datum.object_datum(problem, last.end.state).extent
    for _ in range(datum.CENTERINGS):
        if not last.converged:
            return last
        state, before = datum.center_datum(problem, last.end.state, members), last
        if np.abs(state.values - before.end.state.values)[members].max(initial=0.0) <= datum.EXACT * extent:
            break
        last = again(before, before.weighting, options.iteration_limit, state)
        history = before.solution.history + last.solution.history
        last = replace(last, settled=before.settled, solution=replace(last.solution, history=history))
    return last
