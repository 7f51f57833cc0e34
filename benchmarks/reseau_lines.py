"""Astrographic plates with a réseau of continuous lines, 13 x 13 crossings 5 mm apart, and stars exposed three
times."""

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from scipy.special import ndtr

from benchmarks.harness import Row, rms
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import Bar, FiducialLayout, LayoutMark, MarkShape
from measure.scans.opening import open_scan
from measure.tone.curve import LINEAR

COUNT, STEP_MM, PLATE_MM = 13, 5.0, 160.0
LIGHT_DN, LINE_DN, BLACK_DN, NOISE_DN = 45000.0, 9000.0, 6000.0, 300.0
BLUR_PX = 0.8
EXPOSURES_MM = np.array([(0.0, 0.2), (-0.17, -0.1), (0.17, -0.1)])  # mm, offsets of the three exposures, a triangle
STAR_MM, BRIGHT_MM = 0.045, 0.15  # mm, sigma of faint stars, and of bright ones on crossings
BRIGHT, GAP_MM = 10, (5.0, 25.0)  # number of bright stars, and range, mm, where one line is missing

COLUMNS = {
    "pitch_um": "g", "stars": "d", "pose": "", "measured": "d", "weak": "d", "of": "d", "rms_px": ".3f",
    "largest_px": ".3f", "error_over_claim": ".2f", "cpu_s": ".1f",
}  # fmt: skip


def cells() -> Iterator[Row]:
    yield from (
        {"pitch_um": pitch, "stars": stars, "pose": pose}
        for pitch, stars, pose in ((80.0, 1500, "0"), (80.0, 1500, "auto"), (40.0, 4000, "0"))
    )


def case(pitch_um: float, stars: int, pose: str, seed: int) -> Row:
    line_mm = max(0.08, 2.5 * pitch_um / 1000)
    grey, truth = plate(seed, pitch_um / 1000, line_mm, stars)
    with TemporaryDirectory() as folder:
        tifffile.imwrite(Path(folder) / "plate.tif", grey)
        start = time.process_time()
        with open_scan(Path(folder) / "plate.tif") as scan:
            options = FiducialOptions(pose)
            frame = measure_fiducials(scan.replace_tone(LINEAR), layout(line_mm), (pitch_um, pitch_um), options)
        cpu_s = time.process_time() - start
    statuses = Counter(mark.status for mark in frame.marks)
    good = [mark for mark in frame.marks if mark.status is Status.MEASURED]
    errors = np.array([mark.center_px - truth[mark.point] for mark in good if mark.center_px is not None])
    sigmas = np.array([np.sqrt(np.diag(mark.covariance.px2)) for mark in good if mark.covariance is not None])
    return {
        "measured": len(good),
        "weak": statuses[Status.WEAK],
        "of": COUNT**2,
        "rms_px": rms(errors),
        "largest_px": float(np.abs(errors).max()),
        "error_over_claim": rms(errors) / rms(sigmas),
        "cpu_s": cpu_s,
    }


def layout(line_mm: float) -> FiducialLayout:
    """Layout of crosses whose arms reach halfway to the next ones."""
    arm = STEP_MM / 2
    cross = MarkShape((Bar((-arm, 0.0), (arm, 0.0), line_mm), Bar((0.0, -arm), (0.0, arm), line_mm)), "dark")
    marks = (LayoutMark(name, xy_mm, (0.002, 0.002), cross) for name, xy_mm in crossings().items())
    return FiducialLayout(tuple(marks), (PLATE_MM, PLATE_MM))


def crossings() -> dict[str, tuple[float, float]]:
    steps = STEP_MM * (np.arange(COUNT) - (COUNT - 1) / 2)
    return {f"{i}-{j}": (float(x), float(y)) for i, x in enumerate(steps) for j, y in enumerate(steps)}


def plate(seed: int, pitch_mm: float, line_mm: float, stars: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Render a negative, rotated by 0.3 degrees and slightly sheared; returns it and the true places of its
    crossings."""
    rng = np.random.default_rng(seed)
    size = int(PLATE_MM / pitch_mm)
    turn, middle = np.deg2rad(0.3), size / 2 + rng.uniform(-20, 20, 2)
    linear = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) / pitch_mm
    linear = linear @ [[1 + 2e-4, 1e-4], [0.0, 1 - 1e-4]]
    lines = line_coverage(size, linear, middle, line_mm, BLUR_PX * pitch_mm)
    density = np.zeros((size, size), np.float32)
    places = (np.array([*crossings().values()]))[rng.choice(COUNT**2, BRIGHT, replace=False)]
    for xy_mm in places + rng.normal(0, 0.1, places.shape):
        add_star(density, xy_mm @ linear.T * (1, -1) + middle, 20.0, BRIGHT_MM / pitch_mm)
    for xy_mm, light in zip(rng.uniform(-78, 78, (stars, 2)), rng.uniform(0, 1, stars) ** -0.6, strict=True):
        for place in (xy_mm + EXPOSURES_MM) @ linear.T * (1, -1) + middle:
            add_star(density, place, 0.6 * light, STAR_MM * (1 + 0.25 * np.log(light)) / pitch_mm)
    ground = LIGHT_DN - LINE_DN * lines
    grey = ground - (ground - BLACK_DN) * (1 - np.exp(-density)) + rng.normal(0, NOISE_DN, ground.shape)
    truth = {name: np.array(xy) @ linear.T * (1, -1) + middle for name, xy in crossings().items()}
    return np.clip(grey, 0, 65535).astype(np.uint16), truth


def line_coverage(size: int, linear: np.ndarray, middle: np.ndarray, line_mm: float, blur_mm: float) -> np.ndarray:
    """(size, size) coverage by the lines; one is missing over GAP_MM."""
    rows, cols = np.mgrid[:size, :size].astype(np.float32)
    x, y = np.einsum("ij,jrc->irc", np.linalg.inv(linear), np.stack([cols - middle[0], middle[1] - rows]))
    reach, covered = (COUNT - 1) / 2 * STEP_MM, np.zeros((size, size))
    for across, along, is_upright in ((x, y, True), (y, x, False)):
        number = np.rint(across / STEP_MM)
        off = across - STEP_MM * number
        line = ndtr((line_mm / 2 - off) / blur_mm) - ndtr((-line_mm / 2 - off) / blur_mm)
        line *= (np.abs(number) <= (COUNT - 1) / 2) * ndtr((reach + 2.0 - np.abs(along)) / blur_mm)
        if is_upright:
            line[(number == 2) & (along > GAP_MM[0]) & (along < GAP_MM[1])] = 0.0
        covered = np.maximum(covered, line)
    return covered


def add_star(density: np.ndarray, place: np.ndarray, height: float, sigma_px: float) -> None:
    """Add a Gaussian if it lies entirely within the plate."""
    half = int(5 * sigma_px) + 2
    (col, row), size = np.rint(place).astype(int), len(density)
    if half < col < size - half and half < row < size - half:
        step = np.arange(-half, half + 1)
        off = np.array([[row], [col]]) + step - place[::-1, None]
        down, across = np.exp(-((off / sigma_px) ** 2) / 2)
        density[row - half : row + half + 1, col - half : col + half + 1] += height * np.outer(down, across)
