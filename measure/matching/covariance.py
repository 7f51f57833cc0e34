"""The covariance of a matched place by its causes, from the fit linearised at its solution."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter

from measure.array_types import Array, Mask
from measure.geometry import Affine, linear_scale
from measure.marks.rendering import render
from measure.marks.shapes import MarkTemplate
from measure.marks.shared_picture import SMOOTHED_PX2
from measure.marks.templates import GRAIN_PX
from measure.matching.models import GREY
from measure.noise.noise_model import SCALE_VARIANCE, NoiseModel, autocovariance, combined, correlated, faded, products
from measure.noise.robust_estimation import robust_scale
from measure.results import Covariance, MarkFit, OwnShape, SecondPlace

_ALIKE_PX = 1.5  # standard deviation of the weights by distance of what neighbours leave alike
_BESIDE_DAMAGE_PX = 1.0  # standard deviation of the weights by distance of what damage leaves beside itself
_TEXTURE_PX = 8  # up to which texture is taken as alike
_SMOOTH_PX = 0.8  # of residuals, by which texture is told from noise: as damage is
_CUT_SIGMAS = 3.2  # of the noise: what stands out more is cut out as damage
_LEAST_SLOPE = 1e-3  # of a clipped grey value: what tells less tells nothing
_MOSTLY = 0.5  # of the light of a pixel, that is one side's
_LEAST_PX = 400  # of the frame beside the notch: fewer do not tell how uneven it is
# Of the contrast and the logarithm of its change, how much half tones are off: anything between nothing and what a glow
# makes that stays as it is while the light changes, which is a half.
_HALF_TONES = 0.5 / np.sqrt(3)
_MOST = 1.0  # of that logarithm: more is another scanner's scale
_SMOOTHING = 1.5  # times the scan's blur: noise of about 1.3 times the match's, while a line's two edges stay apart
_LEAST_SMOOTHING_PX = 1.0  # below it pixels sample the derivative too coarsely
_WORST_CONDITION = 1e6  # of a normal matrix: beyond it double precision leaves no figure of a place in small windows
_OWN = 0.9  # of what is known of rotation and scale: where the picture gives so much, little is the frame's
_LEAST_SQUARES = 0.1  # of the slopes' squares: less would tell nothing


@dataclass(frozen=True, eq=False)
class LinearFit:
    """residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the
    unknowns, the first two the place by column and row, the last four gain, offset and slopes of the ground; by_grey,
    alike: derivatives of the fitted unknowns by the grey values; noise: of these. All images are
    multiplied by steadiness (height, width), so that their noise is alike everywhere."""

    residuals: Array
    used: Mask
    design: Array
    by_grey: Array
    noise: NoiseModel
    steadiness: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) that the noise gives to n figures, whose derivatives by the grey values are (n, height, width)."""
        white = self.noise.variance_dn2 * by_grey
        covariance = products(by_grey, white if self.noise.is_white else correlated(by_grey, self.noise))
        return np.asarray((covariance + covariance.T) / 2)

    def unlike_drawing_px2(self, by_noise: Array) -> Array:
        """(2, 2) by which the place is known less well than by_noise, (2, 2) px2, says: by what is left at the mark's
        edges, and alike in neighbours, beyond the noise."""
        place, left = self.by_grey[:2], np.where(self.used, self.residuals, 0.0)[None]
        expected = self.covariance(place)
        if self.noise.is_grain:  # that weighed the fit: as if it were white, so that neighbours share none
            place, left = correlated(place, self.noise, 0.5), correlated(left, self.noise, -0.5)
            expected = products(place, place)
        shares = place * left
        about = _about(shares, _ALIKE_PX) * (2 * np.pi * _ALIKE_PX**2)
        more = products(about, shares) - expected
        sizes, axes = eigh((more + more.T) / 2, by_noise)
        axes = by_noise @ axes
        return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)

    def damage_px2(self, damaged: Mask) -> Array:
        """(2, 2) of the place, by damage (height, width) that was cut out: it goes on beside itself, too faintly to be
        cut out there. Each of its regions is taken to leave any amount up to what is just not cut out, smoothed."""
        about = _about(np.where(self.used, self.by_grey[:2], 0.0), _BESIDE_DAMAGE_PX)
        _, regions = cv2.connectedComponents(damaged.astype(np.uint8), connectivity=4)
        by_region = np.stack([np.bincount(regions.ravel(), each.ravel()) for each in about * self._uncut])[:, 1:]
        return np.asarray(by_region @ by_region.T / 3)  # the variance of an even distribution from 0 to 1

    def texture_px2(self, area: Mask) -> Array:
        """(2, 2) of the place, by texture that one side of the mark's edges has, inside or outside, beyond the noise of
        both together. area (height, width): the pixels about the mark; what was cut out of it as damage may be the
        texture's blotches."""
        shown = self.design[-GREY] / self.steadiness
        return self._texture_px2(shown, area) + self._texture_px2(1 - shown, area)

    def _texture_px2(self, share: Array, area: Mask) -> Array:
        """Of one side; share (height, width): of that side in the light of each pixel."""
        side = area & (share > _MOSTLY)
        if not side.any():
            return np.zeros((2, 2))
        beyond_dn2 = self._texture_dn2(side)
        texture = np.where(side, self._uncut, 0.0)
        texture[side] -= texture[side].mean()
        lags = faded(autocovariance(texture, side, _TEXTURE_PX))
        alike = lags[_TEXTURE_PX, _TEXTURE_PX + 1]  # of neighbours: the noise of single pixels counts already
        if beyond_dn2 == 0.0 or alike <= 0.0:
            return np.zeros((2, 2))
        lags[_TEXTURE_PX, _TEXTURE_PX] = alike
        moved = self.by_grey[:2] * share
        return _positive(products(moved, correlated(moved, NoiseModel(beyond_dn2, lags * (beyond_dn2 / alike), 1.0))))

    def _texture_dn2(self, side: Mask) -> float:
        """The variance of smoothed residuals, dust left out, beyond what the noise leaves of itself and chance."""
        smooth = np.asarray(cv2.GaussianBlur(np.where(side, self.residuals, 0.0), (0, 0), _SMOOTH_PX), float)
        reach = len(self.noise.autocovariance_dn2) // 2
        lag2 = np.add.outer(*2 * [np.arange(-reach, reach + 1) ** 2])
        pixels = 4 * np.pi * _SMOOTH_PX**2  # that are one, smoothed
        noise_dn2 = float(np.sum(self.noise.autocovariance_dn2 * np.exp(-lag2 / (4 * _SMOOTH_PX**2))) / pixels)
        chance = 3 * np.sqrt(2 * SCALE_VARIANCE * pixels / side.sum())
        beyond_dn2 = robust_scale(np.asarray(smooth[side], np.float64)) ** 2 - noise_dn2
        return beyond_dn2 if beyond_dn2 > chance * noise_dn2 else 0.0

    @property
    def _uncut(self) -> Array:
        """(height, width) residuals, at most as large as noise makes them: dust stands out more, texture hardly."""
        limit_dn = _CUT_SIGMAS * np.sqrt(self.noise.variance_dn2)
        return np.clip(self.residuals, -limit_dn, limit_dn)


