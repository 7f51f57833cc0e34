"""report.html as a whole: well-formed, self-contained, and saying what is there in every state of a project."""

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, get_args

import made_up_calibration
import numpy as np
import pytest
from made_up_calibration import set_adjustment, set_frames, set_mark, set_weak
from made_up_calibration import set_adjustment as changed
from projects import present

from adjust.problem.parameter import Parameter
from adjust.quality.significance import Correlation
from adjust.solution.explanations import Explanation
from measure import Code, MarkMeasurement, Reason, ScanOrientation, Status
from measure.results import FrameMeasurement
from pipeline.report import ReportData, ReportedProblem, judge, render_report, write_report
from pipeline.report.data import FrameTotals, ReportSection, frames
from pipeline.report.frame_problems import fraction_test, places_px
from pipeline.report.load import _ending, verdict_counts
from pipeline.report.parameters import spoken_name
from pipeline.report.verdict import critical_w, problems_by_test, sigma0_bounds
from pipeline.results.adjustment_record import GivenQuantity, Quantity, Sigma0Record
from pipeline.results.assessment_record import SuspectRecord
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.stage_files import Check

Change = Callable[[ReportData], ReportData]
VOID = {"meta", "br", "img", "hr", "input", "link"}


class Document(HTMLParser):
    """Checks that every element is closed in its turn; collects text, ids and everything that could load."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "data", "action", "srcset"):
                self.addresses.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def rendered(data: ReportData) -> Document:
    """Without pictures, which take half of the time."""
    return Document(render_report(replace(data, thumbnail=None)))


@cache
def page_of(name: str) -> str:
    """Of a made-up calibration, for all tests that look at it."""
    return render_report(getattr(made_up_calibration, name)())


def test_a_good_calibration_says_so_first_and_has_one_value_to_be_cited() -> None:
    html = page_of("adjusted_report")
    document = Document(html)
    for words in (
        "✓ Good",
        "Calibrated from 160 marks in 5 frames: RC 20 has c = 153.6640 ± 0.0041 mm.",
        "None: nothing here needs a look.",
        *(words for status in Status for words in (status, status.meaning)),
    ):
        assert words in document.text
    assert "given object coordinates" not in document.text  # all are fixed
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "camera", "problems", "frames", "marks", "coverage", "fiducials", "reliability", "check", "notes",
    ]  # fmt: skip
    # And the certificate's other reference is closed, and says that it is another.
    (row,) = re.findall(r'<tr class="cite">.*?</tr>', html, re.DOTALL)
    assert Document(row).text.split() == ["c", "principal", "distance", "153.6640", "0.0041", "mm", "cite"]
    before = html[: html.index("as calibration certificates print it")]
    assert before.rindex("<details>") > before.rindex("</details>")
    assert "not to cite with c above" in html


def test_no_section_and_no_column_is_empty(adjusted_data: ReportData) -> None:
    without = replace(adjusted_data, measurement=None, thumbnail=None, check=None, covariance=None)
    film_alone = made_up_calibration.film_alone()
    for html in (page_of("adjusted_report"), render_report(without), page_of("digital"), render_report(film_alone)):
        for section in re.findall(r"<section.*?</section>", html, re.DOTALL):
            assert len(Document(section).text.split()) > 5, section
        for table in re.findall(r"<table.*?</table>", html, re.DOTALL):
            rows = re.findall(r"<tr.*?</tr>", re.sub(r"<thead.*?</thead>", "", table, flags=re.DOTALL), re.DOTALL)
            cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in rows]
            assert all(any(cell.strip(" –") for cell in column) for column in zip(*cells, strict=False)), table


def test_cameras_of_different_pixels_are_summed_up_in_micrometres() -> None:
    """A residual of 2 um is 0.1 px of 20 um and 0.4 px of 5 um. A camera without images has no part in it."""
    data = made_up_calibration.digital()
    stored = present(data.adjustment)
    (first,) = stored.cameras.values()
    idle = replace(data, adjustment=replace(stored, cameras={**stored.cameras, "idle": first}))
    assert idle.image_units == data.image_units
    assert idle.common_unit.pixel_um == made_up_calibration.PITCH_UM
    images = {
        name: replace(image, camera="other" if name == "f1" else "RC 20") for name, image in stored.images.items()
    }
    cameras = {"other": first, **stored.cameras}
    two = replace(data, adjustment=replace(stored, cameras=cameras, images=images))
    two = replace(two, pitch_um={**data.pitch_um, "f1": (5.0, 5.0)})
    assert {name: unit.pixel_um for name, unit in two.image_units.items()} == {
        "other": 5.0,
        "RC 20": made_up_calibration.PITCH_UM,
    }
    assert not two.common_unit.is_pixel
    assert "rms x (px)" in rendered(two).text
    rms = present(two.adjustment).groups["target"].rms_x_um
    assert f"rms of targets {rms:.1f} ×" in rendered(two).text


def test_a_digital_camera_is_reported_in_pixels_without_film() -> None:
    """c = 153.664 mm at 20 µm is 7683.2 px, its standard deviation 0.0041 mm 0.21 px. mm⁻² is the family's own."""
    document = Document(page_of("digital"))
    assert not re.search(r"(?i)\bfilm|\bpose\b|fiducial|scan orientation|µm|\bmm\b(?!⁻)", document.text)
    assert "RC 20 has c = 7683.20 ± 0.21 px." in document.text
    assert re.search(r"c principal distance 7683\.20 0\.21 px cite", document.text)
    assert "radius from the principal point (px)" in document.text
    assert "rms x (px)" in document.text
    residuals = present(made_up_calibration.digital().adjustment).residuals
    rms = (sum(row.vx_um**2 for row in residuals if row.image == "f1") / 24) ** 0.5
    assert f"{rms / 20.0:.3f}" in document.text


