"""Sharpening of a scan: an unsharp mask applied by scanners and converters after the tone curve.

A code c is stored as c + amount (c - G c), where G is a Gaussian of a radius. Its transfer function,
1 + amount (1 - exp(-(radius k)^2 / 2)), lies between 1 and 1 + amount. It can be inverted without amplifying noise,
except where values were clipped. Marks are therefore fitted in light of unsharpened codes.

Undetected sharpening is mistaken for a tone curve, for damage around a mark, and for a blur smaller than any scanner's.
It is estimated from the edges of marks together with the tone curve, by the same score: see `measure.tone.estimate`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from measure.array_types import Array

RADII_PX = (0.6, 1.0, 1.6, 2.6)  # px, radii tried for detection; the best one starts the estimation
_AMOUNTS, _RADIUS_RANGE_PX = (0.0, 2.5), (0.4, 5.0)
_SIGMAS = np.array([1.0, 0.5])  # prior standard deviations of the amount and of the logarithm of the radius
_USUAL = np.array([0.0, 0.2])  # prior means of these
_SCATTER = np.array([0.1, 0.1])  # their standard deviations between scans of one scanner
_LONGEST = np.array([1.0, 0.3])  # their largest step
_TAIL = 1e-3  # fraction of a pixel's weight, below which the inverse filter is truncated
_EVIDENCE = np.log(100.0)  # log-odds above which a scan counts as sharpened
_LEAST_AMOUNT = 0.1
FEWEST_MARKS, _ODD = 3, 3.0  # marks needed; standard deviations from the median beyond which a mark is an outlier
_SAME = 0.01  # of amount and log radius, convergence limit in addition to the next one
_CLOSE = 0.5  # in standard deviations, convergence limit


@dataclass(frozen=True, eq=False)
class Sharpening:
    """Unsharp mask. covariance (2, 2): of the amount and of the logarithm of the radius; prior: from other scans of the
    scanner, None without any."""

    amount: float = 0.0
    radius_px: float = 1.0
    covariance: Array = field(default_factory=lambda: np.zeros((2, 2)))
    prior: "Sharpening | None" = field(default=None, compare=False)

    @classmethod
    def pool(cls, each: Sequence["Sharpening"]) -> "Sharpening":
        """Pool the sharpening of several scans of a scanner as prior of a further scan; none if most are not
        sharpened."""
        found = [one for one in each if one]
        if 2 * len(found) <= len(each):
            return cls()
        values = np.array([one.values for one in found])
        weights = np.array([np.linalg.inv(one.covariance + np.diag(_SCATTER**2)) for one in found])
        mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, values))
        scatter = np.diag(_SCATTER**2) + (values - mean).T @ (values - mean) / len(found)
        known = cls(float(mean[0]), float(np.exp(mean[1])), np.linalg.inv(weights.sum(axis=0)) + scatter)
        return replace(known, prior=known)

    @property
    def values(self) -> Array:
        """(2,) amount and logarithm of the radius."""
        return np.array([self.amount, np.log(self.radius_px)])

    def __bool__(self) -> bool:
        return self.amount > 0

    @property
    def is_determined(self) -> bool:
        """Whether amount and radius are both better known than by their prior."""
        known = _SIGMAS**2 if self.prior is None else np.diag(self.prior.covariance)
        return bool(self) and bool(np.all(np.diag(self.covariance) < known))

    @property
    def reach_px(self) -> int:
        """Reach of the inverse filter, which is a sum of Gaussians of increasing radius."""
        share = self.amount / (1 + self.amount)
        terms = max(np.log(_TAIL) / np.log(share), 1.0) if share > 0 else 0.0
        return int(np.ceil(3.0 * self.radius_px * np.sqrt(terms)))

    def unsharpen(self, codes: NDArray[np.floating]) -> Array:
        """Remove the sharpening of codes (..., height, width). The result is wrong within reach_px of a border."""
        smooth = _gaussian_spectrum(self.radius_px, codes.shape)
        return _filtered(codes, 1 / (1 + self.amount * (1 - smooth)))

    def changes(self, codes: NDArray[np.floating]) -> Array:
        """(m, height, width) halos: minus the derivatives of the result of `unsharpen`, codes (height, width), with
        respect to m parameters. These are the amount and the logarithm of the radius or, without sharpening, the
        amounts for each of `RADII_PX`."""
        if not self:
            return _filtered(codes, np.stack([1 - _gaussian_spectrum(radius, codes.shape) for radius in RADII_PX]))
        smooth = _gaussian_spectrum(self.radius_px, codes.shape)
        by_radius = -2 * self.amount * smooth * np.log(np.maximum(smooth, 1e-30))
        return _filtered(codes, np.stack([1 - smooth, by_radius]) / (1 + self.amount * (1 - smooth)))

    def apply_step(self, step: Array, covariance: Array) -> "Sharpening":
        """Apply a step (2,) of amount and logarithm of the radius, limited in length."""
        step = step / max(float((np.abs(step) / _LONGEST).max()), 1.0)
        amount = float(np.clip(self.amount + step[0], *_AMOUNTS))
        radius_px = float(np.clip(self.radius_px * np.exp(step[1]), *_RADIUS_RANGE_PX))
        return replace(self, amount=amount, radius_px=radius_px, covariance=covariance)

    def accelerate(self, before: "Sharpening", last: "tuple[Sharpening, Sharpening] | None") -> "Sharpening":
        """Next sharpening by Anderson's method from two iterations: of this estimate, found with the one before, and of
        the last two such. Amount and radius are correlated: full steps alternate."""
        if last is None or not (before and last[0]):
            return self
        (first, found), scale = (each.values for each in last), _LONGEST
        step, change = self.values - before.values, self.values - found
        bend = (step - (found - first)) / scale
        share = float(bend @ (step / scale)) / max(float(bend @ bend), 1e-12)
        return before.apply_step(step - share * change, self.covariance)

    def is_close_to(self, other: "Sharpening") -> bool:
        """Whether it differs from another one by little compared with its standard deviations."""
        step = np.array([self.amount - other.amount, np.log(self.radius_px / other.radius_px)])
        return bool(np.all(np.abs(step) < _CLOSE * np.sqrt(np.diag(self.covariance)) + _SAME))

    @property
    def note(self) -> str:
        """Sentence for the user; empty without sharpening."""
        if not self:
            return ""
        sigmas = np.sqrt(np.diag(self.covariance)) * (1.0, self.radius_px)
        return (
            f"The scan is sharpened, by an amount of {self.amount:.2f} (σ {sigmas[0]:.2f}) within "
            f"{self.radius_px:.2f} px (σ {sigmas[1]:.2f}); marks were measured with the sharpening removed."
        )


def _gaussian_spectrum(radius_px: float, shape: tuple[int, ...]) -> Array:
    """(height, width) transfer function of a Gaussian in the cosine transform of images of a shape."""
    rows, cols = (np.exp(-0.5 * (radius_px * np.pi * np.arange(size) / size) ** 2) for size in shape[-2:])
    return np.outer(rows, cols)


def _filtered(codes: NDArray[np.floating], spectrum: Array) -> Array:
    """Apply symmetric filters (..., height, width) by cosine transform, which mirrors the image at its borders."""
    return np.asarray(fft.idctn(fft.dctn(codes, axes=(-2, -1)) * spectrum, axes=(-2, -1)))


@dataclass(frozen=True, eq=False)
class SharpeningScore:
    """Score of a mark for sharpening and tone curve.

    There are k departures of the curve and m parameters of the sharpening: the amounts for each of `RADII_PX` without
    sharpening, otherwise the amount and the logarithm of the radius.

    Attributes
    ----------
    value : (k + m,) score.
    normal : (k + m, k + m) derivatives of the score with respect to the parameters.
    covariance : (k + m, k + m) of the score.
    on_place : (2, m) derivatives of the place (px) with respect to the parameters of the sharpening.
    sharpening : with which the mark was fitted.
    """

    value: Array
    normal: Array
    covariance: Array
    on_place: Array
    sharpening: Sharpening = Sharpening()

    def relative_to(self, other: Sharpening) -> "SharpeningScore | None":
        """Score at another sharpening, linearised; None if only one of both is a sharpening."""
        if bool(self.sharpening) != bool(other):
            return None
        off = self.sharpening.values - other.values
        return replace(self, value=self.value + self.normal[:, -len(off) :] @ off) if other else self

    def covariance_px2(self, sharpening: Sharpening) -> Array:
        """(2, 2) covariance of the place due to the uncertainty of the sharpening, or its whole effect if the mark was
        fitted without sharpening."""
        if self.on_place.shape[1] == len(RADII_PX):
            nearest = int(np.argmin(np.abs(np.log(RADII_PX) - np.log(sharpening.radius_px))))
            moved = sharpening.amount * self.on_place[:, nearest]
            return np.outer(moved, moved)
        return np.asarray(self.on_place @ sharpening.covariance @ self.on_place.T)


def estimate_sharpening(before: Sharpening, scores: Sequence[SharpeningScore], departures: int) -> Sharpening | None:
    """Estimate the sharpening from marks.

    Parameters
    ----------
    before : sharpening of the scan, from which the step is counted.
    scores : of the marks, some of which may have been fitted with an earlier sharpening.
    departures : number of departures of the tone curve, the first parameters of each score.

    Returns
    -------
    Sharpening, or None if it is not significant.
    """
    scores = [at for score in scores if score.normal.any() and (at := score.relative_to(before))]
    if len(scores) < FEWEST_MARKS:
        return None
    tone, count = list(range(departures)), len(scores[0].value) - departures
    if before:
        step, covariance, _ = _estimate_step(scores, tone, [departures, departures + 1], before)
        after = before.apply_step(step, covariance)
        return after if after.amount > _LEAST_AMOUNT else None
    each = [_estimate_step(scores, tone, [departures + radius], before) for radius in range(count)]
    best = int(np.argmax([log_odds for _, _, log_odds in each]))
    (amount,), covariance, log_odds = each[best]
    if log_odds < _EVIDENCE or amount < _LEAST_AMOUNT:
        return None
    start = Sharpening(0.0, RADII_PX[best])
    return start.apply_step(np.array([amount, 0.0]), np.diag([covariance[0, 0], _SIGMAS[1] ** 2]))


def _estimate_step(
    scores: Sequence[SharpeningScore], tone: Sequence[int], among: Sequence[int], before: Sharpening
) -> tuple[Array, Array, float]:
    """Estimate a step of some parameters together with the tone curve, excluding outlying marks.

    Returns
    -------
    Step (m,) from the parameters of the fits, its covariance (m, m), and the log-odds that it is real.
    """
    count, first = len(tone) + len(among), len(tone)
    prior, pull = np.eye(count), np.zeros(count)
    weight = np.diag(_SIGMAS**-2) if before.prior is None else np.linalg.inv(before.prior.covariance)
    off = (_USUAL if before.prior is None else before.prior.values) - before.values
    prior[first:, first:] = weight[: len(among), : len(among)]
    pull[first:] = (weight @ off)[: len(among)] if before else 0.0
    chosen = np.ix_([*tone, *among], [*tone, *among])
    normals = np.array([score.normal[chosen] for score in scores])
    values = np.array([score.value[[*tone, *among]] for score in scores])
    weighted = np.linalg.solve(np.array([score.covariance[chosen] for score in scores]), normals).swapaxes(1, 2)
    matrices, rights = weighted @ normals, (weighted @ values[..., None])[..., 0]
    matrices = (matrices + matrices.swapaxes(1, 2)) / 2
    own = np.linalg.inv(matrices + prior)  # by each mark alone, without the prior's pull
    steps, variances = (own[:, first] * rights).sum(axis=1), own[:, first, first]
    middle = float(np.median(steps))
    odd = (steps - middle) ** 2 / (_ODD**2 * (variances + np.median((steps - middle) ** 2)))
    kept = 1 / (1 + odd) ** 2  # an outlier fades, without a limit at which it drops out
    matrix, right = np.asarray(np.tensordot(kept, matrices, 1), float), np.asarray(kept @ rights, float)
    covariance = np.asarray(np.linalg.inv(matrix + prior), float)[first:]
    step, covariance = covariance @ (right + pull), covariance[:, first:]
    spread = float(np.sum(kept * (steps - step[0]) ** 2 / variances)) / max(float(kept.sum()) - 1, 1)
    covariance = covariance * max(spread, 1.0)
    explained = right @ np.linalg.solve(matrix + prior, right)
    explained -= right[:first] @ np.linalg.solve((matrix + prior)[:first, :first], right[:first])
    shrunk = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(prior)[1]
    return step, covariance, float(explained / max(spread, 1.0) + shrunk) / 2
