"""Setup of a planned set of photographs, and the network that its measurement would give."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import smooth_terms
from adjust.functional_model.transformation import fit_transformation
from adjust.problem import network
from adjust.problem.network import Approximations, Network, Transformation
from adjust.problem.observations import Distance, ObservationKind, Observations
from pipeline.adjusting.network import FEWEST_TARGETS
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import DEFAULT_SCANNER
from pipeline.rendered.scene_project import SceneFile, film_transformation
from pipeline.rendered.scene_tables import DesignSettings
from pipeline.text.wording import did_you_mean
from pipeline.types import Array
from synthetic_images.film import turn
from synthetic_images.projection import camera_from_object
from synthetic_images.scene import SceneCamera, SceneImage
from synthetic_images.targets import field_targets


@dataclass(frozen=True, eq=False)
class PlannedPoint:
    """A target.

    Attributes
    ----------
    xyz, normal : (3,) coordinates and facing direction.
    sigma_planimetry, sigma_height : standard deviations of the given X and Y, and of the given Z, in object units; 0:
        exact, inf: unknown.
    """

    id: str
    xyz: Array
    normal: Array
    sigma_planimetry: float
    sigma_height: float


@dataclass(frozen=True, eq=False)
class Setup:
    """All input of a plan. lens: the camera for the projection; camera: the camera with its priors."""

    lens: SceneCamera
    camera: CameraFile
    transformation: Transformation
    points: tuple[PlannedPoint, ...]
    images: tuple[SceneImage, ...]
    settings: DesignSettings

    @property
    def bends(self) -> bool:
        """Whether the bend of the scanner is estimated."""
        return self.settings.scanner != "none" and self.transformation != "none"

    def visible_points(self, image: SceneImage) -> list[int]:
        """Points that lie within an image's frame and face its camera. Occlusion by other points is not considered."""
        xyz = np.array([point.xyz for point in self.points])
        normals = np.array([point.normal for point in self.points])
        xy_mm = camera_from_object(self.lens, image.exterior, xyz)
        faces = (normals * (np.asarray(image.exterior[:3]) - xyz)).sum(axis=1) > 0.0
        with np.errstate(invalid="ignore"):
            inside = (np.abs(xy_mm) <= np.asarray(self.lens.frame_mm) / 2).all(axis=1)
        return [int(i) for i in np.flatnonzero(inside & faces)]


def scene_setup(scene_file: SceneFile) -> Setup:
    """Setup of a scene. Raises InputError where it names control points that the field does not have, or has no
    targets."""
    settings = scene_file.design
    targets = field_targets(scene_file.scene.field)
    if not targets:
        raise InputError(
            f"{scene_file.path}: [field] has no targets, and where natural points will be is not known beforehand. "
            "To plan such a field, give as many targets as points are hoped for, in a [[field.scatter]]."
        )
    unknown = set(settings.control_points) - {target.id for target in targets}
    if unknown:
        raise InputError(
            f"{scene_file.path}: [design] control_points: the field has no target {min(unknown)!r}. Its targets are "
            f"{targets[0].id!r} to {targets[-1].id!r}."
        )
    # Frames that are to be scanned in parts are planned as a whole, under their own names.
    frames = {image.frame: image for image in reversed(scene_file.scene.images)}
    whole = [replace(image, name=frame, part_of="", part=(0.0, 1.0)) for frame, image in reversed(frames.items())]
    images = tuple(whole)
    _check_named(scene_file, {target.id for target in targets}, {image.name for image in images})
    points = []
    for target in targets:
        planimetry, height = settings.sigma_planimetry, settings.sigma_height
        if settings.control_points and target.id not in settings.control_points:
            planimetry = height = math.inf
        if target.id in scene_file.given.fixed_points and not scene_file.given.planimetry:
            planimetry = 0.0
        points.append(PlannedPoint(target.id, target.center, target.normal, planimetry, height))
    transformation = settings.transformation or film_transformation(scene_file)
    if transformation != "none" and not scene_file.camera.fiducials:
        raise InputError(
            f"{scene_file.path}: [design] transformation is {transformation!r}, but the camera has no fiducials. "
            'Write transformation = "none", or add the fiducials.'
        )
    return Setup(scene_file.scene.camera, scene_file.camera, transformation, tuple(points), images, settings)


def _check_named(scene_file: SceneFile, targets: set[str], images: set[str]) -> None:
    """Raise InputError where [design] names an end of a distance, or an image, that the scene does not have."""
    known = targets | images
    for distance in scene_file.design.distance:
        for end in (distance.start, distance.end):
            if end not in known:
                raise InputError(
                    f"{scene_file.path}: [[design.distance]]: {end!r} is neither a target nor an image."
                    f"{did_you_mean(end, known)}"
                )
    for orientation in scene_file.design.orientation:
        if orientation.image and orientation.image not in images:
            raise InputError(
                f"{scene_file.path}: [[design.orientation]]: there is no image {orientation.image!r}."
                f"{did_you_mean(orientation.image, images)}"
            )


