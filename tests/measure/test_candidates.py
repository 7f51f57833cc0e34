"""What answers to a mark at reduced size."""

import numpy as np
from brute_marks import brute_picture
from scipy import ndimage

from measure.detection.correlation import CLOSE, GRAINY, WIDE, Surroundings
from measure.marks.shapes import MarkShape, cross, ring_cross


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


def test_lines_as_fine_as_the_grain_answer_at_a_closer_look_by_what_the_grain_hides_least() -> None:
    """Pixels are alike about the crosses, which hides what is coarse of them."""
    rng = np.random.default_rng(2)
    mark, linear = MarkShape(cross(1.75, 0.12, 0.25, 45.0), "light"), np.diag([7.8, -7.8])
    places = np.array([[60.3, 60.0], [60.1, 240.4], [239.8, 60.2], [240.0, 239.7]])
    grain = ndimage.gaussian_filter(rng.standard_normal((300, 300)), 1.0)
    grey = 20000.0 + 1300.0 * grain / grain.std() + rng.normal(0.0, 300.0, grain.shape)
    for place in places:
        grey += 3100.0 * brute_picture(mark, np.column_stack([linear, place]), 300, 300, 0.6)
    template = brute_picture(mark, np.column_stack([linear, [16.0, 16.0]]), 33, 33, 0.6)

    def stronger_elsewhere(surroundings: Surroundings) -> int:
        response = surroundings.correlated(surroundings.flattened(grey.astype(np.float32), 1.0, 130.0), template, 1.0)
        near = [np.s_[round(y) - 18 : round(y) - 13, round(x) - 18 : round(x) - 13] for x, y in places]
        weakest = min(response[each].max() for each in near)
        for each in near:
            response[each] = 0.0
        return int((response > weakest).sum())

    assert stronger_elsewhere(GRAINY) <= 2
    assert stronger_elsewhere(CLOSE) > 50
