"""The covariance of a matched place by its causes, from the fit linearised at its solution."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter

from measure.array_types import Array, Mask
from measure.flags import Cause
from measure.geometry import linear_scale
from measure.marks.rendering import render
from measure.marks.shapes import MarkTemplate
from measure.marks.templates import GRAIN_PX, SMOOTHED_PX2
from measure.matching.gauss_newton import PictureFit
from measure.matching.models import GREY
from measure.noise.noise_model import (
    SCALE_VARIANCE,
    NoiseModel,
    autocovariance,
    combine,
    correlate,
    inner_products,
    least_squares_factors,
    taper,
)
from measure.noise.robust_estimation import robust_scale
from measure.results import Covariance, MarkFit, OwnShape, SecondPlace

_ALIKE_PX = 1.5  # px, standard deviation of the Gaussian weights for the correlation of model misfit
_BESIDE_DAMAGE_PX = 1.0  # px, standard deviation of the Gaussian weights for faint damage around masked pixels
_TEXTURE_PX = 8  # px, largest lag of the autocovariance of texture
_SMOOTH_PX = 0.8  # px, smoothing of residuals that separates texture from noise, as for damage
_CUT_SIGMAS = 3.2  # noise standard deviations beyond which residuals are masked as damage
_MOSTLY = 0.5  # fraction of a pixel's light that assigns it to one side of the edge
_LEAST_PX = 400  # pixels of the frame needed to estimate the background's texture
# Standard deviation of the error of half tones, in units of contrast times log contrast change: uniform between 0 and
# 1/2, the value for a glow that stays constant while the light changes.
_HALF_TONES = 0.5 / np.sqrt(3)
_MOST = 1.0  # limit of the log contrast change: a larger one is a different scanner scale
_WORST_CONDITION = 1e6  # of the normal matrix: beyond it a place in a small window has no significant digits
_OWN = 0.9  # share of the image in rotation and scale above which the frame contributes little
_SPLITS = 8  # directions of lines that divide a mark into halves
_BY_HALVES = 0.25  # fraction of the squared residuals that a shift between halves explains; dust leaves less than 0.2
_LEAST_SQUARES = 0.1  # lower bound of the mark's fraction of the squared slopes


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Fit linearised at its solution.

    Attributes
    ----------
    residuals : (height, width).
    used : (height, width) mask of the pixels used.
    design : (unknowns, height, width) derivatives of the model with respect to the unknowns. The first two are column
        and row of the place, the last four gain, offset and slopes of the background.
    by_grey : (unknowns, height, width) derivatives of the estimated unknowns with respect to the grey values.
    noise : of the grey values.
    steadiness : (height, width) factor of all images, so that their noise is uniform.
    """

    residuals: Array
    used: Mask
    design: Array
    by_grey: Array
    noise: NoiseModel
    steadiness: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) covariance by noise of n quantities with derivatives by_grey (n, height, width) with respect to the
        grey values."""
        white = self.noise.variance_dn2 * by_grey
        covariance = inner_products(by_grey, white if self.noise.is_white else correlate(by_grey, self.noise))
        return np.asarray((covariance + covariance.T) / 2)

    def model_misfit_px2(self, by_noise: Array) -> Array:
        """(2, 2) covariance of the place due to model misfit: correlated residuals at the mark's edges in excess of the
        noise. by_noise (2, 2) px2: covariance due to noise."""
        place, left = self.by_grey[:2], np.where(self.used, self.residuals, 0.0)[None]
        if self.noise.is_grain:  # whiten, so that neighbours are uncorrelated under the null hypothesis
            place, left = correlate(place, self.noise, 0.5), correlate(left, self.noise, -0.5)
        expected = inner_products(place, place) if self.noise.is_grain else self.covariance(place)
        shares = place * left
        about = _smooth(shares, _ALIKE_PX) * (2 * np.pi * _ALIKE_PX**2)
        more = inner_products(about, shares) - expected
        sizes, axes = eigh((more + more.T) / 2, by_noise)
        axes = by_noise @ axes
        return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)

    def damage_px2(self, damaged: Mask) -> Array:
        """(2, 2) covariance of the place due to damage that continues undetected around the masked pixels, damaged
        (height, width). Each region is assumed to leave a uniformly distributed fraction of the limited, smoothed
        residuals."""
        about = _smooth(np.where(self.used, self.by_grey[:2], 0.0), _BESIDE_DAMAGE_PX)
        _, regions = cv2.connectedComponents(damaged.astype(np.uint8), connectivity=4)
        by_region = np.stack([np.bincount(regions.ravel(), each.ravel()) for each in about * self._uncut])[:, 1:]
        return np.asarray(by_region @ by_region.T / 3)  # 1/3: mean square of a uniform distribution from 0 to 1

    def halves_px2(self, area: Mask, center_px: Array) -> Array:
        """(2, 2) covariance of the place due to halves of the mark that contradict each other; 0 if none do.

        Where one half was redrawn, or a joint displaced it, the match lies on the other half or between both, and what
        it masks still shows the mark. The shift between halves is estimated from all pixels of the area (height, width)
        around the mark, masked ones included. It counts where it explains much of the residuals.
        """
        if not np.any(area & ~self.used):
            return np.zeros((2, 2))
        (rows, cols), angles = np.indices(area.shape), np.arange(_SPLITS) * np.pi / _SPLITS
        across = np.tensordot(
            (np.cos(angles), np.sin(angles)), (cols - center_px[0], rows - center_px[1]), axes=((0,), (0,))
        )
        design = self.design * area
        halves = (np.sign(across)[:, None] * design[:2]).reshape(-1, *area.shape)
        images = np.concatenate([halves, (self.residuals * area)[None]])
        by_design = inner_products(images, design) @ np.linalg.pinv(inner_products(design, design), hermitian=True)
        left = images - combine(by_design, design)
        squares = inner_products(left, left)
        best, shift = _BY_HALVES * float(squares[-1, -1]), np.asarray(np.zeros(2), float)
        for split in range(0, len(halves), 2):
            own = slice(split, split + 2)
            if np.linalg.cond(squares[own, own]) < _WORST_CONDITION:
                step = np.linalg.solve(squares[own, own], squares[own, -1])
                if (explained := float(step @ squares[own, -1])) > best:
                    best, shift = explained, np.asarray(step, float)
        return np.asarray(shift @ shift * np.eye(2))  # masks and a free size turn its direction

    def texture_px2(self, area: Mask) -> Array:
        """(2, 2) covariance of the place due to texture inside or outside the mark in excess of the noise.

        area (height, width): pixels around the mark, including those masked as damage, which may be texture.
        """
        shown, both = self.design[-GREY] / self.steadiness, np.zeros((2, 2))
        for share in (shown, 1 - shown):  # fraction of each pixel
            side = area & (share > _MOSTLY)
            beyond_dn2 = self._texture_dn2(side) if side.any() else 0.0
            if beyond_dn2 == 0.0:
                continue
            texture = np.where(side, self._uncut, 0.0)
            texture[side] -= texture[side].mean()
            lags = taper(autocovariance(texture, side, _TEXTURE_PX))
            # Of neighbours: noise of single pixels is accounted for elsewhere.
            alike = lags[_TEXTURE_PX, _TEXTURE_PX + 1]
            if alike <= 0.0:
                continue
            lags[_TEXTURE_PX, _TEXTURE_PX] = alike
            both += _covariance_by_texture(self.by_grey[:2] * share, lags * (beyond_dn2 / alike))
        return both

    def _texture_dn2(self, side: Mask) -> float:
        """Robust variance of smoothed residuals in excess of the smoothed noise; 0 if not significant (3 sigma)."""
        smooth = np.asarray(cv2.GaussianBlur(np.where(side, self.residuals, 0.0), (0, 0), _SMOOTH_PX), float)
        reach = len(self.noise.autocovariance_dn2) // 2
        lag2 = np.add.outer(*2 * [np.arange(-reach, reach + 1) ** 2])
        pixels = 4 * np.pi * _SMOOTH_PX**2  # effective area of the smoothing kernel
        noise_dn2 = float(np.sum(self.noise.autocovariance_dn2 * np.exp(-lag2 / (4 * _SMOOTH_PX**2))) / pixels)
        least_excess = 3 * np.sqrt(2 * SCALE_VARIANCE * pixels / side.sum())
        beyond_dn2 = robust_scale(np.asarray(smooth[side], np.float64)) ** 2 - noise_dn2
        return beyond_dn2 if beyond_dn2 > least_excess * noise_dn2 else 0.0

    @property
    def _uncut(self) -> Array:
        """(height, width) residuals limited to the range of the noise, which affects dust but hardly texture."""
        limit_dn = _CUT_SIGMAS * np.sqrt(self.noise.variance_dn2)
        return np.clip(self.residuals, -limit_dn, limit_dn)


# Causes of uncertainty that leave no residuals: background texture within the mark, and changed half tones.
#
# A notch in the frame's border is exposed like the frame: its light varies like the terrain. A gradient of that light
# shifts the edges where it ends and leaves few residuals in a small notch. Its size is estimated from the frame around
# the notch.
#
# Half tones at an edge depend on the exposure. If the light is stronger than in the images from which a chip was
# learned, the film saturates, or a glow does not grow in proportion. The half tones then are lighter or darker between
# the same extremes. Where all edges face one side this is a shift that leaves almost no residuals.


@dataclass(frozen=True, eq=False)
class BackgroundTexture:
    """Background texture within a mark, assumed to vary as in the frame around it.

    light: (height, width) grey values; frame_pixels: mask of those that show the frame; share: (height, width) fraction
    of the background in the light of the mark's window.
    """

    light: Array
    frame_pixels: Mask
    share: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) covariance of quantities, such as the place, with derivatives by_grey (n, height, width) with respect
        to the grey values of the mark's window."""
        if self.frame_pixels.sum() < _LEAST_PX:
            return np.zeros((len(by_grey),) * 2)
        reach = max(self.share.shape)
        uneven = np.where(self.frame_pixels, self.light - self.light[self.frame_pixels].mean(), 0.0)
        lags = autocovariance(uneven, self.frame_pixels, reach)
        # Noise of single pixels is accounted for elsewhere; the covariance of neighbours is the texture.
        lags[reach, reach] = max(lags[reach, reach + 1], 0.0)
        return _covariance_by_texture(by_grey * self.share, lags)


