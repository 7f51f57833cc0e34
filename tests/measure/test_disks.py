"""Disks against pictures drawn by brute force."""

from typing import Any

import numpy as np
import pytest
from drawn import draw, ellipse, make_scan, whitened
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import Scan
from measure.targets.block_search import Candidate
from measure.targets.detection import DiskSearch, disk_candidates
from measure.targets.disks import FittedDisk, fit_disk, fit_plain_disks

Array = NDArray[np.float64]
CONTRAST, NOISE, GROUND = 20000.0, 600.0, 12000.0


def some_ellipse(rng: np.random.Generator, radius_px: float, flatness: float) -> Array:
    turn = rng.uniform(0, np.pi)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return axes @ np.diag([radius_px, radius_px * flatness])


@parametrize_with_studies(("radius_px", "flatness"), [(3.0, 1.0), (5.0, 0.6), (9.0, 0.8)])
def test_errors_are_as_large_as_their_sigmas_say(radius_px: float, flatness: float) -> None:
    rng = np.random.default_rng(1)
    size = int(2 * radius_px + 31) | 1
    errors, offsets = [], []
    for _ in range(8):
        center, shape = size // 2 + rng.uniform(-0.5, 0.5, 2), some_ellipse(rng, radius_px, flatness)
        clean = GROUND + CONTRAST * draw(ellipse(center, shape), size, size, 0.9)
        for _ in range(6):
            scan = make_scan(clean + rng.normal(0, NOISE, clean.shape))
            disk = fit_disk(scan, center + rng.normal(0, 0.4, 2), shape * rng.uniform(0.9, 1.1))
            assert not disk.reason
            offsets.append(disk.center_px - center)
            errors.append(whitened(offsets[-1], disk.covariance_px2))
            assert disk.contrast_dn == pytest.approx(CONTRAST, rel=0.1)
            np.testing.assert_allclose(np.sort(disk.half_axes_px), [radius_px * flatness, radius_px], atol=0.25)
    assert 0.85 < np.sqrt(np.mean(np.square(errors))) < 1.15  # 96 numbers: 7.2 % standard deviation
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.01


