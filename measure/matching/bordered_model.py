"""The model of a window whose ground has a border: dark on one side and light on the other, as at a roof's edge.

The ground rises by a step along a line that may bend, softened by a Gaussian of its own. Through an opaque mark it does
not shine: the mark's contrast is another beyond the border, by as much as the picture says.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from measure.marks.rendering import Rendering
from measure.matching.models import GREY, PIXEL_VARIANCE_PX2, PictureModel
from measure.noise.noise_model import factors

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OFF, TURN, BEND, SOFTNESS, STEP, CHANGE = range(6)  # a border's unknowns
_LONGEST = np.array([1.5, 0.15, 0.02, 0.7, np.inf, np.inf])  # of a step: beyond it the linearisation tells nothing
_BEND_SIGMA, _SOFTNESS_SIGMA = 0.02, 1.0  # of the priors: bends of a radius of 50 px, and two thirds softer or sharper
_CHANGE_SIGMA = 2.0  # likewise, of the step, which an opaque mark hides and another lets through
_SEEN = 3.0  # standard deviations of its blur from a border: a thousandth of its step is seen farther off
_SOFTNESS_RANGE = 2 * np.log(0.4), 2 * np.log(10.0)


class BorderedModel(PictureModel):
    """As `PictureModel`, on a ground with a border. state.border (6,): how far it passes from the start's centre, px;
    the direction of its normal there, rad; its curvature, 1/px; the logarithm of the variance of its blur, the pixel's
    share included, px2; the step of the ground, and the change of the mark's contrast beyond the border, grey values.
    """

    border_unknowns = 6
    change_sigma_dn = np.inf

    def begin(self, plain: PictureModel, used: Mask, off_px: float, turn_rad: float) -> None:
        """From the state of a model without a border and a straight border as soft as the mark; the step and all greys
        by a linear fit to what is used (height, width), the mark's contrast being the same on both sides."""
        border = np.array([off_px, turn_rad, 0.0, 2 * np.log(plain.seen_blur_px), 0.0, 0.0])
        edge = _edge(border, self.start[:, 2], used.shape).value
        border[STEP], *greys = factors(np.stack([edge, *plain.design[-GREY:] / plain.steadiness]) * used, self.grey)
        self.state = plain.state.with_border(border, np.array(greys))
        self.change_sigma_dn = _CHANGE_SIGMA * abs(border[STEP])

    def _by_border(self, shown: Rendering) -> tuple[Array, Array]:
        border, edge = self.state.border, _edge(self.state.border, self.start[:, 2], self.grey.shape)
        opaque = _product(shown, edge, self.state.variance_px2 + PIXEL_VARIANCE_PX2, np.exp(border[SOFTNESS]))
        # The derivatives, which lead to the solution and do not decide it, have the series' first term.
        by_s = (border[STEP] + border[CHANGE] * shown.value) * edge.slope
        columns = self.design[self.border]
        columns[OFF] = -by_s
        columns[TURN] = by_s * edge.along_px * (1 + border[BEND] * edge.across_px)
        columns[BEND] = -by_s * edge.along_px**2 / 2
        columns[SOFTNESS] = -by_s * edge.s_px / 2
        columns[STEP], columns[CHANGE] = edge.value, opaque
        squares = np.square(shown.value, dtype=float)
        self._share_beyond = float((squares * edge.value).sum() / max(float(squares.sum()), 1e-12))
        contrast = self.state.greys[0] + border[CHANGE] * edge.value
        return contrast, border[STEP] * edge.value + border[CHANGE] * opaque

    @property
    def contrast_by(self) -> Array:
        """(unknowns,) of the mean over the mark: on one side alone it may hardly show."""
        by = super().contrast_by
        by[self.border.start + CHANGE] = self._share_beyond
        return by

    @property
    def contrast_dn(self) -> float:
        """The mean over the mark."""
        return super().contrast_dn + self._share_beyond * float(self.state.border[CHANGE])

    def near_border(self, corner_px: Array, shape: tuple[int, ...]) -> Mask:
        """(height, width) of another window, in which this one begins at corner_px (2,): where the border is seen, if
        it goes on as it does here."""
        edge = _edge(self.state.border, self.start[:, 2] + corner_px, shape)
        return np.asarray(np.abs(edge.s_px) < _SEEN * np.exp(self.state.border[SOFTNESS] / 2))

    def step_chi_square(self, covariance: Array) -> float:
        """Of the ground's step, for that covariance (unknowns, unknowns)."""
        at = self.border.start + STEP
        return float(self.state.border[STEP] ** 2 / covariance[at, at])

    def step(self, step: Array) -> float:
        """As of a `PictureModel`; the border's blur stays in its range."""
        moved = super().step(step)
        border = self.state.border.copy()
        border[SOFTNESS] = np.clip(border[SOFTNESS], *_SOFTNESS_RANGE)
        self.state = self.state.with_border(border, self.state.greys)
        return moved

    def prior_weights(self) -> Array:
        """Also of the border's bend and blur."""
        weights = super().prior_weights()
        weights[self.border][[BEND, SOFTNESS, CHANGE]] = _BEND_SIGMA**-2, _SOFTNESS_SIGMA**-2, self.change_sigma_dn**-2
        return weights

    def departures(self) -> Array:
        """Also of the border: from a straight one as soft as the mark."""
        departures = super().departures()
        bend, softness, change = self.state.border[[BEND, SOFTNESS, CHANGE]]
        departures[self.border][[BEND, SOFTNESS, CHANGE]] = bend, softness - 2 * np.log(self.seen_blur_px), change
        return departures

    def _length_px(self, change: Array) -> float:
        off, turn, bend, softness = np.abs(change[self.border][:STEP])
        return super()._length_px(change) + float(off + self.reach_px * (turn + self.reach_px * bend / 2) + softness)

    def _border_steps(self, step: Array) -> float:
        return float(np.max(np.abs(step) / _LONGEST))


