"""Build the network of a project from the user's files and the comparator coordinates, with checks of both."""

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import fewest_marks, marks_needed
from adjust.initial_values.approximations import FEWEST_COMMON
from adjust.problem.camera import Camera
from adjust.problem.network import Board, Image, LineOfSight, Network, ObjectPoint, Scanner, Transformation
from adjust.problem.observations import Calibration, Distance, Observations
from measure.results import ON_FILM
from pipeline.adjusting.picture_turn import rotate_to_sensor
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.project_tables import UNITS_MM, AdjustSettings
from pipeline.files.target_table import TieSettings
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.wording import counted, did_you_mean, listed

OTHER_UNIT = 5.0  # ratio of lengths: film and paper deform by some percent; the nearest other unit (cm) is 10
FEWEST_TARGETS = 3  # in an image without observed exterior orientation
FEWEST_OF_BOARD = 4  # three given points leave several orientations, and a board has no others


def _check_marks(project: Project, marks: Sequence[ComparatorPoint]) -> None:
    """Raise InputError for fiducials that the camera lacks, for coordinates that are not in mm, and for targets that
    are not among the given points, if there are any."""
    comparator, points = project.comparator, project.object_points
    shown = defaultdict[str, list[ComparatorPoint]](list)
    for mark in marks:
        if mark.kind == "fiducial":
            shown[mark.image].append(mark)
    for image, own in shown.items():
        camera = project.image_camera(image)
        ids = [fiducial.id for fiducial in camera.fiducials]
        for mark in own:
            if mark.point not in ids:
                raise InputError(
                    f"{comparator}, line {mark.line}: image {image!r}: {camera.path} has no fiducial "
                    f"{mark.point!r}. It has {', '.join(ids) or 'none'}."
                )
        # In µm, inches or pixels the extent differs from the camera's by more than film deformation.
        given = {one.id: one.xy_mm for one in camera.fiducials if max(one.sigma_mm) < math.inf}
        known = [(mark.xy_mm, given[mark.point]) for mark in own if mark.xy_mm is not None and mark.point in given]
        diagonals = np.hypot(*np.ptp(np.array(known), axis=0).T).tolist() if known else [0.0, 0.0]  # measured, given
        is_checked = not project.scans and all(diagonals)
        if is_checked and not 1 / OTHER_UNIT < diagonals[0] / diagonals[1] < OTHER_UNIT:
            raise InputError(
                f"{comparator}, line {own[0].line}: the fiducials of image {image!r} stand "
                f"{diagonals[0] / diagonals[1]:.3g} times as far apart as those of {camera.path}. Give both in mm: not "
                "in µm, inches or pixels."
            )
    for mark in marks:
        if mark.kind == "target" and points and mark.point not in points:
            raise InputError(
                f"{comparator}, line {mark.line}: image {mark.image!r} shows the target {mark.point!r}, which "
                f"the given points do not hold.{did_you_mean(mark.point, points)} Add it to them (coordinates may be "
                "blank), or make it a point of kind tie."
            )


