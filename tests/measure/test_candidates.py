"""What answers to a mark at reduced size."""

import numpy as np
from brute_marks import brute_picture

from measure.marks.shapes import MarkShape, ring_cross
from measure.search.correlation import WIDE


def test_a_faint_mark_beside_the_frames_edge_is_what_answers_most() -> None:
    """The edge is nine times as strong as the mark on overexposed film."""
    rng = np.random.default_rng(1)
    mark = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1), "light")
    linear = np.diag([12.0, -12.0])
    grey = np.full((180, 180), 2000.0)
    grey[30:, 30:] = 56000.0
    place = np.array([46.0, 47.0])  # its ring ends six pixels from both edges
    grey += 6000.0 * brute_picture(mark, np.column_stack([linear, place]), 180, 180, 0.8)
    grey += rng.normal(0.0, 1000.0, grey.shape)
    template = brute_picture(mark, np.column_stack([linear, [12.0, 12.0]]), 25, 25, 0.6)
    response = WIDE.correlated(WIDE.flattened(grey.astype(np.float32), 1.2, 130.0), template, 1.2)
    row, col = np.unravel_index(int(response.argmax()), response.shape)
    assert abs(col + 12 - place[0]) <= 1
    assert abs(row + 12 - place[1]) <= 1
    highest = response.max()
    response[row - 3 : row + 4, col - 3 : col + 4] = 0.0
    assert response.max() < 0.6 * highest