def second_order(design: Array, slopes: Array, used: Mask, covariance: Array, priors_dn2: Array) -> float:
    """By what share of itself the variance of a place is larger than a linearised adjustment has it.

    design (unknowns, height, width): derivatives of the model, the first two by column and row, the last four by the
    greys; slopes (height, width): their part in what clipped grey values tell, 1 elsewhere; used (height, width): the
    pixels that count; covariance (unknowns, unknowns); priors_dn2 (unknowns,): weights of the priors, that of a pixel
    being 1. The bends are compared pixel by pixel, with grain in the covariance only: its weights amplify them as no
    noise does."""
    moving = len(design) - GREY + 1  # all but the ground's
    among, used_design = covariance[:moving, :moving], design * used
    # All that moves with the mark changes by its slope, against the move.
    whole = design[:moving] / np.maximum(slopes, _LEAST_SLOPE)
    changes = np.concatenate(np.gradient(whole, axis=(2, 1))) * (-slopes * used)
    normal, shared = products(used_design, used_design), products(used_design, changes)
    inverse: Array = np.asarray(np.linalg.inv(normal + np.diag(priors_dn2)), float)
    taken_up = np.asarray(inverse @ shared, float)
    by_unknown = np.trace(taken_up[:2].reshape(2, 2, moving))  # of the variance's logarithm, negative
    both = taken_up.T @ shared
    left = products(changes, changes) - both - both.T + taken_up.T @ normal @ taken_up
    turning = np.einsum("jl,ijml->im", among, left.reshape(2, moving, 2, moving))
    by_noise = np.asarray(inverse @ normal @ inverse, float)
    curvature = np.trace(by_noise[:2, :2] @ turning) / 2
    # Lags that are noise themselves may leave the covariance of the other unknowns indefinite.
    return max(float(curvature + by_unknown @ among @ by_unknown / 2), 0.0)


