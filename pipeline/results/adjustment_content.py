"""Conversion of an adjustment to the record that `adjustment.json` holds, and to the arrays of `adjustment.npz`."""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.camera import Camera
from adjust.problem.estimates import adjusted_image, observed_places
from adjust.problem.network import EXTERIOR_NAMES, Board, Image, ObjectPoint
from adjust.problem.parameter import Kind, Parameter
from adjust.quality.critical_values import Tested
from adjust.quality.reliability import Reliability, Suspect
from adjust.quality.significance import CalibrationTest, SignificanceTest
from adjust.solution.result import Adjustment
from pipeline.results import adjustment_record as records
from pipeline.results.assessment_record import (
    ContradictionDirection,
    ContradictionRecord,
    DistanceRecord,
    FiducialDistanceRecord,
    ObservedQuantity,
    OuterRecord,
    ReliabilityRecord,
    ResidualRecord,
    SuspectRecord,
    TestedGiven,
)
from pipeline.results.record_json import record_from
from pipeline.types import Array, Indices

ANGLES = ("omega", "phi", "kappa", "angle")
DEG_PER_RAD = 180.0 / math.pi
MOST_IMAGES = 500  # in larger networks projection_uncertainty takes too long to run with every adjustment
AFFORDABLE = 3000  # largest number of quantities whose covariance is written as one matrix


def joined_frames(adjustment: Adjustment) -> dict[str, records.JoinedFrameRecord]:
    """Records of the frames scanned in parts, by frame; empty without such frames or without a solution.

    Coordinates are camera coordinates in mm, sigmas a posteriori.
    """
    if not adjustment.converged:
        return {}
    network, parts = adjustment.network, defaultdict[str, dict[str, records.PartRecord]](dict)
    marks, camera_mm = defaultdict[str, list[records.PartMarkRecord]](list), dict[int, Array]()
    for image in network.images:
        if image.part_of:
            parts[image.part_of][image.name], own = _part(adjustment, image, camera_mm)
            marks[image.part_of] += own
    joins = defaultdict[str, list[records.JoinRecord]](list)
    for (frame, point), rows in network.joins.items():
        if frame in parts:
            begun, *others = rows.tolist()
            for other in others:  # more than one where three scans or more show the point
                names = tuple(network.observations.image[row] for row in (begun, other))
                first, second = camera_mm[begun], camera_mm[other]
                apart_um, middle = UM_PER_MM * (second - first), (first + second) / 2.0
                joins[frame].append(records.JoinRecord(point, names, *middle.tolist(), *apart_um.tolist()))
    return {
        frame: records.JoinedFrameRecord(own, tuple(joins[frame]), tuple(marks[frame])) for frame, own in parts.items()
    }


def _part(
    adjustment: Adjustment, image: Image, camera_mm: dict[int, Array]
) -> tuple[records.PartRecord, list[records.PartMarkRecord]]:
    """Records of a partial scan and its marks, whose camera coordinates by the film transformation are added by row.

    Tie points and fiducials have adjusted coordinates. Targets have measured ones; their covariance is that of the
    measurement plus that of the film transformation, taken as independent.
    """
    network, model = adjustment.network, adjusted_image(adjustment, image.name)
    observations, variance = network.observations, adjustment.sigma0**2
    rows = np.flatnonzero(network.image_numbers == network.images.index(image))
    xy_mm = observations.xy_mm[rows]
    limits = np.array([xy_mm.min(axis=0), xy_mm.max(axis=0)])
    corners = np.array([[x, y] for x in limits[:, 0] for y in limits[:, 1]])
    film = [Parameter.film(image.name, name) for name in film_parameter_names(image.transformation)]
    by_film = model.film.design(np.vstack([xy_mm, corners]))
    of_film = by_film @ (variance * adjustment.cofactor_of(film)) @ by_film.swapaxes(1, 2)
    gradient = model.camera_by_comparator(xy_mm)
    noise = variance * (gradient @ observations.covariance_mm2[rows] @ gradient.swapaxes(1, 2))
    camera_mm |= dict(zip(rows.tolist(), model.camera_from_comparator(xy_mm), strict=True))
    marks = []
    for row, covariance in zip(rows.tolist(), noise + of_film[:-4], strict=True):
        place, kind, point = camera_mm[row], observations.kind[row], observations.point[row]
        own = {
            "join": [Parameter.join(image.frame, point, axis) for axis in "xy"],
            "fiducial": [Parameter.fiducial(image.camera, point, axis) for axis in "xy"],
        }.get(kind)
        if own:
            place, covariance = adjustment.values_of(own), variance * adjustment.cofactor_of(own)
        sx, sy = np.sqrt(np.diag(covariance)).tolist()
        rho = float(covariance[0, 1] / (sx * sy)) if sx * sy > 0.0 else 0.0
        marks.append(records.PartMarkRecord(image.name, point, kind, float(place[0]), float(place[1]), sx, sy, rho))
    return records.PartRecord(float(UM_PER_MM * np.sqrt(np.linalg.eigvalsh(of_film[-4:])[:, -1].max()))), marks


