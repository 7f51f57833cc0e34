"""High correlations in words: which of a camera's parameters trade off, with each other and with the orientations.

The datum of the fiducial marks is taken out first: where priors of 1 mm hold it, the interior orientation and the marks
are uncertain together by what the datum is vague, and the correlations that matter drown in that. What is correlated
with an exterior orientation is told in the axes of the camera: along its axis, across it, and tilts.
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
from adjust.problem.network import EXTERIOR_NAMES, Network
from adjust.problem.parameter import MANY, Parameter

HIGH = 0.95
IMAGES_AT_ONCE = 16
SHARE = 0.3  # of an element of the exterior orientation in a direction, from which on it is named
SHOWN = 3  # images that are named one by one
FIELD = 4  # known points from which the field is known
ALONG, TURN = 2, 5  # directions of an exterior orientation: across in x', in y', along, tilts about x', y', turn
DIRECTIONS = (
    "the station's place across its axis in x'",
    "the station's place across its axis in y'",
    "the station's distance along its axis",
    "the tilt about x'",
    "the tilt about y'",
    "the turn about the axis",
)


@dataclass(frozen=True)
class Correlation:
    """What trades off (owner MANY: in many images), the largest correlation, cause and remedy."""

    parameters: tuple[Parameter, ...]
    rho: float
    cause: str
    remedy: str


def correlations(estimates: Estimates, above: float = HIGH) -> tuple[Correlation, ...]:
    """The correlations above a limit between parameters of one camera, and between these and orientations of images.

    The highest first; none where there is no solution.
    """
    if not estimates.converged:
        return ()
    found = [each for camera in estimates.network.cameras for each in _camera_correlations(estimates, camera, above)]
    return tuple(sorted(found, key=lambda each: -abs(each.rho)))


@dataclass(frozen=True)
class _Kind:
    """A parameter of a camera: its name there, and what it is: c, point, a group of the distortion family, other."""

    name: str
    group: str

    def __str__(self) -> str:
        return self.name + "'" * (self.group == "point")


def _camera_correlations(estimates: Estimates, camera: Camera, above: float) -> Iterator[Correlation]:
    kinds = [kind for kind in _kinds(camera) if _is_free(estimates, Parameter.interior(camera.name, kind.name))]
    if not kinds:
        return
    own = [Parameter.interior(camera.name, kind.name) for kind in kinds]
    marks = _free_marks(estimates, camera)
    own_rho = _correlation(_hold_figure(estimates.cofactor_of([*own, *marks]), len(own), _figure(estimates, marks)))
    known = _field_is_known(estimates.network)
    for i, j in combinations(range(len(own)), 2):
        if abs(own_rho[i, j]) > above:
            yield _pair_correlation(camera.name, kinds[i], kinds[j], float(own_rho[i, j]), known)
    frames = (image.frame for image in estimates.network.images if image.camera == camera.name)
    images = list(dict.fromkeys(frames))
    rho = np.concatenate(
        [
            _exterior_correlations(estimates, own, marks, images[i : i + IMAGES_AT_ONCE])
            for i in range(0, len(images), IMAGES_AT_ONCE)
        ]
    )
    for (i, kind), direction in ((pair, d) for pair in enumerate(kinds) for d in range(6)):
        rows = np.flatnonzero(np.abs(rho[:, i, direction]) > above)
        if len(rows):
            of = [images[row] for row in rows]
            value = float(rho[rows, i, direction][np.argmax(np.abs(rho[rows, i, direction]))])
            yield _image_correlation(estimates, camera.name, kind, direction, of, len(images), value, known)


def _kinds(camera: Camera) -> list[_Kind]:
    groups: dict[str, str] = {}
    of = family(camera.distortion.family)
    for group, names in of.groups:
        groups |= {name: group for name in names if name not in groups}
    interior = [_Kind("c", "c"), _Kind("x0", "point"), _Kind("y0", "point")]
    return interior + [_Kind(name, groups.get(name, "other")) for name in of.parameters]


def _is_free(estimates: Estimates, parameter: Parameter) -> bool:
    return estimates.has(parameter) and estimates.sigma(parameter) > 0.0


def _free_marks(estimates: Estimates, camera: Camera) -> list[Parameter]:
    """x and y of every fiducial that was estimated, x before y."""
    pairs = [[Parameter.fiducial(camera.name, id_, axis) for axis in "xy"] for id_ in camera.fiducials]
    return [each for pair in pairs if all(_is_free(estimates, one) for one in pair) for each in pair]


def _figure(estimates: Estimates, marks: Sequence[Parameter]) -> Array:
    """Shift, rotation and scale (k, m) of fiducial coordinates (m,)."""
    xy = estimates.values_of(marks).reshape(-1, 2)
    if len(xy) < 2:
        return np.zeros((0, len(marks)))
    x, y = (xy - xy.mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = [(one, zero), (zero, one), (-y, x), (x, y)]
    return np.array([np.stack(pair, axis=1).ravel() for pair in pairs])


def _hold_figure(cofactor: Array, count: int, figure: Array) -> Array:
    """The cofactor matrix of the first quantities, for the figure (k, m) of the last m in its place.

    Holding functions f x: Q - Q f' (f Q f')^-1 f Q, of a vague datum Baarda's S-transformation.
    """
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
    """Correlations (images, k, 6) of k parameters with the six directions of every exterior orientation."""
    exterior = [Parameter.exterior(image, element) for image in images for element in EXTERIOR_NAMES]
    cofactor = _hold_figure(estimates.cofactor_of([*own, *marks, *exterior]), len(own), _figure(estimates, marks))
    turn = np.eye(len(cofactor))
    for i, image in enumerate(images):
        at = slice(len(own) + 6 * i, len(own) + 6 * i + 6)
        turn[at, at] = _camera_axes(estimates, image)
    rho = _correlation(turn @ cofactor @ turn.T)[: len(own), len(own) :]
    return rho.reshape(len(own), len(images), 6).transpose(1, 0, 2)


def _camera_axes(estimates: Estimates, image: str) -> Array:
    """The derivative (6, 6) of the six directions by the elements of an exterior orientation."""
    angles = estimates.values_of(Parameter.exterior(image, element) for element in EXTERIOR_NAMES[3:])
    turn = np.zeros((6, 6))
    turn[:3, :3] = rotation_from_angles(angles)
    turn[3:, 3:] = vector_by_angles(angles)
    return turn


def _field_is_known(network: Network) -> bool:
    return len(network.known_places) >= FIELD


def _pair_correlation(camera: str, first: _Kind, second: _Kind, rho: float, known: bool) -> Correlation:
    why, remedy = _why(first.group, second.group, known)
    cause = f"{first} and {second} of camera {camera} are correlated by {rho:.3f}: {why}."
    pair = Parameter.interior(camera, first.name), Parameter.interior(camera, second.name)
    return Correlation(pair, rho, cause, remedy)


def _image_correlation(
    estimates: Estimates,
    camera: str,
    kind: _Kind,
    direction: int,
    images: list[str],
    count: int,
    rho: float,
    known: bool,
) -> Correlation:
    elements = _elements(estimates, images, direction)
    if len(images) == count:
        of = "all images" if count > 1 else f"image {images[0]}"
    else:
        more = len(images) - SHOWN
        of = f"image{'s' * (len(images) > 1)} {', '.join(images[:SHOWN])}" + (f" and {more} more" if more > 0 else "")
    what = elements[0] if len(elements) == 1 else DIRECTIONS[direction]
    other = (
        "along" if direction == ALONG else "turn" if direction == TURN else "across" if direction < ALONG else "tilt"
    )
    why, remedy = _why(kind.group, other, known)
    cause = f"{kind} of camera {camera} and {what} of {of} are correlated by {rho:.3f}: {why}."
    owner = MANY if len(images) > 1 else images[0]
    exterior = (Parameter.exterior(owner, element) for element in elements)
    return Correlation((Parameter.interior(camera, kind.name), *exterior), rho, cause, remedy)


def _elements(estimates: Estimates, images: list[str], direction: int) -> list[str]:
    """The elements of exterior orientations that have a share in a direction."""
    shares = np.array([np.abs(_camera_axes(estimates, image)[direction]) for image in images]).max(axis=0)
    return [name for name, share in zip(EXTERIOR_NAMES, shares, strict=True) if share > SHARE]


def _why(first: str, second: str, known: bool) -> tuple[str, str]:
    """What makes two kinds of parameters alike, and what would tell them apart."""
    pair = frozenset((first, second))
    relief = "a field with more relief" if known else "known points at different heights"
    tilted = f"Images tilted in different directions, or {relief}, would tell them apart."
    wider = "Targets out to the corners of the frame would tell them apart, in a wider field of view."
    apart = tilted
    if not known:
        apart = "Images turned by 90 and 180 degrees about their axes, and tilted ones, would tell them apart."
    for members, why, remedy in (
        (
            {"c", "along"},
            "flying height and principal distance trade off",
            tilted,
        ),
        ({"point", "across"}, "the principal point and a shift of the camera trade off", None),
        ({"point", "tilt"}, "the principal point and a tilt of the camera trade off in a narrow field of view", wider),
        (
            {"point", "decentering"},
            "decentering distortion with a tilt looks like a shift of the principal point",
            f"{wider} Else use the two together, or fix the decentering where it is not significant.",
        ),
        ({"decentering", "tilt"}, "decentering distortion looks like a tilt with a shift of the camera", wider),
        (
            {"radial"},
            "neighbouring powers of the radius are alike within the frame",
            "Compare the curve and not its coefficients; leave out the highest one that is not significant.",
        ),
        (
            {"c", "radial"},
            "a change of scale and radial distortion are alike where the targets lie",
            "Targets from the centre to the corners of the frame would tell them apart.",
        ),
        (
            {"radial", "along"},
            "a change of distance and radial distortion are alike where the targets lie",
            "Targets from the centre to the corners of the frame would tell them apart.",
        ),
    ):
        if pair == members:
            return why, remedy or apart
    return (
        "these targets and images hardly tell them apart",
        "Spread the targets over the whole frame, add images tilted in different directions, or fix what is not "
        "significant.",
    )