# What a place is uncertain by that its residuals do not show: light that is uneven in the mark, tones that changed.
#
# A notch is cut into the frame's border and exposed as the frame is: its light is no more even than the terrain. A
# slope of that light is a shift of the edges where it ends, and leaves little else in a small notch. How uneven it may
# be, the frame beside the notch shows.
#
# An edge between dark and light is a slope of grey values. Light that is stronger than in the pictures that a chip was
# learned from climbs that slope elsewhere: the film saturates, or what glows beside it does not grow as it does. Its
# half tones then are lighter or darker between the same ends, and where all edges face one side that is a shift and
# leaves next to nothing else.


@dataclass(frozen=True, eq=False)
class Landscape:
    """A landscape in a mark that varies as beside it. light (height, width): grey values, and frame_pixels, which of
    them show the frame; share (height, width): of the landscape in the light of the mark's own window."""

    light: Array
    frame_pixels: Mask
    share: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) of figures, column and row of a place for example, whose derivatives by the grey values of the mark's
        window are by_grey (n, height, width)."""
        if self.frame_pixels.sum() < _LEAST_PX:
            return np.zeros((len(by_grey),) * 2)
        moved, reach = by_grey * self.share, max(self.share.shape)
        uneven = np.where(self.frame_pixels, self.light - self.light[self.frame_pixels].mean(), 0.0)
        lags = autocovariance(uneven, self.frame_pixels, reach)
        # The noise of single pixels counts already; what neighbours have in common is the landscape.
        lags[reach, reach] = max(lags[reach, reach + 1], 0.0)
        return _positive(products(moved, correlated(moved, NoiseModel(float(lags[reach, reach]), lags, 1.0))))


def _about(images: Array, sigma_px: float) -> Array:
    """Images (n, height, width), smoothed by a Gaussian, with nothing beyond their borders."""
    return np.asarray(gaussian_filter(images, (0.0, sigma_px, sigma_px), mode="constant"))


def _positive(covariance: Array) -> Array:
    """(n, n) without its negative directions: far lags are chance, and may leave less than none."""
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)


def covariance_of_changed_tone(half_tones: Array, by_grey: Array, contrast_change: float) -> Array:
    """(2, 2) px2 of a place, for what the tones may have changed.

    half_tones (height, width): grey values, the picture's contrast in the middle between dark and light, none at both
    ends; by_grey (unknowns, height, width): the unknowns' derivatives by the grey values, column and row first.
    contrast_change: the contrast over that of the pictures that the chip was learned from.
    """
    bent = _HALF_TONES * min(abs(float(np.log(contrast_change))), _MOST)
    moved = bent * products(by_grey[:2], half_tones[None])
    return np.asarray(moved @ moved.T)


# A second place of a mark, by another method, beside the matched one: by its edges, or with paint that slopes.
#
# Both are linear in the residuals of the match, so that the covariance of their difference to the matched place is
# known: noise moves both places, in part together. What it cannot explain is damage or a mark unlike its drawing.


def edge_place(fit: LinearFit, blur_px: float) -> SecondPlace | None:
    """The place by the mark's edges, None where they do not give one.

    Least-squares matching weighs grey values by how fast the mark's picture changes. An edge detector (Haralick, 1984,
    Digital step edges from zero crossing of second directional derivatives) asks instead where the second derivative
    across an edge, under a Gaussian, passes through nothing. Summed round the mark that gives a place of its own: gain,
    offset and whatever is smooth have no part in it, and a mark whose opposite edges are alike needs no drawing for it.
    """
    weights = across_edges(fit.design[:2] * fit.used, max(_SMOOTHING * blur_px, _LEAST_SMOOTHING_PX)) * fit.used
    response = products(weights, fit.design)
    # What noise the match has taken up already has left the residuals.
    return _second_place(fit, np.eye(2), response[:, :2], weights, weights - combined(response, fit.by_grey))


def sloping_place(fit: LinearFit) -> SecondPlace | None:
    """The place with two more unknowns, slopes of the contrast, in one step from the fit; None where they are not told
    from the others.

    Dust on one side of a small disk, soft at its edge, moves the disk as it moves an edge, and leaves of itself only
    that the disk is darker on that side. A disk whose paint may grow lighter or darker across takes that up.
    """
    sloping = fit.design[-GREY] * fit.design[-2:] * fit.used
    left = (sloping - combined(products(sloping, fit.design), fit.by_grey)) * fit.used  # by what the match has taken up
    return _second_place(fit, -products(fit.by_grey[:2], sloping), products(left, sloping), left, left)


def _second_place(fit: LinearFit, by_unknown: Array, normal: Array, weights: Array, left: Array) -> SecondPlace | None:
    """The place by sums of residuals by weights (2, height, width), which change by two unknowns as normal (2, 2) says;
    by_unknown (2, 2): the place's derivatives by these; left: the sums' derivatives by the noise. None where nothing
    determines it, or the noise's lags, which are noise themselves, make no covariance."""
    if not np.linalg.cond(normal) < _WORST_CONDITION:
        return None
    by_sums = np.asarray(by_unknown @ np.linalg.inv(normal), float)
    covariance_px2 = fit.covariance(combined(by_sums, left))
    if not np.all(np.linalg.eigvalsh(covariance_px2) > 0):
        return None
    return SecondPlace(by_sums @ products(weights, fit.residuals[None])[:, 0], covariance_px2)