def adjustment_record(
    adjustment: Adjustment, frames_mm: Mapping[str, tuple[float, float]], made_from: Mapping[str, str]
) -> records.AdjustmentRecord:
    """Convert an adjustment to its record; parameters as in `write_adjustment`."""
    network, variance = adjustment.network, adjustment.variance
    used = {image.camera for image in network.images}
    reliability, further = adjustment.reliability, _further(adjustment)
    return record_from(
        records.AdjustmentRecord,
        adjustment,
        reseau=version("reseau"),
        made_from=dict(made_from),
        observations=adjustment.conditions,
        sigma0_from=records.Sigma0Record(variance.redundancy, variance.is_a_priori, variance.left_out),
        covariance=covariance_note(adjustment),
        suspects=tuple(map(_suspect, adjustment.suspects)),
        reliability=None if reliability is None else _reliability(reliability, len(network.observations)),
        cameras={
            camera.name: _camera(adjustment, camera, frames_mm.get(camera.name))
            for camera in network.cameras
            if camera.name in used
        },
        scanners={
            each.name: records.ScannerRecord(
                each.center_mm,
                each.half_mm,
                *_terms(adjustment, "scanner", each.name, each.terms),
                None if each.lens is None else records.TakingLensRecord.from_lens(each.lens),
            )
            for each in network.scanners
        },
        boards={each.name: _board(adjustment, each) for each in network.boards},
        images={image.name: _image(adjustment, image) for image in network.images},
        frames=joined_frames(adjustment),
        points={
            point.id: _point(adjustment, point)
            for point in network.points
            if adjustment.has(Parameter.point(point.id, "X"))
        },
        residuals=_residuals(adjustment),
        refraction=network.line_of_sight.refraction,
        earth_curvature=network.line_of_sight.curvature,
        distances=tuple(
            DistanceRecord(each.start, each.end, *numbers)
            for each, (_, numbers) in zip(network.distances, further["distance"], strict=True)
        ),
        fiducial_distances=tuple(
            FiducialDistanceRecord(camera, each.start, each.end, *numbers)
            for (camera, each), (_, numbers) in zip(
                network.observed_distances, further["fiducial distance"], strict=True
            )
        ),
        calibrations=tuple(ObservedQuantity(name, *numbers) for name, numbers in further["calibration"]),
        calibration_tests=tuple(map(_contradiction, adjustment.contradictions)),
    )


def _camera(adjustment: Adjustment, camera: Camera, frame_mm: tuple[float, float] | None) -> records.CameraRecord:
    is_idle = camera.name in adjustment.network.idle_cameras
    tests, together = _tests(adjustment, "interior", camera.name)

    def quantity(name: str, given: Prior | None) -> records.Quantity:
        parameter = Parameter.interior(camera.name, name)
        if is_idle:
            return replace(_quantity(adjustment, parameter, given), sigma=math.nan)
        found = _quantity(adjustment, parameter, given, test=tests.get(name))
        return replace(found, sigma_clusters=clusters.get(parameter)) if found.sigma else found

    keys = [key for key in adjustment.parameters if (key.kind, key.owner) == ("interior", camera.name)]
    by_images = adjustment.cluster_covariance_of(keys) if keys and adjustment.unmodelled_mm else None
    clusters = {} if by_images is None else dict(zip(keys, np.sqrt(np.diag(by_images)).tolist(), strict=True))
    given = camera.distortion.parameters
    parameters = {key: quantity(key, given.get(key, Prior(0.0))) for key in parameter_names(camera.distortion.family)}
    reach = adjustment.lens_reach(camera, frame_mm)
    return records.CameraRecord(
        principal_distance_mm=quantity("c", camera.principal_distance_mm),
        principal_point_mm=records.PrincipalPointRecord(quantity("x0", camera.x0_mm), quantity("y0", camera.y0_mm)),
        distortion=records.DistortionRecord.from_distortion(camera.distortion, parameters),
        significance=together,
        fiducials={
            id: records.FiducialRecord(
                _quantity(adjustment, x, mark.x_mm), _quantity(adjustment, y, mark.y_mm), _correlation(adjustment, x, y)
            )
            for id, mark in camera.fiducials.items()
            for x, y in [[Parameter.fiducial(camera.name, id, axis) for axis in "xy"]]
        },
        lens_known=None if reach is None else record_from(records.LensReachRecord, reach),
        projection=() if reach is None else tuple(_projection(adjustment, camera.name)),
        is_loose=camera.name in adjustment.loose_cameras,
    )


