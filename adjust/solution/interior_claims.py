"""Interior orientations that depend on what images do not tell: decentering in straight views of a flat field, say.

Decentering that is held at 0 is then taken up by the principal point; where it is free, standard deviations, which are
linear, may miss a curved valley and other minima. The principal distance of films has the unit of their fiducials.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.problem.estimates import Cofactor
from adjust.problem.problem import State
from adjust.quality.cofactor import free_cofactor
from adjust.quality.run import Run
from adjust.rank_defect.diagnosis import singular_directions
from adjust.solution.model_hypotheses import freed
from adjust.solution.reweighting import again

WORSE = 2.0  # ratio of standard deviations with decentering free and held at 0 above which it is told
CORRELATED = 0.9  # correlation of a principal point with a distortion parameter above which its valley is followed
FAR = 5.0  # standard deviations by which it is moved
FILM_SCALE = 1.5e-3  # film keeps its size better than that, most scanners too
CLAIMS = 5.0  # standard deviations of c by which another unit of the fiducials would move it
CURVED = 0.5  # share of the rise of v'Pv that these promise below which they are too small
STEPS = 60


def held_decentering_notes(run: Run, cofactor: Cofactor) -> Iterator[str]:
    """Note where the principal point depends on decentering distortion that is held at 0."""
    for camera in run.problem.network.cameras:
        of = family(camera.distortion.family)
        terms = dict(of.groups).get("decentering", ())[:2]
        positions = run.problem.unknowns.camera.get(camera.name)
        if positions is None or not terms:
            continue
        point, added = positions[1:3], positions[[3 + of.parameters.index(name) for name in terms]]
        sigma = run.numbering.problem.prior_sigma
        if sigma[added].any() or not sigma[point].all():
            continue
        weighted, covariance = run.weighting.applied(freed(run, added))
        numbering = Numbering(weighted)
        if (at := linearise(numbering, covariance, weighted.start())) is None:
            continue
        variances = np.full(2, np.inf)
        if not singular_directions(numbering, at.state, at.factor):
            variances = free_cofactor(numbering, at.state, at.factor).variances[point]
        ratio = np.sqrt(variances / cofactor.variances[point])
        if ratio.max() > WORSE:
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
                yield (
                    f"The images hardly tell {what} of camera {name} from its distortion, and its standard deviation "
                    f"is too small: moved by {sign * FAR * sigma[k]:+.2g} mm, {FAR:g} of them, it fits "
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
