"""A calibrated digital camera in pixels, as JSON, as OpenCV's camera.yaml, as text."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from adjust.problem.parameter import Parameter
from adjust.quality.image_clusters import cluster_covariance, shared_positions
from adjust.solution.result import Adjustment
from pipeline.calibration.lens_choice import LensChoice
from pipeline.calibration.pictures import CameraPictures
from pipeline.results.check_file import CameraCheck
from pipeline.text.wording import counted, listed
from pipeline.types import Array

OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
HIGHLY_CORRELATED = 0.9


@dataclass(frozen=True)
class Intrinsic:
    """A value with the standard deviation of the model, and that of its scatter over the pictures (None with few)."""

    value: float
    sigma_model: float
    sigma_clusters: float | None

    @property
    def sigma(self) -> float:
        """The one to use: the larger."""
        return max(self.sigma_model, self.sigma_clusters or 0.0)

    def as_json(self) -> dict[str, float | None]:
        return {
            "value": self.value,
            "sigma": self.sigma,
            "sigma_model": self.sigma_model,
            "sigma_clusters": self.sigma_clusters,
        }


@dataclass(frozen=True, kw_only=True)
class CameraIntrinsics:
    """px from the centre of the top left pixel, x right, y down, as OpenCV's. values: fx, fy, cx, cy, then the
    distortion's. known_share: of the way to the corner, out to where the lens was observed."""

    pictures: CameraPictures
    family: str
    values: Mapping[str, Intrinsic]
    correlations: tuple[tuple[str, str, float], ...]
    left_out: Mapping[str, str]
    used: int
    rms_px: float
    sigma0: float
    corner_sigma_px: float
    unmodelled_sigma_px: float
    known_share: float | None
    lens: LensChoice | None
    pitch_um: float | None
    check: CameraCheck | None = field(repr=False)

    def as_json(self) -> dict[str, Any]:
        pixels = {name: each.as_json() for name, each in self.values.items()}
        shown = {f"{name}_px": pixels.pop(name) for name in ("fx", "fy", "cx", "cy")}
        return {
            "name": self.pictures.name,
            "image_size_px": [self.pictures.width_px, self.pictures.height_px],
            "images_used": self.used,
            "images_left_out": dict(self.left_out),
            **shown,
            "distortion": {"family": self.family, **pixels},
            "correlations": [{"of": [a, b], "value": value} for a, b, value in self.correlations],
            "rms_px": self.rms_px,
            "sigma0": self.sigma0,
            "corner_sigma_px": self.corner_sigma_px,
            "unmodelled_sigma_px": self.unmodelled_sigma_px,
            "known_share": self.known_share,
            "lens_choice": None
            if self.lens is None
            else {score.model: score.rms_mm and score.rms_mm / self._pixel_mm for score in self.lens.scores},
            "opencv": self._opencv(),
        }

    _pixel_mm: float = 1.0

    def _opencv(self) -> dict[str, Any]:
        """OpenCV's calibration of the same points."""
        if self.check is None:
            return {"verdict": "not possible"}
        shown: dict[str, Any] = {"verdict": self.check.verdict, "reason": self.check.reason}
        if self.check.corners_px is not None:
            same, own = self.check.corners_px.reseau, self.check.corners_px.opencv
            shown |= {f"{name}_px": getattr(same, name) for name in ("fx", "fy", "cx", "cy", "rms")}
            shown["own_corners"] = {f"{name}_px": getattr(own, name) for name in ("fx", "fy", "cx", "cy", "rms")}
        return shown


