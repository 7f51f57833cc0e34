"""Hypotheses on errors of the model: larger problems that start where the adjustment without their unknowns ended.

So one linearised step estimates the fall of v'Pv. The words of a hypothesis are made of the estimates of its unknowns:
here of the cameras (lens terms, pixels, interior orientations), and of scans and films.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.correction import AFFINITY_TERMS, ZERO, PolynomialTerms, Term, decentering, radial
from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES, Prior
from adjust.functional_model.scanner import is_left
from adjust.functional_model.transformation import LATTICE, film_kind, fit_transformation
from adjust.problem.camera import Camera
from adjust.problem.condition_equations import camera_places, image_displacements, remove_lens_effects
from adjust.problem.network import Approximations, Board, Network, Scanner, Transformation
from adjust.problem.parameter import shortened
from adjust.problem.problem import Problem, number
from adjust.quality.run import Run, free_quantities
from adjust.solution import partitions

FREE = Prior(0.0, np.inf)
NONE = partitions.Selection()
REFOCUSED = "Fix focus and zoom, switch autofocus and stabilisation off, and take the pictures again."
RADIAL_DEGREES = (3, 5, 7, 9, 11, 13)  # powers of the radius, as of k1 to k6
TERMS_TOGETHER = 2  # radial terms tested jointly
FEWEST_DRIFTING = 4  # images that tell a drift from their scatter
LEAST_CHANGE = 0.05  # of the distance
NAMED = 5  # images named in a message, and points with their errors
RICHER: dict[Transformation, tuple[Transformation, ...]] = {  # film deformation models tried for a simpler one
    "congruent": ("similarity", "affine"),
    "similarity": ("affine", "projective"),
    "affine": ("projective", "bilinear", "polynomial(2)"),
}
FEWEST_IMAGES = 2  # images that tell a rolling shutter
ALIKE = 7.0  # difference of chi-square plus twice the unknowns below which two readings are not distinguished


class Estimate(NamedTuple):
    """Unknowns (k,), their standard deviations (k,) and covariance (k, k), and the rms of the residuals explained."""

    value: Array
    sigma: Array
    covariance: Array
    rms_um: float = 0.0


Words = Callable[[Estimate], tuple[str, str]]  # cause, with figures, and remedy


@dataclass(frozen=True)
class ModelHypothesis:
    """Model with additional unknowns."""

    kind: str  # of what is wrong: "radial", "pixels", "groups", "drift", "interior", "board", "disks", "point", ...
    words: Words
    problem: Problem  # problem that starts where the simpler model ended
    added: Indices  # (k,) positions of the additional unknowns
    name: str = ""  # of the displacement that is added
    limits: tuple[float, float] = (-np.inf, np.inf)  # possible values of the unknowns
    selection: partitions.Selection = NONE
    shown: Indices | None = None  # positions of the unknowns that the words tell; all those added where None
    anew: Callable[[Run], Problem] | None = None  # the problem linearised anew where an adjustment of it ended


OTHERS = " (other images)"  # suffix of a camera's name for the images with a different interior orientation


def model_hypotheses(run: Run, is_suspicious: bool, is_fitted: bool) -> Iterator[ModelHypothesis]:
    """All hypotheses that apply on every camera, on scans and films.

    is_suspicious: whether residuals are larger than the given standard deviations allow; is_fitted: whether those of
    unmodelled errors were estimated from them.
    """
    network = run.problem.network
    used = run.problem.unknowns.camera.keys() - network.idle_cameras
    of_cameras = [_lens_terms, _drift, _wrong_interior_orientation]
    if not any(each.name.endswith(OTHERS) for each in network.cameras):
        of_cameras.append(_interior_orientations)
    if is_suspicious or is_fitted:
        of_cameras += [_own_affinities, _jumps]
    yield from chain(*(kind(run, camera) for kind in of_cameras for camera in network.cameras if camera.name in used))
    yield from _scanner_pixels(run)
    if is_suspicious:
        yield from film_deformations(run)


def displace_points(run: Run, name: str, kind: str, words: Words, directions: Array) -> ModelHypothesis:
    """Add displacements of the targets' points (n, k, 3), or of their images (n, k, 2), as unknowns."""
    network = run.problem.network
    board = Board(name, {}, (FREE,) * directions.shape[1], directions)
    problem = continue_problem(run, replace(network, boards=(*network.boards, board)))
    return ModelHypothesis(kind, words, problem, problem.unknowns.board[name], name=name)


