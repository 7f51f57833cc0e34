"""report.html as a whole: well-formed, self-contained, and saying what is there in every state of a project."""

import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import made_up_calibration
import pytest
from studies import parametrize_with_studies

from measure import Code, FrameMeasurement, Reason, Status
from pipeline.report import Problem, ReportData, render_report, write_report
from pipeline.results.adjustment_record import Sigma0Record
from pipeline.results.assessment_record import CorrelationRecord
from pipeline.results.check_file import Check
from pipeline.results.comparator_file import ComparatorPoint


@pytest.fixture
def measured_data() -> ReportData:
    return made_up_calibration.measured_report()


@pytest.fixture
def adjusted_data() -> ReportData:
    return made_up_calibration.adjusted_report()


@pytest.fixture
def singular() -> ReportData:
    return made_up_calibration.singular()


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


def test_a_good_calibration_says_so_first() -> None:
    html = good_page()
    document = Document(html)
    assert "✓ Good" in document.text
    assert "Calibrated from 160 marks in 5 frames: RC 20 has c = 153.6640 ± 0.0041 mm." in document.text
    assert "None: nothing here needs a look." in document.text
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "camera", "problems", "frames", "marks", "coverage", "fiducials", "reliability", "check", "notes",
    ]  # fmt: skip


def test_no_section_and_no_column_is_empty(adjusted_data: ReportData) -> None:
    without = replace(adjusted_data, measurement=None, thumbnail=None, check=None, covariance=None)
    for html in (good_page(), render_report(without), digital_page(), render_report(film_alone())):
        for section in re.findall(r"<section.*?</section>", html, re.DOTALL):
            assert len(Document(section).text.split()) > 5, section
        for table in re.findall(r"<table.*?</table>", html, re.DOTALL):
            rows = re.findall(r"<tr.*?</tr>", re.sub(r"<thead.*?</thead>", "", table, flags=re.DOTALL), re.DOTALL)
            cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in rows]
            assert all(any(cell.strip(" –") for cell in column) for column in zip(*cells, strict=False)), table


def test_one_value_is_to_be_cited(adjusted_data: ReportData) -> None:
    """And the certificate's other reference is closed, and says that it is another."""
    html = good_page()
    (row,) = re.findall(r'<tr class="cite">.*?</tr>', html, re.DOTALL)
    assert Document(row).text.split() == ["c", "principal", "distance", "153.6640", "0.0041", "mm", "cite"]
    before = html[: html.index("as calibration certificates print it")]
    assert before.rindex("<details>") > before.rindex("</details>")
    assert "not to cite with c above" in html


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


def test_standard_deviations_by_leaving_out_pictures_are_shown_where_they_are_larger() -> None:
    data = made_up_calibration.digital()
    assert data.covariance is not None
    clusters = replace(data.covariance, matrix=9.0 * data.covariance.matrix)
    text = rendered(replace(data, covariance=replace(data.covariance, clusters=clusters))).text
    assert "c = 7683.20 ± 0.62 px" in text  # 3 times 0.205
    smaller = replace(data.covariance, matrix=data.covariance.matrix / 9.0)
    assert "± 0.21 px" in rendered(replace(data, covariance=replace(data.covariance, clusters=smaller))).text


def film_alone() -> ReportData:
    """The fiducials of the good calibration, without anything else."""
    return made_up_calibration.film_alone()


def test_an_archive_has_totals_first_and_corrections_in_words() -> None:
    document = rendered(film_alone())
    assert [id for id in document.ids if not id.startswith("frame-")] == [
        "verdict", "totals", "problems", "frames", "marks", "fiducials", "reliability", "notes",
    ]  # fmt: skip
    assert "5 of 5 scans measured (5 good)." in document.text
    library = rendered(replace(film_alone(), given_by={"RC 20": "the library's typical coordinates"})).text
    assert "Corrections to the library's typical coordinates, after" in library
    assert "certificate" not in library
    assert re.search(r"Corrections to the given coordinates, after a common [\w, ]+: \d+\.\d µm rms", document.text)
    assert "Residuals of all frames" not in document.text


