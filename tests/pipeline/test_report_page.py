"""report.html as a whole: well-formed, self-contained, and saying what is there in every state of a project."""

import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import made_up_calibration
import pytest
from made_up_calibration import set_adjustment, set_frames, set_mark, set_weak
from studies import parametrize_with_studies

from measure import Code, FrameMeasurement, Reason, Status
from pipeline.report import Problem, ReportData, render_report, write_report
from pipeline.results.adjustment_record import Sigma0Record
from pipeline.results.assessment_record import CorrelationRecord
from pipeline.results.stage_files import Check

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
    return Document(render_report(data))


@cache
def good_page() -> str:
    """Of the good calibration, for all tests that look at it."""
    return render_report(made_up_calibration.adjusted_report())


def test_a_good_calibration_says_so_first_and_has_one_value_to_be_cited(adjusted_data: ReportData) -> None:
    html = good_page()
    document = Document(html)
    assert "✓ Good" in document.text
    assert "Calibrated from 160 marks in 5 frames: RC 20 has c = 153.6640 ± 0.0041 mm." in document.text
    assert "None: nothing here needs a look." in document.text
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "camera", "problems", "frames", "marks", "coverage", "fiducials", "reliability", "check", "notes",
    ]  # fmt: skip
    # And the certificate's other reference is closed, and says that it is another.
    (row,) = re.findall(r'<tr class="cite">.*?</tr>', html, re.DOTALL)
    assert Document(row).text.split() == ["c", "principal", "distance", "153.6640", "0.0041", "mm", "cite"]
    before = html[: html.index("as calibration certificates print it")]
    assert before.rindex("<details>") > before.rindex("</details>")
    assert "not to cite with c above" in html
    text = Document(good_page()).text
    for status, meaning in ((each, each.meaning) for each in Status):
        assert status in text
        assert meaning in text
    assert re.search(
        r"control given object coordinates; rms in millionths of their unit no check 0\.00 0\.00 0\.0: no check",
        Document(good_page()).text,
    )


def test_no_section_and_no_column_is_empty(adjusted_data: ReportData) -> None:
    without = replace(adjusted_data, measurement=None, thumbnail=None, check=None, covariance=None)
    film_alone = made_up_calibration.film_alone()
    for html in (good_page(), render_report(without), digital_page(), render_report(film_alone)):
        for section in re.findall(r"<section.*?</section>", html, re.DOTALL):
            assert len(Document(section).text.split()) > 5, section
        for table in re.findall(r"<table.*?</table>", html, re.DOTALL):
            rows = re.findall(r"<tr.*?</tr>", re.sub(r"<thead.*?</thead>", "", table, flags=re.DOTALL), re.DOTALL)
            cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in rows]
            assert all(any(cell.strip(" –") for cell in column) for column in zip(*cells, strict=False)), table


@cache
def digital_page() -> str:
    return render_report(made_up_calibration.digital())


def test_a_digital_camera_is_reported_in_pixels_without_film() -> None:
    """c = 153.664 mm at 20 µm is 7683.2 px, its standard deviation 0.0041 mm 0.21 px. mm⁻² is the family's own."""
    document = Document(digital_page())
    assert not re.search(r"(?i)\bfilm|\bpose\b|fiducial|scan orientation|µm|\bmm\b(?!⁻)", document.text)
    assert "RC 20 has c = 7683.20 ± 0.21 px." in document.text
    assert re.search(r"c principal distance 7683\.20 0\.21 px cite", document.text)
    assert "radius from the principal point (px)" in document.text
    assert "rms x (px)" in document.text
    targets = made_up_calibration.digital().adjustment
    assert targets is not None
    rms = (sum(row.vx_um**2 for row in targets.residuals if row.image == "f1") / 24) ** 0.5
    assert f"{rms / 20.0:.3f}" in document.text


@pytest.mark.parametrize(("factor", "sigma"), [(9.0, "0.62"), (1 / 9.0, "0.21")])  # 3 times 0.205, or as they are
def test_standard_deviations_by_leaving_out_pictures_are_shown_where_they_are_larger(factor: float, sigma: str) -> None:
    data = made_up_calibration.digital()
    assert data.covariance is not None
    clusters = replace(data.covariance, matrix=factor * data.covariance.matrix)
    text = rendered(replace(data, covariance=replace(data.covariance, clusters=clusters))).text
    assert f"c = 7683.20 ± {sigma} px" in text


def test_an_archive_has_totals_first_and_corrections_in_words() -> None:
    film_alone = made_up_calibration.film_alone()
    document = rendered(film_alone)
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "totals", "problems", "frames", "marks", "fiducials", "reliability", "notes",
    ]  # fmt: skip
    assert "5 of 5 scans measured (5 good)." in document.text
    library = rendered(replace(film_alone, given_by={"RC 20": "the library's typical coordinates"})).text
    assert "Corrections to the library's typical coordinates, after" in library
    assert "certificate" not in library
    assert re.search(r"Corrections to the given coordinates, after a common [\w, ]+: \d+\.\d µm rms", document.text)
    assert "Residuals of all frames" not in document.text


