"""The adjustment against OpenCV: the same observations through cv2.calibrateCameraExtended, compared in sigmas.

OpenCV knows neither film, nor priors, nor weights, nor uncertain object points. So the comparison is of one problem
that both programs can solve: the observations in the camera frame by the adjusted transformations, the object points
at their adjusted coordinates, all observations of one weight, no prior. The adjustment solves it anew, its solution is
converted to OpenCV's model by a refit over the image, and what the step from the full adjustment to this problem
changes is told too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.adjustment import adjust
from adjust.distortion import PARAMETERS
from adjust.errors import AdjustmentError
from adjust.network import Camera, Family
from adjust.result import Adjustment
from pipeline.bare_problem import COUNTERPARTS, BareProblem, bare_problem, free_parameters
from pipeline.opencv_calibration import OpenCvCalibration, calibrate
from pipeline.opencv_model import NAMES, Freedom, Refit, image_grid, refit, refit_jacobian

Array = NDArray[np.float64]
Verdict = Literal["agrees", "differs", "not possible"]

LARGEST_DIFFERENCE = (
    1.0  # sigmas; two correct programs differ by about a tenth, for their models are not quite the same
)
LARGEST_SIGMA_RATIO = 1.2  # standard deviations; 0.6 to 3 % is usual
LARGEST_DEPARTURE = 3.0  # sigmas that priors, weights and the like may move a parameter by before it is a difference
NOTABLE_DEPARTURE = 0.1
LARGEST_REFIT = 0.5  # of the standard deviation of an image coordinate: beyond it OpenCV's model cannot take the lens
STEP_SIGMAS = 0.3  # for derivatives of the refit
UNDETERMINED = 0.05  # relative sigma of the principal distance above which there is nothing to compare
WORSE_RMS = 1.02
ROUNDINGS = 20.0  # rms below which a solution consists of OpenCV's rounding, in that of one coordinate
NOTABLE_SPREAD = 1.5
NOTABLE_ROUNDING = 0.01  # of the standard deviation of an image coordinate
TINY = 1e-300


@dataclass(frozen=True)
class Row:
    """One parameter of OpenCV's model by both programs: values and a-posteriori standard deviations."""

    name: str
    unit: str
    value: float
    sigma: float
    opencv_value: float
    opencv_sigma: float

    @property
    def difference_sigmas(self) -> float:
        return abs(self.value - self.opencv_value) / self.sigma if self.sigma > 0 else 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "unit": self.unit,
            "reseau": {"value": self.value, "sigma": self.sigma},
            "opencv": {"value": self.opencv_value, "sigma": self.opencv_sigma},
            "difference_sigmas": self.difference_sigmas,
        }


@dataclass(frozen=True)
class CameraCheck:
    """The comparison of one camera. rms in um a point (not an axis); the refit's residual in um, rms over the image."""

    verdict: Verdict
    reason: str
    images: int = 0
    points: int = 0
    rms_opencv_um: float | None = None
    rms_reseau_um: float | None = None
    refit_residual_um: float | None = None
    rows: tuple[Row, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "rows": [row.to_json() for row in self.rows]}


@dataclass(frozen=True)
class Check:
    """The comparison of every camera, and the verdict on the whole."""

    cameras: Mapping[str, CameraCheck] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        verdicts = {check.verdict for check in self.cameras.values()}
        if "differs" in verdicts:
            return "differs"
        return "agrees" if verdicts == {"agrees"} else "not possible"

    @property
    def reason(self) -> str:
        decisive = {name: check for name, check in self.cameras.items() if check.verdict == self.verdict}
        if len(self.cameras) == 1:
            return next(iter(decisive.values())).reason
        return " ".join(f"Camera {name}: {check.reason}" for name, check in decisive.items())

    def to_json(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "cameras": {name: check.to_json() for name, check in self.cameras.items()},
        }


def check_against_opencv(adjustment: Adjustment) -> Check:
    """Compare every camera of an adjustment with OpenCV's calibration of the same observations.

    "agrees": no parameter differs by more than one sigma; "differs": one does, or priors and weights moved one by more
    than three; "not possible": OpenCV, or anyone without priors, cannot solve it, and the reason says why.
    """
    names = [camera.name for camera in adjustment.network.cameras]
    return Check({name: _check_camera(adjustment, name) for name in names})


def _check_camera(adjustment: Adjustment, name: str) -> CameraCheck:
    if not adjustment.converged:
        return CameraCheck("not possible", f"The adjustment itself has no solution: {_without_stop(adjustment)}.")
    camera = adjustment.network.camera_by_name[name]
    hindrance = _hindrance(camera)
    if hindrance:
        return CameraCheck("not possible", hindrance)
    problem = bare_problem(adjustment, name)
    if not problem.images:
        return CameraCheck("not possible", "No image shows enough points for OpenCV: 4 in a plane, 6 otherwise.")
    counts = (len(problem.images), sum(len(image.xyz) for image in problem.images))
    try:
        solved = adjust(problem.network, problem.approximations)
    except AdjustmentError as error:
        return CameraCheck("not possible", f"Without priors this camera cannot be adjusted: {error}", *counts)
    undetermined = _undetermined(solved, name)
    if undetermined:
        return CameraCheck("not possible", undetermined, *counts)
    return _compared(adjustment, problem, solved, counts)


