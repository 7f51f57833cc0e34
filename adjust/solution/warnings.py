"""Warnings and notes about a result, each with its remedy.

Some interior orientations depend on what images do not tell. Decentering that is held at 0 is taken up by the principal
point in straight views of a flat field; where it is free, standard deviations, which are linear, may miss a curved
valley and other minima. The principal distance of films has the unit of their fiducials.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial import KDTree
from scipy.special import chdtr, chdtrc

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.functional_model.transformation import marks_needed
from adjust.least_squares.iteration import factorise
from adjust.problem.condition_equations import computed_observations
from adjust.problem.estimates import Cofactor
from adjust.problem.observations import Observations
from adjust.problem.parameter import description, shortened
from adjust.problem.problem import Problem, State
from adjust.quality.cofactor import free_cofactor
from adjust.quality.run import Residuals, Run
from adjust.rank_defect.diagnosis import loose_principal_distances, singular_directions, undetermined, weak_directions
from adjust.rank_defect.directions import weak_term_sentences
from adjust.solution.model_hypotheses import free_and_continue
from adjust.solution.reweighting import ROUNDS, again

GROSS = 20.0  # in a-priori standard deviations: a larger residual may come from a confused mark
COPIED = 0.001  # significance level, for all pairs of images, of marks that lie too near to each other
NEARER = 0.25  # fraction of the distance of two marks: largest offset of one from the other's expected place
NAMED = 5  # images named in a warning
UNCHECKED = 1e-6  # redundancy of all targets of an image below which its orientation is unchecked
# Ratios of standard deviations with decentering free and held at 0, above which it is reported: where images suggest
# decentering, and always.
WORSE, MUCH_WORSE = 2.0, 5.0
SUGGESTED = 0.05  # p-value of decentering distortion that the images suggest
CORRELATED = 0.9  # correlation of a principal point with a distortion parameter above which its valley is followed
FAR = 5.0  # standard deviations by which it is moved
FILM_SCALE = 1.5e-3  # film keeps its size better than that, most scanners too
CLAIMS = 5.0  # standard deviations of c by which another unit of the fiducials would move it
CURVED = 0.5  # share of the rise of v'Pv that these promise below which they are too small
STEPS = 60  # iterations along a curved valley, which converge slowly


def run_warnings(run: Run, cofactor: Cofactor, residuals: Residuals, explained: Run) -> list[str]:
    """Collect warnings on an adjustment: termination, weak parameters, swapped numbers, unchecked images.

    explained: that with the explanations of its residuals.
    """
    return [
        *_termination(run),
        *_weak_parameters(run, cofactor),
        *_input(run.problem),
        *_swapped_numbers(run, residuals),
        *_repeated_images(explained),
        *_repeated_marks(run.problem.network.observations),
        *(_unchecked_orientations(run.problem, residuals) if run.converged else ()),
    ]


def _termination(run: Run) -> Iterator[str]:
    termination = run.solution.termination
    if termination == "iteration limit":
        # Along a flat valley an iteration does not end either: there small residuals would only mislead.
        is_gross = _is_gross(run.numbering.problem.network.observations, run.end.v_mm).any()
        largest = f" The largest residuals are those of {_largest_residuals(run)}." if is_gross else ""
        yield (
            f"The iteration did not stand still within {len(run.solution.history)} steps: the values are not final."
            f"{largest}"
        )
    if termination == "diverged":
        yield (
            f"The iteration diverged: it came to no minimum. Look for wrong point numbers and wrong approximations; "
            f"the largest residuals are those of {_largest_residuals(run)}."
        )
        yield from (f"Where it ended, the equations are singular: {each.cause}" for each in run.singular)
    if not run.settled:
        yield (
            f"The weights did not settle within {ROUNDS} rounds of robust estimation, variance components or data "
            f"snooping."
        )


def _largest_residuals(run: Run) -> str:
    observations = run.numbering.problem.network.observations
    size = np.abs(run.end.v_mm).max(axis=1)
    rows = np.argsort(-size)[:3]
    return ", ".join(
        f"{observations.kind[i]} {observations.point[i]} in image {observations.image[i]} ({size[i]:.3g} mm)"
        for i in rows
    )


def _weak_parameters(run: Run, cofactor: Cofactor) -> Iterator[str]:
    problem, state = run.numbering.problem, run.end.state
    without_priors = factorise(run.numbering, run.end, camera_priors=False)
    for each in weak_directions(run.numbering, state, without_priors, run.singular):
        yield f"Practically singular without priors ({description(each.parameters)}): {each.cause} {each.remedy}"
    if run.converged:
        yield from filter(None, [undetermined(problem, state, cofactor.variances)])
        yield from loose_principal_distances(problem, state, cofactor.variances).values()
        yield from weak_term_sentences(run.numbering, state, run.factor, cofactor)


def _input(problem: Problem) -> Iterator[str]:
    """Warn of given points without an image, and of images with too few fiducial marks for their transformation."""
    images = problem.network.images
    points = [point.id for point in problem.network.points if point.id not in problem.unknowns.point]
    if points:
        yield f"No image shows the object points {shortened(points, 5)}: they take no part."
    shown = np.bincount(problem.image_numbers[problem.is_fiducial], minlength=len(images))
    few = [i for i, image in enumerate(images) if shown[i] < marks_needed(image.transformation)]
    if few:
        first = images[few[0]]
        others = f" {len(few) - 1} more images are alike." if len(few) > 1 else ""
        yield (
            f"Image {first.name} shows {shown[few[0]]} fiducial marks, and its {first.transformation} transformation "
            f"takes {marks_needed(first.transformation)} of its own: the targets determine the rest of it.{others}"
        )


def _is_gross(observations: Observations, v_mm: Array) -> Mask:
    """(n,) mask of residuals (n, 2) large enough to come from confused marks."""
    sigma = np.sqrt(np.trace(observations.covariance_mm2, axis1=1, axis2=2) / 2)
    return np.asarray(np.linalg.norm(v_mm, axis=1) > GROSS * sigma)


def _swapped_numbers(run: Run, residuals: Residuals) -> Iterator[str]:
    """Find pairs of marks that each lie where the other is expected, unless most marks of the image do."""
    # The residuals at the start of the adjustment are used, since those orientations follow the majority of the marks.
    # At the end the adjustment has been distorted to fit the wrong ones.
    problem, observations = run.problem, run.problem.network.observations
    if run.converged and not _is_gross(observations, residuals.v_mm).any():
        return
    started = computed_observations(problem, problem.start())
    if started is None:
        return
    found = defaultdict[tuple[bool, str, str], list[str]](list)
    gross = _is_gross(observations, started - observations.xy_mm)
    for image, rows in _rows_by_image(problem):
        fiducial = observations.is_fiducial[rows]
        for kind in (False, True):
            marks = rows[fiducial == kind]
            pairs = combinations(marks[gross[marks]].tolist(), 2)
            crossed = [(i, j) for i, j in pairs if _cross(observations.xy_mm, started, i, j)]
            if 2 * len({row for pair in crossed for row in pair}) < len(marks):
                for pair in crossed:
                    first, second = sorted(observations.point[i] for i in pair)
                    found[kind, first, second].append(image)
    for (is_fiducial, first, second), images in found.items():
        what, several = "fiducial marks" if is_fiducial else "points", len(images) > 1
        where = f"the images {shortened(images, NAMED)}" if several else f"image {images[0]}"
        yield (
            f"The {what} {first} and {second} of {where} each lie where the other is expected: "
            f"their numbers{', or the coordinates given to them,' if several else ''} may be swapped."
        )


def _unchecked_orientations(problem: Problem, residuals: Residuals) -> Iterator[str]:
    """Warn of images whose orientation no redundant target checks."""
    for name, rows in _rows_by_image(problem):
        targets = rows[~problem.is_fiducial[rows]]
        if len(targets) and residuals.redundancy[targets].sum() < UNCHECKED:
            yield (
                f"Nothing checks the orientation of image {name}: its {len(targets)} targets just determine it, "
                f"and an error of one of them would not show. Measure more targets in it."
            )


def _repeated_images(run: Run) -> Iterator[str]:
    """Warn of images whose marks lie nearer to each other than independent errors allow: one picture under two names.

    Differences of their coordinates are compared with the variances of both, in the scale of the median residual.
    Fiducial marks alone may lie alike in all frames: they have to be equal.
    """
    problem, observations = run.problem, run.problem.network.observations
    point = np.array(observations.point)
    images = [(name, rows[np.argsort(point[rows], kind="stable")]) for name, rows in _rows_by_image(problem)]
    # The median of the squares of a bivariate normal distribution is 2 ln 2; gross errors hardly raise it.
    variance = 1.0
    if run.converged and len(marks := np.flatnonzero(run.weighting.used[: len(observations)])):
        squares, share = (run.misfits.residual[marks] ** 2).sum(axis=1), run.redundancies[marks].mean()
        variance = float(np.median(squares)) / (2.0 * np.log(2.0) * share) if share > UNCHECKED else 1.0
    covariance = observations.covariance_mm2 * variance
    middles = np.array([observations.xy_mm[rows].mean(axis=0) for _, rows in images])
    reach = 2.0 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).max(initial=0.0)))
    pairs = []
    for i, j in sorted(KDTree(middles).query_pairs(reach)) if len(images) else ():
        (one, own), (other, others) = images[i], images[j]
        if len(own) != len(others) or (point[own] != point[others]).any():
            continue
        apart = observations.xy_mm[own] - observations.xy_mm[others]
        squares = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(covariance[own] + covariance[others]), apart)
        targets = ~problem.is_fiducial[own]
        p = chdtr(2 * targets.sum(), squares[targets].sum()) if targets.any() else float(squares.any())
        if p < COPIED / len(images) ** 2:
            pairs.append(f"{other} as {one}")
    if pairs:
        yield (
            f"All marks have the same coordinates, but for less than their errors, in {shortened(pairs, NAMED)}: a "
            "picture under two names, or one view taken again, counts twice, and standard deviations are too small. "
            "Leave one of them out."
        )


def _repeated_marks(observations: Observations) -> Iterator[str]:
    """Warn of marks of one kind with the same coordinates in an image: the same mark under two names."""
    first, pairs = dict[tuple[str, str, bytes], str](), dict[str, None]()
    rows = zip(observations.image, observations.kind, observations.point, observations.xy_mm, strict=True)
    for image, kind, point, xy_mm in rows:
        other = first.setdefault((image, kind, xy_mm.tobytes()), point)
        if other != point:
            pairs[f"{point} and {other}"] = None
    if pairs:
        yield (
            f"Marks of two names have the same coordinates in an image, {shortened(list(pairs), NAMED)}: a mark under "
            "two names counts twice, and standard deviations are too small. Leave one of them out."
        )


def _rows_by_image(problem: Problem) -> Iterator[tuple[str, Indices]]:
    """Rows of each image that shows any mark, in order of first appearance."""
    numbers, first = np.unique(problem.image_numbers, return_index=True)
    for number in numbers[np.argsort(first)]:
        yield problem.network.images[number].name, np.flatnonzero(problem.image_numbers == number)


def _cross(observed_mm: Array, expected_mm: Array, i: int, j: int) -> bool:
    """Whether two marks each lie where the other is expected."""
    off = np.linalg.norm(expected_mm[[i, j]] - observed_mm[[j, i]], axis=1)
    return bool(off.max() < NEARER * np.linalg.norm(observed_mm[i] - observed_mm[j]))


def held_decentering_notes(run: Run, cofactor: Cofactor) -> Iterator[str]:
    """Note where the principal point depends on decentering distortion that is held at 0."""
    for camera in run.problem.network.cameras:
        lens_family = family(camera.distortion.family)
        terms = dict(lens_family.groups).get("decentering", ())[:2]
        positions = run.problem.unknowns.camera.get(camera.name)
        if positions is None or not terms:
            continue
        point, added = positions[1:3], positions[[3 + lens_family.parameters.index(name) for name in terms]]
        sigma = run.numbering.problem.prior_sigma
        if sigma[added].any() or not sigma[point].all():
            continue
        if (at := run.linearised(free_and_continue(run, added))) is None:
            continue
        variances, p = np.full(2, np.inf), 0.0
        if not singular_directions(at.rows.numbering, at.state, at.factor):
            variances, p = free_cofactor(at).variances[point], float(chdtrc(len(added), at.factor.length() ** 2))
        ratio = np.sqrt(variances / cofactor.variances[point])
        if ratio.max() > (WORSE if p < SUGGESTED else MUCH_WORSE):
            many = f"{ratio.max():.2g} times as large" if np.isfinite(ratio.max()) else "infinite"
            yield (
                f"The images of camera {camera.name} hardly tell its principal point from decentering distortion, "
                f"which is held at 0: with {' and '.join(terms)} free, its standard deviation would be {many}. Free "
                "them, or add images with other tilts."
            )


def curved_valley_warnings(run: Run, cofactor: Cofactor) -> Iterator[str]:
    """Warn where a principal point moved by FAR standard deviations, all else adjusted, fits as well."""
    problem = run.problem
    for name, positions in problem.unknowns.camera.items():
        free = positions[run.numbering.problem.prior_sigma[positions] > 0.0]
        covariance = cofactor.part(free)
        sigma = np.sqrt(np.diag(covariance))
        correlation = np.abs(covariance / np.outer(sigma, sigma))
        of_lens = ~np.isin(free, positions[: len(INTERIOR_NAMES)])
        for k, position in enumerate(free):
            is_unknown = position in positions[1 : len(INTERIOR_NAMES)] and np.isinf(problem.unknowns.sigma[position])
            if not is_unknown or correlation[k, of_lens].max(initial=0.0) < CORRELATED:
                continue
            rises = []
            for sign in (-1.0, 1.0):
                values = run.end.state.values.copy()
                values[position] += sign * FAR * sigma[k]
                held = replace(problem, unknowns=problem.unknowns.fixed([int(position)]))
                moved = again(replace(run, problem=held), run.weighting, STEPS, State(values, run.end.state.rotations))
                rises += [(moved.vpv - run.vpv, sign)] if moved.converged else []
            least, sign = min(rises, default=(np.inf, 0.0))
            if least < CURVED * FAR**2:
                what = problem.unknowns.parameters[position].quantity
                per_mm, unit = problem.network.camera_by_name[name].image_unit()
                moved_by = per_mm[list(positions).index(position) - 1] * sign * FAR * sigma[k]
                yield (
                    f"The images hardly tell {what} of camera {name} from its distortion, and its standard deviation "
                    f"is too small: moved by {moved_by:+.3g} {unit}, {FAR:g} of them, it fits "
                    f"{'better' if least < 0.0 else 'nearly as well'} (v'Pv rises by {least:.2g}, not by {FAR**2:g}). "
                    "Hold the decentering distortion at 0, give principal_point_mm, or add images with other tilts."
                )


def film_scale_notes(run: Run, cofactor: Cofactor) -> Iterator[str]:
    """Note where the fiducials of all films lie farther apart, or nearer, than given: c changes in that ratio."""
    problem, observations = run.problem, run.problem.network.observations
    for camera in problem.network.cameras:
        given = {id_: np.array([mark.x_mm.value, mark.y_mm.value]) for id_, mark in camera.fiducials.items()}
        scales = []
        for number, image in enumerate(problem.network.images):
            rows = np.flatnonzero(problem.is_fiducial & (problem.image_numbers == number))
            rows = np.array([row for row in rows if observations.point[row] in given], dtype=np.intp)
            if image.camera == camera.name and image.transformation != "congruent" and len(rows) > 2:
                places = np.array([given[observations.point[row]] for row in rows]), observations.xy_mm[rows]
                expected, found = (np.linalg.norm(each - each.mean(axis=0)) for each in places)
                scales.append(found / expected)
        at = problem.unknowns.camera.get(camera.name)
        if at is None or not scales:
            continue
        off, c_mm = float(np.mean(scales)) - 1.0, float(run.end.state.values[at[0]])
        sigma_mm = float(np.sqrt(cofactor.variances[at[0]]))
        if abs(off) > FILM_SCALE and 0.0 < CLAIMS * sigma_mm < abs(off) * c_mm:
            yield (
                f"The fiducials of camera {camera.name} lie {100.0 * abs(off):.2g} % "
                f"{'farther apart' if off > 0.0 else 'nearer to each other'} in the scans than given. c counts in the "
                f"unit of the given coordinates: if these are wrong, not the film or the scanner's pitch, c is "
                f"{abs(off) * c_mm:.2g} mm off."
            )
