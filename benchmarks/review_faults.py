"""Review of forty frames with twenty planted faults, by keyboard in a real browser.

Do the decisions lead to correct marks? Do only the rows change that were decided on? How many keys and how much time
does it take?

The reviewer is simulated: it accepts a mark measured at its true place, places a mark that is visible elsewhere,
rejects a measurement where no mark is visible, and otherwise states that the mark is absent. The true values are those
of the renderer. --folder: where the project is kept for inspection. Requires Chromium.
"""

import csv
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from playwright.sync_api import Page

from benchmarks.harness import Row, reseau
from benchmarks.review_load import served_page
from measure.geometry import POSES
from synthetic_images import areas, scene
from synthetic_images.render import render_scene

Array = NDArray[np.float64]
Marks = Mapping[tuple[str, str], Mapping[str, str]]

FRAMES = 40
PITCH_UM, PX_PER_MM = 50.0, 20.0
CORNERS = ((6.0, -6.0), (-6.0, -6.0), (-6.0, 6.0), (6.0, 6.0))
PLACES = dict(enumerate((*CORNERS, (6.0, 0.0), (0.0, -6.0), (-6.0, 0.0), (0.0, 6.0)), 1))
OFF_MM = (0.18, 0.1)  # mm, offset of a false mark from the hidden true one
ASKEW_RAD = 0.35  # rotation of a frame outside the search range
SEEN_PX = 1.5  # px, offset of a cross from its mark that a reviewer notices
RIGHT_PX = 0.5  # px, tolerance of a measured mark
ROUNDS = 4  # largest number of rounds of review and measurement

RING, BARS = (
    areas.ring((0.0, 0.0), 0.5, 0.1),
    (areas.bar((-0.8, 0), (0.8, 0), 0.1), areas.bar((0, -0.8), (0, 0.8), 0.1)),
)
DOTS = {1: ((1.05, -0.3), (1.05, 0.3)), 2: ((1.05, 0.3),)}  # mm, dots next to these marks, which determine the pose
DOT_MM = 0.12
SHAPES = (
    'shape = "ring"\ncenter_mm = [0, 0]\nradius_mm = 0.5\nline_mm = 0.1\n',
    'shape = "bar"\nfrom_mm = [-0.8, 0]\nto_mm = [0.8, 0]\nline_mm = 0.1\n',
    'shape = "bar"\nfrom_mm = [0, -0.8]\nto_mm = [0, 0.8]\nline_mm = 0.1\n',
)
CAMERA = (
    'name = "K"\nframe_mm = [16.0, 16.0]\nprincipal_distance_mm = 30.0\n'
    + "".join(
        f'[[fiducial]]\nid = "{n}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.01\nmark = "m{n if n in DOTS else 0}"\n'
        for n, (x, y) in PLACES.items()
    )
    + "".join(
        f'[mark.m{n}]\nkind = "parts"\n'
        + "".join(f"[[mark.m{n}.part]]\n{shape}" for shape in SHAPES)
        + "".join(
            f'[[mark.m{n}.part]]\nshape = "disk"\ncenter_mm = [{x}, {y}]\nradius_mm = {DOT_MM}\n'
            for x, y in DOTS.get(n, ())
        )
        for n in (0, *DOTS)
    )
)
PROJECT = f'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = {PITCH_UM}\n'


@dataclass(frozen=True)
class Fault:
    """Fault of a frame. mark: number of the mark concerned, 0 for none."""

    kind: str
    pose: str = "0"
    mark: int = 0
    turn_rad: float = 0.004