def free_and_continue(run: Run, positions: Indices) -> Problem:
    """Free some quantities of a problem; start where an adjustment ended."""
    return free_quantities(continue_problem(run, run.problem.network), positions)


def continue_problem(run: Run, network: Network, like: Mapping[str, str] | None = None) -> Problem:
    """Number a network with additional unknowns; start where an adjustment ended, in its datum.

    like: additional cameras, with those whose interior orientation they start with.
    """
    old, values, mirrored = run.problem.unknowns, run.end.state.values, run.problem.mirrored
    interior = {name: values[at[: len(INTERIOR_NAMES)]] for name, at in old.camera.items()}
    transformation = dict[str, Array]()
    for image, before in zip(network.images, run.problem.network.images, strict=True):
        parameters = values[old.transformation[image.name]]
        if image.transformation != before.transformation:  # the kind before is a special case of it
            places = film_kind(before.transformation, image.name in mirrored).apply(parameters, LATTICE)
            parameters, _ = fit_transformation(image.transformation, LATTICE, places)
        transformation[image.name] = parameters
    state = Approximations(
        interior=interior | {name: interior[other] for name, other in (like or {}).items()},
        exterior={image.name: values[old.exterior[image.name]] for image in network.images},
        transformation=transformation,
        points={id_: values[at] for id_, at in old.point.items()},
        mirrored=mirrored,
        joins={key: values[at] for key, at in old.join.items()},
    )
    problem = number(network, state, run.problem.by_elements)
    unknowns, position = problem.unknowns, {parameter: i for i, parameter in enumerate(old.parameters)}
    new = np.array([i for i, parameter in enumerate(unknowns.parameters) if parameter in position], dtype=np.intp)
    at = np.array([position[unknowns.parameters[i]] for i in new], dtype=np.intp)
    given, sigma, start = unknowns.given.copy(), unknowns.sigma.copy(), unknowns.start.copy()
    given[new], sigma[new], start[new] = old.given[at], old.sigma[at], values[at]
    return replace(problem, unknowns=replace(unknowns, given=given, sigma=sigma, start=start))


# Of the six terms of degree 2 two are decentering, and the tilts of the images take two.
BOW: tuple[Term, Term] = (({(0, 2): 1.0}, ZERO), (ZERO, {(2, 0): 1.0}))