@pytest.mark.parametrize(("factor", "sigma"), [(9.0, "0.62"), (1 / 9.0, "0.21")])  # 3 times 0.205, or as they are
def test_standard_deviations_by_leaving_out_pictures_are_shown_where_they_are_larger(factor: float, sigma: str) -> None:
    data = made_up_calibration.digital()
    known = present(data.covariance)
    clusters = replace(known, matrix=factor * known.matrix)
    text = rendered(replace(data, covariance=replace(known, clusters=clusters))).text
    assert f"c = 7683.20 ± {sigma} px" in text


def test_an_archive_has_totals_first_and_corrections_in_words() -> None:
    film_alone = made_up_calibration.film_alone()
    document = rendered(film_alone)
    assert "given object coordinates" not in document.text  # all are fixed
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "totals", "problems", "frames", "marks", "fiducials", "reliability", "notes",
    ]  # fmt: skip
    assert "5 of 5 scans measured (5 good)." in document.text
    library = rendered(replace(film_alone, given_by={"RC 20": "the library's typical coordinates"})).text
    assert "Corrections to the library's typical coordinates, after" in library
    assert "certificate" not in library
    assert re.search(r"Corrections to the given coordinates, after a common [\w, ]+: \d+\.\d µm rms", document.text)
    assert "Residuals of all frames" not in document.text


def test_a_problem_has_reason_remedy_link_and_thumbnail(adjusted_data: ReportData) -> None:
    html = render_report(set_mark(adjusted_data, 2, Status.REJECTED, "4.2 px off"))
    (problem,) = re.findall(r"<li>.*?</li>", html[: html.index("<h2>Frames")], re.DOTALL)
    assert "<b>f1: 1 fiducial mark not measured" in problem
    assert 'class="step">Settle them with' in problem
    assert '<a href="#frame-1">f1</a>' in problem
    assert problem.count("data:image/png") == 1
    reason = "4.2 px off the other marks' places."
    lost = adjusted_data.comparator[2]
    rows = present(adjusted_data.adjustment).residuals
    kept = tuple(row for row in rows if (row.image, row.kind, row.point) != (lost.image, lost.kind, lost.point))
    text = rendered(set_adjustment(set_mark(adjusted_data, 2, Status.REJECTED, reason), residuals=kept)).text
    assert "! Needs a look" in text
    assert "1 thing needs a look" in text
    assert f"f1: 1 fiducial mark not measured, 7 measured. Reasons: 3 rejected: {reason}" in text
    assert "7 of 8 (1 rejected)" in text
    weak = set_mark(set_mark(adjusted_data, 2, Status.REJECTED, reason), 3, Status.WEAK, "covered")
    assert "f1: 1 fiducial mark not measured, 6 measured, 1 weak. Reasons: 3 rejected" in rendered(weak).text


