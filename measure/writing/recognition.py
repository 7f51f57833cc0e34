"""The characters of one line of writing, in the four ways in which it may lie along its own direction."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from measure.writing.line import Reading
from measure.writing.networks import Networks

Picture = NDArray[np.uint8]

WAYS = ("0", "180", "0m", "180m")  # in which a line may lie that runs from left to right
HEIGHT_PX = 48  # of a line, as the network reads it
_SURE = 0.5  # a character of this confidence counts nothing, one of 1 as a whole
_BLANK, _BLANK_COLUMNS = 1.5, 1.5  # times the usual step from letter to letter, and columns more than it
_PLAIN = str.maketrans("′’‘´`″“”：，。．（）－—–／", "'''''\"\"\":,..()---/")  # signs for which the network knows many


def read_ways(line: Picture, networks: Networks) -> Mapping[str, Reading]:
    """A line's picture (HEIGHT_PX, width) as it reads upright, turned by half, mirrored, and both, by pose."""
    ways = (line, line[::-1, ::-1], line[:, ::-1], line[::-1])
    return dict(zip(WAYS, _read(ways, networks), strict=True))


def _read(pictures: Sequence[Picture], networks: Networks) -> list[Reading]:
    grey = np.stack(pictures).astype(np.float32) / 127.5 - 1.0
    networks.recognition.setInput(np.ascontiguousarray(np.repeat(grey[:, None], 3, axis=1)))
    return [_decoded(np.asarray(each), networks.characters) for each in networks.recognition.forward()]


def _decoded(probabilities: NDArray[np.float32], characters: Sequence[str]) -> Reading:
    """The likeliest character of each column (columns, characters): one that repeats at once is one, the first of all
    is none (connectionist temporal classification). What no Latin keyboard writes is not taken for writing."""
    best = probabilities.argmax(axis=1)
    starts = np.flatnonzero((best > 0) & np.concatenate([[True], best[1:] != best[:-1]]))
    read = [characters[best[column]].translate(_PLAIN) for column in starts]
    kept = [index for index, character in enumerate(read) if character.isascii()]
    starts, text = starts[kept], "".join(read[index] for index in kept)
    letters = np.array([letter != " " for letter in text], dtype=bool)
    confidences = probabilities.max(axis=1)[starts][letters].astype(float)
    legible = float(((confidences - _SURE) / (1.0 - _SURE)).clip(0.0).sum())
    return Reading(_spaced(text, starts), float(confidences.mean()) if len(confidences) else 0.0, legible)


def _spaced(text: str, columns: NDArray[np.int_]) -> str:
    """The text with blanks where letters stand plainly farther apart: the network sees few blanks itself."""
    steps = np.diff(columns, prepend=columns[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    wide = steps >= max(_BLANK * usual, usual + _BLANK_COLUMNS)
    spaced = "".join(f" {letter}" if gap else letter for letter, gap in zip(text, wide, strict=True))
    return " ".join(spaced.split())
