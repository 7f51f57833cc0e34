"""A made-up calibration of five aerial frames, and its files: result file and report are tested on its numbers."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
from networks import ObservedRow, given_interior, given_marks, make_observations
from numpy.typing import NDArray
from projects import present

from adjust import Adjustment, Camera, Distortion, Exterior, Image, Network, ObjectPoint, Parameter, Prior
from adjust.least_squares.iteration import Iteration
from adjust.problem.estimates import NullDirection, VarianceFactor
from adjust.problem.network import EXTERIOR_NAMES
from adjust.quality.critical_values import Probabilities
from adjust.quality.run import Group, Residuals
from measure.flags import Cause, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from pipeline import read_adjustment, write_adjustment
from pipeline.report import ReportData, Thumbnail
from pipeline.results.adjustment_file import read_covariance
from pipeline.results.adjustment_record import FilmRecord, Quantity
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.stage_files import CameraCheck, Check, ComparedParameter

Array = NDArray[np.float64]

PITCH_UM = 20.0

CAMERA = "RC 20"
FRAMES = tuple(f"f{i}" for i in range(1, 6))
MARKS = (
    (106.0, -106.0),
    (-106.0, -106.0),
    (-106.0, 106.0),
    (106.0, 106.0),
    (0.0, -110.0),
    (-110.0, 0.0),
    (0.0, 110.0),
    (110.0, 0.0),
)
INTERIOR = {"c": (153.664, 0.0041), "x0": (0.012, 0.0035), "y0": (-0.008, 0.0036)}
LENS = {
    "k3": (1.7427e-7, 3.1e-9),
    "k5": (-5.4e-12, 2.2e-13),
    "k7": (0.0, 0.0),
    "p1": (7.9e-7, 9e-8),
    "p2": (-0.6e-7, 9e-8),
    "p3": (0.0, 0.0),
    "p4": (0.0, 0.0),
}
CHECKED = (("fx", "px", 7683.2, 0.21), ("cx", "px", 5701.3, 0.19), ("k1", "", -4.11e-3, 7.3e-5))
POINTS = 24
SIGMA_MM = 0.004


@dataclass(frozen=True)
class DenseCofactor:
    """A cofactor matrix that is there as a whole."""

    matrix: Array

    @property
    def variances(self) -> Array:
        return np.diag(self.matrix)

    def part(self, at: NDArray[np.intp]) -> Array:
        return self.matrix[np.ix_(at, at)]

    def parts(self, groups: NDArray[np.intp]) -> Array:
        return self.matrix[groups[:, :, None], groups[:, None, :]]


@dataclass(frozen=True, repr=False)
class MadeUpAdjustment(Adjustment):
    """Without a run: what it says of its observations is there beforehand, by the property's name."""

    known: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nothing = dict.fromkeys(("further", "contradictions", "suspects", "explanations", "warnings", "notes"), ())
        self.__dict__.update(
            {**nothing, "reliability": None, "variance_sigmas": {}, "loose_cameras": set(), **self.known}
        )


@cache
def adjustment() -> MadeUpAdjustment:
    """Converged, sigma0 within its bounds, no observation suspect; f2 is mirrored, its film sheared."""
    rng = np.random.default_rng(7)
    ids, targets_mm = tuple(str(i + 1) for i in range(POINTS)), rng.uniform(-100.0, 100.0, (POINTS, 2))
    parameters, values, sigmas = _unknowns(ids, rng)
    network = _network(ids, targets_mm, rng)
    count = len(network.observations)
    redundancy = rng.uniform(0.4, 0.9, (count, 2))
    w = np.clip(rng.standard_normal((count, 2)), -3.0, 3.0)
    v = w * SIGMA_MM * np.sqrt(redundancy)
    correlation = np.eye(len(parameters))
    c, k3 = (parameters.index(Parameter.interior(CAMERA, name)) for name in ("c", "k3"))
    correlation[c, k3] = correlation[k3, c] = -0.95
    return MadeUpAdjustment(
        run=cast(Any, None),
        scaled=cast(Any, None),
        probabilities=Probabilities(),
        mirrored=frozenset(),
        network=network,
        termination="converged",
        iterations=6,
        conditions=340,
        unknowns=83,
        redundancy=257,
        vpv=262.1,
        variance=VarianceFactor(math.sqrt(262.1 / 257), 257),
        parameters=parameters,
        values=values,
        cofactor=DenseCofactor(correlation * np.outer(sigmas, sigmas)),
        known={
            "residuals": Residuals(v, redundancy, w),
            "groups": {
                "target": Group(1.02, 3.1, 3.2, 190.0),
                "fiducial": Group(0.97, 2.2, 2.1, 67.0),
                "control": Group(0.0, 0.0, 0.0, 0.0),
            },
        },
        singular=(),
        history=(
            Iteration(4.1e6, 5e4, 1e-3, 2),
            *(Iteration(*pair, 0.0, 1) for pair in ((2113.0, 310.0), (262.2, 0.8), (262.1, 1e-4), (262.1, 2e-8))),
            Iteration(262.1, 1e-9, 0.0, 1),
        ),
    )