def place_covariance(
    fit: PictureFit, linear: LinearFit, covariance: Array, background: BackgroundTexture
) -> Covariance:
    """Covariance of the place by its causes. covariance (unknowns, unknowns): by noise."""
    model, by_grey, by_noise = fit.model, linear.by_grey, covariance[:2, :2]
    place = Covariance.from_noise(by_noise)
    if isinstance(model.mark, MarkTemplate) and model.mark.steadiness is not None:
        change = fit.contrast_dn / float(np.ptp(model.mark.image))
        place = place.plus(Cause.CHANGED_TONES, covariance_of_changed_tone(model.half_tones, by_grey, change))
    place = place.plus(Cause.NOTCH_BACKGROUND, background.covariance(by_grey[:2]))
    place = place.plus(Cause.MODEL_MISFIT, linear.model_misfit_px2(by_noise))
    place = place.plus(Cause.DAMAGE, linear.damage_px2(fit.area & ~fit.used))
    halves = linear.halves_px2(fit.area & model.informative, fit.state.pixel_from_mark[:, 2])
    place = place.plus(Cause.MODEL_MISFIT, halves)
    if not model.is_chip and model.background_px is None:
        place = place.plus(Cause.TEXTURE, linear.texture_px2(fit.area & model.informative))
    return place


