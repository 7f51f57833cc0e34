"""Frames of an aerial camera with faint marks, in scans whose pixels are longer one way than the other.

python -m benchmarks unequal_pixels [--frames 24] [--first 0] [--seed 1]

Four plain diagonal crosses at the corners of a square of 212 mm, as Wild cameras have them, a pixel wide, on pads,
among dust, scratches and hairs on grainy film. Their contrast is that of lines 3 to 8 times the scanner's noise on a
pad of 0.06 of full scale; as the pads have half of that, it is 3.1, 4.4 and 6.2 times the noise of a pixel, grain and
scanner's, before the blur. Pixels differ by 0.4 to 1 % either way, and the pitch given for both is off by up to 0.4 %.
One line a frame: how many marks were found where they are, how many elsewhere, how many are with both pitches given
right, and what was said; then a table by contrast. best: in standard deviations, what a filter matched to the marks and
to the noise, were both known, would answer to all marks together; what it has to pass is in docs/method/search.md.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.lone_frames import fiducials_of, image_of, lone_frame, painted
from measure.fiducials.measurement import measure_fiducials
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross
from measure.results import FrameMeasurement
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from synthetic_images.frame import frame_truth
from synthetic_images.scene import (
    Film,
    Scanner,
    Scene,
    Tones,
)

Array = NDArray[np.float64]

FRAME_MM, AT_MM = 228.0, 106.0
PITCH_UM = 127.5
UNEQUAL, MOST_WRONG = (0.004, 0.01), 0.004
SNRS = (3.0, 5.0, 8.0)
PAD = 0.06  # of full scale
NOISE = 0.012  # likewise
GRAIN, GRAIN_PX = 0.02, 1.0
ABOUT_PX = 48  # about a mark: its picture and its pad's
SAME_PX = 1.0
CROSS = MarkShape(cross(1.75, 0.12, 0.25, 45.0), "light")
LAYOUT = FiducialLayout(
    tuple(
        LayoutMark(str(number), (x * AT_MM, y * AT_MM), (0.01, 0.01), CROSS)
        for number, (x, y) in enumerate(((-1, -1), (1, 1), (-1, 1), (1, -1)), 1)
    ),
    (FRAME_MM, FRAME_MM),
)


@dataclass(frozen=True, eq=False)
class Case:
    """A scan, its true pitches, the one that is given for both, its marks' true places by their names, and how strongly
    the best filter would answer to them."""

    snr: float
    unequal: float
    pitch_um: tuple[float, float]
    given_um: float
    scan: Scan
    centers_px: dict[str, Array]
    best: float


def draw_case(seed: int, index: int) -> Case:
    """The index-th frame of a study."""
    rng = np.random.default_rng([seed, index])
    snr = SNRS[index % len(SNRS)]
    unequal = float(rng.choice([-1.0, 1.0]) * rng.uniform(*UNEQUAL))
    pitch_um = (PITCH_UM * (1 + unequal / 2), PITCH_UM * (1 - unequal / 2))
    image = image_of(
        "0",
        float(rng.normal(0.0, 0.5)),
        offset_mm=(float(rng.normal(0.0, 1.0)), float(rng.normal(0.0, 1.0))),
        scale=(1 + float(rng.normal(0, 3e-4)), 1 + float(rng.normal(0, 3e-4))),
        shear=0.0,
        height_mm=1000.0,
    )
    scene = lone_frame(
        "unequal pixels",
        int(rng.integers(2**31)),
        FRAME_MM,
        fiducials_of(LAYOUT.marks),
        image,
        153.0,
        scanner=Scanner(pitch_um, margin_mm=6.0, blur_px=float(rng.uniform(0.4, 0.8)), noise=NOISE),
        film=Film(grain=GRAIN, grain_px=GRAIN_PX, dust=600, scratches=20, hairs=30),
        tones=Tones(border=0.03, background=0.4, contrast=0.15, mark=PAD + snr * 1.2 * NOISE),
        background="terrain",
        pad_mm=float(rng.choice([2.2, 4.0])),
    )
    centers_px = {name: each.center_px for name, each in frame_truth(scene, 0).fiducials.items()}
    grey = painted(scene)
    return Case(
        snr,
        unequal,
        pitch_um,
        PITCH_UM * (1 + float(rng.uniform(-MOST_WRONG, MOST_WRONG))),
        Scan(Path(f"{index}.tif"), WholePicture(grey[..., None]), NO_TAGS),
        centers_px,
        best_answer(scene, centers_px),
    )


def best_answer(scene: Scene, centers_px: dict[str, Array]) -> float:
    """The answer of the filter matched to the marks and to the noise: the root of the sum of |mark|^2 / noise over all
    frequencies."""
    even = replace(scene, film=replace(scene.film, grain=0.0), scanner=replace(scene.scanner, noise=0.0))
    bare = replace(even, tones=replace(even.tones, mark=even.tones.border))
    marks = (painted(even).astype(float) - painted(bare)) / 65535
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(2 * ABOUT_PX), np.fft.fftfreq(2 * ABOUT_PX)))
    spread = np.exp(-((2 * np.pi * GRAIN_PX * frequency) ** 2))
    noise = NOISE**2 + GRAIN**2 * 4 * np.pi * GRAIN_PX**2 * spread
    squares = 0.0
    for col, row in (np.rint(center).astype(int) for center in centers_px.values()):
        mark = marks[row - ABOUT_PX : row + ABOUT_PX, col - ABOUT_PX : col + ABOUT_PX]
        squares += float((np.abs(np.fft.fft2(mark)) ** 2 / noise).sum()) / mark.size
    return float(np.sqrt(squares))


def main() -> None:
    """Measure the frames one by one, and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rows = [told(draw_case(given.seed, index), index) for index in range(given.first, given.first + given.frames)]
    print(f"\n{'SNR':>4}{'frames':>8}{'marks':>7}{'found':>7}{'elsewhere':>11}{'with both':>11}{'pitch named':>13}")
    for snr in SNRS:
        own = [counts for each, counts in rows if each == snr]
        found, elsewhere, known, named = np.sum(own, axis=0).tolist() if own else (0, 0, 0, 0)
        print(f"{snr:4.0f}{len(own):8}{4 * len(own):7}{found:7}{elsewhere:11}{known:11}{named:13}")


def told(case: Case, index: int) -> tuple[float, tuple[int, int, int, int]]:
    """Marks found, elsewhere, and found with both pitches; and whether a pitch pair is named where none is found."""
    result = measure_fiducials(case.scan, LAYOUT, (case.given_um, case.given_um))
    found, elsewhere = counted(case, result)
    known, _ = counted(case, measure_fiducials(case.scan, LAYOUT, case.pitch_um))
    said = "" if found == len(LAYOUT.marks) else " ".join(result.problems)
    off = f"{100 * case.unequal:+.2f} %, given {100 * (case.given_um / PITCH_UM - 1):+.2f} %"
    places = f"found {found}, elsewhere {elsewhere}, with both pitches {known}"
    print(f"{index}: SNR {case.snr:.0f}, best {case.best:.1f}, {off}: {places} {said}", flush=True)
    return case.snr, (found, elsewhere, known, int("try pitch_um" in said))


def counted(case: Case, result: FrameMeasurement) -> tuple[int, int]:
    """Observations where a mark is, and elsewhere."""
    places = np.array(list(case.centers_px.values()))
    seen = [mark.center_px for mark in result.marks if mark.status.is_observation and mark.center_px is not None]
    right = sum(bool(np.hypot(*(places - center).T).min() < SAME_PX) for center in seen)
    return right, len(seen) - right


if __name__ == "__main__":
    main()