class _Edge(NamedTuple):
    """A step of 1 along a border in a window (height, width): value; slope: its derivative by s_px, how far beyond the
    border a pixel lies; along_px: how far along it; across_px: s_px if it did not bend; normal (2, height, width): the
    derivatives of s_px by column and row."""

    value: Array
    slope: Array
    s_px: Array
    along_px: Array
    across_px: Array
    normal: Array


def _edge(border: Array, about_px: Array, shape: tuple[int, ...]) -> _Edge:
    """The step of a border (6,) whose distance is that from about_px (2,)."""
    col, row = np.arange(shape[1]) - about_px[0], (np.arange(shape[0]) - about_px[1])[:, None]
    c, s = np.cos(border[TURN]), np.sin(border[TURN])
    across, along = c * col + s * row, c * row - s * col
    bent = border[BEND] * along
    s_px = across - border[OFF] - bent * along / 2
    sigma = np.exp(border[SOFTNESS] / 2)
    slope = np.exp(-((s_px / sigma) ** 2) / 2) / (np.sqrt(2 * np.pi) * sigma)
    return _Edge(ndtr(s_px / sigma), slope, s_px, along, across, np.stack([c + s * bent, s - c * bent]))


def _product(shown: Rendering, edge: _Edge, blur_px2: float, edge_px2: float) -> Array:
    """(height, width) what a blur of variance blur_px2 makes of a sharp mark times a step, from what it makes of each,
    the step's variance then being edge_px2.

    By the series of the mean of a product of two functions of one normal variable: the sum over n of variance^n / n!
    times the product of the means of their n-th derivatives, here up to n = 2. It is exact where a line crosses the
    border at a right angle.
    """
    right, down = edge.normal
    first = shown.by_col * right + shown.by_row * down
    second = shown.by_col_col * right**2 + 2 * shown.by_col_row * right * down + shown.by_row_row * down**2
    bent = -edge.s_px / edge_px2
    return np.asarray(shown.value * edge.value + blur_px2 * edge.slope * (first + blur_px2 / 2 * bent * second))
