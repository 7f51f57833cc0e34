"""Projects that tests make: drawn, simulated, exported, damaged; scans and records that nobody has measured."""

import hashlib
import json
import math
import random
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import tifffile
from drawn import ALIKE, CORNERS, PITCH_UM, frame_picture, pixel_from_camera
from networks import Truth, affine, camera_point, rotation, simulated, torlegard
from numpy.typing import NDArray

from adjust import Network, Prior
from measure import FiducialLayout
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from pipeline.archive.checked_results import CheckedResult, find_check_run, store_checks
from pipeline.archive.results_database import Kept, ResultsDatabase
from pipeline.cli import DONE, LOOK, run
from pipeline.files.project_file import Project
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.provenance import FileIdentity, FileState, file_state, parts_hash
from pipeline.results.comparator_file import ComparatorPoint, read_measurement_hash
from pipeline.results.measured_record import Failure, FailureCode, MeasuredScan, mark_row, scan_detail

Capture = pytest.CaptureFixture[str]
Refusal = Callable[..., str]
Printed = Callable[..., str]
Spoil = Callable[[Path], object]


T = TypeVar("T")


def present(value: T | None) -> T:
    """The value, which is there."""
    assert value is not None
    return value


def command(*arguments: object) -> int:
    """The exit code of a command."""
    return run([*map(str, arguments)])


def fiducial_tables(places: Mapping[str, Iterable[float]], more: str = "", table: str = "fiducial") -> str:
    """Tables of fiducials at these places, for a camera's or a scene's file; more: further lines of each."""
    return "".join(f'[[{table}]]\nid = "{id}"\nxy_mm = {[*map(float, place)]}\n{more}' for id, place in places.items())


def write_tables(folder: Path, project: str, **tables: str | Sequence[str]) -> Path:
    """project.toml, and camera.toml and tables by their names, each as text or lines; the path of the first."""
    for name, text in {"project": project, **tables}.items():
        ending = "toml" if name in ("project", "camera") else "csv"
        lines = [text] if isinstance(text, str) else text
        (folder / f"{name}.{ending}").write_text("\n".join(lines) + "\n")
    return folder / "project.toml"


PLACES = dict(zip("1234", CORNERS, strict=True))
CAMERA = (
    'name = "K"\nframe_mm = [17.0, 17.0]\nprincipal_distance_mm = 30.0\n'
    + fiducial_tables(PLACES, 'sigma_mm = 0.01\nmark = "m"\n')
    + '[mark.m]\nkind = "ring-cross"\nring_mm = 0.5\nring_line_mm = 0.1\narm_mm = 0.8\nline_mm = 0.1\n'
)
PROJECT = f'camera = "camera.toml"\nscans = ["*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\ntone = "linear"\n'


