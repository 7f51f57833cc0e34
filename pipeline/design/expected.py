"""Expected precision and reliability of a setup: of the camera, the distortion along the radius, and the points."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Prior
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles, rotation_from_vector
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.estimates import adjusted_lens
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.quality.reliability import OuterEffect
from adjust.solution.adjustment import Options
from adjust.solution.planning import Plan, plan
from pipeline.adjusting.network import FEWEST_TARGETS
from pipeline.design.setup import Setup, planned_network
from pipeline.terminal import Count
from pipeline.types import Array
from synthetic_images.scene import SceneImage

IN_MM = ("target", "tie", "fiducial", "datum", "scanner", "fiducial distance")

DIRECTIONS = 36
QUARTERS = 4
ROUNDING_UM = 1e-9
ROUNDING = 1e-9  # relative cut-off of singular values of the null directions
QUARTER = math.pi / 2  # rad
FOUND = 100.0  # percent: gain where only the changed plan determines a quantity


@dataclass(frozen=True)
class GroupReliability:
    """Reliability of one group of observations or given quantities.

    Attributes
    ----------
    redundancy : mean redundancy number of a coordinate.
    median, largest : of the smallest detectable gross errors; µm for groups measured in mm, else object units or rad;
        without the unchecked ones.
    unchecked : number of coordinates that nothing checks.
    """

    group: str
    coordinates: int
    redundancy: float
    median: float
    largest: float
    unchecked: int


def error_unit(group: str) -> str:
    """Unit of a group's gross errors."""
    if group in IN_MM:
        return "um"
    return "object unit" if group in ("control", "distance") else "mixed"


@dataclass(frozen=True)
class AtRadius:
    """Expected standard deviations at a radius, µm: rms over all directions, per axis.

    radial, tangential: of the distortion; ray: of the image of a ray with known direction in the camera frame, from the
    whole interior orientation.
    """

    radius_mm: float
    radial_um: float
    tangential_um: float
    ray_um: float


