"""Checks across the frames of a camera, by simulated places: detection rates of wrong marks, deformed frames, wrong
given coordinates and scanner errors, and false-alarm rates.
"""

from collections.abc import Callable, Iterator

import numpy as np
from test_across_frames import EIGHT, FILM_MM, FOUR, PX_PER_MM, SIGMA_PX, make_frames, make_layout, shift_mark, weak

from benchmarks.harness import Row
from measure.fiducials.across_frames import CheckedFrames, check_frames
from measure.marks.shapes import FiducialLayout
from measure.results import FrameMeasurement

PITCH_UM = 1000 / PX_PER_MM
POSES = ("0", "90", "180", "270m")
TEN_SIGMAS_PX = 10 * float(np.hypot(SIGMA_PX, FILM_MM * PX_PER_MM))
COUNTS = (1, 2, 3, 6, 12)
Frames = list[FrameMeasurement]
Made = Callable[[FiducialLayout, int, np.random.Generator], tuple[Frames, str]]


COLUMNS = {"kind": "", **{f"{count} frames": "" for count in COUNTS}}


def cells(cameras: int = 100) -> Iterator[Row]:
    yield from ({"kind": kind[0], "cameras": cameras} for kind in kinds())


def case(kind: str, cameras: int, seed: int) -> Row:
    """Numbers of cameras with the correct outcome, and with a false one: a good mark weak, another frame or cause
    named."""
    _, places, sigma_mm, made = next(each for each in kinds() if each[0] == kind)
    rng, row = np.random.default_rng(seed), {}
    for count in COUNTS:
        outcomes = [outcome(made, make_layout(places, sigma_mm), count, rng) for _ in range(cameras)]
        row[f"{count} frames"] = f"{sum(right for right, _ in outcomes)}/{sum(wrong for _, wrong in outcomes)}"
    return row


def kinds() -> list[tuple[str, list[tuple[float, float]], float, Made]]:
    """Kinds of cameras: fault, marks, standard deviation of their coordinates, and function that makes the frames."""
    return [
        ("four marks, given to 5 um, film 3 um", FOUR, 0.005, good),
        ("eight marks, given to 5 um, film 3 um", EIGHT, 0.005, good),
        ("eight marks, given to 5 um, film 10 um", EIGHT, 0.005, scattering),
        ("eight marks of unknown places, film 3 um", EIGHT, 1.0, good),
        ("eight: a mark 10 sigmas off, places unknown", EIGHT, 1.0, one_mark(TEN_SIGMAS_PX)),
        ("eight: a mark 0.05 mm off", EIGHT, 0.005, one_mark(0.05 * PX_PER_MM)),
        ("eight: a frame's film bent by 0.03 mm", EIGHT, 0.005, bent),
        ("four: a frame's film bent by 0.1 mm", FOUR, 0.005, strongly_bent),
        ("four: given coordinates wrong by 0.4 mm", FOUR, 0.005, wrong_places),
        ("eight: given coordinates wrong by 0.05 mm", EIGHT, 0.005, slightly_wrong_places),
        ("eight: a scanner that bends by 0.05 mm, four poses", EIGHT, 0.005, scanner),
    ]


def outcome(made: Made, layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[bool, bool]:
    """Whether exactly the fault is named, and whether anything else is."""
    frames, expected = made(layout, count, rng)
    result = check_frames(frames, layout, [(PITCH_UM, PITCH_UM)] * count)
    named = causes(result)
    if count == 1 and expected not in ("", "mark"):
        expected = "frame"  # a single frame does not allow to separate the causes
    return named == {expected} - {""}, bool(named - {expected})


def causes(result: CheckedFrames) -> set[str]:
    """Causes named in the result; the first frame is the one with a fault."""
    found = {"mark" if where == ("0", "2") else "another mark" for where in weak(result.frames)}
    for number, frame in enumerate(result.frames):
        for problem in frame.problems:
            if "no affine" in problem:
                found.add("another frame" if number else "frame")
            else:
                found.add("scanner" if "scanner's axes" in problem else "places")
    return found


def good(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return make_frames(layout, count, rng, camera_mm=0.005, poses=POSES), ""


def scattering(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return make_frames(layout, count, rng, camera_mm=0.005, film_mm=0.01, poses=POSES), ""


def one_mark(off_px: float) -> Made:
    def make_frames_and_fault(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
        frames, angle = good(layout, count, rng)[0], rng.uniform(0, 2 * np.pi)
        frames[0] = shift_mark(frames[0], 2, (off_px * np.cos(angle), off_px * np.sin(angle)))
        return frames, "mark"

    return make_frames_and_fault


def bent(layout: FiducialLayout, count: int, rng: np.random.Generator, film_mm: float = 0.03) -> tuple[Frames, str]:
    frames = good(layout, count, rng)[0]
    frames[0] = make_frames(layout, 1, rng, film_mm=film_mm)[0]
    return frames, "frame"


def strongly_bent(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return bent(layout, count, rng, 0.1)


def wrong_places(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return make_frames(layout, count, rng, camera_mm=0.4, poses=POSES), "places"


def slightly_wrong_places(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return make_frames(layout, count, rng, camera_mm=0.05, poses=POSES), "places"


def scanner(layout: FiducialLayout, count: int, rng: np.random.Generator) -> tuple[Frames, str]:
    return make_frames(layout, count, rng, camera_mm=0.005, scanner_mm=0.05, poses=POSES), "scanner"
