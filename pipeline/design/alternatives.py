"""Improvements of a design: one more photograph, another kappa, more points, better control or measurements."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles, rotation_from_vector
from pipeline.adjusting.network import FEWEST_TARGETS
from pipeline.design.expected import Expected, expect
from pipeline.design.setup import PlannedPoint, Setup
from pipeline.types import Array
from synthetic_images.scene import SceneImage

QUARTER = math.pi / 2
FOUND = 100.0  # percent: gain where only the changed plan determines a quantity


@dataclass(frozen=True)
class Alternative:
    """One change of the setup, and the resulting standard deviations of the camera.

    gain_percent: reduction of each; nan where neither plan determines it, 100 where only the changed one does.
    """

    change: str
    expected: Expected
    gain_percent: Mapping[str, float]

    @property
    def usefulness(self) -> float:
        """Mean gain over all quantities."""
        gains = [gain for gain in self.gain_percent.values() if not math.isnan(gain)]
        return sum(gains) / len(gains) if gains else 0.0


Progress = Callable[[str, int, int], None]


def alternatives(basis: Expected, progress: Progress | None = None) -> tuple[Alternative, ...]:
    """Try all kinds of changes, each once. Of the photographs that could be added or rolled, the most useful of each
    kind is kept."""
    setup, tried = basis.setup, defaultdict[int, list[Alternative]](list)
    kinds = [*_photos(setup), _turned(setup), *([one] for one in _better(setup))]
    changes = [(kind, *each) for kind, some in enumerate(kinds) for each in some]
    for done, (kind, change, changed) in enumerate(changes, 1):
        expected = expect(changed)
        tried[kind].append(Alternative(change, expected, gains(basis.camera_sigmas, expected.camera_sigmas)))
        if progress is not None:
            progress(change, done, len(changes))
    return tuple(max(some, key=lambda alternative: alternative.usefulness) for some in tried.values())


def gains(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Reduction of standard deviations in percent."""

    def gain(name: str) -> float:
        old, new = before[name], after.get(name, 0.0)
        if math.isinf(old):
            return math.nan if math.isinf(new) else FOUND
        return -math.inf if math.isinf(new) else 100.0 * (1.0 - new / old)

    return {name: gain(name) for name in before}


Change = tuple[str, Setup]
Exterior = tuple[float, float, float, float, float, float]


def _photos(setup: Setup) -> Iterator[Iterable[Change]]:
    """One more photograph: each named in the settings; and existing ones, rolled or moved around the field."""
    for photo in setup.settings.photo:
        omega, phi, kappa = (math.radians(angle) for angle in photo.angles_deg)
        image = SceneImage(photo.name, (*photo.position, omega, phi, kappa))
        yield [(f"one more photo: {photo.name}", _add_image(setup, image))]
    center, axis = _field_axis(setup.points)
    yield _more(setup, "turned by 90 degrees", _rolled)
    for turn, words in ((QUARTER, "a quarter"), (2 * QUARTER, "half")):
        rotation = rotation_from_vector(turn * axis)
        yield _more(setup, f"carried {words} round the field", partial(_carried, center=center, rotation=rotation))


def _more(setup: Setup, words: str, moved: Callable[[Exterior], Exterior]) -> Iterator[Change]:
    for image in setup.images:
        new = SceneImage(f"{image.name} again", moved(image.exterior))
        if len(setup.visible_points(new)) >= FEWEST_TARGETS:
            yield f"one more photo: as {image.name}, {words}", _add_image(setup, new)


def _turned(setup: Setup) -> Iterator[Change]:
    """Another kappa of one photograph."""
    for i, image in enumerate(setup.images):
        new = replace(image, exterior=_rolled(image.exterior))
        if len(setup.visible_points(new)) >= FEWEST_TARGETS:
            images = (*setup.images[:i], new, *setup.images[i + 1 :])
            yield f"another kappa: {image.name} turned by 90 degrees", replace(setup, images=images)


def _better(setup: Setup) -> Iterator[Change]:
    """More or better measurements, of the kinds that the setup has."""
    # A second point at the same place represents one more of the same distribution.
    again = (replace(point, id=f"{point.id} again") for point in setup.points)
    yield "twice as many points, spread alike", replace(setup, points=(*setup.points, *again))
    if any(0.0 < point.sigma_height < math.inf for point in setup.points):
        points = (replace(point, sigma_height=point.sigma_height / 2) for point in setup.points)
        yield "given heights twice as good", replace(setup, points=tuple(points))
    if any(0.0 < point.sigma_planimetry < math.inf for point in setup.points):
        points = (replace(point, sigma_planimetry=point.sigma_planimetry / 2) for point in setup.points)
        yield "given X and Y twice as good", replace(setup, points=tuple(points))
    if setup.bends and len(setup.images) > 1:
        images = (replace(image, turn_rad=image.turn_rad + (i % 2) * math.pi) for i, image in enumerate(setup.images))
        yield "every second scan turned by 180 degrees", replace(setup, images=tuple(images))
    settings = setup.settings
    if setup.transformation != "none":
        finer = replace(settings, sigma_fiducial_um=settings.sigma_fiducial_um / 2)
        yield "fiducials measured twice as well", replace(setup, settings=finer)
    finer = replace(settings, sigma_target_um=settings.sigma_target_um / 2)
    yield "targets measured twice as well", replace(setup, settings=finer)


def _add_image(setup: Setup, image: SceneImage) -> Setup:
    return replace(setup, images=(*setup.images, image))


def _rolled(exterior: Exterior) -> Exterior:
    return (*exterior[:5], exterior[5] + QUARTER)


def _field_axis(points: Iterable[PlannedPoint]) -> tuple[Array, Array]:
    """Centre of the field, and mean direction in which its targets face."""
    listed = list(points)
    center = np.mean([point.xyz for point in listed], axis=0)
    axis = np.mean([point.normal for point in listed], axis=0)
    length = float(np.linalg.norm(axis))
    return center, axis / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def _carried(exterior: Exterior, center: Array, rotation: Array) -> Exterior:
    """Rotate the station around the centre, together with the camera."""
    station = center + rotation @ (np.array(exterior[:3]) - center)
    angles = angles_from_rotation(rotation_from_angles(np.array(exterior[3:])) @ rotation.T)
    x, y, z, omega, phi, kappa = (float(value) for value in (*station, *angles))
    return (x, y, z, omega, phi, kappa)