def test_nothing_is_loaded_from_anywhere_and_every_drawing_has_words() -> None:
    html = page_of("adjusted_report")
    document = Document(html)
    inside, pictures = ([a for a in document.addresses if a.startswith(start)] for start in ("#", "data:image/png"))
    assert len(inside) + len(pictures) == len(document.addresses)
    assert len(pictures) == 160  # of every mark
    assert {address[1:] for address in inside} <= set(document.ids)
    assert len(document.ids) == len(set(document.ids))
    assert not re.search(r"http|url\(|@import", html)
    for opening in re.findall(r"<svg[^>]*>", html):
        assert re.search(r'aria-label="[^"]{10,}', opening), opening


def test_only_measured(measured_data: ReportData) -> None:
    page = render_report(measured_data)
    text = Document(page).text
    assert "✓ Good" in text
    assert "Measured: 160 marks in 5 frames." in text
    assert "These marks are not adjusted yet: run <code>reseau run</code>." in page
    assert "<dt>of which</dt>" in page
    assert re.search(r">noise 0\.041</span>, <span [^>]*>tone 0\.020</span> px", page)
    problem = ReportedProblem("It is <stale>. So says `reseau status`.", "Run `reseau measure`.")
    page = render_report(replace(measured_data, problems=(problem,)))
    for words in ("It is &lt;stale&gt;.", "So says <code>reseau status</code>.", "Run <code>reseau measure</code>."):
        assert words in page


def with_sigma0(redundancy: int, of_sigma0: float) -> Change:
    """Given coordinates that only place the datum have redundancy, but none that tells sigma0."""
    source = Sigma0Record(of_sigma0, of_sigma0 == 0.0, ())
    return lambda data: set_adjustment(data, redundancy=redundancy, sigma0=1.0, sigma0_from=source)


def with_check(verdict: Any) -> Change:
    return lambda data: replace(data, check=Check(verdict=verdict, reason="One flat vertical frame.", cameras={}))


def with_two_rejected(data: ReportData) -> ReportData:
    data = set_mark(data, 2, Status.REJECTED, "4.2 px off the other marks' places")
    return set_mark(data, 4, Status.REJECTED, "3.1 px off the other marks' places")


def with_tie_points(data: ReportData) -> ReportData:
    rows = [p if p.kind == "fiducial" else replace(p, kind="tie", status=Status.WEAK) for p in data.comparator]
    return replace(data, comparator=tuple(rows), measurement=None, adjustment=None, thumbnail=None)


C_AND_Z0 = (Parameter.interior("RC 20", "c"), Parameter.exterior("*", "Z0"))
TRADE_OFF = Correlation(C_AND_Z0, 0.98, "c and Z0 trade off.", "Tilt.")


@pytest.mark.parametrize(
    ("change", "counts"),
    [
        (lambda data: data, {"Exterior orientation (m, °)": 5}),
        (
            lambda data: replace(data, unit="mm", measurement=None, check=None, covariance=None),
            {
                "Exterior orientation (mm, °)": 5,
                "no pictures: the scans are not at hand.": 1,
                "It has not been made: run reseau check .": 1,
                "no distortion parameters, or their covariance is missing.": 1,
            },
        ),
        (lambda data: set_adjustment(data, correlations=(TRADE_OFF,)), {"c and Z0 trade off. Tilt.": 1}),
        (with_sigma0(257, 0.0), {"Standard deviations are a priori ones": 2}),  # as a note, and with the groups
        (with_sigma0(100, 37.0), {"redundancy 37": 2, "redundancy 100": 0}),
        (
            with_sigma0(0, 0.0),
            {"Nothing checks the result": 1, "The redundancy is 0: no check.": 1, "! Needs a look": 1},
        ),
        (with_check("differs"), {"differs : One flat vertical frame.": 1, "! Needs a look": 1}),
        (with_check("not possible"), {"! Needs a look": 0}),
        (with_two_rejected, {"3, 5 rejected, such as 3: 4.2 px off the other marks' places.": 1}),
        (with_tie_points, {"tie-point observations weak": 1, "targets": 0}),
    ],
)
def test_the_page_says_what_there_is(adjusted_data: ReportData, change: Change, counts: dict[str, int]) -> None:
    text = rendered(change(adjusted_data)).text
    assert {words: text.count(words) for words in counts} == counts