@dataclass(frozen=True, eq=False)
class Expected:
    """A setup, its network and its plan."""

    setup: Setup
    network: Network
    plan: Plan

    @property
    def camera(self) -> str:
        return self.network.cameras[0].name

    @property
    def family_parameters(self) -> tuple[str, ...]:
        """Distortion parameters that are not fixed."""
        distortion = self.network.cameras[0].distortion
        given, names = distortion.parameters, parameter_names(distortion.family)
        return tuple(name for name in names if name in given and given[name].sigma > 0.0)

    @property
    def fiducials(self) -> tuple[str, ...]:
        return tuple(self.network.cameras[0].fiducials)

    @cached_property
    def camera_sigmas(self) -> Mapping[str, float]:
        """Standard deviations of the camera's parameters that are not fixed, by name.

        c, x0, y0, fiducials (rms of all coordinates) and scanner (rms of the terms of its bend) in µm; distortion
        parameters in their own units; `ray`: of the image of a ray at the largest radius, µm.
        """
        found = self.plan.sigmas(self._interior, np.eye(len(self._interior))).tolist()
        by_name = dict(zip((each.quantity for each in self._interior), found, strict=True))
        sigmas = {name: UM_PER_MM * by_name[name] for name in INTERIOR_NAMES}
        sigmas |= {name: by_name[name] for name in self.family_parameters}
        marks = [self.plan.sigma(each) for each in _fiducial_unknowns(self.network.cameras[0])]
        sigmas |= {"fiducials": UM_PER_MM * rms(marks), "ray": self.curve[-1].ray_um}
        sigmas |= {"scanner": UM_PER_MM * rms(list(self.scanner_sigmas.values()))}
        return {name: sigma for name, sigma in sigmas.items() if sigma > 0.0}

    @cached_property
    def scanner_sigmas(self) -> Mapping[Parameter, float]:
        """Standard deviations of the terms of the scanner's bend, mm; empty where none is estimated."""
        scanners = self.network.scanners
        terms = [Parameter.scanner(scanner.name, term) for scanner in scanners for term in scanner.terms]
        return {term: self.plan.sigma(term) for term in terms}

    @cached_property
    def curve(self) -> tuple[AtRadius, ...]:
        """Precision of the distortion at the radii of the settings."""
        radii = self.setup.settings.radii_mm
        if not radii:
            corner = float(np.hypot(*self.setup.lens.frame_mm)) / 2
            radii = tuple(corner * quarter / QUARTERS for quarter in range(1, QUARTERS + 1))
        functions = [self._functions(radius) for radius in radii]
        sigmas = self.plan.sigmas(self._interior, np.concatenate(functions))
        sigmas = np.where(sigmas > ROUNDING_UM, sigmas, 0.0)
        return tuple(
            AtRadius(radius, rms(part[0]), rms(part[1]), rms(part[2:].ravel()))
            for radius, part in zip(radii, sigmas.reshape(len(radii), 4, DIRECTIONS), strict=True)
        )

    @cached_property
    def groups(self) -> tuple[GroupReliability, ...]:
        """Inner reliability (Baarda) of the plan for its sigma0 by groups; empty without redundancy."""
        plan, found = self.plan, self.plan.adjustment.reliability
        if found is None:
            return ()
        rows_of = defaultdict[str, list[tuple[float, float]]](list)
        for unit, redundancies, errors in zip(found.tested, found.redundancy, found.smallest, strict=True):
            scale = plan.sigma0 * (UM_PER_MM if unit.group in IN_MM else 1.0)
            pairs = zip(redundancies.tolist(), (scale * errors).tolist(), strict=True)
            rows_of[unit.group] += list(pairs)[: len(unit.coordinates)]
        for each in plan.adjustment.further:
            rows_of[each.group].append((each.redundancy, plan.sigma0 * each.detectable))
        groups = []
        for name, rows in rows_of.items():
            redundancy, smallest = np.array(rows).T
            checked = smallest[np.isfinite(smallest)]
            median = float(np.median(checked)) if len(checked) else np.inf
            largest = float(checked.max()) if len(checked) else np.inf
            mean = float(redundancy.mean())
            groups.append(GroupReliability(name, len(rows), mean, median, largest, len(rows) - len(checked)))
        return tuple(groups)

    @property
    def outer_effects(self) -> Sequence[OuterEffect]:
        """Outer reliability by camera parameters (Baarda)."""
        return self.plan.adjustment.reliability.outer if self.plan.adjustment.reliability else ()

    @cached_property
    def point_sigmas(self) -> Array:
        """(n, 3) standard deviations of the network's points, object units."""
        coordinates = [Parameter.point(point.id, axis) for point in self.network.points for axis in "XYZ"]
        return np.array([self.plan.sigma(each) for each in coordinates]).reshape(-1, 3)

    @property
    def _interior(self) -> list[Parameter]:
        """Parameters of the interior orientation and the distortion."""
        names = (*INTERIOR_NAMES, *parameter_names(self.network.cameras[0].distortion.family))
        return [Parameter.interior(self.camera, name) for name in names]

    def _functions(self, radius_mm: float) -> Array:
        """(4 DIRECTIONS, k) µm, derivatives of radial and tangential distortion at a radius, and of a ray's image."""
        angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
        outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        across = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
        lens = adjusted_lens(self.plan.adjustment, self.camera)
        by_c_and_parameters = lens.displacement(radius_mm * outward).by_unknowns_um
        by_c_and_parameters[np.abs(by_c_and_parameters) < ROUNDING_UM] = 0.0  # most families do not depend on c
        distortion = [np.einsum("di,dik->dk", along, by_c_and_parameters) for along in (outward, across)]
        by_interior = np.insert(np.concatenate(distortion), [1, 1], 0.0, axis=1)
        # The image of a ray by c, x0', y0' and the parameters: from F = 0 with a fixed ray.
        xy_mm = lens.interior[1:] + radius_mm * outward
        at = lens.equations(xy_mm, lens.ray_from_observed(xy_mm)[0])
        ray = -UM_PER_MM * np.linalg.solve(at.xy_jacobian, at.quantity_jacobian)
        return np.concatenate([by_interior, ray.reshape(-1, ray.shape[2])])


def expect(setup: Setup) -> Expected:
    """Plan a setup. Raises InputError or AdjustmentError where an image shows too few points."""
    network, values = planned_network(setup)
    return Expected(setup, network, plan(network, values, Options(setup.settings.datum), setup.settings.sigma0))


