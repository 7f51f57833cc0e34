"""Check of the adjustment against OpenCV: the same observations in its calibration of cameras or fisheyes, in sigmas.

OpenCV has neither film transformations, nor priors, nor weights, nor uncertain object points. The comparison therefore
uses a bare problem that both programs can solve: the observations in the camera frame by the adjusted transformations,
the object points at their adjusted coordinates, equal weights, no priors. The adjustment solves this problem again. Its
solution is converted to OpenCV's model by a fit over the image. The change from the full adjustment to the bare problem
is reported, too.

Of a board also the corners that OpenCV's functions find are calibrated, beside the measured ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import chdtri

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion
from adjust.problem.camera import Camera
from adjust.problem.parameter import Parameter, description, enumeration
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from measure.boards.markers import charuco_board
from measure.boards.specs import ArucoSpec, BoardSpec, CharucoSpec, ChessboardSpec, CircleGridSpec, aruco_dictionary
from measure.errors import MeasurementError
from measure.scans.scan import Scan
from pipeline.adjusting.picture_turn import turned_back
from pipeline.opencv_check.bare_problem import (
    COUNTERPARTS,
    BareProblem,
    ConvertedSolution,
    bare_problem,
    convert_solution,
    free_camera,
    free_parameters,
)
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
    model_names,
)
from pipeline.results import stage_files
from pipeline.results.adjustment_record import Quantity
from pipeline.results.comparator_file import comparator_from_pixel
from pipeline.types import Array

Bytes = NDArray[np.uint8]
Calibrate = Callable[[Sequence[OpenCVPoints]], OpenCvCalibration]

HALF_WINDOW_PX = 11  # of cornerSubPix, as in OpenCV's calibration sample
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.0001)  # of the same sample
FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK | cv2.CALIB_CB_NORMALIZE_IMAGE  # of the same sample
NEAREST = 0.4  # of the distance to the next point: largest distance between corresponding points
FEWEST_PICTURES = 3  # with points of both, for a calibration of each
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
SIGNIFICANCE_LEVEL = 0.05  # of a difference of v'Pv between two solutions in a flat valley
NOTABLE_ROUNDING = 0.01  # fraction of the standard deviation of an image coordinate


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
    inseparable: list[str]  # radial terms that the observations do not separate

    @property
    def camera(self) -> Camera:
        return self.problem.network.cameras[0]

    @property
    def has_residuals(self) -> bool:
        """Whether the residuals are larger than OpenCV's rounding, so that they tell the standard deviations."""
        return _rms_um(self.solved) > ROUNDINGS * self.opencv.rounding_um

    @property
    def gain(self) -> float:
        """By how much v'Pv is smaller in OpenCV's solution, in the variance of a coordinate."""
        points = sum(len(image.xyz) for image in self.problem.images)
        squares_um2 = points * (_rms_um(self.solved) ** 2 - self.opencv.rms_um**2)
        return squares_um2 / (1e3 * self.problem.sigma_mm * self.solved.sigma0) ** 2

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
    inseparable = solved.inseparable(name) or adjustment.inseparable(name)
    solutions = _Solutions(problem, solved, conversion, opencv, inseparable)
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
    return verdict, f"{reason} {_notes(solutions, is_digital)}"


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
    if verdict == "differs" and solutions.inseparable:
        critical = float(chdtri(len(solutions.inseparable), SIGNIFICANCE_LEVEL))
        if abs(solutions.gain) < critical:
            verdict = "agrees"
            reason = (
                f"OpenCV ends elsewhere in the flat valley of these terms, no better: v'Pv differs by "
                f"{abs(solutions.gain):.1f}, critical value {critical:.1f}. {reason.partition(';')[0]}."
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
    camera = free_camera(problem.network.cameras[0], Distortion("opencv"), values, free)
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


def _notes(solutions: _Solutions, is_digital: bool) -> str:
    """Notes on the simplifications of the bare problem."""
    problem, opencv = solutions.problem, solutions.opencv
    notes = [
        "This checks the adjustment and not the marks: OpenCV is given the same observations. Both take "
        f"{'' if is_digital else 'film transformations and '}object points as known, so these sigmas hold for that case"
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
