"""Scan orientation from the text on a frame.

A line is legible in its right orientation, and less so mirrored or upside down. Under the right scan orientation all
lines are legible from one side of the film, and titles and the camera's plate lie at the sides, and in the orientation,
where the camera is known to write.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from measure.annotations.fields import Line, is_of_film, is_plate, signs
from measure.geometry import pose_in_camera, up_from_camera
from measure.marks.shapes import Side, WrittenPlace

Array = NDArray[np.float64]

_A_CHARACTER = 1.4  # log-odds of an orientation for each legible character more than in another one
# Log-odds that a line lies where the camera writes rather than by chance, among four sides with two directions. On
# seven real frames none of 29 lines with a title field lay elsewhere, and other words (counted by frames, since a
# stamp may have several) on none of the seven; numbers may be written by hand at any side.
_A_FIELD, _A_WORD, _A_NUMBER = 6.2, 4.8, 3.6
_FEIGNED = 1 / 3000  # probability of misleading text: of 3000 readings with a lead of 3 characters none was wrong
_PLAINLY = 1.5  # least ratio of legible characters to those of any other orientation
_DIRECTIONS: Mapping[Side, tuple[int, int]] = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}


def writing_likelihoods(lines: Sequence[Line], places: Sequence[WrittenPlace], poses: Sequence[str]) -> Array:
    """(n,) log-likelihoods of scan orientations, 0 for the best, bounded below by the probability of misleading
    text."""
    scores = np.array([sum((line_score(line, places, pose) for line in lines), 0.0) for pose in poses])
    return bounded(scores)


def bounded(scores: Array) -> Array:
    """(n,) log-likelihoods, bounded below by the probability of misleading text."""
    return np.asarray(np.log((1 - _FEIGNED) * np.exp(scores - scores.max(initial=-np.inf)) + _FEIGNED))


def line_score(line: Line, places: Sequence[WrittenPlace], pose: str) -> float:
    """Log-likelihood of one line in a scan orientation, up to a constant of the line."""
    own = {pose_in_camera(way, pose): reading.legible for way, reading in line.ways.items()}
    upright = {way: legible for way, legible in own.items() if not way.endswith("m")}
    anyhow = _A_CHARACTER * max(upright.values())
    plate = is_plate(line)
    expected = [] if is_of_film(line) else [place for place in places if place.plate == plate]
    if not expected:
        return anyhow
    side = side_in_camera(line.side, pose)
    there = [max(upright.values()) if place.pose is None else upright.get(place.pose, 0.0)
             for place in expected if place.side == side]  # fmt: skip
    return max([anyhow - _placed(line), *(_A_CHARACTER * legible for legible in there)])


def _placed(line: Line) -> float:
    """Log-odds that a line lies where the camera writes."""
    other = _A_WORD if any(character.isalpha() for character in line.text) else _A_NUMBER
    return max(_A_FIELD * signs(line), other)


def side_in_camera(side: Side, pose: str) -> Side:
    """Side of the camera's drawing at a side of a scan with the given orientation."""
    direction = up_from_camera(pose).T @ _DIRECTIONS[side]
    return next(name for name, other in _DIRECTIONS.items() if np.allclose(direction, other))


def main_pose(lines: Sequence[Line]) -> str:
    """Orientation of most of the text in the scan; "" where another has nearly as many legible characters."""
    if not lines:
        return ""
    ways: dict[str, float] = {}
    for line in lines:
        ways[line.pose] = ways.get(line.pose, 0.0) + line.legible
    best, *others = sorted(ways, key=lambda way: -ways[way])
    return best if not others or ways[best] > _PLAINLY * ways[others[0]] else ""