def rms(values: list[float] | Array) -> float:
    """Root mean square; 0 for no values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


# Calibration from the photographs alone, without given fiducials and interior orientation.
#
# The camera frame is then free in shift, rotation and scale (Torlegård's singular cases). Estimable are the relative
# positions of the fiducials, and the rest of the camera in their frame.


def sigmas_of_images_alone(expected: Expected) -> Mapping[Parameter, float]:
    """Standard deviations of the camera's parameters without the pseudo-observations F5 to F9.

    mm, and the parameters' own units; inf: not determined. With N the null directions and N_f its rows of the
    fiducials: standard deviations of d - N N_f^+ d_f (Baarda's S-transformation to inner constraints over the
    fiducials).
    """
    network = expected.network
    camera = network.cameras[0]
    # All parameters are free that are not fixed.
    fiducials = {id: Fiducial(_free_prior(mark.x_mm), _free_prior(mark.y_mm)) for id, mark in camera.fiducials.items()}
    c, x0, y0 = (prior and _free_prior(prior) for prior in (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm))
    freed = replace(camera, principal_distance_mm=c, x0_mm=x0, y0_mm=y0, fiducials=fiducials)
    without = replace(network, cameras=(freed,))
    options = Options(expected.setup.settings.datum)
    free = plan(without, planned_network(expected.setup)[1], options, expected.plan.sigma0)
    interior = [Parameter.interior(camera.name, name) for name in (*INTERIOR_NAMES, *expected.family_parameters)]
    marks = _fiducial_unknowns(camera)
    moved = free.null[[free.adjustment.index(each) for each in (*interior, *marks)]]
    functions = np.eye(len(interior) + len(marks))
    functions[:, len(interior) :] -= moved @ np.linalg.pinv(moved[len(interior) :], rcond=ROUNDING)
    return dict(zip((*interior, *marks), free.sigmas((*interior, *marks), functions).tolist(), strict=True))


def _fiducial_unknowns(camera: Camera) -> list[Parameter]:
    return [Parameter.fiducial(camera.name, id, axis) for id in camera.fiducials for axis in "xy"]


def _free_prior(prior: Prior) -> Prior:
    return prior if prior.sigma == 0.0 else Prior(prior.value, np.inf)


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


def alternatives(basis: Expected, progress: Count = lambda *_: None) -> tuple[Alternative, ...]:
    """Try all kinds of changes, each once. Of the photographs that could be added or rolled, the most useful of each
    kind is kept."""
    setup, tried = basis.setup, defaultdict[int, list[Alternative]](list)
    kinds = [*_more_photos(setup), _other_kappas(setup), *([one] for one in _better(setup))]
    changes = [(kind, *each) for kind, some in enumerate(kinds) for each in some]
    for done, (kind, change, changed) in enumerate(changes, 1):
        expected = expect(changed)
        tried[kind].append(Alternative(change, expected, gains(basis.camera_sigmas, expected.camera_sigmas)))
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


def _more_photos(setup: Setup) -> Iterator[Iterable[Change]]:
    """One more photograph: each named in the settings; and existing ones, rolled or moved around the field."""
    for photo in setup.settings.photo:
        omega, phi, kappa = (math.radians(angle) for angle in photo.angles_deg)
        image = SceneImage(photo.name, (*photo.position, omega, phi, kappa))
        yield [(f"one more photo: {photo.name}", _add_image(setup, image))]
    yield _more(setup, "turned by 90 degrees", _turn_kappa)
    center = np.mean([point.xyz for point in setup.points], axis=0)
    axis = np.mean([point.normal for point in setup.points], axis=0)  # in which the targets face
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 0.0 else np.array([0.0, 0.0, 1.0])

    def carried(exterior: Exterior, rotation: Array) -> Exterior:
        """Rotate the station around the centre, together with the camera."""
        station = center + rotation @ (np.array(exterior[:3]) - center)
        angles = angles_from_rotation(rotation_from_angles(np.array(exterior[3:])) @ rotation.T)
        x, y, z, omega, phi, kappa = (float(value) for value in (*station, *angles))
        return (x, y, z, omega, phi, kappa)

    for turn, words in ((QUARTER, "a quarter"), (2 * QUARTER, "half")):
        moved = partial(carried, rotation=rotation_from_vector(turn * axis))
        yield _more(setup, f"carried {words} round the field", moved)


def _more(setup: Setup, words: str, moved: Callable[[Exterior], Exterior]) -> Iterator[Change]:
    for image in setup.images:
        new = SceneImage(f"{image.name} again", moved(image.exterior))
        if len(setup.visible_points(new)) >= FEWEST_TARGETS:
            yield f"one more photo: as {image.name}, {words}", _add_image(setup, new)


def _other_kappas(setup: Setup) -> Iterator[Change]:
    """Another kappa of one photograph."""
    for i, image in enumerate(setup.images):
        new = replace(image, exterior=_turn_kappa(image.exterior))
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


def _turn_kappa(exterior: Exterior) -> Exterior:
    return (*exterior[:5], exterior[5] + QUARTER)