def write_project(folder: Path, names: Sequence[str], project: str = PROJECT, layout: FiducialLayout = ALIKE) -> Path:
    """project.toml with its camera and its scans, which show that layout; the frames differ in noise and turn."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.toml").write_text(CAMERA)
    for seed, name in enumerate(names, 1):
        grey = frame_picture(layout, pixel_from_camera("0", 0.004 * seed), seed)
        tifffile.imwrite(folder / f"{name}.tif", np.clip(np.rint(grey), 0, 65535).astype(np.uint16))
    (folder / "project.toml").write_text(project)
    return folder / "project.toml"


def write_network_project(network: Network, folder: Path, frame_mm: str = "frame_mm = [228.0, 228.0]") -> Path:
    """camera.toml, points.csv, comparator.csv and project.toml; the path of the last."""
    camera, points, observed = network.cameras[0], network.points, network.observations
    c, x0, y0 = map(present, (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm))
    parameters = camera.distortion.parameters
    lines = [
        f'name = "{camera.name}"',
        frame_mm,
        f"principal_distance_mm = {c.value!r}",
        f"principal_point_mm = [{x0.value!r}, {y0.value!r}]",
        "[sigma]",
        f"principal_distance_mm = {sigma(c)}",
        f"principal_point_mm = [{sigma(x0)}, {sigma(y0)}]",
        "[distortion]",
        f'family = "{camera.distortion.family}"',
        f"r0_dm = {camera.distortion.r0_mm / 100.0!r}"
        if camera.distortion.family == "juhl"
        else f"r0_mm = {camera.distortion.r0_mm!r}",
        *(['decentering = "paper"'] if camera.distortion.decentering == "paper" else []),
        "[distortion.value]",
        *(f"{name} = {prior.value!r}" for name, prior in parameters.items()),
        "[distortion.sigma]",
        *(f"{name} = {sigma(prior)}" for name, prior in parameters.items()),
    ]
    for id, mark in camera.fiducials.items():
        x, y = mark.x_mm, mark.y_mm
        lines += ["[[fiducial]]", f'id = "{id}"', f"xy_mm = [{x.value!r}, {y.value!r}]"]
        lines.append(f"sigma_mm = [{sigma(x)}, {sigma(y)}]")
    given = ["point,X,Y,Z,sX,sY,sZ"]
    for point in points:
        axes = [axis for axis in (point.X, point.Y, point.Z) if axis is not None]
        given.append(",".join([point.id, *(repr(a.value) for a in axes), *(bare(a.sigma) for a in axes)]))
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for i, (x_mm, y_mm) in enumerate(observed.xy_mm.tolist()):
        sx, sy = np.sqrt(np.diag(observed.covariance_mm2[i])).tolist()
        rows.append(f"{observed.image[i]},{observed.point[i]},{observed.kind[i]},{x_mm!r},{y_mm!r},{sx!r},{sy!r}")
    film = f'[adjust]\ntransformation = "{network.images[0].transformation}"'
    project = f'camera = "camera.toml"\n[object]\npoints = "points.csv"\n{film}'
    return write_tables(folder, project, camera=lines, points=given, comparator=rows)


def sigma(prior: Prior) -> str:
    return repr(prior.sigma) if np.isfinite(prior.sigma) else '"free"'


def bare(value: float) -> str:
    return repr(value) if np.isfinite(value) else ""


Array = NDArray[np.float64]

PITCH_MM = 0.1
SIZE_PX = 2500
IMAGES = range(4)
MIRRORED = 2
LENS = {"k3": 4e-8, "k5": -1e-12, "p1": 8e-8, "p2": -6e-8}
TRUTH = Truth(distortion=LENS, mirrored=(False, False, True, False), middle_mm=(125.0, -125.0))
POINTS = np.random.default_rng(8).uniform((-700.0, -700.0, -150.0), (700.0, 700.0, 150.0), (100, 3))


def adjusted_project(folder: Path, truth: Truth = TRUTH, crs: str = "", kind: str = "affine") -> Path:
    """project.toml of an adjusted project, with scans that have a size and nothing in them."""
    network, _ = simulated(np.random.default_rng(1), truth, kind, points=POINTS, noise=False)
    return make_project(network, folder, crs)


def make_project(network: Network, folder: Path, crs: str = "") -> Path:
    """The same of a network, whose frames may be in parts."""
    path = write_network_project(network, folder)
    text = path.read_text()
    more = f'crs = "{crs}"\n' if crs else ""
    if any(image.part_of for image in network.images):
        rows = "".join(f"{image.name},{image.part_of}\n" for image in network.images)
        (folder / "images.csv").write_text(f"image,part_of\n{rows}")
        more += 'images = "images.csv"\n'
    text = text.replace("[object]\n", f"[object]\n{more}")
    path.write_text(f'scans = ["scans/*.tif"]\npitch_um = {1000.0 * PITCH_MM}\n{text}')
    comparator = folder / "comparator.csv"
    marks = comparator.read_text()
    comparator.write_text(f"# comparator coordinates, reseau\n{marks}")
    (folder / "scans").mkdir()
    for image in network.images:
        (folder / "scans" / f"{image.name}.tif").write_bytes(empty_scan())
    assert command("adjust", path) in (DONE, LOOK)  # a network may show points beyond its frame
    return path


@cache
def empty_scan() -> bytes:
    file = BytesIO()
    tifffile.imwrite(file, np.zeros((SIZE_PX, SIZE_PX), np.uint8), compression="deflate")
    return file.getvalue()


def camera_mm(image: int, truth: Truth = TRUTH) -> Array:
    """Where the points (100, 2) are in the camera."""
    return camera_point(truth, image, POINTS)


def ideal_mm(image: int, truth: Truth = TRUTH) -> Array:
    """The same without the lens."""
    u, v, w = rotation(*truth.attitudes[image]) @ (POINTS - np.array(truth.stations[image])).T
    return np.column_stack([truth.x0 - truth.c * u / w, truth.y0 - truth.c * v / w])


def scan_px(image: int, places_mm: Array, truth: Truth = TRUTH) -> Array:
    """Columns and rows (n, 2) of camera places in the scan."""
    a1, a2, a3, b1, b2, b3 = affine(truth, image, "affine")
    comparator = np.linalg.solve(np.array([[a2, a3], [b2, b3]]), (places_mm - (a1, b1)).T).T
    return np.asarray(comparator * (1.0, -1.0) / PITCH_MM)


def frame_px(image: int, places_mm: Array, ideal: bool = False, truth: Truth = TRUTH) -> Array:
    """Columns and rows (n, 2) of camera places in the resampled frame: its pixels lie at whole multiples of the pitch,
    and it holds the whole outline of the scan."""
    side = np.linspace(-0.5, SIZE_PX - 0.5, 65)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(side, end), 1) for end in (side[0], side[-1])]
        + [np.stack(np.broadcast_arrays(end, side), 1) for end in (side[0], side[-1])]
    )
    x, y = (edge * (PITCH_MM, -PITCH_MM)).T
    a1, a2, a3, b1, b2, b3 = affine(truth, image, "affine")
    outline = np.column_stack([a1 + a2 * x + a3 * y, b1 + b2 * x + b3 * y])
    if ideal:
        outline = outline - np.column_stack(torlegard(truth, *outline.T))
    left = PITCH_MM * math.ceil(outline[:, 0].min() / PITCH_MM)
    top = PITCH_MM * math.floor(outline[:, 1].max() / PITCH_MM)
    return np.asarray((places_mm - (left, top)) * (1.0, -1.0) / PITCH_MM)


def stated_misfit_px(folder: Path) -> float:
    """The residual that the README tells."""
    text = (folder / "README.txt").read_text()
    return float(text[text.index("off by ") + 7 :].split()[0])


def result_file(folder: Path) -> dict[str, Any]:
    """What out/adjustment.json of a project's folder holds."""
    content: dict[str, Any] = json.loads((folder / "out" / "adjustment.json").read_text())
    return content