FAULTS = (
    Fault("pose hidden", "90"), Fault("pose hidden", "180m"), Fault("pose hidden", "0"),
    Fault("not found", turn_rad=ASKEW_RAD), Fault("not found", "90m", turn_rad=-ASKEW_RAD),
    Fault("hidden", mark=2), Fault("hidden", mark=5), Fault("hidden", "270", mark=3),
    Fault("false mark", mark=4), Fault("false mark", mark=7),
    Fault("stamp", mark=3), Fault("stamp", mark=6), Fault("stamp", mark=8),
    Fault("missing", mark=2), Fault("missing", mark=8),
    Fault("turned", "90"), Fault("mirrored", "180m"), Fault("mirrored", "0m"),
    Fault("doubtful", mark=4), Fault("doubtful", mark=5),
)  # fmt: skip


@dataclass(frozen=True)
class PlantedTruth:
    """True values of a frame. px: place of each mark by name; visible: names of the visible marks."""

    pose: str
    px: Mapping[str, Array]
    visible: frozenset[str]


@dataclass
class BrowserSession:
    """Statistics of a review. marks: number of decisions on marks; keys_of_marks: keys pressed for them."""

    keys: int = 0
    marks: int = 0
    keys_of_marks: int = 0
    clock_s: float = 0.0
    decisions: Counter[str] = field(default_factory=Counter)


def case(seed: int, folder: Path | None = None) -> Row:
    """Counts of a review, and the marks that are wrong or changed without a decision afterwards."""
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        folder = Path(place)
        folder.mkdir(parents=True, exist_ok=True)
        truths = planted(folder, np.random.default_rng(seed))
        project, session = folder / "project.toml", BrowserSession()
        reseau("measure", project)
        before = rows(folder)
        for _ in range(ROUNDS):
            if reviewed(project, truths, session) == 0:
                break
            reseau("measure", project)
        after, made = rows(folder), decisions(folder)
    expected = {(one["image"], one["point"]) for one in made if one.get("point")}
    whole = {one["image"] for one in made if one["decision"] == "pose"}
    whole |= {image for image, truth in truths.items() if sum(key[0] == image for key in expected) >= 3}
    expected |= {key for key in before if key[0] in whole}
    changed = {key for key in before if before[key] != after[key]}
    wrong_before, wrong = ([key for key in each if not is_right(each[key], truths[key[0]])] for each in (before, after))
    return {
        "decided": dict(session.decisions), "keys": session.keys, "clock_s": session.clock_s, "marks": session.marks,
        "keys_of_marks": session.keys_of_marks, "right_before": len(before) - len(wrong_before),
        "right": len(after) - len(wrong), "changed": len(changed), "decided_about": len(changed & expected),
        "wrong": [f"{key}: {after[key]['status']}: {after[key]['reason']}" for key in wrong],
        "changed_undecided": [f"{key}: {before[key]} -> {after[key]}" for key in sorted(changed - expected)],
    }  # fmt: skip


def report(rows: Sequence[Row]) -> Iterator[str]:
    for row in rows:
        yield from (f"{name}: {value}" for name, value in row.items())


def is_right(row: Mapping[str, str], truth: PlantedTruth) -> bool:
    """Whether a visible mark is measured at its place, or an invisible one is not an observation."""
    is_observation = row["status"] in ("measured", "weak")
    if row["point"] not in truth.visible or not is_observation:
        return is_observation == (row["point"] in truth.visible)
    off_px = float(np.hypot(*(np.array([float(row["col_px"]), float(row["row_px"])]) - truth.px[row["point"]])))
    sigma_px = 1000.0 / PITCH_UM * max(float(row["sx_mm"]), float(row["sy_mm"]))
    return off_px < (RIGHT_PX if row["status"] == "measured" else max(RIGHT_PX, 4 * sigma_px))


# --- the frames


