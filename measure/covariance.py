"""What a measured place is uncertain by: a covariance that is the sum of its causes."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Cause(StrEnum):
    """What a part of a covariance comes from, in the order in which the parts are told."""

    NOISE = "noise"
    ROUNDING = "rounding"
    SECOND_ORDER = "second order"
    UNLIKE_DRAWING = "unlike drawing"
    TONE = "tone"
    CHANGED_TONES = "changed tones"
    LANDSCAPE = "landscape"
    COMPRESSION = "compression"
    TOUCHED = "touched"
    OWN_TURN = "own turn"
    FILM = "film"
    SECOND_METHOD = "second method"
    GIVEN_PLACES = "given places"
    OTHER_FRAMES = "other frames"
    INTERPOLATION = "interpolation"
    CLICK = "click"


MEANING = {
    Cause.NOISE: "Grain of the film and noise of the scanner, as the picture shows them.",
    Cause.ROUNDING: "The grey values are whole numbers.",
    Cause.SECOND_ORDER: "A soft and faint mark's picture bends within the errors of its place, blur and contrast.",
    Cause.UNLIKE_DRAWING: "At its edges the picture differs by more than noise: it is not quite as drawn.",
    Cause.TONE: "The curve through which light was stored as grey values is not known well enough.",
    Cause.CHANGED_TONES: "A learned mark's half tones may be others than where it was learned.",
    Cause.LANDSCAPE: "The ground that shows within a notch is not even.",
    Cause.COMPRESSION: "JPEG rounded the mark's edges away.",
    Cause.TOUCHED: "Something may touch the mark, as its size or shape says.",
    Cause.OWN_TURN: "It was only seen, as turned and as large as the frame says: it may be drawn a little otherwise.",
    Cause.FILM: "The film was bent or stretched, as the camera's frames show.",
    Cause.SECOND_METHOD: "Its edges put it elsewhere.",
    Cause.GIVEN_PLACES: "It contradicts the given places.",
    Cause.OTHER_FRAMES: "It contradicts the camera's other frames.",
    Cause.INTERPOLATION: "Two scans have their pixels at other places, and between these no picture is sure.",
    Cause.CLICK: "A person pointed at it, and nothing could be matched there.",
}


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """The covariance of a place, (column, row): parts (2, 2) px2 by their causes, independent of one another.

    What is common to several marks of a frame, as `tone` is, is in each of them by its own part.
    """

    parts: Mapping[Cause, Array]

    @classmethod
    def of_noise(cls, px2: Array) -> "Covariance":
        """Of a place of which the noise (2, 2) is all that is known."""
        return cls({Cause.NOISE: np.asarray(px2, float)})

    @cached_property
    def px2(self) -> Array:
        """(2, 2): the sum."""
        return np.asarray(sum(self.parts.values(), np.zeros((2, 2))))

    @property
    def sigmas_px(self) -> dict[Cause, float]:
        """Of each cause the standard deviation of a coordinate, the mean of both; causes that add nothing are left
        out."""
        sigmas = {cause: float(np.sqrt(np.trace(self.parts[cause]) / 2)) for cause in Cause if cause in self.parts}
        return {cause: sigma for cause, sigma in sigmas.items() if sigma > 0}

    def plus(self, cause: Cause, px2: Array) -> "Covariance":
        """With what a cause adds (2, 2); the same where that is nothing."""
        if not np.any(px2):
            return self
        return Covariance({**self.parts, cause: self.parts.get(cause, np.zeros((2, 2))) + px2})

    def through(self, matrix: Array) -> "Covariance":
        """Of a place whose errors are these times a matrix (2, 2)."""
        return Covariance({cause: matrix @ part @ matrix.T for cause, part in self.parts.items()})

    def __repr__(self) -> str:
        return "Covariance(" + ", ".join(f"{cause} {sigma:.3g} px" for cause, sigma in self.sigmas_px.items()) + ")"
