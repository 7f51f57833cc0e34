"""Dots of a sheet get their names from two codes and the sheet alone: right ones or none."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure.targets.sheets import Dots, Naming, name_dots

Array = NDArray[np.float64]
SIZE = (2200, 1700)
DIAGONAL = float(np.hypot(*SIZE))


@dataclass(frozen=True, eq=False)
class View:
    """A sheet (n, 2), its dots and others; origin (m,): the point that each dot is, -1 for none."""

    sheet: Array
    dots: Dots
    origin: NDArray[np.int64]
    visible: int

    def wrong(self, naming: Naming) -> int:
        return sum(self.origin[dot] != point for point, dot in naming.named.items())


def view_sheet(rng: np.random.Generator, columns: int, rows: int, codes: int, uneven: float = 0.0) -> View:
    """A sheet under a pinhole camera with a lens of up to 15 % distortion, rolled anyhow; a fifth of its dots missing,
    a fifth as many false ones."""
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    middle = grid.mean(axis=0)
    height = uneven * np.sin(grid[:, 0] / 2.5) * np.cos(grid[:, 1] / 3.5)
    board = np.column_stack([grid - middle, height])
    tilt, around, roll = np.radians(rng.uniform(0, 50)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    turn = rotation_matrix(2, roll) @ rotation_matrix(0, np.pi + tilt) @ rotation_matrix(2, around)
    distance = 1.25 * max(columns, rows)
    bend = rng.uniform(-0.15, 0.1)

    def project(points: Array) -> Array:
        camera = points @ turn.T + np.array([0.0, 0.0, distance])
        ideal = camera[:, :2] / camera[:, 2:]
        r2 = (ideal**2).sum(axis=1, keepdims=True) / 0.5
        place = ideal * (1 + bend * r2)
        return np.asarray(place * DIAGONAL / 1.4 + (np.array(SIZE) - 1) / 2 + (30.0, -20.0))

    places, radius = project(board), 0.15
    across, up = (project(board + radius * axis) for axis in np.eye(3)[:2])
    spin = np.einsum("nik,nkj->nij", np.stack([across - places, up - places], axis=-1), spins(rng, len(grid)))
    inside = np.all((places > 5) & (places < np.array(SIZE) - 6), axis=1)
    found = np.flatnonzero(inside & (rng.random(len(grid)) < 0.8))
    false = int(0.2 * len(grid))
    centers = np.concatenate(
        [places[found] + rng.normal(0, 0.3, (len(found), 2)), rng.uniform(0, 1, (false, 2)) * SIZE]
    )
    shapes = np.concatenate(
        [spin[found] * rng.uniform(0.95, 1.05, (len(found), 1, 1)), np.tile(9 * np.eye(2), (false, 1, 1))]
    )
    origin = np.concatenate([found, np.full(false, -1)])
    coded = {int(dot): int(found[dot]) for dot in rng.choice(len(found), codes, replace=False)}
    return View(grid, Dots(centers, shapes, coded), origin, int(inside.sum()))


def rotation_matrix(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.roll(np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]), axis, axis=(0, 1))
    return np.asarray(turn)


def spins(rng: np.random.Generator, count: int) -> Array:
    """An ellipse says nothing of the turn of its circle."""
    return np.stack([rotation_matrix(2, angle)[:2, :2] for angle in rng.uniform(0, 2 * np.pi, count)])


@parametrize_with_studies(
    ("columns", "rows", "codes", "views"), [(10, 10, 4, 8), (10, 10, 2, 8), (23, 21, 6, 2)], quick=(2,)
)
def test_a_fifth_missing_and_a_fifth_false(columns: int, rows: int, codes: int, views: int) -> None:
    rng = np.random.default_rng(columns + codes)
    for _ in range(views):
        view = view_sheet(rng, columns, rows, codes)
        naming = name_dots(view.sheet, view.dots, SIZE)
        assert isinstance(naming, Naming), naming
        assert view.wrong(naming) == 0
        assert len(naming.named) >= 0.93 * np.sum(view.origin >= 0)
        assert not naming.misread


@pytest.mark.study
def test_codes_misread_are_outvoted_or_nothing_is_named() -> None:
    rng = np.random.default_rng(3)
    for _ in range(2):
        view = view_sheet(rng, 8, 8, 5)
        points = dict(view.dots.coded)
        one_wrong = {**points, next(iter(points)): int(rng.integers(0, 64))}
        naming = name_dots(view.sheet, replace(view.dots, coded=one_wrong), SIZE)
        assert isinstance(naming, Naming)
        assert view.wrong(naming) == 0
        all_wrong = {dot: int(point) for dot, point in zip(points, rng.integers(0, 64, 5), strict=True)}
        naming = name_dots(view.sheet, replace(view.dots, coded=all_wrong), SIZE)
        assert isinstance(naming, str)
        assert "do not put the other points" in naming or "no two" in naming


def test_one_code_is_not_enough() -> None:
    view = view_sheet(np.random.default_rng(4), 10, 10, 1)
    naming = name_dots(view.sheet, view.dots, SIZE)
    assert naming == "1 coded targets of the sheet were recognised, and two are needed"


def test_a_sheet_that_is_not_quite_flat() -> None:
    """Bumps of 6 % of a step, three times what the sheet of a camera calibration was found to have."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        view = view_sheet(rng, 10, 10, 4, uneven=0.06)
        naming = name_dots(view.sheet, view.dots, SIZE)
        assert isinstance(naming, Naming), naming
        assert view.wrong(naming) == 0
        assert len(naming.named) >= 0.9 * np.sum(view.origin >= 0)


def test_two_codes_of_different_sheets_name_nothing() -> None:
    """Of one sheet the upper half is seen, of another one like it the lower half; a view through a dot of each may turn
    its back on the sheet."""
    sheet = np.array([(48.0 * column, 48.0 * row) for row in range(6) for column in range(7)])
    moved = np.where(sheet[:, 1:] < 120.0, (0.0, 0.0), (227.66576879, -132.54003258))
    centers = sheet * (1.0, -1.0) + (100.0, 400.0) + moved
    shapes = np.repeat(np.diag([7.3, -7.3])[None], 42, axis=0)
    shapes[0] = shapes[0] @ np.array([[1.0, -0.5948923], [0.0, 1.07725307]])
    named = name_dots(sheet, Dots(centers, shapes, {21: 21, 0: 0}), (1300, 950))
    assert isinstance(named, str)
    assert "do not put the other points of the sheet where dots are" in named
