"""Notches, blocks, curves and triangles of real cameras: templates learned, found in any pose and measured.

A folder of four crops (L, T, R, B) within --marks is one camera. Frames are composed from them: each crop at its side
of a textured square, its background (above Otsu's threshold) replaced by another, averaged over a few pixels with a
different offset in each frame, so that the marks shift by known fractions of a pixel. Templates are learned from three
frames, then a fourth is measured with unknown pose: in all eight poses in turn, with backgrounds as light as in the
learned frames or not, and with the origins of the marks at the centres of the crops or off them.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Row
from benchmarks.search import OUTCOMES, POSE_OUTCOMES, counts, judge_case
from benchmarks.search_frames import SearchCase
from measure.geometry import POSES, UP_FROM_CAMERA
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.marks.templates import cut, learn_template
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Crops = dict[str, NDArray[np.uint8]]

SIDES = {"L": (-1, 0), "T": (0, 1), "R": (1, 0), "B": (0, -1)}
SIZE_PX, REACH_PX, PITCH_MM = 820, 280, 0.1
REDUCED_PX = 160  # px, approximate longer side of a reduced crop
NOISE_DN = 1.5
MIDDLE_PX = (SIZE_PX - 1) / 2
FLIP = np.diag([1.0, -1.0])
# Grey values of the background, in the learned frames and in the measured one, used in turn.
LANDSCAPES_DN = ((150, 150), (245, 245), (200, 200), (150, 200), (200, 245), (150, 245), (245, 220), (100, 60))
OFF_PX = (0, 5)  # px, offsets of the origins from the crops' centres, used in turn


def cells(marks: Path, frames: int = 8, first: int = 0) -> Iterator[Row]:
    for frame in range(first, first + frames):
        yield from (
            {"marks": marks, "camera": name, "frame": frame, "turn": frame + number}
            for number, name in enumerate(find_cameras(marks))
        )


def case(marks: Path, camera: str, frame: int, turn: int) -> Row:
    return {**judge_case(draw_case(marks / camera, frame, turn)), "kind": camera}


def find_cameras(marks: Path) -> list[str]:
    """Folders with four crops, relative to marks."""
    folders = sorted({path.parent for path in marks.rglob("*.*")})
    return [str(each.relative_to(marks)) for each in folders if set(SIDES) <= {path.stem for path in each.iterdir()}]


def draw_case(camera: Path, index: int, turn: int) -> SearchCase:
    """Make frame number index of a camera. turn: selects pose and background, differently for each camera."""
    learned_dn, view_dn = LANDSCAPES_DN[turn % len(LANDSCAPES_DN)]
    round_, pose = index // len(LANDSCAPES_DN), POSES[(3 * index + turn) % len(POSES)]
    grey, places = composed(cut_crops(camera), np.random.default_rng([index, 1]), view_dn)
    up, origins = UP_FROM_CAMERA[pose], origins_px(round_)
    centers = {side: FLIP @ up @ FLIP @ (places[side] + origins[side] - MIDDLE_PX) + MIDDLE_PX for side in SIDES}
    return SearchCase(
        kind=camera.name,
        symmetry="different marks",
        picture=f"{learned_dn}, seen beside {view_dn}",
        layout=learned_layout(camera, learned_dn, round_),
        pose=pose,
        pitch_um=1000 * PITCH_MM,
        scan=make_scan("measured", posed(grey, pose)),
        centers_px=centers,
        hidden=frozenset(),
        without_marks=lambda: landscape(np.random.default_rng([index, 2]), (SIZE_PX, SIZE_PX), view_dn),
    )


@cache
def cut_crops(camera: Path) -> Crops:
    return {path.stem: np.asarray(cv2.imread(str(path), 0), np.uint8) for path in camera.iterdir()}


def origins_px(round_: int) -> dict[str, Array]:
    """Offsets (right, down) of the marks' origins from the crops' centres."""
    off = np.random.default_rng([round_, 0]).integers(-1, 2, (len(SIDES), 2)) * OFF_PX[round_ % len(OFF_PX)]
    return dict(zip(SIDES, off.astype(float), strict=True))


@cache
def learned_layout(camera: Path, learned_dn: float, round_: int) -> FiducialLayout:
    """Layout of the camera's marks with templates learned from three frames."""
    crops, origins, marks = cut_crops(camera), origins_px(round_), []
    frames = [composed(crops, np.random.default_rng([round_, 3, seed]), learned_dn) for seed in range(3)]
    scans = [(make_scan(f"learned {number}", grey), places) for number, (grey, places) in enumerate(frames)]
    for side, direction in SIDES.items():
        spare_px = 8 + 2 * float(np.abs(origins[side]).max())
        size_mm = PITCH_MM * (min(crops[side].shape) / fold(crops[side]) - spare_px)
        placed = [(scan, np.column_stack([FLIP / PITCH_MM, places[side] + origins[side]])) for scan, places in scans]
        template = learn_template([cut(scan, place, size_mm) for scan, place in placed], size_mm)
        x, y = PITCH_MM * (REACH_PX * np.array(direction) + FLIP @ origins[side])
        marks.append(LayoutMark(side, (float(x), float(y)), (0.05, 0.05), template))
    return FiducialLayout(tuple(marks), (SIZE_PX * PITCH_MM,) * 2)


