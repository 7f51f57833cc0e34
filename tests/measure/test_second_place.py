"""Second places of marks, pictures unlike the drawing, and marks at the Cramér-Rao bound."""

from dataclasses import replace

import numpy as np
from drawn import Array, draw, ellipse, make_scan
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import chdtrc
from true_marks import ALL_MOVES, KIND, Kind, TrueMark, grainy, some_mark, whitened_rms
from true_marks import WING as TRUE_WING

from measure import FiducialOptions, MatchOptions, ScanWindow, match, measure_fiducials
from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.flags import Cause
from measure.marks import shapes
from measure.matching.covariance import LinearFit
from measure.noise.noise_model import NoiseModel, combine, inner_products
from measure.results import MarkFit, SecondPlace
from measure.targets.disks import UNIT_DISK, fit_disk

CONTRAST = 500.0
DISK_SIZE, RADIUS = 31, 3.0
DISK_PLACE = np.array([15.2, 14.7])


def disks(slope: float, sigma: float, count: int) -> list[MarkFit]:
    """Disks whose paint is darker by slope times the contrast a radius to the right."""
    start = np.column_stack([RADIUS * np.eye(2), DISK_PLACE])
    inside = ellipse(DISK_PLACE, RADIUS * np.eye(2))

    def painted(col: Array, row: Array) -> Array:
        return np.asarray(inside(col, row) * (1 + slope * (col - DISK_PLACE[0]) / RADIUS))

    grey, rng = 1000 - CONTRAST * draw(painted, DISK_SIZE, DISK_SIZE, 1.0), np.random.default_rng(5)
    options = MatchOptions(freedom="ellipse")
    return [match(ScanWindow(grey + rng.normal(0, sigma, grey.shape)), UNIT_DISK, start, options) for _ in range(count)]


def chances(places: list[SecondPlace | None]) -> Array:
    assert all(place is not None for place in places)
    return np.array([chdtrc(2, place.sigmas**2) for place in places if place is not None])


def assert_as_likely(found: Array) -> None:
    """Of forty probabilities: each as likely as any other."""
    assert len(found) == 40
    assert 0.33 < found.mean() < 0.67  # 0.5 within 3.7 of its standard deviations
    assert found.min() > 1e-4


def test_noise_alone_makes_every_probability_of_sloping_paint_as_likely() -> None:
    assert_as_likely(chances([fit.sloping for fit in disks(0.0, 20.0, 40)]))


def test_where_paint_slopes_its_place_is_nearer_than_the_matched_one() -> None:
    (fit,) = disks(0.1, 1.0, 1)
    assert fit.sloping is not None
    off = np.hypot(*(fit.center_px - DISK_PLACE))
    assert off > 0.05
    assert np.hypot(*(fit.center_px + fit.sloping.offset_px - DISK_PLACE)) < 0.7 * off
    assert chdtrc(2, fit.sloping.sigmas**2) < 1e-6


CROSS = shapes.MarkShape(shapes.cross(1.5, 0.15))
FOLD, SPARE_PX = 4, 6
SHIFTS = ((2, 0), (0, 2), (1, 1), (3, 2), (2, 3))


def coarse(fine: NDArray[np.float64], col: int, row: int) -> NDArray[np.float64]:
    """Means over squares of its pixels, the first of which begins at a column and a row."""
    rows = len(fine) // FOLD - 1
    part = fine[row : row + rows * FOLD, col : col + rows * FOLD]
    return np.asarray(part.reshape(rows, FOLD, rows, FOLD).mean(axis=(1, 3)))


def ragged(axis: int, rng: np.random.Generator) -> list[shapes.Bar]:
    """The pieces of a line of 3 mm along an axis."""
    ends, off_mm = np.linspace(-1.5, 1.5, 31).tolist(), rng.normal(0, 0.008, 30).tolist()

    def place(along: float, off: float) -> tuple[float, float]:
        return (off, along) if axis else (along, off)

    pieces = zip(ends[:-1], ends[1:], off_mm, strict=True)
    return [shapes.Bar(place(begin, off), place(end, off), 0.15) for begin, end, off in pieces]


def test_ragged_lines_are_known_as_badly_as_they_are() -> None:
    """Each pixel's length of them lies elsewhere by 0.08 px, one standard deviation. The ground is clear, and would let
    a cross be known three times as well as it is."""
    rng, errors, known, by_noise = np.random.default_rng(4), [], [], []
    for _ in range(8):
        mark = some_mark(Kind("ragged", shapes.MarkShape((*ragged(0, rng), *ragged(1, rng)))), 1.0, rng)
        grey = 1000 * mark.picture + rng.normal(0, 10, (mark.size, mark.size))
        fit = match(ScanWindow(grey), CROSS, mark.place, MatchOptions())
        errors.append(fit.center_px - mark.place[:, 2])
        known.append(fit.covariance_px2)
        by_noise.append(fit.place_covariance.parts[Cause.NOISE])
    assert whitened_rms(errors, by_noise) > 2.3
    assert whitened_rms(errors, known) < 1.7