def camera_intrinsics(
    adjustment: Adjustment,
    pictures: CameraPictures,
    pixel_mm: float,
    left_out: Mapping[str, str],
    lens: LensChoice | None,
    check: CameraCheck | None,
    pitch_um: float | None,
) -> CameraIntrinsics:
    """The camera of some pictures in px, from the adjustment in mm.

    Parameters
    ----------
    pixel_mm : side of a pixel, as the adjustment took it
    pitch_um : the true one, None where nobody knows it
    """
    name, network = pictures.name, adjustment.network
    distortion = next(each.distortion for each in network.cameras if each.name == name)
    free = [quantity for quantity, prior in distortion.parameters.items() if prior.sigma > 0.0]
    quantities = ["c", "x0", "y0", *free]
    mm = {quantity: adjustment.value(Parameter.interior(name, quantity)) for quantity in quantities}
    stretch = 1.0 + mm.get("b1", 0.0)
    shown = {"fx": mm["c"] * stretch / pixel_mm, "fy": mm["c"] / pixel_mm, "cx": mm["x0"] / pixel_mm}
    shown |= {"cy": -mm["y0"] / pixel_mm, **{each: mm[each] for each in free if each != "b1"}}
    by_mm = np.zeros((len(shown), len(quantities)))
    for row, each in enumerate(shown):
        match each:
            case "fx":
                by_mm[row, quantities.index("c")] = stretch / pixel_mm
                if "b1" in quantities:
                    by_mm[row, quantities.index("b1")] = mm["c"] / pixel_mm
            case "fy":
                by_mm[row, quantities.index("c")] = 1.0 / pixel_mm
            case "cx":
                by_mm[row, quantities.index("x0")] = 1.0 / pixel_mm
            case "cy":
                by_mm[row, quantities.index("y0")] = -1.0 / pixel_mm
            case _:
                by_mm[row, quantities.index(each)] = 1.0
    keys = [Parameter.interior(name, quantity) for quantity in quantities]
    model = by_mm @ (adjustment.sigma0**2 * adjustment.cofactor_of(keys)) @ by_mm.T
    clusters = _cluster_covariance(adjustment, [adjustment.index(key) for key in keys])
    scatter = None if clusters is None else np.sqrt(np.diagonal(by_mm @ clusters @ by_mm.T))
    sigmas = np.sqrt(np.diagonal(model))
    values = {
        each: Intrinsic(value, float(sigmas[row]), None if scatter is None else float(scatter[row]))
        for row, (each, value) in enumerate(shown.items())
    }
    rows = np.isin(network.observations.image, pictures.images)
    covariance = network.observations.covariance_mm2[rows]
    unmodelled_mm = adjustment.unmodelled_mm.get(name, 0.0)
    corner_mm2 = np.maximum(np.trace(covariance, axis1=1, axis2=2) / 2.0 - unmodelled_mm**2, 0.0)
    v_px = adjustment.residuals.v_mm[rows] / pixel_mm
    camera = next(each for each in network.cameras if each.name == name)
    reach = adjustment.lens_reach(camera, (pictures.width_px * pixel_mm, pictures.height_px * pixel_mm))
    return CameraIntrinsics(
        pictures=pictures,
        family=distortion.family,
        values=values,
        correlations=tuple(_correlations(list(shown), model / np.outer(sigmas, sigmas))),
        left_out=left_out,
        used=len(set(network.observations.image) & set(pictures.images)),
        rms_px=float(np.sqrt((v_px**2).sum(axis=1).mean())),
        sigma0=adjustment.sigma0,
        corner_sigma_px=float(np.sqrt(np.median(corner_mm2))) / pixel_mm,
        unmodelled_sigma_px=unmodelled_mm / pixel_mm,
        known_share=None if reach is None else reach.share,
        lens=lens,
        pitch_um=pitch_um,
        check=check,
        _pixel_mm=pixel_mm,
    )


def _cluster_covariance(adjustment: Adjustment, positions: list[int]) -> Array | None:
    """Of some quantities of a camera, by leaving out one picture after the other; those that are fixed have zeros."""
    run = adjustment.scaled
    shared = shared_positions(run.numbering)
    covariance = cluster_covariance(run.numbering, run.end, adjustment.cofactor.part(shared))
    if covariance is None:
        return None
    found = np.zeros((len(positions), len(positions)))
    rows = [(row, int(np.flatnonzero(shared == at)[0])) for row, at in enumerate(positions) if at in shared]
    for row, of in rows:
        for column, by in rows:
            found[row, column] = covariance[of, by]
    return found


def _correlations(names: list[str], matrix: Array) -> Iterator[tuple[str, str, float]]:
    for row, column in zip(*np.triu_indices(len(names), 1), strict=True):
        if abs(matrix[row, column]) > HIGHLY_CORRELATED:
            yield names[row], names[column], float(matrix[row, column])


def opencv_yaml(camera: CameraIntrinsics) -> str:
    """The file camera.yaml, as cv2.FileStorage reads it."""
    value = {name: each.value for name, each in camera.values.items()}
    matrix = [value["fx"], 0.0, value["cx"], 0.0, value["fy"], value["cy"], 0.0, 0.0, 1.0]
    lines = ["%YAML:1.0", "---", *_size_lines(camera), *_matrix_lines("camera_matrix", 3, 3, matrix)]
    distortion = _distortion(camera)
    lines += _matrix_lines("distortion_coefficients", 1, len(distortion), distortion)
    if camera.family == "opencv_fisheye":
        lines.append('distortion_model: "fisheye"')
    sigmas = [camera.values[name].sigma for name in ("fx", "fy", "cx", "cy")]
    lines += _matrix_lines("std_deviations_fx_fy_cx_cy", 1, 4, sigmas)
    return "\n".join([*lines, f"avg_reprojection_error: {camera.rms_px:.10g}", ""])


