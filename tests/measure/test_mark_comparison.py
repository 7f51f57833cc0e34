"""What marks tell of one another, and a faint mark in its frame."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drawn as draw
import numpy as np
import pytest
from studies import parametrize_with_studies
from true_marks import KIND, TrueMark, some_mark

from measure import FiducialLayout, FiducialOptions, LayoutMark, MarkShape, Status, cross
from measure.fiducials import mark_comparison
from measure.fiducials.constellation import Placement
from measure.fiducials.mark_fit import not_found
from measure.fiducials.measure_frame import Frame, choose_fit, compare_shapes, detect_frame, measure_frame, orient_frame
from measure.fiducials.measurement import absent_frame
from measure.fiducials.stages import explain_misfit
from measure.flags import NO_REASON, Cause
from measure.marks.shapes import polygon
from measure.matching.gauss_newton import UNSETTLED
from measure.results import Covariance, MarkFit, OwnShape
from measure.tone.curve import LINEAR

PIXEL = 1 / 12


def fits(seen_px: Any, sigmas: Any) -> list[Any]:
    """As matches have them: seen_px with the pixel's share."""
    blurs = np.sqrt(np.asarray(seen_px) ** 2 - PIXEL)
    return [SimpleNamespace(blur_px=blur, blur_sigma=sigma) for blur, sigma in zip(blurs, sigmas, strict=True)]


def test_a_faint_mark_gets_the_blur_of_the_others_and_those_need_none() -> None:
    shared = mark_comparison.shared_blurs(fits([1.2, 1.2, 1.21, 1.19, 0.95], [0.01, 0.01, 0.02, 0.02, 0.2]))
    assert shared[:4] == [None] * 4
    assert shared[4] is not None
    assert np.hypot(shared[4].blur_px, np.sqrt(PIXEL)) == pytest.approx(1.2, rel=0.01)
    assert not shared[4].differs


def test_a_mark_exposed_twice_may_lie_where_either_exposure_does() -> None:
    """Of four, one that lies twice on the film, 2.1 px apart: its fit is that of the mean of both."""
    matrix = draw.pixel_from_camera("0")
    grey, second = draw.frame_picture(draw.ALIKE, matrix), np.column_stack([matrix[:, :2], matrix[:, 2] + (1.7, 1.3)])
    draw.paint(grey, draw.ALIKE.marks[1].mark, draw.ALIKE.marks[1].xy_mm, second, 9000.0)
    marks = draw.measure_grey(grey, draw.ALIKE).marks
    smeared = [mark.covariance is not None and Cause.SMEAR in mark.covariance.parts for mark in marks]
    assert smeared == [mark.status is Status.WEAK for mark in marks] == [False, True, False, False]
    off, claimed = draw.center(marks[1]) - matrix @ (*draw.ALIKE.marks[1].xy_mm, 1.0), marks[1].covariance_px2
    assert claimed is not None
    assert np.hypot(*off) > 0.9
    assert off @ np.linalg.solve(claimed, off) < 4


@parametrize_with_studies("apart_px", [0.0, 0.2, 3.0], quick=(1, 2))
def test_a_mark_whose_ring_lies_apart_from_its_lines_may_lie_where_either_does(apart_px: float) -> None:
    """In all four marks alike, so that no mark differs from the others."""
    matrix = draw.pixel_from_camera("0")
    lines, rings = (draw.lay_out([MarkShape(parts)] * 4) for parts in (draw.RING_CROSS[1:], draw.RING_CROSS[:1]))
    shifted = np.column_stack([matrix[:, :2], matrix[:, 2] + apart_px * np.array([0.8, -0.6])])
    grey = draw.frame_picture(lines, matrix)
    covers = np.zeros((2, *grey.shape))
    for line, ring in zip(lines.marks, rings.marks, strict=True):
        draw.paint(covers[0], line.mark, line.xy_mm, matrix, 1.0)
        draw.paint(covers[1], ring.mark, ring.xy_mm, shifted, 1.0)
    grey += 9000 * covers[1] * (1 - covers[0])
    for mark, given in zip(draw.measure_grey(grey, draw.ALIKE).marks, draw.ALIKE.marks, strict=True):
        assert mark.covariance is not None
        off = draw.center(mark) - matrix @ (*given.xy_mm, 1.0)
        assert off @ np.linalg.solve(mark.covariance.px2, off) < (4 if apart_px else 16)
        assert mark.status is (Status.WEAK if apart_px > 1 else Status.MEASURED)
        assert ("its lines lie 3.0 px from its ring" in mark.reason) is (apart_px > 1)


