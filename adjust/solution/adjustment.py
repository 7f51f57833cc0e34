"""Simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9)."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Indices
from adjust.errors import AdjustmentError, DatumError, NoImageError, UnorientedError
from adjust.initial_values.approximations import initial_values
from adjust.least_squares.malloc_tuning import keep_freed_memory, pause_cycle_search
from adjust.problem.network import STRAIGHT, Approximations, Network
from adjust.problem.problem import Problem, number
from adjust.problem.unknowns import Reduction
from adjust.quality.run import Run
from adjust.rank_defect.datum import (
    CENTERINGS,
    EXACT,
    centered,
    chosen_coordinates,
    chosen_points,
    held_as_known,
    minimal_datum,
    object_datum,
)
from adjust.solution.blunder_hypotheses import Trials, blunder_sentence, stations_elsewhere
from adjust.solution.coordinate_blunders import FarPoint, coordinate_slips, far_points, few_points, free_points
from adjust.solution.left_out_images import adopt_lens, contradicting_image, fitting, leave_out, misnumbered_images
from adjust.solution.options import Datum, Method, Options
from adjust.solution.plausibility import check_plausibility
from adjust.solution.result import Adjustment, is_fixed, run_result
from adjust.solution.reweighting import again, run
from adjust.validation import validate

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_problem", "settle_datum"]


GUESSED = 0.1  # relative standard deviation of a principal distance above which the value is a guess
TRIAL_STEPS = 6  # iterations of a trial adjustment, enough to test v'Pv, which decreases with each


def adjust(
    network: Network, approximations: Approximations | None = None, options: Options | None = None
) -> Adjustment:
    """Adjust a network by least squares, all unknowns simultaneously.

    The combined model A v + B dx = w is relinearised at the adjusted observations and unknowns until convergence
    (Torlegård, equations F1 to F9). Object coordinates are reduced to the centre of the field. The cofactor matrix
    covers all unknowns; only quantities with a standard deviation of 0 are held fixed. A singular network gives a
    result with its null directions, not an error: its values are the approximations, its cofactor matrix is zero and
    has no meaning.

    Parameters
    ----------
    network : cameras, images, object points and observations with their priors.
    approximations : initial values. By default, and where the iteration does not converge from those given, they are
        computed from the network itself.
    options : datum, weighting, method and tests.

    Returns
    -------
    Adjustment
        Images without an orientation are left out, and so are those in which some point has no image at the start, or
        which keep the iteration from converging; all are tried again once the lens is known (`Adjustment.left_out`).
        Given points with coordinate blunders are named where the observations do not agree because of them; robust
        estimation and data snooping start without these points.

    Raises
    ------
    AdjustmentError
        If the network is empty or contradictory, the approximations put a point where it has no image, the chosen datum
        does not determine the object space, or a blunder of the whole network explains contradictions everywhere (see
        `blunder_sentence`).
    """
    keep_freed_memory()
    with pause_cycle_search():
        validate(network)
        solver = _Solver(options or Options())
        if approximations is None:
            result, left_out = solver.leave_out_blind(*solver.orientable(network))
            found = solver.try_again(network, result, left_out) if left_out else result
        else:
            found = solver.check_whole(network, approximations, None)
        return check_plausibility(found, solver.trials)


@dataclass(frozen=True)
class _Solver:
    """Adjust networks with given options."""

    options: Options

    @property
    def trials(self) -> Trials:
        return Trials(lambda network: self.solve_plainly(network, self.own_start(network)), self.family)

    @property
    def family(self) -> float:
        return self.options.probabilities.family

    def initial_values(self, network: Network) -> Approximations:
        return initial_values(held_as_known(network, self.options.datum_coordinates))

    def own_start(self, network: Network) -> Approximations | None:
        """Compute a network's own approximations; None where this fails."""
        try:
            return self.initial_values(network)
        except AdjustmentError:
            return None

    def without(self, network: Network, reasons: Mapping[str, str]) -> tuple[Network, Approximations] | None:
        """Leave out some frames; return the rest with its own approximations, None where too little is left."""
        rest = leave_out(network, reasons) if reasons else None
        start = None if rest is None else self.own_start(rest)
        return None if rest is None or start is None else (rest, start)

    def orientable(self, network: Network) -> tuple[Network, Approximations | None, dict[str, str]]:
        """Leave out the images whose point numbers are off, and those for which no orientation is found.

        Returns the remaining network, its own approximations and the reasons by frame. Approximations are None where
        too little would remain or something else is wrong.
        """
        misnumbered = misnumbered_images(network)
        part = leave_out(network, misnumbered) if misnumbered else network
        if part is None:
            sentences = dict.fromkeys(misnumbered.values())
            raise AdjustmentError(" ".join(f"{each[0].upper()}{each[1:]}" for each in sentences))
        try:
            return part, self.initial_values(part), misnumbered
        except UnorientedError as error:
            rest, reasons = self.without(part, error.reasons), error.reasons
        except AdjustmentError:
            return part, None, misnumbered
        return (part, None, misnumbered) if rest is None else (*rest, misnumbered | reasons)

    def leave_out_blind(
        self, part: Network, start: Approximations | None, left_out: dict[str, str]
    ) -> tuple[Adjustment, dict[str, str]]:
        """Adjust a network without the images that keep it from a solution; also return the reasons.

        These are the images in which some point has no image at the start, and where the iteration does not converge
        the one that contradicts the others most, if it converges without it. Raises NoImageError where too little would
        remain.
        """
        try:
            result = self.check_whole(part, None, start)
        except NoImageError as error:
            if (rest := self.without(part, error.reasons)) is None:
                raise
            return self.leave_out_blind(*rest, left_out | error.reasons)
        reasons = contradicting_image(result) if result.termination not in ("converged", "singular") else {}
        if (rest := self.without(part, reasons)) is None:
            return result, left_out
        without, more = self.leave_out_blind(*rest, left_out | reasons)
        return (without, more) if without.converged else (result, left_out)

    def try_again(self, network: Network, rest: Adjustment, left_out: dict[str, str]) -> Adjustment:
        """Adjust with those left-out images that fit once the lens is known."""
        found = rest
        if rest.converged:
            _, start, reasons = self.orientable(adopt_lens(network, rest))
            came = left_out.keys() - reasons.keys()
            while start is not None and came:
                part = leave_out(network, left_out.keys() - came)
                if part is None:
                    break
                try:
                    tried = self.check_points(part, start)
                    fit = fitting(tried, came, rest.sigma0) if tried.converged else set()
                except NoImageError as error:
                    tried, fit = rest, came - error.reasons.keys()
                if fit == came:
                    found = tried
                    break
                came = fit
        frames = {image.frame for image in found.network.images}
        return replace(found, left_out={name: reason for name, reason in left_out.items() if name not in frames})

    def check_whole(
        self, network: Network, approximations: Approximations | None, own: Approximations | None
    ) -> Adjustment:
        """Adjust a network after a check for blunders of the whole network.

        own: the network's own approximations, where already computed. Raises AdjustmentError where such a blunder
        explains contradictions that the network as given does not.
        """
        weighs_anew = self.options.plain != self.options
        if weighs_anew:  # reweighting would hide a blunder of the whole network in single observations
            own = own or self.own_start(network)
            self._refuse_blunder(network, self.solve_plainly(network, own))
        try:
            result = self.check_points(network, approximations or own or self.initial_values(network))
        except DatumError:  # independent of the observations
            raise
        except AdjustmentError:
            if not weighs_anew:
                self._refuse_blunder(network, None)
            raise
        if result.termination == "singular":
            return result
        if not weighs_anew:
            self._refuse_blunder(network, result)
        elsewhere = stations_elsewhere(network, result)
        return replace(result, remarks=(*result.remarks, elsewhere)) if elsewhere else result

    def _refuse_blunder(self, network: Network, given: Adjustment | None) -> None:
        if slip := blunder_sentence(network, given, self.trials):
            raise AdjustmentError(slip)

    def check_points(self, network: Network, start: Approximations) -> Adjustment:
        """Adjust a network and report given points with coordinate blunders."""
        try:
            result = self._start_robustly(network, start) or self.solve(network, start)
        except NoImageError as error:
            if slips := self._slips(network, start):
                raise AdjustmentError(" ".join(sentence for _, sentence in slips)) from error
            raise
        if result.termination not in ("converged", "singular"):
            result = self._begin_anew(network, start, result)
        if result.termination == "singular" or self._agrees(result):
            return result
        if slips := self._slips(network, start):
            return replace(result, slips=tuple(sentence for _, sentence in slips))
        return result if result.converged else replace(result, remarks=(*result.remarks, *few_points(network)))

    def solve(
        self, network: Network, start: Approximations, doubted_points: Iterable[str] = (), plain: bool = False
    ) -> Adjustment:
        """Adjust a network in coordinates reduced to its centroid; the result is in its own coordinates.

        doubted_points: points whose given coordinates are left out at first. plain: with the weights as given.
        """
        reduction = Reduction.to_centroid(network)
        problem = self._numbered(reduction.network(network), reduction.approximations(start))
        unknowns = problem.unknowns
        doubted = [int(position) for name in doubted_points for position in unknowns.point[name]]
        result = adjust_problem(problem, self.options.plain if plain else self.options, doubted=doubted)
        return replace(result, network=network, values=reduction.unreduced_values(unknowns, result.values, network))

    def solve_plainly(self, network: Network, start: Approximations | None) -> Adjustment | None:
        """Adjust a network in a few steps with the weights as given; None where the adjustment cannot start."""
        if start is None:
            return None
        limit = min(self.options.iteration_limit, TRIAL_STEPS)
        try:
            return _Solver(replace(self.options.plain, iteration_limit=limit)).solve(network, start)
        except AdjustmentError:
            return None

    def _numbered(self, network: Network, start: Approximations) -> Problem:
        return number(network, start, self.options.method == "elements")

    def _agrees(self, result: Adjustment) -> bool:
        """Whether v'Pv agrees with the redundancy (chi-square test)."""
        chance = result.redundancy < 1 or chdtrc(result.redundancy, result.vpv) > self.family
        return result.converged and bool(chance)

    def _start_robustly(self, network: Network, start: Approximations) -> Adjustment | None:
        """Start robust estimation or data snooping without the given points that are blunders."""
        # Returns None without such points or without convergence. From an adjustment that includes a blunder neither
        # method recovers: the linearised equations do not hold for errors so large.
        slips = self._slips(network, start) if self.options.robust or self.options.snooping else []
        if not slips:
            return None
        _, freed = free_points(network, start, [far for far, _ in slips])
        try:
            result = self.solve(network, freed, [far.name for far, _ in slips])
        except NoImageError:
            return None
        return result if result.converged else None

    def _slips(self, network: Network, start: Approximations) -> list[tuple[FarPoint, str]]:
        """Find given points that contradict an adjustment without their coordinates significantly, with sentences."""
        far = far_points(self._numbered(network, start), self.family)
        if not far:
            return []
        try:
            return coordinate_slips(
                network, far, self.solve(*free_points(network, start, far), plain=True), self.options
            )
        except AdjustmentError:  # the adjustment cannot start without these points
            return []

    def _begin_anew(self, network: Network, start: Approximations, stopped: Adjustment) -> Adjustment:
        """Adjust again from the network's own approximations; return `stopped` where these are no better."""
        # The first attempt ignores poorly known principal distances, since images of known points determine them
        # better; the second one uses them.
        cameras = tuple(
            replace(camera, principal_distance_mm=None)
            if (c := camera.principal_distance_mm) is not None and c.sigma > GUESSED * abs(c.value)
            else camera
            for camera in network.cameras
        )
        for known in (cameras, network.cameras) if cameras != network.cameras else (cameras,):
            own = self.own_start(replace(network, cameras=known))
            if own is None or all(
                np.array_equal(own.exterior[name], start.exterior.get(name, [])) for name in own.exterior
            ):
                continue
            result = self.solve(network, own)
            if result.converged:
                warning = (
                    f"From the given approximations the iteration did not converge ({stopped.termination} after "
                    f"{stopped.iterations} steps); it was repeated with approximations found from the network itself."
                    " Check those given."
                )
                return replace(result, remarks=(warning, *result.remarks))
        return stopped