def _smooth(images: Array, sigma_px: float) -> Array:
    """Smooth images (n, height, width) by a Gaussian, with zeros beyond their borders."""
    return np.asarray(gaussian_filter(images, (0.0, sigma_px, sigma_px), mode="constant"))


def _covariance_by_texture(by_grey: Array, lags: Array) -> Array:
    """(n, n) covariance of quantities with derivatives by_grey (n, height, width) with respect to the grey values, by
    texture with an autocovariance (lags, lags)."""
    reach = len(lags) // 2
    covariance = inner_products(by_grey, correlate(by_grey, NoiseModel(float(lags[reach, reach]), lags, 1.0)))
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)  # noisy far lags may give negative eigenvalues
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)


def covariance_of_changed_tone(half_tones: Array, by_grey: Array, contrast_change: float) -> Array:
    """(2, 2) px2 covariance of a place due to changed half tones.

    Parameters
    ----------
    half_tones : (height, width) grey values: the contrast at half height between dark and light, 0 at both extremes.
    by_grey : (unknowns, height, width) derivatives of the unknowns with respect to the grey values, column and row
        first.
    contrast_change : contrast over that of the images from which the chip was learned.
    """
    bent = _HALF_TONES * min(abs(float(np.log(contrast_change))), _MOST)
    moved = bent * inner_products(by_grey[:2], half_tones[None])
    return np.asarray(moved @ moved.T)