def across_edges(slopes: Array, smoothing_px: float) -> Array:
    """(2, height, width): what each grey value counts in the sums, along columns and rows, of the second derivatives
    across the edges; slopes (2, height, width): of the mark's picture."""
    square = np.maximum((slopes**2).sum(axis=0), 1e-300)
    across = (slopes[0] ** 2 / square, 2 * slopes[0] * slopes[1] / square, slopes[1] ** 2 / square)
    smooth, slope, bend = _kernels(smoothing_px)
    along = ((bend, smooth), (slope, slope), (smooth, bend))
    return np.stack(
        [
            sum(
                cv2.sepFilter2D(part * share, cv2.CV_64F, *kernels, borderType=cv2.BORDER_CONSTANT)
                for share, kernels in zip(across, along, strict=True)
            )
            for part in slopes
        ]
    )


def _kernels(sigma_px: float) -> tuple[Array, Array, Array]:
    """A Gaussian and its first two derivatives; the second sums to nothing, so that an even ground has none."""
    reach = int(np.ceil(4 * sigma_px))
    place = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(place**2) / (2 * sigma_px**2))
    smooth /= smooth.sum()
    bend = (place**2 / sigma_px**2 - 1) * smooth / sigma_px**2
    return smooth, -place * smooth / sigma_px**2, bend - bend.mean()


# The rotation and scale that a mark's own picture gives, where it was matched with those of the frame.
#
# A wedge's or a notch's edges hardly tell its scale from its place, so the frame gives it. But what touches an edge
# moves the place as it changes that scale, and leaves no other trace: both are in the picture, and may be compared.


