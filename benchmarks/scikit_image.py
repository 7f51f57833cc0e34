"""Methods of scikit-image compared with those of the program, on the same synthetic images and points.

Each row is one method: its figure of merit, and that of the method used by the program.
"""

import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from drawn import make_scan
from numpy.typing import NDArray
from skimage.feature import blob_log, corner_subpix
from skimage.filters import threshold_local, window
from skimage.measure import EllipseModel, find_contours, label, ransac, regionprops
from skimage.morphology import opening
from skimage.registration import phase_cross_correlation
from skimage.transform import AffineTransform, PiecewiseAffineTransform, PolynomialTransform
from test_frame_edge import CORNER_SIZE as CORNER_PX
from test_frame_edge import NOISE as CORNER_NOISE
from test_frame_edge import board_steps, square_picture
from test_targets import field
from true_marks import KIND, TrueMark, some_mark

from adjust.functional_model.transformation import film_kind, fit_transformation
from benchmarks.harness import Row, rms
from benchmarks.measured_marks import CONTRAST, GROUND, draw_mark, measure_mark, start_off
from measure.boards.corner_fit import junctions
from measure.fiducials.consistency import FrameMarks, Scatter, gross_errors
from measure.noise.robust_estimation import _open_mask, robust_scale
from measure.targets.detection import DiskSearch, disk_candidates

Array = NDArray[np.float64]

SEED, SNR, LEAST_CONTOUR = 5, 20.0, 12
DISKS, RADII_PX, HIT_PX = 32, (2.5, 15.0), 1.0
NOISES, SOLID = (4.0, 6.0, 9.0, 14.0, 20.0), 0.92
MARKS_MM = 106.0 * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1)], float)
FILM_MM, BENT_MM, GROSS_MM, GATE_MM = 0.01, 0.1, 1.0, 0.5


def ellipse_model(count: int) -> str:
    """Centres of ellipses by EllipseModel through the contour at half the contrast, and by least-squares matching."""
    rng, ours, theirs = np.random.default_rng(SEED), list[Array](), list[Array]()
    for _number in range(count):
        mark = some_mark(KIND["ellipse"], 1.0, rng)
        grey, _sign = draw_mark(mark, rng)
        noisy = grey + CONTRAST / SNR * rng.standard_normal(grey.shape)
        found, place = measure_mark(mark, noisy, rng, off=start_off(mark, rng)), mark.place[:, 2]
        ours += [] if found is None else [found.center_px - place]
        theirs += [contour_center(noisy, place) - place]
    return f"{rms(theirs):.4f} px | least-squares matching {rms(ours):.4f} px"


def contour_center(grey: Array, about_px: Array) -> Array:
    """(2,) centre of an ellipse through the contour around a place, halfway between background and mark."""
    col, row = np.rint(about_px).astype(int)
    level = (np.median(grey) + grey[row - 1 : row + 2, col - 1 : col + 2].mean()) / 2
    contours = [each[:, ::-1] for each in find_contours(grey, level) if len(each) >= LEAST_CONTOUR]
    nearest = min(contours, key=lambda each: float(np.hypot(*(each.mean(axis=0) - about_px))))
    model = EllipseModel.from_estimate(nearest)
    return np.asarray(model.center) if model else np.full(2, np.nan)


def phase_correlation(count: int) -> str:
    """Shift of a mark between two scans by phase_cross_correlation, 1/100 px, and by matching the drawing in both."""
    rng, ours, theirs = np.random.default_rng(SEED), list[Array](), list[Array]()
    for _number in range(count):
        first = some_mark(KIND["ring-cross"], 1.0, rng)
        shift = rng.uniform(-0.5, 0.5, 2)
        place = first.place + np.column_stack([np.zeros((2, 2)), shift])
        second = TrueMark(first.kind, place, first.size, first.blur_px)
        pictures = [
            GROUND + CONTRAST * (each.picture + rng.standard_normal(each.picture.shape) / SNR)
            for each in (first, second)
        ]
        here, there = (
            measure_mark(each, grey, rng, off=start_off(each, rng))
            for each, grey in zip((first, second), pictures, strict=True)
        )
        if here is not None and there is not None:
            ours.append(there.center_px - here.center_px - shift)
        tapered = [(each - each.mean()) * window("hann", each.shape) for each in pictures]
        moved, _error, _phase = phase_cross_correlation(*tapered[::-1], upsample_factor=100, normalization=None)
        theirs.append(np.asarray(moved)[::-1] - shift)
    return f"{rms(theirs):.4f} px | matching in both {rms(ours):.4f} px"


