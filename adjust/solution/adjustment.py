"""Simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9).

Blunders of the whole network are refused. Images that keep it from a solution, or contradict the others, are left out,
and so, at the start of robust methods, are given points whose blunders are too large for coordinates as observations.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adjust.errors import AdjustmentError, DatumError, NoImageError, UnorientedError
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import marks_needed
from adjust.initial_values.approximations import initial_values
from adjust.initial_values.mismatches import Mismatches, find_mismatches
from adjust.least_squares.malloc_tuning import keep_freed_memory, pause_cycle_search
from adjust.problem.network import Approximations, Network
from adjust.problem.parameter import Parameter, shortened
from adjust.problem.problem import Problem, number_reduced
from adjust.problem.unknowns import Reduction
from adjust.quality.variance_components import added_variance
from adjust.rank_defect.datum import held_as_known
from adjust.solution.blunder_hypotheses import Trials, blunder_sentence, frame_cause
from adjust.solution.coordinate_blunders import CoordinateBlunder, find_coordinate_blunders
from adjust.solution.given_orientations import orientations_elsewhere, unlike_approximations
from adjust.solution.options import Datum, Method, Options
from adjust.solution.plausibility import check_plausibility
from adjust.solution.result import Adjustment, adjust_problem
from adjust.solution.reweighting import snoop
from adjust.solution.wrong_names import exchanged_fiducials, misnumbered_images
from adjust.validation import largest_sigma_mm, validate

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_unmodelled"]

GUESSED = 0.1  # relative standard deviation of a principal distance above which the value is a guess
TRIAL_STEPS = 12  # iterations of a trial adjustment; with a free lens v'Pv agrees with the given sigmas after some 8
NAMED = 5  # images named in a message
ROUNDS = 6  # two or three suffice: nearly equal weights hardly change the residuals
ENOUGH = 5  # points needed to identify a wrong one: the resection without it is still redundant
FITTING = 3.0  # in sigma0 of the others: largest rms standardised residual of an image that agrees with them
CONTRADICTING = 0.5  # share in the squared errors of a camera's images above which some may contradict the others
TRIED = 3  # images left out in turn, those with the largest errors
WHOLE = 3.0  # in given standard deviations: median residual of an image that contradicts the others as a whole
MOST_CONTRADICTING = 1 / 3  # fraction of the images
FEWEST_RAYS = 2  # rays needed for a point without priors
# Unmodelled errors:
CLEARER = 3.0  # factor by which errors fall without images that contradict the others
FIRST = 1e-3  # initial value, fraction of the frame's diagonal: above any lens misfit, below a blunder
PLAUSIBLE = 3e-4  # fraction of the frame's diagonal that lens, board and processing may cause: 1.5 px of 5000 px
SETTLED = 0.01  # relative change of a standard deviation that means convergence


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
        which keep the iteration from converging; all are tried again once the lens is known (`Adjustment.left_out`). Of
        images with too few known points the fiducials stay.
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


def adjust_unmodelled(network: Network, options: Options | None = None, pixel_mm: float | None = None) -> Adjustment:
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
    pixel_mm : side of a pixel of all images, for errors in px; None: they are given in µm

    Returns
    -------
    Adjustment
        With the added standard deviations in `unmodelled_mm`. Raises AdjustmentError as `adjust` does.
    """
    options = options or Options()
    plausible_mm = {each.name: PLAUSIBLE * float(np.hypot(*each.frame_mm)) for each in network.cameras}
    refitted = partial(_fit_unmodelled, options=options)
    result = _drop_contradicting(network, refitted(network), refitted, plausible_mm)
    per_mm, unit = (1000.0, "µm") if pixel_mm is None else (1.0 / pixel_mm, "px")
    warnings = (
        f"Camera {name}: errors of {per_mm * sigma_mm:.3g} {unit} are not modelled, one part in "
        f"{plausible_mm[name] / PLAUSIBLE / sigma_mm:.0f} of the picture's diagonal. Look for pictures that are "
        "blurred or moved, for a wrong size or count of the board, and whether the lens model suits."
        for name, sigma_mm in result.unmodelled_mm.items()
        if result.converged and sigma_mm > plausible_mm[name] > 0.0
    )
    return replace(result, remarks=(*result.remarks, *warnings))