def _projection(adjustment: Adjustment, camera: str) -> Iterator[records.ProjectionRecord]:
    """Precision of projected points at infinity and at the median distance of the targets."""
    if len(adjustment.network.images) > MOST_IMAGES:
        return
    infinite = adjustment.projection_uncertainty(camera)
    near = adjustment.projection_uncertainty(camera, infinite.median_distance)
    for known in (infinite, near):
        x_mm, y_mm = known.places_mm[0, :, 0], known.places_mm[::-1, 0, 1]
        sigma_um = [[float(f"{UM_PER_MM * each:.4g}") for each in row] for row in known.sigma_mm[::-1]]
        distance = known.distance if math.isfinite(known.distance) else math.nan
        yield records.ProjectionRecord(
            distance, tuple(x_mm.tolist()), tuple(y_mm.tolist()), tuple(map(tuple, sigma_um))
        )


def _board(adjustment: Adjustment, board: Board) -> records.BoardRecord:
    bends = dict(zip(board.names, board.bends, strict=True))
    terms, together = _terms(adjustment, "board", board.name, bends)
    return records.BoardRecord(points=len(board.places), terms=terms, significance=together)


def _terms(
    adjustment: Adjustment, kind: Kind, owner: str, terms: Mapping[str, Prior]
) -> tuple[dict[str, records.Quantity], tuple[records.GroupTestRecord, ...]]:
    """Terms with their significance tests, and the tests of groups."""
    tests, together = _tests(adjustment, kind, owner)
    quantities = {
        name: _quantity(adjustment, Parameter(kind, owner, "", name), prior, test=tests.get(name))
        for name, prior in terms.items()
    }
    return quantities, together


def _tests(
    adjustment: Adjustment, kind: Kind, owner: str
) -> tuple[dict[str, SignificanceTest], tuple[records.GroupTestRecord, ...]]:
    """Significance tests: of single parameters by name, and of groups."""
    tests = adjustment.significance.get((kind, owner), ())
    groups = (
        records.GroupTestRecord(each.name, each.parameters, each.statistic, each.p) for each in tests if each.is_group
    )
    return {each.name: each for each in tests if not each.is_group}, tuple(groups)


def _image(adjustment: Adjustment, image: Image) -> records.ImageRecord:
    film_keys = [Parameter.film(image.name, name) for name in film_parameter_names(image.transformation)]
    exterior_keys = [Parameter.exterior(image.frame, element) for element in EXTERIOR_NAMES]
    film = {}
    for key in film_keys:
        name, scale = (f"{key.quantity}_deg", DEG_PER_RAD) if key.quantity in ANGLES else (key.quantity, 1.0)
        film[name] = _quantity(adjustment, key, None, scale)
    elements, known = [], image.exterior
    for i, key in enumerate(exterior_keys):
        given = None if known is None else Prior(float(known.values[i]), float(known.sigmas[i]))
        elements.append(_quantity(adjustment, key, given, DEG_PER_RAD if key.quantity in ANGLES else 1.0))
    if image.name in adjustment.network.unoriented:
        elements = [replace(each, sigma=math.nan) for each in elements]
    return records.ImageRecord(
        camera=image.camera,
        scanner=image.scanner,
        part_of=image.part_of or None,
        transformation=records.FilmRecord(
            kind=image.transformation, mirrored=image.name in adjustment.mirrored, parameters=film
        ),
        exterior=records.ExteriorRecord(*elements),
    )


def _point(adjustment: Adjustment, point: ObjectPoint) -> records.PointRecord:
    """Coordinates of a point with their priors; the deflection of a bent board is added."""
    keys = [Parameter.point(point.id, axis) for axis in "XYZ"]
    place = {key.quantity: _quantity(adjustment, key, prior) for key, prior in zip(keys, point.priors, strict=True)}
    for board in adjustment.network.boards:
        if point.id in board.places:
            unknowns = [*keys, *(Parameter.board(board.name, each) for each in board.names)]
            by_unknowns = np.hstack([np.eye(3), board.lift_directions[point.id].T])
            values = by_unknowns @ adjustment.values_of(unknowns)
            variances = np.diag(by_unknowns @ adjustment.cofactor_of(unknowns) @ by_unknowns.T)
            for axis, value, variance in zip("XYZ", values, variances, strict=True):
                sigma = adjustment.sigma0 * math.sqrt(variance) if _has_solution(adjustment) else math.nan
                place[axis] = replace(place[axis], value=float(value), sigma=sigma)
    return records.PointRecord(**place)


