"""Warnings about a result, each with its remedy."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.transformation import marks_needed
from adjust.least_squares.iteration import factorise
from adjust.problem.condition_equations import computed_observations
from adjust.problem.estimates import Cofactor
from adjust.problem.observations import Observations
from adjust.problem.parameter import description, shortened
from adjust.problem.problem import Problem
from adjust.quality.run import Residuals, Run
from adjust.rank_defect.diagnosis import loose_principal_distances, undetermined, weak_directions
from adjust.rank_defect.directions import weak_term_sentences
from adjust.solution.reweighting import ROUNDS

GROSS = 20.0  # in a-priori standard deviations: a larger residual may come from a confused mark
NEARER = 0.25  # fraction of the distance of two marks: largest offset of one from the other's expected place
NAMED = 5  # images named in a warning
UNCHECKED = 1e-6  # redundancy of all targets of an image below which its orientation is unchecked


def run_warnings(run: Run, cofactor: Cofactor, residuals: Residuals) -> list[str]:
    """Collect warnings on an adjustment: termination, weak parameters, swapped numbers, unchecked images."""
    problem, observations = run.problem, run.problem.network.observations
    unchecked = _unchecked_orientations(observations, residuals) if run.converged else []
    return [
        *_termination(run),
        *_weak_parameters(run, cofactor),
        *_points_without_image(problem),
        *_films_by_targets(problem),
        *_swapped_numbers(run, residuals),
        *_repeated_images(observations),
        *unchecked,
    ]


def _termination(run: Run) -> Iterator[str]:
    termination = run.solution.termination
    if termination == "iteration limit":
        yield (
            f"The iteration did not stand still within {len(run.solution.history)} steps: the values are not final. "
            f"The largest residuals are those of {_largest_residuals(run)}."
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
        yield from loose_principal_distances(problem, state, cofactor.variances)
        yield from weak_term_sentences(run.numbering, state, run.factor, cofactor)


def _points_without_image(problem: Problem) -> list[str]:
    """Warn of given points without an image."""
    points = [point.id for point in problem.network.points if point.id not in problem.unknowns.point]
    return [f"No image shows the object points {shortened(points, 5)}: they take no part."] if points else []


def _films_by_targets(problem: Problem) -> list[str]:
    """Warn of images with too few fiducial marks for their film transformation."""
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


def _is_gross(observations: Observations, v_mm: Array) -> Mask:
    """(n,) mask of residuals (n, 2) large enough to come from confused marks."""
    sigma = np.sqrt(np.trace(observations.covariance_mm2, axis1=1, axis2=2) / 2)
    return np.asarray(np.linalg.norm(v_mm, axis=1) > GROSS * sigma)


def _swapped_numbers(run: Run, residuals: Residuals) -> list[str]:
    """Find pairs of marks that each lie where the other is expected, unless most marks of the image do."""
    # The residuals at the start of the adjustment are used, since those orientations follow the majority of the marks.
    # At the end the adjustment has been distorted to fit the wrong ones.
    problem, observations = run.problem, run.problem.network.observations
    if run.converged and not _is_gross(observations, residuals.v_mm).any():
        return []
    started = computed_observations(problem, problem.start())
    if started is None:
        return []
    found = defaultdict[tuple[bool, str, str], list[str]](list)
    gross = _is_gross(observations, started - observations.xy_mm)
    for image, rows in _rows_by_image(observations).items():
        fiducial = observations.is_fiducial[rows]
        for kind in (False, True):
            marks = rows[fiducial == kind]
            pairs = combinations(marks[gross[marks]].tolist(), 2)
            crossed = [(i, j) for i, j in pairs if _cross(observations.xy_mm, started, i, j)]
            if 2 * len({row for pair in crossed for row in pair}) < len(marks):
                for i, j in crossed:
                    first, second = sorted((observations.point[i], observations.point[j]))
                    found[kind, first, second].append(image)
    return [_swapped(*pair, images) for pair, images in found.items()]


def _unchecked_orientations(observations: Observations, residuals: Residuals) -> list[str]:
    """Warn of images whose orientation no redundant target checks."""
    found = []
    for name, rows in _rows_by_image(observations).items():
        targets = rows[~observations.is_fiducial[rows]]
        if len(targets) and residuals.redundancy[targets].sum() < UNCHECKED:
            found.append(
                f"Nothing checks the orientation of image {name}: its {len(targets)} targets just determine it, "
                f"and an error of one of them would not show. Measure more targets in it."
            )
    return found


def _repeated_images(observations: Observations) -> list[str]:
    """Warn of images with the same coordinates of all marks: the same picture under two names."""
    first, pairs = dict[bytes, str](), []
    for name, rows in _rows_by_image(observations).items():
        ordered = rows[np.argsort(np.array(observations.point)[rows], kind="stable")]
        other = first.setdefault(observations.xy_mm[ordered].tobytes(), name)
        if other != name:
            pairs.append(f"{name} as {other}")
    if not pairs:
        return []
    return [
        f"All marks have the same coordinates in {shortened(pairs, NAMED)}: a picture under two names counts twice, "
        "and standard deviations are too small. Leave one of them out."
    ]


def _rows_by_image(observations: Observations) -> dict[str, Indices]:
    """Group the rows by image, in order of first appearance."""
    rows = defaultdict[str, list[int]](list)
    for row, image in enumerate(observations.image):
        rows[image].append(row)
    return {image: np.array(own, dtype=np.intp) for image, own in rows.items()}


def _cross(observed_mm: Array, expected_mm: Array, i: int, j: int) -> bool:
    """Whether two marks each lie where the other is expected."""
    off = np.linalg.norm(expected_mm[[i, j]] - observed_mm[[j, i]], axis=1)
    return bool(off.max() < NEARER * np.linalg.norm(observed_mm[i] - observed_mm[j]))


def _swapped(is_fiducial: bool, first: str, second: str, images: Sequence[str]) -> str:
    what, several = "fiducial marks" if is_fiducial else "points", len(images) > 1
    where = f"the images {shortened(images, NAMED)}" if several else f"image {images[0]}"
    return (
        f"The {what} {first} and {second} of {where} each lie where the other is expected: "
        f"their numbers{', or the coordinates given to them,' if several else ''} may be swapped."
    )