def own_shape(fit: LinearFit, shape: slice, strain: slice, departures: Array) -> OwnShape | None:
    """What the picture says of the two unknowns of a shape, None where they were its own anyway, or it says nothing.

    shape: which unknowns of the fit these are; strain: those of stretch and shear, which stay held by the frame;
    departures (unknowns,): of the match from what the frame gave.
    """
    resolution = products(fit.by_grey, fit.design)
    if np.diag(resolution)[shape].min() > _OWN:
        return None
    let_go = resolution.copy()  # as if no other unknown were held: each column is how far that unknown itself decides
    let_go[:, strain] = np.eye(len(resolution))[:, strain]
    try:
        freed = np.asarray(np.linalg.inv(let_go), float)[shape]
    except np.linalg.LinAlgError:
        return None
    by_noise = combined(freed, fit.by_grey)
    variance = np.diag(fit.covariance(by_noise))
    if not np.all(variance > 0):
        return None
    change = products(by_noise, np.where(fit.used, fit.residuals, 0.0)[None])[:, 0]
    return OwnShape(change + freed @ resolution @ departures, np.sqrt(variance), -resolution[:2, shape])


def honest_covariance(template: MarkTemplate, scan: str, fit: MarkFit) -> Covariance:
    """Of a mark measured in a scan that has a share in its template.

    The scan's noise is in the template too and so is missing from the residuals, in which only the rest, one less its
    share, is left. Where the template is that scan's picture alone nothing is left: then noise from the picture itself.
    Slopes of the template that are noise tell nothing of the place, but the fit took them for slopes of the mark.
    """
    share = template.shares.get(scan, 0.0)
    if share == 1.0:
        return Covariance.from_noise(_covariance_of_noise(template, fit))
    return fit.place_covariance.through(_slope_noise_factor(template, fit) / np.sqrt(1.0 - share))


def _slope_noise_factor(template: MarkTemplate, fit: MarkFit) -> Array:
    """(2, 2) what an error of the place is to be multiplied by: the squares of all slopes that the fit saw over those
    of the mark's."""
    linear, blur_px2 = fit.pixel_from_mark[:, :2], SMOOTHED_PX2 + fit.blur_px**2
    px_per_sample = linear_scale(linear) * template.pitch_um / 1000
    side = int(np.ceil(len(template.image) * px_per_sample))
    place = Affine.from_linear(linear, np.full(2, (side - 1) / 2)).matrix
    shown = render(template, place, side, side, float(np.sqrt(blur_px2)))
    slopes = np.stack([shown.by_col, shown.by_row]).astype(float)
    noise = template.slope_noise_dn / max(float(np.ptp(template.image)), 1e-9) / px_per_sample
    noise *= SMOOTHED_PX2 / blur_px2  # more blur takes as much of the slopes of white noise
    squares, axes = np.linalg.eigh(products(slopes, slopes))
    marks = np.maximum(squares - noise**2 * side**2, _LEAST_SQUARES * squares)
    return np.asarray(axes * (squares / marks) @ axes.T)


def _covariance_of_noise(template: MarkTemplate, fit: MarkFit) -> Array:
    """Of a shift, gain and offset, from the picture's slopes and its noise, as grain of GRAIN_PX correlates it."""
    side = template.image.shape[0]
    place = Affine.from_linear(fit.pixel_from_mark[:, :2], np.full(2, side / 2)).matrix
    shown = render(template, place, side, side, 0.0)
    columns = [fit.contrast_dn * shown.by_col, fit.contrast_dn * shown.by_row, shown.value, np.ones_like(shown.value)]
    normal = products(np.stack(columns), np.stack(columns))
    size = np.sqrt(np.diag(normal))
    inverse = np.linalg.pinv(normal / np.outer(size, size)) / np.outer(size, size)
    # As many pixels as such grain is wide are one observation: the sum of its correlations.
    return np.asarray(4 * np.pi * GRAIN_PX**2 * max(template.noise_dn, 1e-3) ** 2 * inverse[:2, :2])
