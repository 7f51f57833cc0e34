"""What no photograph shows, whatever the residuals say: marks outside the picture, stations on both sides of an opaque
board, a principal point outside the picture or far from where it is given.

On a flat board a mirrored image leaves the residuals of a true one, with its station on the other side; y that points
down mirrors all images. The mirrored network is adjusted, and told with its sigma0 where it explains all observations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from adjust.array_types import Array, Indices, Mask
from adjust.problem.camera import Camera
from adjust.problem.images import adjusted_image
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.blunder_hypotheses import Tried, explains, mirrored_images, y_downward
from adjust.solution.result import Adjustment

MARGIN = 0.01  # of the frame by which a mark may lie outside: the outermost pixel's edge, a frame's rounded size
NEARLY_ALL = 0.9  # of the marks outside the picture, from which on the axes are wrong and not the marks
FLAT = 1e-2  # relief of given points over their extent: a board, or ground without relief
AROUND = 0.25  # of the extent of all marks that a picture of unknown size may reach beyond them
NAMED = 5


def check_plausibility(result: Adjustment, tried: Tried, family: float) -> Adjustment:
    """A result with sentences on what contradicts the geometry of photographs."""
    network = result.network
    if result.termination == "singular" or not network.observed_points:
        return result
    outside = _outside(network, result)
    remarks = [*_marks_outside(network, outside, result, tried, family)]
    misread = tuple(_both_sides(network, result, tried, family))
    if result.converged and not outside.any():
        remarks += [each for camera in network.cameras for each in _principal_point(camera, network, result, family)]
    return replace(result, misread=misread, remarks=(*result.remarks, *remarks))


@dataclass(frozen=True)
class _Picture:
    """The picture of a camera in mm: its corners, and the marks (n,) that lie outside of it."""

    low: Array
    high: Array

    def outside(self, xy_mm: Array) -> Mask:
        margin = MARGIN * float((self.high - self.low).max())
        return np.asarray((xy_mm < self.low - margin).any(axis=1) | (xy_mm > self.high + margin).any(axis=1))

    @property
    def words(self) -> str:
        return f"x from {self.low[0]:g} to {self.high[0]:g}, y from {self.low[1]:g} to {self.high[1]:g} mm"


def _picture(camera: Camera, xy_mm: Array, digital: bool) -> _Picture | None:
    """Where the picture lies; None where its size is not known.

    Of a digital camera it counts from the first pixel, as the comparator does, of a film camera it lies about the
    middle of the fiducial marks; about the origin if nearly all observed marks (n, 2) lie in it then, and more.
    """
    size = np.array(camera.frame_mm)
    if not size.all():
        return None
    low = size * [0.0, -1.0] if digital else _fiducial_center_mm(camera) - size / 2.0
    usual, middle = _Picture(low, low + size), _Picture(-size / 2.0, size / 2.0)
    outside = middle.outside(xy_mm).mean()
    return middle if outside < min(1.0 - NEARLY_ALL, usual.outside(xy_mm).mean()) else usual


def _fiducial_center_mm(camera: Camera) -> Array:
    places = np.array([[mark.x_mm.value, mark.y_mm.value] for mark in camera.fiducials.values()])
    return np.asarray((places.min(axis=0) + places.max(axis=0)) / 2.0) if len(places) else np.zeros(2)


def _outside(network: Network, result: Adjustment) -> Mask:
    """The object points (n,) that are observed outside the picture; all of a digital camera's that lie above and right
    of its first pixel, where its size is not known."""
    observations = network.observations
    outside = np.zeros(len(observations), dtype=bool)
    for camera in network.cameras:
        rows = _targets(network, camera)
        if not len(rows):
            continue
        digital = _is_digital(network, camera)
        xy_mm = _camera_places(network, result, rows)
        picture = _picture(camera, xy_mm, digital)
        if picture is not None:
            outside[rows] = picture.outside(xy_mm)
        elif digital and (xy_mm > 0.0).all():
            outside[rows] = True
    return outside


def _targets(network: Network, camera: Camera) -> Indices:
    """The observations of object points by a camera."""
    own = np.array([image.camera == camera.name for image in network.images])
    return np.flatnonzero(own[network.image_numbers] & ~network.observations.is_fiducial)


def _camera_places(network: Network, result: Adjustment, rows: Indices) -> Array:
    """Observed camera coordinates (m, 2) of some observations."""
    xy_mm = network.straight_xy_mm[rows].copy()
    numbers = network.image_numbers[rows]
    order = np.argsort(numbers, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
        image = network.images[numbers[own[0]]]
        if image.transformation != "none":
            xy_mm[own] = adjusted_image(result, image.name).film.camera_from_comparator(xy_mm[own])
    return xy_mm


def _is_digital(network: Network, camera: Camera) -> bool:
    return all(image.transformation == "none" for image in network.images if image.camera == camera.name)


def _marks_outside(network: Network, outside: Mask, result: Adjustment, tried: Tried, family: float) -> Iterator[str]:
    if not outside.any():
        return
    observations = network.observations
    count = int((~observations.is_fiducial).sum())
    sized = [camera for camera in network.cameras if all(camera.frame_mm)]
    where = (
        f"the picture (frame_mm = {list(sized[0].frame_mm)})" if sized else "the picture, above its first row of pixels"
    )
    if outside.sum() < NEARLY_ALL * count:
        rows = np.flatnonzero(outside)
        shown = ", ".join(f"{observations.image[row]}/{observations.point[row]}" for row in rows[:NAMED])
        more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
        yield (
            f"{len(rows)} of {count} marks lie outside {where}: {shown}{more}. Their coordinates, frame_mm or the "
            "pitch is wrong. Correct it."
        )
        return
    other = y_downward(network)
    turned = tried(other) if other is not None else None
    if other is None or turned is None or _outside(other, turned).any():
        yield (
            f"{int(outside.sum())} of {count} marks lie outside {where}: the comparator counts x to the right and y "
            "up, from the first pixel. Correct the coordinates, frame_mm or the pitch."
        )
        return
    fits = explains(turned, family) or turned.sigma0 < 1.01 * result.sigma0
    both = "" if fits else ", but the observations agree less then"
    yield (
        f"{int(outside.sum())} of {count} marks lie outside {where}. With y pointing up instead of down all lie inside "
        f"(σ₀ = {turned.sigma0:.2f}; as it stands {result.sigma0:.2f}){both}: the y axis of the comparator coordinates "
        "points down, or they count from the lower left corner. Give them with y up, from the first pixel; principal "
        "point, decentering and stations are wrong until then."
    )


def _both_sides(network: Network, result: Adjustment, tried: Tried, family: float) -> Iterator[str]:
    """Images whose stations lie on the other side of an opaque board than most."""
    sides = _sides(network, result)
    fewer = [name for name, side in sides.items() if side * sum(sides.values()) < 0.0]
    if sum(sides.values()) == 0.0 and sides:  # as many here as there
        fewer = [name for name, side in sides.items() if side > 0.0]
    if network.transparent or not fewer:
        return
    shown = ", ".join(fewer[:NAMED]) + (f" and {len(fewer) - NAMED} more" if len(fewer) > NAMED else "")
    one = len(fewer) == 1
    even = ", or the others," if 2 * len(fewer) == len(sides) else ""
    turned = tried(mirrored_images(network, fewer))
    same = turned is not None and len(set(_sides(network, turned).values())) == 1
    figures = ""
    if turned is not None and same and (explains(turned, family) or turned.sigma0 < 1.05 * result.sigma0):
        figures = (
            f" With {'it' if one else 'them'} mirrored, all stations lie on one side and all observations agree as well"
            f" (σ₀ = {turned.sigma0:.2f}; as it stands {result.sigma0:.2f})."
        )
    yield (
        f"{'Image' if one else 'The images'} {shown}{even} {'is' if one else 'are'} mirrored, or the flat board of the "
        f"given points is transparent: {'its station lies' if one else 'their stations lie'} on the other side of it "
        f"than those of the {len(sides) - len(fewer)} other images, which an opaque board hides.{figures} Mirror "
        f"{'the image' if one else 'the images'} and measure again, or write transparent = true under [targets] or "
        "[object]."
    )


def _sides(network: Network, result: Adjustment) -> dict[str, float]:
    """On which side of the plane of the given points, 1 or -1, the station of every image lies; empty without one."""
    places = [place for id_, place in network.known_places.items() if id_ in network.observed_points]
    if len(places) < max(4, len(network.observed_points)):
        return {}
    xyz = np.array(places)
    _, extents, axes = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
    if extents[1] < FLAT * extents[0] or extents[2] > FLAT * extents[0]:
        return {}
    images = [image for image in network.images if image.name not in network.objectless_images]
    stations = {image.name: adjusted_image(result, image.name).station for image in images}
    return {name: float(np.sign((station - xyz.mean(axis=0)) @ axes[2])) for name, station in stations.items()}


def _principal_point(camera: Camera, network: Network, result: Adjustment, family: float) -> Iterator[str]:
    if camera.name in network.idle_cameras or all(image.camera != camera.name for image in network.images):
        return
    parameters = [Parameter.interior(camera.name, axis) for axis in ("x0", "y0")]
    found = result.values_of(parameters)
    words = f"The principal point of camera {camera.name} is found at ({found[0]:.4g}, {found[1]:.4g}) mm"
    far = _far_from_given(camera, found, result, parameters, family)
    if far:
        yield f"{words}, {far}"
        return
    rows = _targets(network, camera)
    xy_mm = _camera_places(network, result, rows)
    digital = _is_digital(network, camera)
    picture = _picture(camera, xy_mm, digital)
    kind = "outside the picture"
    if picture is None:
        reach = AROUND * np.ptp(xy_mm, axis=0).max()
        low, high = xy_mm.min(axis=0) - reach, xy_mm.max(axis=0) + reach
        picture = _Picture(np.minimum(low, 0.0), np.maximum(high, 0.0)) if digital else _Picture(low, high)
        kind = "outside all that the marks cover"
    if not picture.outside(found[None])[0]:
        return
    yield (
        f"{words}, {kind} ({picture.words}), where no lens has it: the images do not tell it from their tilts, or "
        "points are misnamed or misplaced. Give principal_point_mm with its standard deviation (0 fixes it), or add "
        "images with other tilts; check the points' numbers and coordinates."
    )


def _far_from_given(
    camera: Camera, found: Array, result: Adjustment, parameters: Sequence[Parameter], family: float
) -> str:
    """Where the principal point is given, if the images contradict it beyond chance; empty where they do not."""
    priors = [prior for prior in (camera.x0_mm, camera.y0_mm) if prior is not None and 0.0 < prior.sigma < np.inf]
    if len(priors) < len(parameters):
        return ""
    given, sigma = (np.array([getattr(prior, key) for prior in priors]) for key in ("value", "sigma"))
    covariance = np.diag(sigma**2) - result.cofactor_of(parameters)
    size, axes = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    along = axes.T @ ((found - given) / sigma)
    checked = size > 1e-6
    if not checked.any():
        return ""
    statistic = float((along[checked] ** 2 / size[checked]).sum()) / max(1.0, result.sigma0) ** 2
    if statistic <= chdtri(int(checked.sum()), family):
        return ""
    off = found - given
    sign = ""
    if np.abs(off[0]) < abs(off[1]) and abs(found[1] + given[1]) < 0.1 * abs(off[1]):
        sign = " The sign of y looks wrong: y points up."
    return (
        f"({off[0]:+.3g}, {off[1]:+.3g}) mm from ({given[0]:g}, {given[1]:g}) ± ({sigma[0]:g}, {sigma[1]:g}), where it "
        f"is given: {np.sqrt(statistic):.1f} times what its standard deviation allows.{sign} Check principal_point_mm, "
        "from where it counts and its sign, or give it with a larger standard deviation."
    )
