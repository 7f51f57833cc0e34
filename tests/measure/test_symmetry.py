"""Origins of learned marks that look alike however their frame lies, against pictures turned by hand."""

import numpy as np
import pytest
from brute_marks import brute_picture

from measure.geometry import POSES, up_from_camera
from measure.marks.shapes import MarkShape, MarkTemplate, cross, polygon
from measure.marks.templates import share_origins

PLACES = np.array([(6.0, -6.0), (-6.0, -6.0), (-6.0, 6.0), (6.0, 6.0)])
SIDE, PX_PER_MM = 61, 20.0


def clicked(shape: MarkShape, off_mm: np.ndarray, rng: np.random.Generator) -> MarkTemplate:
    """A picture of the mark whose origin, in its middle, lies beside the mark's own by off_mm."""
    middle = np.full(2, SIDE // 2)
    place = np.column_stack([PX_PER_MM * np.diag([1.0, -1.0]), middle - PX_PER_MM * np.array([1.0, -1.0]) * off_mm])
    grey = 100.0 * brute_picture(shape, place, SIDE, SIDE, 1.0) + rng.normal(0, 4.0, (SIDE, SIDE))
    return MarkTemplate(grey, 1000 / PX_PER_MM, (SIDE // 2, SIDE // 2), learned_mm=3.0)


def test_origins_of_crosses_are_laid_in_their_middles() -> None:
    rng = np.random.default_rng(1)
    off = rng.normal(0, 0.1, (4, 2))
    templates, moves = share_origins([clicked(MarkShape(cross(1.0, 0.2)), each, rng) for each in off], PLACES, POSES)
    assert templates[0].alike == POSES[1:]
    np.testing.assert_allclose(moves, -off, atol=0.05 / PX_PER_MM)
    for template, move in zip(templates, moves, strict=True):
        shift = (np.array(template.origin_px) - SIDE // 2) / PX_PER_MM * (1.0, -1.0)
        np.testing.assert_allclose(shift, move, atol=1e-9)


def test_marks_that_are_each_turned_with_their_place_keep_what_nothing_tells() -> None:
    """Half-wedges of a frame that looks alike turned by quarters: their origins come to lie alike, at no tips."""
    rng = np.random.default_rng(2)
    outline = np.array([(0.0, 0.0), (1.0, 0.1), (1.0, 0.9)])
    quarters = [up_from_camera(pose) for pose in ("0", "270", "180", "90")]  # from one corner to the next
    off = rng.normal(0, 0.1, (4, 2))
    shapes = [MarkShape(polygon(tuple(map(tuple, (outline @ turn.T).tolist())))) for turn in quarters]
    templates, moves = share_origins([clicked(*each, rng) for each in zip(shapes, off, strict=True)], PLACES, POSES)
    assert templates[0].alike == ("90", "180", "270")
    left = off + moves  # of the origins from the tips: alike once each is turned back
    turned_back = np.array([turn.T @ each for turn, each in zip(quarters, left, strict=True)])
    np.testing.assert_allclose(turned_back, np.broadcast_to(turned_back.mean(axis=0), (4, 2)), atol=0.15 / PX_PER_MM)


@pytest.mark.parametrize("places", [PLACES, PLACES * (1.0, 0.5)])
def test_marks_that_differ_stay_as_they_were(places: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    shapes = [MarkShape(cross(1.0, 0.2)), *(MarkShape(polygon(((0.0, 0.0), (1.1, 0.2), (0.4, 0.8)))) for _ in range(3))]
    marks = [clicked(shape, np.zeros(2), rng) for shape in shapes]
    templates, moves = share_origins(marks, places, POSES)
    assert templates == marks
    assert not moves.any()