@pytest.mark.parametrize("smear_px2", [4.0, -1.0])
def test_a_smear_is_what_a_blur_has_beyond_the_others(smear_px2: float) -> None:
    added = mark_comparison.smear_px2(np.sqrt(1.5 + smear_px2), np.sqrt(1.5))
    np.testing.assert_allclose(added, max(smear_px2, 0.0) * np.eye(2), atol=1e-12)


@pytest.mark.parametrize("sigma_px", [0.04, 0.1])
def test_a_faint_mark_claims_what_its_fit_lies_off_unless_that_is_taken(sigma_px: float) -> None:
    def faint(col: float, sigma: float) -> MarkFit:
        place = np.array([[1.0, 0.0, col], [0.0, 1.0, 7.0]])
        return MarkFit(True, NO_REASON, place[:, 2], Covariance.from_noise(sigma**2 * np.eye(2)), place)

    chosen = choose_fit(faint(5.0, 0.06), faint(5.1, sigma_px), None)
    if sigma_px < 0.06:
        assert draw.center(chosen)[0] == 5.1
    else:
        np.testing.assert_allclose(chosen.covariance_px2, np.diag([0.06**2 + 0.1**2, 0.06**2]))


def test_a_width_of_lines_that_most_crosses_show_is_taken_and_that_of_few_is_not() -> None:
    widths = [(-0.15, 0.02), (-0.13, 0.02), (-0.17, 0.03), (0.4, 0.05), None, None]
    assert mark_comparison.shared_line_width(widths) == pytest.approx(np.exp(-0.15), rel=0.03)
    assert mark_comparison.shared_line_width([*widths, None, None, None]) == 1.0
    assert mark_comparison.shared_line_width([(-0.02, 0.001)] * 4) == 1.0


def test_crosses_whose_lines_are_narrower_than_drawn_are_drawn_so_and_fitted() -> None:
    shown, given = (draw.lay_out([MarkShape(cross(2.4, mm), "dark")] * 4) for mm in (0.1, 0.12))
    matrix, size = draw.pixel_from_camera("0"), 400
    grey = 30000 + np.random.default_rng(3).normal(0, 400.0, (size, size))
    for mark in shown.marks:
        draw.paint(grey, mark.mark, mark.xy_mm, matrix, -20000.0, 55, 0.1)
    placement = Placement("0", matrix, 1.0, 4, 1, 1, (0.05, 0.05))
    begun = draw.make_scan(grey).replace_tone(LINEAR), given, placement, FiducialOptions("0")
    frame, quick = detect_frame(*begun), detect_frame(*begun, is_quick=True)
    assert quick.layout is given
    assert len(quick.inlier_fits) == 4
    drawn_mm = {round(mark.mark.thinnest_mm, 3) for mark in frame.layout.marks}
    assert len(drawn_mm) == 1
    assert min(drawn_mm) < 0.11
    for fit, mark in zip(frame.inlier_fits.values(), given.marks, strict=True):
        assert np.hypot(*(draw.center(fit) - matrix @ (*mark.xy_mm, 1.0))) < 0.05


def test_marks_of_one_blur_are_rarely_doubted_and_another_blur_is() -> None:
    rng = np.random.default_rng(1)
    doubted, found = 0, 0
    for _ in range(300):
        sigmas = rng.uniform(0.01, 0.15, 8)
        own = 1.1 * np.exp(rng.normal(0, np.hypot(sigmas, 0.05)))
        doubted += any(each is not None and each.differs for each in mark_comparison.shared_blurs(fits(own, sigmas)))
        own[0], sigmas[0] = 0.6, 0.08
        shared = mark_comparison.shared_blurs(fits(own, sigmas))[0]
        found += shared is not None and shared.differs
    assert doubted <= 12  # 1 in 100, and more for how much they differ is an estimate itself
    assert found > 270


def test_how_much_blurs_differ_from_mark_to_mark_comes_out_as_it_was_drawn() -> None:
    """By the moments of marks that tell their blurs unequally well: the square is unbiased."""
    rng, between, squares = np.random.default_rng(6), 0.25, []
    sigmas = np.array([0.03, 0.05, 0.08, 0.12, 0.2, 0.2, 0.1])
    for _ in range(400):
        own = 1.1 * np.exp(rng.normal(0, np.hypot(sigmas, between)))
        shared = mark_comparison.shared_blurs(fits(np.append(own, 1.1), [*sigmas, 0.3]))[-1]
        assert shared is not None
        squares.append(shared.sigma**2)
    of_mean = 1 / np.sum(1 / (sigmas**2 + between**2 + 0.05**2))
    expected = between**2 + 0.05**2 + of_mean
    assert np.mean(squares) == pytest.approx(expected, rel=0.08)