def _unknowns(points: tuple[str, ...], rng: np.random.Generator) -> tuple[tuple[Parameter, ...], Array, Array]:
    """Keys, values and a-priori sigmas of all quantities; points are fixed."""
    quantities: dict[Parameter, tuple[float, float]] = {}
    quantities |= {Parameter.interior(CAMERA, name): pair for name, pair in (INTERIOR | LENS).items()}
    for i, (x, y) in enumerate(MARKS, 1):
        for axis, given in (("x", x), ("y", y)):
            quantities[Parameter.fiducial(CAMERA, str(i), axis)] = (given + 0.01 * rng.standard_normal(), 0.0021)
    for image in FRAMES:
        affine = (0.1, -1.0, 0.02, 0.2, 0.02, 1.0) if image == "f2" else (0.1, 1.0, 0.02, 0.2, -0.02, 1.0)
        station = (*rng.uniform(-500.0, 500.0, 2), 1500.0, *rng.uniform(-0.1, 0.1, 3))
        for name, value in zip(("a1", "a2", "a3", "b1", "b2", "b3"), affine, strict=True):
            quantities[Parameter.film(image, name)] = (value, 1e-4)
        for name, value, sigma in zip(EXTERIOR_NAMES, station, [0.05] * 3 + [3e-5] * 3, strict=True):
            quantities[Parameter.exterior(image, name)] = (float(value), sigma)
    for point in points:
        quantities |= {Parameter.point(point, axis): (float(rng.uniform(-900.0, 900.0)), 0.0) for axis in "XYZ"}
    values, sigmas = np.array(list(quantities.values())).T
    return tuple(quantities), values, sigmas


def _network(points: tuple[str, ...], targets_mm: Array, rng: np.random.Generator) -> Network:
    fiducials = {str(i): np.array(xy) for i, xy in enumerate(MARKS, 1)}
    camera = Camera(
        CAMERA,
        *given_interior((153.6, 0.0, 0.0)),
        Distortion("torlegard", {name: Prior(0.0, np.inf) for name in ("k3", "k5", "p1", "p2")}),
        given_marks(fiducials, 1.0),
    )
    rows: list[ObservedRow] = []
    for image in FRAMES:
        turn = -1.0 if image == "f2" else 1.0
        rows += [(image, id, "fiducial", xy * (turn, 1.0), SIGMA_MM) for id, xy in fiducials.items()]
        targets = zip(points, targets_mm, strict=True)
        rows += [(image, point, "target", xy * (turn, 1.0), SIGMA_MM) for point, xy in targets]
    observations = make_observations(rows)
    noise = 0.004 * rng.standard_normal((len(rows), 2))
    observations = replace(observations, xy_mm=observations.xy_mm + noise)
    exterior = Exterior(np.array([0.0, 0.0, 1500.0, 0.0, 0.0, 0.0]), np.array([np.inf] * 3 + [0.5] * 3))
    return Network(
        (camera,),
        tuple(Image(image, CAMERA, "affine", exterior if image == "f1" else None) for image in FRAMES),
        tuple(ObjectPoint(point, Prior(0.0), Prior(0.0), Prior(0.0)) for point in points),
        observations,
    )


def set_adjustment(data: ReportData, **values: Any) -> ReportData:
    """With other values in the adjustment's record."""
    return replace(data, adjustment=replace(present(data.adjustment), **values))


def set_frames(data: ReportData, change: Callable[[FrameMeasurement], FrameMeasurement]) -> ReportData:
    """With every scan's frame changed."""
    scans = {name: replace(scan, frame=change(scan.frame)) for name, scan in present(data.measurement).items()}
    return replace(data, measurement=scans)


def set_mark(data: ReportData, row: int, status: Status, reason: str) -> ReportData:
    """With another status of one mark of comparator.csv."""
    rows = list(data.comparator)
    rows[row] = replace(rows[row], status=status, reason=reason)
    return replace(data, comparator=rows)


def set_weak(data: ReportData, image: str, points: Sequence[str], reason: Reason) -> ReportData:
    """With weak fiducials in an image's record."""

    def change(frame: FrameMeasurement) -> FrameMeasurement:
        marks = tuple(
            replace(mark, status=Status.WEAK, reason=reason)
            if frame.image == image and mark.kind == "fiducial" and mark.point in points
            else mark
            for mark in frame.marks
        )
        return replace(frame, marks=marks)

    return set_frames(data, change)


@cache
def singular_adjustment() -> Adjustment:
    """The same without a solution."""
    null = NullDirection(
        (Parameter.interior(CAMERA, "c"), Parameter.exterior("f1", "Z0")),
        "c and the flying height move together over flat ground.",
        "Fix c.",
    )
    count = len(adjustment().parameters)
    return replace(
        adjustment(), termination="singular", singular=(null,), cofactor=DenseCofactor(np.full((count, count), np.nan))
    )