def test_marks_that_fit_badly_are_shown_and_all_others_closed(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    first, *others = adjusted_data.adjustment.residuals
    html = render_report(set_adjustment(adjusted_data, residuals=(replace(first, w=-3.4), *others)))
    shown, closed = html[html.index("<h2>Frames") :].split('<details id="marks">')
    assert shown.count('<div class="card"') == 1
    assert "w</dt><dd>−3.4" in shown
    assert closed.count('<div class="card"') == 160
    assert '<div class="card"' not in good_page().split('<details id="marks">')[0]


def test_a_problem_has_reason_remedy_link_and_thumbnail(adjusted_data: ReportData) -> None:
    html = render_report(set_mark(adjusted_data, 2, Status.REJECTED, "4.2 px off"))
    (problem,) = re.findall(r"<li>.*?</li>", html[: html.index("<h2>Frames")], re.DOTALL)
    assert "<b>f1: 1 fiducial mark not measured" in problem
    assert 'class="step">Settle them with' in problem
    assert '<a href="#frame-1">f1</a>' in problem
    assert problem.count("data:image/png") == 1
    reason = "4.2 px off the other marks' places."
    lost = adjusted_data.comparator[2]
    assert adjusted_data.adjustment is not None
    rows = adjusted_data.adjustment.residuals
    kept = tuple(row for row in rows if (row.image, row.kind, row.point) != (lost.image, lost.kind, lost.point))
    text = rendered(set_adjustment(set_mark(adjusted_data, 2, Status.REJECTED, reason), residuals=kept)).text
    assert "! Needs a look" in text
    assert "1 thing needs a look" in text
    assert f"f1: 1 fiducial mark not measured, 7 measured. Reasons: 3 rejected: {reason}" in text
    assert "7 of 8 (1 rejected)" in text


def test_nothing_is_loaded_from_anywhere_and_every_drawing_has_words() -> None:
    html = good_page()
    document = Document(html)
    inside, pictures = (
        [each for each in document.addresses if each.startswith(start)] for start in ("#", "data:image/png")
    )
    assert len(inside) + len(pictures) == len(document.addresses)
    assert len(pictures) == 160  # of every mark
    assert {address[1:] for address in inside} <= set(document.ids)
    assert len(document.ids) == len(set(document.ids))
    assert not re.search(r"http|url\(|@import", html)
    for opening in re.findall(r"<svg[^>]*>", html):
        assert re.search(r'aria-label="[^"]{10,}', opening), opening


@pytest.mark.parametrize(
    ("redundancy", "of_sigma0", "words", "count"),
    [
        (257, 0.0, "Standard deviations are a priori ones", 2),  # as a note, and with the groups
        (100, 37.0, "redundancy 37", 2),
        (100, 37.0, "redundancy 100", 0),
        (0, 0.0, "Nothing checks the result", 1),
        (0, 0.0, "The redundancy is 0: no check.", 1),
        (0, 0.0, "! Needs a look", 1),
    ],
)
def test_redundancy_is_that_of_sigma0(
    adjusted_data: ReportData, redundancy: int, of_sigma0: float, words: str, count: int
) -> None:
    """Given coordinates that only place the datum have redundancy, but none that tells sigma0."""
    source = Sigma0Record(of_sigma0, of_sigma0 == 0.0, ())
    text = rendered(set_adjustment(adjusted_data, redundancy=redundancy, sigma0=1.0, sigma0_from=source)).text
    text = text if "priori" in words else text.split("Camera metric")[0]
    assert text.count(words) == count


def test_only_measured(measured_data: ReportData) -> None:
    page = render_report(measured_data)
    text = Document(page).text
    assert "✓ Good" in text
    assert "Measured: 160 marks in 5 frames." in text
    assert "These marks are not adjusted yet: run <code>reseau run</code>." in page
    assert "<dt>of which</dt>" in page
    assert re.search(r">noise 0\.041</span>, <span [^>]*>tone 0\.020</span> px", page)
    problem = Problem("It is <stale>. So says `reseau status`.", "Run `reseau measure`.")
    page = render_report(replace(measured_data, problems=(problem,)))
    for words in ("It is &lt;stale&gt;.", "So says <code>reseau status</code>.", "Run <code>reseau measure</code>."):
        assert words in page


def test_tie_points_are_not_called_targets(measured_data: ReportData) -> None:
    points = [
        p if p.kind == "fiducial" else replace(p, kind="tie", status=Status.WEAK) for p in measured_data.comparator
    ]
    text = rendered(replace(measured_data, comparator=tuple(points), measurement=None, thumbnail=None)).text
    assert "Tie points" in text
    assert "sights of tie points weak" in text
    assert "targets" not in text[: text.index("Notes")]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "Exterior orientation (m, degrees)"),
        ({"unit": "mm"}, "Exterior orientation (mm, degrees)"),
        ({"measurement": None, "thumbnail": None}, "There are no pictures: the scans are not at hand."),
        ({"check": None}, "It has not been made: run reseau check ."),
        ({"covariance": None}, "The camera has no distortion parameters, or their covariance is missing."),
    ],
)
def test_what_is_missing_is_reported(adjusted_data: ReportData, change: dict[str, Any], words: str) -> None:
    assert words in rendered(replace(adjusted_data, **change)).text


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