def sloping_place(fit: LinearFit) -> SecondPlace | None:
    """Compute the place with two more unknowns, gradients of the contrast, in one step from the fit. None where they
    are not estimable, or noisy lags leave the covariance of the difference indefinite.

    Soft-edged dust on one side of a small disk shifts the disk and leaves a gradient of its contrast as its only trace.
    The additional unknowns absorb that. All is linear in the residuals of the match, so the covariance of the
    difference to the matched place is known, including the common part of the noise.
    """
    sloping = fit.design[-GREY] * fit.design[-2:] * fit.used
    left = (sloping - combine(inner_products(sloping, fit.design), fit.by_grey)) * fit.used  # not absorbed by the match
    normal = inner_products(left, sloping)
    if not np.linalg.cond(normal) < _WORST_CONDITION:
        return None
    by_sums = np.asarray(-inner_products(fit.by_grey[:2], sloping) @ np.linalg.inv(normal), float)
    covariance_px2 = fit.covariance(combine(by_sums, left))
    if not np.all(np.linalg.eigvalsh(covariance_px2) > 0):
        return None
    return SecondPlace(by_sums @ inner_products(left, fit.residuals[None])[:, 0], covariance_px2)


def line_width(fit: LinearFit, change: Array, held: int) -> tuple[float, float]:
    """Estimate the width of a mark's lines as a further unknown of the fit.

    Parameters
    ----------
    change : (height, width) derivative of the model by the logarithm of the width.
    held : index of an unknown held fixed, the blur at its limit.

    Returns
    -------
    Logarithm of the width over the drawn one, and its standard deviation; infinite where it is not determined.
    """
    others, change = np.delete(fit.design, held, axis=0) * fit.used, change * fit.used
    left = (change - combine(least_squares_factors(others, change), others))[None]
    normal, variance = float(inner_products(left, change[None])[0, 0]), float(fit.covariance(left)[0, 0])
    if not (normal > 0 and variance > 0):
        return 0.0, np.inf
    return float(inner_products(left, fit.residuals[None])[0, 0]) / normal, float(np.sqrt(variance)) / normal


# Rotation and scale by the mark's own image, where it was matched with those of the frame.
#
# The edges of a wedge or a notch hardly separate its scale from its place, so the scale is taken from the frame. But an
# object that touches an edge changes place and apparent scale together and leaves no other trace. Comparing the mark's
# own scale with the frame's reveals it.