def planned_network(setup: Setup) -> tuple[Network, Approximations]:
    """Network of a setup, with approximate values that are the setup itself.

    The film lies without rotation in the comparator or, where a scanner's bend is estimated, according to its scan
    orientation. Every visible mark is measured. A point without given coordinates that fewer than two images show is
    left out. Raises InputError where an image shows too few targets.
    """
    visible = {image.name: setup.visible_points(image) for image in setup.images}
    for name, rows in visible.items():
        if len(rows) < FEWEST_TARGETS:
            raise InputError(
                f"Image {name!r} would show {len(rows)} targets and needs {FEWEST_TARGETS}. Move or turn it towards "
                "the field, or leave it out."
            )
    rays = Counter(i for rows in visible.values() for i in rows)
    is_given = [min(point.sigma_planimetry, point.sigma_height) < math.inf for point in setup.points]
    used = [i for i in sorted(rays) if rays[i] >= 2 or is_given[i]]
    given_point = setup.camera.principal_point_mm or (0.0, 0.0)
    # Fiducials only where the film transformation is estimated from them.
    fiducials = setup.camera.fiducials if setup.transformation != "none" else ()
    camera = replace(setup.camera, principal_point_mm=given_point, fiducials=fiducials).camera()
    observations = _observations(setup, visible, set(used))
    points = [setup.points[i] for i in used]
    sigmas = [(point.sigma_planimetry, point.sigma_planimetry, point.sigma_height) for point in points]
    planned = Network(
        cameras=(camera,),
        images=tuple(_image(setup, camera.name, image) for image in setup.images),
        points=tuple(
            network.ObjectPoint(point.id, *map(Prior, map(float, point.xyz), sigma))
            for point, sigma in zip(points, sigmas, strict=True)
        ),
        observations=observations,
        distances=_distances(setup, {point.id: point.xyz for point in points}),
        scanners=_scanners(setup),
    )
    return planned, _values(setup, planned, points)


def _image(setup: Setup, camera: str, image: SceneImage) -> network.Image:
    observed = setup.settings.planned_orientation(image.name)
    exterior = None
    if observed is not None:
        sigmas = np.array([*observed.position_sigma, *np.radians(observed.angles_sigma_deg)])
        exterior = network.Exterior(np.array(image.exterior), sigmas)
    scanner = DEFAULT_SCANNER if setup.bends else ""
    return network.Image(image.name, camera, setup.transformation, exterior, scanner)


def _distances(setup: Setup, points: Mapping[str, Array]) -> tuple[Distance, ...]:
    """Planned distances between points and stations of the network."""
    places = {image.name: np.array(image.exterior[:3]) for image in setup.images} | dict(points)
    return tuple(
        Distance(each.start, each.end, float(np.linalg.norm(places[each.end] - places[each.start])), each.sigma)
        for each in setup.settings.distance
        if each.start in places and each.end in places
    )


def _scanners(setup: Setup) -> tuple[network.Scanner, ...]:
    """The scanner, where its bend is estimated: over the frame, which is centred on the comparator's origin."""
    if not setup.bends:
        return ()
    settings, half_mm = setup.settings, max(setup.lens.frame_mm) / 2.0
    names = smooth_terms([setup.transformation]) if settings.scanner == "bend" else settings.scanner
    prior = Prior(0.0, settings.scanner_sigma_um / 1000.0)
    return (network.Scanner(DEFAULT_SCANNER, dict.fromkeys(names, prior), half_mm=(half_mm, half_mm)),)


def _observations(setup: Setup, visible: dict[str, list[int]], used: set[int]) -> Observations:
    """One row per visible mark; the coordinates are computed when the network is planned."""
    film_um = setup.settings.film_sigma_um
    rows: list[tuple[str, str, ObservationKind, float]] = []
    for image in setup.images:
        if setup.transformation != "none":
            sigma = math.hypot(setup.settings.sigma_fiducial_um, film_um)
            shown = [one.id for one in setup.camera.fiducials if one.id not in image.covered]
            rows += [(image.name, id, "fiducial", sigma) for id in shown]
        sigma = math.hypot(setup.settings.sigma_target_um, film_um)
        rows += [(image.name, setup.points[i].id, "target", sigma) for i in visible[image.name] if i in used]
    images, points, kinds, sigmas_um = zip(*rows, strict=True)
    variances_mm2 = (np.array(sigmas_um) / 1000.0) ** 2
    return Observations(images, points, kinds, np.zeros((len(rows), 2)), variances_mm2[:, None, None] * np.eye(2))


def _values(setup: Setup, planned: Network, points: list[PlannedPoint]) -> Approximations:
    camera = planned.cameras[0]
    marks = np.array([one.xy_mm for one in setup.camera.fiducials]).reshape(-1, 2)
    films = {}
    for image in setup.images:
        comparator_from_camera = np.eye(2)  # rotation, with reflection if the scan is mirrored
        if setup.bends:
            pose_rad = math.radians(int(image.pose.rstrip("m")))
            mirror = np.diag([-1.0 if image.pose.endswith("m") else 1.0, 1.0])
            comparator_from_camera = turn(image.turn_rad + pose_rad) @ mirror
        films[image.name] = fit_transformation(setup.transformation, marks @ comparator_from_camera.T, marks)
    point = setup.lens.principal_point_mm
    return Approximations(
        interior={camera.name: np.array([setup.lens.principal_distance_mm, *point])},
        exterior={image.name: np.array(image.exterior) for image in setup.images},
        transformation={name: parameters for name, (parameters, _) in films.items()},
        points={point.id: point.xyz for point in points},
        mirrored=frozenset(name for name, (_, mirrored) in films.items() if mirrored),
    )