def _hindrance(camera: Camera) -> str:
    """Why OpenCV has no model for this camera; empty where it has."""
    if camera.distortion.family not in COUNTERPARTS:
        return f"OpenCV has no counterpart of the distortion family {camera.distortion.family}."
    free = free_parameters(camera)
    if ("x0" in free) != ("y0" in free):
        return "OpenCV holds both coordinates of the principal point or neither; here one is fixed."
    if "b1" in free and "c" not in free:
        return "OpenCV holds both focal lengths or neither; here the principal distance is fixed and b1 is not."
    if not free:
        return "Everything of this camera is fixed: there is nothing to compare."
    return ""


def _undetermined(solved: Adjustment, name: str) -> str:
    """Why the observations without priors give no camera; empty where they do."""
    if solved.singular:
        causes = " ".join(f"{', '.join(direction.parameters)}: {direction.cause}" for direction in solved.singular)
        return f"Priors carried the solution; the observations of the points alone do not determine it. {causes}"
    if not solved.converged:
        return f"Without priors the adjustment finds no solution: {_without_stop(solved)}."
    c, sigma = solved.value(f"IO.{name}.c"), solved.sigma(f"IO.{name}.c")
    if sigma > UNDETERMINED * c:
        return (
            f"Priors carried the solution: from the observations of the points alone the principal distance has a "
            f"standard deviation of {sigma:.3g} mm, {sigma / c:.0%} of its value."
        )
    return ""


def _without_stop(adjustment: Adjustment) -> str:
    causes = [direction.cause for direction in adjustment.singular] or [adjustment.termination]
    return " ".join(causes).rstrip(".")


def _compared(adjustment: Adjustment, problem: BareProblem, solved: Adjustment, counts: tuple[int, int]) -> CameraCheck:
    camera = problem.network.cameras[0]
    converted = _converted(problem, solved)
    rms_um = _rms_um(solved)
    known: dict[str, Any] = {
        "images": counts[0],
        "points": counts[1],
        "rms_reseau_um": rms_um,
        "refit_residual_um": 1e3 * converted.refit.residual_mm,
    }
    if converted.refit.residual_mm > LARGEST_REFIT * problem.sigma_mm:
        reason = (
            f"OpenCV's model cannot take this lens: the nearest one is off by {1e3 * converted.refit.residual_mm:.2f} "
            f"um, rms over the image, where a coordinate's standard deviation is {1e3 * problem.sigma_mm:.2f} um."
        )
        return CameraCheck("not possible", reason, **known)
    try:
        opencv = calibrate(problem.images, problem.freedom, converted.refit.parameters)
    except cv2.error as error:
        return CameraCheck("not possible", f"OpenCV refuses these observations: {error.err}.", **known)
    sigmas_tell = rms_um > ROUNDINGS * opencv.rounding_um
    sigma0 = solved.sigma0 if sigmas_tell else 1.0
    known |= {"rms_opencv_um": opencv.rms_um, "rows": _rows(problem.freedom, converted, sigma0, opencv)}
    if opencv.rms_um > WORSE_RMS * rms_um + ROUNDINGS * opencv.rounding_um:
        reason = (
            f"OpenCV ends in a worse solution, {opencv.rms_um:.2f} um a point against {rms_um:.2f} um: it begins every "
            "image by itself and did not come to the minimum."
        )
        return CameraCheck("not possible", reason, **known)
    verdict, reason = _verdict(known["rows"], _departures(adjustment, solved, camera), sigmas_tell)
    notes = _notes(problem, opencv, sigmas_tell)
    sentence = f"{reason} rms {opencv.rms_um:.2f} um a point in OpenCV, {rms_um:.2f} um here. {notes}"
    return CameraCheck(verdict, sentence, **known)


@dataclass(frozen=True)
class _Converted:
    """A solution in OpenCV's model: the refit and the a-priori standard deviations (16,)."""

    refit: Refit
    sigmas: Array


def _converted(problem: BareProblem, solved: Adjustment) -> _Converted:
    camera = problem.network.cameras[0]
    family = camera.distortion.family
    rows = [solved.index(f"IO.{camera.name}.{each}") for each in ("c", "x0", "y0", *PARAMETERS[family])]
    values = solved.values[rows]
    interior, parameters = values[:3], values[3:]
    observed = problem.network.observations.xy_mm
    grid = image_grid(np.array([observed.min(axis=0), observed.max(axis=0)]))
    whole = refit(camera.distortion, interior, parameters, grid, _whole(family), _start(family, interior, parameters))
    steps = [STEP_SIGMAS * float(np.sqrt(solved.cofactor[row, row])) for row in rows]
    jacobian = refit_jacobian(camera.distortion, interior, parameters, steps, grid, problem.freedom, whole.parameters)
    variances = np.einsum("ij,jk,ik->i", jacobian, solved.cofactor[np.ix_(rows, rows)], jacobian)
    return _Converted(whole, np.sqrt(np.maximum(variances, 0.0)))