@cache
def measured_report() -> ReportData:
    """Scans measured, nothing adjusted: every mark found, every pose decided."""
    observations = adjustment().network.observations
    pixels = observations.xy_mm * (1e3 / PITCH_UM, -1e3 / PITCH_UM) + 6000.0
    marks: dict[str, list[MarkMeasurement]] = {}
    rows = []
    known = Covariance({Cause.NOISE: np.diag([0.0012, 0.0021]), Cause.TONE: np.diag([0.0004, 0.0004])})
    for i in range(len(observations)):
        image, point, kind = observations.image[i], observations.point[i], observations.kind[i]
        xy, sigma = observations.xy_mm[i], np.sqrt(np.diag(observations.covariance_mm2[i]))
        rows.append(ComparatorPoint(image, point, kind, xy, sigma, 0.0, Status.MEASURED, ""))
        mark = MarkMeasurement(point, kind, pixels[i], known, Status.MEASURED, quality={"snr": 31.0})
        marks.setdefault(image, []).append(mark)
    scans = {image: _scan(image, own) for image, own in marks.items()}
    return ReportData("Five frames", rows, scans, thumbnail=_crosses(marks), frame_mm={"RC 20": (228.0, 228.0)})


def _scan(image: str, marks: Sequence[MarkMeasurement]) -> MeasuredScan:
    pose = ScanOrientation("0", True, ("The dots beside the corner marks say so (41 to 3).",))
    place = np.array([[50.0, 0.0, 6000.0], [0.0, -50.0, 6000.0]])
    frame = FrameMeasurement(image, tuple(marks), pose, place)
    return MeasuredScan(f"scans/{image}.tif", 12000, 12000, (PITCH_UM, PITCH_UM), frame)


def _crosses(marks: Mapping[str, Sequence[MarkMeasurement]]) -> Callable[[str, str, str], Thumbnail]:
    """Pictures of a light cross about the measured centre, in noise."""
    centers = {(image, mark.point, str(mark.kind)): mark.center_px for image, own in marks.items() for mark in own}

    def cut(image: str, point: str, kind: str) -> Thumbnail:
        col, row = np.asarray(centers[image, point, kind]).tolist()
        corner = round(col) - 20, round(row) - 20
        x, y = np.arange(41) + corner[0] - col, np.arange(41) + corner[1] - row
        arms = np.maximum(np.exp(-(x**2) / 6.0)[None, :], np.exp(-(y**2) / 6.0)[:, None])
        noise = np.random.default_rng(round(col)).normal(0.0, 600.0, arms.shape)
        return Thumbnail(20000.0 + 15000.0 * arms + noise, (float(corner[0]), float(corner[1])))

    return cut


@cache
def adjusted_report() -> ReportData:
    """Measured, adjusted and in agreement with OpenCV."""
    return _replace(adjustment())


@cache
def singular() -> ReportData:
    return _replace(singular_adjustment())


def _replace(result: Adjustment) -> ReportData:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "adjustment.json"
        write_adjustment(result, path)
        stored, known = read_adjustment(path), read_covariance(path)
    rows = tuple(
        ComparedParameter.from_numbers(name, unit, Quantity(value, sigma), Quantity(value + 0.1 * sigma, sigma))
        for name, unit, value, sigma in CHECKED
    )
    camera = CameraCheck("agrees", "All parameters agree within 0.1 sigma.", 5, 120, 4.61, 4.60, 0.012, rows)
    return replace(measured_report(), adjustment=stored, covariance=known, check=Check.from_cameras({CAMERA: camera}))


def _only(data: ReportData, kind: str, **values: Any) -> ReportData:
    """With the marks of one kind and other values in the adjustment's record."""
    residuals = tuple(row for row in present(data.adjustment).residuals if row.kind == kind)
    data = set_frames(data, lambda frame: replace(frame, marks=tuple(m for m in frame.marks if m.kind == kind)))
    rows = [row for row in data.comparator if row.kind == kind]
    return set_adjustment(replace(data, comparator=rows, check=None), residuals=residuals, **values)


@cache
def digital() -> ReportData:
    """The same by a digital camera: no film, no fiducials, pixels of PITCH_UM."""
    stored = present(adjusted_report().adjustment)
    cameras = {name: replace(camera, fiducials={}) for name, camera in stored.cameras.items()}
    images = {name: replace(image, transformation=FilmRecord(kind="none")) for name, image in stored.images.items()}
    groups = {name: group for name, group in stored.groups.items() if name != "fiducial"}
    data = _only(adjusted_report(), "target", cameras=cameras, images=images, groups=groups)
    data = set_frames(data, lambda frame: replace(frame, pose=None))
    return replace(data, pitch_um=dict.fromkeys(FRAMES, (PITCH_UM, PITCH_UM)))


@cache
def film_alone() -> ReportData:
    """The fiducials alone: no frame is oriented, and no camera calibrated."""
    cameras = {
        name: replace(
            camera, principal_distance_mm=replace(camera.principal_distance_mm, sigma=math.nan), lens_known=None
        )
        for name, camera in present(adjusted_report().adjustment).cameras.items()
    }
    return _only(adjusted_report(), "fiducial", cameras=cameras, reliability=None)