def test_a_match_with_the_others_blur_rarely_contradicts_it_unless_its_own_is_another() -> None:
    rng, others_sigma, own_sigma = np.random.default_rng(3), 0.06, 0.1
    result, weight = (
        mark_comparison.SharedBlur(np.sqrt(1.1**2 - PIXEL), others_sigma, False),
        others_sigma**2 / (0.06**2 + 0.1**2),
    )
    sigma = others_sigma * np.sqrt(1 - weight)  # of the weighted mean of both
    good = 1.1 * np.exp(weight * rng.normal(0, np.hypot(others_sigma, own_sigma), 2000))
    other = 1.1 * np.exp(weight * rng.normal(np.log(0.6), own_sigma, 2000))
    contradicted, found = (
        sum(not result.is_confirmed(fit) for fit in fits(v, [sigma] * len(v))) for v in (good, other)
    )
    assert 8 <= contradicted <= 34  # 1 in 100
    assert found > 1800
    assert not result.is_confirmed(fits([1.1], [np.inf])[0])


@pytest.mark.parametrize("figures", [1, 2])
def test_marks_of_one_size_and_turn_are_rarely_doubted_and_another_is(figures: int) -> None:
    rng, doubted, found = np.random.default_rng(2), 0, 0
    for _ in range(300):
        sigmas = rng.uniform(0.005, 0.05, (5, figures))
        changes = 0.08 + rng.normal(0, np.hypot(sigmas, 0.014))  # of all alike: the drawing's fault
        doubted += any(shape is not None and shape.differs for shape in mark_comparison.shared_shapes(changes, sigmas))
        changes[0], sigmas[0] = changes[0] - 0.24 * (np.arange(figures) == 0), 0.02
        odd = mark_comparison.shared_shapes(changes, sigmas)[0]
        found += odd is not None and odd.differs and abs(odd.off[0] + 0.24) < 0.1
    assert doubted <= 12
    assert found > 270


def test_what_touches_one_side_of_a_dot_widens_its_variance_and_chance_hardly_does() -> None:
    rng, angle = np.random.default_rng(3), np.radians(np.arange(360.0))
    radius_px, known_px = 5.4, 0.05
    outline = np.column_stack([np.ones(360), np.cos(angle), np.sin(angle)])
    off, widened, chance = [], [], []
    for _ in range(500):
        # One side of the outline lies elsewhere: the circle through it is what least squares make of it.
        moved = np.where(angle < rng.uniform(0.5, 2.0), rng.normal(0.0, 2.0), 0.0)
        size, *place = np.linalg.lstsq(outline, moved, rcond=None)[0] + rng.normal(0.0, known_px, 3)
        off.append(np.hypot(*place))
        widened.append(touch(1 + size / radius_px, known_px / radius_px, radius_px).variance_px2)
        chance.append(touch(np.exp(rng.normal(0.0, known_px / radius_px)), known_px / radius_px, radius_px))
    sigmas = np.array(off) / np.hypot(known_px, np.sqrt(widened))
    assert np.mean(np.array(off) > 0.5) > 0.2
    assert sigmas[np.array(off) > 0.5].max() < 5.0
    assert np.mean([each.variance_px2 for each in chance]) < 0.05 * known_px**2


def touch(ratio: float, sigma: float, radius_px: float, px_per_mm: float = 36.0) -> mark_comparison.Touch:
    shape = mark_comparison.SharedShape(np.log([ratio]), np.array([sigma]), differs=False)
    return mark_comparison.touch_of_round(shape, radius_px, px_per_mm, is_damaged=False)


PX_PER_MM, SIDE_PX, AT_MM = 10.0, 600, 20.0
PLACES = [(x, y) for y in (-AT_MM, 0.0, AT_MM) for x in (-AT_MM, 0.0, AT_MM) if x or y]
GROUND, CONTRAST, NOISE = 30000.0, 16000.0, 800.0  # 20 times the noise
FAINT = (0, 3, 6)


