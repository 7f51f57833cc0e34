"""Check of the adjustment against OpenCV: the same observations in its calibration of cameras or fisheyes, in sigmas.

OpenCV has neither film transformations, nor priors, nor weights, nor uncertain object points. The comparison therefore
uses a bare problem that both programs can solve: the observations in the camera frame by the adjusted transformations,
the object points at their adjusted coordinates, equal weights, no priors. The adjustment solves this problem again. Its
solution is converted to OpenCV's model by a fit over the image. The change from the full adjustment to the bare problem
is reported, too."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.lens_conversion import convert_lens
from adjust.problem.camera import Camera
from adjust.problem.estimates import adjusted_image, adjusted_lens, adjusted_places
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.problem.parameter import Parameter, description, enumeration
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from measure.boards.markers import charuco_board
from measure.boards.specs import ArucoSpec, BoardSpec, CharucoSpec, ChessboardSpec, CircleGridSpec, aruco_dictionary
from measure.errors import MeasurementError
from measure.scans.scan import Scan
from pipeline.adjusting.picture_turn import turned_back
from pipeline.opencv_check.opencv_calibration import (
    FISHEYE,
    INTERIOR,
    NAMES,
    OPENCV_RADIAL,
    Freedom,
    NoRedundancyError,
    OpenCvCalibration,
    OpenCVPoints,
    calibrate,
    calibrate_fisheye,
    can_begin,
    fixed_distortion,
    model_names,
    opencv_values,
)
from pipeline.results import stage_files
from pipeline.results.adjustment_record import Quantity
from pipeline.results.comparator_file import comparator_from_pixel
from pipeline.types import Array

GROSS_WEIGHT = 0.5  # observations with a lower robust weight are left out

# OpenCV's counterparts of each family's parameters. Parameters without one are held at their adjusted values.
COUNTERPARTS: Mapping[str, Mapping[str, str]] = {
    "none": {},
    "torlegard": {"k3": "k1", "k5": "k2", "k7": "k3", "p1": "p1", "p2": "p2"},
    "brown": {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p1", "p2": "p2", "b1": "fy"},
    "australis": {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p1", "p2": "p2", "b1": "fy"},
    "aicon": {"a1": "k1", "a2": "k2", "a3": "k3", "b1": "p2", "b2": "p1", "c1": "fy"},
    "opencv": {name: name for name in parameter_names("opencv") if name not in ("b1", "b2")} | {"b1": "fy"},
    FISHEYE: {name: name for name in parameter_names(FISHEYE) if name not in ("b1", "b2")}
    | {"b1": "fy", "b2": "alpha"},
}
# Parameters that OpenCV estimates only together.
FREE_TOGETHER = (frozenset({"p1", "p2"}), frozenset({"s1", "s2", "s3", "s4"}), frozenset({"tau_x", "tau_y"}))
Bytes = NDArray[np.uint8]
Calibrate = Callable[[Sequence[OpenCVPoints]], OpenCvCalibration]

HALF_WINDOW_PX = 11  # of cornerSubPix, as in OpenCV's calibration sample
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.0001)  # of the same sample
FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK | cv2.CALIB_CB_NORMALIZE_IMAGE  # of the same sample
NEAREST = 0.4  # of the distance to the next point: largest distance between corresponding points
FEWEST_PICTURES = 3
LARGEST_DIFFERENCE = 1.0  # sigmas; about 0.1 is usual, since the two models differ slightly
LARGEST_SIGMA_RATIO = 1.2  # ratio of standard deviations; 1.006 to 1.03 is usual
SAME_MODEL_DIFFERENCE = 0.1  # sigmas, where both programs use the identical model
SAME_MODEL_SIGMA_RATIO = 1.02  # the same of standard deviations
LARGEST_DEPARTURE = 3.0  # sigmas, largest accepted change of a parameter by priors, weights etc.
NOTABLE_DEPARTURE = 0.1  # standard deviations from which a departure is reported
LARGEST_REFIT = 0.5  # fraction of an image coordinate's sigma: above it, OpenCV's model does not fit the lens
UNDETERMINED = 0.05  # relative sigma of the principal distance above which no comparison is possible
WORSE_RMS = 1.02  # ratio of OpenCV's rms to the adjustment's that shows that its iteration stopped early
ROUNDINGS = 20.0  # rms, in units of OpenCV's rounding of one coordinate, below which rounding dominates the residuals
NOTABLE_SPREAD = 1.5  # ratio of the largest to the smallest sigma of marks, from which it is reported
NOTABLE_ROUNDING = 0.01  # fraction of the standard deviation of an image coordinate


@dataclass(frozen=True)
class BareProblem:
    """The bare problem for the adjustment (network, approximations) and for OpenCV (images, freedom).

    Attributes
    ----------
    sigma_mm : common standard deviation of all image coordinates.
    sigma_spread : ratio of the largest to the smallest standard deviation of the observations.
    gross : number of observations with a low robust weight.
    uncertain_points : number of object points that their priors do not fix.
    left_out : images with too few points for OpenCV.
    """

    network: Network
    approximations: Approximations
    images: tuple[OpenCVPoints, ...]
    freedom: Freedom
    sigma_mm: float
    sigma_spread: float
    gross: int
    uncertain_points: int
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class ConvertedSolution:
    """A solution in OpenCV's model.

    Attributes
    ----------
    parameters : (n,) in the order of `model_names`.
    sigmas : (n,) a-priori standard deviations.
    residual_mm : difference of the two lenses over the image, rms per point.
    """

    parameters: Array
    sigmas: Array
    residual_mm: float


@dataclass(frozen=True)
class BoardPictures:
    """Images of a board.

    Attributes
    ----------
    open_scan : opens an image by its name; raises MeasurementError or KeyError where its scan is not available.
    pitch_um : pixel pitch across and down, by image.
    turned : (counter-clockwise turn in degrees, size of the sensor), by image, for images that were turned.
    """

    board: BoardSpec
    open_scan: Callable[[str], Scan]
    pitch_um: Mapping[str, tuple[float, float]]
    turned: Mapping[str, tuple[int, tuple[float, float]]] = field(default_factory=dict)

    def points_mm(self, image: str) -> Array:
        """(n, 2) points that OpenCV finds, in the frame of the sensor, mm; empty where the scan is not available."""
        try:
            with self.open_scan(image) as scan:
                grey = scan.window(0, 0, scan.width_px, scan.height_px) * (255.0 / scan.full_scale_dn)
                pitch_um = self.pitch_um[image]
        except (MeasurementError, KeyError):
            return np.zeros((0, 2))
        picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        points_mm = comparator_from_pixel(find_points(picture, self.board), pitch_um)
        return turned_back(points_mm, *self.turned[image]) if image in self.turned else points_mm


def detector_name(board: BoardSpec) -> str:
    """OpenCV's functions that detect such a board; empty where there is no customary one."""
    match board:
        case ChessboardSpec():
            return f"findChessboardCorners and cornerSubPix, half a window of {HALF_WINDOW_PX} px"
        case CircleGridSpec(asymmetric=False):
            return "findCirclesGrid"
        case CharucoSpec():
            return "CharucoDetector"
        case ArucoSpec():
            return "ArucoDetector"
        case _:
            return ""


