"""From the user's files and the comparator coordinates to the network that is adjusted."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.network import Camera, Image, Network, ObjectPoint, Observations, Prior, Transformation
from pipeline.camera_file import CameraFile
from pipeline.comparator_file import ComparatorPoint
from pipeline.errors import InputError
from pipeline.project_file import AdjustSettings, Project
from pipeline.spelling import did_you_mean

Array = NDArray[np.float64]


LISTED = 8
FEWEST_TARGETS = 3  # in an image whose exterior orientation nobody has observed


def build_network(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[Network, tuple[str, ...]]:
    """The network of a project: the images, points and observations that `marks` really hold; and what is left out.

    Raises InputError where a mark names a point, a fiducial or an image that the project does not have.
    """
    used = [mark for mark in marks if mark.status.is_observation]
    if not used:
        raise InputError(
            f"{project.comparator}: holds no observation: no mark has the status measured or weak. "
            "See the reasons in its last column."
        )
    _check_fiducials(project, used)
    _check_points(project, used)
    used, lonely = _locatable(project, used)
    used, left_out = _orientable(project, used)
    images = tuple(_image(project, name) for name in dict.fromkeys(mark.image for mark in used))
    network = Network(
        cameras=_cameras(project, images, used),
        images=images,
        points=_points(project, used),
        observations=_observations(project.adjust, used),
    )
    return network, (*lonely, *left_out)


def unmeasured_points(project: Project, network: Network) -> tuple[str, ...]:
    """Points that are given but that no image shows."""
    if project.given_points is None:
        return ()
    return tuple(point.id for point in project.given_points.points if point.id not in network.point_by_id)


def _locatable(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[list[ComparatorPoint], tuple[str, ...]]:
    """The marks of the points that can be located: of which something is given, or which two images show."""
    given = {id for id, point in given_points(project).items() if any((point.X, point.Y, point.Z))}
    images = Counter(mark.point for mark in marks if mark.kind != "fiducial")
    lonely = {point for point, count in images.items() if count < 2 and point not in given}
    sentence = (
        f"Unknown and shown by one image only, and so left out: {listed(sorted(lonely))}. Measure each such point in a "
        "second image, or give its coordinates."
    )
    kept = [mark for mark in marks if mark.kind == "fiducial" or mark.point not in lonely]
    return kept, (sentence,) if lonely else ()


def listed(names: Sequence[str]) -> str:
    """The first names, and how many there are beyond them."""
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def _orientable(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[list[ComparatorPoint], tuple[str, ...]]:
    """The marks of the images that can be oriented, and a sentence on each of the others."""
    targets = Counter(mark.image for mark in marks if mark.kind != "fiducial")
    names = list(dict.fromkeys(mark.image for mark in marks))
    without = [name for name in names if targets[name] < FEWEST_TARGETS and not _observed(project, name)]
    if len(without) == len(names):
        most = max(without, key=lambda name: targets[name])
        raise InputError(
            f"{project.comparator}: no image can be oriented: {most!r} shows the most targets, {targets[most]}, and an "
            f"image needs {FEWEST_TARGETS}. See the status and reason of every mark in that file."
        )
    left_out = tuple(
        f"Image {name!r} has no part in the adjustment: it shows {targets[name]} targets and needs {FEWEST_TARGETS}. "
        "Look at the reasons of its marks; or observe its orientation in images.csv, with standard deviations."
        for name in without
    )
    return [mark for mark in marks if mark.image not in without], left_out


def _observed(project: Project, image: str) -> bool:
    """Whether the project gives the whole exterior orientation with standard deviations."""
    exterior = project.given_images.exterior.get(image) if project.given_images else None
    return exterior is not None and bool(np.isfinite(exterior.sigmas).all())


def _image(project: Project, name: str) -> Image:
    camera = project.camera_of(name)
    exterior = project.given_images.exterior.get(name) if project.given_images else None
    return Image(name, camera.name, _transformation(project, camera), exterior)


def _transformation(project: Project, camera: CameraFile) -> Transformation:
    """As the project says; where it is silent, affine with fiducials and none without."""
    given = project.adjust.transformation
    if given is None:
        return "affine" if camera.fiducials else "none"
    if given != "none" and not camera.fiducials:
        raise InputError(
            f"{project.path}: [adjust] transformation is {given!r}, but {camera.path} has no fiducials for it. "
            'Write transformation = "none" for a digital camera, or add the fiducials.'
        )
    return given


def _check_fiducials(project: Project, marks: Sequence[ComparatorPoint]) -> None:
    for mark in marks:
        if mark.kind != "fiducial":
            continue
        camera = project.camera_of(mark.image)
        ids = [fiducial.id for fiducial in camera.fiducials]
        if mark.point not in ids:
            raise InputError(
                f"{project.comparator}, line {mark.line}: image {mark.image!r}: {camera.path} has no fiducial "
                f"{mark.point!r}. It has {', '.join(ids) or 'none'}."
            )


def _check_points(project: Project, marks: Sequence[ComparatorPoint]) -> None:
    """A target is one of the given points, where any are given; a tie point need not be."""
    given = given_points(project)
    for mark in marks:
        if mark.kind == "target" and given and mark.point not in given:
            raise InputError(
                f"{project.comparator}, line {mark.line}: image {mark.image!r} shows the target {mark.point!r}, which "
                f"the given points do not hold.{did_you_mean(mark.point, given)} Add it to them (coordinates may be "
                "blank), or make it a point of kind tie."
            )


def _cameras(project: Project, images: Sequence[Image], marks: Sequence[ComparatorPoint]) -> tuple[Camera, ...]:
    cameras = []
    for file in project.cameras.values():
        names = {image.name for image in images if image.camera == file.name}
        if names:
            xy = np.array([mark.xy_mm for mark in marks if mark.image in names])
            center = (xy.min(axis=0) + xy.max(axis=0)) / 2 if file.principal_point_mm is None else np.zeros(2)
            cameras.append(file.camera((float(center[0]), float(center[1]))))
    return tuple(cameras)


def _points(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[ObjectPoint, ...]:
    """Every object point that an image shows: as given, of the board, or unknown where nothing gives it."""
    given = given_points(project)
    points = {}
    for mark in marks:
        if mark.kind == "fiducial" or mark.point in points:
            continue
        points[mark.point] = given.get(mark.point, ObjectPoint(mark.point, None, None, None))
    return tuple(points.values())


def given_points(project: Project) -> Mapping[str, ObjectPoint]:
    """The points of points.csv, or else those of the board, by id."""
    if project.given_points is not None:
        return {point.id: point for point in project.given_points.points}
    if project.targets is None or project.targets.board is None:
        return {}
    scale = 1.0 / project.unit_mm
    board = project.targets.board.object_points()
    return {id: ObjectPoint(id, *(Prior(scale * value) for value in xyz)) for id, xyz in board.items()}


def _observations(settings: AdjustSettings, marks: Sequence[ComparatorPoint]) -> Observations:
    return Observations(
        image=tuple(mark.image for mark in marks),
        point=tuple(mark.point for mark in marks),
        kind=tuple(mark.kind for mark in marks),
        xy_mm=np.array([mark.xy_mm for mark in marks], dtype=np.float64),
        covariance_mm2=np.array([_covariance(settings, mark) for mark in marks]),
    )


def _covariance(settings: AdjustSettings, mark: ComparatorPoint) -> Array:
    """The mark's own covariance, or the a-priori one, and that of film and scanner, which no picture shows."""
    if mark.sigma_mm is None:
        sigma_um = settings.sigma_fiducial_um if mark.kind == "fiducial" else settings.sigma_target_um
        covariance = np.eye(2) * (sigma_um / 1000.0) ** 2
    else:
        covariance = np.outer(mark.sigma_mm, mark.sigma_mm) * np.array([[1.0, mark.rho], [mark.rho, 1.0]])
    film: Array = covariance + np.eye(2) * (settings.film_sigma_um / 1000.0) ** 2
    return film
