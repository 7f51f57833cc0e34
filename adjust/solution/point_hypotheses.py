"""Hypotheses on errors of the given points: a deformed object, disks of another diameter, wrong coordinates."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from scipy.spatial import KDTree
from scipy.special import chdtrc

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.board import BoardForm, board_form, datum_directions, disk_directions, strain_directions
from adjust.problem.condition_equations import computed_observations
from adjust.problem.network import Network
from adjust.problem.parameter import shortened
from adjust.problem.problem import State
from adjust.quality.cofactor import free_cofactor
from adjust.quality.run import Run
from adjust.solution import partitions
from adjust.solution.model_hypotheses import (
    NAMED,
    Estimate,
    ModelHypothesis,
    Words,
    displace_points,
    free_and_continue,
)

CLEAR = 3.0  # standard deviations above which one of two changes of a board is reported
FEWEST_GIVEN, FEWEST_IMAGES = 5, 2  # given points, and images of one, that tell a wrong one
MISMEASURED = 0.1  # relative error of the given diameter of disks whose effect is reported
MOST_NAMED = 10  # points named in a message
FEWEST_ALIKE = 3  # points whose shifts tell that all are the same
LEVEL = 0.001  # probability of calling a point wrong that is where it is given, or equal shifts unequal
INDEPENDENT = "points' unit; ± for independent errors, on real boards up to 5 times as much"


def point_hypotheses(run: Run, is_suspicious: bool, is_fitted: bool) -> Iterator[ModelHypothesis]:
    """All hypotheses on the given points that apply; arguments as of `model_hypotheses`."""
    yield from _deformations(run)
    yield from _disks(run)
    # Errors of a real board's points are part of the noise that is fitted: none of them is reported but the worst.
    if is_suspicious or is_fitted:
        yield from _wrong_points(run, 1 if is_fitted else len(run.problem.network.points))


def _deformations(run: Run) -> Iterator[ModelHypothesis]:
    """A strain of the object of all given points, another datum than that of observed orientations, and a bend or a
    twist of a flat one."""
    network = run.problem.network
    if not _is_given(network):
        return

    form = _flat_form(network)
    axes = np.eye(3) if form is None else form.axes
    strain = strain_directions(np.array(list(network.known_places.values())), axes)
    rows: list[tuple[str, Words, Array]] = [("strain", lambda found: _strain_words(len(axes), found), strain)]
    if form is not None:
        is_bent = any(board.by_observation is None for board in network.boards)
        bends = [form.twist_directions] if is_bent else [form.bend_directions, form.twist_directions]
        rows += [("bend", _bend_words, np.concatenate(bends, axis=1))]
    if any(image.is_observed for image in network.images):
        rows.append(("datum", _datum_words, datum_directions(np.array(list(network.known_places.values())))))
    for name, words, directions in rows:
        by_point = dict(zip(network.known_places, directions, strict=True))
        yield displace_points(run, name, "board", words, _displacements_of_targets(run, by_point))


def _datum_words(found: Estimate) -> tuple[str, str]:
    """Describe another datum of the points by its shifts, turns (degrees) and scale (1e-6)."""
    rows = [(f"shifted by {{}} in {axis}", 1.0) for axis in "XYZ"]
    rows += [(f"turned by {{}} degrees about {axis}", float(np.degrees(1.0))) for axis in "XYZ"]
    rows.append(("{} · 10⁻⁶ larger", 1e6))
    values = zip(rows, -found.value, found.sigma, strict=True)
    changes = [
        words.format(f"{unit * v:+.4g} ± {unit * s:.1g}") for (words, unit), v, s in values if abs(v) > CLEAR * s
    ]
    return (
        "The points and the orientations are given in two datums: the points are, about their centre, "
        f"{', '.join(changes) or 'shifted'} against the orientations (points' unit)",
        "Give both in one datum, or the orientations as approximations, without standard deviations.",
    )


def _bend_words(found: Estimate) -> tuple[str, str]:
    """Describe bends along the two axes of a board, where these are not adjusted anyway, and a twist."""
    (*bends, twist), (*bend_sigmas, twist_sigma) = found.value, found.sigma
    remedy = "Put it on a flat plate."
    twisted = f"two opposite corners stand {abs(twist):.3g} ± {twist_sigma:.1g} above its plane, the others below it"
    if all(abs(v) < CLEAR * s for v, s in zip(bends, bend_sigmas, strict=True)):
        return f"The board of the given points is twisted: {twisted} ({INDEPENDENT})", remedy
    (x, y), (x_sigma, y_sigma) = bends, bend_sigmas
    further = f"; it is twisted, too, {twisted}" if abs(twist) > CLEAR * twist_sigma else ""
    return (
        f"The board of the given points is not flat: its middle stands {x:.3g} ± {x_sigma:.1g} off along its first "
        f"axis and {y:.3g} ± {y_sigma:.1g} along its second{further} ({INDEPENDENT})",
        f'{remedy} Or let its bend be adjusted: board_bend = "free" under [object] in project.toml.',
    )


def _strain_words(count: int, found: Estimate) -> tuple[str, str]:
    """Describe stretches and shears of a flat board (count 2) or of an object in space (3)."""
    value, names = found.value, ("X", "Y", "Z") if count > 2 else ("its first axis", "its second")
    middle = int(np.argsort([*value[: count - 1], 0.0])[(count - 1) // 2 if count > 2 else 1])
    # Stretches relative to the axis in the middle.
    stretches = np.vstack([np.eye(len(value))[: count - 1], np.zeros(len(value))])
    rows = [
        (stretches[i] - stretches[middle], 100.0, f"% {{}} along {names[i]} than along {names[middle]}")
        for i in range(count)
        if i != middle
    ]
    rows += [
        (row, 1000.0, f"mrad off in the angle of {names[i]} and {names[j]}")
        for row, (i, j) in zip(np.eye(len(value))[count - 1 :], combinations(range(count), 2), strict=True)
    ]
    changes = [(float(row @ value), np.sqrt(row @ found.covariance @ row), unit, what) for row, unit, what in rows]
    significant = [each for each in changes if abs(each[0]) > CLEAR * each[1]] or changes
    figures = " and ".join(
        f"{abs(unit * v):.3g} ± {unit * s:.1g} {what.format('longer' if v > 0.0 else 'shorter')}"
        for v, s, unit, what in significant
    )
    what = "board" if count == 2 else "object"
    return (
        f"The {what} of the given points has another shape than given: it is {figures}",
        f"Measure the {what} and give the coordinates that it has: printers stretch paper in one direction.",
    )


def _is_given(network: Network) -> bool:
    """Whether all points of an object are given, and enough to test its shape."""
    return len(network.known_places) >= max(FEWEST_GIVEN, len(network.observed_points))


def _flat_form(network: Network) -> BoardForm | None:
    try:
        return board_form(np.array(list(network.known_places.values())))
    except ValueError:
        return None


def _displacements_of_targets(run: Run, by_point: Mapping[str, Array]) -> Array:
    """(n, k, 3) displacements of the points of all targets, of those (k, 3) by name; 0 for others."""
    none = np.zeros_like(next(iter(by_point.values())))
    return np.array([by_point.get(name, none) for name in run.problem.network.observations.point])


def _possible_radius(run: Run) -> float:
    """Radius of disks: as given, or where it is not a quarter of the distance of neighbours."""
    network = run.problem.network
    if network.disk_radius is not None:
        return network.disk_radius
    xyz = np.array(list(network.known_places.values()))
    nearest, _ = KDTree(xyz).query(xyz, 2)
    return float(np.median(np.asarray(nearest)[:, 1])) / 4.0


def _disks(run: Run) -> Iterator[ModelHypothesis]:
    """Another squared radius of disks on a board than given, or one where nothing says that the points are disks."""
    problem, state, network = run.problem, run.end.state, run.problem.network
    given = network.disk_radius
    form = _flat_form(network) if _is_given(network) and given != 0.0 else None
    if form is None:
        return
    radius, at = _possible_radius(run), dict[tuple[int, int], Array]()
    points = np.array([at for id_, at in problem.unknowns.point.items() if id_ in network.known_places])
    shown = network.observations.has_kind("target")
    for i, j in product((-1, 0, 1), repeat=2):
        values = state.values.copy()
        values[points] += radius * (np.array([i, j]) @ form.axes)
        if (computed := computed_observations(problem, State(values, state.rotations))) is None:
            return
        at[i, j] = computed[shown]

    def words(found: Estimate) -> tuple[str, str]:
        sigma, diameter = found.sigma[0], 2.0 * np.sqrt(max((given or 0.0) ** 2 + found.value[0], 0.0))
        figures = f"{diameter:.3g} ± {2.0 * sigma / max(diameter, np.sqrt(sigma)):.1g} (points' unit)"
        if given is None:
            return (
                "The points are centres of dots, whose perspective is not corrected: their diameter is found as "
                f"{figures}",
                'Give their diameter_mm under [targets], kind = "disk".',
            )
        return (
            f"The disks do not have the diameter of {2.0 * given:.4g} that is given, or the points another spacing: by "
            f"the coordinates it is found as {figures}",
            "Measure a disk, and from one to the next; correct diameter_mm or the coordinates and their unit.",
        )

    directions = np.zeros((len(shown), 1, 3))
    directions[shown] = disk_directions(at, form.axes, radius)
    limits = (-np.inf, np.inf) if given is not None else (0.0, (2.0 * radius) ** 2)
    yield replace(displace_points(run, "disks", "disks", words, directions), limits=limits)


def diameter_notes(run: Run) -> Iterator[str]:
    """Note where a wrong diameter of the disks, or one that is not given, changes c by more than its deviation."""
    for each in _disks(run) if run.converged else ():
        unknowns, (radius_squared,) = each.problem.unknowns, each.added
        if (at := run.linearised(each.problem)) is None:
            return
        cofactor = free_cofactor(at)
        given = run.problem.network.disk_radius
        for camera, (c, *_) in unknowns.camera.items():
            (own, common), (_, square) = cofactor.part(np.array([c, radius_squared]))
            squared = _possible_radius(run) ** 2 if given is None else ((1.0 + MISMEASURED) ** 2 - 1.0) * given**2
            change = squared * common / square
            if abs(change) <= np.sqrt(own - common**2 / square):
                continue
            if given is not None:
                yield (
                    f"The diameter of the disks is taken as exact: if it is {100.0 * MISMEASURED:.0f} % larger, c of "
                    f"camera {camera} changes by {change:+.2g} mm."
                )
            elif squared - at.factor.solution[at.rows.numbering.numbers[radius_squared]] < CLEAR * np.sqrt(square):
                yield (
                    "Nothing says whether the points are corners or the centres of dots: if they are dots of a "
                    f"diameter of {2.0 * np.sqrt(squared):.2g} (points' unit), whose perspective is not corrected, c "
                    f"of camera {camera} changes by {change:+.2g} mm. Give their diameter_mm under [targets], kind = "
                    '"disk".'
                )


def _wrong_points(run: Run, most: int) -> Iterator[ModelHypothesis]:
    """Wrong coordinates of fixed points, heights alone, say, or of a line or a side of a regular field by one shift.

    Coordinates that are given with a standard deviation are observations, tested by data snooping.
    """
    network, unknowns, fixed = run.problem.network, run.problem.unknowns, _fixed_coordinates(run)
    if len(fixed) < FEWEST_GIVEN:
        return
    positions = np.concatenate([unknowns.point[name][mask] for name, mask in fixed.items()])
    form = _flat_form(network) if network.known_places else None
    axes = np.eye(3) if form is None else form.axes
    for selection in partitions.displaced_points(run, axes, free_and_continue(run, positions), fixed, most):
        mask = np.array([fixed[name] for name in selection.names])
        added = np.array([unknowns.point[name] for name in selection.names])[mask]
        words = _point_words(selection, mask, unknowns.given[added], len(fixed))
        if selection.words:
            moved = _displacements_of_targets(run, dict.fromkeys(selection.names, np.eye(3)))
            found = displace_points(run, "group", "point", words, moved)
        else:
            found = ModelHypothesis("point", words, free_and_continue(run, added), added)
        yield replace(found, selection=selection)


def _fixed_coordinates(run: Run) -> dict[str, Mask]:
    """Mask (3,) of the fixed coordinates of each point that has some, and that FEWEST_IMAGES show."""
    network = run.problem.network
    images = Counter(name for name, _ in set(zip(network.observations.point, network.observations.image, strict=True)))
    fixed = {
        name: np.array([prior is not None and prior.sigma == 0.0 for prior in network.point_by_id[name].priors])
        for name in run.problem.unknowns.point
        if images[name] >= FEWEST_IMAGES
    }
    return {name: mask for name, mask in fixed.items() if mask.any()}


def wrong_points(earlier: ModelHypothesis | None, found: ModelHypothesis, run: Run) -> ModelHypothesis:
    """Wrong single points as estimated in a run, with those of an earlier round, without those where they are given.

    Other hypotheses are returned as they are.
    """
    rounds = [each for each in (earlier, found) if each and each.kind == "point" and not each.selection.words]
    if found not in rounds:
        return found
    unknowns, cofactor, wrong = found.problem.unknowns, free_cofactor(run.end), list[tuple[str, Mask, Indices]]()
    for each in rounds:
        for name in each.selection.names:
            mask = np.isin(each.problem.unknowns.point[name], each.added if each.shown is None else each.shown)
            at = unknowns.point[name][mask]
            off = run.end.state.values[at] - unknowns.given[at]
            if chdtrc(len(at), off @ np.linalg.solve(cofactor.part(at), off)) < LEVEL:
                wrong.append((name, mask, at))
    if not wrong:
        return found
    names, masks, positions = zip(*wrong, strict=True)
    added, selection = np.concatenate(positions), replace(found.selection, names=names)
    words = _point_words(selection, np.array(masks), unknowns.given[added], len(_fixed_coordinates(run)))
    return replace(found, words=words, shown=added, selection=selection)


def _point_words(selection: partitions.Selection, fixed: Mask, given: Array, count: int) -> Words:
    """Words on points whose fixed coordinates (k, 3) are not those given (n,), or on a group with one shift.

    count: of the points with fixed coordinates.
    """
    names, remedy = selection.names, "Correct the coordinates of these points, or their numbers among the marks."

    def words(found: Estimate) -> tuple[str, str]:
        offs, sigmas = np.zeros((2, *fixed.shape))
        if selection.words:
            offs, sigmas = -found.value[None], found.sigma[None]
        else:
            offs[fixed], sigmas[fixed] = given - found.value, found.sigma
        by = [_axes_words(*each) for each in zip(offs, sigmas, strict=True)]
        some = shortened(names, MOST_NAMED)
        if selection.words:
            return (
                f"The points {some} ({selection.words}) are not where they are given: all their coordinates are off, "
                f"{by[0]} (points' unit)",
                remedy,
            )
        if len(names) == 1:
            return (
                f"Point {names[0]} is not where it is given: its coordinates are off, {by[0]} (points' unit)",
                "Correct the coordinates of this point, or its number among the marks.",
            )
        if fixed.all() and (common := _common_shift(offs, found.covariance)):
            return (
                f"{len(names)} points are not where they are given: {some}; all are off by the same shift, "
                f"{_axes_words(*common)} (points' unit)",
                remedy,
            )
        if 2 * len(names) > count:
            return (
                f"{len(names)} of {count} points that are given as exact are not where they are given, by "
                f"{np.sqrt(np.mean(offs[fixed] ** 2)):.2g} rms (points' unit): their coordinates are not exact",
                "Give sX, sY and sZ as the points have them.",
            )
        worst = np.argsort(-np.linalg.norm(offs, axis=1), kind="stable")[:NAMED]
        return (
            f"{len(names)} points are not where they are given: {some}; the coordinates of the worst are off, "
            f"{'; '.join(f'{names[k]}: {by[k]}' for k in worst)} (points' unit)",
            remedy,
        )

    return words


def _axes_words(off: Array, sigma: Array) -> str:
    """Errors (3,) of coordinates with their standard deviations, 0 for those that are not tested."""
    digits = [max(0, -int(np.floor(np.log10(max(s, 1e-12))))) for s in sigma]
    rows = zip("XYZ", off, sigma, digits, strict=True)
    return ", ".join(f"{axis} by {d:+.{n}f} ± {s:.1g}" for axis, d, s, n in rows if s > 0.0)


def _common_shift(offs: Array, covariance: Array) -> tuple[Array, Array] | None:
    """Weighted mean (3,) of the shifts (k, 3) of points, and its standard deviations; None where they differ."""
    count = len(offs)
    weight, same = np.linalg.inv(covariance), np.tile(np.eye(3), (count, 1))
    of_mean = np.linalg.inv(same.T @ weight @ same)
    mean = of_mean @ (same.T @ weight @ offs.ravel())
    rest = (offs - mean).ravel()
    if count < FEWEST_ALIKE or chdtrc(3 * (count - 1), rest @ weight @ rest) < LEVEL:
        return None
    return mean, np.sqrt(np.diag(of_mean))