def _quantity(
    adjustment: Adjustment,
    parameter: Parameter,
    given: Prior | None = None,
    scale: float = 1.0,
    test: SignificanceTest | None = None,
) -> records.Quantity:
    """Value and a-posteriori sigma; NaN without a solution, since zero means that the quantity was fixed."""
    return records.Quantity(
        value=scale * adjustment.value(parameter),
        sigma=scale * adjustment.sigma(parameter) if _has_solution(adjustment) else math.nan,
        given=None if given is None else records.GivenQuantity(scale * given.value, scale * given.sigma),
        t=None if test is None else test.statistic,
        p=None if test is None else test.p,
    )


def _correlation(adjustment: Adjustment, x: Parameter, y: Parameter) -> float:
    q = adjustment.cofactor_of([x, y])
    product = q[0, 0] * q[1, 1]
    return float(q[0, 1] / math.sqrt(product)) if product > 0.0 and _has_solution(adjustment) else 0.0


def _has_solution(adjustment: Adjustment) -> bool:
    return adjustment.termination in ("converged", "iteration limit")


def _residuals(adjustment: Adjustment) -> tuple[ResidualRecord, ...]:
    observations, residuals = adjustment.network.observations, adjustment.residuals
    camera_mm = _camera_places(adjustment, observations.xy_mm)
    w = np.where(np.isfinite(residuals.w), residuals.w, np.nan)
    larger_axis = np.argmax(np.nan_to_num(np.abs(w), nan=-1.0), axis=1)[:, None]
    columns = [
        UM_PER_MM * residuals.v_mm,
        residuals.redundancy,
        np.column_stack([np.take_along_axis(w, larger_axis, axis=1), residuals.w]),
        adjustment.weights[:, None] if adjustment.weights.size else np.ones((len(observations), 1)),
        UM_PER_MM * np.sqrt(np.diagonal(observations.covariance_mm2, axis1=1, axis2=2)),
        observations.xy_mm,
        camera_mm,
        UM_PER_MM * (_camera_places(adjustment, observations.xy_mm + residuals.v_mm) - camera_mm),
    ]
    if (result := adjustment.reliability) is not None:
        rows = slice(len(observations))
        effect = np.max(result.effect[rows], axis=1)
        columns += [result.tau[rows], result.statistic[rows, None], UM_PER_MM * result.smallest[rows], effect[:, None]]
    names = zip(observations.image, observations.point, observations.kind, strict=True)
    return tuple(ResidualRecord(*name, *row) for name, row in zip(names, np.hstack(columns).tolist(), strict=True))


def _camera_places(adjustment: Adjustment, xy_mm: Array) -> Array:
    """Transform comparator coordinates (n, 2) of all observations to camera coordinates (n, 2), mm."""
    camera_mm = np.empty_like(xy_mm)
    for camera in adjustment.network.cameras:
        rows, places_mm = observed_places(adjustment, camera.name, xy_mm)
        camera_mm[rows] = places_mm
    return camera_mm


def _further(adjustment: Adjustment) -> dict[str, list[tuple[str, tuple[float, ...]]]]:
    """Names and numbers of the observations that are no marks, by group; fiducial distances in mm and µm."""
    rows = defaultdict[str, list[tuple[str, tuple[float, ...]]]](list)
    for row in adjustment.further:
        scale = UM_PER_MM if row.group == "fiducial distance" else 1.0
        numbers = row.observed, row.sigma, scale * row.v, row.redundancy, row.w, scale * row.detectable
        rows[row.group].append((row.name, numbers))
    return rows


def _contradiction(test: CalibrationTest) -> ContradictionRecord:
    direction = tuple(
        ContradictionDirection(test.parameters[i].text, float(test.difference[i]), float(test.sigma[i]))
        for i in test.direction
    )
    return ContradictionRecord(test.statistic, test.freedom, test.probability, direction)