def _drop_contradicting(
    network: Network,
    first: Adjustment,
    refitted: Callable[[Network], Adjustment],
    plausible_mm: Mapping[str, float],
) -> Adjustment:
    """Leave out the frames without which unmodelled errors are CLEARER times smaller, and then less gross ones."""
    doubtful = [
        name
        for name, limit_mm in plausible_mm.items()
        if limit_mm and (first.unmodelled_mm[name] > limit_mm or _is_of_some_frames(first, name))
    ]
    if not doubtful:
        return first

    def agrees(result: Adjustment) -> bool:
        return result.converged and all(
            result.unmodelled_mm[name] <= plausible_mm[name]
            and CLEARER * _marks_sigma_mm(result, name) <= _marks_sigma_mm(first, name)
            for name in doubtful
        )

    found = _leave_out_contradicting(network, first, refitted, agrees, several=True)
    rest = _leave_out(network, found.left_out.keys() - first.left_out.keys()) if found is not first else None
    return found if rest is None else _drop_contradicting(rest, found, refitted, plausible_mm)


def _fit_unmodelled(network: Network, options: Options) -> Adjustment:
    """Adjust a network with standard deviations of unmodelled errors by camera with which v'Pv of its marks equals
    their redundancy, but none larger than an adjustment accepts: the lens may not suit at all."""
    largest_mm = largest_sigma_mm(network)
    sigma_mm = {each.name: min(FIRST * float(np.hypot(*each.frame_mm)), largest_mm) for each in network.cameras}
    result = adjust(_add_unmodelled(network, sigma_mm), options=options)
    largest_mm = largest_sigma_mm(result.network)
    for _ in range(ROUNDS):
        if not result.converged:
            break
        before_mm, sigma_mm = sigma_mm, {}
        cameras, residuals = _cameras(result.network), result.residuals
        variances = np.diagonal(result.network.observations.covariance_mm2, axis1=1, axis2=2)
        for camera, before in before_mm.items():
            rows = cameras == camera
            redundancy = float(residuals.redundancy[rows].sum())
            squares, given = residuals.v_mm[rows] ** 2, variances[rows] - before**2
            added = added_variance(squares, given, redundancy) if redundancy >= 1.0 else None
            sigma_mm[camera] = min(float(np.sqrt(added or 0.0)), largest_mm)
        if all(abs(sigma_mm[each] - before_mm[each]) <= SETTLED * sigma_mm[each] for each in sigma_mm):
            break
        result = adjust(_add_unmodelled(network, sigma_mm), result.start, options)
    return replace(result, unmodelled_mm=sigma_mm)


def _add_unmodelled(network: Network, sigma_mm: Mapping[str, float]) -> Network:
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


