"""Marks named with no orientation, from simulated frames; what has no names gets none."""

import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust.functional_model.rotation import rotation_from_vector
from adjust.target_identification.naming import Names, name_marks

Array = NDArray[np.float64]

C_MM, HALF_MM, SIGMA_MM = 50.0, np.array([18.0, 12.0]), 0.003


def photographed(xyz: Array, rng: np.random.Generator, share: float = 0.2) -> tuple[Array, NDArray[np.intp]]:
    """Marks (m, 2) from an oblique side, a share of the points missing and as many marks that are none; their points
    (m,), -1 for none. The true principal distance is 2 % longer than the given one, and there is barrel distortion."""
    rotation = rotation_from_vector(rng.uniform(-3, 3) * np.eye(3)[2]) @ rotation_from_vector(np.array([0.5, -0.3, 0]))
    camera = xyz @ rotation.T - (0.02, -0.03, 1.7)
    p = camera[:, :2] / -camera[:, 2:]
    xy = 1.02 * C_MM * p * (1.0 - 0.1 * (p**2).sum(axis=1, keepdims=True)) + rng.normal(0.0, SIGMA_MM, p.shape)
    view = np.flatnonzero((np.abs(xy) < HALF_MM).all(axis=1) & (rng.random(len(xy)) >= share))
    false = rng.uniform(-HALF_MM, HALF_MM, (round(share * len(xyz)), 2))
    order = rng.permutation(len(view) + len(false))
    point = np.append(view, np.full(len(false), -1))[order]
    return np.concatenate([xy[view], false])[order], point


def named(xyz: Array, xy_mm: Array, normals: Array | None = None) -> Names | str:
    unknown = np.full(xyz.shape, np.nan)
    return name_marks(xyz, unknown if normals is None else normals, xy_mm, (-HALF_MM, HALF_MM), C_MM, SIGMA_MM)


def lattice(columns: int, rows: int, jitter: float, rng: np.random.Generator) -> Array:
    xy = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    moved = (xy - (columns / 2, rows / 2) + rng.uniform(-jitter, jitter, xy.shape)) / columns
    return np.column_stack([moved, np.zeros(len(xy))])


@parametrize_with_studies(("points", "depth"), [(20, 0.5), (60, 0.3), (60, 0.0)])
def test_a_fifth_missing_and_a_fifth_false(points: int, depth: float) -> None:
    rng = np.random.default_rng([points, round(10 * depth)])
    xyz = rng.uniform(-0.5, 0.5, (points, 3)) * (0.9, 0.6, depth)
    marks, point = photographed(xyz, rng)
    names = named(xyz, marks)
    assert isinstance(names, Names), names
    assert all(point[mark] == own for own, mark in names.mark.items())
    assert len(names.mark) >= 0.9 * (point >= 0).sum()
    assert names.log10_false_alarms < -10.0


@pytest.mark.study
def test_marks_of_nothing_known_get_no_names() -> None:
    rng = np.random.default_rng(4)
    xyz = rng.uniform(-0.5, 0.5, (14, 3))
    refused = named(xyz, rng.uniform(-HALF_MM, HALF_MM, (16, 2)))
    assert isinstance(refused, str)
    assert "do not make the pattern" in refused
    refused = named(xyz, rng.uniform(-HALF_MM, HALF_MM, (4, 2)))
    assert isinstance(refused, str)
    assert "too few" in refused


@pytest.mark.parametrize(("columns", "hidden", "words"), [(9, 0, "as a regular grid does"), (6, 3, "about as closely")])
def test_a_regular_grid_has_no_names_of_its_own(columns: int, hidden: int, words: str) -> None:
    """Nor do marks that are left out tell where it begins."""
    rng = np.random.default_rng(5 + hidden)
    xyz = lattice(columns, 6, 0.0, rng)[hidden:]
    refused = named(xyz, photographed(xyz, rng)[0])
    assert isinstance(refused, str)
    assert words in refused


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.study) for seed in (1, 2))])
def test_a_grid_off_by_a_twentieth_of_its_step_is_known_by_how_closely_its_marks_agree(seed: int) -> None:
    """Moved on or turned, it agrees with most of the marks as well, but not as closely."""
    rng = np.random.default_rng([9, seed])
    xyz = lattice(6, 6, 0.05, rng) * 0.9
    marks, point = photographed(xyz, rng)
    names = named(xyz, marks)
    assert isinstance(names, Names), names
    assert all(point[mark] == own for own, mark in names.mark.items())


@pytest.mark.study
def test_a_field_viewed_from_behind_is_no_other_naming() -> None:
    """A lattice that is its own mirror image may be seen from either side, unless it is known where its points face."""
    rng = np.random.default_rng(6)
    half = lattice(6, 5, 0.3, rng)
    half[:, 0] += 0.65
    xyz = np.concatenate([half, half * (-1.0, 1.0, 1.0)]) * 0.6
    marks, point = photographed(xyz, rng, 0.1)
    assert isinstance(named(xyz, marks), str)
    names = named(xyz, marks, np.tile([0.0, 0.0, 1.0], (len(xyz), 1)))
    assert isinstance(names, Names), names
    assert all(point[mark] == own for own, mark in names.mark.items())
