"""High correlations of a camera's parameters with each other and with exterior orientations, in words.

The datum of the fiducial marks is held first: where only priors of 1 mm define it, interior orientation and marks share
its uncertainty, which hides the correlations that matter. Exterior orientations are described in the axes of the
camera: along its axis, across it, and tilts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.functional_model.rotation import rotation_from_angles, vector_by_angles
from adjust.problem.camera import Camera
from adjust.problem.estimates import Estimates
from adjust.problem.network import EXTERIOR_NAMES
from adjust.problem.parameter import MANY, Parameter, shortened

HIGH = 0.95
IMAGES_AT_ONCE = 16
SHARE = 0.3  # least share in a direction of an element of the exterior orientation that is named
SHOWN = 3  # images named one by one
FIELD = 4  # known points needed for a known field
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
    frozenset(("c", "along")): ("flying height and principal distance are correlated", TILTED),
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


def correlations(estimates: Estimates, above: float = HIGH) -> tuple[Correlation, ...]:
    """Correlations above a limit between parameters of one camera, and between them and exterior orientations.

    Sorted, the highest first; none where there is no solution.
    """
    if not estimates.converged:
        return ()
    found = [each for camera in estimates.network.cameras for each in _camera_correlations(estimates, camera, above)]
    return tuple(sorted(found, key=lambda each: -abs(each.rho)))


def _camera_correlations(estimates: Estimates, camera: Camera, above: float) -> Iterator[Correlation]:
    own, kinds, words = [], [], []
    for name, kind in _parameter_kinds(camera).items():
        if _is_free(estimates, Parameter.interior(camera.name, name)):
            own.append(Parameter.interior(camera.name, name))
            kinds.append(kind)
            words.append(name + "'" * (kind == "point"))
    if not own:
        return
    known = len(estimates.network.known_places) >= FIELD
    marks = _free_marks(estimates, camera)
    own_rho = _correlation(_hold_figure(estimates.cofactor_of([*own, *marks]), len(own), _figure(estimates, marks)))
    for i, j in combinations(range(len(own)), 2):
        if abs(own_rho[i, j]) > above:
            rho = float(own_rho[i, j])
            why, remedy = _cause(kinds[i], kinds[j], known)
            cause = f"{words[i]} and {words[j]} of camera {camera.name} are correlated by {rho:.3f}: {why}."
            yield Correlation((own[i], own[j]), rho, cause, remedy)
    frames = list(dict.fromkeys(image.frame for image in estimates.network.images if image.camera == camera.name))
    parts = [frames[i : i + IMAGES_AT_ONCE] for i in range(0, len(frames), IMAGES_AT_ONCE)]
    all_rho = np.concatenate([_exterior_correlations(estimates, own, marks, part) for part in parts])
    for i, direction in np.ndindex(len(own), len(DIRECTIONS)):
        high = [row for row in range(len(frames)) if abs(all_rho[row, i, direction]) > above]
        if high:
            rho = float(max(all_rho[high, i, direction], key=abs))
            elements, what, owner = _exterior_words(estimates, frames, high, direction)
            why, remedy = _cause(kinds[i], DIRECTIONS[direction][0], known)
            cause = f"{words[i]} of camera {camera.name} and {what} are correlated by {rho:.3f}: {why}."
            exterior = (Parameter.exterior(owner, element) for element in elements)
            yield Correlation((own[i], *exterior), rho, cause, remedy)


def _parameter_kinds(camera: Camera) -> dict[str, str]:
    """Kind of each parameter of a camera: c, point, a group of the distortion family, other."""
    lens = family(camera.distortion.family)
    kinds = {"c": "c", "x0": "point", "y0": "point"} | dict.fromkeys(lens.parameters, "other")
    for group, names in reversed(lens.groups):
        kinds |= dict.fromkeys(names, group)
    return kinds


def _is_free(estimates: Estimates, parameter: Parameter) -> bool:
    return estimates.has(parameter) and estimates.sigma(parameter) > 0.0


def _free_marks(estimates: Estimates, camera: Camera) -> list[Parameter]:
    """x and y of every estimated fiducial, x before y."""
    pairs = [[Parameter.fiducial(camera.name, id_, axis) for axis in "xy"] for id_ in camera.fiducials]
    return [each for pair in pairs if all(_is_free(estimates, one) for one in pair) for each in pair]


def _figure(estimates: Estimates, marks: Sequence[Parameter]) -> Array:
    """(k, m) shift, rotation and scale of fiducial coordinates (m,)."""
    xy = estimates.values_of(marks).reshape(-1, 2)
    if len(xy) < 2:
        return np.zeros((0, len(marks)))
    x, y = (xy - xy.mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = [(one, zero), (zero, one), (-y, x), (x, y)]
    return np.array([np.stack(pair, axis=1).ravel() for pair in pairs])


def _hold_figure(cofactor: Array, count: int, figure: Array) -> Array:
    """Conditional cofactor matrix of the quantities, given the figure (k, m) of the m that follow the first `count`."""
    # For functions f x that are held: Q - Q f' (f Q f')^-1 f Q; for a vague datum this is Baarda's S-transformation.
    size = figure.shape[1]
    keep = np.r_[:count, count + size : len(cofactor)]
    by_figure = figure @ cofactor[count : count + size]
    own = by_figure[:, count : count + size] @ figure.T
    held = cofactor - by_figure.T @ np.linalg.pinv(own, rcond=1e-12, hermitian=True) @ by_figure
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
    cofactor = _hold_figure(estimates.cofactor_of([*own, *marks, *exterior]), len(own), _figure(estimates, marks))
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