def make_frame(
    rng: np.random.Generator, blur_px: float, share: float
) -> tuple[Frame, list[tuple[TrueMark, np.ndarray]]]:
    """A frame of eight crosses with gaps, three of them with a share of the others' contrast: as it was measured, and
    each mark with its first pixel."""
    kind, middle = KIND["gap cross"], SIDE_PX / 2 + rng.uniform(-0.5, 0.5, 2)
    layout = tuple(LayoutMark(str(n), place, (0.005, 0.005), kind.shape) for n, place in enumerate(PLACES))
    linear = PX_PER_MM * np.diag([1.0, -1.0])
    grey, marks = GROUND + NOISE * rng.standard_normal((SIDE_PX, SIDE_PX)), []
    for number, place in enumerate(PLACES):
        some = some_mark(kind, blur_px * float(np.exp(rng.normal(0, 0.05))), rng)
        corner = np.rint(linear @ place + middle).astype(int) - some.size // 2
        mark = replace(some, place=np.column_stack([linear, linear @ place + middle - corner]))
        contrast = CONTRAST * (share if number in FAINT else 1.0)
        grey[corner[1] :, corner[0] :][: mark.size, : mark.size] += contrast * mark.picture
        marks.append((mark, corner))
    scan = draw.make_scan(grey)
    placed = np.column_stack([1.001 * linear, middle + np.array([1.0, -1.0])])
    placement = Placement("0", placed, 8.0, 8, 1, 1, (1 / PX_PER_MM, 1 / PX_PER_MM))
    return measure_frame(scan, FiducialLayout(layout, (50.0, 50.0)), placement, FiducialOptions()), marks


@pytest.fixture(scope="module")
def plain() -> Frame:
    """Of which all marks are measured."""
    return make_frame(np.random.default_rng(3), 1.0, 1.0)[0]


@pytest.mark.parametrize(("axis", "is_inlier"), [((1.0, 1.0), True), ((1.0, -1.0), False)])
def test_an_error_along_the_long_axis_of_its_ellipse_is_no_gross_error(
    plain: Frame, axis: tuple[float, float], is_inlier: bool
) -> None:
    """All marks have an ellipse that leans to the right and down in the scan; one lies off along it, or across it."""
    leaning = Covariance.from_noise(2.0**2 * np.full((2, 2), 0.5) + 0.05**2 * np.array([[0.5, -0.5], [-0.5, 0.5]]))
    fits = {index: replace(fit, place_covariance=leaning) for index, fit in plain.inlier_fits.items()}
    fits[4] = fits[4].shifted(np.sqrt(2.0) * np.array(axis))
    assert orient_frame(plain.replace_fits(fits)).inliers.tolist() == [index != 4 or is_inlier for index in range(8)]


KNOWN = Covariance.from_noise(0.2**2 * np.eye(2))


@pytest.mark.parametrize(
    ("own", "others", "status"),
    [
        # In white noise a claim of 0.2 px is one; on a landscape it knows of the noise in part.
        ({"place_covariance": KNOWN, "covariance_is_white": True}, {}, Status.MEASURED),
        ({"place_covariance": KNOWN, "covariance_is_white": False}, {}, Status.WEAK),
        # What all marks lack alike is the drawing's.
        ({"damaged_fraction": 0.27}, {"damaged_fraction": 0.0}, Status.WEAK),
        ({"damaged_fraction": 0.27}, {"damaged_fraction": 0.2}, Status.MEASURED),
        ({"damaged_fraction": 0.4}, {"damaged_fraction": 0.4}, Status.WEAK),
        # A place that hangs on a remnant, however little is damaged.
        ({"damaged_fraction": 0.05, "lost_fraction": 0.5}, {}, Status.MEASURED),
        ({"damaged_fraction": 0.05, "lost_fraction": 0.95}, {}, Status.WEAK),
        # A contrast within that of the texture is plain where all of the mark tells it.
        ({"noise_dn": CONTRAST / 2, "significance": 9.0}, {}, Status.WEAK),
        ({"noise_dn": CONTRAST / 2, "significance": 15.0}, {}, Status.MEASURED),
    ],
)
def test_the_verdict_on_a_mark(plain: Frame, own: dict[str, Any], others: dict[str, Any], status: Status) -> None:
    fits = {k: replace(fit, **(others if k else own)) for k, fit in plain.inlier_fits.items()}
    assert plain.replace_fits(fits).verdict(0)[0] is status


