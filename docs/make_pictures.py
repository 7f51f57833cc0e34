"""The pictures of the pages, taken with Chromium, and the figures of the demonstration that pages quote.

python docs/make_pictures.py FOLDER [report] [review] [learn] [draw]: all of them without a name. What they show is made
in the folder, and used again where it is there: `demo` by `reseau demo`, `archive` with the planted faults of
benchmarks/review_faults.py.
"""

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, PngImagePlugin
from playwright.sync_api import Page, expect

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browser import started_browser

from benchmarks import review_faults
from benchmarks.harness import reseau
from benchmarks.review_load import served_page
from pipeline.results.adjustment_file import read_adjustment

DOCS = Path(__file__).parent
FRAMES = 20  # of the archive: one with each fault
SETTLED_MS = 10_000  # until all images on the review page are there
COLOURS = 256
SMALL = {"width": 800, "height": 1250}
LARGE = {"width": 1300, "height": 1000}
LEARNED = "".join(
    f'[[fiducial]]\nid = "{n}"\nxy_mm = [{x}, {y}]\nmark = "m"\n' for n, (x, y) in review_faults.PLACES.items()
)


def report(folder: Path) -> None:
    """report.png, with the figures that it shows as a comment, and demo.json: these figures."""
    demo = folder / "demo"
    if not (demo / "out" / "report.html").exists():
        reseau("demo", demo)
    adjustment = read_adjustment(demo / "out" / "adjustment.json")
    (camera,) = adjustment.cameras.values()
    c = camera.principal_distance_mm
    figures = {"c_mm": c.value, "c_sigma_mm": c.sigma, "sigma0": adjustment.sigma0, "redundancy": adjustment.redundancy}
    (DOCS / "demo.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    with started_browser() as browser:
        page = browser.new_page(viewport={"width": 1300, "height": 1190})
        page.goto((demo / "out" / "report.html").as_uri())
        page.screenshot(path=DOCS / "report.png")
    comment = PngImagePlugin.PngInfo()
    comment.add_text("Comment", f"c {c.value:.4f}, sigma0 {adjustment.sigma0:.3f}")
    with Image.open(DOCS / "report.png") as picture:
        picture.load()
    picture.save(DOCS / "report.png", pnginfo=comment, optimize=True)


def archive(folder: Path) -> tuple[Path, Mapping[str, review_faults.PlantedTruth]]:
    """A project with a frame for each fault, not measured yet, and its true values."""
    review_faults.FRAMES = FRAMES
    truths = review_faults.planted(folder / "archive", np.random.default_rng(1))
    return folder / "archive" / "project.toml", truths


def box_of_scans(folder: Path) -> tuple[Path, Mapping[str, review_faults.PlantedTruth]]:
    """Four scans of the archive that show all marks, in a project without a camera."""
    project, truths = archive(folder)
    names = [_frame(truths, kind) for kind in ("turned", "mirrored", "pose hidden", "doubtful")]
    scans = folder / "box1" / "scans"
    scans.mkdir(parents=True)
    for name in names:
        shutil.copy(project.parent / "scans" / f"{name}.tif", scans)
    shutil.copy(project, scans.parent)
    return scans.parent / "project.toml", {name: truths[name] for name in names}


@contextmanager
def shown(project: Path, size: dict[str, int], scheme: Literal["light", "dark"]) -> Iterator[Page]:
    """The review page of a project."""
    with served_page(project) as (page, address, _):
        page.set_viewport_size({"width": size["width"], "height": size["height"]})
        page.emulate_media(color_scheme=scheme)
        page.goto(address)
        page.wait_for_function("document.getElementById('left').textContent !== '…'")
        yield page


def review(folder: Path) -> None:
    """review-pose.png, review-mark.png and review-frame.png."""
    project, truths = archive(folder)
    reseau("measure", project)
    with shown(project, LARGE, "dark") as page:
        page.locator("#queue button", has_text=f"{_frame(truths, 'pose hidden')}: scan orientation").first.click()
        expect(page.locator("#poses button").first).to_be_visible()
        _take(page, "review-pose")
    with shown(project, LARGE, "light") as page:
        page.locator("#queue button", has_text=f"{_frame(truths, 'stamp')}: fiducial").first.click()
        expect(page.locator("#mark-view")).to_be_visible()
        _take(page, "review-mark")
    with shown(project, SMALL, "dark") as page:
        page.locator("#queue button", has_text="no mark was found").first.click()
        image = page.inner_text("#title").partition(":")[0]
        _click_marks(page, truths[image], "124")
        _take(page, "review-frame")


def _frame(truths: Mapping[str, review_faults.PlantedTruth], kind: str) -> str:
    """The first frame in which `planted` put a fault of a kind."""
    order: list[int] = np.random.default_rng(1).permutation(FRAMES).tolist()
    kinds = dict(zip(order, (fault.kind for fault in review_faults.FAULTS), strict=True))
    return next(name for number, name in enumerate(sorted(truths)) if kinds[number] == kind)


def learn(folder: Path) -> None:
    """review-learn.png: marks that nobody has drawn, clicked in one scan."""
    project, truths = box_of_scans(folder / "learn")
    text = f'name = "K"\nframe_mm = [16.0, 16.0]\n{LEARNED}[mark.m]\nkind = "learned"\nsize_mm = 2.2\n'
    project.with_name("camera.toml").write_text(text, encoding="utf-8")
    with shown(project, SMALL, "light") as page:
        page.locator("#queue button").first.click()
        _click_marks(page, truths[page.locator("#scan").input_value()], "12345678")
        _take(page, "review-learn")


def _click_marks(page: Page, truth: review_faults.PlantedTruth, numbers: str) -> None:
    """Click marks by keys, and measure by them."""
    person = review_faults.Person(page, {}, review_faults.BrowserSession())
    expect(page.locator("#whole")).to_be_focused()
    for number in numbers:
        page.keyboard.press(number)
        for view in ("whole", "near"):
            expect(page.locator(f"#{view}")).to_be_focused()
            person.steers(view, truth.px[number])
            page.keyboard.press("Enter")
    page.keyboard.press("m")
    page.wait_for_selector("#keep:focus", timeout=300_000)


def draw(folder: Path) -> None:
    """draw-camera.png: a ring-cross whose ring line is still too wide."""
    project, truths = box_of_scans(folder / "draw")
    sizes = {"arm_mm": 0.8, "line_mm": 0.1, "ring_mm": 0.5, "ring_line_mm": 0.1, "gap_mm": 0.0}
    with shown(project, {"width": 992, "height": 1150}, "light") as page:
        expect(page.locator("#draw-view")).to_be_visible()
        scan = page.locator("#draw-scan").input_value()
        with Image.open(project.parent / "scans" / f"{scan}.tif") as picture:
            width = picture.width
        box = page.locator("#draw-whole").bounding_box()
        assert box is not None
        for number in "1234":
            x, y = (truths[scan].px[number] + 0.5) * box["width"] / width
            page.locator("#draw-whole").click(position={"x": float(x), "y": float(y)})
        page.locator("#draw-kind").select_option("ring-cross")
        for key, value in sizes.items():
            _fill(page, key, value)
        page.locator("#draw-fit").click()
        expect(page.locator("#draw-told")).to_contain_text("Fitted", timeout=300_000)
        _fill(page, "ring_line_mm", 0.15)
        _take(page, "draw-camera")


def _fill(page: Page, key: str, value: float) -> None:
    page.locator(f"#size-{key}").fill(str(value))
    page.locator(f"#size-{key}").press("Enter")


def _take(page: Page, name: str) -> None:
    """Write a picture of what the window shows from its top on, in few colours."""
    page.evaluate("window.scrollTo(0, 0)")
    page.wait_for_timeout(SETTLED_MS)
    path = DOCS / f"{name}.png"
    page.screenshot(path=path)
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    few.save(path, optimize=True)


PICTURES: dict[str, Callable[[Path], None]] = {"report": report, "review": review, "learn": learn, "draw": draw}


if __name__ == "__main__":
    place = Path(sys.argv[1]).resolve()
    for each in sys.argv[2:] or PICTURES:
        PICTURES[each](place)
