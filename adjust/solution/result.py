"""The result of an adjustment: estimates, residuals and their tests, messages; each computed where it is asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import Any, Literal

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.display.camera_plots import CameraPlots, PlottedResult, adjusted_camera_plots
from adjust.display.tables import data_frame, parameter_columns, residual_columns
from adjust.least_squares.iteration import Iteration, factorise
from adjust.least_squares.numbering import Numbering
from adjust.problem.camera import Camera
from adjust.problem.estimates import Cofactor, Estimates, NullDirection, VarianceFactor
from adjust.problem.parameter import Parameter
from adjust.problem.probabilities import Probabilities
from adjust.problem.problem import Problem
from adjust.quality.cofactor import NoCofactor, free_cofactor, inner_cofactor
from adjust.quality.contradiction import CalibrationTest, calibration_tests
from adjust.quality.correlation import Correlation, correlations
from adjust.quality.image_clusters import MOST_SHARED, cluster_covariance, prediction_errors, shared_positions
from adjust.quality.lens_reach import LensReach, lens_reach
from adjust.quality.projection_uncertainty import ProjectionUncertainty, only_camera, projection_uncertainty
from adjust.quality.reliability import Reliability, reliability
from adjust.quality.residuals import FurtherResidual, Group, Residuals, further_residuals, groups, residuals
from adjust.quality.run import Run
from adjust.quality.significance import SignificanceTest, significance_tests
from adjust.quality.snooping import Snooping, Suspect
from adjust.quality.variance_components import factor_sigmas
from adjust.quality.variance_factor import variance_factor
from adjust.rank_defect.flat_valleys import held_directions, inseparable
from adjust.solution.explanations import Explained, Explanation, explain
from adjust.solution.warnings import run_warnings


@dataclass(frozen=True, repr=False)
class Adjustment(Estimates, PlottedResult):
    """An adjusted network and what its observations say of it.

    run: the last adjustment, in reduced coordinates; scaled: the same with the priors that the cofactor matrix has.
    weights (n,): the factors that robust estimation left on the weights of the observations, 1 without it.
    variance_factors: the factors found for the variances of groups, where asked for.
    remarks: on how the adjustment came about, the first of the warnings.
    slips: sentences on given points so far off that the observations do not agree, or have no solution, for them.
    left_out: by name, the images for which no orientation was found, and why; the network is that of the others.
    misread: sentences on images that are mirrored; what else there seems to be is theirs.
    unused: notes on what was given and has no part, the first of the notes.
    unmodelled_mm: by camera, the standard deviation of what is not modelled, where it was estimated.
    """

    run: Run
    scaled: Run
    probabilities: Probabilities
    iterations: int
    conditions: int
    unknowns: int
    redundancy: int
    vpv: float
    singular: tuple[NullDirection, ...]
    history: tuple[Iteration, ...]
    weights: Array = field(default_factory=lambda: np.empty(0))
    variance_factors: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    slips: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    misread: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    unmodelled_mm: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def residuals(self) -> Residuals:
        return residuals(self.run)

    @cached_property
    def groups(self) -> Mapping[str, Group]:
        """The kinds of observations, with their share of v'Pv."""
        return groups(self.run, self.further)

    @cached_property
    def further(self) -> tuple[FurtherResidual, ...]:
        """The residuals of distances and the like."""
        return tuple(further_residuals(self.run, self.probabilities.noncentrality(1)))

    @cached_property
    def contradictions(self) -> tuple[CalibrationTest, ...]:
        """What the images say against earlier calibrations as wholes."""
        if not self.run.has_solution:
            return ()
        return tuple(calibration_tests(self.run, self.variance.sigma0, self.variance.redundancy))

    @cached_property
    def variance_sigmas(self) -> Mapping[str, float]:
        """The standard deviations of the variance factors."""
        has_factors = self._is_tested and self.run.weighting.factors
        return factor_sigmas(self.run) if has_factors else {}

    @cached_property
    def reliability(self) -> Reliability | None:
        """Baarda's inner and outer reliability; None where there is no solution."""
        return _reliability(self.run, self.variance, self.probabilities) if self._is_tested else None

    @cached_property
    def correlations(self) -> tuple[Correlation, ...]:
        """High correlations of cameras' parameters, the highest first."""
        return correlations(self)

    @cached_property
    def significance(self) -> Mapping[tuple[str, str], tuple[SignificanceTest, ...]]:
        """Tests by kind ("interior", "scanner", "board") and owner, of single parameters, then of groups."""
        return significance_tests(self)

    def cluster_covariance_of(self, parameters: Sequence[Parameter]) -> Array | None:
        """The covariance (k, k) of quantities of cameras or boards, by leaving out one image at a time.

        It holds where errors within an image are correlated; what is fixed has zeros. None without a solution and where
        images are too few (`adjust.quality.image_clusters`).
        """
        run, at = self.scaled, shared_positions(self.scaled.numbering)
        if not self.converged or len(at) > MOST_SHARED:
            return None
        found = cluster_covariance(run.numbering, run.end, self.cofactor.part(at))
        if found is None:
            return None
        place = {int(position): number for number, position in enumerate(at)}
        numbers = [place.get(self.index(each), len(at)) for each in parameters]
        return np.pad(found, (0, 1))[np.ix_(numbers, numbers)]

    def prediction_errors(self, folds: int) -> Array | None:
        """The mean square (m,) of the lengths of each image's residuals, over their standard deviations, where every so
        many images are left out in turn (`adjust.quality.image_clusters`); None without a solution."""
        run, at = self.scaled, shared_positions(self.scaled.numbering)
        if not self.converged or len(at) > MOST_SHARED:
            return None
        return prediction_errors(run.numbering, run.end, self.cofactor.part(at), folds)

    def lens_reach(self, camera: Camera, frame_mm: tuple[float, float] | None = None) -> LensReach | None:
        """How far out the lens of a camera is known; None without a solution or without targets.

        Parameters
        ----------
        camera : of the network
        frame_mm : width and height of the picture in mm, None where they are not known
        """
        has_lens = self.converged and camera.name not in self.network.idle_cameras
        return lens_reach(self, camera, frame_mm) if has_lens else None

    def projection_uncertainty(
        self, camera: str = "", distance: float = np.inf, places_mm: Array | None = None
    ) -> ProjectionUncertainty:
        """Standard deviations of the images of points that stand fixed in the scene.

        Parameters
        ----------
        camera : its name; may be left out where there is one
        distance : of the points from the camera, in object units; by default they are infinitely far
        places_mm : (..., 2) where they are seen, in the camera frame; by default a grid over the picture

        Returns
        -------
        ProjectionUncertainty
            See docs/method/reliability.md for what is taken out of it.

        Raises
        ------
        AdjustmentError
            Without a solution, for a camera that there is not, or one that shows no target.
        """
        return projection_uncertainty(self, self.cluster_covariance_of, camera, distance, places_mm)

    def plots(self, camera: str = "", pixel_mm: float | None = None) -> CameraPlots:
        """What the plots of a camera show.

        Parameters
        ----------
        camera : its name; may be left out where there is one
        pixel_mm : side of a pixel of a digital camera; plots are then in px

        Raises
        ------
        AdjustmentError
            Without a solution, or for a camera that there is not.
        """
        shown = only_camera(self, camera)

        def uncertainty(distance: float) -> tuple[Array, Array]:
            found = self.projection_uncertainty(shown.name, distance)
            return found.places_mm, found.sigma_mm

        return adjusted_camera_plots(self, shown, self.residuals.v_mm, uncertainty, pixel_mm)

    def to_pandas(self, table: Literal["parameters", "residuals"] = "parameters") -> Any:
        """A table as pandas.DataFrame: one row a quantity, or one row an observation.

        Raises
        ------
        ImportError
            Where pandas is not installed.
        """
        if table == "residuals":
            return data_frame(residual_columns(self.network.observations, self.residuals))
        return data_frame(parameter_columns(self))

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """What contradicts the others, the worst first: beside what explains the residuals of all."""
        if self.misread or not self._is_tested:
            return ()
        run, variance, tested = self._explanation_run.run, self.variance, self.reliability
        if run is not self.run:
            variance = variance_factor(run, _redundancy(run, self.cofactor))
            tested = _reliability(run, variance, self.probabilities)
        return Snooping(run, self.probabilities).suspects(tested, round(variance.redundancy)) if tested else ()

    @cached_property
    def explanations(self) -> tuple[Explanation, ...]:
        """Of a sigma0 that is too large; suspects are then those of an adjustment with them in the model."""
        return () if self.misread else self._explanation_run.explanations

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What the user should look at; where slips kept it from a solution, all else there seems to be is theirs."""
        left_out = (f"Left out of the adjustment: {reason}" for reason in self.left_out.values())
        own = () if self.slips and not self.converged else run_warnings(self.scaled, self.cofactor, self.residuals)
        return (*self.misread, *self.slips, *left_out, *self.remarks, *own)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What is worth knowing and needs no action."""
        run = self.run
        found = inseparable(run.problem, run.end.state, self.cofactor.variances) if run.converged else ()
        return (*self.unused, *found)

    @cached_property
    def _explanation_run(self) -> Explained:
        return explain(self.run, _redundancy(self.run, self.cofactor), self.probabilities)

    @property
    def _is_tested(self) -> bool:
        return self.run.has_solution and self.run.is_tested

    def __repr__(self) -> str:
        return (
            f"Adjustment({self.termination} after {self.iterations} iterations: {self.conditions} conditions, "
            f"{self.unknowns} unknowns, redundancy {self.redundancy}, sigma0 {self.sigma0:.3f})"
        )

    def _repr_html_(self) -> str:
        """The cameras' parameters, as a notebook shows them."""
        rows = "".join(
            f"<tr><td>{escape(each.label)}</td><td>{self.value(each):.7g}</td><td>{self.sigma(each):.2g}</td></tr>"
            for each in self.parameters
            if each.kind == "interior"
        )
        head = "<tr><th>parameter</th><th>value</th><th>sigma</th></tr>"
        return f"<p>{escape(repr(self))}</p><table>{head}{rows}</table>"