def ros_yaml(camera: CameraIntrinsics) -> str:
    """ROS's camera info: plumb_bob, rational_polynomial or equidistant."""
    value, distortion = {name: each.value for name, each in camera.values.items()}, _distortion(camera)
    models = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
    model = "equidistant" if camera.family == "opencv_fisheye" else models[len(distortion)]
    if model == "plumb_bob":
        distortion = [*distortion, 0.0][:5]
    matrix = [value["fx"], 0.0, value["cx"], 0.0, value["fy"], value["cy"], 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    parts = [
        f"image_width: {camera.pictures.width_px}",
        f"image_height: {camera.pictures.height_px}",
        f"camera_name: {camera.pictures.name}",
        *_ros_lines("camera_matrix", 3, 3, matrix),
        f"distortion_model: {model}",
        *_ros_lines("distortion_coefficients", 1, len(distortion), distortion),
        *_ros_lines("rectification_matrix", 3, 3, identity),
        *_ros_lines("projection_matrix", 3, 4, projection),
    ]
    return "\n".join([*parts, ""])


def _distortion(camera: CameraIntrinsics) -> list[float]:
    """The coefficients in OpenCV's order, as many as OpenCV takes: 4, 5, 8, 12 or 14."""
    order = ("k1", "k2", "k3", "k4") if camera.family == "opencv_fisheye" else OPENCV_ORDER
    last = max((order.index(name) + 1 for name in camera.values if name in order), default=0)
    count = next(count for count in (4, 5, 8, 12, 14) if count >= last)
    return [camera.values[name].value if name in camera.values else 0.0 for name in order[:count]]


def _size_lines(camera: CameraIntrinsics) -> list[str]:
    return [f"image_width: {camera.pictures.width_px}", f"image_height: {camera.pictures.height_px}"]


def _matrix_lines(name: str, rows: int, columns: int, values: list[float]) -> list[str]:
    data = ", ".join(f"{value:.17g}" if value else "0." for value in values)
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: [ {data} ]"]


def _ros_lines(name: str, rows: int, columns: int, values: list[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{', '.join(map(repr, values))}]"]


def print_intrinsics(camera: CameraIntrinsics, console: Console) -> None:
    """The camera first, then what it rests on."""
    pictures = camera.pictures
    table = Table(title=f"{pictures.name}, {pictures.width_px} x {pictures.height_px} px", title_justify="left")
    for column in ("parameter", "value", "standard deviation"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for name, each in camera.values.items():
        unit, digits = (", px", 2) if name in ("fx", "fy", "cx", "cy") else ("", 5)
        table.add_row(f"{name}{unit}", f"{each.value:.{digits}f}", f"{each.sigma:.{digits}f}")
    console.print(table)
    for line in intrinsics_lines(camera):
        console.print(line, markup=False, highlight=False)


def intrinsics_lines(camera: CameraIntrinsics) -> Iterator[str]:
    """What is said below the table, a sentence each."""
    yield f"{counted(camera.used, 'picture')}, rms {camera.rms_px:.3f} px a point."
    yield (
        f"Corners {camera.corner_sigma_px:.3f} px, unmodelled {camera.unmodelled_sigma_px:.3f} px: what lens model, "
        "board and the picture's processing leave."
    )
    larger = [name for name, each in camera.values.items() if each.sigma > each.sigma_model]
    if larger:
        most = max((camera.values[name] for name in larger), key=lambda each: each.sigma / each.sigma_model)
        yield (
            f"Standard deviations of {', '.join(larger)} are those of the scatter over the pictures, up to "
            f"{most.sigma / most.sigma_model:.1f} times what independent errors would make."
        )
    if camera.correlations:
        pairs = ", ".join(f"{a} and {b} {value:.2f}" for a, b, value in camera.correlations)
        yield f"Correlations above {HIGHLY_CORRELATED}: {pairs}."
    if camera.known_share is not None and camera.known_share < 1.0:
        yield f"The lens is known to {camera.known_share:.0%} of the way to the corner; beyond it is extrapolated."
    if camera.pitch_um is not None:
        c_mm = camera.values["fy"].value * camera.pitch_um / 1000.0
        yield f"Principal distance {c_mm:.4f} mm at {camera.pitch_um:g} µm a pixel."
    shown = camera.as_json()["opencv"]
    if "fx_px" in shown:
        yield (
            f"OpenCV, same points: fx {shown['fx_px']:.2f}, fy {shown['fy_px']:.2f}, cx {shown['cx_px']:.2f}, "
            f"cy {shown['cy_px']:.2f} px, rms {shown['rms_px']:.3f} px ({shown['verdict']})."
        )
    if camera.left_out:
        yield f"Left out: {listed([f'{name} ({why})' for name, why in camera.left_out.items()])}."


def write_camera_files(cameras: list[CameraIntrinsics], out: Path, ros: bool) -> Iterator[tuple[Path, str]]:
    """camera.yaml for one camera, else one file a camera."""
    for camera in cameras:
        stem = "camera" if len(cameras) == 1 else camera.pictures.name
        yield out / f"{stem}.yaml", opencv_yaml(camera)
        if ros:
            yield out / f"{stem}-ros.yaml", ros_yaml(camera)