@dataclass(frozen=True)
class _Solver:
    """Adjust networks with given options."""

    options: Options

    @property
    def trials(self) -> Trials:
        return Trials(
            lambda network: self.solve_plainly(network, self.own_start(network)), self.options.probabilities.family
        )

    def initial_values(self, network: Network) -> Approximations:
        return initial_values(held_as_known(network, self.options.datum_coordinates))

    def own_start(self, network: Network) -> Approximations | None:
        """Compute a network's own approximations; None where this fails."""
        try:
            return self.initial_values(network)
        except AdjustmentError:
            return None

    def remainder(
        self, network: Network, reasons: Mapping[str, str], few: Collection[str] = ()
    ) -> tuple[Network, Approximations] | None:
        """Leave out some frames, but the fiducials of those with `few` known points.

        Returns the rest with its own approximations, None where too little is left.
        """
        rest = _leave_out(network, reasons, few) if reasons else None
        start = None if rest is None else self.own_start(rest)
        return None if rest is None or start is None else (rest, start)

    def orientable(self, network: Network) -> tuple[Network, Approximations | None, dict[str, str]]:
        """Leave out the images whose points or fiducials have wrong names, and those for which no orientation is found.

        Returns the remaining network, its own approximations and the reasons by frame. Approximations are None where
        too little would remain or something else is wrong.
        """
        misnumbered = exchanged_fiducials(network) or misnumbered_images(network)
        part = _leave_out(network, misnumbered) if misnumbered else network
        if part is None:
            sentences = dict.fromkeys(misnumbered.values())
            raise AdjustmentError(" ".join(f"{each[0].upper()}{each[1:]}" for each in sentences))
        try:
            return part, self.initial_values(part), misnumbered
        except UnorientedError as error:
            rest, reasons = self.remainder(part, error.reasons, error.few), error.reasons
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

        def readjust(rest: Network) -> Adjustment:
            return self.adjust_without_blind(rest, self.initial_values(rest))

        if first.termination != "singular":
            found = _leave_out_contradicting(part, first, readjust, agrees, several=False)
        # A few images that show something of another shape look like images distorted each in its own way.
        is_gross = found is first and first.converged and first.sigma0 > WHOLE
        if is_gross and any(each.kind == "affinities" for each in first.explanations):
            found = _leave_out_contradicting(part, first, readjust, agrees, several=True)
        contradicting = [] if found is first else [each for each in found.left_out if each not in first.left_out]
        causes = {
            frame: cause
            for frame in contradicting[:TRIED]
            if (rest := _leave_out(part, {*found.left_out} - {frame})) is not None
            and (cause := frame_cause(rest, frame, found, self.trials))
        }
        return replace(found, left_out={**left_out, **found.left_out, **causes})

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
            oriented, start, reasons = self.orientable(_adopt_lens(network, rest))
            oriented = replace(oriented, cameras=network.cameras)
            came = left_out.keys() - reasons.keys()
            while start is not None and came:
                part = _leave_out(oriented, left_out.keys() - reasons.keys() - came)
                if part is None:
                    break
                try:
                    tried = self.check_points(part, start)
                    fit = _fitting(tried, came, rest.sigma0) if tried.converged else set()
                except NoImageError as error:
                    tried, fit = rest, came - error.reasons.keys()
                if fit == came:
                    found = tried
                    break
                came = fit
        unoriented = found.network.unoriented
        frames = {image.frame for image in found.network.images if image.name not in unoriented}
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
        if elsewhere := orientations_elsewhere(network, result):
            return replace(result, remarks=(*result.remarks, elsewhere))
        unlike = unlike_approximations(network, result)
        return replace(result, unused=(*result.unused, unlike)) if unlike else result

    def _refuse_blunder(self, network: Network, given: Adjustment | None) -> None:
        if sentence := blunder_sentence(network, given, self.trials):
            raise AdjustmentError(sentence)

    def check_points(self, network: Network, start: Approximations) -> Adjustment:
        """Adjust a network and report given points with coordinate blunders."""
        # Robust estimation and data snooping start without these points: from an adjustment that includes a blunder
        # neither recovers, since the linearised equations do not hold for errors so large.
        result: Adjustment | None = None
        try:
            begins_without = self.options.robust or self.options.snooping
            if begins_without and (blunders := self.coordinate_blunders(network, start)):
                places = {each.name: each.place for each in blunders}
                with suppress(NoImageError):
                    result = self.solve(network, replace(start, points={**start.points, **places}), places)
            if result is None or not result.converged:
                result = self.solve(network, start)
        except NoImageError as error:
            if blunders := self.coordinate_blunders(network, start):
                raise AdjustmentError(" ".join(each.sentence for each in blunders)) from error
            raise
        if result.termination not in ("converged", "singular"):
            result = self._begin_anew(network, start, result)
        if result.termination == "singular" or (result.converged and self.trials.agrees(result)):
            return result
        if blunders := self.coordinate_blunders(network, start):
            return replace(result, coordinate_blunders={each.name: each.sentence for each in blunders})
        given = sorted(name for name in network.known_places if name in network.observed_points)
        if result.converged or len(given) != ENOUGH - 1:
            return result
        remark = (
            f"The points {', '.join(given)} alone are given in X, Y and Z: if the coordinates of one of the "
            f"{len(given)} are wrong, nothing tells which. Check all of them, or give another point."
        )
        return replace(result, remarks=(*result.remarks, remark))

    def coordinate_blunders(self, network: Network, start: Approximations) -> list[CoordinateBlunder]:
        solve = partial(self.solve, plain=True)
        return find_coordinate_blunders(network, start, solve, self.options.probabilities)

    def solve(
        self, network: Network, start: Approximations, doubted_points: Iterable[str] = (), plain: bool = False
    ) -> Adjustment:
        """Adjust a network without mismatched rays of unknown points, or as it is where that does not converge.

        doubted_points: points whose given coordinates are left out at first. plain: with the weights as given.
        """
        options, doubted = self.options.plain if plain else self.options, list(doubted_points)
        earlier: Mismatches | None = None
        result: Adjustment | None = None
        # Orientations that the worst mismatches have not spoilt show the smaller ones, and which rays meet after all.
        for _ in range(ROUNDS):
            numbered = number_reduced(network, start, options.method == "elements")
            found = find_mismatches(numbered[0])
            if earlier is not None and found.agrees(earlier):
                break
            places = {name: place + numbered[1].origin for name, place in found.places.items()}
            start, parts = replace(start, points={**start.points, **places}), numbered
            rest, mismatched, unmet = _leave_out_mismatches(network, found)
            if places:
                parts = number_reduced(rest, start, options.method == "elements")
            now = _solve(rest, parts, options, doubted, mismatched)
            if not now.converged:
                return result or (_solve(network, numbered, options, doubted, {}) if places else now)
            result, earlier = replace(now, unmet=unmet), found
            if not places and self.trials.agrees(result):
                break
            start = replace(result.approximations, points={**start.points, **result.approximations.points})
        assert result is not None
        return result

    def solve_plainly(self, network: Network, start: Approximations | None) -> Adjustment | None:
        """Adjust a network in a few steps with the weights as given; None where the adjustment cannot start."""
        if start is None:
            return None
        limit = min(self.options.iteration_limit, TRIAL_STEPS)
        try:
            return _Solver(replace(self.options.plain, iteration_limit=limit)).solve(network, start)
        except AdjustmentError:
            return None

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