def test_a_mark_in_a_textured_border_is_known_as_badly_as_it_is() -> None:
    """Its blotches are cut out as damage, and bend its edges all the same; outside of it there is hardly any noise."""
    rng, errors, known, without = np.random.default_rng(6), [], [], []
    block = shapes.MarkShape(shapes.polygon(((0.0, 0.0), (1.2, 1.2), (3.0, 1.2), (3.0, -1.2), (1.2, -1.2))))
    for _ in range(8):
        mark = some_mark(Kind("block", block), 0.8, rng)
        texture = gaussian_filter(rng.normal(size=(mark.size, mark.size)), 2.0)
        light = 1.0 - mark.picture * (1.0 + 0.1 * texture / texture.std())
        fit = match(ScanWindow(20000 * light + rng.normal(0, 300, light.shape)), block, mark.place, MatchOptions())
        errors.append(fit.center_px - mark.place[:, 2])
        known.append(fit.covariance_px2)
        without.append(fit.covariance_px2 - fit.place_covariance.parts[Cause.TEXTURE])
    assert whitened_rms(errors, without) > 2.0
    assert 0.6 < whitened_rms(errors, known) < 1.3


def test_what_damage_leaves_next_to_itself_is_a_cause_of_a_marks_covariance() -> None:
    """A region of 4 x 4 px on a line, of which the pixels about it may have any amount up to what is cut out."""
    line = -np.gradient(np.exp(-((np.mgrid[0:40, 0:40][1] - 19.5) ** 2) / 2), axis=1)
    design, used = np.stack([line, line.T, np.ones_like(line)]), np.ones(line.shape, dtype=bool)
    damaged = np.zeros_like(used)
    damaged[10:14, 20:24] = True
    by_grey = combine(np.asarray(np.linalg.inv(inner_products(design, design)), np.float64), design)
    noise = NoiseModel(4.0, np.full((1, 1), 4.0), 0.0)
    fit = LinearFit(np.where(damaged, 1000.0, 0.0), used & ~damaged, design, by_grey, noise, np.ones_like(line))
    margin = gaussian_filter(damaged * 3.2 * 2.0, 1.0, mode="constant")
    moved = (by_grey[:2] * margin * fit.used).sum(axis=(1, 2))
    np.testing.assert_allclose(fit.damage_px2(damaged), np.outer(moved, moved) / 3, rtol=1e-6)
    assert not fit.damage_px2(np.zeros_like(used)).any()


def test_a_chip_sampled_too_coarsely_is_found_in_pictures_shifted_by_known_parts_of_a_pixel() -> None:
    rng, errors, sigmas = np.random.default_rng(1), [], []
    for name in ("wedge", "wing", "notch"):  # their edges lie on one side: what these do does not cancel
        fine = some_mark(KIND[name], 0.8, rng, 200, 32.0).picture
        chip = coarse(fine, 0, 0)[SPARE_PX:-SPARE_PX, SPARE_PX:-SPARE_PX]
        middle = (np.array(chip.shape) - 1) / 2
        drawn = shapes.MarkTemplate(chip, 1000.0, (float(middle[0]), float(middle[1])))
        for shift in SHIFTS:
            true = middle + SPARE_PX - np.array(shift) / FOLD
            start = np.column_stack([np.diag([1.0, -1.0]), np.rint(true)])
            fit = match(
                ScanWindow(100 * coarse(fine, *shift)), drawn, start, MatchOptions("shift", estimate_blur=False)
            )
            assert fit.converged
            errors.append(fit.center_px - true)
            sigmas.append(np.sqrt(np.diag(fit.covariance_px2)))
    assert np.abs(errors).max() < 0.005  # 1.6 px, with a standard deviation of 0.004, where edges are taken for damage
    assert np.sqrt(np.mean(np.square(np.divide(errors, sigmas)))) < 1.2


GROUND, PRECISION_CONTRAST = 25000.0, 15000.0


def sighted(mark: TrueMark, grey: np.ndarray, rng: np.random.Generator, quantisation_step_dn: float = 0.0) -> MarkFit:
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + rng.uniform(-1, 1, 2)])
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    scan, options = make_scan(grey, quantisation_step_dn=quantisation_step_dn), FiducialOptions().match
    fit = detect_mark(scan, MarkPrediction(mark.kind.shape, start, 3.0, 1), options, frame_sigma).fit
    assert fit is not None
    return fit