def _lens_terms(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """The lowest radial terms that a camera lacks, its next decentering terms, a bow, and affinity of the pixels.

    Radial and decentering (Juhl: tangential) terms are those of its distortion family that are held, if there are any;
    all others are polynomials of the image point in units of half the frame, so that their parameters are in mm at its
    edge.
    """
    network, groups = run.problem.network, dict(family(camera.distortion.family).groups)
    positions, unknowns = run.problem.lens_positions(camera.name), run.problem.unknowns
    free = {name for name, at in positions.items() if unknowns.sigma[at] > 0.0}
    own_group = "tangential" if "tangential" in groups else "decentering"
    held = {
        "radial": _held_terms(camera, "radial", free)[:TERMS_TOGETHER],
        "decentering": _held_terms(camera, own_group, free),
    }
    images = [image for image in network.images if image.camera == camera.name]
    half_mm = camera.distortion.half_mm[0] or max(network.extent_by_image[image.name].half_mm for image in images)
    degree_of = {name: 3 + 2 * k for k, name in enumerate(groups.get("radial", ()))}
    estimated = {degree for name, degree in degree_of.items() if name in free}
    degrees = [degree for degree in RADIAL_DEGREES if degree not in estimated] or RADIAL_DEGREES[-TERMS_TOGETHER:]
    degrees = [degree_of[name] for name in held["radial"]] or degrees[:TERMS_TOGETHER]
    pattern = f"a radial pattern, of the degrees {', '.join(map(str, degrees))} in r"
    rows: list[tuple[str, Sequence[Term], Words]] = [
        ("radial", [radial((degree - 1) // 2) for degree in degrees], _too_simple_words(camera, "radial", pattern))
    ]
    words = _too_simple_words(camera, own_group, "a tangential pattern (decentering)")
    rows.append(("decentering", decentering(int(bool(free.intersection(groups.get("decentering", ()))))), words))
    rows.append(("bow", BOW, partial(_bow_words, camera)))
    if all(image.transformation == "none" for image in images):
        affinity: tuple[tuple[str, Words], ...] = (
            ("pixels", _pixel_words(camera.name, 1.0 / half_mm)),
            ("shear", partial(_shear_words, camera.name, half_mm)),
        )
        for k, (name, words) in enumerate(affinity):
            if not free.intersection(groups.get("affinity", ())[k : k + 1]):
                rows.append((name, AFFINITY_TERMS[k : k + 1], words))
    for name, terms, words in rows:
        if own := held.get(name):
            added = np.array([positions[each] for each in own])
            yield ModelHypothesis(name, words, free_and_continue(run, added), added)
            continue

        def fields(places: Array, terms: Sequence[Term] = terms) -> Array:
            at = PolynomialTerms.from_terms(terms).correction(places, np.zeros(2), np.zeros(len(terms)), half_mm)
            return at.parameter_jacobian.swapaxes(1, 2)

        yield _displaced_images(run, name, name, camera, words, fields)


def _held_terms(camera: Camera, group: str, free: Collection[str]) -> list[str]:
    """Terms of a group of the camera's distortion family that are not free."""
    lens_family = family(camera.distortion.family)
    # Terms of a denominator have the same derivatives at 0 as others: they are freed last, by hand.
    return [
        name
        for name in dict(lens_family.groups).get(group, ())
        if name not in lens_family.alike_at_zero and name not in free
    ]


def _too_simple_words(camera: Camera, group: str, what: str) -> Words:
    """Words on a lens model without terms of a group; what: pattern of the residuals."""
    distortion = camera.distortion
    fixed = _held_terms(camera, group, distortion.free)
    if distortion.family == "none":
        terms = "k1 and k2" if group == "radial" else "p1 and p2"
        remedy = f'Give the camera a [distortion] of the family "brown", say, with {terms} free.'
    elif fixed:
        remedy = f'Free {", ".join(fixed)} under [distortion.sigma] of the camera ("free").'
    else:
        remedy = "Choose a distortion family with more terms, legendre(5) say; `reseau choose` compares some."
    wrong = [name for name in fixed if name in distortion.parameters and distortion.parameters[name].value]
    doubt = f", or what is given as exact, {', '.join(wrong)}, is wrong" if wrong else ""
    cause = f"The lens model of camera {camera.name} is too simple{doubt}: the residuals have {what}"
    per_mm, unit = camera.image_unit(UM_PER_MM, "µm")
    return lambda found: (f"{cause}, {per_mm[0] * found.rms_um / UM_PER_MM:.2g} {unit} rms", remedy)


def _bow_words(camera: Camera, found: Estimate) -> tuple[str, str]:
    per_mm, unit = camera.image_unit(UM_PER_MM, "µm")
    (x, y), sigma = per_mm * found.value, np.abs(per_mm) * found.sigma
    return (
        f"The pictures of camera {camera.name} are bowed: half the frame off the middle, columns lie {x:+.3g} ± "
        f"{sigma[0]:.1g} {unit} aside and rows {y:+.3g} ± {sigma[1]:.1g} {unit}",
        "Look for a rolling shutter, stabilisation or a scanner's lens. Use a distortion family with such "
        "terms, for example legendre(3).",
    )


def _shear_words(camera: str, half_mm: float, found: Estimate) -> tuple[str, str]:
    return (
        f"The axes of the pictures of camera {camera} are not perpendicular: b2 = {found.value[0] / half_mm:+.2g} ± "
        f"{found.sigma[0] / half_mm:.1g}",
        "Free the shear b2 of the distortion (families brown, opencv), or scan them once more: sensors have none.",
    )


def _pixel_words(camera: str, per_mm: float) -> Words:
    """Words on pixels that are not square; per_mm: change of the aspect ratio per mm of the added unknown."""

    def words(found: Estimate) -> tuple[str, str]:
        off, sigma = per_mm * float(found.value[0]), per_mm * found.sigma[0]
        return (
            f"The pixels of camera {camera} are not square: their width is {1.0 - off:.6f} ± {sigma:.6f} times their "
            f"height (b1 = {off:+.2g})",
            f"Give pitch_um as [x, y] with x / y = {1.0 - off:.6f}, or free the affinity b1 of the distortion "
            "(families brown, opencv).",
        )

    return words


def _own_affinities(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """An affinity of each digital image's own, as a camera or object that moves while rows are read gives it."""
    network, rows = run.problem.network, run.problem.targets_by_camera[camera.name]
    names = [network.images[number].name for number in np.unique(run.problem.image_numbers[rows])]
    films = {image.transformation for image in network.images if image.camera == camera.name}
    if len(names) < FEWEST_IMAGES or films != {"none"}:
        return

    def words(found: Estimate) -> tuple[str, str]:
        sizes = np.hypot(*(found.value.reshape(-1, 2) - (1.0, 0.0)).T)
        worst = shortened([names[k] for k in np.argsort(-sizes, kind="stable")], NAMED)
        return (
            f"The images of camera {camera.name} are distorted each in its own way, stretched or sheared by up to "
            f"{100.0 * sizes.max():.2g} % (largest first: {worst}), or each has a principal point of its own",
            "Look for motion of camera or object while a picture was taken (rolling shutter, long exposure) and for "
            "stabilisation: fix both, give more light, and take the pictures again.",
        )

    # As of a film, whose unknowns are eliminated with the exterior orientation: the cost is linear in the images.
    images = tuple(replace(each, transformation="affine") if each.name in names else each for each in network.images)
    problem = continue_problem(run, replace(network, images=images))
    lens_family = family(camera.distortion.family)
    unknowns, sigma = problem.unknowns, problem.unknowns.sigma.copy()
    affine = np.array([unknowns.transformation[name] for name in names])
    added = affine[:, 1:3].ravel()
    # Affinities of all images of a flat object leave the interior orientation open, and contain the camera's own: these
    # are held where they are, but where they are given with a standard deviation, which is an observation.
    known = {*INTERIOR_NAMES, *dict(lens_family.groups).get("affinity", ())}
    own = unknowns.camera[camera.name][[name in known for name in (*INTERIOR_NAMES, *lens_family.parameters)]]
    sigma[own[np.isinf(sigma[own])]] = 0.0
    sigma[np.setdiff1d(affine, added)] = 0.0
    held = replace(problem, unknowns=replace(unknowns, sigma=sigma))
    yield ModelHypothesis("affinities", words, held, added)


def _drift(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """A principal distance that changes with the number of the image, or with the distance of the object."""
    problem, state = run.problem, run.end.state
    rows = problem.targets_by_camera[camera.name]
    shown, of_row, counts = np.unique(problem.image_numbers[rows], return_inverse=True, return_counts=True)
    if len(shown) < FEWEST_DRIFTING:
        return
    points = state.values[problem.places[rows]]
    middle = np.stack([np.bincount(of_row, points[:, k]) for k in range(3)], axis=1) / counts[:, None]
    nearness = 1.0 / np.linalg.norm(middle - state.values[problem.exterior[shown, :3]], axis=1)

    distance = state.values[problem.unknowns.camera[camera.name][0]] / 100.0

    def words(along: str) -> Words:
        return lambda found: (
            f"The principal distance of camera {camera.name} changes {along}, by {found.value[0] / distance:+.3g} ± "
            f"{found.sigma[0] / distance:.1g} %: the focus drifts",
            REFOCUSED,
        )

    for name, by, along in (
        ("order", np.arange(len(shown), dtype=float), "from the first image to the last"),
        ("nearness", nearness, "from the farthest image to the nearest"),
    ):
        if np.ptp(by) > LEAST_CHANGE * by.max():
            share = np.zeros((len(problem.image_numbers), 1, 1))
            share[rows, 0, 0] = ((by - by.mean()) / np.ptp(by))[of_row] / (100.0 * distance)

            def fields(places: Array, share: Array = share) -> Array:
                return places[:, None] * share

            yield _displaced_images(run, name, "drift", camera, words(along), fields)


def _displaced_images(
    run: Run, name: str, kind: str, camera: Camera, words: Words, fields: Callable[[Array], Array]
) -> ModelHypothesis:
    """Add displacements of the camera's images as unknowns.

    fields: displacements (n, k, 2) in mm at places (n, 2) in mm from the principal point.
    """
    own = f"{name} of {camera.name}"

    def fields_mm(last: Run) -> Array:
        at = fields(_from_principal_point(last, camera.name))
        # What the lens has is no part of what it lacks, even where it is given with a standard deviation.
        is_of_lens = kind in ("radial", "decentering")
        return (
            remove_lens_effects(last.problem, last.end.state, last.end.computed_mm, camera.name, at)
            if is_of_lens
            else at
        )

    def anew(last: Run) -> Problem:
        """Take the displacements from where the images lie with them in the model."""
        network, at = last.problem.network, fields_mm(last)
        boards = (replace(each, by_observation=at) if each.name == own else each for each in network.boards)
        return continue_problem(last, replace(network, boards=tuple(boards)))

    return replace(displace_points(run, own, kind, words, fields_mm(run)), anew=anew)


def _from_principal_point(run: Run, camera: str) -> Array:
    """(n, 2) mm, adjusted image points of a camera without displacements, relative to its principal point.

    They are 0 for other marks.
    """
    problem, state, xy_mm = run.problem, run.end.state, np.zeros_like(run.end.v_mm)
    rows = problem.targets_by_camera[camera]
    # Observed places have the residuals' errors.
    camera_xy = camera_places(problem, state, run.end.computed_mm)[rows]
    xy_mm[rows] = (
        camera_xy - image_displacements(problem, state, rows) - state.values[problem.unknowns.camera[camera][1:3]]
    )
    return xy_mm


def _scanner_pixels(run: Run) -> Iterator[ModelHypothesis]:
    """A scanner that stretches one axis, where film transformations do not absorb that."""
    network = run.problem.network
    films = [image for image in network.images if image.transformation != "none"]
    if not films or network.scanners or not all(is_left(image.transformation, "stretch") for image in films):
        return
    extents = [network.extent_by_image[image.name] for image in films]
    x, y = np.mean([extent.center_mm for extent in extents], axis=0).tolist()
    half_mm = max(extent.half_mm for extent in extents)
    scanner = Scanner("scanner", {"stretch": FREE}, (x, y), (half_mm, half_mm))
    images = tuple(replace(image, scanner=scanner.name) if image in films else image for image in network.images)
    problem = continue_problem(run, replace(network, images=images, scanners=(scanner,)))
    words = _pixel_words(films[0].camera, 2.0 / half_mm)
    yield ModelHypothesis("pixels", words, problem, problem.unknowns.scanner[scanner.name])


def _jumps(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """A displacement of all marks beyond a row or column of one digital image, or of all: a jump of the scanner."""
    rows = run.problem.targets_by_camera[camera.name]
    if any(each.transformation != "none" for each in run.problem.network.images if each.camera == camera.name):
        return
    for jump in partitions.jumps(run, rows):
        who = f"image {jump.image}" if jump.image else f"the images of camera {camera.name}"
        per_mm, unit = camera.image_unit()
        where = (
            f"{'above' if jump.axis else 'right of'} {'xy'[jump.axis]} = {per_mm[jump.axis] * jump.cut_mm:.4g} {unit}"
        )

        def words(found: Estimate, who: str = who, where: str = where) -> tuple[str, str]:
            per_mm, unit = camera.image_unit(UM_PER_MM, "µm")
            (x, y), sigma = per_mm * found.value, np.abs(per_mm) * found.sigma
            return (
                f"All marks of {who} {where} are displaced against the others, by ({x:+.3g}, {y:+.3g}) ± "
                f"({sigma[0]:.1g}, {sigma[1]:.1g}) {unit}: the sensor, or what copied the picture, jumps there",
                "Take or scan the picture again, or check whether it was joined from parts.",
            )

        def fields(_: Array, beyond: Mask = jump.beyond) -> Array:
            return np.asarray(beyond[:, None, None] * np.eye(2))

        found = _displaced_images(run, f"jump {jump.image}", "jump", camera, words, fields)
        # The best of as many jumps as there are coordinates.
        yield replace(
            found, selection=partitions.Selection(choices=float(np.log(2.0 * len(rows))), contrasts=2 * len(rows))
        )


def film_deformations(run: Run) -> Iterator[ModelHypothesis]:
    """Films that are deformed, each in its own way, by more than their transformation models, and one such film."""
    network, problem = run.problem.network, run.problem
    given = {image.transformation for image in network.images} - {"none"}
    films = [image.name for image in network.images if image.transformation in given]
    squares = (run.misfits.residual[: len(problem.image_numbers)] ** 2).sum(axis=1)
    sizes = dict(zip((each.name for each in network.images), np.bincount(problem.image_numbers, squares), strict=False))
    worst = max(films, key=lambda name: sizes.get(name, 0.0), default="")
    kinds = RICHER.get(min(given), ()) if len(given) == 1 else ()
    for kind, some in chain(((kind, films) for kind in kinds), ((kind, [worst]) for kind in kinds[-1:])):
        images = tuple(replace(each, transformation=kind) if each.name in some else each for each in network.images)
        larger = continue_problem(run, replace(network, images=images))
        count = len(problem.unknowns.transformation[worst])
        added = np.concatenate([larger.unknowns.transformation[name][count:] for name in some])
        if some is films:
            yield ModelHypothesis("film", partial(_film_words, min(given), kind), larger, added)
        elif len(films) > 1:
            best = partitions.Selection(choices=float(np.log(len(films))), contrasts=len(added) * len(films))
            words = partial(_single_film_words, worst, min(given))
            yield ModelHypothesis("single film", words, larger, added, selection=best)


def _film_words(given: Transformation, kind: Transformation, found: Estimate) -> tuple[str, str]:
    return (
        f"The film deformation model, {given}, is too simple: the films are deformed, each in its own way; a {kind} "
        f"one explains {found.rms_um:.2g} µm rms",
        f'Give transformation = "{kind}" under [adjust].',
    )


def _single_film_words(image: str, given: Transformation, _: Estimate) -> tuple[str, str]:
    return (
        f"Only the film of image {image} is deformed by more than its transformation ({given}) models",
        "Look for stretched or torn film, or a frame of another camera, and scan it again or leave it out.",
    )


def _wrong_interior_orientation(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """Wrong values of c, x0 and y0 that are given as exact."""
    unknowns = run.problem.unknowns
    added = unknowns.camera[camera.name][: len(INTERIOR_NAMES)]
    added = added[unknowns.sigma[added] == 0.0]
    names, given = [unknowns.parameters[i].quantity for i in added], unknowns.given[added]

    def words(found: Estimate) -> tuple[str, str]:
        rows = zip(names, found.value, found.sigma, given, strict=True)
        changes = ", ".join(f"{name} = {v:.5g} ± {s:.1g} in place of {g:.5g} mm" for name, v, s, g in rows)
        return (
            f"The interior orientation given for camera {camera.name} as exact is not that of the images: {changes}",
            "Correct it, or give its standard deviations.",
        )

    if len(added):
        yield ModelHypothesis("interior", words, free_and_continue(run, added), added)


def _interior_orientations(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """Another interior orientation for some of the camera's images, or another principal distance or point for each."""
    equations = partitions.interior_equations(run, camera.name)
    if (groups := partitions.two_groups(run, camera.name, equations)) is not None:
        who = f"the images {shortened(groups.names, NAMED)} ({len(groups.names)} of {len(equations.names)})"
        others = dict.fromkeys(groups.names, camera.name + OTHERS)
        problem, added = _separate_cameras(run, camera, others, slice(0, 3))
        shown = np.concatenate([added, problem.unknowns.camera[camera.name][: len(INTERIOR_NAMES)]])
        words = partial(group_words, f"{who} of camera {camera.name}")
        yield ModelHypothesis("groups", words, problem, added, selection=groups, shown=shown)
    for part, images in partitions.own_interiors(run, equations):
        others = {name: f"{camera.name}, {name}{OTHERS}" for name in images.names}
        problem, added = _separate_cameras(run, camera, others, part)
        shown = np.append(problem.unknowns.camera[camera.name][part], added)
        if part.start == 0:
            words = partial(_distance_words, camera.name, equations.names)
            yield ModelHypothesis("distances", words, problem, added, selection=images, shown=shown)
        elif not camera.fiducials:
            words = partial(_principal_point_words, camera, equations.names)
            yield ModelHypothesis("principal points", words, problem, added, selection=images, shown=shown)


def _separate_cameras(run: Run, camera: Camera, others: Mapping[str, str], part: slice) -> tuple[Problem, Indices]:
    """Give some frames cameras of other names that differ in a part of INTERIOR_NAMES; also return these unknowns."""
    network, names = run.problem.network, dict.fromkeys(others.values(), camera.name)
    images = tuple(replace(each, camera=others.get(each.frame, each.camera)) for each in network.images)
    cameras = (*network.cameras, *(replace(camera, name=name) for name in names))
    problem = continue_problem(run, replace(network, images=images, cameras=cameras), names)
    unknowns = problem.unknowns
    given, sigma, start = unknowns.given.copy(), unknowns.sigma.copy(), unknowns.start.copy()
    of_camera, fiducial, own = dict(unknowns.camera), dict(unknowns.fiducial), unknowns.camera[camera.name]
    for name in names:
        free = of_camera[name][part]
        # All else, and the fiducial marks, are those of the camera.
        sigma[of_camera[name]] = 0.0
        given[free], sigma[free], start[free] = np.nan, np.inf, start[own[part]]
        of_camera[name] = own.copy()
        of_camera[name][part] = free
        for (owner, id_), pair in unknowns.fiducial.items():
            if owner == name:
                sigma[pair] = 0.0
                fiducial[name, id_] = fiducial[camera.name, id_]
    shared = replace(unknowns, given=given, sigma=sigma, start=start, camera=of_camera, fiducial=fiducial)
    return replace(problem, unknowns=shared), np.concatenate([of_camera[name][part] for name in names])


def _distance_words(camera: str, images: Sequence[str], found: Estimate) -> tuple[str, str]:
    """Describe principal distances of the images by the shortest and the longest."""
    first, last = np.argsort(found.value)[[0, -1]]
    shortest = found.value[first]
    longer, sigma = found.value[last] / shortest - 1.0, np.hypot(*found.sigma[[first, last]]) / shortest
    return (
        f"The principal distance of camera {camera} differs from image to image, by {100.0 * longer:.3g} ± "
        f"{100.0 * sigma:.1g} % between {images[first]} and {images[last]}: focus or zoom changed",
        REFOCUSED,
    )


def _principal_point_words(camera: Camera, images: Sequence[str], found: Estimate) -> tuple[str, str]:
    """Describe principal points of the images by their scatter and the two that lie farthest apart."""
    per_mm, unit = camera.image_unit()
    xy, sigma = per_mm * found.value.reshape(-1, 2), np.abs(per_mm) * found.sigma.reshape(-1, 2)
    axis = int(np.argmax(np.ptp(xy, axis=0)))
    first, last = np.argsort(xy[:, axis])[[0, -1]]
    return (
        f"The principal point of camera {camera.name} differs from image to image, by {np.ptp(xy[:, axis]):.3g} ± "
        f"{np.hypot(*sigma[[first, last], axis]):.1g} {unit} in {'xy'[axis]} between {images[first]} and "
        f"{images[last]}: lens or sensor moved, or pictures are cropped each otherwise",
        "Switch stabilisation off, hold the lens, use pictures as the camera takes them, and take them again.",
    )


def group_words(who: str, found: Estimate) -> tuple[str, str]:
    """Describe images unlike the others by the simplest differences of interior orientation that fit.

    They are given in fractions of c: the pixels of digital cameras may have no size.
    """
    base, difference = found.value[3:], found.value[:3] - found.value[3:]
    by_both = np.hstack([np.eye(3), -np.eye(3)])
    spread = by_both @ found.covariance @ by_both.T
    sigma, weight = np.sqrt(np.diag(spread)), np.linalg.pinv(spread, hermitian=True)
    scale = 1.0 + float(difference @ base) / float(base @ base)
    (c, x0, y0), (c_sigma, x0_sigma, y0_sigma) = 100.0 * difference / base[0], 100.0 * sigma / base[0]
    readings = (
        (
            np.eye(3)[:, :1],
            f"{who} have another principal distance than the others, by {c:+.3g} ± {c_sigma:.1g} % "
            "(zoom or focus changed)",
        ),
        (
            np.eye(3)[:, 1:],
            f"{who} have another principal point than the others, by ({x0:+.3g}, {y0:+.3g}) ± "
            f"({x0_sigma:.1g}, {y0_sigma:.1g}) % of c: images of different sizes in one camera (cropped), or turned or "
            "mirrored pictures",
        ),
        (
            base[:, None] / np.linalg.norm(base),
            f"{who} are {scale:.5g} times as large as the others: images of different sizes in one camera (scaled)",
        ),
        (
            np.eye(3),
            f"{who} have another interior orientation than the others: c is {1.0 + c / 100.0:.4g} times "
            f"as long, the principal point ({x0:+.3g}, {y0:+.3g}) % of c off (another camera, or "
            "pictures cropped and enlarged)",
        ),
    )
    costs = []  # chi-square of the difference constrained to the directions of a reading, and twice their number
    for along, _ in readings:
        inverse = np.linalg.pinv(along.T @ weight @ along, hermitian=True)
        rest = difference - along @ inverse @ (along.T @ weight @ difference)
        costs.append(float(rest @ weight @ rest) + 2.0 * along.shape[1])
    fitting = [each for each, cost in zip(readings, costs, strict=True) if cost < min(costs) + ALIKE]
    special = [cause for along, cause in fitting if along.shape[1] < len(base)]
    causes = "; or ".join(special or [cause for _, cause in fitting])
    return (
        f"{causes[0].upper()}{causes[1:]}",
        "Give these images a camera of their own (column camera of images.csv), or a folder and project of their own.",
    )