def planted(folder: Path, rng: np.random.Generator) -> dict[str, PlantedTruth]:
    """Render the project with faults in random frames; returns the true values."""
    at = dict(zip(rng.permutation(FRAMES)[: len(FAULTS)].tolist(), FAULTS, strict=True))
    faults = {f"f{k:02}": at.get(k, Fault("none", turn_rad=float(rng.uniform(-0.01, 0.01)))) for k in range(FRAMES)}
    images = tuple(
        scene.SceneImage(
            name, (40.0 * k, 10.0 * k, 100.0, 0.0, 0.0, 0.5 * k), pose=fault.pose, turn_rad=fault.turn_rad,
            covered=(str(fault.mark),) if fault.kind == "hidden" else (),
        )
        for k, (name, fault) in enumerate(faults.items())
    )  # fmt: skip
    fiducials = tuple(
        scene.SceneFiducial(
            str(n), xy, scene.DrawnMark((RING, *BARS, *(areas.disk(dot, DOT_MM) for dot in DOTS.get(n, ()))))
        )
        for n, xy in PLACES.items()
    )
    camera = scene.SceneCamera("K", (16.0, 16.0), 30.0, fiducials=fiducials)
    scanner = scene.SceneScanner((PITCH_UM, PITCH_UM), margin_mm=3.5, noise=0.004)
    field_ = scene.DiskField((), 1.0)
    made = scene.Scene("faults", 3, camera, field_, images, scanner, background="terrain", pad_mm=1.6)
    render_scene(made, folder)
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    (folder / "project.toml").write_text(PROJECT, encoding="utf-8")
    for left in ("images.csv", "points.csv"):
        (folder / left).unlink(missing_ok=True)
    summary = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["images"]
    truths = {}
    for name, fault in faults.items():
        px = {id: np.array([one["col_px"], one["row_px"]]) for id, one in summary[name]["fiducials"].items()}
        plant(folder / "scans" / f"{name}.tif", fault, px, rng)
        gone = {str(fault.mark)} if fault.kind in ("hidden", "false mark", "missing") else set()
        truths[name] = PlantedTruth(fault.pose, px, frozenset(px.keys() - gone))
    return truths


def plant(path: Path, fault: Fault, px: Mapping[str, Array], rng: np.random.Generator) -> None:
    """Paint a fault into a scan."""
    grey = tifffile.imread(path).astype(np.float64)
    design = np.column_stack([np.array(list(PLACES.values())), np.ones(len(PLACES))])
    matrix = np.linalg.lstsq(design, np.array([px[str(n)] for n in PLACES]), rcond=None)[0].T
    mark = fault.mark or next(iter(DOTS))
    around = matrix @ (*(PLACES[mark] + np.array([0.0, 1.3])), 1.0)  # its pad
    dark = float(np.median(grey[tuple(slice(round(v) - 2, round(v) + 3) for v in around[::-1])]))
    light = float(grey.max())

    def paint(value: float, *drawn: areas.Area, off: tuple[float, float] = (0.0, 0.0), at: int = mark) -> None:
        place = np.array(PLACES[at]) + off
        in_px = tuple(tuple((o + place) @ matrix[:, :2].T + matrix[:, 2] for o in area) for area in drawn)
        col0, row0, width, height = areas.bounds(in_px)
        share = np.abs(areas.coverage(in_px, col0, row0, width, height))
        own = grey[row0 : row0 + height, col0 : col0 + width]
        own += share * (value + rng.normal(0, 0.004 * 65535, own.shape) - own)

    match fault.kind:
        case "pose hidden":
            for each in DOTS:
                paint(dark, areas.polygon(((0.86, -0.5), (1.3, -0.5), (1.3, 0.5), (0.86, 0.5))), at=each)
        case "missing":
            paint(dark, areas.disk((0.0, 0.0), 1.3))
        case "false mark":
            paint(dark, areas.disk((0.0, 0.0), 1.3))
            paint(light, RING, off=OFF_MM)
            paint(light, *BARS, off=OFF_MM)
        case "stamp":
            for k in range(3):
                paint(light, areas.bar((-1.2, 0.25 + 0.35 * k), (1.2, 0.45 + 0.35 * k), 0.15))
        case "doubtful":
            paint(light, areas.bar((0.12, -1.4), (0.3, 1.4), 0.16))
    tifffile.imwrite(path, np.clip(np.rint(grey), 0, 65535).astype(np.uint16))