def build_network(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[Network, tuple[str, ...]]:
    """Build the network from the images, points and observations in `marks`.

    Returns the network, and a sentence on everything that is left out. Raises InputError where a mark names a point or
    fiducial that the project lacks, or there is nothing to adjust.
    """
    used = rotate_to_sensor(project, [mark for mark in marks if mark.status.is_observation])
    if not used:
        reasons = Counter(mark.reason for mark in marks if mark.reason).most_common(1)
        why = "".join(f" Most have this reason ({number} of {len(marks)}): {reason}." for reason, number in reasons)
        raise InputError(
            f"{project.comparator}: holds no observation: no mark has the status measured or weak.{why} "
            "The reasons of all stand in its last column."
        )
    _check_marks(project, used)
    comparator, given = project.comparator, project.object_points
    by_name = {name: _image(project, name) for name in dict.fromkeys(mark.image for mark in used)}
    used, unjoined = _joinable(comparator, by_name, used)
    used, lonely = _locatable(given, by_name, used)
    fewest = FEWEST_OF_BOARD if project.targets else FEWEST_TARGETS
    used, left_out = _orientable(comparator, by_name, used, fewest, _expects_targets(project))
    in_order = [by_name[name] for name in dict.fromkeys(mark.image for mark in used)]
    first = {image.frame: rank for rank, image in reversed(list(enumerate(in_order)))}
    images = tuple(sorted(in_order, key=lambda image: first[image.frame]))
    distances, without_end = _distances(project, used)
    cameras, calibrations = _cameras(project, images, used)
    scanners = dict.fromkeys(image.scanner for image in images if image.scanner)
    network = Network(
        cameras=cameras,
        images=images,
        points=_points(given, project.ties, used),
        observations=_observations(project.adjust, used),
        distances=distances,
        # Digital cameras that photographed the film, with their lens; none for film that was scanned.
        scanners=tuple(Scanner(name, lens=project.lens.lens) for name in scanners) if project.lens else (),
        boards=_boards(project),
        disk_radius=project.disk_radius or (0.0 if project.targets and not project.targets.code else None),
        transparent=project.transparent or (project.targets is not None and project.targets.transparent),
        calibrations=calibrations,
        line_of_sight=LineOfSight(
            project.adjust.earth_curvature, project.adjust.refraction, project.unit_mm / UNITS_MM["m"]
        ),
    )
    return network, (*unjoined, *lonely, *left_out, *without_end)


def anything_to_adjust(project: Project, marks: Sequence[ComparatorPoint]) -> bool:
    """Whether there is anything to adjust: object points, or film deformations where fiducials suffice."""
    observed = (mark for mark in marks if mark.kind == "fiducial" and mark.status.is_observation)
    fiducials = {(project.image_frame(mark.image), mark.point): mark.image for mark in observed}
    counts = Counter(frame for frame, _ in fiducials)
    image_of = {frame: image for (frame, _), image in fiducials.items()}
    return _expects_targets(project) or any(
        _has_film_transformation(_image(project, image_of[frame]), count) for frame, count in counts.items()
    )


def check_transformation(project: Project) -> None:
    """Raise InputError where the film deformation model needs fiducials that a camera lacks."""
    for camera in project.cameras.values():
        _transformation(project, camera)


def _locatable(
    given: Mapping[str, ObjectPoint], images: Mapping[str, Image], marks: Sequence[ComparatorPoint]
) -> tuple[list[ComparatorPoint], tuple[str, ...]]:
    """Drop marks of points that cannot be located: without coordinates, and in one image only."""
    known = {id for id, point in given.items() if any(point.priors)}
    image_of = {(mark.point, images[mark.image].frame): mark.image for mark in marks if mark.kind not in ON_FILM}
    counts = Counter(point for point, _ in image_of)
    lonely = {point: frame for point, frame in image_of if counts[point] < 2 and point not in known}
    named = [f"{point} ({frame})" for point, frame in sorted(lonely.items())]
    sentence = (
        f"Without coordinates and measured in one image only, and so left out: {listed(named)}. Two images are needed "
        "to locate a point. Measure each in a second image, or give its coordinates."
    )
    kept = [mark for mark in marks if mark.kind in ON_FILM or mark.point not in lonely]
    return kept, (sentence,) if lonely else ()


def _orientable(
    comparator: Path,
    images: Mapping[str, Image],
    marks: Sequence[ComparatorPoint],
    fewest: int,
    expects_targets: bool,
) -> tuple[list[ComparatorPoint], tuple[str, ...]]:
    """Drop marks of images that cannot be oriented, with a sentence on each."""
    # Of an image with too few targets the fiducials remain if they suffice for its film deformation model. Marks in
    # several parts of a frame count once.
    shown = {(images[mark.image].frame, mark.kind, mark.point) for mark in marks}
    targets = Counter(frame for frame, kind, _ in shown if kind not in ON_FILM)
    fiducials = Counter(frame for frame, kind, _ in shown if kind == "fiducial")
    frames = dict.fromkeys(images[mark.image].frame for mark in marks)
    first = {images[mark.image].frame: images[mark.image] for mark in reversed(marks)}
    whole = [replace(first[frame], name=frame) for frame in frames]
    least = {image.name: fewest if image.exterior is None else FEWEST_TARGETS for image in whole}
    few = [image for image in whole if targets[image.name] < least[image.name] and not image.is_observed]
    lost = [image for image in few if not _has_film_transformation(image, fiducials[image.name])]
    if len(lost) == len(whole):
        raise InputError(f"{comparator}: {_why_nothing(lost, least, targets, fiducials)}")
    needed = {image.name: fewest_marks(image.transformation) for image in whole}
    short = [image for image in whole if image not in few and fiducials[image.name] < needed[image.name]]
    if len(lost) + len(short) == len(whole):
        short = []  # the adjustment says what is wrong with all
    sentences = [
        f"Image {image.name!r} has no part in the adjustment: it shows "
        f"{counted(fiducials[image.name], 'fiducial mark')}, and its {image.transformation} transformation needs "
        f"{needed[image.name]}. Look at the reasons of the others."
        for image in short
    ]
    sentences += [
        f"Image {image.name!r} has no part in the adjustment: it shows {counted(targets[image.name], 'target')} and "
        f"needs {least[image.name]}. Look at the reasons of its marks; or observe its orientation in images.csv, with "
        "standard deviations."
        for image in lost
    ]
    sentences += [
        f"Image {image.name!r} is not oriented: it shows {counted(targets[image.name], 'target')} and needs "
        f"{least[image.name]}. Its film transformation is adjusted from its fiducials. Look at the reasons of its "
        "targets."
        for image in few
        if image not in lost and expects_targets
    ]
    dropped = {image.name for image in (*lost, *short)}
    bare = dropped | {image.name for image in few}
    kept = [mark for mark in marks if images[mark.image].frame not in (dropped if mark.kind in ON_FILM else bare)]
    return kept, tuple(sentences)


def _joinable(
    comparator: Path, images: Mapping[str, Image], marks: Sequence[ComparatorPoint]
) -> tuple[list[ComparatorPoint], tuple[str, ...]]:
    """Drop joins that only one scan of their frame shows, and marks of scans and frames that lack joins or fiducials,
    with a sentence on each."""
    joins = [mark for mark in marks if mark.kind == "join"]
    for mark in joins:
        if not images[mark.image].part_of:
            raise InputError(
                f"{comparator}, line {mark.line}: image {mark.image!r} shows the join {mark.point!r}, but is no part "
                "of a frame. Name the frame in the column part_of of images.csv, for all of its scans."
            )
    counts = Counter((images[mark.image].frame, mark.point) for mark in joins)
    marks = [mark for mark in marks if mark.kind != "join" or counts[images[mark.image].frame, mark.point] > 1]
    parts = defaultdict[str, defaultdict[str, set[tuple[str, str]]]](partial(defaultdict, set))
    for mark in marks:
        if frame := images[mark.image].part_of:
            parts[frame][mark.image].add((mark.kind, mark.point))
    lost, bare = dict[str, str](), dict[str, str]()
    for frame, points in parts.items():
        fiducials = {part: {each for each in points[part] if each[0] == "fiducial"} for part in points}
        kept = max(_pieces(points), key=lambda piece: sum(len(fiducials[part]) for part in piece))
        lost |= {part: frame for part in points if part not in kept}
        left = [part for part in points if part in kept]
        transformation, count = images[left[0]].transformation, len({each for part in left for each in fiducials[part]})
        if count < (needed := fewest_marks(transformation)):
            bare[frame] = (
                f"Frame {frame!r} has no part in the adjustment: {listed(left)} "
                f"{'shows' if len(left) == 1 else 'show'} {count} fiducial marks, and the transformation "
                f"{transformation} needs {needed}."
            )
    sentences = tuple(
        f"Image {image!r} has no part in the adjustment: it has fewer than {FEWEST_COMMON} points in common with the "
        f"other scans of frame {frame!r}, so that nothing joins it to them. See the reasons of its marks."
        for image, frame in sorted(lost.items())
    )
    sentences += tuple(bare.values())
    kept_marks = [mark for mark in marks if mark.image not in lost and images[mark.image].part_of not in bare]
    if not kept_marks:
        raise InputError(f"{comparator}: {' '.join(sentences)}")
    return kept_marks, sentences


def _pieces(parts: Mapping[str, set[tuple[str, str]]]) -> list[set[str]]:
    """Connected components of the scans of a frame."""
    pieces: list[set[str]] = []
    for part in sorted(parts):
        own = [piece for piece in pieces if any(len(parts[part] & parts[other]) >= FEWEST_COMMON for other in piece)]
        pieces = [piece for piece in pieces if piece not in own] + [{part}.union(*own)]
    return pieces


def _expects_targets(project: Project) -> bool:
    """Whether a project has object points. Without any, only film deformations can be adjusted."""
    return any(part is not None for part in (project.targets, project.ties, project.given_points))


def _has_film_transformation(image: Image, fiducials: int) -> bool:
    return fiducials >= max(marks_needed(image.transformation), 1)


def _why_nothing(
    images: Sequence[Image], least: Mapping[str, int], targets: Counter[str], fiducials: Counter[str]
) -> str:
    most = max(images, key=lambda image: targets[image.name])
    shown = max(images, key=lambda image: fiducials[image.name])
    marks = (
        f" Nor can a film transformation be found: {shown.name!r} shows the most fiducials, {fiducials[shown.name]}, "
        f"and its {shown.transformation} transformation needs {marks_needed(shown.transformation)}."
        if shown.transformation != "none"
        else ""
    )
    return (
        f"no image can be oriented: {most.name!r} shows the most targets, {targets[most.name]}, and an image needs "
        f"{least[most.name]}.{marks} See the status and reason of every mark in that file."
    )


def _image(project: Project, name: str) -> Image:
    camera = project.image_camera(name)
    exterior = project.given_images.exterior.get(name) if project.given_images else None
    transformation = _transformation(project, camera)
    bends = (project.adjust.scanner != "none" or project.lens is not None) and transformation != "none"
    scanner = project.image_scanner(name) if bends else ""
    return Image(name, camera.name, transformation, exterior, scanner, project.scanned_frame(name))


def _transformation(project: Project, camera: CameraFile) -> Transformation:
    """Film deformation model of the project; default: affine for cameras with fiducials, else none."""
    given = project.adjust.transformation
    if given is None:
        return "affine" if camera.fiducials else "none"
    if given != "none" and not camera.fiducials:
        raise InputError(
            f"{project.path}: [adjust] transformation is {given!r}, but {camera.path} has no fiducials for it. "
            'Write transformation = "none" for a digital camera, or add the fiducials.'
        )
    return given


def _cameras(
    project: Project, images: Sequence[Image], marks: Sequence[ComparatorPoint]
) -> tuple[tuple[Camera, ...], tuple[Calibration, ...]]:
    """Cameras of the images, and the earlier calibrations that replace their priors."""
    cameras, calibrations = [], []
    for file in project.cameras.values():
        names = {image.name for image in images if image.camera == file.name}
        if names:
            xy = np.array([mark.xy_mm for mark in marks if mark.image in names])
            center = (xy.min(axis=0) + xy.max(axis=0)) / 2 if file.principal_point_mm is None else np.zeros(2)
            camera = file.camera((float(center[0]), float(center[1])))
            if file.calibration is not None:
                camera, calibration = file.calibration.apply_to(camera)
                calibrations.append(calibration)
            cameras.append(camera)
    return tuple(cameras), tuple(calibrations)


def _points(
    given: Mapping[str, ObjectPoint], ties: TieSettings | None, marks: Sequence[ComparatorPoint]
) -> tuple[ObjectPoint, ...]:
    """Object points that are observed: as given, of the board, or unknown; natural ones may have a given height."""
    kinds = {mark.point: mark.kind for mark in reversed(marks) if mark.kind not in ON_FILM}
    tie_height = None if ties is None or ties.height is None else Prior(ties.height, ties.height_sigma or 0.0)
    points = []
    for id in dict.fromkeys(mark.point for mark in marks if mark.point in kinds):
        height = tie_height if kinds[id] == "tie" else None
        points.append(given.get(id) or ObjectPoint(id, None, None, height))
    return tuple(points)


def _boards(project: Project) -> tuple[Board, ...]:
    """All given points as one board, where its bend is to be estimated. Raises InputError if they form none."""
    sigma = project.board_bend_sigma
    if sigma == 0.0:
        return ()
    flat = {
        point.id: np.array([prior.value for prior in (point.X, point.Y, point.Z) if prior is not None])
        for point in project.object_points.values()
    }
    try:
        return (Board("board", {id_: xyz for id_, xyz in flat.items() if len(xyz) == 3}, (Prior(0.0, sigma),) * 2),)
    except ValueError as error:
        raise InputError(
            f"{project.path}: board_bend is given, but the object points are no board: {error}. Leave it out, or give "
            "the flat coordinates of the board's points."
        ) from None


def _distances(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[tuple[Distance, ...], tuple[str, ...]]:
    """Distances whose ends are both observed, and a sentence on the others."""
    taking_part = {mark.point for mark in marks if mark.kind not in ON_FILM} | {mark.image for mark in marks}
    known = taking_part | set(project.object_points) | set(project.given_images.camera if project.given_images else ())
    known |= set(project.scans)
    kept, lost = [], dict[str, None]()
    for given in project.given_distances:
        ends = {"from": given.distance.start, "to": given.distance.end}
        for column, end in ends.items():
            if end not in known:
                raise given.row.error(column, f"{end!r} is no object point and no image.{did_you_mean(end, known)}")
        if taking_part.issuperset(ends.values()):
            kept.append(given.distance)
        else:
            lost[" to ".join(ends.values())] = None
    sentence = (
        f"Left out, for an end was measured in no image: the distances {listed(list(lost))}. See the status and reason "
        "of its marks."
    )
    return tuple(kept), (sentence,) if lost else ()


def _observations(settings: AdjustSettings, marks: Sequence[ComparatorPoint]) -> Observations:
    """Observed marks; covariances, measured or a priori, with the variance of film and scanner added."""
    covariances_mm2 = []
    for mark in marks:
        if mark.sigma_mm is None:
            sigma_um = settings.sigma_fiducial_um if mark.kind == "fiducial" else settings.sigma_target_um
            own_mm2 = np.eye(2) * (sigma_um / 1000.0) ** 2
        else:
            own_mm2 = np.outer(mark.sigma_mm, mark.sigma_mm) * np.array([[1.0, mark.rho], [mark.rho, 1.0]])
        covariances_mm2.append(own_mm2 + np.eye(2) * (settings.film_sigma_um / 1000.0) ** 2)
    return Observations(
        image=tuple(mark.image for mark in marks),
        point=tuple(mark.point for mark in marks),
        kind=tuple(mark.kind for mark in marks),
        xy_mm=np.array([mark.xy_mm for mark in marks], dtype=np.float64),
        covariance_mm2=np.array(covariances_mm2),
    )
