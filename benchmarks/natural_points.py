"""Natural points on rendered terrain, against the truth of the same scene.

python -m benchmarks natural_points [PITCH_UM]

Three or four aerial frames crosswise, 1:10,000, one turned by 180 degrees and one mirrored. The truth of a point is the
ray through it in the frame that defines it, led to the terrain and projected into the other frames. A pitch of 80 um
makes frames of 3000 px, the default of 150 um of 1600 px.
"""

import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.flags import Status
from measure.results import MarkMeasurement
from measure.tie_points.features import TieFrame
from measure.tie_points.find_points import TieOptions, Ties, measure_ties
from synthetic_images.film import FrameGeometry
from synthetic_images.render import render_scene
from synthetic_images.scene import DiskField, Distortion, Film, Scanner, Scene, SceneCamera, SceneImage
from synthetic_images.terrain import transferred

Array = NDArray[np.float64]

Marks = dict[str, dict[str, MarkMeasurement]]

WRONG_PX = 0.5
DISTORTION = Distortion("torlegard", {"k3": 1e-8, "p1": 1e-7})
FRAME_MM = (228.0, 228.0)
IMAGES = (
    SceneImage("strip1-1", (-456.0, 3.0, 1536.0, 0.004, -0.005, 0.007)),
    SceneImage("strip1-2", (456.0, -5.0, 1530.0, -0.005, 0.002, -0.010), pose="180"),
    SceneImage("strip2-1", (-228.0, 6.0, 1533.0, 0.002, 0.007, 1.58), pose="90m"),
    SceneImage("strip2-2", (-228.0, 506.0, 1533.0, 0.004, 0.001, 1.57), pose="270"),
)


HEADING = (
    "condition            points in >= 3  images  rms an axis  a point  largest  beyond 0.5  real/claimed  weak"
    "  refused  CPU s"
)


@dataclass(frozen=True)
class Condition:
    """What a row of the table stands for. grain, noise: rms, shares of full scale; relief: rms in metres."""

    name: str
    frames: int = 3
    relief: float = 5.0
    grain: float = 0.012
    noise: float = 0.004


CONDITIONS = (
    Condition("flat", relief=0.0),
    Condition("hilly"),
    Condition("hilly, four frames", frames=4),
    Condition("mountains", relief=30.0),
    Condition("fine grain", grain=0.004, noise=0.002),
    Condition("coarse grain", grain=0.025, noise=0.008),
)


@dataclass(frozen=True, eq=False)
class Errors:
    """Of the places in frames that do not define them: errors_px (n, 2), their covariances (n, 2, 2), statuses."""

    errors_px: Array
    covariances_px2: Array
    statuses: tuple[Status, ...]

    def of(self, *statuses: Status) -> tuple[Array, Array]:
        rows = [status in statuses for status in self.statuses]
        return self.errors_px[rows], self.covariances_px2[rows]


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    pitch_um = float(sys.argv[1]) if len(sys.argv) > 1 else 150.0
    print(f"pitch {pitch_um:g} um, frames of {1000 * FRAME_MM[0] / pitch_um:.0f} px; errors in px of measured places")
    print(HEADING)
    for condition in CONDITIONS:
        with tempfile.TemporaryDirectory() as folder:
            print(row(condition, scene(condition, pitch_um), Path(folder)), flush=True)


def scene(condition: Condition, pitch_um: float) -> Scene:
    return Scene(
        name="natural",
        seed=3,
        camera=SceneCamera("wide-angle", FRAME_MM, 153.0, (0.02, -0.03), DISTORTION),
        field=DiskField((), 1.0),
        images=IMAGES[: condition.frames],
        scanner=Scanner((pitch_um, pitch_um), noise=condition.noise),
        film=Film(grain=condition.grain, grain_px=0.8, deformation_um=5.0),
        background="terrain",
        ground=30.0,
        relief=condition.relief,
    )


def row(condition: Condition, made: Scene, folder: Path) -> str:
    truth = render_scene(made, folder)
    return figures(condition.name, {frame.geometry.image.name: frame.geometry for frame in truth.frames}, folder)


def figures(name: str, geometry: dict[str, FrameGeometry], folder: Path) -> str:
    """A row of the table: natural points of the scans in a folder, measured and compared with the truth."""
    frames = [tie_frame(each, folder) for each in geometry.values()]
    begin = time.process_time()
    ties = measure_ties(frames, TieOptions(wanted=300))
    seconds = time.process_time() - begin
    errors = compared(ties, geometry)
    measured, covariances = errors.of(Status.MEASURED)
    squares = np.einsum("ni,nij,nj->n", measured, np.linalg.inv(covariances), measured)
    sights = Counter(mark.point for own in ties.marks.values() for mark in own if mark.status is Status.MEASURED)
    whole = [count for count in sights.values() if count >= 3]
    weak, refused = (sum(status is each for status in errors.statuses) for each in (Status.WEAK, Status.REJECTED))
    beyond = int((np.hypot(*measured.T) > WRONG_PX).sum())
    return (
        f"{name:20s} {len(sights):6d} {len(whole):8d} {np.mean(whole):7.2f} "
        f"{np.sqrt(np.mean(measured**2)):12.3f} {np.sqrt(2.0 * np.mean(measured**2)):8.3f} "
        f"{np.hypot(*measured.T).max():8.3f} {beyond:11d} "
        f"{np.sqrt(squares.mean() / 2):13.2f} {weak:5d} {refused:8d} {seconds:8.0f}"
    )


def tie_frame(geometry: FrameGeometry, folder: Path) -> TieFrame:
    """As fiducials without error would place the frame."""
    name = geometry.image.name
    pixel_from_camera = np.linalg.inv(geometry.camera_from_pixel)[:2].astype(np.float64)
    return TieFrame(name, folder / "scans" / f"{name}.tif", pixel_from_camera, FRAME_MM, np.zeros((0, 3)))


def compared(ties: Ties, geometry: dict[str, FrameGeometry]) -> Errors:
    """Every matched place in a frame against the place that the defining frame's terrain has there."""
    errors, covariances, statuses = [], [], []
    marks = {image: {mark.point: mark for mark in own} for image, own in ties.marks.items()}
    for image, own in marks.items():
        for name, mark in own.items():
            start = defining(name, marks)
            if mark.covariance_px2 is None or start in ("", image):
                continue
            reference = marks[start][name]
            corners = np.asarray(reference.center_px) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
            place, right, down = transferred(corners, geometry[start], geometry[image])
            linear = np.stack([right - place, down - place], axis=1)
            errors.append(np.asarray(mark.center_px) - place)
            covariances.append(mark.covariance_px2 + linear @ np.asarray(reference.covariance_px2) @ linear.T)
            statuses.append(mark.status)
    return Errors(np.array(errors), np.array(covariances), tuple(statuses))


def defining(name: str, marks: Marks) -> str:
    """The image whose place defines a point; "" where it was not matched."""
    return next((i for i, own in marks.items() if name in own and own[name].quality.get("reference")), "")


if __name__ == "__main__":
    main()