def test_without_a_result_the_report_says_why() -> None:
    text = rendered(ReportData("Empty")).text
    assert "✕ No result" in text
    assert "No mark was measured." in text
    assert "No frame has been measured yet" in text
    text = rendered(made_up_calibration.singular()).text
    for words in (
        "✕ No result",
        "There is no calibration: the network is singular.",
        "c and the flying height move together over flat ground.",
        "Fix c.",
        "all values and residuals of this report are those of the last iteration",
        "There is no solution to draw the distortion from.",
    ):
        assert words in text
    assert not re.search(r"\bnan\b|\bNone\b", text)


def test_what_the_user_named_is_escaped(adjusted_data: ReportData) -> None:
    name = '<script>alert("x")</script> & Co'
    data = set_mark(adjusted_data, 0, Status.WEAK, name)
    html = render_report(replace(data, project=name, problems=(ReportedProblem(name, name),)))
    Document(html)
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html


@pytest.mark.parametrize("code", [Code.OFF_GIVEN, Code.OFF_FRAMES])
def test_a_weak_fiducial_that_the_others_contradict_is_a_problem(measured_data: ReportData, code: Code) -> None:
    """Without it the clearer case, one mark of eight 0.1 mm off, passed as good where bent film did not."""
    sentence, row = "it lies 0.100 mm from where the other marks have it", measured_data.comparator[2]
    data = set_mark(measured_data, 2, Status.WEAK, sentence)
    reasons = (Reason(sentence, code), Reason(sentence, code, Code.DECIDED))
    texts = [rendered(set_weak(data, row.image, [row.point], reason)).text for reason in reasons]
    assert f"f1: 1 weak fiducial mark. Reasons: {row.point} weak: {sentence}." in texts[0]
    assert "! Needs a look" in texts[0]
    assert "weak fiducial mark" not in texts[1]


def test_the_file_is_written_whole_and_the_same_each_time(adjusted_data: ReportData, tmp_path: Path) -> None:
    write_report(adjusted_data, tmp_path / "report.html")
    first = (tmp_path / "report.html").read_bytes()
    shuffled = replace(adjusted_data, comparator=list(reversed(adjusted_data.comparator)))
    write_report(shuffled, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_bytes() == first


def test_marks_can_be_chosen_by_the_code_of_their_reason(measured_data: ReportData) -> None:
    gone, (first, second) = Reason("half of it is gone", Code.COVERED, Code.SIZE), measured_data.comparator[:2]
    data = set_mark(set_mark(measured_data, 0, Status.WEAK, str(gone)), 1, Status.WEAK, "a hair")
    html = render_report(set_weak(data, first.image, [first.point, second.point], gone))
    assert html.count('data-codes="covered size"') == 2  # with its frame, and above; what a person wrote has no code
    assert '<option value="covered">covered (1)</option>' in html
    text = Document(html).text
    assert "half of it is gone covered size" in text
    assert Code.COVERED.meaning in text
    assert "<select" not in page_of("adjusted_report")


def test_bounds_are_those_of_published_tables() -> None:
    """Chi-square with 10 degrees of freedom: 2.156 and 25.188 (any table, 0.005 and 0.995)."""
    low, high = sigma0_bounds(10)
    assert (low, high) == pytest.approx((np.sqrt(0.2156), np.sqrt(2.5188)), abs=1e-4)
    # One test: 2.576; a hundred: 0.01 / 100 two-sided, 3.891 (normal table).
    assert critical_w(1) == pytest.approx(2.576, abs=1e-3)
    assert critical_w(100) == pytest.approx(3.891, abs=1e-3)


ONE_LINE = 150  # letters in the width of the report at 1300 px


def describe(data: ReportData) -> str:
    """All problems in one text, for a calibration that is not good."""
    verdict = judge(data)
    assert verdict.level == "look"
    assert verdict.exit_code == 1
    assert [problem.remedy for problem in verdict.problems if len(problem.remedy) > ONE_LINE] == []
    return " ".join(f"{problem.what} {problem.next_step}" for problem in verdict.problems)


def test_good(adjusted_data: ReportData) -> None:
    """σ₀ may be better than promised."""
    verdict = judge(adjusted_data)
    assert (verdict.level, verdict.exit_code, verdict.problems) == ("good", 0, ())
    for sigma0, words in ((0.5, "σ₀ = 0.50 is below 0.89"), (0.8864, "σ₀ = 0.886 is below 0.887")):
        verdict = judge(changed(adjusted_data, sigma0=sigma0))
        assert verdict.exit_code == 0
        assert words in " ".join(verdict.notes)
    alone = judge(replace(adjusted_data, comparator=(), measurement=None))
    assert (alone.level, alone.sentence[:40]) == ("good", "Calibrated from 160 marks in 5 frames: R")
    rows = present(adjusted_data.adjustment).residuals
    some = changed(adjusted_data, residuals=tuple(row for row in rows if row.image != rows[0].image))
    assert judge(some).sentence.startswith("Calibrated from 128 marks in 4 frames: ")


NOT_SQUARE = (Explanation("pixels", "The pixels are not square.", "Give b1.", 1e-9, (1.6, 1.0)),)
PARTLY = (replace(NOT_SQUARE[0], sigma0=(9.6, 4.2)),)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"sigma0": 1.6}, ["σ₀ = 1.60 is above 1.11", "film_sigma_um", "(target 1.02, fiducial 0.97)"]),
        ({"sigma0": 1.6, "warnings": ("a is mirrored.",)}, ["a is mirrored.", "Mend what is named above first; if σ₀"]),
        ({"sigma0": 1.6, "explanations": NOT_SQUARE}, ["deviations given. The pixels are not square. Give b1."]),
        ({"explanations": NOT_SQUARE}, ["The pixels are not square. Give b1."]),
        ({"sigma0": 9.6, "explanations": PARTLY}, ["Give b1.", "σ₀ = 4.2 remains with that", "state film_sigma_um"]),
        ({"warnings": ("c is carried by its prior.",)}, ["c is carried by its prior."]),
    ],
)
def test_what_the_adjustment_finds_is_a_problem(adjusted_data: ReportData, values: Any, words: list[str]) -> None:
    text = describe(changed(adjusted_data, **values))
    assert [word for word in words if word not in text] == []
    assert "gross errors" not in text or "explanations" not in values
    assert ("remains" in text) == (values.get("explanations") == PARTLY)