def _leave_out_mismatches(
    network: Network, mismatches: Mismatches
) -> tuple[Network, dict[int, tuple[int, ...]], dict[str, str]]:
    """Remove the points whose rays do not meet from a network; also return its doubted rows, and sentences by point."""
    unmet, images = mismatches.unmet, network.observations.image
    out = np.concatenate([np.empty(0, dtype=np.intp), *unmet.values()])
    kept = np.setdiff1d(np.arange(len(network.observations)), out)
    doubted = {
        int(np.searchsorted(kept, row)): tuple(np.searchsorted(kept, others).tolist())
        for row, others in mismatches.doubted.items()
    }
    if not unmet:
        return network, doubted, {}
    points = tuple(point for point in network.points if point.id not in unmet)
    distances = tuple(each for each in network.distances if not {each.start, each.end} & unmet.keys())
    rest = replace(network, points=points, observations=network.observations.only(kept), distances=distances)
    sentences = {
        name: f"No two rays of point {name} meet, from the images {shortened([images[row] for row in rows], NAMED)}: "
        "the point is left out. Check its number there."
        for name, rows in unmet.items()
    }
    return rest, doubted, sentences


def _leave_out_contradicting(
    network: Network,
    first: Adjustment,
    adjusted: Callable[[Network], Adjustment],
    agrees: Callable[[Adjustment], bool],
    several: bool,
) -> Adjustment:
    """Leave out the frames that contradict the others, one after another, until these agree; `first` if they never do.

    Each has to dominate the residuals of its camera with all its marks. Where several may do so together, that one of
    the TRIED worst is left out without which the residuals are smallest.
    """
    frames = {image.frame for image in network.images} | first.left_out.keys()
    most, out, last = MOST_CONTRADICTING * len(frames) - len(first.left_out), list[str](), first
    while not agrees(last):
        worst, trials = _frames_by_error(last, several)[: TRIED if several else 1], dict[str, Adjustment]()
        for each in worst if len(out) + 1 <= most else ():
            rest = _leave_out(network, [*out, each.name])
            if rest is not None and (several or (each.share > CONTRADICTING and each.is_whole)):
                with suppress(AdjustmentError):
                    trials[each.name] = adjusted(rest)
        if not trials or (not out and _is_of_single_marks(first, adjusted, agrees)):
            return first
        out.append(min(trials, key=lambda name: float(np.mean(trials[name].residuals.v_mm ** 2))))
        last = trials[out[-1]]
    return replace(last, left_out={**first.left_out, **last.left_out, **dict.fromkeys(out, _reason(first, last, out))})


