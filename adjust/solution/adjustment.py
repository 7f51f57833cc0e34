"""Simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9).

Blunders of the whole network are refused. Images that keep it from a solution are left out, and so, at the start of
robust methods, are given points whose blunders are too large for coordinates as observations.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from adjust.array_types import Array
from adjust.errors import AdjustmentError, DatumError, NoImageError, UnorientedError
from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import initial_values
from adjust.initial_values.mismatches import Mismatches, find_mismatches, started_rays
from adjust.initial_values.pose import intersect
from adjust.least_squares.malloc_tuning import keep_freed_memory, pause_cycle_search
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.parameter import shortened
from adjust.problem.problem import Problem, number, number_reduced
from adjust.problem.unknowns import Reduction
from adjust.quality.variance_components import added_variance
from adjust.rank_defect.datum import held_as_known
from adjust.solution.blunder_hypotheses import (
    Trials,
    blunder_sentence,
    check_plausibility,
    misnumbered_images,
    stations_elsewhere,
)
from adjust.solution.contradicting_images import (
    adopt_lens,
    fitting,
    is_of_some_frames,
    leave_out,
    leave_out_contradicting,
)
from adjust.solution.options import Datum, Method, Options
from adjust.solution.result import Adjustment, adjust_problem
from adjust.validation import validate

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_unmodelled"]

GUESSED = 0.1  # relative standard deviation of a principal distance above which the value is a guess
TRIAL_STEPS = 6  # iterations of a trial adjustment, enough to test v'Pv, which decreases with each
NAMED = 5  # images named in a message
CLEARER = 3.0  # factor by which errors fall without images that contradict the others
ROUNDS = 6  # two or three suffice: nearly equal weights hardly change the residuals
FIRST = 1e-3  # initial value, fraction of the frame's diagonal: above any lens misfit, below a blunder
PLAUSIBLE = 3e-4  # fraction of the frame's diagonal that lens, board and processing may cause: 1.5 px of 5000 px
SETTLED = 0.01  # relative change of a standard deviation that means convergence
MOST_FAR = 0.25  # fraction of the given points: if more are far off, the correct ones cannot be identified
FEWEST_IMAGES = 2  # images needed for an intersection
ENOUGH = 5  # points needed to identify a wrong one: the resection without it is still redundant


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
            result = solver.adjust_orientable(*solver.orientable(network))
            found = solver.try_again(network, result) if result.left_out else result
        else:
            found = solver.check_whole(network, approximations, None)
        return check_plausibility(found, solver.trials)


def adjust_unmodelled(network: Network, options: Options | None = None) -> Adjustment:
    """Adjust with a standard deviation of unmodelled errors, estimated for each camera.

    It is added in quadrature to those of the camera's targets and tie points, such that their v'Pv equals their
    redundancy (Förstner's condition for a variance component, here an additive one). It is 0 where the given standard
    deviations explain the residuals. The first adjustment allows FIRST of the frame's diagonal, so that blunders of the
    whole network are refused before an error is attributed to unmodelled effects. Images without which errors are
    CLEARER times smaller are left out; an implausibly large one is a warning.

    Parameters
    ----------
    network : marks with their standard deviations from image measurement
    options : of each adjustment

    Returns
    -------
    Adjustment
        With the added standard deviations in `unmodelled_mm`. Raises AdjustmentError as `adjust` does.
    """
    options = options or Options()
    first = _fit_unmodelled(network, options)
    plausible_mm = {each.name: PLAUSIBLE * float(np.hypot(*each.frame_mm)) for each in network.cameras}
    doubtful = [
        name
        for name, limit_mm in plausible_mm.items()
        if limit_mm and (first.unmodelled_mm[name] > limit_mm or is_of_some_frames(first, name))
    ]

    def agrees(result: Adjustment) -> bool:
        return result.converged and all(
            result.unmodelled_mm[name] <= plausible_mm[name]
            and CLEARER * _marks_sigma_mm(result, name) <= _marks_sigma_mm(first, name)
            for name in doubtful
        )

    result = first
    if doubtful:
        refitted = partial(_fit_unmodelled, options=options)
        result = leave_out_contradicting(network, first, refitted, agrees, several=True)
    warnings = (
        f"Camera {name}: errors of {1000.0 * sigma_mm:.3g} µm are not modelled, one part in "
        f"{plausible_mm[name] / PLAUSIBLE / sigma_mm:.0f} of the picture's diagonal. Look for pictures that are "
        "blurred or moved, for a wrong size or count of the board, and whether the lens model suits."
        for name, sigma_mm in result.unmodelled_mm.items()
        if sigma_mm > plausible_mm[name] > 0.0
    )
    return replace(result, remarks=(*result.remarks, *warnings))


def _fit_unmodelled(network: Network, options: Options) -> Adjustment:
    """Adjust a network with standard deviations of unmodelled errors by camera that its residuals confirm."""
    sigma_mm = {each.name: FIRST * float(np.hypot(*each.frame_mm)) for each in network.cameras}
    result = adjust(add_unmodelled(network, sigma_mm), options=options)
    for _ in range(ROUNDS):
        if not result.converged:
            break
        before, sigma_mm = sigma_mm, _components_mm(result, sigma_mm)
        if all(abs(sigma_mm[each] - before[each]) <= SETTLED * sigma_mm[each] for each in sigma_mm):
            break
        result = adjust(add_unmodelled(network, sigma_mm), result.start, options)
    return replace(result, unmodelled_mm=sigma_mm)


def add_unmodelled(network: Network, sigma_mm: Mapping[str, float]) -> Network:
    """Add a standard deviation by camera to the targets and tie points of a network."""
    added = np.array([sigma_mm.get(camera, 0.0) for camera in _cameras(network)]) ** 2
    covariance_mm2 = network.observations.covariance_mm2 + added[:, None, None] * np.eye(2)
    return replace(network, observations=replace(network.observations, covariance_mm2=covariance_mm2))


def _cameras(network: Network) -> NDArray[np.str_]:
    """Camera of every target and tie point; "" for other marks."""
    cameras = np.array([image.camera for image in network.images])[network.image_numbers]
    return np.where(np.isin(network.observations.kind, ("target", "tie")), cameras, "")


def _marks_sigma_mm(result: Adjustment, camera: str) -> float:
    """Rms standard deviation of a camera's marks, given and unmodelled."""
    covariance_mm2 = result.network.observations.covariance_mm2[_cameras(result.network) == camera]
    return float(np.sqrt(np.trace(covariance_mm2, axis1=1, axis2=2).mean() / 2.0))


def _components_mm(result: Adjustment, before_mm: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations by camera with which v'Pv of its marks equals their redundancy, for the current residuals."""
    found, cameras, residuals = dict[str, float](), _cameras(result.network), result.residuals
    variances = np.diagonal(result.network.observations.covariance_mm2, axis1=1, axis2=2)
    for camera, before in before_mm.items():
        rows = cameras == camera
        redundancy = float(residuals.redundancy[rows].sum())
        squares, given = residuals.v_mm[rows] ** 2, variances[rows] - before**2
        added = added_variance(squares, given, redundancy) if redundancy >= 1.0 else None
        found[camera] = float(np.sqrt(added or 0.0))
    return found


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

    def remainder(self, network: Network, reasons: Mapping[str, str]) -> tuple[Network, Approximations] | None:
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
            rest, reasons = self.remainder(part, error.reasons), error.reasons
        except AdjustmentError:
            return part, None, misnumbered
        return (part, None, misnumbered) if rest is None else (*rest, misnumbered | reasons)

    def adjust_orientable(self, part: Network, start: Approximations | None, left_out: Mapping[str, str]) -> Adjustment:
        """Adjust a network without the images that contradict the others, as one may that keeps it from converging.

        left_out: reasons for images left out before.
        """
        first = found = self.adjust_without_blind(part, start)

        def agrees(result: Adjustment) -> bool:
            return result.converged and (not first.converged or self.trials.explains(result))

        def adjusted(rest: Network) -> Adjustment:
            return self.adjust_without_blind(rest, self.initial_values(rest))

        if first.termination != "singular":
            found = leave_out_contradicting(part, first, adjusted, agrees, several=False)
        return replace(found, left_out={**left_out, **found.left_out})

    def adjust_without_blind(self, part: Network, start: Approximations | None) -> Adjustment:
        """Adjust a network without the images in which some point has no image at the start.

        Raises NoImageError where too little would remain.
        """
        try:
            return self.check_whole(part, None, start)
        except NoImageError as error:
            if (rest := self.remainder(part, error.reasons)) is None:
                raise
            found = self.adjust_without_blind(*rest)
            return replace(found, left_out={**error.reasons, **found.left_out})

    def try_again(self, network: Network, rest: Adjustment) -> Adjustment:
        """Adjust with those left-out images that fit once the lens is known."""
        found, left_out = rest, rest.left_out
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
                raise AdjustmentError(" ".join(slip.sentence for slip in slips)) from error
            raise
        if result.termination not in ("converged", "singular"):
            result = self._begin_anew(network, start, result)
        if result.termination == "singular" or (result.converged and self.agrees(result)):
            return result
        if slips := self._slips(network, start):
            return replace(result, slips={slip.name: slip.sentence for slip in slips})
        return result if result.converged else replace(result, remarks=(*result.remarks, *_few_points(network)))

    def solve(
        self, network: Network, start: Approximations, doubted_points: Iterable[str] = (), plain: bool = False
    ) -> Adjustment:
        """Adjust a network without mismatched rays of unknown points, or as it is where that does not converge.

        doubted_points: points whose given coordinates are left out at first. plain: with the weights as given.
        """
        options, doubted = self.options.plain if plain else self.options, list(doubted_points)
        given = numbered = number_reduced(network, start, options.method == "elements")
        found, result = find_mismatches(given[0]), None
        # Orientations that the worst mismatches have not spoilt show the smaller ones, and which rays meet after all.
        for _ in range(ROUNDS):
            places = {name: place + numbered[1].origin for name, place in found.places.items()}
            start, (rest, mismatched) = replace(start, points={**start.points, **places}), _without(network, found)
            parts = number_reduced(rest, start, given[0].by_elements) if places else numbered
            now = _solve(rest, parts, options, doubted, mismatched)
            if not now.converged:
                return result or (_solve(network, given, options, doubted, {}) if places else now)
            result = replace(now, unmet=_unmet_sentences(network, found))
            if not places and self.agrees(result):
                break
            start = replace(result.approximations, points={**start.points, **result.approximations.points})
            numbered, earlier = number_reduced(network, start, given[0].by_elements), found
            if (found := find_mismatches(numbered[0])).agrees(earlier):
                break
        assert result is not None
        return result

    def agrees(self, result: Adjustment) -> bool:
        """Whether v'Pv is not significant."""
        return result.redundancy < 1 or bool(chdtrc(result.redundancy, result.vpv) > self.family)

    def solve_plainly(self, network: Network, start: Approximations | None) -> Adjustment | None:
        """Adjust a network in a few steps with the weights as given; None where the adjustment cannot start."""
        if start is None:
            return None
        limit = min(self.options.iteration_limit, TRIAL_STEPS)
        try:
            return _Solver(replace(self.options.plain, iteration_limit=limit)).solve(network, start)
        except AdjustmentError:
            return None

    def _start_robustly(self, network: Network, start: Approximations) -> Adjustment | None:
        """Start robust estimation or data snooping without the given points that are blunders."""
        # Returns None without such points or without convergence. From an adjustment that includes a blunder neither
        # method recovers: the linearised equations do not hold for errors so large.
        slips = self._slips(network, start) if self.options.robust or self.options.snooping else []
        if not slips:
            return None
        _, freed = _free_points(network, start, slips)
        try:
            result = self.solve(network, freed, [slip.name for slip in slips])
        except NoImageError:
            return None
        return result if result.converged else None

    def _slips(self, network: Network, start: Approximations) -> "list[_FarPoint]":
        """Find given points that contradict an adjustment without their coordinates significantly, with sentences."""
        far = _far_points(number(network, start), self.family)
        if not far:
            return []
        try:
            without = self.solve(*_free_points(network, start, far), plain=True)
            return _coordinate_slips(network, far, without, self.options)
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


def _solve(
    network: Network,
    numbered: tuple[Problem, Reduction],
    options: Options,
    doubted_points: Iterable[str],
    mismatched: Mapping[int, tuple[int, ...]],
) -> Adjustment:
    """Adjust a network that is numbered in reduced coordinates; the result is in its own coordinates."""
    problem, reduction = numbered
    doubted = [int(position) for name in doubted_points for position in problem.unknowns.point[name]]
    result = adjust_problem(problem, options, doubted=doubted, mismatched=mismatched)
    values = reduction.unreduced_values(problem.unknowns, result.values, network)
    return replace(result, network=network, values=values)


def _without(network: Network, mismatches: Mismatches) -> tuple[Network, dict[int, tuple[int, ...]]]:
    """Remove the points whose rays do not meet from a network; also return its doubted rows."""
    out = np.concatenate([np.empty(0, dtype=np.intp), *mismatches.unmet.values()])
    kept = np.setdiff1d(np.arange(len(network.observations)), out)
    doubted = {
        int(np.searchsorted(kept, row)): tuple(np.searchsorted(kept, others).tolist())
        for row, others in mismatches.doubted.items()
    }
    if not len(out):
        return network, doubted
    points = tuple(point for point in network.points if point.id not in mismatches.unmet)
    distances = tuple(each for each in network.distances if not {each.start, each.end} & mismatches.unmet.keys())
    rest = replace(network, points=points, observations=network.observations.only(kept), distances=distances)
    return rest, doubted


class _FarPoint(NamedTuple):
    """Given point whose rays meet elsewhere."""

    name: str  # id of the point
    images: int  # number of images that show it
    place: Array  # (3,) intersection of its rays, in object units
    # median distance in the images of its marks from the projected given coordinates; inf behind the cameras
    miss_mm: float
    others_mm: float  # largest such distance of the other given points
    sentence: str = ""  # where the point contradicts the observations significantly


def _far_points(problem: Problem, family: float) -> list[_FarPoint]:
    """Find given points that miss their marks by far more than all others, farthest first.

    The orientations at the start of the adjustment are used: resections without the distortion, which is not known yet.
    Therefore only a finite variance of the misses of good points is assumed. The largest of many is then more than
    family^(-1/2) times as large as the next (10 times with 0.01) with the probability `family` at most, as holds for a
    tail that falls with the square of the distance (the spacings of Pareto's distribution: B. C. Arnold, Pareto
    Distributions, 1983). All points before the last such gap are far, if their rays meet. Empty where more than
    MOST_FAR of the points are far.
    """
    rays, unknowns, rows = started_rays(problem), problem.unknowns, defaultdict[str, list[int]](list)
    given = {id_: unknowns.given[at] for id_, at in unknowns.point.items() if np.isfinite(unknowns.sigma[at]).all()}
    for row in np.flatnonzero(rays.scale_mm > 0.0).tolist():
        rows[problem.network.observations.point[row]].append(row)
    shown = {name: np.array(rows[name]) for name in sorted(given) if len(rows[name]) >= FEWEST_IMAGES}
    if not shown:
        return []
    miss = {name: float(np.median(rays.misses_mm(own, given[name]))) for name, own in shown.items()}
    falling = sorted(miss, key=lambda name: (-miss[name], name))
    limits = [max(miss[name], rays.sigma_mm) / np.sqrt(family) for name in falling]  # for the points before each
    gaps = [k for k in range(1, int(MOST_FAR * len(falling)) + 1) if miss[falling[k - 1]] > limits[k]]
    found = []
    for name in falling[: gaps[-1]] if gaps else ():
        own = shown[name]
        numbers = np.zeros(len(own), dtype=np.intp)
        (place,), _ = intersect(rays.centers[own], rays.directions[own], numbers, np.full((1, 3), np.nan))
        if (rays.misses_mm(own, place) < limits[gaps[-1]]).all():
            found.append(_FarPoint(name, len(own), place, miss[name], miss[falling[gaps[-1]]]))
    return found


def _free_points(network: Network, start: Approximations, far: Sequence[_FarPoint]) -> tuple[Network, Approximations]:
    """Remove the priors of far points from a network; start them where their rays meet."""
    places = {each.name: each.place for each in far}

    def freed(point: ObjectPoint) -> ObjectPoint:
        return ObjectPoint(point.id, *(Prior(each.value, np.inf) for each in point.priors if each))

    points = tuple(freed(point) if point.id in places else point for point in network.points)
    return replace(network, points=points), replace(start, points={**start.points, **places})


def _coordinate_slips(
    network: Network, far: Sequence[_FarPoint], without: Adjustment, options: Options
) -> list[_FarPoint]:
    """Select the far points that contradict an adjustment `without` their coordinates significantly, with sentences.

    The quadratic form of the difference between given and adjusted coordinates is chi-square with 3 degrees of freedom.
    The critical value holds for the maximum over all given points at the level `family`, and is multiplied by sigma0²
    where that is larger than 1. Empty where that adjustment has no solution.
    """
    given, scale = network.known_places, max(without.sigma0, 1.0)
    critical = float(options.probabilities.critical(np.array([3]), len(given))[0]) * scale**2
    found = []
    for each in far if without.converged else ():
        at, point = without.run.problem.unknowns.point[each.name], network.point_by_id[each.name]
        place, cofactor = without.values[at], without.cofactor.part(at)
        variances = [prior.sigma**2 for prior in point.priors if prior]
        weight: Array = np.asarray(np.linalg.inv(cofactor + np.diag(variances)), dtype=np.float64)

        def passes(xyz: Array, place: Array = place, weight: Array = weight) -> bool:
            return bool((xyz - place) @ weight @ (xyz - place) <= critical)

        if not passes(given[each.name]):
            sigma = scale * float(np.sqrt(np.diag(cofactor).max()))
            found.append(each._replace(sentence=_sentence(each, place, sigma, given, passes)))
    return found


def _sentence(
    far: _FarPoint, place: Array, sigma: float, given: Mapping[str, Array], passes: Callable[[Array], bool]
) -> str:
    """Describe a blunder by the point's place (3,) without its given coordinates, and their difference from it."""
    own = given[far.name]
    off, digits = own - place, max(0, 1 - int(np.floor(np.log10(sigma))))
    at = ", ".join(f"{axis} = {value:.{digits}f}" for axis, value in zip("XYZ", place, strict=True))
    by = ", ".join(f"{axis} by {value:+.{digits}f}" for axis, value in zip("XYZ", off, strict=True))
    missed = f"{far.miss_mm:.3g} mm from its marks" if np.isfinite(far.miss_mm) else "behind the camera"
    # Clerical errors that explain the coordinates; told where there is exactly one.
    readings = [
        (own[[j if k == i else i if k == j else k for k in range(3)]], f"{'XYZ'[i]} and {'XYZ'[j]} look exchanged.")
        for i, j in combinations(range(3), 2)
    ]
    readings += [(own * (1.0 - 2.0 * np.eye(3)[i]), f"The sign of {'XYZ'[i]} looks wrong.") for i in range(3)]
    readings += [(xyz, f"It lies where point {id_} is given.") for id_, xyz in given.items() if id_ != far.name]
    causes = [cause for xyz, cause in readings if passes(xyz)]
    guess = f" {causes[0]}" if len(causes) == 1 else ""
    return (
        f"Control point {far.name} is not where it is given: its rays from {far.images} images meet at {at}, "
        f"{np.linalg.norm(off):.{digits}f} away ({by}). What is given lies {missed} in the images, every other given "
        f"point within {far.others_mm:.2g} mm.{guess} Correct its coordinates, or its number among the marks; with "
        f"snooping = true the adjustment does without them."
    )


def _unmet_sentences(network: Network, mismatches: Mismatches) -> dict[str, str]:
    """Describe the points whose rays do not meet, by point."""
    images, sentences = network.observations.image, dict[str, str]()
    for name, rows in mismatches.unmet.items():
        where = shortened([images[row] for row in rows], NAMED)
        sentences[name] = (
            f"No two rays of point {name} meet, from the images {where}: the point is left out. Check its number there."
        )
    return sentences


def _few_points(network: Network) -> list[str]:
    """Remark on an adjustment without a solution where too few points are given to check each other."""
    named = sorted(name for name in network.known_places if name in network.observed_points)
    if len(named) != ENOUGH - 1:
        return []
    return [
        f"The points {', '.join(named)} alone are given in X, Y and Z: if the coordinates of one of the {len(named)} "
        f"are wrong, nothing tells which. Check all of them, or give another point."
    ]
