"""Tests of camera, scanner and board parameters, and high correlations of a camera's parameters, in words.

The null hypothesis is 0 for distortion and the given value for c, x0' and y0'. The difference d of k parameters from it
has the cofactor Q; F = d' Q⁻¹ d / (k sigma0²) is F(k, r) distributed with the redundancy r, its root Student's t for
k = 1. A given value with a prior sigma differs by -v, of the cofactor sigma² - q (Koch 1999, 4.2 and 4.3).

A whole calibration with covariance C = L L' and residuals v is tested by u' S⁺ u, u = L⁻¹ v, S = I - H: chi-square with
the rank of S as degrees of freedom (Baarda 1968; Förstner and Wrobel, 4.6.4).

Correlations are with each other and with exterior orientations. The datum of the fiducial marks is held first: where
only priors of 1 mm define it, interior orientation and marks share its uncertainty, which hides the correlations that
matter. Exterior orientations are described in the axes of the camera: along its axis, across it, and tilts.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtr, stdtr

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.functional_model.rotation import rotation_from_angles, vector_by_angles
from adjust.problem.camera import Camera
from adjust.problem.estimates import Estimates, GivenGroup
from adjust.problem.further_observations import ObservedCalibration
from adjust.problem.network import EXTERIOR_NAMES
from adjust.problem.parameter import MANY, Kind, Parameter, shortened
from adjust.quality.run import Run, surplus
from adjust.rank_defect.directions import FIELD

LEVEL = 0.01  # significance level: probability of calling a superfluous parameter significant
FIXED = Prior(0.0)
UNCHECKED = 1e-6  # redundancy of a prior below which it cannot be tested
UNSEEN = 1e-6  # least redundancy of a direction that the other observations determine
HIGH = 0.95  # correlation from which quantities are reported as hardly separable
IMAGES_AT_ONCE = 16  # bounds the memory of correlations
SHARE = 0.3  # least share in a direction of an element of the exterior orientation that is named
SHOWN = 3  # images named one by one


@dataclass(frozen=True)
class SignificanceTest:
    """Significance test of parameters, by their names in the family or c, x0, y0.

    statistic: t of one parameter, F of a group. p: p-value.
    """

    name: str
    parameters: tuple[str, ...]
    statistic: float
    p: float

    @property
    def is_group(self) -> bool:
        return len(self.parameters) > 1

    @property
    def significant(self) -> bool:
        return self.p < LEVEL


def f_probability(statistic: float, freedom: int, redundancy: float) -> float:
    """P-value of an F statistic; without redundancy of a chi-square one over its degrees of freedom."""
    return float(fdtrc(freedom, redundancy, statistic) if redundancy > 0 else chdtrc(freedom, statistic * freedom))


def significance_tests(estimates: Estimates) -> dict[tuple[str, str], tuple[SignificanceTest, ...]]:
    """Test every estimated parameter, then groups of at least two.

    Parameters
    ----------
    estimates : of a network; nothing is tested without a solution

    Returns
    -------
    dict
        By kind and owner. "interior": c, x0, y0 where a value is given, the distortion's parameters, every group of its
        family, and "all" of them together. "scanner": the terms of the bend. "board": the bends along both axes.
    """
    if not estimates.converged:
        return {}
    network, tests = estimates.network, dict[tuple[str, str], tuple[SignificanceTest, ...]]()
    for camera in network.cameras:
        if camera.name not in network.idle_cameras:
            interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
            given = (_against_given(estimates, camera.name, name, prior) for name, prior in interior.items())
            lens = family(camera.distortion.family)
            priors = {name: camera.distortion.parameters.get(name, FIXED) for name in lens.parameters}
            own = _against_zero(estimates, "interior", camera.name, priors, dict(lens.groups))
            tests["interior", camera.name] = (*filter(None, given), *own)
    for scanner in network.scanners:
        tests["scanner", scanner.name] = _against_zero(estimates, "scanner", scanner.name, scanner.terms)
    for board in network.boards:
        bends = dict(zip(board.names, board.bends, strict=True))
        tests["board", board.name] = _against_zero(estimates, "board", board.name, bends)
    return tests


def _against_zero(
    estimates: Estimates,
    kind: Kind,
    owner: str,
    priors: Mapping[str, Prior],
    groups: Mapping[str, Sequence[str]] | None = None,
) -> tuple[SignificanceTest, ...]:
    """Tests of the quantities that are not fixed: single, in groups, and all together if no group holds all."""
    estimated = tuple(name for name, prior in priors.items() if prior.sigma > 0.0)
    several = {name: tuple(each for each in members if each in estimated) for name, members in (groups or {}).items()}
    several = {name: members for name, members in several.items() if len(members) > 1}
    if len(estimated) > 1 and list(several.values()) != [estimated]:
        several["all"] = estimated
    tests = []
    for name, quantities in [*((name, (name,)) for name in estimated), *several.items()]:
        tested = [Parameter(kind, owner, "", each) for each in quantities]
        values, cofactor = estimates.values_of(tested), estimates.cofactor_of(tested)
        tests.append(_significance_test(estimates, name, quantities, values, cofactor))
    return tuple(tests)


def _against_given(estimates: Estimates, camera: str, name: str, prior: Prior | None) -> SignificanceTest | None:
    full = Parameter.interior(camera, name)
    if prior is None or prior.sigma == 0.0:
        return None
    cofactor = float(estimates.cofactor_of([full])[0, 0])
    if np.isfinite(prior.sigma):
        given = prior.sigma**2
        if GivenGroup("interior", camera) in estimates.variance.left_out:
            given /= estimates.sigma0**2
        redundancy = 1.0 - cofactor / given
        if redundancy < UNCHECKED:
            return None
        cofactor = given * redundancy
    difference = np.array([estimates.value(full) - prior.value])
    return _significance_test(estimates, name, (name,), difference, np.array([[cofactor]]))


def _significance_test(
    estimates: Estimates, name: str, parameters: tuple[str, ...], difference: Array, cofactor: Array
) -> SignificanceTest:
    scale, count = np.sqrt(np.diag(cofactor)), len(parameters)
    normalised, r = difference / scale, estimates.variance.redundancy
    if count == 1:
        t = float(normalised[0]) / estimates.sigma0
        one_sided = stdtr(r, -abs(t)) if r > 0 else ndtr(-abs(t))
        return SignificanceTest(name, parameters, t, 2.0 * float(one_sided))
    square = float(normalised @ np.linalg.solve(cofactor / np.outer(scale, scale), normalised))
    statistic = square / (count * estimates.sigma0**2)
    return SignificanceTest(name, parameters, statistic, f_probability(statistic, count, r))


@dataclass(frozen=True, eq=False)
class CalibrationTest:
    """Compatibility test of the images with correlated observations."""

    group: str
    parameters: tuple[Parameter, ...]  # (m,)
    # difference, sigma: (m,) value from the images minus observed value, and its a-posteriori standard deviation; nan
    # and inf where the images do not determine it
    difference: Array
    sigma: Array
    statistic: float  # of all together, F with `freedom` and the redundancy of the other observations
    freedom: int
    probability: float  # p-value

    @property
    def direction(self) -> tuple[int, ...]:
        """Indices of the quantities, sorted by the difference in standard deviations, the largest first."""
        size = np.where(np.isfinite(self.difference), np.abs(self.difference) / self.sigma, 0.0)
        return tuple(np.argsort(-size, kind="stable").tolist())


def calibration_tests(run: Run, sigma0: float, redundancy: float) -> Iterator[CalibrationTest]:
    """Test every earlier calibration of several quantities; sigma0, redundancy: of the whole adjustment."""
    vpv = sigma0**2 * redundancy
    for each, block in zip(run.problem.further, run.end.rows.further, strict=True):
        if not isinstance(each, ObservedCalibration) or len(each.observed) < 2:
            continue
        root = np.linalg.cholesky(each.covariance)
        free, directions = np.linalg.eigh(surplus(block, run.factor))
        visible = free > UNSEEN
        freedom = int(visible.sum())
        if not freedom:
            continue
        u = directions.T @ np.linalg.solve(root, each.computed(run.end.state.values) - each.observed)
        chi_square = float((u[visible] ** 2 / free[visible]).sum())
        left = round(redundancy) - freedom
        variance = (vpv - chi_square) / left if left > 0 and vpv > chi_square else 1.0
        # The frame of the marks can shift, rotate and scale together with the camera. Undetermined changes are combined
        # with the others such that the marks move least: as in a comparison of two calibrations, the change of c is
        # then the one relative to the marks.
        along, is_mark = root @ directions, np.array([one.kind == "fiducial" for one in each.parameters])
        by_marks = np.linalg.pinv(along[:, ~visible] * is_mark[:, None], rcond=UNSEEN)
        along = along - along[:, ~visible] @ (by_marks @ along)
        difference = along[:, visible] @ (u[visible] / free[visible])
        sigma = np.sqrt(variance * (along[:, visible] ** 2 / free[visible]).sum(axis=1))
        hidden = (along[:, ~visible] ** 2).sum(axis=1) > UNSEEN * np.diag(each.covariance)
        test = chi_square / freedom / variance
        yield CalibrationTest(
            group=each.group,
            parameters=each.parameters,
            difference=np.where(hidden, np.nan, difference),
            sigma=np.where(hidden, np.inf, sigma),
            statistic=test,
            freedom=freedom,
            probability=f_probability(test, freedom, left),
        )


DIRECTIONS = (  # of an exterior orientation: kind, and words
    ("across", "the station's place across its axis in x'"),
    ("across", "the station's place across its axis in y'"),
    ("along", "the station's distance along its axis"),
    ("tilt", "the tilt about x'"),
    ("tilt", "the tilt about y'"),
    ("turn", "the turn about the axis"),
)
WIDER = "Targets out to the corners of the frame would tell them apart, in a wider field of view."
OUTWARD = "Targets from the centre to the corners of the frame would tell them apart."
APART, TILTED = "apart", "tilted"  # remedies that depend on whether the field is known
CAUSES = {  # of correlations between two kinds of parameters, and the remedy
    frozenset(("c", "along")): ("the distance of the object and the principal distance are correlated", TILTED),
    frozenset(("point", "across")): ("the principal point and a shift of the camera are correlated", APART),
    frozenset(("point", "tilt")): (
        "the principal point and a tilt of the camera are correlated in a narrow field of view",
        WIDER,
    ),
    frozenset(("point", "decentering")): (
        "decentering distortion with a tilt is correlated with a shift of the principal point",
        f"{WIDER} Else use the two together, or fix the decentering where it is not significant.",
    ),
    frozenset(("decentering", "tilt")): (
        "decentering distortion is correlated with a tilt and a shift of the camera",
        WIDER,
    ),
    frozenset(("radial",)): (
        "neighbouring powers of the radius are alike within the frame",
        "Compare the curve and not its coefficients; leave out the highest one that is not significant.",
    ),
    frozenset(("c", "radial")): ("a change of scale and radial distortion are alike where the targets lie", OUTWARD),
    frozenset(("radial", "along")): (
        "a change of distance and radial distortion are alike where the targets lie",
        OUTWARD,
    ),
}
OTHERS = (
    "these targets and images hardly tell them apart",
    "Spread the targets over the whole frame, add images tilted in different directions, or fix what is not "
    "significant.",
)


@dataclass(frozen=True)
class Correlation:
    """Correlated parameters (owner MANY: in many images), their largest correlation, cause and remedy."""

    parameters: tuple[Parameter, ...]
    rho: float
    cause: str
    remedy: str


def correlations(estimates: Estimates) -> tuple[Correlation, ...]:
    """Correlations above HIGH between parameters of one camera, and between them and exterior orientations.

    Sorted, the highest first; none where there is no solution.
    """
    if not estimates.converged:
        return ()
    found = [each for camera in estimates.network.cameras for each in _camera_correlations(estimates, camera)]
    return tuple(sorted(found, key=lambda each: -abs(each.rho)))


def _camera_correlations(estimates: Estimates, camera: Camera) -> Iterator[Correlation]:
    lens, own, kinds, words = family(camera.distortion.family), list[Parameter](), list[str](), list[str]()
    kind_of = {"c": "c", "x0": "point", "y0": "point"} | dict.fromkeys(lens.parameters, "other")
    for group, names in reversed(lens.groups):
        kind_of |= dict.fromkeys(names, group)
    for name, kind in kind_of.items():
        if _is_free(estimates, Parameter.interior(camera.name, name)):
            own.append(Parameter.interior(camera.name, name))
            kinds.append(kind)
            words.append(name + "'" * (kind == "point"))
    if not own:
        return
    known = len(estimates.network.known_places) >= FIELD
    pairs = [[Parameter.fiducial(camera.name, id_, axis) for axis in "xy"] for id_ in camera.fiducials]
    marks = [each for pair in pairs if all(_is_free(estimates, one) for one in pair) for each in pair]
    own_rho = _correlation(_cofactor_in_datum(estimates, own, marks))
    for i, j in combinations(range(len(own)), 2):
        if abs(own_rho[i, j]) > HIGH:
            rho = float(own_rho[i, j])
            why, remedy = _cause(kinds[i], kinds[j], known)
            cause = f"{words[i]} and {words[j]} of camera {camera.name} are correlated by {rho:.3f}: {why}."
            yield Correlation((own[i], own[j]), rho, cause, remedy)
    frames = list(dict.fromkeys(image.frame for image in estimates.network.images if image.camera == camera.name))
    parts = [frames[i : i + IMAGES_AT_ONCE] for i in range(0, len(frames), IMAGES_AT_ONCE)]
    all_rho = np.concatenate([_exterior_correlations(estimates, own, marks, part) for part in parts])
    for i, direction in np.ndindex(len(own), len(DIRECTIONS)):
        high = [row for row in range(len(frames)) if abs(all_rho[row, i, direction]) > HIGH]
        if high:
            rho = float(max(all_rho[high, i, direction], key=abs))
            elements, what, owner = _exterior_words(estimates, frames, high, direction)
            why, remedy = _cause(kinds[i], DIRECTIONS[direction][0], known)
            cause = f"{words[i]} of camera {camera.name} and {what} are correlated by {rho:.3f}: {why}."
            exterior = (Parameter.exterior(owner, element) for element in elements)
            yield Correlation((own[i], *exterior), rho, cause, remedy)


def _is_free(estimates: Estimates, parameter: Parameter) -> bool:
    return estimates.has(parameter) and estimates.sigma(parameter) > 0.0


def _cofactor_in_datum(
    estimates: Estimates, own: Sequence[Parameter], marks: Sequence[Parameter], further: Sequence[Parameter] = ()
) -> Array:
    """Cofactor matrix of parameters of a camera and further ones, given shift, rotation and scale of its marks."""
    # For functions f x that are held: Q - Q f' (f Q f')^-1 f Q; for a vague datum this is Baarda's S-transformation.
    cofactor, count, size = estimates.cofactor_of([*own, *marks, *further]), len(own), len(marks)
    xy = estimates.values_of(marks).reshape(-1, 2)
    figure = np.zeros((0, size))
    if len(xy) > 1:
        x, y = (xy - xy.mean(axis=0)).T
        one, zero = np.ones_like(x), np.zeros_like(x)
        pairs = [(one, zero), (zero, one), (-y, x), (x, y)]
        figure = np.array([np.stack(pair, axis=1).ravel() for pair in pairs])
    keep = np.r_[:count, count + size : len(cofactor)]
    by_figure = figure @ cofactor[count : count + size]
    own_part = by_figure[:, count : count + size] @ figure.T
    held = cofactor - by_figure.T @ np.linalg.pinv(own_part, rcond=1e-12, hermitian=True) @ by_figure
    return np.asarray(held[np.ix_(keep, keep)])


def _correlation(cofactor: Array) -> Array:
    sigma = np.sqrt(np.maximum(np.diag(cofactor), 0.0))
    scale = np.where(sigma > 0.0, sigma, np.inf)
    return np.asarray(cofactor / np.outer(scale, scale))


def _exterior_correlations(
    estimates: Estimates, own: list[Parameter], marks: list[Parameter], images: list[str]
) -> Array:
    """(images, k, 6) correlations of k parameters with the six directions of every exterior orientation."""
    exterior = [Parameter.exterior(image, element) for image in images for element in EXTERIOR_NAMES]
    cofactor = _cofactor_in_datum(estimates, own, marks, exterior)
    turn = np.eye(len(cofactor))
    for i, image in enumerate(images):
        at = slice(len(own) + 6 * i, len(own) + 6 * i + 6)
        turn[at, at] = _camera_axes(estimates, image)
    rho = _correlation(turn @ cofactor @ turn.T)[: len(own), len(own) :]
    return rho.reshape(len(own), len(images), 6).transpose(1, 0, 2)


def _camera_axes(estimates: Estimates, image: str) -> Array:
    """(6, 6) derivatives of the six directions by the elements of an exterior orientation."""
    angles = estimates.values_of(Parameter.exterior(image, element) for element in EXTERIOR_NAMES[3:])
    turn = np.zeros((6, 6))
    turn[:3, :3] = rotation_from_angles(angles)
    turn[3:, 3:] = vector_by_angles(angles)
    return turn


def _exterior_words(
    estimates: Estimates, frames: list[str], high: list[int], direction: int
) -> tuple[list[str], str, str]:
    """Elements of exterior orientations with a share in a direction, their words, and their owner."""
    images = [frames[row] for row in high]
    shares = np.array([np.abs(_camera_axes(estimates, image)[direction]) for image in images]).max(axis=0)
    elements = [name for name, share in zip(EXTERIOR_NAMES, shares, strict=True) if share > SHARE]
    what = elements[0] if len(elements) == 1 else DIRECTIONS[direction][1]
    owner = MANY if len(images) > 1 else images[0]
    if len(images) == len(frames) > 1:
        return elements, f"{what} of all images", owner
    return elements, f"{what} of image{'s' * (len(images) > 1)} {shortened(images, SHOWN)}", owner


def _cause(first: str, second: str, known: bool) -> tuple[str, str]:
    """Cause of a correlation between two kinds of parameters, and the remedy; known: whether the field is known."""
    why, remedy = CAUSES.get(frozenset((first, second)), OTHERS)
    if remedy == APART and not known:
        return why, "Images turned by 90 and 180 degrees about their axes, and tilted ones, would tell them apart."
    if remedy in (APART, TILTED):
        relief = "a field with more relief" if known else "known points at different heights"
        return why, f"Images tilted in different directions, or {relief}, would tell them apart."
    return why, remedy