def test_why_parameters_are_highly_correlated_stands_with_the_camera(adjusted_data: ReportData) -> None:
    pair = CorrelationRecord(("IO.RC 20.c", "EO.*.Z0"), 0.98, "c and Z0 trade off.", "Tilt.")
    assert "c and Z0 trade off. Tilt." in rendered(set_adjustment(adjusted_data, correlations=(pair,))).text


def test_what_the_user_named_is_escaped(adjusted_data: ReportData) -> None:
    name = '<script>alert("x")</script> & Co'
    data = set_mark(adjusted_data, 0, Status.WEAK, name)
    html = render_report(replace(data, project=name, problems=(Problem(name, name),)))
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


def test_reasons_are_reported_once(measured_data: ReportData) -> None:
    data = set_mark(measured_data, 2, Status.REJECTED, "4.2 px off the other marks' places")
    data = set_mark(data, 4, Status.REJECTED, "3.1 px off the other marks' places")
    first, second = (data.comparator[row].point for row in (2, 4))
    reasons = f"{first}, {second} rejected, such as {first}: 4.2 px off the other marks' places."
    assert f"6 measured. Reasons: {reasons}" in rendered(data).text
    reason = "no fiducial was measured: the constellation does not fit"
    absent = [replace(point, status=Status.ABSENT, reason=reason) for point in measured_data.comparator]
    problem = (Reason(f"{reason}.", Code.NO_FRAME),)
    data = set_frames(measured_data, lambda frame: FrameMeasurement(frame.image, (), problems=problem))
    text = rendered(replace(data, comparator=absent)).text
    assert text.count(f"{reason}.") == 1
    assert "fiducial marks not measured" not in text
    assert "not adjusted yet" not in text


def test_of_many_targets_the_worst_are_shown_and_all_fiducials(adjusted_data: ReportData) -> None:
    """60 frames of 8 fiducials and 24 targets: 600 // 60 = 10 targets a frame."""
    picture = adjusted_data.thumbnail
    assert picture is not None
    names = [f"{image}-{copy}" for copy in range(12) for image in ("f1", "f2", "f3", "f4", "f5")]
    rows = [replace(row, image=name) for name in names for row in adjusted_data.comparator if row.image == name[:2]]
    data = replace(adjusted_data, comparator=rows, measurement=None, adjustment=None, check=None)
    html = render_report(replace(data, thumbnail=lambda image, point, kind: picture(image[:2], point, kind)))
    assert html.count("data:image/png") == 60 * (8 + 10)
    assert "14 more targets of this frame are not pictured" in html
    assert html.count('<details class="frame"') == 60
    assert " open>" not in html


def test_the_file_is_written_whole_and_the_same_each_time(adjusted_data: ReportData, tmp_path: Path) -> None:
    write_report(adjusted_data, tmp_path / "report.html")
    first = (tmp_path / "report.html").read_bytes()
    shuffled = replace(adjusted_data, comparator=list(reversed(adjusted_data.comparator)))
    write_report(shuffled, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_bytes() == first


@parametrize_with_studies("verdict", ["differs", "not possible"])
def test_the_verdict_of_the_check_stands_with_its_reason(adjusted_data: ReportData, verdict: Any) -> None:
    check = Check(verdict=verdict, reason="One flat vertical frame.", cameras={})
    text = rendered(replace(adjusted_data, check=check)).text
    assert f"{verdict} : One flat vertical frame." in text
    assert ("! Needs a look" in text) == (verdict == "differs")


def test_marks_can_be_chosen_by_the_code_of_their_reason(measured_data: ReportData) -> None:
    gone, (first, second) = Reason("half of it is gone", Code.COVERED, Code.SIZE), measured_data.comparator[:2]
    data = set_mark(set_mark(measured_data, 0, Status.WEAK, str(gone)), 1, Status.WEAK, "a hair")
    html = render_report(set_weak(data, first.image, [first.point, second.point], gone))
    assert html.count('data-codes="covered size"') == 2  # with its frame, and above; what a person wrote has no code
    assert '<option value="covered">covered (1)</option>' in html
    text = Document(html).text
    assert "half of it is gone covered size" in text
    assert Code.COVERED.meaning in text
    assert "<select" not in good_page()
