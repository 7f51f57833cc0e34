"""Contradictions of an adjusted network with the geometry of photographs, independent of the residuals.

Marks outside the image, stations on both sides of an opaque board, a principal point outside the image or far from its
given place. On a flat board a mirrored image has the same residuals as a correct one, with its station on the other
side; y pointing down mirrors all images. The mirrored network is adjusted, and its sigma0 is reported where it explains
all observations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from adjust.array_types import Array, Mask
from adjust.problem.camera import Camera
from adjust.problem.condition_equations import observed_in_camera
from adjust.problem.parameter import shortened
from adjust.solution.blunder_hypotheses import Trials, mirrored_images, reversed_y
from adjust.solution.result import Adjustment
from adjust.solution.wrong_names import NAMED

MARGIN = 0.01  # fraction of the frame that a mark may lie outside: edge of the outermost pixel, rounded frame size
NEARLY_ALL = 0.9  # fraction of marks outside the image above which the axes are wrong, not the marks
FLAT_BOARD = 1e-2  # relief of given points over their extent below which they are flat
AROUND = 0.25  # fraction of the extent of all marks by which an image of unknown size may extend beyond them


def check_plausibility(result: Adjustment, trials: Trials) -> Adjustment:
    """Add remarks on contradictions with the geometry of photographs to a result."""
    if result.termination == "singular" or not result.network.observed_points:
        return result
    views = _views(result)
    # The film transformations of an iteration that did not converge take marks anywhere.
    outside = sorted(row for view in views if result.converged or view.digital for row in view.outside)
    remarks, misread = list(_marks_outside(result, outside, trials)), tuple(_both_sides(result, trials))
    if result.converged and not outside and not result.coordinate_blunders:
        remarks += [each for view in views for each in _principal_point(view, result, trials.family)]
    # Orientations unlike those given may be consequences.
    return replace(result, misread=misread, remarks=(*remarks, *result.remarks))


class _CameraView(NamedTuple):
    """Object points in the images of one camera.

    digital: whether its images have no film transformation; xy_mm (n, 2): camera coordinates; picture (2, 2): image
    area in mm, by two opposite corners, None where its size is unknown; outside: rows of the marks outside it.
    """

    camera: Camera
    digital: bool
    xy_mm: Array
    picture: Array | None
    outside: list[int]


def _views(result: Adjustment) -> list[_CameraView]:
    """Views of the cameras whose images show object points."""
    in_camera_mm, images = observed_in_camera(result.run.problem, result.run.end.state), result.network.images
    films, found = {image.camera for image in images if image.transformation != "none"}, list[_CameraView]()
    for name, rows in result.run.problem.targets_by_camera.items():
        if not len(rows):
            continue
        camera, digital, xy_mm = result.network.camera_by_name[name], name not in films, in_camera_mm[rows]
        size = np.array(camera.frame_mm)
        picture: Array | None = None
        # Of unknown size, all marks of a digital camera are outside if they lie above and right of the first pixel.
        outside = rows if digital and (xy_mm > 0.0).all() else rows[:0]
        if size.all():
            # The image area of a digital camera starts at the first pixel, like the comparator coordinates. That of a
            # film camera is centred on the fiducial marks. It is centred on the origin where nearly all marks lie
            # inside then, and more than otherwise.
            marks = [[mark.x_mm.value, mark.y_mm.value] for mark in camera.fiducials.values()]
            middle_mm = (np.min(marks, axis=0) + np.max(marks, axis=0)) / 2.0 if marks else np.zeros(2)
            low = size * [0.0, -1.0] if digital else middle_mm - size / 2.0
            picture, centred = np.array([low, low + size]), np.array([-size / 2.0, size / 2.0])
            if _is_outside(centred, xy_mm).mean() < min(1.0 - NEARLY_ALL, _is_outside(picture, xy_mm).mean()):
                picture = centred
            outside = rows[_is_outside(picture, xy_mm)]
        found.append(_CameraView(camera, digital, xy_mm, picture, outside.tolist()))
    return found


def _is_outside(picture: Array, xy_mm: Array) -> Mask:
    """Mask of points (n, 2) outside an image area."""
    margin = MARGIN * float(np.ptp(picture, axis=0).max())
    return np.asarray(((xy_mm < picture[0] - margin) | (xy_mm > picture[1] + margin)).any(axis=1))


def _marks_outside(result: Adjustment, rows: Sequence[int], trials: Trials) -> Iterator[str]:
    if not rows:
        return
    network, observations = result.network, result.network.observations
    count = int((~observations.is_fiducial).sum())
    sized = [camera for camera in network.cameras if all(camera.frame_mm)]
    where = f"(frame_mm = {list(sized[0].frame_mm)})" if sized else "above its first row of pixels"
    words = f"{len(rows)} of {count} marks lie outside the picture{' ' if sized else ', '}{where}"
    if len(rows) < NEARLY_ALL * count:
        shown = shortened([f"{observations.image[row]}/{observations.point[row]}" for row in rows], NAMED)
        yield f"{words}: {shown}. Their coordinates, frame_mm or the pitch is wrong. Correct it."
        return
    other = reversed_y(network, keeps_given=True)
    is_digital = all(image.transformation == "none" for image in network.images)
    turned = trials.adjust(other) if is_digital else None
    if turned is None or any(view.outside for view in _views(turned)):
        yield (
            f"{words}: the comparator counts x to the right and y up, from the first pixel. Correct the coordinates, "
            "frame_mm or the pitch."
        )
        return
    fits = trials.explains(turned) or turned.sigma0 < 1.01 * result.sigma0
    yield (
        f"{words}. With y pointing up instead of down all lie inside (σ₀ = {turned.sigma0:.2f}; as it stands "
        f"{result.sigma0:.2f}){'' if fits else ', but the observations agree less then'}: the y axis of the comparator "
        "coordinates points down, or they count from the lower left corner. Give them with y up, from the first pixel."
    )


def _both_sides(result: Adjustment, trials: Trials) -> Iterator[str]:
    """Report images whose stations lie on the other side of an opaque board than most."""
    network, sides = result.network, _sides(result)
    balance = sum(sides.values()) or -1.0  # equally many on both sides
    fewer = [name for name, side in sides.items() if side * balance < 0.0]
    if network.transparent or not fewer:
        return
    turned = trials.adjust(mirrored_images(network, fewer))
    same = turned is not None and len(set(_sides(turned).values())) == 1
    one, figures, even = len(fewer) == 1, "", ", or the others," if 2 * len(fewer) == len(sides) else ""
    if turned is not None and same and turned.sigma0 < 1.05 * result.sigma0:
        figures = (
            f" With {'it' if one else 'them'} mirrored, all stations lie on one side and all observations agree as well"
            f" (σ₀ = {turned.sigma0:.2f}; as it stands {result.sigma0:.2f})."
        )
    yield (
        f"{'Image' if one else 'The images'} {shortened(fewer, NAMED)}{even}"
        f" {'is' if one else 'are'} mirrored, or numbered as in a mirror, or the flat board is transparent: "
        f"{'its station lies' if one else 'their stations lie'} on the other side of it than those of the "
        f"{len(sides) - len(fewer)} other images, which an opaque board hides.{figures} Mirror "
        f"{'the image' if one else 'the images'} and measure again, correct the point numbers, or write transparent = "
        "true under [targets] or [object]."
    )


def _sides(result: Adjustment) -> dict[str, float]:
    """Side (1 or -1) of the plane of the given points on which each station lies, by image; empty without a plane."""
    network = result.network
    places = [place for id_, place in network.known_places.items() if id_ in network.observed_points]
    if len(places) < max(4, len(network.observed_points)):
        return {}
    xyz = np.array(places)
    _, extents, axes = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
    if extents[1] < FLAT_BOARD * extents[0] or extents[2] > FLAT_BOARD * extents[0]:
        return {}
    sides = np.sign((result.values[result.run.problem.exterior[:, :3]] - xyz.mean(axis=0)) @ axes[2]).tolist()
    shown = {image.name: side for image, side in zip(network.images, sides, strict=True)}
    return {name: side for name, side in shown.items() if name not in network.objectless_images}


def _principal_point(view: _CameraView, result: Adjustment, family: float) -> Iterator[str]:
    name, picture, kind = view.camera.name, view.picture, "outside the picture"
    at = result.run.problem.unknowns.camera[name][1:3]
    found = result.values[at]
    words = f"The principal point of camera {name} is found at"
    if far := _far_from_given(view.camera, found, result, family):
        yield f"{words} ({found[0]:.4g}, {found[1]:.4g}) mm, {far}"
        return
    per_mm, unit = view.camera.image_unit()
    x, y = per_mm * found
    if picture is None:
        low, high = (np.array([limit(values) for values in view.xy_mm.T]) for limit in (np.min, np.max))
        reach = AROUND * (high - low).max()
        picture = np.array([low - reach, high + reach])
        if view.digital:
            picture = np.array([np.minimum(picture[0], 0.0), np.maximum(picture[1], 0.0)])
        kind = "outside all that the marks cover"
    if _is_outside(picture, found[None])[0]:
        (left, right), (lower, upper) = np.sort(per_mm * picture, axis=0).T
        yield (
            f"{words} ({x:.4g}, {y:.4g}) {unit}, {kind} (x from {left:g} to {right:g}, y from {lower:g} to {upper:g} "
            f"{unit}), where no lens has it: the images do not tell it from their tilts, or points are misnamed or "
            "misplaced. Give principal_point_mm with its standard deviation (0 fixes it), or add images with other "
            "tilts; check the points' numbers and coordinates."
        )


def _far_from_given(camera: Camera, found: Array, result: Adjustment, family: float) -> str:
    """Describe a significant contradiction between estimated and given principal point; empty where there is none."""
    priors = [prior for prior in (camera.x0_mm, camera.y0_mm) if prior is not None and 0.0 < prior.sigma < np.inf]
    if len(priors) < len(found):
        return ""
    given, sigma = np.array([(prior.value, prior.sigma) for prior in priors]).T
    cofactor = result.cofactor.part(result.run.problem.unknowns.camera[camera.name][1:3])
    size, axes = np.linalg.eigh((np.diag(sigma**2) - cofactor) / np.outer(sigma, sigma))
    along = axes.T @ ((found - given) / sigma)
    checked = size > 1e-6
    if not checked.any():
        return ""
    statistic = float((along[checked] ** 2 / size[checked]).sum()) / max(1.0, result.sigma0) ** 2
    if statistic <= chdtri(int(checked.sum()), family):
        return ""
    off = found - given
    turned = np.abs(off[0]) < abs(off[1]) and abs(found[1] + given[1]) < 0.1 * abs(off[1])
    sign = " The sign of y looks wrong: y points up." if turned else ""
    return (
        f"({off[0]:+.3g}, {off[1]:+.3g}) mm from ({given[0]:g}, {given[1]:g}) ± ({sigma[0]:g}, {sigma[1]:g}), where it "
        f"is given: {np.sqrt(statistic):.1f} times what its standard deviation allows.{sign} Check principal_point_mm, "
        "from where it counts and its sign, or give it with a larger standard deviation."
    )