def blobs(_: int) -> str:
    """Detection, before any fit, of disks of 3 to 12 px radius on a cloudy background with streaks; at the contrast for
    which the threshold is set, and at a third of it."""
    drawn_field, centers = field(np.random.default_rng(SEED), DISKS)
    truth = np.array(centers)
    fainter = drawn_field.mean() + (drawn_field - drawn_field.mean()) / 3
    return " || ".join(_places_found(picture, truth) for picture in (drawn_field, fainter))


def _places_found(picture: Array, truth: Array) -> str:
    def regions() -> Array:
        """Regions above multiples of the image noise; of those around one place the one of largest solidity."""
        above = picture - threshold_local(picture, 4 * int(RADII_PX[1]) + 1, method="mean")
        noise, sizes = robust_scale(np.diff(picture)) / np.sqrt(2), np.pi * np.array(RADII_PX) ** 2
        found = [each for level in NOISES for each in regionprops(label(above > level * noise))]
        kept = list[Array]()
        for each in sorted(found, key=lambda each: -each.solidity):
            center = np.array(each.centroid[::-1])
            apart = [np.hypot(*(center - other)) for other in kept]
            if sizes[0] < each.area < sizes[1] and each.solidity > SOLID and min(apart, default=np.inf) > RADII_PX[0]:
                kept.append(center)
        return np.array(kept)

    def laplacians() -> Array:
        sigmas = np.array(RADII_PX) / np.sqrt(2)
        found = blob_log(picture / 65535, min_sigma=sigmas[0], max_sigma=sigmas[1], num_sigma=8, threshold=0.1)
        return np.asarray(found[:, 1::-1])

    def own() -> Array:
        return np.array(
            [each.center_px for each in disk_candidates(make_scan(picture), DiskSearch((5.0, 30.0), "light"))]
        )

    return " | ".join(f"{method.__name__}: {_count_outliers(method, truth)}" for method in (regions, laplacians, own))


def _count_outliers(method: Callable[[], Array], truth: Array) -> str:
    start = time.process_time()
    found = method().reshape(-1, 2)
    seconds = time.process_time() - start
    if not len(found):
        return f"none of {len(truth)}, {seconds:.2f} s"
    off = np.hypot(*np.moveaxis(found[:, None] - truth[None], -1, 0))
    hit = off.min(axis=0) < HIT_PX
    return f"{hit.sum()} of {len(truth)}, {int((off.min(axis=1) > HIT_PX).sum())} false, {seconds:.2f} s"


def agreeing_marks(count: int) -> str:
    """Outlier detection on a film with deformation of about 0.1 mm, with gross errors of 1 mm in two of eight or none
    of four marks: number of frames in which exactly these are rejected, and in which a correct mark is, by RANSAC with
    the gate of the search, and one by one."""
    return " || ".join(_outliers_named(10 * count, *case) for case in ((MARKS_MM, 2), (MARKS_MM[:4], 0)))


def _outliers_named(frames: int, marks_mm: Array, off: int) -> str:
    rng, result = np.random.default_rng(SEED), {"RANSAC": [0, 0], "one by one": [0, 0]}
    for number in range(frames):
        x, y = marks_mm.T / 106.0
        bend = np.stack([x * x, x * y, y * y], axis=1) @ rng.normal(0.0, BENT_MM, (3, 2))
        view = marks_mm + bend + FILM_MM * rng.standard_normal(marks_mm.shape)
        wrong, angle = rng.choice(len(view), off, replace=False), rng.uniform(0, 2 * np.pi, off)
        view[wrong] += GROSS_MM * np.column_stack([np.cos(angle), np.sin(angle)])
        truth = np.isin(np.arange(len(view)), wrong)
        _, kept = ransac((marks_mm, view), AffineTransform, 3, GATE_MM, max_trials=60, rng=number)
        marks = FrameMarks.from_places(marks_mm, view, np.zeros((len(view), 2, 2)))
        one_by_one = gross_errors(marks, Scatter(FILM_MM), GATE_MM)
        for name, out in (("RANSAC", ~kept if kept is not None else ~truth), ("one by one", one_by_one)):
            result[name][0] += np.array_equal(out, truth)
            result[name][1] += bool((out & ~truth).any())
    estimate = [f"{name} right in {right}, a true one out in {extra}" for name, (right, extra) in result.items()]
    return f"{off} of {len(marks_mm)} off, {frames} frames: {' | '.join(estimate)}"


