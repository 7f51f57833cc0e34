"""Tone curve by which a scanner or converter stores light as grey values (codes), and its estimate from images.

Film, lens and scanner blur the light before it is coded. A fit in linear light needs the curve from code to light, up
to gain and offset, which every fit estimates. A curve is therefore described by the logarithm of its slope, up to a
constant. Its distribution consists of a base curve and normally distributed departures of that logarithm: a power
(gamma) term and a few smooth waves over the range of codes. A file declares its curve by an ICC profile, a
TransferFunction, PNG's sRGB and gAMA, or Exif.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Single
from measure.tone.sharpening import Sharpening

_PIECES = 1024  # linear pieces over the range of codes
_NODES = np.linspace(0.0, 1.0, _PIECES + 1)
_MIDDLES = (_NODES[1:] + _NODES[:-1]) / 2
_TOE = 0.005  # fraction of full scale added to the code: the log slope of a power is singular at black
# Prior of a curve that no file declares: between linear and sRGB, with further bending by a scanner. The waves are
# Legendre polynomials; their standard deviations admit S-curves such as those of a scanner's "contrast" setting.
_POWER, _POWER_SIGMA = 1.6, 0.6
_WAVE_SIGMAS = (0.3, 0.5, 0.2, 0.15)
_SIGMAS = np.array([_POWER_SIGMA, *_WAVE_SIGMAS])
_COUNT = len(_SIGMAS)
_LEGENDRE = [np.polynomial.legendre.Legendre.basis(degree)(2 * _MIDDLES - 1) for degree in range(1, _COUNT)]
# (k, pieces) change of the log slope by one standard deviation of each departure.
_WAVES: Array = _SIGMAS[:, None] * np.stack([np.log(_MIDDLES + _TOE), *_LEGENDRE])
# Prior of a declared curve: programs round it, and a scanner does not follow it exactly in highlights and shadows.
_DECLARED_SIGMA = 0.1  # fraction of the standard deviations above
# Variances tried for the departures of the images' own curves from the scanner's.
_SCATTERS = (0.0, *np.geomspace(0.003, 30.0, 17))
_CONTRADICTED = np.log(1000.0)  # log-odds above which the images overrule the declared curve
_STARTS, _ANOTHER = (1.0, 1.6, 0.5, 2.4), 0.3  # initial powers, and their smallest distance from those tried before
_ICC_HEADER, _CURVES = 128, (b"kTRC", b"gTRC")  # bytes; tags of a grey curve and of green (ICC.1:2022, 7.2 and 9.2)
_SAMPLES = np.linspace(0.0, 1.0, 1025)  # codes at which a parametric curve is tabulated
_EXIF_SRGB = 1  # value of ColorSpace (Exif 2.3)


def power(exponent: float) -> Array:
    """(nodes,) light as a power of the code."""
    return np.asarray(_NODES**exponent)


def srgb() -> Array:
    """(nodes,) light by IEC 61966-2-1."""
    return np.where(_NODES <= 0.04045, _NODES / 12.92, ((_NODES + 0.055) / 1.055) ** 2.4)


def sampled_curve(light: Array) -> Array:
    """(nodes,) curve interpolated from values (n,) at evenly spaced codes. Raises ValueError if it does not
    increase."""
    even = np.interp(_NODES, np.linspace(0.0, 1.0, len(light)), light)
    low, high = float(even[0]), float(even[-1])
    if not (high > low and np.all(np.diff(even) >= 0)):
        raise ValueError("a tone curve grows with the code")
    return np.asarray((even - low) / (high - low))


@dataclass(frozen=True, eq=False)
class ToneInformation:
    """Information of images on the departures of a curve, as normal equations.

    Attributes
    ----------
    matrix : (k, k) information matrix.
    right_side : (k,) matrix times the most likely departures.
    sum_of_squares : weighted sum of squares of the misfit without departures.
    count : number of independent quantities.
    common_variance : variance of each departure common to all images, for example by JPEG's rounding. It is not in the
        matrix and does not average out over images.
    sharpening : of the scan.
    """

    matrix: Array
    right_side: Array
    sum_of_squares: float
    count: int
    common_variance: float = 0.0
    sharpening: Sharpening = field(default_factory=Sharpening)

    @classmethod
    def empty(cls) -> "ToneInformation":
        return cls(np.zeros((_COUNT, _COUNT)), np.zeros(_COUNT), 0.0, 0)

    @classmethod
    def pool(cls, each: Sequence["ToneInformation"], scatter: float = 0.0) -> "ToneInformation":
        """Pool the information of several images on the scanner's curve.

        Parameters
        ----------
        each : information of each image. Their common variances are averaged with the traces of their matrices.
        scatter : variance of each departure of an image's own curve around the scanner's.
        """
        matrices = np.array([one.matrix for one in each])
        right_sides = np.array([one.right_side for one in each])[..., None]
        traces, common = np.trace(matrices, axis1=1, axis2=2), np.array([one.common_variance for one in each])
        own_covariances = scatter * np.linalg.inv(np.eye(_COUNT) + scatter * matrices)
        matrix = (matrices - matrices @ own_covariances @ matrices).sum(axis=0)
        return cls(
            (matrix + matrix.T) / 2,
            (right_sides - matrices @ own_covariances @ right_sides).sum(axis=(0, 2)),
            sum(one.sum_of_squares for one in each)
            - float((right_sides.swapaxes(1, 2) @ own_covariances @ right_sides).sum()),
            sum(one.count for one in each),
            float(traces @ common / max(traces.sum(), 1e-30)),
        )

    @property
    def scanner_information(self) -> "ToneInformation":
        """Information on the scanner's curve, with the common variance included in the matrix."""
        return replace(ToneInformation.pool([self], self.common_variance), common_variance=0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Tone:
    """Tone curve of a scan, with its uncertainty.

    Attributes
    ----------
    base : (nodes,) light, 0 to 1, at evenly spaced codes.
    mean, covariance : (k,) and (k, k) of the departures from the base, in units of their standard deviations without
        prior knowledge.
    source : origin of the curve, as part of a sentence.
    is_declared : whether the file declares it; images may contradict that.
    other_scans : curve before the information of other scans of the scanner, and that information; None without any.
    before : prior curve from which this one starts or was estimated; None for the prior itself.
    sharpening : applied to the codes after the tone curve.
    """

    base: Array = field(default_factory=lambda: power(1.0))
    mean: Array = field(default_factory=lambda: np.zeros(_COUNT))
    covariance: Array = field(default_factory=lambda: np.zeros((_COUNT, _COUNT)))
    source: str = "grey values are taken as light"
    is_declared: bool = False
    other_scans: "tuple[Tone, tuple[ToneInformation, ...]] | None" = field(default=None, compare=False)
    before: "Tone | None" = field(default=None, compare=False)
    sharpening: Sharpening = field(default_factory=Sharpening)

    @classmethod
    def unknown(cls) -> "Tone":
        return cls(power(_POWER), covariance=np.eye(_COUNT), source="estimated from the edges of marks")

    @classmethod
    def declared(cls, base: Array, source: str) -> "Tone":
        """Curve declared by the file."""
        return cls(base, covariance=_DECLARED_SIGMA**2 * np.eye(_COUNT), source=source, is_declared=True)

    @property
    def is_identity(self) -> bool:
        return not (self.mean.any() or self.sharpening) and bool(np.array_equal(self.base, _NODES))

    @property
    def is_known(self) -> bool:
        return not self.covariance.any()

    @property
    def prior(self) -> "Tone":
        """Prior curve, before this scan."""
        return self.before or self

    @property
    def without_priors(self) -> "Tone":
        """The curve without its prior, as a result."""
        return replace(self, before=None, sharpening=replace(self.sharpening, prior=None))

    @property
    def starting_curves(self) -> tuple["Tone", ...]:
        """Alternative initial curves if this one is uncertain: with a curve far from the true one, a mark may be lost
        in noise and grain."""
        curves = list[Tone]() if self.is_known else [self]
        for power in _STARTS if curves else ():
            apart = min(abs(power - each.equivalent_power(0.1, 0.9)[0]) for each in curves)
            curves += [self.shift_to_power(power)] if apart > _ANOTHER else []
        return tuple(curves[1:])

    def shift_to_power(self, value: float) -> "Tone":
        """Initial curve, shifted in its first departure so that it approximates a power."""
        mean = self.mean.copy()
        mean[0] += (value - self.equivalent_power(0.1, 0.9)[0]) / _POWER_SIGMA
        return replace(self, mean=mean, before=self.prior)

    @property
    def plausible_curves(self) -> tuple["Tone", ...]:
        """The curve itself if known, else the two curves one standard deviation of the power to either side."""
        if self.is_known:
            return (self,)
        sigma = np.sqrt(self.covariance[0, 0]) * np.eye(_COUNT)[0]
        return replace(self, mean=self.mean - sigma), replace(self, mean=self.mean + sigma)

    def include_information(self, others: Sequence[ToneInformation]) -> "Tone":
        """Update the curve by information from other scans of the scanner.

        The information is kept and pooled again with that of the scan itself, since errors common to all scans do not
        average out.
        """
        if not others:
            return self
        sharpening = Sharpening.pool([one.sharpening for one in others])
        return replace(self.estimate(others)[0], other_scans=(self, tuple(others)), sharpening=sharpening)

    def estimate(self, each: Sequence[ToneInformation]) -> tuple["Tone", float]:
        """Update the curve by information from images.

        Parameters
        ----------
        each : information of each image. Images that agree may overrule the declared curve.

        Returns
        -------
        Estimated curve, and the variance of each departure of the images' own curves around it.
        """
        if self.other_scans is not None:
            before, others = self.other_scans
            return before.estimate([*others, *each])
        if self.is_known or not each:
            return self, 0.0
        tone, scatter, log_likelihood = self._most_likely(each)
        if not self.is_declared:
            return tone, scatter
        # With the vague prior of an undeclared curve, between linear and sRGB.
        mean = np.zeros(_COUNT)
        mean[0] = (_POWER - Tone(self.base).equivalent_power(0.1, 0.9)[0]) / _POWER_SIGMA
        vague = replace(self, mean=mean, covariance=np.eye(_COUNT))
        free, free_scatter, free_log_likelihood = vague._most_likely(each)
        if free_log_likelihood - log_likelihood < _CONTRADICTED:
            return tone, scatter
        source = f"{self.source}, but the pictures contradict it"
        return replace(free, source=source, is_declared=False), free_scatter

    def _most_likely(self, each: Sequence[ToneInformation]) -> tuple["Tone", float, float]:
        """Estimate with the most likely scatter; returns curve, scatter and logarithm of its marginal likelihood.

        Images that contradict one another or the prior significantly have edges that are not as drawn, for example by
        sharpening or uneven development. Each image therefore has its own curve, and the scatter of these curves around
        the scanner's is estimated as the variance of random effects. The prior of its root is half-Cauchy (Gelman,
        2006, Prior distributions for variance parameters).
        """
        estimates = []
        for scatter in _SCATTERS:
            pooled = ToneInformation.pool(each, scatter)
            information, prior = pooled.scanner_information, np.linalg.inv(self.covariance)
            covariance = np.linalg.inv(prior + information.matrix)
            right_side = prior @ self.mean + information.right_side
            mean = covariance @ right_side
            log_likelihood = np.linalg.slogdet(prior @ covariance)[1] + right_side @ mean
            log_likelihood -= self.mean @ prior @ self.mean + information.sum_of_squares + 2 * np.log1p(scatter)
            log_likelihood -= _log_determinant(scatter, each) + _log_determinant(pooled.common_variance, [pooled])
            tone = replace(self, mean=mean, covariance=(covariance + covariance.T) / 2)
            estimates.append((tone, scatter, float(log_likelihood / 2)))
        return max(estimates, key=itemgetter(2))

    def light(self, code: NDArray[np.floating] | NDArray[np.integer], full_scale: float) -> Single:
        """Convert grey values to light on the same scale, 0 to full_scale; both ends are fixed."""
        if self.is_identity:
            return np.asarray(code, np.float32)
        share = np.maximum(np.asarray(code, np.float32) * np.float32(_PIECES / full_scale), np.float32(0.0))
        whole = np.minimum(share.astype(np.int32), _PIECES - 1)
        table, steps = self._float32_table
        return np.asarray(np.float32(full_scale) * (table[whole] + steps[whole] * (share - whole)), np.float32)

    def code(self, light: NDArray[np.floating], full_scale: float) -> Array:
        """Convert light to grey values."""
        return np.asarray(full_scale * np.interp(np.asarray(light) / full_scale, self._table, _NODES))

    def replace_sharpening(self, sharpening: Sharpening) -> "Tone":
        """Copy of the curve, and of its prior, with the scan's sharpening."""
        before = self.before and replace(self.before, sharpening=sharpening)
        return replace(self, sharpening=sharpening, before=before)

    def slope(self, light: NDArray[np.floating], full_scale: float) -> Array:
        """Derivative of light with respect to the grey value, at a light."""
        steps = np.diff(self._table) * _PIECES
        share = np.asarray(self.code(light, full_scale)) / full_scale
        return np.asarray(steps[np.clip((share * _PIECES).astype(int), 0, _PIECES - 1)])

    def derivatives(self, light: NDArray[np.floating], full_scale: float) -> Array:
        """(k, ...) derivatives of light with respect to the departures, at the codes of this light."""
        share = self.code(light, full_scale) * (_PIECES / full_scale)
        whole = np.minimum(share.astype(np.intp), _PIECES - 1)
        by_departure, steps = self._departure_derivatives, np.diff(self._departure_derivatives, axis=1)
        return np.asarray(full_scale * (by_departure[:, whole] + steps[:, whole] * (share - whole)))

    def equivalent_power(self, low: float, high: float) -> tuple[float, float]:
        """Power (gamma) fitted to the curve between two codes, fractions of full scale, and its standard deviation."""
        codes = np.linspace(max(low, 0.02), max(high, low + 0.02), 50)
        at = np.clip((codes * _PIECES).astype(int), 0, _PIECES - 1)
        slope = np.log(np.maximum(np.diff(self._table)[at], 1e-12))
        design = np.column_stack([np.log(codes), np.ones_like(codes)])
        of_slope = np.linalg.pinv(design)[0]
        sigma2 = of_slope @ (_WAVES[:, at].T @ self.covariance @ _WAVES[:, at]) @ of_slope
        return 1 + float(of_slope @ slope), float(np.sqrt(max(sigma2, 0.0)))

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
    def _departure_derivatives(self) -> Array:
        """(k, nodes) derivatives of the table, up to a part proportional to light, which the gain of a fit absorbs."""
        sums = np.cumsum(self._steps * _WAVES, axis=1) / self._steps.sum()
        return np.concatenate([np.zeros((_COUNT, 1)), sums], axis=1)

    @cached_property
    def _float32_table(self) -> tuple[Single, Single]:
        return self._table.astype(np.float32), np.diff(self._table).astype(np.float32)

    def __repr__(self) -> str:
        value, sigma = self.equivalent_power(0.1, 0.9)
        return f"Tone(gamma {value:.2f} ± {sigma:.2f}: {self.source})"


def _log_determinant(variance: float, each: Sequence[ToneInformation]) -> float:
    """Sum of log det(I + variance * matrix): increase of the images' log covariance determinants by that variance."""
    matrices = np.array([one.matrix for one in each])
    return float(np.linalg.slogdet(np.eye(_COUNT) + variance * matrices)[1].sum())


LINEAR = Tone()


@dataclass(frozen=True, eq=False)
class ColourTags:
    """Tags of a file that declare its tone curve.

    icc_profile: empty if absent; transfer_function: (codes,) light of each code; exif: tags of the Exif block; is_srgb:
    PNG's sRGB chunk is present; light_power: inverse of PNG's gAMA.
    """

    icc_profile: bytes = b""
    transfer_function: Array | None = None
    exif: Mapping[str, Any] = field(default_factory=dict)
    is_srgb: bool = False
    light_power: float | None = None


def tone_of_tags(tags: ColourTags) -> Tone | None:
    """Read the tone curve declared by a file. The ICC profile has priority over all other tags.

    Returns
    -------
    Tone, or None if no tag declares a usable curve.

    Raises
    ------
    ValueError, LookupError, ArithmeticError, struct.error
        If the tags are corrupt.
    """
    if tags.icc_profile and (curve := curve_of_profile(tags.icc_profile)) is not None:
        return Tone.declared(curve, "the file's ICC profile says it")
    if tags.transfer_function is not None:
        return Tone.declared(sampled_curve(tags.transfer_function), "the file's TransferFunction says it")
    if tags.is_srgb:
        return Tone.declared(srgb(), "the file says sRGB")
    if tags.light_power is not None:
        return Tone.declared(power(tags.light_power), "the file's gAMA chunk says it")
    if tags.exif.get("ColorSpace") == _EXIF_SRGB:
        return Tone.declared(srgb(), "the file's Exif data say sRGB")
    if "Gamma" in tags.exif:
        above, below = tags.exif["Gamma"]
        return Tone.declared(power(above / below), "the file's Exif data say it")
    return None


def curve_of_profile(profile: bytes) -> Array | None:
    """(nodes,) light by the grey or green curve of an ICC profile; None if it has none, such as profiles with colour
    tables. Raises struct.error or ValueError if it is corrupt."""
    (count,) = struct.unpack_from(">I", profile, _ICC_HEADER)
    for entry in range(min(count, 100)):
        name, offset, size = struct.unpack_from(">4sII", profile, _ICC_HEADER + 4 + 12 * entry)
        if name in _CURVES:
            return _curve(profile[offset : offset + size])
    return None


def _curve(data: bytes) -> Array | None:
    """Decode curveType and parametricCurveType (ICC.1:2022, 10.6 and 10.18)."""
    if data[:4] == b"curv":
        (count,) = struct.unpack_from(">I", data, 8)
        if count == 0:
            return power(1.0)
        if count == 1:
            return power(struct.unpack_from(">H", data, 12)[0] / 256)
        return sampled_curve(np.frombuffer(data, ">u2", count, 12).astype(float))
    if data[:4] != b"para":
        return None
    (kind,) = struct.unpack_from(">H", data, 8)
    numbers = [value / 65536 for value in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", data, 12)]
    g, a, b, c, d, e, f = numbers + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0][len(numbers) - 1 :]
    if kind in (1, 2):
        limit, shift = -b / a, c if kind == 2 else 0.0
        low, above = np.full_like(_SAMPLES, shift), shift
    else:
        limit, above = (d, e) if kind > 2 else (0.0, 0.0)
        low = c * _SAMPLES + f
    return sampled_curve(np.where(limit <= _SAMPLES, np.maximum(a * _SAMPLES + b, 0.0) ** g + above, low))