def find_points(picture: Bytes, board: BoardSpec) -> Array:
    """(n, 2) column and row of a board's points, by OpenCV's functions with their customary settings."""
    found: object = True
    points = None
    match board:
        case ChessboardSpec():
            found, points = cv2.findChessboardCorners(picture, (board.columns, board.rows), flags=FLAGS)
            if found:
                points = cv2.cornerSubPix(picture, points, (HALF_WINDOW_PX,) * 2, (-1, -1), CRITERIA)
        case CircleGridSpec(asymmetric=False):
            found, points = cv2.findCirclesGrid(picture, (board.columns, board.rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        case CharucoSpec():
            points = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(picture)[0]
        case ArucoSpec():
            parameters = cv2.aruco.DetectorParameters()
            parameters.markerBorderBits = board.border_modules
            markers = cv2.aruco.ArucoDetector(aruco_dictionary(board.dictionary), parameters).detectMarkers(picture)[0]
            points = np.concatenate(markers) if len(markers) else None
    return np.asarray(points, dtype=float).reshape(-1, 2) if found and points is not None else np.zeros((0, 2))


def compare_corners(
    images: Sequence[OpenCVPoints], pictures: BoardPictures, calibrate: Calibrate
) -> stage_files.CornersCheck | None:
    """Calibrate the measured points and OpenCV's own points with OpenCV, using the points that both have.

    Returns None where too few images are available, or OpenCV finds the board in too few of them.
    """
    both = []
    for image in images:
        own_mm = pictures.points_mm(image.image)
        if len(own_mm) == 0 or len(image.xyz) < 2:
            continue
        # OpenCV's points take the names of the nearest measured ones.
        apart_mm = np.asarray(KDTree(image.xy_mm).query(image.xy_mm, k=2)[0])[:, 1]
        distance_mm, nearest = (np.asarray(each) for each in KDTree(own_mm).query(image.xy_mm))
        rows = np.flatnonzero(distance_mm < NEAREST * apart_mm)
        xyz, xy_mm = image.xyz[rows], image.xy_mm[rows]
        if can_begin(xyz):
            both.append((OpenCVPoints(image.image, xyz, xy_mm), OpenCVPoints(image.image, xyz, own_mm[nearest[rows]])))
    if len(both) < FEWEST_PICTURES:
        return None
    found = {image.image for image, _ in both}
    try:
        measured, own = (calibrate(each) for each in zip(*both, strict=True))
    except (cv2.error, NoRedundancyError):
        return None
    pitch_mm = np.array(pictures.pitch_um[both[0][0].image]) / 1000.0
    return stage_files.CornersCheck(
        detector_name(pictures.board),
        len(both),
        sum(len(image.xyz) for image, _ in both),
        tuple(image.image for image in images if image.image not in found),
        _pixel_calibration(measured, pitch_mm),
        _pixel_calibration(own, pitch_mm),
    )


def _pixel_calibration(calibration: OpenCvCalibration, pitch_mm: Array) -> stage_files.PixelCalibration:
    fx, fy, cx, cy = (calibration.parameters[:4] / np.tile(pitch_mm, 2) * (1.0, 1.0, 1.0, -1.0)).tolist()
    return stage_files.PixelCalibration(fx, fy, cx, cy, calibration.rms_um / 1000.0 / float(np.sqrt(pitch_mm.prod())))


def check_against_opencv(adjustment: Adjustment, pictures: BoardPictures | None = None) -> stage_files.Check:
    """Compare every camera of an adjustment with OpenCV's calibration of the same observations.

    The verdicts are "agrees": no parameter differs by more than one sigma; or a strong distortion does not fit OpenCV's
    model well enough for that, but the solutions agree once the adjustment uses OpenCV's model. "differs": a parameter
    differs, or priors and weights moved one by more than three sigmas. "not possible": OpenCV, or any adjustment
    without priors, cannot solve the problem. The reason gives the details.

    Parameters
    ----------
    pictures : images of a board; for digital cameras, OpenCV's own points in them are calibrated, too.
    """
    checks = {}
    for camera in adjustment.network.cameras:
        known: dict[str, Any] = {}  # results of the check up to a failure
        try:
            verdict, reason = _compare(adjustment, camera.name, pictures, known)
        except _NotPossible as hindrance:
            verdict, reason = "not possible", str(hindrance)
        checks[camera.name] = stage_files.CameraCheck(verdict, reason, **known)
    return stage_files.Check.from_cameras(checks)


class _NotPossible(Exception):
    """Reason why no comparison is possible."""


def _hindrance(adjustment: Adjustment, name: str) -> str:
    """Reason why OpenCV has no model for this camera; empty where it has one."""
    network, camera = adjustment.network, adjustment.network.camera_by_name[name]
    if not adjustment.converged:
        return f"The adjustment itself has no solution: {_stop_reason(adjustment)}."
    if name in network.idle_cameras:
        return "No image shows object points: the camera is not calibrated."
    if not network.line_of_sight.is_straight:
        return "OpenCV knows neither refraction nor the curvature of the earth."
    if camera.distortion.family not in COUNTERPARTS:
        return f"OpenCV has no counterpart of the distortion family {camera.distortion.family}."
    free = free_parameters(camera)
    if ("x0" in free) != ("y0" in free):
        return "OpenCV holds both coordinates of the principal point or neither; here one is fixed."
    stretch = [name for name in free if COUNTERPARTS[camera.distortion.family].get(name) == "fy"]
    if stretch and "c" not in free:
        return f"OpenCV holds both focal lengths or neither; here c is fixed and {stretch[0]} is not."
    return "" if free else "Everything of this camera is fixed: there is nothing to compare."


def _solve_without_priors(problem: BareProblem) -> Adjustment:
    """Solve the bare problem. Raises _NotPossible where the observations alone do not determine the camera."""
    try:
        solved = adjust(problem.network, problem.approximations)
    except AdjustmentError as error:
        raise _NotPossible(f"Without priors this camera cannot be adjusted: {error}") from None
    if solved.singular:
        causes = " ".join(f"{description(direction.parameters)}: {direction.cause}" for direction in solved.singular)
        raise _NotPossible(
            f"Priors carried the solution; the observations of the points alone do not determine it. {causes}"
        )
    if not solved.converged:
        raise _NotPossible(f"Without priors the adjustment finds no solution: {_stop_reason(solved)}.")
    distance = Parameter.interior(problem.network.cameras[0].name, "c")
    c, sigma = solved.value(distance), solved.sigma(distance)
    if sigma > UNDETERMINED * c:
        raise _NotPossible(
            f"From the observations of the points alone the principal distance has a standard deviation of "
            f"{sigma:.3g} mm, {100.0 * sigma / c:.0f} % of its value."
        )
    return solved


def _stop_reason(adjustment: Adjustment) -> str:
    causes = [direction.cause for direction in adjustment.singular] or [adjustment.termination]
    return " ".join(causes).rstrip(".")


@dataclass(frozen=True)
class _Solutions:
    """Solutions of the bare problem of a camera: by the adjustment, converted to OpenCV's model, and by OpenCV."""

    problem: BareProblem
    solved: Adjustment
    conversion: ConvertedSolution
    opencv: OpenCvCalibration

    @property
    def camera(self) -> Camera:
        return self.problem.network.cameras[0]

    @property
    def has_residuals(self) -> bool:
        """Whether the residuals are larger than OpenCV's rounding, so that they tell the standard deviations."""
        return _rms_um(self.solved) > ROUNDINGS * self.opencv.rounding_um

    @cached_property
    def inseparable(self) -> list[str]:
        """Radial terms that the observations do not separate."""
        return self.solved.inseparable(self.camera.name)

    @cached_property
    def rows(self) -> tuple[stage_files.ComparedParameter, ...]:
        """Parameters that are compared: all estimated ones but inseparable terms."""
        sigma0 = self.solved.sigma0 if self.has_residuals else 1.0
        names = model_names(self.camera.distortion.family)
        rows = _rows(names, self.problem.freedom, self.conversion, sigma0, self.opencv)
        return tuple(row for row in rows if not self.inseparable or row.name not in OPENCV_RADIAL)


def _compare(
    adjustment: Adjustment, name: str, pictures: BoardPictures | None, known: dict[str, Any]
) -> tuple[stage_files.Verdict, str]:
    """Verdict and its reason; intermediate results are added to known. Raises _NotPossible."""
    if hindrance := _hindrance(adjustment, name):
        raise _NotPossible(hindrance)
    problem = bare_problem(adjustment, name)
    if not problem.images:
        raise _NotPossible("No image shows enough points for OpenCV: 4 in a plane, 6 otherwise.")
    known |= {"images": len(problem.images), "points": sum(len(image.xyz) for image in problem.images)}
    solved = _solve_without_priors(problem)
    known["rms_reseau_um"] = rms_um = _rms_um(solved)
    conversion = _conversion(problem, solved, known)
    is_fisheye = problem.network.cameras[0].distortion.family == FISHEYE
    calibrated = partial(
        calibrate_fisheye if is_fisheye else calibrate, freedom=problem.freedom, start=conversion.parameters
    )
    opencv = _opencv_solution(problem.images, calibrated)
    solutions = _Solutions(problem, solved, conversion, opencv)
    if not solutions.rows:
        raise _NotPossible(
            f"{enumeration(solutions.inseparable)} cannot be separated, and nothing else is free: no parameter is left "
            "to compare."
        )
    known |= {"rms_opencv_um": opencv.rms_um, "rows": solutions.rows}
    is_digital = _is_digital(adjustment, problem)
    if pictures is not None and is_digital:
        known["corners_px"] = compare_corners(problem.images, pictures, calibrated)
    if opencv.rms_um > WORSE_RMS * rms_um + ROUNDINGS * opencv.rounding_um:
        raise _NotPossible(
            f"OpenCV ends in a worse solution, {opencv.rms_um:.2f} µm a point against {rms_um:.2f} µm: it "
            "begins every image by itself and did not come to the minimum."
        )
    verdict, reason = _verdict(solutions, adjustment)
    if not is_digital:  # whose pixels may have no size
        reason += f" The residuals are {opencv.rms_um:.2f} µm rms a point in OpenCV, {rms_um:.2f} µm here."
    return verdict, f"{reason} {_notes(solutions)}"


def _opencv_solution(images: Sequence[OpenCVPoints], calibrated: Calibrate) -> OpenCvCalibration:
    """Calibrate by OpenCV. Raises _NotPossible where it cannot."""
    try:
        return calibrated(images)
    except cv2.error as error:
        raise _NotPossible(f"OpenCV refuses these observations: {error.err}.") from None
    except NoRedundancyError as error:
        raise _NotPossible(
            f"There is nothing to compare: {error}. Take more pictures, or measure more points."
        ) from None


def _rms_um(solved: Adjustment) -> float:
    """Rms of the residuals of a point."""
    return 1e3 * float(np.sqrt((solved.residuals.v_mm**2).sum(axis=1).mean()))


def _conversion(problem: BareProblem, solved: Adjustment, known: dict[str, Any]) -> ConvertedSolution:
    """Convert a solution to OpenCV's model. Raises _NotPossible where that has no such lens."""
    try:
        conversion = convert_solution(problem, solved)
    except AdjustmentError as error:
        raise _NotPossible(f"OpenCV's model cannot take this lens: {error}") from None
    sigma_um, refit_um = 1e3 * problem.sigma_mm, 1e3 * conversion.residual_mm
    known["refit_residual_um"] = refit_um
    if refit_um > LARGEST_REFIT * sigma_um:
        raise _NotPossible(
            f"OpenCV's model cannot take this lens: the nearest one is off by {refit_um:.2f} µm, rms over the image, "
            f"where a coordinate's standard deviation is {sigma_um:.2f} µm."
        )
    return conversion


def _verdict(solutions: _Solutions, adjustment: Adjustment) -> tuple[stage_files.Verdict, str]:
    """Verdict and reason from the parameters of both programs, then from what priors and weights change."""
    # Pseudo-observations along the valley, which OpenCV has not, make the other standard deviations smaller.
    verdict, reason = _agreement(solutions.rows, solutions.has_residuals and not solutions.inseparable)
    if verdict == "differs" and _same_model_agrees(solutions):
        verdict, points = "agrees", sum(len(image.xyz) for image in solutions.problem.images)
        reason = (
            "Given the very same model both programs agree. OpenCV's own model is not quite this lens: the refit "
            f"leaves {1e3 * solutions.conversion.residual_mm:.3f} µm, which {points} points notice. {reason}"
        )
    if verdict == "agrees" and solutions.has_residuals:
        verdict, reason = _judge_departure(reason, adjustment, solutions)
    if solutions.inseparable:
        terms = enumeration(solutions.inseparable)
        reason += f" {terms} cannot be separated: the radial terms are not compared one by one."
    return verdict, reason


def _is_digital(adjustment: Adjustment, problem: BareProblem) -> bool:
    """Whether the camera frame is that of the images, without film transformations."""
    network = adjustment.network
    camera = network.camera_by_name[problem.network.cameras[0].name]
    transformations = {network.image_by_name[image.image].transformation for image in problem.images}
    return not camera.fiducials and transformations == {"none"}


def _rows(
    names: Sequence[str], freedom: Freedom, conversion: ConvertedSolution, sigma0: float, opencv: OpenCvCalibration
) -> tuple[stage_files.ComparedParameter, ...]:
    return tuple(
        stage_files.ComparedParameter.from_numbers(
            name,
            "mm" if name in INTERIOR else "rad" if name in ("tau_x", "tau_y") else "1",
            Quantity(float(conversion.parameters[k]), float(sigma0 * conversion.sigmas[k])),
            Quantity(float(opencv.parameters[k]), float(opencv.sigmas[k])),
        )
        for k, name in enumerate(names)
        if name in freedom.names
    )


def _agreement(rows: Sequence[stage_files.ComparedParameter], sigmas_tell: bool) -> tuple[stage_files.Verdict, str]:
    """Verdict from the parameters. sigmas_tell: whether the residuals are larger than OpenCV's rounding."""
    worst = max(rows, key=lambda row: row.difference_sigmas)
    loosest = max(rows, key=_sigma_ratio)
    found = f"{worst.name} differs most from OpenCV's, by {worst.difference_sigmas:.2f} sigma"
    if worst.difference_sigmas > LARGEST_DIFFERENCE:
        return "differs", f"{found}; up to {LARGEST_DIFFERENCE:g} is acceptable."
    if sigmas_tell and _sigma_ratio(loosest) > LARGEST_SIGMA_RATIO:
        ratio = f"The standard deviations of {loosest.name} differ by a factor of {_sigma_ratio(loosest):.2f}"
        return "differs", f"{ratio}, up to {LARGEST_SIGMA_RATIO:g} is acceptable; {found}."
    return "agrees", f"All {len(rows)} parameters agree: {found}."


def _sigma_ratio(row: stage_files.ComparedParameter) -> float:
    smaller, larger = sorted((row.reseau.sigma, row.opencv.sigma))
    return larger / smaller if smaller > 0 else np.inf


def _same_model_agrees(solutions: _Solutions) -> bool:
    """Whether the adjustment with OpenCV's own distortion gives OpenCV's solution."""
    problem = solutions.problem
    if problem.network.cameras[0].distortion.family in ("opencv", FISHEYE):
        return False
    fx, fy, x0, y0, *distortion = solutions.conversion.parameters.tolist()
    values = {"c": fy, "x0": x0, "y0": y0, "b1": fx / fy - 1, "b2": 0.0}
    values |= dict(zip(NAMES[4:], distortion, strict=True))
    free = {"c", "x0", "y0", *problem.freedom.distortion}.difference(problem.freedom.held_interior)
    camera = _free_camera(problem.network.cameras[0], Distortion("opencv"), values, free)
    approximations = replace(problem.approximations, interior={camera.name: np.array([fy, x0, y0])})
    same = replace(problem, network=replace(problem.network, cameras=(camera,)), approximations=approximations)
    solved = adjust(same.network, same.approximations)
    if not solved.converged:
        return False
    rows = _rows(NAMES, same.freedom, convert_solution(same, solved), solved.sigma0, solutions.opencv)
    return all(r.difference_sigmas < SAME_MODEL_DIFFERENCE and _sigma_ratio(r) < SAME_MODEL_SIGMA_RATIO for r in rows)


def _judge_departure(reason: str, adjustment: Adjustment, solutions: _Solutions) -> tuple[stage_files.Verdict, str]:
    """Verdict from the agreement on the bare problem and the departures of the full adjustment from it."""
    solved, camera = solutions.solved, solutions.camera
    departures = {  # in standard deviations of the bare problem
        each.quantity: abs(adjustment.value(each) - solved.value(each)) / solved.sigma(each)
        for each in (Parameter.interior(camera.name, name) for name in sorted(free_parameters(camera)))
        if solved.sigma(each) > 0 and not (solutions.inseparable and each.quantity in OPENCV_RADIAL)
    }
    farthest = max(departures, key=lambda name: departures[name])
    sigmas = departures[farthest]
    alone = f"On the observations alone, {reason[0].lower()}{reason[1:]}"
    if sigmas > LARGEST_DEPARTURE:
        return "differs", f"Priors or weights move {farthest} by {sigmas:.1f} sigma, against the observations. {alone}"
    if sigmas > NOTABLE_DEPARTURE:
        moved = f"Priors and weights, which OpenCV does not know, move {farthest} by {sigmas:.2f} sigma."
        return "agrees", f"{alone} {moved}"
    return "agrees", reason


def _notes(solutions: _Solutions) -> str:
    """Notes on the simplifications of the bare problem."""
    problem, opencv = solutions.problem, solutions.opencv
    notes = [
        "This checks the adjustment and not the marks: OpenCV is given the same observations. Both take film "
        "transformations and object points as known, so these sigmas hold for that case"
    ]
    if not solutions.has_residuals:
        notes.append(
            "the observations leave no more than OpenCV's rounding, so these sigmas are those assumed beforehand"
        )
    if problem.uncertain_points:
        notes.append(
            f"{problem.uncertain_points} points have standard deviations and enter at their adjusted coordinates"
        )
    if problem.sigma_spread > NOTABLE_SPREAD:
        notes.append(
            "all observations have one weight here, though their standard deviations differ up to "
            f"{problem.sigma_spread:.1f}-fold"
        )
    if problem.gross:
        notes.append(f"{problem.gross} observations that robust estimation set aside are left out")
    if problem.left_out:
        notes.append(f"left out, for too few points: {', '.join(problem.left_out)}")
    if opencv.rounding_um > NOTABLE_ROUNDING * 1e3 * problem.sigma_mm:
        notes.append(f"OpenCV's single precision rounds by {opencv.rounding_um:.3f} µm")
    return "; ".join(notes) + "."


def bare_problem(adjustment: Adjustment, camera_name: str) -> BareProblem:
    """Bare problem of one camera with all images for which OpenCV can find initial values, at the adjusted values."""
    network = adjustment.network
    camera = network.camera_by_name[camera_name]
    names = [image.name for image in network.images if image.camera == camera_name]
    shown = {name: _image_points(adjustment, name) for name in names}
    usable = [name for name in names if can_begin(shown[name][0].xyz)]
    sigmas = np.concatenate([shown[name][1] for name in usable]) if usable else np.ones(1)
    sigma_mm = float(np.sqrt((sigmas**2).mean()))
    points = sorted({point for name in usable for point in shown[name][2]})
    places = adjusted_places(adjustment, points)
    free = free_parameters(camera)
    counterparts = {"c": "fx", "x0": "cx", "y0": "cy", **COUNTERPARTS[camera.distortion.family]}
    values = {
        name: adjustment.value(Parameter.interior(camera_name, name))
        for name in ("c", "x0", "y0", *parameter_names(camera.distortion.family))
    }
    return BareProblem(
        network=Network(
            cameras=(_free_camera(camera, camera.distortion, values, free),),
            images=tuple(Image(name, camera_name, "none") for name in usable),
            points=tuple(
                ObjectPoint(point, *(Prior(value, 0.0) for value in xyz))
                for point, xyz in zip(points, places.tolist(), strict=True)
            ),
            observations=_observations({name: shown[name] for name in usable}, sigma_mm),
        ),
        approximations=Approximations(
            interior={camera_name: np.array([values["c"], values["x0"], values["y0"]])},
            exterior={
                name: adjustment.values_of(Parameter.exterior(frame, each) for each in EXTERIOR_NAMES)
                for name in usable
                for frame in [adjustment.network.image_by_name[name].frame]
            },
            transformation={name: np.zeros(0) for name in usable},
            points=dict(zip(points, places, strict=True)),
        ),
        images=tuple(shown[name][0] for name in usable),
        freedom=Freedom(tuple(counterpart for name, counterpart in counterparts.items() if name in free)),
        sigma_mm=sigma_mm,
        sigma_spread=float(sigmas.max() / sigmas.min()),
        gross=sum(
            network.observations.image[row] in shown and not network.observations.is_fiducial[row]
            for row in np.flatnonzero(adjustment.weights < GROSS_WEIGHT)
        ),
        uncertain_points=sum(
            any(prior is None or prior.sigma != 0 for prior in network.point_by_id[point].priors) for point in points
        ),
        left_out=tuple(name for name in names if name not in usable),
    )


def free_parameters(camera: Camera) -> set[str]:
    """c, x0, y0 and the distortion parameters that are estimated in the bare problem, with or without priors."""
    given = camera.distortion.parameters
    counterparts = COUNTERPARTS[camera.distortion.family]
    free = {name for name in counterparts if name in given and given[name].sigma > 0}
    for together in FREE_TOGETHER:
        own = {name for name, counterpart in counterparts.items() if counterpart in together}
        if free & own:
            free |= own
    interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
    free |= {name for name, prior in interior.items() if prior is None or prior.sigma > 0}
    return free | ({"b1"} if camera.distortion.family == FISHEYE and "c" in free else set())


def _free_camera(camera: Camera, distortion: Distortion, values: Mapping[str, float], free: set[str]) -> Camera:
    """Camera of a distortion model without fiducials and priors. free: parameters that are estimated."""
    priors = {name: Prior(value, np.inf if name in free else 0.0) for name, value in values.items()}
    parameters = {name: priors[name] for name in parameter_names(distortion.family)}
    return replace(
        camera,
        principal_distance_mm=priors["c"],
        x0_mm=priors["x0"],
        y0_mm=priors["y0"],
        distortion=replace(distortion, parameters=parameters),
        fiducials={},
    )


def _image_points(adjustment: Adjustment, image: str) -> tuple[OpenCVPoints, Array, list[str]]:
    """Observations of an image in the camera frame, their standard deviations (n,), and the names of the points."""
    network, observations = adjustment.network, adjustment.network.observations
    weights = adjustment.weights if len(adjustment.weights) else np.ones(len(observations))
    is_own = network.image_numbers == network.images.index(network.image_by_name[image])
    rows = np.flatnonzero(is_own & ~observations.is_fiducial & (weights >= GROSS_WEIGHT))
    points = [observations.point[row] for row in rows]
    model = adjusted_image(adjustment, image)
    xyz = adjusted_places(adjustment, points)
    gradient = model.camera_by_comparator(observations.xy_mm[rows])
    covariance = gradient @ observations.covariance_mm2[rows] @ gradient.swapaxes(1, 2)
    sigmas = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return OpenCVPoints(image, xyz, model.camera_from_comparator(observations.xy_mm[rows])), sigmas, points


def _observations(shown: Mapping[str, tuple[OpenCVPoints, Array, list[str]]], sigma_mm: float) -> Observations:
    rows = [(name, point) for name, (_, _, points) in shown.items() for point in points]
    kinds: list[ObservationKind] = ["target"] * len(rows)
    coordinates = [image.xy_mm for image, _, _ in shown.values()]
    return Observations(
        tuple(image for image, _ in rows),
        tuple(point for _, point in rows),
        tuple(kinds),
        np.concatenate([*coordinates, np.zeros((0, 2))]),
        np.tile(sigma_mm**2 * np.eye(2), (len(rows), 1, 1)),
    )


def convert_solution(problem: BareProblem, solved: Adjustment) -> ConvertedSolution:
    """Convert a solution to OpenCV's model. Raises AdjustmentError where the fit fails."""
    camera = problem.network.cameras[0]
    family = camera.distortion.family
    lens = adjusted_lens(solved, camera.name)
    own = [Parameter.interior(camera.name, each) for each in lens.quantities]
    if family == FISHEYE or (family == "opencv" and lens.parameters[-1] == 0.0):  # without shear: OpenCV's own model
        parameters, by_lens = opencv_values(lens)
        variances = np.diag(by_lens @ solved.cofactor_of(own) @ by_lens.T)
        return ConvertedSolution(parameters, np.sqrt(np.maximum(variances, 0.0)), 0.0)
    observed = problem.network.observations.xy_mm
    corners_mm = np.array([observed.min(axis=0), observed.max(axis=0)])
    if family == "opencv":  # all but the shear b2, which cv2.calibrateCamera does not model
        begun = dict(zip(lens.quantities[3:], lens.parameters.tolist(), strict=True)) | {"b2": 0.0}
        whole = convert_lens(lens, fixed_distortion(begun), corners_mm, ("b1",))
    else:
        affinity = ["b1"] if "fy" in COUNTERPARTS[family].values() else []
        whole = convert_lens(lens, Distortion("opencv"), corners_mm, ("k1", "k2", "p1", "p2", "k3", *affinity))
    # OpenCV holds the parameters that it does not estimate at these values. Its standard deviations assume them.
    model = fixed_distortion(dict(zip(whole.lens.quantities[3:], whole.lens.parameters.tolist(), strict=True)))
    known = replace(lens, covariance=solved.cofactor_of(own))
    free = convert_lens(known, model, corners_mm, problem.freedom.distortion, held=problem.freedom.held_interior)
    parameters, _ = opencv_values(whole.lens)
    _, by_lens = opencv_values(free.lens)
    covariance = by_lens @ free.lens.covariance @ by_lens.T
    return ConvertedSolution(parameters, np.sqrt(np.maximum(np.diag(covariance), 0.0)), whole.rms_mm)