def corners(count: int) -> str:
    """Corners of a chessboard with a blur of 1 px, from a start at a whole pixel: by corner_subpix, and by OpenCV."""
    rng, ours, theirs = np.random.default_rng(SEED), list[Array](), list[Array]()
    for _number in range(4 * count):
        center = np.full(2, (CORNER_PX - 1) / 2) + rng.uniform(-0.5, 0.5, 2)
        grey = square_picture(center, board_steps(rng), 1.0, False)
        grey = grey + CORNER_NOISE * rng.standard_normal(grey.shape)
        start = np.rint(center)
        ours.append(junctions(grey[None], start[None], 7.0)[0] - center)
        theirs.append(corner_subpix(grey, start[None, ::-1].astype(int), window_size=13)[0, ::-1] - center)
    lost = int(np.isnan(np.array(theirs)).any(axis=1).sum())
    return f"{rms(theirs):.4f} px, none for {lost} of {4 * count} | OpenCV {rms(ours):.4f} px"


def morphology(count: int) -> str:
    """Morphological opening of damage masks: number of equal results, and time of each."""
    rng = np.random.default_rng(SEED)
    masks = [cv2.GaussianBlur(rng.standard_normal((61, 61)), (0, 0), 1.2) > 0.15 for _ in range(20 * count)]
    start = time.process_time()
    ours = [_open_mask(mask) for mask in masks]
    middle = time.process_time()
    theirs = [opening(mask, np.ones((2, 2), bool)) for mask in masks]
    end = time.process_time()
    same = sum(np.array_equal(*pair) for pair in zip(ours, theirs, strict=True))
    return f"{end - middle:.2f} s, {same} of {len(masks)} masks the same | OpenCV {middle - start:.2f} s"


def film(count: int) -> str:
    """Film deformed by a second-order polynomial, measured by eight marks to 3 µm: RMS error over the frame."""
    rng = np.random.default_rng(SEED)
    inside = np.stack(np.meshgrid(*2 * [np.linspace(-100.0, 100.0, 9)]), axis=-1).reshape(-1, 2)
    errors: dict[str, list[Array]] = {"PiecewiseAffine": [], "Polynomial": [], "film transformation": []}
    for _number in range(count):
        bend = rng.normal(0.0, 0.02, (2, 3))

        def bent(xy: Array, bend: Array = bend) -> Array:
            x, y = xy.T / 106.0
            return np.asarray(xy + np.stack([x * x, x * y, y * y], axis=1) @ bend.T)

        view = bent(MARKS_MM) + 0.003 * rng.standard_normal(MARKS_MM.shape)
        piecewise = PiecewiseAffineTransform.from_estimate(view, MARKS_MM)
        polynomial = PolynomialTransform.from_estimate(view, MARKS_MM, order=2)
        parameters, mirrored = fit_transformation("polynomial(2)", view, MARKS_MM)
        places = bent(inside)
        errors["PiecewiseAffine"].append(piecewise(places) - inside)
        errors["Polynomial"].append(polynomial(places) - inside)
        own = film_kind("polynomial(2)", mirrored).apply(parameters, places)
        errors["film transformation"].append(own - inside)
    lost = np.isnan(np.concatenate(errors["PiecewiseAffine"])).any(axis=1).mean()
    result = [f"{name} {1000 * np.sqrt(np.nanmean(np.square(each))):.2f} um" for name, each in errors.items()]
    return f"{' | '.join(result)}; {lost:.0%} of the places outside of all triangles"


METHODS: dict[str, Callable[[int], str]] = {
    "EllipseModel": ellipse_model,
    "phase_cross_correlation": phase_correlation,
    "regionprops, blob_log": blobs,
    "ransac": agreeing_marks,
    "corner_subpix": corners,
    "morphology": morphology,
    "PolynomialTransform, PiecewiseAffineTransform": film,
}


COLUMNS = {"method": "", "figures": ""}


def cells() -> Iterator[Row]:
    yield from ({"method": method} for method in METHODS)


def case(method: str, count: int = 24) -> Row:
    return {"figures": METHODS[method](count)}