def _whole(family: Family) -> Freedom:
    """All parameters that a family can need in OpenCV's model: what is not estimated is held at the refit's values."""
    fixed_ratio = ("fx", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return Freedom({"opencv": ("fx", "fy", "cx", "cy"), "brown": ("fy", *fixed_ratio)}.get(family, fixed_ratio))


def _start(family: Family, interior: Array, parameters: Array) -> Array:
    start = np.zeros(len(NAMES))
    start[:4] = interior[0], interior[0], interior[1], interior[2]
    if family == "opencv":
        given = dict(zip(PARAMETERS[family], parameters, strict=True))
        start[0] *= 1 + given["b1"]
        start[4:] = [given[name] for name in NAMES[4:]]
    return start


def _rms_um(solved: Adjustment) -> float:
    """Per point: the root of the mean squared length of the residuals."""
    return 1e3 * float(np.sqrt((solved.residuals.v_mm**2).sum(axis=1).mean()))


def _rows(freedom: Freedom, converted: _Converted, sigma0: float, opencv: OpenCvCalibration) -> tuple[Row, ...]:
    return tuple(
        Row(
            name,
            "mm" if name in NAMES[:4] else "1",
            *(float(each[NAMES.index(name)]) for each in (converted.refit.parameters, sigma0 * converted.sigmas)),
            *(float(each[NAMES.index(name)]) for each in (opencv.parameters, opencv.sigmas)),
        )
        for name in NAMES
        if name in freedom.names
    )


def _departures(adjustment: Adjustment, solved: Adjustment, camera: Camera) -> dict[str, float]:
    """How far, in the sigmas of the bare problem, the adjustment's own values lie from the bare problem's."""
    names = {name: f"IO.{camera.name}.{name}" for name in sorted(free_parameters(camera))}
    return {
        name: abs(adjustment.value(full) - solved.value(full)) / solved.sigma(full)
        for name, full in names.items()
        if solved.sigma(full) > 0
    }


def _verdict(rows: Sequence[Row], departures: Mapping[str, float], sigmas_tell: bool) -> tuple[Verdict, str]:
    """sigmas_tell: whether the residuals, from which the sigmas come, are more than OpenCV's rounding."""
    worst = max(rows, key=lambda row: row.difference_sigmas)
    ratios = {row.name: max(row.sigma, row.opencv_sigma) / max(min(row.sigma, row.opencv_sigma), TINY) for row in rows}
    loosest = max(ratios, key=lambda name: ratios[name])
    farthest = max(departures, key=lambda name: departures[name])
    found = f"{worst.name} differs most from OpenCV's, by {worst.difference_sigmas:.2f} sigma"
    if worst.difference_sigmas > LARGEST_DIFFERENCE:
        return "differs", f"{found}; up to {LARGEST_DIFFERENCE:g} would be in order."
    if sigmas_tell and ratios[loosest] > LARGEST_SIGMA_RATIO:
        return "differs", f"The standard deviations of {loosest} differ by a factor of {ratios[loosest]:.2f}; {found}."
    if sigmas_tell and departures[farthest] > LARGEST_DEPARTURE:
        return "differs", (
            f"On the observations alone both programs agree ({found}), but priors or weights move {farthest} by "
            f"{departures[farthest]:.1f} sigma: they contradict the observations."
        )
    if sigmas_tell and departures[farthest] > NOTABLE_DEPARTURE:
        return "agrees", (
            f"On the observations alone both programs agree: {found}. Priors and weights, which OpenCV does not know, "
            f"move {farthest} by {departures[farthest]:.2f} sigma of that."
        )
    return "agrees", f"All {len(rows)} parameters agree: {found}."


def _notes(problem: BareProblem, opencv: OpenCvCalibration, sigmas_tell: bool) -> str:
    """What OpenCV was told that is not quite so."""
    notes = ["Both take film transformations and object points as known, so these sigmas hold for that case"]
    if not sigmas_tell:
        notes.append(
            "the observations leave no more than OpenCV's rounding, so these sigmas are those assumed beforehand"
        )
    if problem.uncertain_points:
        notes.append(
            f"{problem.uncertain_points} points are in truth uncertain and enter at their adjusted coordinates"
        )
    if problem.sigma_spread > NOTABLE_SPREAD:
        notes.append(
            "all observations have one weight here, though their standard deviations differ up to "
            f"{problem.sigma_spread:.1f}-fold"
        )
    if problem.left_out:
        notes.append(f"left out, for too few points: {', '.join(problem.left_out)}")
    if opencv.rounding_um > NOTABLE_ROUNDING * 1e3 * problem.sigma_mm:
        notes.append(f"OpenCV's single precision rounds by {opencv.rounding_um:.3f} um")
    return "; ".join(notes) + "."