def test_marks_that_fit_badly_are_shown_and_all_others_closed(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    first, *others = adjusted_data.adjustment.residuals
    rows = (replace(first, w=-3.4), *others)
    html = render_report(replace(adjusted_data, adjustment=replace(adjusted_data.adjustment, residuals=rows)))
    shown, closed = html[html.index("<h2>Frames") :].split('<details id="marks">')
    assert shown.count('<div class="card"') == 1
    assert "w</dt><dd>−3.4" in shown
    assert closed.count('<div class="card"') == 160
    assert '<div class="card"' not in good_page().split('<details id="marks">')[0]


def test_a_problem_has_cause_remedy_link_and_thumbnail(adjusted_data: ReportData) -> None:
    lost = replace(adjusted_data.comparator[2], status=Status.REJECTED, reason="4.2 px off")
    html = render_report(
        replace(adjusted_data, comparator=[*adjusted_data.comparator[:2], lost, *adjusted_data.comparator[3:]])
    )
    (problem,) = re.findall(r"<li>.*?</li>", html[: html.index("<h2>Frames")], re.DOTALL)
    assert "<b>f1: 1 fiducial mark not measured" in problem
    assert 'class="step">Settle them with' in problem
    assert '<a href="#frame-1">f1</a>' in problem
    assert problem.count("data:image/png") == 1


def test_nothing_is_loaded_from_anywhere() -> None:
    html = good_page()
    for address in Document(html).addresses:
        assert address.startswith(("#", "data:image/png;base64,")), address
    assert "http" not in html
    assert "url(" not in html
    assert "@import" not in html


def test_every_link_inside_finds_its_place_and_no_id_stands_twice() -> None:
    document = Document(good_page())
    assert len(document.ids) == len(set(document.ids))
    assert {address[1:] for address in document.addresses if address.startswith("#")} <= set(document.ids)


def test_every_drawing_has_words_for_those_who_cannot_see_it() -> None:
    html = good_page()
    for opening in re.findall(r"<svg[^>]*>", html):
        assert re.search(r'aria-label="[^"]{10,}', opening), opening


def test_every_mark_has_its_picture() -> None:
    assert sum(address.startswith("data:") for address in Document(good_page()).addresses) == 160


def test_the_statuses_are_those_of_the_table() -> None:
    text = Document(good_page()).text
    for status, meaning in ((each, each.meaning) for each in Status):
        assert status in text
        assert meaning in text


def test_no_check_stands_where_the_redundancy_is_zero() -> None:
    assert re.search(
        r"control given object coordinates; rms in millionths of their unit no check 0\.00 0\.00 0\.0: no check",
        Document(good_page()).text,
    )


def test_a_priori_standard_deviations_are_named(adjusted_data: ReportData) -> None:
    """One frame whose given coordinates only place the datum has redundancy, but none that tells sigma0."""
    assert adjusted_data.adjustment is not None
    content = replace(adjusted_data.adjustment, sigma0=1.0, sigma0_from=Sigma0Record(0.0, True, ()))
    text = rendered(replace(adjusted_data, adjustment=content)).text
    assert text.count("Standard deviations are a priori ones") == 2  # as a note, and with the groups


def test_the_redundancy_next_to_sigma0_is_the_one_that_it_comes_from(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    content = replace(adjusted_data.adjustment, redundancy=100, sigma0=1.0, sigma0_from=Sigma0Record(37.0, False, ()))
    verdict = rendered(replace(adjusted_data, adjustment=content)).text.split("Camera metric")[0]
    assert "redundancy 37" in verdict
    assert "redundancy 100" not in verdict


def test_an_adjustment_without_any_redundancy_is_not_called_good(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    nothing = Sigma0Record(0.0, True, ())
    content = replace(adjusted_data.adjustment, redundancy=0, sigma0=1.0, sigma0_from=nothing)
    text = rendered(replace(adjusted_data, adjustment=content)).text
    assert "Nothing checks the result" in text
    assert "The redundancy is 0: no check." in text
    assert "! Needs a look" in text


def test_only_measured(measured_data: ReportData) -> None:
    text = rendered(measured_data).text
    assert "✓ Good" in text
    assert "Measured: 160 marks in 5 frames." in text
    assert "These marks are not adjusted yet: run `reseau adjust`." in text


def test_a_frame_that_was_not_found_says_so_once(measured_data: ReportData) -> None:
    reason = "no fiducial was measured: the constellation does not fit"
    absent = [replace(point, status=Status.ABSENT, reason=reason) for point in measured_data.comparator]
    assert measured_data.measurement is not None
    scans = {
        image: replace(scan, frame=FrameMeasurement(image, (), problems=(Reason(f"{reason}.", Code.NO_FRAME),)))
        for image, scan in measured_data.measurement.items()
    }
    text = rendered(replace(measured_data, comparator=tuple(absent), measurement=scans)).text
    assert text.count(f"{reason}.") == 1
    assert "fiducial marks not measured" not in text
    assert "run `reseau adjust`" not in text


def test_tie_points_are_not_called_targets(measured_data: ReportData) -> None:
    points = [
        p if p.kind == "fiducial" else replace(p, kind="tie", status=Status.WEAK) for p in measured_data.comparator
    ]
    text = rendered(replace(measured_data, comparator=tuple(points), measurement=None, thumbnail=None)).text
    assert "Tie points" in text
    assert "sights of tie points weak" in text
    assert "targets" not in text[: text.index("Notes")]


def test_given_coordinates_without_scans(adjusted_data: ReportData) -> None:
    text = rendered(replace(adjusted_data, measurement=None, thumbnail=None)).text
    assert "There are no pictures: the scans are not at hand." in text


def test_exterior_orientations_stand_in_the_users_unit(adjusted_data: ReportData) -> None:
    assert "Exterior orientation (m, degrees)" in Document(good_page()).text
    assert "Exterior orientation (mm, degrees)" in rendered(replace(adjusted_data, unit="mm")).text


def test_no_check_against_opencv_yet(adjusted_data: ReportData) -> None:
    assert "It has not been made: run reseau check ." in rendered(replace(adjusted_data, check=None)).text


def test_without_the_covariance_the_curves_are_left_out_with_a_word(adjusted_data: ReportData) -> None:
    text = rendered(replace(adjusted_data, covariance=None)).text
    assert "The camera has no distortion parameters, or their covariance is missing." in text


def test_nothing_at_all() -> None:
    text = rendered(ReportData("Empty")).text
    assert "✕ No result" in text
    assert "No mark was measured." in text
    assert "No frame has been measured yet" in text


def test_a_singular_network_names_cause_and_remedy(singular: ReportData) -> None:
    text = rendered(singular).text
    assert "✕ No result" in text
    assert "There is no calibration: the network is singular." in text
    assert "c and the flying height move together over flat ground." in text
    assert "Fix c." in text
    assert "all values and residuals of this report are those of the last iteration" in text
    assert not re.search(r"\bnan\b|\bNone\b", text)
    assert "There is no solution to draw the distortion from." in text


def test_why_parameters_are_highly_correlated_stands_with_the_camera(adjusted_data: ReportData) -> None:
    stored = adjusted_data.adjustment
    assert stored is not None
    (camera,) = stored.cameras
    pair = CorrelationRecord((f"IO.{camera}.c", "EO.*.Z0"), 0.98, "c and Z0 trade off.", "Tilt.")
    text = rendered(replace(adjusted_data, adjustment=replace(stored, correlations=(pair,)))).text
    assert "c and Z0 trade off. Tilt." in text


def test_what_the_user_named_is_escaped(adjusted_data: ReportData) -> None:
    name = '<script>alert("x")</script> & Co'
    first = replace(adjusted_data.comparator[0], status=Status.WEAK, reason=name)
    html = render_report(
        replace(
            adjusted_data,
            project=name,
            comparator=[first, *adjusted_data.comparator[1:]],
            problems=(Problem(name, name),),
        )
    )
    Document(html)
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html


def _key(mark: ComparatorPoint) -> tuple[str, str, str]:
    return mark.image, mark.kind, mark.point


def test_a_rejected_fiducial_is_a_problem_with_its_reason(adjusted_data: ReportData) -> None:
    reason = "4.2 px off the other marks' places."
    rejected = replace(adjusted_data.comparator[2], status=Status.REJECTED, reason=reason)
    rows = [*adjusted_data.comparator[:2], rejected, *adjusted_data.comparator[3:]]
    assert adjusted_data.adjustment is not None
    kept = tuple(
        row for row in adjusted_data.adjustment.residuals if (row.image, row.kind, row.point) != _key(rejected)
    )
    text = rendered(
        replace(adjusted_data, comparator=rows, adjustment=replace(adjusted_data.adjustment, residuals=kept))
    ).text
    assert "! Needs a look" in text
    assert "1 thing needs a look" in text
    assert (
        "f1: 1 fiducial mark not measured, 7 measured. Reasons: 3 rejected: 4.2 px off the other marks' places." in text
    )
    assert "7 of 8 (1 rejected)" in text


def test_reasons_that_differ_by_their_numbers_are_reported_once(measured_data: ReportData) -> None:
    rows = list(measured_data.comparator)
    for index, off in ((2, 4.2), (4, 3.1)):
        rows[index] = replace(rows[index], status=Status.REJECTED, reason=f"{off} px off the other marks' places")
    names = f"{rows[2].point}, {rows[4].point}"
    text = rendered(replace(measured_data, comparator=rows)).text
    reasons = f"{names} rejected, such as {rows[2].point}: 4.2 px off the other marks' places."
    assert f"6 measured. Reasons: {reasons}" in text


def test_of_many_targets_the_worst_are_shown_and_all_fiducials(adjusted_data: ReportData) -> None:
    """60 frames of 8 fiducials and 24 targets: 600 // 60 = 10 targets a frame."""
    assert adjusted_data.adjustment is not None
    names = [f"{image}-{copy}" for copy in range(12) for image in ("f1", "f2", "f3", "f4", "f5")]
    rows = [replace(row, image=name) for name in names for row in adjusted_data.comparator if row.image == name[:2]]
    data = replace(adjusted_data, comparator=rows, measurement=None, adjustment=None, check=None)
    first = _copy_pictures(data)
    html = render_report(first)
    assert html.count("data:image/png") == 60 * (8 + 10)
    assert "14 more targets of this frame are not pictured" in html
    assert html.count('<details class="frame"') == 60
    assert " open>" not in html


def _copy_pictures(data: ReportData) -> ReportData:
    picture = data.thumbnail
    assert picture is not None
    return replace(data, thumbnail=lambda image, point, kind: picture(image[:2], point, kind))


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


def test_a_marks_sigma_is_known_by_its_causes(measured_data: ReportData) -> None:
    page = render_report(measured_data)
    assert "<dt>of which</dt>" in page
    assert re.search(r">noise 0\.041</span>, <span [^>]*>tone 0\.020</span> px", page)


def test_marks_can_be_chosen_by_the_code_of_their_reason(measured_data: ReportData) -> None:
    assert measured_data.measurement is not None
    image, scan = next(iter(measured_data.measurement.items()))
    gone = Reason("half of it is gone", Code.COVERED, Code.SIZE)
    changed = [mark.point for mark in scan.frame.marks if mark.kind == "fiducial"][:2]
    marks = tuple(
        replace(mark, status=Status.WEAK, reason=gone) if mark.kind == "fiducial" and mark.point in changed else mark
        for mark in scan.frame.marks
    )
    rows = tuple(
        replace(row, status=Status.WEAK, reason="a hair" if row.point == changed[1] else str(gone))
        if row.image == image and row.kind == "fiducial" and row.point in changed
        else row
        for row in measured_data.comparator
    )
    scans = {**measured_data.measurement, image: replace(scan, frame=replace(scan.frame, marks=marks))}
    html = render_report(replace(measured_data, comparator=rows, measurement=scans))
    assert html.count('data-codes="covered size"') == 2  # with its frame, and above; what a person wrote has no code
    assert '<option value="covered">covered (1)</option>' in html
    text = Document(html).text
    assert "half of it is gone covered size" in text
    assert Code.COVERED.meaning in text
    assert "<select" not in good_page()