def is_fixed(problem: Problem, last: Run) -> bool:
    """Whether a datum was held fixed in a run of a problem."""
    return bool((last.problem.unknowns.sigma != problem.unknowns.sigma).any())


def _cofactor(problem: Problem, last: Run, members: Indices | None) -> Cofactor:
    """The cofactor matrix in the datum of a run, or over the coordinates that carry inner constraints."""
    state, factor = last.end.state, last.solution.factor
    if factor is None:
        return NoCofactor(len(problem.unknowns))
    if members is None or not (last.converged and is_fixed(problem, last)):
        return free_cofactor(last.numbering, state, factor)
    return inner_cofactor(problem, last.numbering, state, factor, members)


def run_result(given: Problem, last: Run, members: Indices | None, probabilities: Probabilities) -> Adjustment:
    """The result of the last run.

    Parameters
    ----------
    given : the problem before its datum was settled
    last : the run, in that datum
    members : positions of the coordinates that carry inner constraints, None without a free datum
    probabilities : of the tests
    """
    problem = last.problem
    plain = _cofactor(given, last, members)
    redundancy = _redundancy(last, plain)
    variance = variance_factor(last, redundancy)
    scaled = _scaled_run(last, variance)
    return Adjustment(
        network=problem.network,
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


def _scaled_run(last: Run, variance: VarianceFactor) -> Run:
    """The run with such standard deviations of the given values that sigma0 leaves out that sigma0 times the cofactors
    leaves them as they were given."""
    if not len(variance.positions):
        return last
    unknowns = last.numbering.problem.unknowns
    sigma = unknowns.sigma.copy()
    sigma[variance.positions] /= variance.sigma0
    numbering = Numbering(replace(last.numbering.problem, unknowns=replace(unknowns, sigma=sigma)))
    factor = factorise(numbering, last.end)
    return replace(last, numbering=numbering, solution=replace(last.solution, factor=factor), factor=factor)


def _meaningless(problem: Problem) -> Mask:
    """The quantities (n,) that nothing is given of and that nothing tells, for no object point is seen."""
    network, unknowns = problem.network, problem.unknowns
    meaningless = np.zeros(len(unknowns), dtype=bool)
    for name in network.unoriented:
        meaningless[unknowns.exterior[name]] = True
    for name in network.idle_cameras & unknowns.camera.keys():
        camera = network.camera_by_name[name]
        given = (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm)
        meaningless[unknowns.camera[name][:3]] = [prior is None for prior in given]
    return meaningless


def _redundancy(run: Run, cofactor: Cofactor) -> int:
    """Equations, without what the adjustment does without and with what pseudo-observations determine, less
    unknowns."""
    problem = run.problem
    further = sum(len(each.observed) for each in problem.further)
    held = held_directions(problem, cofactor.variances) if problem.pseudo_observed else 0
    return int(run.units.sizes[run.weighting.used].sum()) + further + held - len(run.numbering.free)


def _reliability(run: Run, variance: VarianceFactor, probabilities: Probabilities) -> Reliability:
    return reliability(run, variance.sigma0, round(variance.redundancy), probabilities)
