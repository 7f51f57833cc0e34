"""What the writing on a frame says of its pose.

A line tells itself which way it lies in the scan: it reads better so than in a mirror or upside down, by so many
characters. Under the right pose all lines read right from the film's own face. Where the camera is known to write
beside its frames, under the right pose its titles and its own plate stand and read there as the camera has them.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from measure.annotations.fields import Line, is_of_film, is_plate, signs
from measure.geometry import pose_in_camera, up_from_camera
from measure.marks.shapes import Side, WrittenPlace

Array = NDArray[np.float64]

_A_CHARACTER = 1.4  # log-odds of a way to lie, a character that is legible in it beyond those of another way
# Log-odds that a line stands where the camera writes, and not by chance there among four sides with two directions
# each: on seven real frames no line of 29 that says a field of a title stood elsewhere; in none of the seven did other
# words, which are counted by frames, for a stamp may have several; a number may be written by hand at any side.
_A_FIELD, _A_WORD, _A_NUMBER = 6.2, 4.8, 3.6
_FEIGNED = 1 / 3000  # that what is written misleads: of so many readings none that was better by 3 characters was wrong
_PLAINLY = 1.5  # times as many characters as in any other way
_DIRECTIONS: Mapping[Side, tuple[int, int]] = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}


def writing_likelihoods(lines: Sequence[Line], places: Sequence[WrittenPlace], poses: Sequence[str]) -> Array:
    """(n,) log-likelihoods of the poses: 0 for the best, and no less than the probability that writing misleads."""
    scores = np.array([sum((line_score(line, places, pose) for line in lines), 0.0) for pose in poses])
    return bounded(scores)


def bounded(scores: Array) -> Array:
    """(n,) log-likelihoods of which none is less than the probability that writing misleads."""
    return np.asarray(np.log((1 - _FEIGNED) * np.exp(scores - scores.max(initial=-np.inf)) + _FEIGNED))


def line_score(line: Line, places: Sequence[WrittenPlace], pose: str) -> float:
    """The log-likelihood of one line in a pose, up to a constant of the line."""
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
    """The log-odds that a line stands where the camera writes."""
    other = _A_WORD if any(character.isalpha() for character in line.text) else _A_NUMBER
    return max(_A_FIELD * signs(line), other)


def side_in_camera(side: Side, pose: str) -> Side:
    """Which side of the camera's drawing lies at a side of a scan of that pose."""
    direction = up_from_camera(pose).T @ _DIRECTIONS[side]
    return next(name for name, other in _DIRECTIONS.items() if np.allclose(direction, other))


def main_pose(lines: Sequence[Line]) -> str:
    """The way in which most of the writing lies in the scan; "" where another has nearly as many
    characters."""
    if not lines:
        return ""
    ways: dict[str, float] = {}
    for line in lines:
        ways[line.pose] = ways.get(line.pose, 0.0) + line.legible
    best, *others = sorted(ways, key=lambda way: -ways[way])
    return best if not others or ways[best] > _PLAINLY * ways[others[0]] else ""