def test_a_size_that_edges_leave_open_is_a_finite_figure(plain: Frame) -> None:
    wedge, open_size = MarkShape(polygon([(0, 0), (0.9, -0.5), (0.9, 0.5)])), np.array([5e3, 0.1])
    layout = replace(plain.layout, marks=tuple(replace(mark, mark=wedge) for mark in plain.layout.marks))
    shapes = {n: OwnShape(np.array([5e4 * n, 0.0]), open_size, np.zeros((2, 2))) for n in plain.inlier_fits}
    fits = {n: replace(fit, own_shape=shapes[n]) for n, fit in plain.inlier_fits.items()}
    compared = compare_shapes(replace(plain, layout=layout).replace_fits(fits))
    ratios = [fit.figures["size_ratio"] for fit in compared.inlier_fits.values()]
    assert len(ratios) == len(fits)
    assert np.isfinite(ratios).all()


def test_what_widens_a_mark_is_added_to_its_covariance_under_its_cause(plain: Frame) -> None:
    before, added = plain.detections[2].fit, np.array([[4e-3, 1e-3], [1e-3, 2e-3]])
    assert before is not None
    widened = plain.detections[2].amend(parts={Cause.TOUCHED: added}).amend(parts={Cause.TOUCHED: added})
    after = widened.fit
    assert after is not None
    np.testing.assert_allclose(after.covariance_px2 - before.covariance_px2, 2 * added, atol=1e-12)
    np.testing.assert_allclose(after.place_covariance.parts[Cause.TOUCHED], 2 * added, atol=1e-12)


def test_a_frame_in_which_marks_lie_as_they_should_but_differ_from_their_drawings_says_so(plain: Frame) -> None:
    assert plain.accepted
    unlike = [
        replace(detection, fit=replace(detection.fit, likeness=0.4)) if detection.fit and number > 1 else detection
        for number, detection in enumerate(plain.detections)
    ]
    refused = replace(plain, detections=tuple(unlike))
    assert not refused.accepted
    assert explain_misfit(refused).startswith(
        "8 of 8 marks were found where the others put them, but only 2 of them match"
    )


def test_a_frame_whose_marks_do_not_converge_says_so_and_not_that_camera_and_pitch_are_wrong(plain: Frame) -> None:
    failed = [replace(each, fit=None, reason=UNSETTLED) for each in plain.detections[2:]]
    refused = orient_frame(replace(plain, detections=(*plain.detections[:2], *failed)))
    assert refused.failed_fits == [2, 3, 4, 5, 6, 7]
    reason = explain_misfit(refused)
    assert "only 2 of 8 marks" in reason
    assert "the fit of 2, 3, 4, 5, 6, 7 did not converge" in reason
    (problem,) = absent_frame(plain.scan, plain.layout, reason, 6.0, None).problems
    assert "set tone under [measure]" in problem
    assert "pitch" not in problem
    nothing = [replace(each, fit=None, reason=not_found(4.0)) for each in plain.detections[2:]]
    refused = orient_frame(replace(plain, detections=(*plain.detections[:2], *nothing)))
    assert "pitch right" in absent_frame(plain.scan, plain.layout, explain_misfit(refused), 6.0, None).problems[0]


def test_wings_of_three_marks_under_wrong_names_claim_no_more_than_the_stretch_that_these_make() -> None:
    """Given coordinates are stretched by 1 % and the marks are not: three marks cannot tell it from film."""
    rng, kind, linear = np.random.default_rng(5), KIND["wing"], PX_PER_MM * np.diag([1.0, -1.0])
    places, middle = np.array([(-AT_MM, -AT_MM), (AT_MM, -AT_MM), (AT_MM, AT_MM)]), np.full(2, SIDE_PX / 2)
    given = places * (1.01, 0.99)
    layout = tuple(LayoutMark(str(n), (x, y), (0.005, 0.005), kind.shape) for n, (x, y) in enumerate(given.tolist()))
    grey, true_px = GROUND + NOISE / 4 * rng.standard_normal((SIDE_PX, SIDE_PX)), []
    for place in places:
        some = some_mark(kind, 1.0, rng)
        corner = np.rint(linear @ place + middle).astype(int) - some.size // 2
        mark = replace(some, place=np.column_stack([linear, linear @ place + middle - corner]))
        grey[corner[1] :, corner[0] :][: mark.size, : mark.size] += CONTRAST * mark.picture
        true_px.append(linear @ place + middle)
    scan = draw.make_scan(grey)
    placement = Placement("0", np.column_stack([linear, middle]), 8.0, 3, 1, 1, (1 / PX_PER_MM, 1 / PX_PER_MM))
    frame = measure_frame(scan, FiducialLayout(layout, (50.0, 50.0)), placement, FiducialOptions())
    for fit, place in zip(frame.inlier_fits.values(), true_px, strict=True):
        assert draw.chi_square(fit, place) < 16.0
