"""Intrinsics of a calibrated digital camera in pixels, with standard deviations and the data they are based on."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Column, Table
from scipy.special import fdtrc, ndtr, stdtrit

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Approximations, Network
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.calibration.pictures import CameraPictures
from pipeline.results.image_unit import CENTRE, pixel_intrinsics
from pipeline.results.stage_files import CameraCheck, PixelCalibration
from pipeline.text.wording import counted, listed, listed_by_reason
from pipeline.types import Array

LensModel = Literal["opencv4", "opencv5", "opencv8", "fisheye"]
LensSetting = LensModel | Literal["auto"]
Adjust = Callable[[Network, Approximations | None], Adjustment]

PARAMETERS: dict[LensModel, tuple[str, ...]] = {
    "opencv4": ("k1", "k2", "p1", "p2"),
    "opencv5": ("k1", "k2", "p1", "p2", "k3"),
    "opencv8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}  # each but the last extends the one before
FOLDS = 5
ONE_SIGMA = ndtr(1.0)  # of Student's t: predictions are better by a standard error of many images, more of few
TINY = 1e-12  # squared prediction error, in standard deviations, of simulations without errors
WIDE = 1.0  # half the image's diagonal over the principal distance, above which a fisheye is tried: 45 degrees
HIGHLY_CORRELATED = 0.9  # from which a correlation is listed
ONE_UNKNOWN = 1.0 - 1e-9  # correlation of fx and fy of square pixels
_WORST = 3  # images named


@dataclass(frozen=True)
class LensChoice:
    """Selected lens model. rms_px: by model, prediction error of a point in images left out; None without a
    solution."""

    model: LensModel
    rms_px: Mapping[LensModel, float | None]


def free_lens(model: LensModel, square_pixels: bool) -> Distortion:
    """Distortion of a model with all parameters free, including b1 (fx differs from fy) unless the pixels are
    square."""
    family = "opencv_fisheye" if model == "fisheye" else "opencv"
    names = PARAMETERS[model] if square_pixels else (*PARAMETERS[model], "b1")
    return Distortion(family, {name: Prior(0.0, np.inf) for name in names})


def choose_lens(
    network: Network, square_pixels: bool, pixel_mm: float, adjusted: Adjust, start: Approximations | None = None
) -> LensChoice:
    """Select the lens model of a camera by cross-validation over its images.

    One fifth of the images, at least one, is left out in turn. Their points are predicted with the camera of the
    others, after a space resection of each, using the normal equations of all images. A model with more parameters is
    taken where its predictions are better, in the logarithm of their squares, by more than the standard error of the
    difference over the images, or with few images by what has the same probability. The logarithm, since a lens that
    does not suit errs in some images a hundred times as much as in others.

    Parameters
    ----------
    network : of one camera and its images, with equal standard deviations of all marks
    square_pixels : whether fx and fy are equal
    pixel_mm : side of a pixel
    adjusted : adjusts a network, from initial values if given
    start : values of an adjustment with the first model
    """
    squares: dict[LensModel, dict[str, float]] = {}  # by image
    best: LensModel = "opencv4"
    (camera,), is_wide = network.cameras, False
    for model in PARAMETERS:
        if model == "fisheye" and not is_wide:
            continue
        free = replace(camera, distortion=free_lens(model, square_pixels))
        try:
            fitted = adjusted(replace(network, cameras=(free,)), None if model == "fisheye" else start)
        except AdjustmentError:
            fitted = None
        if fitted is not None and not fitted.converged:
            fitted = None
        errors = None if fitted is None else fitted.prediction_errors(FOLDS)
        names = [] if fitted is None or errors is None else [image.name for image in fitted.network.images]
        predicted = zip(names, () if errors is None else errors.tolist(), strict=True)
        squares[model] = {name: error for name, error in predicted if np.isfinite(error)}
        start = start if fitted is None else fitted.start
        if model == "opencv4":
            c_mm = 0.0 if fitted is None else fitted.value(Parameter.interior(camera.name, "c"))
            is_wide = float(np.hypot(*camera.frame_mm)) / 2.0 > WIDE * c_mm
        simple, rich = sorted((best, model), key=lambda each: len(PARAMETERS[each]))
        best = rich if _is_better(squares[rich], squares[simple]) else simple
    sigma_px = np.sqrt(network.observations.covariance_mm2[0, 0, 0]) / pixel_mm
    rms_px = {
        model: float(np.sqrt(np.mean([*each.values()])) * sigma_px) if each else None for model, each in squares.items()
    }
    return LensChoice(best, rms_px)


def _is_better(squares: Mapping[str, float], than: Mapping[str, float]) -> bool:
    """Whether the images that both models predict are predicted better."""
    common = [image for image in squares if image in than]
    if len(common) < 2:
        return len(squares) > len(than)
    richer, simpler = (np.log([max(each[image], TINY) for image in common]) for each in (squares, than))
    gain = simpler - richer
    least = stdtrit(len(gain) - 1, ONE_SIGMA) * gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(gain.mean() > least)


_FIGURES = ("rms_px", "sigma0", "corner_sigma_px", "unmodelled_sigma_px", "known_share")


@dataclass(frozen=True)
class Intrinsic:
    """A value with its standard deviation from the adjustment, and by leaving out images; None with too few
    images."""

    value: float
    sigma_model: float
    sigma_clusters: float | None

    @property
    def sigma(self) -> float:
        """The larger standard deviation, which should be used."""
        return max(self.sigma_model, self.sigma_clusters or 0.0)

    def as_json(self) -> dict[str, float | None]:
        return {name: getattr(self, name) for name in ("value", "sigma", "sigma_model", "sigma_clusters")}


@dataclass(frozen=True, kw_only=True, repr=False)
class CameraIntrinsics:
    """Intrinsics in px from the centre of the top left pixel, x right, y down, as in OpenCV.

    Attributes
    ----------
    values : fx, fy, cx, cy, then the distortion parameters.
    covariance : of these, the larger of model and left-out images in each direction.
    correlations : pairs above HIGHLY_CORRELATED.
    left_out : by image, the reason.
    worst : images with the largest residuals: name, and rms of a point, px.
    known_share : radius up to which the lens was observed, as a fraction of the distance to the corner.
    lens : selection of the lens model; None where it was given.
    pitch_um : pixel pitch, None if unknown.
    """

    pictures: CameraPictures
    family: str
    values: Mapping[str, Intrinsic]
    covariance: Array
    correlations: tuple[tuple[str, str, float], ...]
    left_out: Mapping[str, str]
    used: int
    rms_px: float
    worst: tuple[tuple[str, float], ...]
    sigma0: float
    corner_sigma_px: float
    unmodelled_sigma_px: float
    known_share: float | None
    lens: LensChoice | None
    pitch_um: float | None
    check: CameraCheck | None

    @property
    def is_fisheye(self) -> bool:
        return self.family == "opencv_fisheye"

    @property
    def centre(self) -> str:
        """fx, fy, cx, cy with their standard deviations."""
        return ", ".join(
            f"{name} {each.value:.2f} ± {each.sigma:.2f}" for name, each in self.values.items() if name in CENTRE
        )

    def __repr__(self) -> str:
        pictures = counted(self.used, "picture")
        return f"{self.pictures.name}: {self.centre} px, {pictures}, rms {self.rms_px:.3f} px a point"

    def as_json(self) -> dict[str, Any]:
        values = {name: each.as_json() for name, each in self.values.items()}
        # OpenCV's calibration of the same points, and of its own corners
        opencv: dict[str, Any] = {"verdict": "not possible", "reason": "the camera was not checked"}
        if self.check is not None:
            opencv = {"verdict": self.check.verdict, "reason": self.check.reason}
            if self.check.corners_px is not None:
                opencv |= _pixels(self.check.corners_px.reseau)
                opencv["own_corners"] = _pixels(self.check.corners_px.opencv)
        return {
            "name": self.pictures.name,
            "image_size_px": [self.pictures.width_px, self.pictures.height_px],
            "images_used": self.used,
            "images_left_out": dict(self.left_out),
            "images_turned_deg": dict(self.pictures.turned_deg),
            "unsure_turns": list(self.pictures.unsure_turns),
            **{f"{name}_px": values.pop(name) for name in CENTRE},
            "distortion": {"family": self.family, **values},
            "correlations": [{"of": [a, b], "value": value} for a, b, value in self.correlations],
            **{name: getattr(self, name) for name in _FIGURES},
            "lens_rms_px": {} if self.lens is None else dict(self.lens.rms_px),
            "opencv": opencv,
        }

    def print(self, console: Console) -> None:
        """Print the camera as a table, then the data it is based on."""
        title = f"{self.pictures.name}, {self.pictures.width_px} x {self.pictures.height_px} px"
        figures = (Column(name, justify="right") for name in ("value", "standard deviation"))
        table = Table("parameter", *figures, title=title, title_justify="left")
        for name, each in self.values.items():
            unit, digits = (", px", 2) if name in CENTRE else ("", 5)
            table.add_row(f"{name}{unit}", f"{each.value:.{digits}f}", f"{each.sigma:.{digits}f}")
        console.print(table)
        for line in self._lines():
            console.print(line, markup=False, highlight=False)

    def _lines(self) -> Iterator[str]:
        worst = listed([f"{name} {rms_px:.3f}" for name, rms_px in self.worst])
        yield f"{counted(self.used, 'picture')}, rms {self.rms_px:.3f} px a point. The worst: {worst} px."
        yield (
            f"Corners {self.corner_sigma_px:.3f} px, unmodelled {self.unmodelled_sigma_px:.3f} px: what lens model, "
            "board and the picture's processing leave."
        )
        if self.lens is not None and self.lens.rms_px[self.lens.model] is not None:
            rms_px = {
                model: "no solution" if rms is None else f"{rms:.3f} px" for model, rms in self.lens.rms_px.items()
            }
            others = ", ".join(f"{model} {rms}" for model, rms in rms_px.items() if model != self.lens.model)
            yield (
                f"Lens {self.lens.model}, by cross-validation over pictures: rms {rms_px[self.lens.model]} in pictures "
                f"left out ({others})."
            )
        if larger := [name for name, each in self.values.items() if each.sigma > each.sigma_model]:
            most = max(self.values[name].sigma / self.values[name].sigma_model for name in larger)
            yield (
                f"Standard deviations of {', '.join(larger)}: by leaving out one picture at a time, up to {most:.1f} "
                "times those of a model with independent errors."
            )
        # Left out one at a time, fewer pictures than parameters vary the camera in some directions only.
        estimated = sum(each.sigma > 0.0 for each in self.values.values())
        if self.used <= estimated or any(each.sigma_clusters is None for each in self.values.values()):
            yield (
                f"{self.used} pictures are few for the {estimated} parameters of the camera: errors within a picture "
                "may be correlated unnoticed, and real errors larger."
            )
        if self.correlations:
            pairs = ", ".join(f"{a} and {b} {value:.2f}" for a, b, value in self.correlations)
            yield f"Correlations above {HIGHLY_CORRELATED}: {pairs}."
        if self.known_share is not None and self.known_share < 1.0:
            share = 100.0 * self.known_share
            yield f"The lens is known to {share:.0f} % of the way to the corner; beyond it is extrapolated."
        if self.pitch_um is not None:
            c_mm = self.values["fy"].value * self.pitch_um / 1000.0
            yield f"Principal distance {c_mm:.4f} mm at {self.pitch_um:g} µm a pixel."
        if self.check is not None and self.check.corners_px is not None:
            same = self.check.corners_px.reseau
            yield (
                f"OpenCV, same points: fx {same.fx:.2f}, fy {same.fy:.2f}, cx {same.cx:.2f}, cy {same.cy:.2f} px, rms "
                f"{same.rms:.3f} px ({self.check.verdict})."
            )
        if turned := self.pictures.turned_deg:
            shown = listed([f"{name} ({degrees}°)" for name, degrees in turned.items()])
            yield f"Turned counter-clockwise, and turned back into the frame of the others: {shown}."
        if unsure := self.pictures.unsure_turns:
            yield (
                f"Which way {listed(unsure)} {'was' if len(unsure) == 1 else 'were'} turned is ambiguous: both ways "
                "fit equally, for the principal point lies in the middle and the distortion is symmetric."
            )
        if self.left_out:
            yield f"Left out: {listed_by_reason(self.left_out)}."


def camera_intrinsics(
    adjustment: Adjustment,
    pictures: CameraPictures,
    pixel_mm: float,
    left_out: Mapping[str, str],
    lens: LensChoice | None,
    pitch_um: float | None,
    check: CameraCheck | None,
) -> CameraIntrinsics:
    """Convert the adjustment of one camera from mm to px.

    pixel_mm: side of a pixel in the adjustment; left_out, lens, pitch_um, check: see `CameraIntrinsics`.
    """
    (camera,) = adjustment.network.cameras
    names = [name for name, prior in camera.distortion.parameters.items() if prior.sigma > 0.0]
    keys = [Parameter.interior(camera.name, name) for name in ("c", "x0", "y0", *names)]
    values, by_mm = pixel_intrinsics({key.quantity: adjustment.value(key) for key in keys}, pixel_mm)
    covariance = by_mm @ (adjustment.sigma0**2 * adjustment.cofactor_of(keys)) @ by_mm.T
    clusters = adjustment.cluster_covariance_of(keys)
    scatter = None if clusters is None else np.sqrt(np.diagonal(by_mm @ clusters @ by_mm.T))
    sigmas = np.sqrt(np.diagonal(covariance))
    unmodelled_mm = adjustment.unmodelled_mm.get(camera.name, 0.0)
    given_mm2 = np.trace(adjustment.network.observations.covariance_mm2, axis1=1, axis2=2) / 2.0 - unmodelled_mm**2
    v_px = adjustment.residuals.v_mm / pixel_mm
    reach = adjustment.lens_reach(camera, (pictures.width_px * pixel_mm, pictures.height_px * pixel_mm))
    correlation = covariance / np.outer(sigmas, sigmas)
    images, rows = np.unique(np.array(adjustment.network.observations.image), return_inverse=True)
    image_rms_px = np.sqrt(np.bincount(rows, (v_px**2).sum(axis=1)) / np.bincount(rows))
    return CameraIntrinsics(
        pictures=pictures,
        family=camera.distortion.family,
        values={
            name: Intrinsic(value, float(sigmas[row]), None if scatter is None else float(scatter[row]))
            for row, (name, value) in enumerate(values.items())
        },
        covariance=by_mm @ adjustment.larger_covariance_of(keys) @ by_mm.T,
        correlations=tuple(
            (one, other, float(correlation[row, column]))
            for (row, one), (column, other) in combinations(enumerate(values), 2)
            if HIGHLY_CORRELATED < abs(correlation[row, column]) < ONE_UNKNOWN
        ),
        left_out=left_out,
        used=len(adjustment.network.images),
        rms_px=float(np.sqrt((v_px**2).sum(axis=1).mean())),
        worst=tuple((str(images[row]), float(image_rms_px[row])) for row in np.argsort(-image_rms_px)[:_WORST]),
        sigma0=adjustment.sigma0,
        corner_sigma_px=float(np.sqrt(np.median(np.maximum(given_mm2, 0.0)))) / pixel_mm,
        unmodelled_sigma_px=unmodelled_mm / pixel_mm,
        known_share=None if reach is None else reach.share,
        lens=lens,
        pitch_um=pitch_um,
        check=check,
    )


def p_of_one_camera(cameras: Sequence[CameraIntrinsics]) -> float:
    """p-value of calibrations by different images that fx, fy, cx, cy are those of one camera. Their covariances come
    from few images, so that it is an F test."""
    values = np.array([[camera.values[name].value for name in CENTRE] for camera in cameras])
    weights = np.linalg.pinv(np.array([camera.covariance[:4, :4] for camera in cameras]), hermitian=True)
    mean = np.linalg.pinv(weights.sum(axis=0), hermitian=True) @ np.einsum("cij,cj->i", weights, values)
    count = len(CENTRE) * (len(cameras) - 1)
    square = float(np.einsum("ci,cij,cj->", values - mean, weights, values - mean))
    images = sum(camera.used for camera in cameras) - len(cameras)
    return float(fdtrc(count, images, square / count)) if count and images > 0 else 1.0


def _pixels(calibration: PixelCalibration) -> dict[str, float]:
    return {f"{name}_px": getattr(calibration, name) for name in (*CENTRE, "rms")}
