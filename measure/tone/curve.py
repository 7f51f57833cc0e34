"""The curve through which a scanner or a converter stored light as grey values.

Film, lens and scanner blur light; only then is it coded. A fit in light needs the curve from code to light, and light
may be anything that grows linearly with it: gain and offset are in every fit. So a curve is known by the logarithm of
its slope, up to a constant. What is believed of it is a base curve and a normal distribution of departures from it: of
the logarithm of the slope, a power's share and a few smooth waves over the range of codes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PIECES = 1024  # of the range of codes, in which a curve is straight
_NODES = np.linspace(0.0, 1.0, _PIECES + 1)
_MIDDLES = (_NODES[1:] + _NODES[:-1]) / 2
_TOE = 0.005  # of full scale: the slope of a power has no logarithm at black
# What is believed of a curve of which nothing is said: between linear and sRGB, and a scanner may bend it further. The
# waves are Legendre's polynomials; their standard deviations let S-curves be that a scanner's "contrast" makes.
_POWER, _POWER_SIGMA = 1.6, 0.6
_WAVE_SIGMAS = (0.3, 0.5, 0.2, 0.15)
_SIGMAS = np.array([_POWER_SIGMA, *_WAVE_SIGMAS])
_COUNT = len(_SIGMAS)
# What is believed of a curve that the file says: programs round it, and a scanner's light and dark are not exactly its.
_DECLARED_SIGMA = 0.1  # of the standard deviations above
# By how much pictures' own curves may differ from the scanner's: variances of each departure that are tried.
_SCATTERS = (0.0, *np.geomspace(0.003, 30.0, 17))
_CONTRADICTED = np.log(1000.0)  # log-odds, at which a picture is believed against what its file says


def power(exponent: float) -> Array:
    """(nodes,) light of a code raised to a power."""
    return np.asarray(_NODES**exponent)


def srgb() -> Array:
    """(nodes,) light by IEC 61966-2-1."""
    return np.where(_NODES <= 0.04045, _NODES / 12.92, ((_NODES + 0.055) / 1.055) ** 2.4)


def sampled(light: Array) -> Array:
    """(nodes,) light of a curve that is given by values (n,) at evenly spaced codes; it has to grow."""
    even = np.interp(_NODES, np.linspace(0.0, 1.0, len(light)), light)
    low, high = float(even[0]), float(even[-1])
    if not (high > low and np.all(np.diff(even) >= 0)):
        raise ValueError("a tone curve grows with the code")
    return np.asarray((even - low) / (high - low))


@dataclass(frozen=True, eq=False)
class SaidOfTone:
    """What pictures say of the departures of a curve: information (k, k), right (k,), the information times the most
    likely departures, and square, the sum of squares of departures of none in units of their standard deviations;
    count: of independent figures. alike: the variance of each departure by which all of them speak of another curve
    than the scanner's in the same way, as JPEG's rounding makes them: it is not in the information, and no number of
    pictures averages it."""

    information: Array
    right: Array
    square: float
    count: int
    alike: float = 0.0

    @classmethod
    def nothing(cls) -> "SaidOfTone":
        return cls(np.zeros((_COUNT, _COUNT)), np.zeros(_COUNT), 0.0, 0)

    @classmethod
    def by_score(cls, normal: Array, score: Array, covariance: Array) -> "SaidOfTone":
        """Of a score (k,) of that covariance (k, k) that grows with the departures by a normal matrix (k, k)."""
        weighted = np.linalg.solve(covariance, np.column_stack([normal, score])).T
        information = weighted[:-1] @ normal
        return cls((information + information.T) / 2, weighted[-1] @ normal, float(weighted[-1] @ score), len(score))

    @classmethod
    def together(cls, each: Sequence["SaidOfTone"], scatter: float = 0.0) -> "SaidOfTone":
        """What several pictures say, each of them of a curve of its own, each departure of which differs from the
        scanner's with the variance scatter. What they have alike counts by how much each says."""
        information, right = (
            np.array([one.information for one in each]),
            np.array([one.right for one in each])[..., None],
        )
        says, alike = np.trace(information, axis1=1, axis2=2), np.array([one.alike for one in each])
        taken = scatter * np.linalg.inv(np.eye(_COUNT) + scatter * information)
        less = (information - information @ taken @ information).sum(axis=0)
        return cls(
            (less + less.T) / 2,
            (right - information @ taken @ right).sum(axis=(0, 2)),
            sum(one.square for one in each) - float((right.swapaxes(1, 2) @ taken @ right).sum()),
            sum(one.count for one in each),
            float(says @ alike / max(says.sum(), 1e-30)),
        )

    @property
    def of_scanner(self) -> "SaidOfTone":
        """The same of the scanner's curve."""
        return replace(SaidOfTone.together([self], self.alike), alike=0.0)