def own_shape(fit: LinearFit, shape: slice, strain: slice, departures: Array) -> OwnShape | None:
    """Estimate rotation and scale of a mark without the prior from the frame.

    Parameters
    ----------
    shape : indices of scale and rotation among the unknowns.
    strain : indices of stretch and shear, whose prior is kept.
    departures : (unknowns,) deviations of the match from the frame's values.

    Returns
    -------
    OwnShape, or None where the image determined them anyway or does not determine them at all.
    """
    resolution = inner_products(fit.by_grey, fit.design)
    if np.diag(resolution)[shape].min() > _OWN:
        return None
    let_go = resolution.copy()  # its inverse removes the priors, except those of the strain
    let_go[:, strain] = np.eye(len(resolution))[:, strain]
    try:
        freed = np.asarray(np.linalg.inv(let_go), float)[shape]
    except np.linalg.LinAlgError:
        return None
    by_noise = combine(freed, fit.by_grey)
    variance = np.diag(fit.covariance(by_noise))
    if not np.all(variance > 0):
        return None
    change = inner_products(by_noise, np.where(fit.used, fit.residuals, 0.0)[None])[:, 0]
    return OwnShape(change + freed @ resolution @ departures, np.sqrt(variance), -resolution[:2, shape])


def honest_covariance(template: MarkTemplate, scan: str, fit: MarkFit) -> Covariance:
    """Correct the covariance of a mark measured in a scan that contributed to the mark's template.

    The template contains a share of the scan's noise, so the residuals contain only the fraction 1 - share. If the
    template comes from that scan alone there are no residuals, and the noise is that of the template.
    Slopes of the template that are noise carry no information on the place, but the fit used them.
    """
    share, linear = template.shares.get(scan, 0.0), fit.pixel_from_mark[:, :2]
    if share == 1.0:
        return Covariance.from_noise(_covariance_of_noise(template, fit))
    blur_px2 = SMOOTHED_PX2 + fit.blur_px**2
    px_per_sample = linear_scale(linear) * template.pitch_um / 1000
    side = int(np.ceil(len(template.image) * px_per_sample))
    place = np.column_stack([linear, np.full(2, (side - 1) / 2)])
    shown = render(template, place, side, side, float(np.sqrt(blur_px2)))
    slopes = np.stack([shown.by_col, shown.by_row]).astype(float)
    noise = template.slope_noise_dn / max(float(np.ptp(template.image)), 1e-9) / px_per_sample
    noise *= SMOOTHED_PX2 / blur_px2  # blur reduces the slopes of white noise by this factor
    squares, axes = np.linalg.eigh(inner_products(slopes, slopes))
    marks = np.maximum(squares - noise**2 * side**2, _LEAST_SQUARES * squares)  # squared slopes of the mark itself
    return fit.place_covariance.through(np.asarray(axes * (squares / marks) @ axes.T) / np.sqrt(1.0 - share))


def _covariance_of_noise(template: MarkTemplate, fit: MarkFit) -> Array:
    """(2, 2) covariance of the place from the template's slopes and noise, estimated with gain and offset, for grain of
    GRAIN_PX."""
    side = template.image.shape[0]
    place = np.column_stack([fit.pixel_from_mark[:, :2], np.full(2, side / 2)])
    shown = render(template, place, side, side, 0.0)
    columns = [fit.contrast_dn * shown.by_col, fit.contrast_dn * shown.by_row, shown.value, np.ones_like(shown.value)]
    normal = inner_products(np.stack(columns), np.stack(columns))
    size = np.sqrt(np.diag(normal))
    inverse = np.linalg.pinv(normal / np.outer(size, size)) / np.outer(size, size)
    # 4 pi GRAIN_PX^2: sum of the grain's correlations, the number of pixels per independent observation.
    return np.asarray(4 * np.pi * GRAIN_PX**2 * max(template.noise_dn, 1e-3) ** 2 * inverse[:2, :2])