def _is_of_single_marks(
    first: Adjustment, adjusted: Callable[[Network], Adjustment], agrees: Callable[[Adjustment], bool]
) -> bool:
    """Whether the observations agree without gross errors of single marks, no more than half of each image's fiducials
    and of its targets."""
    network = first.network
    if not first.converged:
        return False
    is_left = np.ones(len(network.observations), dtype=bool)
    removed = snoop(first.run, Options(snooping=True, probabilities=first.probabilities)).removed
    is_left[[each.unit for each in removed if each.unit < len(is_left)]] = False
    parts = 2 * network.observed_frames + network.observations.is_fiducial
    shares = np.bincount(parts, is_left) / np.bincount(parts).clip(1)
    if is_left.all() or (shares[parts] < 0.5).any():
        return False
    with suppress(AdjustmentError):
        return agrees(adjusted(replace(network, observations=network.observations.only(np.flatnonzero(is_left)))))
    return False


def _is_of_some_frames(result: Adjustment, camera: str) -> bool:
    """Whether so many frames of a camera as may contradict the others have most of its errors."""
    shares = [each.share for each in _frames_by_error(result, predicted=True) if each.camera == camera]
    return sum(shares[: int(MOST_CONTRADICTING * len(shares))]) > CONTRADICTING


class _FrameError(NamedTuple):
    """Squared error of a frame and its share in that of its camera; whether it is of most of its marks."""

    square: float
    name: str
    camera: str
    share: float
    is_whole: bool


def _frames_by_error(result: Adjustment, predicted: bool) -> list[_FrameError]:
    """Frames by their errors as the others predict them, or by their v'Pv, the largest first."""
    network = result.network
    camera_of = {image.frame: image.camera for image in network.images}
    numbers, of_frame = np.unique(network.observed_frames, return_inverse=True)
    names, cameras = np.array([*camera_of.items()])[numbers].T
    variances = np.diagonal(network.observations.covariance_mm2, axis1=1, axis2=2)
    squares = (result.residuals.v_mm**2 / variances).sum(axis=1)  # without a solution no residual is standardised
    of_others = result.prediction_errors(len(numbers)) if predicted else None
    errors = np.bincount(of_frame, squares) if of_others is None or np.isnan(of_others).any() else of_others
    shares = errors / np.maximum((cameras[:, None] == cameras) @ errors, 1e-300)
    medians = np.array([np.median(squares[of_frame == frame]) for frame in range(len(numbers))])
    # Without a solution the worst mark is as large as any.
    is_whole = np.full(len(numbers), not result.converged) | (medians >= 2.0 * WHOLE**2)
    columns = (each.tolist() for each in (errors, names, cameras, shares, is_whole))
    return sorted(map(_FrameError._make, zip(*columns, strict=True)), reverse=True)