def adjust_problem(
    problem: Problem, options: Options, held: Iterable[int] = (), doubted: Collection[int] = ()
) -> Adjustment:
    """Adjust a network whose quantities are numbered.

    held: positions of quantities that stay at their start. doubted: positions of quantities whose given values are left
    out at first (see `run`).
    """
    members = chosen_points(problem, options.datum_points)
    solved = settle_datum(problem, options)
    solution = run(replace(solved, unknowns=solved.unknowns.fixed(held)), options, doubted)
    if options.datum == "free":
        solution = _center_datum(problem, solution, members, options)
    result = run_result(problem, solution, members if options.datum == "free" else None, options.probabilities)
    return replace(result, network=problem.network)


def settle_datum(problem: Problem, options: Options) -> Problem:
    """Fix a minimal datum in a problem, unless the given values are to define the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        unknowns = unknowns.fixed(minimal_datum(problem))
    settled = replace(problem, unknowns=unknowns)
    is_bent = not problem.network.line_of_sight.is_straight
    if is_bent and object_datum(settled, settled.start()).free.shape[1] > 0:
        # Bent lines of sight would determine the datum, but hardly.
        return replace(settled, network=replace(problem.network, line_of_sight=STRAIGHT))
    return settled


def _center_datum(problem: Problem, last: Run, members: Indices, options: Options) -> Run:
    """Transform a run with minimal datum to inner constraints over some coordinates; unchanged where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are free to first order only: the network
    is adjusted again after each transformation.
    """
    if not is_fixed(problem, last):
        return last
    extent = object_datum(problem, last.end.state).extent
    for _ in range(CENTERINGS):
        if not last.converged:
            return last
        state, before = centered(problem, last.end.state, members), last
        if np.abs(state.values - before.end.state.values)[members].max(initial=0.0) <= EXACT * extent:
            break
        last = again(before, before.weighting, options.iteration_limit, state)
        history = before.solution.history + last.solution.history
        last = replace(last, settled=before.settled, solution=replace(last.solution, history=history))
    return last