def _reliability(result: Reliability, marks: int) -> ReliabilityRecord:
    """Record of the reliability without its first units, the marks: those are in the residuals.

    The smallest detectable error of an unchecked coordinate is infinite.
    """
    given = []
    for unit in range(marks, len(result.tested)):
        tested = result.tested[unit]
        for axis in range(result.sizes[unit]):
            scale, at = _scale(tested, axis), (unit, axis)
            given.append(
                TestedGiven(
                    name=tested.coordinate_name(axis),
                    group=tested.group,
                    v=scale * float(result.v[at]),
                    sigma=scale * float(result.sigma[at]),
                    redundancy=float(result.redundancy[at]),
                    w=float(result.w[at]),
                    tau=float(result.tau[at]),
                    smallest_error=scale * float(result.smallest[at]),
                    effect_sigmas=float(result.effect[at]),
                )
            )
    return ReliabilityRecord(
        *(result.probabilities.alpha, result.probabilities.power, result.probabilities.family),
        result.critical_tau,
        tuple(OuterRecord(each.parameter.text, each.effect, each.in_sigmas, each.cause) for each in result.outer),
        result.unchecked,
        tuple(given),
    )


def _scale(tested: Tested, axis: int) -> float:
    return DEG_PER_RAD if tested.coordinates[axis] in ANGLES else 1.0


def _suspect(suspect: Suspect) -> SuspectRecord:
    tested = suspect.tested
    error = tuple(_scale(tested, axis) * value for axis, value in enumerate(suspect.error))
    return record_from(SuspectRecord, suspect, error=error, name=tested.name, **vars(tested))


def covariance_arrays(adjustment: Adjustment) -> dict[str, NDArray[np.generic]]:
    """Arrays of the covariance file by name; mm, object units, rad.

    names (n), values (n) and matrix (n, n) hold all quantities if there are at most AFFORDABLE; otherwise those of
    cameras and images; if these exceed it too, those of cameras. The remaining points (and images) are stored as
    diagonal blocks, without covariances between them: point_names (p, 3), point_values (p, 3), point_matrices
    (p, 3, 3), image_names (i, k) and so on, padded with empty names and zeros for images with fewer than k quantities.
    cluster_names (k), cluster_matrix (k, k) are of the interior orientations, if an unmodelled error was estimated.
    """
    whole, blocks = _parts(adjustment)
    arrays = _names_and_values(adjustment, whole) | {"matrix": adjustment.sigma0**2 * adjustment.cofactor.part(whole)}
    for kind, groups in blocks.items():
        padded = np.full((len(groups), max(map(len, groups))), -1, dtype=np.intp)
        for row, group in zip(padded, groups, strict=True):
            row[: len(group)] = group
        matrices = np.zeros((*padded.shape, padded.shape[1]))
        lengths = (padded >= 0).sum(axis=1)
        for length in np.unique(lengths):
            cofactors = adjustment.cofactor.parts(padded[lengths == length, :length])
            matrices[lengths == length, :length, :length] = adjustment.sigma0**2 * cofactors
        named = _names_and_values(adjustment, padded) | {"matrices": matrices}
        arrays |= {f"{kind}_{name}": array for name, array in named.items()}
    keys = [key for key in adjustment.parameters if key.kind == "interior"] if adjustment.unmodelled_mm else []
    clusters = adjustment.cluster_covariance_of(keys) if keys else None
    if clusters is not None:
        arrays |= {"cluster_names": np.array([key.text for key in keys], dtype=np.str_), "cluster_matrix": clusters}
    return arrays


def covariance_note(adjustment: Adjustment) -> str:
    """State which parts of the covariance the file holds."""
    count, alone = len(adjustment.parameters), " and every ".join(_parts(adjustment)[1])
    if not alone:
        return "adjustment.npz holds the covariance of all quantities."
    whole = "cameras" if "image" in alone else "cameras and images"
    return (
        f"adjustment.npz holds the covariance of the {whole} together and of every {alone} by itself: the matrix of "
        f"all {count} quantities would be too large."
    )


def _parts(adjustment: Adjustment) -> tuple[Indices, dict[str, list[Indices]]]:
    """Positions of the quantities in the matrix, and by kind of those in each diagonal block."""
    parameters = adjustment.parameters
    whole = np.arange(len(parameters))
    groups: dict[str, list[Indices]] = {}
    # The quantities of a point or an image are contiguous and begin with X or X0.
    for kind, kinds, first in (("point", ("point",), "X"), ("image", ("exterior", "film"), "X0")):
        members = np.array([parameters[i].kind in kinds for i in whole], dtype=bool)
        if len(whole) <= AFFORDABLE or not members.any():
            continue
        positions = whole[members]
        begins = [j for j, i in enumerate(positions) if parameters[i].quantity == first]
        groups[kind] = np.split(positions, begins[1:])
        whole = whole[~members]
    return whole, groups


def _names_and_values(adjustment: Adjustment, positions: Indices) -> dict[str, NDArray[np.generic]]:
    """Names and values at positions; "" and 0 at -1."""
    names = np.array([*adjustment.names, ""], dtype=np.str_)
    return {"names": names[positions], "values": np.append(adjustment.values, 0.0)[positions]}