def composed(crops: Crops, rng: np.random.Generator, level_dn: float) -> tuple[NDArray[np.uint8], dict[str, Array]]:
    """Compose a frame with a background of that grey value; returns it and the places (col, row) of the crops'
    centres."""
    grey, places = landscape(rng, (SIZE_PX, SIZE_PX), level_dn), {}
    for side, (x, y) in SIDES.items():
        fine, step = crops[side], fold(crops[side])
        first = rng.integers(step, size=2)  # row and column of the first fine pixel averaged
        rows, cols = ((np.array(fine.shape) - first) // step).tolist()
        part = relandscaped(fine, rng, level_dn)[first[0] : first[0] + rows * step, first[1] : first[1] + cols * step]
        part = part.reshape(rows, step, cols, step).mean(axis=(1, 3))
        top, left = (SIZE_PX // 2 + REACH_PX * np.array([-y, x]) - np.array(fine.shape) // step // 2).tolist()
        grey[top : top + rows, left : left + cols] = part
        middle = np.array(fine.shape) // 2
        places[side] = np.array([left, top]) + ((middle - first + 0.5) / step - 0.5)[::-1]
    grey += rng.normal(0.0, NOISE_DN, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), places


def relandscaped(fine: NDArray[np.uint8], rng: np.random.Generator, level_dn: float) -> Array:
    """Replace the background of a crop, where it is light, with a soft edge."""
    _, light = cv2.threshold(fine, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    share = cv2.GaussianBlur(light.astype(np.float64), (0, 0), 1.5)
    dark = np.where(light > 0, np.median(fine[light == 0]), fine)
    return np.asarray(share * landscape(rng, fine.shape, level_dn) + (1 - share) * dark)


def landscape(rng: np.random.Generator, shape: tuple[int, ...], level_dn: float) -> Array:
    coarse, medium = (cv2.GaussianBlur(rng.normal(0.0, 1.0, shape), (0, 0), blur) * blur for blur in (12.0, 3.0))
    return np.asarray(level_dn + 40.0 * coarse + 25.0 * medium)


def fold(fine: NDArray[np.uint8]) -> int:
    return max(1, int(max(fine.shape)) // REDUCED_PX)


def posed(grey: NDArray[np.uint8], pose: str) -> NDArray[np.uint8]:
    """Rotate and mirror the frame to a scan orientation (pose)."""
    mirrored = grey[:, ::-1] if pose.endswith("m") else grey
    return np.ascontiguousarray(np.rot90(mirrored, int(pose.removesuffix("m")) // 90))


def make_scan(name: str, grey: NDArray[np.uint8]) -> Scan:
    return Scan(Path(name), WholePicture(grey[..., None]), NO_TAGS)


def report(rows: Sequence[Row]) -> Iterator[str]:
    cameras, pictures = (sorted({row[key] for row in rows}) for key in ("kind", "picture"))
    yield from counts("kind", cameras, "pose", POSE_OUTCOMES, rows)
    yield from counts("picture", pictures, "pose", POSE_OUTCOMES, rows)
    yield from counts("kind", cameras, "outcome", OUTCOMES, rows)
    for key in ("pose", "outcome"):
        yield f"frames with a wrong {key}: {[(row['kind'], row['frame']) for row in rows if row[key] == 'WRONG']}"