def replace_text(path: Path, old: str, new: str) -> None:
    """The first place of a file's text that reads so, otherwise."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def change_project(old: str, new: str) -> Spoil:
    """A change of the project file in a folder."""
    return lambda folder: replace_text(folder / "project.toml", old, new)


def change_camera(old: str, new: str) -> Spoil:
    return lambda folder: replace_text(folder / "camera.toml", old, new)


def copied(source: Path, folder: Path) -> Path:
    shutil.copytree(source, folder)
    return folder / "project.toml"


FOLDER = Path("/project")


def made_record(seed: int = 1, marks: int = 8, status: Status = Status.MEASURED, **changes: Any) -> MeasuredScan:
    """A frame of so many fiducials. changes: of the frame."""
    rng = random.Random(seed)
    matrix = np.array([[rng.uniform(40, 60), rng.gauss(0, 1), 2500.0], [rng.gauss(0, 1), -50.0, 2000.0]])
    own = tuple(mark(rng, str(number), status) for number in range(1, marks + 1))
    frame = FrameMeasurement(str(seed), own, ScanOrientation("90m", True, ("its number says so.",)), matrix)
    path, notes = str(FOLDER / f"scans/{seed}.tif"), ("Light was taken to grow as the grey value.",)
    return MeasuredScan(path, 5000, 4000, (20.0, 20.5), replace(frame, **changes), notes, seconds=0.5)


def mark(rng: random.Random, point: str, status: Status = Status.MEASURED) -> MarkMeasurement:
    noise = np.array([[rng.uniform(1e-4, 2e-4), 1e-5], [1e-5, rng.uniform(1e-4, 2e-4)]])
    film = np.array([[rng.uniform(1e-3, 2e-3), 0.0], [0.0, 1e-3]])
    covariance = Covariance({Cause.NOISE: noise, Cause.FILM: film})
    place = np.array([rng.uniform(0, 5000), rng.uniform(0, 4000)])
    quality = {"snr": rng.uniform(5, 50), "contrast_dn": np.nan, "blur_px": rng.uniform(1, 2)}
    reason = Reason() if status is Status.MEASURED else Reason("it is faint", Code.CONTRAST)
    return MarkMeasurement(point, "fiducial", place, covariance, status, reason, quality)


def changed(scan: MeasuredScan, numbers: Iterable[int], status: Status, reason: Reason) -> MeasuredScan:
    """The scan with another status of some marks."""
    marks = list(scan.frame.marks)
    for number in numbers:
        marks[number] = replace(marks[number], status=status, reason=reason)
    return replace(scan, frame=replace(scan.frame, marks=tuple(marks)))


def failed(seed: int = 1) -> MeasuredScan:
    sentence = f"scans/{seed}.tif is damaged or truncated"
    frame = made_record(seed, 2, Status.ABSENT, pose=None, pixel_from_camera=None).frame
    frame = replace(frame, problems=(Reason(sentence, Code.FAILED_SCAN),))
    return MeasuredScan.failed(str(FOLDER / f"scans/{seed}.tif"), frame, Failure(FailureCode.UNREADABLE, sentence))


def kept_result(seed: int = 1, options: str = "{}", mtime_ns: int = 1, scan: MeasuredScan | None = None) -> Kept:
    """A result of a scan of its own."""
    state = FileState(f"scans/{seed}.tif", 1000 + seed, mtime_ns)
    parts = hashlib.sha256(str(seed).encode()).hexdigest()
    return Kept(FileIdentity(state, parts), options, scan or made_record(seed), camera="camera.toml")


def content(scan: MeasuredScan) -> tuple[object, ...]:
    """All of a scan, by which it can be compared."""
    codes = [problem.code for problem in scan.frame.problems]
    return (scan.frame.image, scan_detail(scan, scan.scan), codes, *map(mark_row, scan.frame.marks))


def stored(database: ResultsDatabase, row: int, image: str = "1") -> tuple[object, ...]:
    """The content of a result of a store."""
    return content(database.scan(row, image, FOLDER))


def keep_scans(path: Path, scans: Sequence[MeasuredScan], made_from: Mapping[str, str] | None = None) -> str:
    """In the store at `path` of the project whose folder is above its own; the digest of their judging."""
    folder = path.parent.parent.resolve()
    with ResultsDatabase(path) as database:
        database.set_project_folder(folder)
        frames = []
        for scan in scans:
            identity = FileIdentity(file_state(Path(scan.scan), folder), parts_hash(Path(scan.scan)))
            row = database.keep(Kept(identity, "{}", scan), scan.frame.image)
            frames.append(CheckedResult(row, scan))
        return store_checks(database, made_from or {}, "kept", frames).digest


def comparator_points(
    frames: Iterable[FrameMeasurement], pitch_um: Mapping[str, tuple[float, float]]
) -> Iterator[ComparatorPoint]:
    """Marks of frames, as in comparator.csv."""
    for frame in sorted(frames, key=lambda frame: frame.image):
        mm_from_px = np.diag([1.0, -1.0] * np.array(pitch_um[frame.image])) / 1000.0
        for mark in frame.marks:
            xy_mm = None if mark.center_px is None else mm_from_px @ mark.center_px
            s_mm, rho = None, 0.0
            if mark.covariance_px2 is not None:
                (xx, xy), (_, yy) = mm_from_px @ mark.covariance_px2 @ mm_from_px
                s_mm, rho = np.sqrt([xx, yy]), float(xy / np.sqrt(xx * yy))
            yield ComparatorPoint(frame.image, mark.point, mark.kind, xy_mm, s_mm, rho, mark.status, str(mark.reason))


def scan_content(file: Path) -> bytes:
    """Of a result; of a store what it says of the marks that stand in comparator.csv, and not which page it stands on
    nor when it was measured; of thumbnails, which may be deleted, nothing."""
    if file.name.startswith("thumbnails"):
        return b""
    if file.suffix != ".db":
        return file.read_bytes()
    comparator = file.parents[1] / "comparator.csv"
    with ResultsDatabase(file) as database:
        check_run = find_check_run(database, read_measurement_hash(comparator)) if comparator.exists() else None
        scans = () if check_run is None else check_run.scans()
        kept = [[scan_detail(scan, ""), *map(mark_row, scan.frame.marks)] for scan in scans]
        return b"" if check_run is None else repr([check_run.digest, *kept]).encode()


def measure_scan(project: Project, name: str) -> MeasuredScan:
    (task,) = scan_tasks(project, [name])
    scan = measured_scan(task)
    assert not scan.failure
    return scan


# How much of the demonstration the tests render and run.
FRAMES = 3  # of its five: one upright, one turned, one mirrored; a run of all five is a study
FEWER_TARGETS = {  # over the same field
    "columns = 6\nrows = 5": "columns = 5\nrows = 4",
    "right = [0.58, 0.0, 0.0]\nup = [0.0, 0.58, 0.0]": "right = [0.72, 0.0, 0.0]\nup = [0.0, 0.77, 0.0]",
    "columns = 3\nrows = 3": "columns = 3\nrows = 2",
    "up = [0.0, 0.85, 0.0]": "up = [0.0, 1.7, 0.0]",
}