def test_many_disks_at_once_are_placed_as_well_as_their_sigmas_say_and_odd_ones_looked_at_closer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng, alone = np.random.default_rng(3), list[Array]()

    def fit_alone(scan: Scan, center_px: Array, *others: Any) -> FittedDisk:
        alone.append(center_px)
        return fit_disk(scan, center_px, *others)

    monkeypatch.setattr("measure.targets.disks.fit_disk", fit_alone)
    picture, starts, true = np.full((240, 640), GROUND), [], []
    for number in range(40):
        corner = np.array([80 * (number % 8) + 8, 48 * (number // 8)])
        place, shape = corner + rng.uniform(23.5, 24.5, 2), some_ellipse(rng, 9.0, 0.8)
        window = picture[corner[1] : corner[1] + 48, corner[0] : corner[0] + 64]
        window += CONTRAST * draw(ellipse(place - corner, shape), 64, 48, 0.9)
        starts.append(Candidate(place + rng.normal(0, 0.2, 2), shape * rng.uniform(0.95, 1.05), CONTRAST))
        true.append(place)
    covered = true[0] - 9.0
    picture[max(round(covered[1]), 0) : round(covered[1]) + 9, round(covered[0]) : round(covered[0]) + 18] = GROUND
    disks = fit_plain_disks(make_scan(picture + rng.normal(0, NOISE, picture.shape)), starts, [10.0] * len(starts))
    errors = [whitened(disk.center_px - place, disk.covariance_px2) for disk, place in zip(disks, true, strict=True)]
    assert 0.85 < np.sqrt(np.mean(np.square(errors[1:]))) < 1.15  # 78 numbers: 8 % standard deviation
    assert all(not disk.reason and not disk.weakness for disk in disks[1:])
    assert len(alone) == 1
    assert disks[0].reason or disks[0].weakness
    for disk in disks[1:]:
        np.testing.assert_allclose(disk.half_axes_px, (9.0, 7.2), atol=0.2)
        assert abs(disk.blur_px - 0.9) < 0.15


def test_dark_disks_at_the_edge_of_the_scan_and_large_coordinates() -> None:
    rng = np.random.default_rng(2)
    picture = 30000 + rng.normal(0, 300, (60, 3000))
    center, shape = np.array([2990.3, 30.4]), some_ellipse(rng, 6.0, 0.8)
    picture[:, 2960:] -= CONTRAST * draw(ellipse(center - (2960, 0), shape), 40, 60, 0.9)
    disk = fit_disk(make_scan(picture), center + 0.5, shape)
    assert disk.contrast_dn < 0
    assert np.abs(disk.center_px - center).max() < 0.03


def field(rng: np.random.Generator, count: int) -> tuple[Array, list[Array]]:
    """A textured ground with light disks of many sizes, some dark ones, and streaks that are no disks."""
    height, width = 500, 1800
    picture = (
        GROUND + 9000 * gaussian_filter(rng.normal(size=(height, width)), 4) + rng.normal(0, NOISE, (height, width))
    )
    centers = []
    for number in range(count):
        place = np.array([60 + 105 * (number % 16), 60 + 90 * (number // 16)]) + rng.uniform(-9, 9, 2)
        corner = np.round(place).astype(int) - 24
        shape = some_ellipse(rng, rng.uniform(3, 12), rng.uniform(0.6, 1.0))
        window = picture[corner[1] : corner[1] + 49, corner[0] : corner[0] + 49]
        window += CONTRAST * draw(ellipse(place - corner, shape), 49, 49, 0.9)
        centers.append(place)
    for row in range(20, 490, 60):
        picture[row : row + 3, 10:400] += 0.6 * CONTRAST
    return picture, centers


def fitted_disks(scan: Scan, search: DiskSearch) -> list[FittedDisk]:
    """What is found in the whole frame, fitted, less what the fit refuses and soft spots."""
    found = disk_candidates(scan, search)
    fitted = (fit_disk(scan, candidate.center_px, candidate.pixel_from_disk) for candidate in found)
    return [disk for disk in fitted if not (disk.reason or disk.is_soft)]


def test_all_disks_of_a_frame_and_nothing_else() -> None:
    picture, centers = field(np.random.default_rng(3), 32)
    found = fitted_disks(make_scan(picture), DiskSearch((5.0, 30.0), "light"))
    nearest = [min(float(np.hypot(*(disk.center_px - center))) for center in centers) for disk in found]
    hit = {int(np.argmin([np.hypot(*(disk.center_px - center)) for center in centers])) for disk in found}
    assert max(nearest) < 0.5
    assert len(found) == len(hit)
    assert len(hit) >= 31


@pytest.mark.parametrize(("snr", "blur_px"), [(10.0, 0.7), (50.0, 1.5)])
def test_disks_of_all_sizes_are_found_nearly_where_they_are(snr: float, blur_px: float) -> None:
    """From every reduction of the scan, also beside its edge; 0.15 px, or three times the best there is."""
    rng = np.random.default_rng(6)
    picture, true = GROUND + rng.normal(0, CONTRAST / snr, (300, 700)), []
    for number, radius in enumerate([2.6, 4.0, 6.0, 9.0, 14.0, 21.0, 30.0]):
        for row in (60, 220):
            place = np.array([30 + 100 * number - (number == 0) * 22, row]) + rng.uniform(-0.5, 0.5, 2)
            shape = some_ellipse(rng, radius, rng.uniform(0.6, 1.0) if radius > 3 else 1.0)
            corner = np.maximum(np.round(place).astype(int) - 48, 0)
            window = picture[corner[1] : corner[1] + 97, corner[0] : corner[0] + 97]
            window += CONTRAST * draw(ellipse(place - corner, shape), window.shape[1], window.shape[0], blur_px, 5)
            true.append(place)
    found = disk_candidates(make_scan(picture), DiskSearch((5.0, 70.0), "light"))
    assert len(found) == len(true)
    for place in true:
        nearest = min(found, key=lambda disk: float(np.hypot(*(disk.center_px - place))))
        best = 1.5 / snr / np.sqrt(nearest.radius_px)  # of a circle: an edge of 2 pi r pixels, about a pixel wide
        assert np.abs(nearest.center_px - place).max() < max(0.15, 3 * best)


@pytest.mark.parametrize("diameter_px", [(1.0, 5.0), (9.0, 5.0)])
def test_bad_diameters_are_refused(diameter_px: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="the smallest first"):
        DiskSearch(diameter_px)