def suspect(**values: Any) -> tuple[SuspectRecord]:
    numbers = (86.5, 2, 20.0, -9.3, -9.3, 4.0)
    row = SuspectRecord("target 1 in image f2", "target", "f2", "1", ("x", "y"), *numbers, (0.03, 0.0), (), False)
    return (replace(row, **values),)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, ["1 gross error suspected: target 1 in image f2 (w = −9.3).", "snooping = true", "Look at the picture"]),
        ({"alike": ("control point 1 Z",)}, ["f2 (w = −9.3; not distinguishable from control point 1 Z)."]),
        ({"name": "given 7 x", "group": "datum", "removed": True}, ["Left out as gross errors: given 7 x (w = −9.3)."]),
        ({"name": "given c (camera RC 20)", "group": "interior"}, ["Correct the given value in the camera's file"]),
    ],
)
def test_gross_errors_are_named(adjusted_data: ReportData, values: dict[str, Any], words: list[str]) -> None:
    text = describe(changed(adjusted_data, suspects=suspect(**values)))
    assert [word for word in words if word not in text] == []
    assert ("Look at the picture" in text) == (values.get("group") != "interior")


def test_suspects_have_the_advice_of_their_kind(adjusted_data: ReportData) -> None:
    given = suspect(name="given c (camera RC 20)", group="interior")
    text = describe(changed(adjusted_data, suspects=(*given, *suspect())))
    assert "Look at the picture" in text
    assert "Correct the given value in the camera's file" in text
    of_one = tuple(suspect(name=f"target {k} in image f2")[0] for k in range(8))
    assert "marks of f2: look for wrong point numbers" in describe(changed(adjusted_data, suspects=of_one))
    of_two = tuple(replace(each, owner=f"f{k % 2}") for k, each in enumerate(of_one))
    assert "look for wrong point numbers" not in describe(changed(adjusted_data, suspects=of_two))