def _reason(first: Adjustment, last: Adjustment, frames: Sequence[str]) -> str:
    """Sentence on frames without which the others agree, or the adjustment converges."""
    who, shown = f"image{'s' * (len(frames) > 1)} {shortened(sorted(frames), NAMED)}", first.network.observations
    if not first.converged:
        network = first.network
        own = np.isin(np.array([image.frame for image in network.images])[network.image_numbers], frames)
        row = int(np.argmax(np.where(own, np.linalg.norm(first.residuals.v_mm, axis=1), -1.0)))
        return (
            f"with {who} the iteration does not converge, without it does. The largest residual there is that of "
            f"{shown.point[row]} in {shown.image[row]}. Check the point numbers."
        )
    falls = [first.unmodelled_mm[camera] / sigma_mm for camera, sigma_mm in last.unmodelled_mm.items() if sigma_mm]
    times = f": unmodelled errors are {max(falls):.2g} times smaller then" if falls else ""
    is_observed = any(image.frame in frames and image.is_observed for image in first.network.images)
    orientation = "a wrong orientation in images.csv, " if is_observed else ""
    return (
        f"all marks of {who} contradict the other images, which agree without them{times}. Possible are {orientation}"
        "another size, pitch, zoom or camera than given, a crop, another print of the board, wrong point numbers, or "
        "two frames under one name."
    )


def _leave_out(network: Network, frames: Collection[str], few: Collection[str] = ()) -> Network | None:
    """Remove some frames and what only they show from a network; None where no more than half of it would remain.

    few: those whose fiducials stay, where these suffice for the film transformation.
    """
    left = {image.frame for image in network.images if image.frame not in frames}
    if len(left) <= len(frames):
        return None
    observations, fiducials = network.observations, defaultdict[str, set[str]](set)
    for row in np.flatnonzero(observations.has_kind("fiducial")):
        fiducials[network.image_by_name[observations.image[row]].frame].add(observations.point[row])
    film = {
        image.name
        for image in network.images
        if image.frame in few and len(fiducials[image.frame]) >= max(marks_needed(image.transformation), 1)
    }
    names = {image.name for image in network.images if image.frame in left}
    shown = np.isin(observations.image, list(names))
    frames_of = defaultdict[str, set[str]](set)
    for row in np.flatnonzero(shown & ~observations.is_fiducial):
        frames_of[observations.point[row]].add(network.image_by_name[observations.image[row]].frame)
    located = {
        point.id
        for point in network.points
        if len(frames_of[point.id]) >= (FEWEST_RAYS if point.X is point.Y is point.Z is None else 1)
    }
    kept = (shown & np.isin(observations.point, list(located))) | (
        observations.is_fiducial & np.isin(observations.image, list(names | film))
    )
    return replace(
        network,
        images=tuple(image for image in network.images if image.name in names | film),
        points=tuple(
            point for point in network.points if point.id in located or point.id not in network.observed_points
        ),
        observations=observations.only(np.flatnonzero(kept)),
        distances=tuple(each for each in network.distances if {each.start, each.end} <= located | names),
    )


def _fitting(result: Adjustment, frames: Collection[str], sigma0: float) -> set[str]:
    """Select the frames whose residuals agree with sigma0 of the others."""
    of_mark = np.array([image.frame for image in result.network.images])[result.network.image_numbers]
    excess = (np.nan_to_num(result.residuals.w) ** 2).sum(axis=1) - 2.0 * (FITTING * sigma0) ** 2
    return {frame for frame in frames if (result.weights * excess)[of_mark == frame].sum() <= 0.0}


def _adopt_lens(network: Network, result: Adjustment) -> Network:
    """Replace the cameras of a network by those adjusted from a part of it."""

    def adopted(camera: str, name: str, given: Prior | None) -> Prior:
        return Prior(result.value(Parameter.interior(camera, name)), np.inf if given is None else given.sigma)

    cameras = dict(network.camera_by_name)
    for name in {image.camera for image in result.network.images} - result.network.idle_cameras:
        camera, given = cameras[name], cameras[name].distortion.parameters
        cameras[name] = replace(
            camera,
            principal_distance_mm=adopted(name, "c", camera.principal_distance_mm),
            x0_mm=adopted(name, "x0", camera.x0_mm),
            y0_mm=adopted(name, "y0", camera.y0_mm),
            distortion=replace(
                camera.distortion, parameters={each: adopted(name, each, prior) for each, prior in given.items()}
            ),
        )
    return replace(network, cameras=tuple(cameras.values()))