@dataclass(frozen=True, eq=False)
class Believed:
    """A tone curve after pictures have said something. scatter: the variance of each departure of their own curves
    from it."""

    tone: "Tone"
    scatter: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Tone:
    """What is believed of a scan's curve.

    base (nodes,): light, 0 to 1, at evenly spaced codes. mean (k,), covariance (k, k): of the departures from it, each
    in units of the standard deviation that it has where nothing is known. source: where the curve is from, a part of a
    sentence; is_declared: whether the file says it, which the picture may contradict. heard: what was believed before
    other scans said something, and what they said; None where none did.
    """

    base: Array = field(default_factory=lambda: power(1.0))
    mean: Array = field(default_factory=lambda: np.zeros(_COUNT))
    covariance: Array = field(default_factory=lambda: np.zeros((_COUNT, _COUNT)))
    source: str = "grey values are taken as light"
    is_declared: bool = False
    heard: "tuple[Tone, tuple[SaidOfTone, ...]] | None" = field(default=None, compare=False)

    @classmethod
    def unknown(cls) -> "Tone":
        return cls(power(_POWER), covariance=np.eye(_COUNT), source="estimated from the edges of marks")

    @classmethod
    def declared(cls, base: Array, source: str) -> "Tone":
        """A curve that the file says."""
        return cls(base, covariance=_DECLARED_SIGMA**2 * np.eye(_COUNT), source=source, is_declared=True)

    @property
    def is_identity(self) -> bool:
        return not self.mean.any() and bool(np.array_equal(self.base, _NODES))

    @property
    def is_known(self) -> bool:
        return not self.covariance.any()

    def forgetting(self) -> "Tone":
        """The same base, of whose departures nothing is known but that the curve lies between linear and sRGB."""
        mean = np.zeros(_COUNT)
        mean[0] = (_POWER - self._base_power) / _POWER_SIGMA
        return replace(self, mean=mean, covariance=np.eye(_COUNT))

    def like_power(self, value: float) -> "Tone":
        """The same with the departure that makes it most like a power."""
        mean = self.mean.copy()
        mean[0] += (value - self.power_between(0.1, 0.9)[0]) / _POWER_SIGMA
        return self.at(mean)

    def at(self, mean: Array) -> "Tone":
        """The same with other departures."""
        return replace(self, mean=mean)

    @property
    def ends(self) -> tuple["Tone", ...]:
        """The curves that it may be: itself where it is known, else one standard deviation of power to either side."""
        if self.is_known:
            return (self,)
        sigma = np.sqrt(self.covariance[0, 0]) * np.eye(_COUNT)[0]
        return self.at(self.mean - sigma), self.at(self.mean + sigma)

    def hearing(self, others: Sequence[SaidOfTone]) -> "Tone":
        """What is believed where other scans of the scanner have said something: it is put together anew with what a
        scan says itself, for what is wrong alike in all of them does not average."""
        return replace(self.told(others).tone, heard=(self, tuple(others))) if others else self

    def told(self, each: Sequence[SaidOfTone]) -> "Believed":
        """What is believed when pictures have said something, too. What the file says they may contradict, where they
        agree."""
        if self.heard is not None:
            before, others = self.heard
            return before.told([*others, *each])
        if self.is_known or not each:
            return Believed(self)
        believed, odds = self._told(each)
        if not self.is_declared:
            return believed
        free, free_odds = self.forgetting()._told(each)
        if free_odds - odds < _CONTRADICTED:
            return believed
        source = f"{self.source}, but the pictures contradict it"
        return replace(free, tone=replace(free.tone, source=source, is_declared=False))

    def _told(self, each: Sequence[SaidOfTone]) -> tuple["Believed", float]:
        """And the logarithm of how likely the prior makes what was said.

        Pictures that contradict one another or the prior beyond chance have edges that are not as they are drawn: of
        sharpened pictures, of film developed unevenly. So each speaks of a curve of its own, and how far these scatter
        about the scanner's is estimated with it, as the most likely variance of random effects. Beforehand its root
        has a half-Cauchy distribution (Gelman, 2006, Prior distributions for variance parameters)."""
        return max((self._scattered(each, scatter) for scatter in _SCATTERS), key=itemgetter(1))

    def _scattered(self, each: Sequence[SaidOfTone], scatter: float) -> tuple["Believed", float]:
        together = SaidOfTone.together(each, scatter)
        said, prior = together.of_scanner, np.linalg.inv(self.covariance)
        covariance = np.linalg.inv(prior + said.information)
        right = prior @ self.mean + said.right
        mean = covariance @ right
        chance = np.linalg.slogdet(prior @ covariance)[1] + right @ mean - self.mean @ prior @ self.mean - said.square
        chance -= _spread(scatter, each) + _spread(together.alike, [together]) + 2 * np.log1p(scatter)
        return Believed(replace(self, mean=mean, covariance=(covariance + covariance.T) / 2), scatter), chance / 2

    def light(self, code: NDArray[np.floating] | NDArray[np.integer], full_scale: float) -> NDArray[np.float32]:
        """Light of grey values of a file whose largest is full_scale, on the same scale: 0 stays 0, and white white."""
        if self.is_identity:
            return np.asarray(code, np.float32)
        share = np.asarray(code, np.float32) * np.float32(_PIECES / full_scale)
        whole = np.minimum(share.astype(np.int32), _PIECES - 1)
        table, steps = self._fast
        return np.asarray(np.float32(full_scale) * (table[whole] + steps[whole] * (share - whole)), np.float32)

    def code(self, light: NDArray[np.floating], full_scale: float) -> Array:
        """The grey value that such light is stored as."""
        return np.asarray(full_scale * np.interp(np.asarray(light) / full_scale, self._table, _NODES))

    def changes(self, light: NDArray[np.floating], full_scale: float) -> Array:
        """(k, ...) what light becomes more of for each departure of 1, at codes that stand for this light."""
        share = self.code(light, full_scale) / full_scale
        return full_scale * np.stack([np.interp(share, _NODES, each) for each in self._by_departure])

    def power_between(self, low: float, high: float) -> tuple[float, float]:
        """The power that the curve is most like between two codes, shares of full scale, and its standard deviation."""
        codes = np.linspace(max(low, 0.02), max(high, low + 0.02), 50)
        at = np.clip((codes * _PIECES).astype(int), 0, _PIECES - 1)
        slope = np.log(np.maximum(np.diff(self._table)[at], 1e-12))
        design = np.column_stack([np.log(codes), np.ones_like(codes)])
        of_slope = np.linalg.pinv(design)[0]
        sigma2 = of_slope @ (_WAVES[:, at].T @ self.covariance @ _WAVES[:, at]) @ of_slope
        return 1 + float(of_slope @ slope), float(np.sqrt(max(sigma2, 0.0)))

    @cached_property
    def _base_power(self) -> float:
        return Tone(self.base).power_between(0.1, 0.9)[0]

    @cached_property
    def _steps(self) -> Array:
        return np.asarray(np.diff(self.base) * np.exp(self.mean @ _WAVES))

    @cached_property
    def _table(self) -> Array:
        """(nodes,) light at evenly spaced codes."""
        if not self.mean.any():
            return self.base
        sums = np.concatenate([[0.0], np.cumsum(self._steps)])
        return np.asarray(sums / sums[-1])

    @cached_property
    def _by_departure(self) -> Array:
        """(k, nodes) derivatives of the table, but for a constant share of light: a fit's gain takes that."""
        sums = np.cumsum(self._steps * _WAVES, axis=1) / self._steps.sum()
        return np.concatenate([np.zeros((_COUNT, 1)), sums], axis=1)

    @cached_property
    def _fast(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self._table.astype(np.float32), np.diff(self._table).astype(np.float32)

    def __repr__(self) -> str:
        value, sigma = self.power_between(0.1, 0.9)
        return f"Tone(like a power of {value:.2f} +- {sigma:.2f}: {self.source})"


def _spread(variance: float, each: Sequence[SaidOfTone]) -> float:
    """The logarithm of the determinant by which the covariance of what pictures say grows with that variance."""
    information = np.array([one.information for one in each])
    return float(np.linalg.slogdet(np.eye(_COUNT) + variance * information)[1].sum())


def _waves(code: Array) -> Array:
    """(k, n) departures of one standard deviation: what each adds to the logarithm of the slope."""
    x = 2 * code - 1
    waves = [np.polynomial.legendre.Legendre.basis(degree)(x) for degree in range(1, len(_WAVE_SIGMAS) + 1)]
    return np.asarray(_SIGMAS[:, None] * np.stack([np.log(code + _TOE), *waves]))


_WAVES = _waves(_MIDDLES)
LINEAR = Tone()