def test_an_assumed_pose_needs_attention_once(measured_data: ReportData, adjusted_data: ReportData) -> None:
    pose = ScanOrientation("0", False, ("The marks are symmetric to 3 µm.",))  # nothing is decided
    data = set_frames(measured_data, lambda frame: replace(frame, pose=pose))
    assert len(judge(data).problems) == 1
    assert "f1, f2, f3, f4, f5: pose assumed (0). The marks are symmetric to 3 µm." in describe(data)
    assert 'set scan_orientation = "90"' in describe(data)
    cameras = present(adjusted_data.adjustment).cameras
    unknown = {name: replace(each, principal_distance_mm=Quantity(153.0, np.nan)) for name, each in cameras.items()}
    bare = changed(adjusted_data, cameras=unknown)
    check = Check(verdict="not possible", reason="No camera is calibrated.", cameras={})
    verdict = judge(replace(set_frames(bare, lambda frame: replace(frame, pose=pose)), check=check))
    assert verdict.exit_code == 1
    assert "pose assumed (0). The marks are symmetric to 3 µm." in verdict.problems[0].what
    result = " ".join(verdict.notes)
    assert "if two scans bear each other's names, nothing here shows it" in result
    assert "OpenCV cannot check" not in result


@pytest.mark.parametrize(
    ("given", "sigma", "clusters", "is_problem"),
    [
        (math.nan, 18.0, None, True),
        (math.nan, 0.9, None, False),
        (math.nan, 0.9, 18.0, True),
        (18.0, 18.0, None, False),
    ],
)
def test_a_free_principal_distance_that_images_hardly_determine(
    adjusted_data: ReportData, given: float, sigma: float, clusters: float | None, is_problem: bool
) -> None:
    """c is 153 mm; 18 mm are 12 % of it. A given one of that standard deviation is what the user says, and where the
    adjustment says it, the report does not say it twice."""
    prior = GivenQuantity(153.0, given)
    cameras = {
        name: replace(camera, principal_distance_mm=Quantity(153.0, sigma, prior, sigma_clusters=clusters))
        for name, camera in present(adjusted_data.adjustment).cameras.items()
    }
    assert ("is known to 12 % only" in rendered(changed(adjusted_data, cameras=cameras)).text) == is_problem
    said = {name: replace(camera, is_loose=True) for name, camera in cameras.items()}
    assert "is known to 12 %" not in rendered(changed(adjusted_data, cameras=said)).text


def test_every_section_that_a_problem_names_is_linked_and_on_the_page() -> None:
    """The columns are locked to whole pixels, for the histograms to be shown."""
    problems = tuple(ReportedProblem(f"Wrong: {section}.", section=section) for section in get_args(ReportSection))
    html = render_report(replace(set_frames(made_up_calibration.adjusted_report(), locked), problems=problems))
    linked = re.findall(r'Wrong: (\w+)\.(?:(?!</li>).)*href="#(\w+)"', html, re.DOTALL)
    assert linked == [(section, section) for section in get_args(ReportSection)]
    assert set(get_args(ReportSection)) <= set(Document(html).ids)


def test_the_table_of_exit_code_1_is_that_of_the_code() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "results.md").read_text()
    table = page.split("| test | passed when | false alarms |\n|---|---|---|\n")[1].split("\n\n")[0]
    assert [line.split(" | ")[0].removeprefix("| ") for line in table.splitlines()] == list(
        problems_by_test(ReportData(""), [])
    )


def test_problems_and_notes_of_frames_and_callers_are_kept(measured_data: ReportData) -> None:
    dark = (Reason("nearly black.", Code.NO_FRAME),)
    data = set_frames(measured_data, lambda frame: replace(frame, problems=dark) if frame.image == "f4" else frame)
    data = replace(data, problems=(ReportedProblem("points.csv: 99 was not measured."),))
    assert "f4: nearly black." in describe(data)
    assert "99 was not measured" in describe(data)
    note = "The file's orientation tag (6) is not applied."
    scans = {name: replace(scan, notes=(note,)) for name, scan in present(measured_data.measurement).items()}
    verdict = judge(replace(measured_data, measurement=scans))
    assert verdict.level == "good"
    assert f"f1, f2, f3, f4, f5: {note}" in verdict.notes


def lose(data: ReportData, kind: str, reason: str) -> ReportData:
    """Without the marks of a kind in f2."""
    rows = (
        replace(row, status=Status.ABSENT, reason=reason) if (row.image, row.kind) == ("f2", kind) else row
        for row in data.comparator
    )
    return replace(data, comparator=tuple(rows))


def test_what_a_frame_lacks_is_reported_once(measured_data: ReportData) -> None:
    assert describe(lose(measured_data, "fiducial", "Nothing there.")).count("Nothing there") == 1
    lost = lose(measured_data, "target", "Outside the scan.")
    assert "f2: none of its 24 targets was measured." in describe(lost)
    copied = (Reason("its file is byte for byte that of f1: its marks count once.", Code.COPY),)
    problems = describe(set_frames(lost, lambda one: replace(one, problems=copied) if one.image == "f2" else one))
    assert "f2: its file is byte for byte that of f1" in problems
    assert "none of its 24 targets" not in problems
    assert judge(set_mark(measured_data, -1, Status.ABSENT, "Outside the scan.")).level == "good"