def test_marks_say_how_well_the_frame_s_stretch_and_shear_are_known_that_move_them() -> None:
    """A few marks close together, say, that are given a little off: all their tips are then off alike."""
    rng, roughly = np.random.default_rng(8), 2e-3
    dots = shapes.MarkShape((*shapes.cross(0.5, 0.15), *(shapes.Disk((1.6, y), 0.18) for y in (-0.5, 0.0, 0.5))))
    errors, covariances, best, bounds = [], [], [], []
    for kind in (KIND["wedge"], KIND["wing"], Kind("identification dots", dots, ALL_MOVES)):
        true = some_mark(replace(kind, known=roughly), 1.0, rng)
        for _ in range(4):
            unit = rng.standard_normal((true.size, true.size)) / 200
            off = rng.normal(0, roughly, len(ALL_MOVES))
            result = (np.eye(2) + np.tensordot(off, np.reshape(ALL_MOVES, (-1, 2, 2)), 1)) @ true.place[:, :2]
            predicted = TrueMark(true.kind, np.column_stack([result, true.place[:, 2]]), true.size, 1.0)
            fit = sighted(predicted, GROUND + PRECISION_CONTRAST * (true.picture + unit), rng)
            errors.append(fit.center_px - true.place[:, 2])
            covariances.append(fit.covariance_px2)
            best.append(true.best_errors(unit, 1 / 200, told=off))
            bounds.append(true.bound(1 / 200))
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(best))) < 1.15
    assert 0.9 < whitened_rms(errors, covariances) / whitened_rms(best, bounds) < 1.1


def test_faint_soft_disks_are_at_the_bound() -> None:
    rng = np.random.default_rng(7)
    mark = some_mark(KIND["ellipse"], 2.5, rng)
    beyond = []
    for _ in range(6):
        noise = rng.standard_normal((mark.size, mark.size)) / 5
        start = mark.place[:, 2] + rng.normal(0, 0.4, 2), mark.place[:, :2] * rng.uniform(0.9, 1.1)
        disk = fit_disk(make_scan(GROUND + PRECISION_CONTRAST * (mark.picture + noise)), *start)
        assert not disk.reason
        beyond.append(disk.center_px - mark.place[:, 2] - mark.best_errors(noise, 1 / 5))
    assert np.square(beyond).sum() < 6 * 0.3 * np.trace(mark.bound(1 / 5))


def test_wings_take_rotation_and_scale_from_their_frame() -> None:
    rng = np.random.default_rng(3)
    places = [(-25.0, 0.0, 90.0), (25.0, 0.0, -90.0), (0.0, 25.0, 0.0), (3.0, -25.0, 180.0)]
    marks = tuple(
        shapes.LayoutMark(
            str(number), (x, y), (0.01, 0.01), shapes.rotate_mark(shapes.MarkShape(shapes.polygon(TRUE_WING)), turn)
        )
        for number, (x, y, turn) in enumerate(places)
    )
    c, s = np.cos(0.026), np.sin(0.026)
    linear = 9.93 * np.array([[c, -s], [-s, -c]])
    grey, true = np.full((640, 640), GROUND), []
    for mark in marks:
        center = np.array([320.3, 319.8]) + linear @ mark.xy_mm
        corner = np.floor(center).astype(int) - 40
        kind = Kind(
            "wing", shapes.MarkShape(mark.mark.parts) if isinstance(mark.mark, shapes.MarkShape) else KIND["wing"].shape
        )
        shown = TrueMark(kind, np.column_stack([linear, center - corner]), 81, 1.0).picture
        grey[corner[1] : corner[1] + 81, corner[0] : corner[0] + 81] += PRECISION_CONTRAST * shown
        true.append(center)
    grey += 150 * rng.standard_normal(grey.shape)
    layout = shapes.FiducialLayout(marks, (60.0, 60.0))
    result = measure_fiducials(make_scan(grey), layout, (100.7, 100.7), FiducialOptions("0"))
    errors = [np.asarray(mark.center_px) - place for mark, place in zip(result.marks, true, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.009  # of a placement's rotation alone: 0.012 and more


def test_what_compression_hides_of_a_faint_mark_is_added_to_its_sigma() -> None:
    rng = np.random.default_rng(4)
    mark = some_mark(KIND["ring-dot"], 1.0, rng)
    grey = GROUND + PRECISION_CONTRAST * (mark.picture + grainy(mark.size, 1.0, rng) / 100)
    film, fine, coarse = (
        sighted(mark, grey, np.random.default_rng(5), step * PRECISION_CONTRAST) for step in (0.0, 0.01, 0.3)
    )
    assert np.trace(film.covariance_px2) / 2 < 0.006**2
    assert np.trace(fine.covariance_px2) / 2 < 0.012**2
    assert 0.02**2 < np.trace(coarse.covariance_px2) / 2 < 0.03**2


def test_lines_far_wider_than_the_mark_s_are_not_the_mark() -> None:
    """Handwriting, say: drawn as finely as the mark it would need more contrast than a scan has."""
    wide, fine = (shapes.MarkShape(shapes.cross(1.5, line_mm)) for line_mm in (0.5, 0.03))
    mark = TrueMark(Kind("wide cross", wide), np.array([[10.0, 0.0, 40.3], [0.0, -10.0, 39.8]]), 81, 3.0)
    grey = 30 + 200 * mark.picture + np.random.default_rng(1).normal(0, 3, mark.picture.shape)
    detection = detect_mark(make_scan(grey, 255), MarkPrediction(fine, mark.place, 3.0, 1), FiducialOptions().match)
    assert detection.fit is None
    assert "far wider than the mark's lines" in detection.reason
