"""What joins two scans of one frame: places of the film, matched to what their standard deviations say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from measure.flags import Cause, Status
from measure.tie_points.features import TieFrame
from measure.tie_points.joins import Joins, measure_joins

Array = NDArray[np.float64]

SIDE, ROWS, FEW_ROWS = 700, 320, 200  # px: of the picture, and of its upper part that is scanned


def picture(blur: float) -> Array:
    """Band-limited noise, whose values between pixels are known: periodic, by its spectrum."""
    rng = np.random.default_rng(2)
    spectrum = np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
    return np.asarray(np.fft.irfft2(spectrum * np.exp(-2.0 * (np.pi * blur * _frequencies()) ** 2), s=(SIDE, SIDE)))


def _frequencies() -> Array:
    return np.asarray(np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None]))


def shifted(grey: Array, col: float, row: float) -> Array:
    """The picture moved right and down, exactly."""
    turn = np.exp(-2j * np.pi * (np.fft.fftfreq(SIDE)[:, None] * row + np.fft.rfftfreq(SIDE)[None] * col))
    return np.asarray(np.fft.irfft2(np.fft.rfft2(grey) * turn, s=(SIDE, SIDE)))


def scanned(folder: Path, noise: float, rows: int = ROWS) -> tuple[list[TieFrame], Array]:
    """The left and the right part of a picture, the right one moved by a broken number of pixels, and how far."""
    rng = np.random.default_rng(3)
    grey = picture(1.2)
    grey = 30000.0 + 6000.0 * grey / grey.std()
    first, move = 230, np.array([0.37, -0.61])
    scans = {"a": grey[:rows, :480], "b": shifted(grey, *move)[:rows, first:]}
    parts = []
    for name, part in scans.items():
        stored = np.clip(np.rint(part + rng.normal(0.0, noise, part.shape)), 0, 65535).astype(np.uint16)
        tifffile.imwrite(folder / f"{name}.tif", stored)
        parts.append(TieFrame(name, folder / f"{name}.tif", np.eye(2, 3), None, np.zeros((0, 3))))
    return parts, move - (first, 0)


def off_and_sigma(joins: Joins, move: Array) -> tuple[Array, Array]:
    pairs = zip(joins.marks["a"], joins.marks["b"], strict=True)
    off, variance = [], []
    for one, other in pairs:
        assert one.center_px is not None
        assert other.center_px is not None
        assert one.covariance_px2 is not None
        assert other.covariance_px2 is not None
        off.append(other.center_px - one.center_px - move)
        variance.append(np.trace(one.covariance_px2 + other.covariance_px2) / 2.0)
    return np.array(off), np.sqrt(np.array(variance))[:, None]


@pytest.mark.study
def test_errors_of_joins_are_as_large_as_their_standard_deviations(tmp_path: Path) -> None:
    parts, move = scanned(tmp_path, 1500.0)
    joins = measure_joins(parts, 30)
    assert len(joins.marks["a"]) == 30
    off, sigma = off_and_sigma(joins, move)
    assert 0.8 < np.sqrt(np.mean((off / sigma) ** 2)) < 1.25
    assert np.abs(off.mean(axis=0)).max() < 0.02


@pytest.mark.study
def test_without_noise_what_lies_between_pixels_is_left(tmp_path: Path) -> None:
    """A hundredth of a pixel, and no less is claimed."""
    parts, move = scanned(tmp_path, 1.0)
    joins = measure_joins(parts, 30)
    off, sigma = off_and_sigma(joins, move)
    assert np.sqrt(np.mean((off / sigma) ** 2)) < 1.2
    first = joins.marks["a"][0]
    assert first.status is Status.MEASURED
    assert first.covariance is not None
    assert first.covariance.sigmas_px[Cause.INTERPOLATION] == 0.01


def test_marks_that_are_known_are_no_joins(tmp_path: Path) -> None:
    (first, second), move = scanned(tmp_path, 500.0, FEW_ROWS)
    taken = np.array([[300.0, 110.0, 60.0]])
    joins = measure_joins([replace(first, taken_px=taken), second], 8)
    off, sigma = off_and_sigma(joins, move)
    assert len(off) == 8
    assert (np.abs(off) < 3.5 * sigma).all()
    for mark in joins.marks["a"]:
        assert mark.center_px is not None
        assert np.hypot(*(mark.center_px - (300.0, 110.0))) > 60.0


def test_a_scan_that_cannot_be_read_costs_the_other_nothing(tmp_path: Path) -> None:
    parts, _ = scanned(tmp_path, 500.0)
    (tmp_path / "b.tif").write_bytes(b"no picture")
    joins = measure_joins(parts)
    assert "It is not joined to the other scans of its frame" in joins.problems["b"]