def test_what_was_not_found_fills_no_page(measured_data: ReportData) -> None:
    """A target that is absent has no card among the doubtful marks, nor a fiducial of a frame that was not found."""

    def cards(*kinds: str) -> int:
        data = measured_data
        for kind in kinds:
            data = lose(data, kind, "Nothing there.")
        first, _ = render_report(data).split('<details id="marks"', 1)
        return len(re.findall(r'class="card(?: suspect)?"', first))

    of_f2 = [row for row in measured_data.comparator if row.image == "f2" and row.kind == "fiducial"]
    assert cards("fiducial") == cards() + len(of_f2)
    assert cards("target") == cards()
    assert cards("target", "fiducial") == cards()


def test_weights_that_the_adjustment_changed_are_noted(adjusted_data: ReportData) -> None:
    rows = [*present(adjusted_data.adjustment).residuals]
    rows[5] = replace(rows[5], weight=0.25)
    factors: dict[str, Any] = {"variance_factors": {"target": 4.0}, "variance_sigmas": {"target": 0.4}}
    notes = " ".join(judge(changed(adjusted_data, residuals=tuple(rows), **factors)).notes)
    assert "lowered the weight of 1 observation, most that of f1/6, to 0.25" in notes
    assert "the sigmas of the group target were multiplied by 2.00 ± 0.10" in notes
    cannot = replace(adjusted_data, check=Check(verdict="not possible", reason="One flat frame.", cameras={}))
    assert judge(cannot).level == "good"  # where it differs, a test of the page has it
    assert "OpenCV cannot check this calibration. One flat frame." in judge(cannot).notes


def test_without_a_solution_there_is_no_result(adjusted_data: ReportData) -> None:
    assert judge(ReportData("none")).level == "failed"
    stopped = changed(
        adjusted_data, converged=False, termination="iteration limit", iterations=50, warnings=("Not final.",)
    )
    verdict = judge(stopped)
    assert verdict.level == "failed"
    assert "There is no calibration: the iteration did not converge." in verdict.sentence
    assert "iteration limit, 50 iterations" in verdict.problems[0].what
    assert verdict.problems[1].what == "Not final."


def test_positions_that_prefer_parts_of_a_pixel_are_distinguished_from_even_ones() -> None:
    rng = np.random.default_rng(2)
    even = rng.uniform(0.0, 2000.0, 800)
    assert not fraction_test(even).is_locked
    pulled = np.round(even) + 0.6 * (even - np.round(even))
    assert fraction_test(pulled).is_locked
    assert fraction_test(even[:20]).probability is None
    assert fraction_test(even).counts.sum() == 800
    # 0.03 px towards the pixel's centre, as interpolating methods have it.
    rng = np.random.default_rng(4)
    true = rng.uniform(0.0, 4000.0, 20000)
    test = fraction_test(true - 0.03 * np.sin(2.0 * np.pi * true))
    assert test.is_locked
    assert test.bias_px == pytest.approx(0.03, abs=0.003)
    # However many marks show it, a bias that harms nobody is left alone.
    many = (np.arange(400000) + 0.5) / 1000.0
    test = fraction_test(many - 0.005 * np.sin(2.0 * np.pi * many))
    assert test.probability is not None
    assert test.probability < 1e-9
    assert not test.is_locked


def near_a_column(mark: MarkMeasurement, off_px: float) -> MarkMeasurement:
    """The mark so far off a whole column."""
    assert mark.center_px is not None
    return replace(mark, center_px=np.array([round(mark.center_px[0]) + off_px, mark.center_px[1]]))


def locked(frame: FrameMeasurement) -> FrameMeasurement:
    """The frame with all its marks near whole columns."""
    return replace(frame, marks=tuple(near_a_column(mark, 0.02) for mark in frame.marks))


