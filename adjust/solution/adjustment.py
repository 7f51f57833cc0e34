"""The simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9)."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Indices
from adjust.errors import AdjustmentError, DatumError, NoImageError, UnorientedError
from adjust.initial_values.approximations import initial_values
from adjust.least_squares.malloc_tuning import keep_freed_memory, pause_cycle_search
from adjust.problem.network import STRAIGHT, Approximations, Network
from adjust.problem.problem import Problem, number
from adjust.problem.reduction import Reduction
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
from adjust.solution.blunder_hypotheses import blunder_sentence, stations_elsewhere
from adjust.solution.coordinate_blunders import Slip, coordinate_slips, far_points, few_points, free_points
from adjust.solution.left_out_images import adopt_lens, fitting, leave_out
from adjust.solution.network_hypotheses import Trials
from adjust.solution.options import Datum, Method, Options
from adjust.solution.plausibility import check_plausibility
from adjust.solution.result import Adjustment, is_fixed, run_result
from adjust.solution.reweighting import again, run
from adjust.validation import validate

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_problem", "settle_datum"]


GUESSED = 0.1  # standard deviation of a principal distance, over it, from which on it is a guess
TRIAL_STEPS = 6  # of an adjustment that only has to show whether the observations agree: v'Pv falls with every one


def adjust(
    network: Network, approximations: Approximations | None = None, options: Options | None = None
) -> Adjustment:
    """Adjust a network by least squares, all unknowns together.

    The combined model A v + B dx = w is relinearised at the adjusted observations and unknowns until both stand still
    (Torlegård, equations F1 to F9); object coordinates count from the middle of the field. The cofactor matrix is that
    of all unknowns, nothing held fixed but what a standard deviation of 0 fixes. A singular network is a result with
    its null directions, not an error: its values are the approximations, its cofactor matrix is zero and means nothing.
    Where no approximations are given, or the iteration does not come to rest from them, it begins with those found from
    the network itself. Given points that are far off are named where the observations do not agree for them; robust
    estimation and data snooping begin without them. Images for which no orientation is found are left out, and tried
    again once the lens is known (`Adjustment.left_out`); so are those in which some point has no image to begin with.

    Raises AdjustmentError where the network is empty or contradictory, where the approximations put a point where it
    has no image, where the chosen datum does not hold the object space, or where a slip that concerns the whole network
    explains what else contradicts itself everywhere (see `blunder_sentence`).
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
    """Adjusts networks with some options."""

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
        """A network's own approximations; None where it has none."""
        try:
            return self.initial_values(network)
        except AdjustmentError:
            return None

    def orientable(self, network: Network) -> tuple[Network, Approximations | None, dict[str, str]]:
        """The network without the images for which no orientation is found, its own approximations, and why these are
        left out. The whole network without approximations where too little would be left, or something else is wrong.
        """
        try:
            return network, self.initial_values(network), {}
        except UnorientedError as error:
            part, reasons = leave_out(network, error.reasons), error.reasons
        except AdjustmentError:
            return network, None, {}
        start = None if part is None else self.own_start(part)
        return (network, None, {}) if part is None or start is None else (part, start, reasons)

    def leave_out_blind(
        self, part: Network, start: Approximations | None, left_out: dict[str, str]
    ) -> tuple[Adjustment, dict[str, str]]:
        """The adjustment of a network without those images, too, in which some point has no image to begin with, and
        why images are left out. Raises NoImageError where too little would be left."""
        try:
            return self.check_whole(part, None, start), left_out
        except NoImageError as error:
            rest = leave_out(part, error.reasons) if error.reasons else None
            begun = None if rest is None else self.own_start(rest)
            if rest is None or begun is None:
                raise
            reasons = error.reasons
        return self.leave_out_blind(rest, begun, left_out | reasons)

    def try_again(self, network: Network, rest: Adjustment, left_out: dict[str, str]) -> Adjustment:
        """The adjustment with those images that were left out and that fit once the lens is known."""
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
        """The adjustment of a network that is free of slips of the whole; own: its own approximations, where these are
        known already. Raises AdjustmentError where such a slip explains what the network as it is given does not.
        """
        weighs_anew = self.options.plain != self.options
        if weighs_anew:  # what is wrong with all would be weighed away here and there
            own = own or self.own_start(network)
            self._refuse_blunder(network, self.solve_plainly(network, own))
        try:
            result = self.check_points(network, approximations or own or self.initial_values(network))
        except DatumError:  # whatever the observations say
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
        """The adjustment, and what is to be said of single given points."""
        try:
            result = self._start_robustly(network, start) or self.solve(network, start)
        except NoImageError as error:
            if slips := self._slips(network, start):
                raise AdjustmentError(" ".join(slip.sentence for slip in slips)) from error
            raise
        if result.termination not in ("converged", "singular"):
            result = self._begin_anew(network, start, result)
        if result.termination == "singular" or self._agrees(result):
            return result
        if slips := self._slips(network, start):
            return replace(result, slips=tuple(slip.sentence for slip in slips))
        return result if result.converged else replace(result, remarks=(*result.remarks, *few_points(network)))

    def solve(
        self, network: Network, start: Approximations, doubted_points: Iterable[str] = (), plain: bool = False
    ) -> Adjustment:
        """A network adjusted about its centroid, in its own coordinates; without the given places of some points to
        begin with.
        """
        reduction = Reduction.to_centroid(network)
        problem = self._numbered(reduction.network(network), reduction.approximations(start))
        unknowns = problem.unknowns
        doubted = [int(position) for name in doubted_points for position in unknowns.point[name]]
        result = adjust_problem(problem, self.options.plain if plain else self.options, doubted=doubted)
        return replace(result, network=network, values=reduction.unreduced_values(unknowns, result.values, network))

    def solve_plainly(self, network: Network, start: Approximations | None) -> Adjustment | None:
        """A network adjusted in a few steps with the weights as they are given; None where it cannot begin."""
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
        """Whether chance alone explains v'Pv."""
        chance = result.redundancy < 1 or chdtrc(result.redundancy, result.vpv) > self.family
        return result.converged and bool(chance)

    def _start_robustly(self, network: Network, start: Approximations) -> Adjustment | None:
        """Robust estimation or data snooping that begins without the given points that are slips; None without any, or
        where it comes to no end.

        From an adjustment with a slip in it neither finds back: its linear equations say nothing of errors so large.
        """
        slips = self._slips(network, start) if self.options.robust or self.options.snooping else []
        if not slips:
            return None
        _, freed = free_points(network, start, [slip.far for slip in slips])
        try:
            result = self.solve(network, freed, [slip.far.name for slip in slips])
        except NoImageError:
            return None
        return result if result.converged else None

    def _slips(self, network: Network, start: Approximations) -> list[Slip]:
        """The given points that contradict, beyond chance, an adjustment that knows nothing of their coordinates."""
        far = far_points(self._numbered(network, start), self.family)
        if not far:
            return []
        try:
            return coordinate_slips(
                network, far, self.solve(*free_points(network, start, far), plain=True), self.options
            )
        except AdjustmentError:  # without these points it cannot even begin
            return []

    def _begin_anew(self, network: Network, start: Approximations, stopped: Adjustment) -> Adjustment:
        """The adjustment from the network's own approximations, without principal distances of which so little is known
        that images of known points tell more, then with them; what is there already where these are no better."""
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
    """The same with a network whose quantities are numbered; those at the positions `held` stay where they start, the
    given values of those `doubted` are left out to begin with (see `run`).
    """
    members = chosen_points(problem, options.datum_points)
    solved = settle_datum(problem, options)
    solution = run(replace(solved, unknowns=solved.unknowns.fixed(held)), options, doubted)
    if options.datum == "free":
        solution = _center_datum(problem, solution, members, options)
    result = run_result(problem, solution, members if options.datum == "free" else None, options.probabilities)
    return replace(result, network=problem.network)


def settle_datum(problem: Problem, options: Options) -> Problem:
    """The problem that is solved: with a minimal datum held fixed, unless what is given is to be the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        unknowns = unknowns.fixed(minimal_datum(problem))
    return _straighten_sight(replace(problem, unknowns=unknowns))


def _straighten_sight(problem: Problem) -> Problem:
    """Straight lines of sight where the datum is lacking: bent ones would hold it, but by next to nothing."""
    bent = not problem.network.line_of_sight.is_straight
    if bent and object_datum(problem, problem.start()).free.shape[1] > 0:
        return replace(problem, network=replace(problem.network, line_of_sight=STRAIGHT))
    return problem


def _center_datum(problem: Problem, last: Run, members: Indices, options: Options) -> Run:
    """A run with minimal datum, brought to inner constraints over some coordinates; as it is where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are so to the first order alone: after
    each the network is adjusted again.
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