# --- the reviewer


def reviewed(project: Path, truths: Mapping[str, PlantedTruth], session: BrowserSession) -> int:
    """Answer all questions of the queue; returns the number of answers."""
    with served_page(project) as (page, address, _):
        page.goto(address)
        page.wait_for_function("document.getElementById('left').textContent !== '…'")
        began, answers = time.monotonic(), 0
        while (left := page.inner_text("#left"))[0].isdigit():
            Person(page, truths, session).answers()
            page.wait_for_function("left => document.getElementById('left').textContent !== left", arg=left)
            answers += 1
        session.clock_s += time.monotonic() - began
    return answers


@dataclass
class Person:
    """Simulated reviewer with a keyboard, who knows the true places of the marks."""

    page: Page
    truths: Mapping[str, PlantedTruth]
    session: BrowserSession

    def answers(self) -> None:
        self.page.wait_for_function(_READY)
        image, _, requests = self.page.inner_text("#title").partition(": ")
        truth = self.truths[image.split(" and ")[0]]
        if requests == "scan orientation":
            self.press(str(POSES.index(truth.pose) + 1), "pose")
        elif requests == "no mark was found":
            self.shows_frame(truth)
        else:
            before = self.session.keys
            self.judges(requests.split()[-1], truth)
            self.session.marks += 1
            self.session.keys_of_marks += self.session.keys - before

    def judges(self, point: str, truth: PlantedTruth) -> None:
        measured, place = self.page.evaluate(_SHOWN), truth.px[point]
        if measured and point in truth.visible and np.hypot(*(np.array(measured) - place)) < SEEN_PX:
            self.press("a", "accept")
        elif point in truth.visible:
            self.steers("mark", place)
            self.press("Enter", "place")
        else:
            self.press("n" if self.page.is_disabled("#reject") else "r", "reject or not there")

    def shows_frame(self, truth: PlantedTruth) -> None:
        for number in ("1", "2", "4"):
            self.press(number)
            for view in ("whole", "near"):
                self.page.wait_for_selector(f"#{view}:focus")
                self.steers(view, truth.px[number])
                self.press("Enter")
        self.press("m")
        self.page.wait_for_selector("#keep:focus", timeout=120_000)
        self.press("Enter", "frame")

    def steers(self, view: str, place_px: Array) -> None:
        """Move the cursor to a place by arrow keys, to the nearest step."""
        self.press("ArrowRight")
        first = self.cursor(view)
        self.press("ArrowRight")
        step = self.cursor(view)[0] - first[0]
        for axis, (less, more) in enumerate((("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))):
            left = float((place_px - self.cursor(view))[axis])
            for _ in range(round(abs(left) / step)):
                self.press(more if left > 0 else less)

    def cursor(self, view: str) -> Array:
        return np.array(json.loads(self.page.get_attribute(f"#{view}", "data-cursor") or "null"), dtype=float)

    def press(self, key: str, decision: str = "") -> None:
        self.page.keyboard.press(key)
        self.session.keys += 1
        if decision:
            self.session.decisions[decision] += 1


_READY = """() => {
  const shown = (id) => !document.getElementById(id).hidden;
  if (shown('mark-view')) return document.activeElement.id === 'mark';
  return shown('whole-view') && (shown('pose-view') || document.activeElement.id === 'whole');
}"""

# Measured place of the mark as shown on the page.
_SHOWN = """() => {
  const terms = [...document.querySelectorAll('#facts dt')];
  const place = terms.find((term) => term.textContent === 'column, row')?.nextElementSibling.textContent;
  return place ? place.split(', ').map(Number) : null;
}"""


# --- files


def rows(folder: Path) -> Marks:
    lines = (folder / "comparator.csv").read_text(encoding="utf-8").splitlines()
    table = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {(row["image"], row["point"]): row for row in table}


def decisions(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "decisions.jsonl").read_text(encoding="utf-8").splitlines()]