def test_locked_positions_need_attention_and_recurring_ones_do_not(measured_data: ReportData) -> None:
    text = describe(set_frames(measured_data, locked))
    assert "The column positions of the marks prefer parts of a pixel" in text
    assert "The row positions" not in text
    # A frame that lies in the same place of every scan: 4 marks, 38 times within 0.01 px of the same places.
    rng = np.random.default_rng(6)
    (name, scan), *_ = (measured_data.measurement or {}).items()
    marks = [tuple(near_a_column(mark, rng.normal(0.0, 0.01)) for mark in scan.frame.marks[:4]) for _ in range(38)]
    scans = {f"{name}-{k}": replace(scan, frame=replace(scan.frame, marks=own)) for k, own in enumerate(marks)}
    recurring = replace(measured_data, comparator=(), measurement=scans)
    shots = frames(recurring)
    assert sum(mark.status.is_observation for frame in shots for mark in frame.marks) == 4 * 38
    assert all(len(positions) <= 4 for positions in places_px(shots).values())
    assert judge(recurring).level == "good"
    # A reseau of 20 x 20 crosses, 120.04 px apart: 20 columns and 20 rows, each measured 20 times.
    places = np.stack(np.meshgrid(*[100.7 + 120.04 * np.arange(20)] * 2), axis=-1).reshape(-1, 2)
    places += np.random.default_rng(8).normal(0.0, 0.01, places.shape)
    mark = scan.frame.marks[0]
    crosses = tuple(replace(mark, point=str(index), center_px=place) for index, place in enumerate(places))
    scans = {name: replace(scan, frame=replace(scan.frame, marks=crosses))}
    lattice = replace(measured_data, comparator=(), measurement=scans)
    assert len(frames(lattice)[0].marks) == 400
    assert judge(lattice).level == "good"


@pytest.mark.parametrize(("frame", "is_missing"), [("f", False), (None, True)])
def test_fiducials_that_another_scan_of_the_frame_shows_are_not_missing(frame: str | None, is_missing: bool) -> None:
    """In a comparator file without measurement, as `reseau block` writes it: it has no codes."""
    part_of = {"l": frame, "r": frame} if frame else {}
    shown = ComparatorPoint("l", "1", "fiducial", np.zeros(2), np.full(2, 0.005), 0.0, Status.MEASURED, "")
    absent = ComparatorPoint("r", "1", "fiducial", None, None, 0.0, Status.ABSENT, "it lies in l")
    left, right = frames(ReportData("Halves", [shown, absent], part_of=part_of))
    assert not left.marks[0].codes
    assert right.marks[0].needs_review is is_missing


def test_frames_outside_of_the_adjustment_are_counted_with_their_camera_and_kind_of_file() -> None:
    absent = [ComparatorPoint(image, "1", "fiducial", None, None, 0.0, Status.ABSENT, "") for image in "ab"]
    data = ReportData("Box", absent, image_cameras={"a": "K", "b": "L"})
    assert verdict_counts(data, frames(data)) == {("K", "given"): {"poor": 1}, ("L", "given"): {"poor": 1}}
    assert [_ending(scan) for scan in ("../(none) w2", "../a.b/X.TIF", "s3://a.b/c.tif")] == ["none", "tif", "tif"]


@pytest.mark.parametrize("is_many", [False, True])
def test_the_parts_of_a_frame_count_as_one_frame_and_one_without_marks_as_none(is_many: bool) -> None:
    marks = [ComparatorPoint(i, "1", "fiducial", np.zeros(2), np.ones(2), 0.0, Status.MEASURED, "") for i in "lrw"]
    absent = ComparatorPoint("e", "1", "fiducial", None, None, 0.0, Status.ABSENT, "")
    data = ReportData("Halves", [*marks, absent], part_of={"l": "f", "r": "f", "w": ""})
    counts = {image: Counter[str]({Status.MEASURED: int(image != "e")}) for image in "lrwe"}
    totals = FrameTotals(counts, {}, {}, (), {"col": np.zeros(0), "row": np.zeros(0)}) if is_many else None
    assert judge(replace(data, totals=totals)).sentence.startswith("Measured: 3 marks in 2 frames")


def test_quantities_are_called_as_in_the_tables() -> None:
    names = ["IO.RC 20.c", "IO.RC 20.x0", "FID.RC 20.7.1.x", "EO.f1.Z0"]
    assert [spoken_name(name, ["RC 20"]) for name in names] == ["c", "x₀′", "x′ of fiducial 7.1", "Z0 of image f1"]
    assert spoken_name("IO.A.B.k3", ["A", "A.B"]) == "k3, A.B"
