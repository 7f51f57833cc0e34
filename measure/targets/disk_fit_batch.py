"""Batch test of image patches for disks: a few Gauss-Newton steps of a blurred ellipse in closed form.

The image model is `gain * Phi(distance / blur) + offset + slopes`. The outline of a patch is right to a few per cent;
four steps from there localise a disk to a tenth of a pixel, and the residuals tell disks from image content. The model
takes the edge as straight within the blur, which changes the size by a few hundredths of a pixel and not the centre.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtr

from measure.array_types import Array, Indices, Mask, Single
from measure.flags import Code, Reason
from measure.matching.gauss_newton import FitModel, gauss_newton
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.noise.noise_model import influence_covariances
from measure.noise.robust_estimation import SIGMA_OF_DEVIATION, gauss_newton_step, place_influences, tukey_weights
from measure.results import Covariance, MarkFit
from measure.targets.block_search import Patches, ScanBlock, concatenate

_GROUP_PIXELS = 1 << 16  # pixels of the windows that are fitted together: 10 MiB with their derivatives
_FIRST_BLUR_PX, _BLUR_PX = 1.0, (0.5, 8.0)  # initial value and limits, standard deviations, pixel width included
_HOPELESS = 1.5  # times the allowed misfit: patches above it are dropped before the first step
_LONGEST_STEP = 0.3  # in radii: the limit of linearisation
_PLAIN_STEPS, _MOST_STEPS, _SETTLED_PX = 2, 30, 1e-3  # first ones, and all of a fit to convergence
_UNDAMAGED = 0.05  # robust weight below which a pixel shows something else
_DAMPING = 1e-4  # the unknowns of a faint disk are nearly dependent
_UNKNOWNS = 10  # place (2), size, stretch, shear, blur, gain, offset, slopes (2)
_NO_DISK = Reason("no disk explains the picture there", Code.LIKENESS)
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast; above: texture or a stain
SMOOTH = 0.5  # correlation of neighbouring residuals above which they are not noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # background, in radii and px: a target's pad may end soon
_COARSE_PX = 3.0  # sampled pixels per radius that suffice
_EDGE_SAMPLES = 16  # sampled pixels on the edge, four pixels wide, that suffice
_FARTHEST, _MOST_GROWN = 0.5, float(np.log(1.5))  # change of centre in radii, of log size; beyond: another object


def fit_disks(block: ScanBlock, patches: Patches) -> Patches:
    """Patches that are disks, fitted, the strongest first; centres are right to a tenth of a pixel or so."""
    radius = patches.radii
    first = np.full(len(radius), _FIRST_BLUR_PX)
    of_edge = np.sqrt(8 * np.pi * radius / _EDGE_SAMPLES)
    strides = np.maximum(np.minimum(radius / _COARSE_PX, of_edge), 1.0).astype(np.intp)
    promising, blurs = _fit_patches(block, patches, first, strides, _PLAIN_STEPS, (_HOPELESS, _HOPELESS))
    whole = np.ones(len(blurs), np.intp)
    return _fit_patches(block, promising, blurs, whole, 0, (np.inf, 1.0))[0].strongest_first()


def _fit_patches(
    block: ScanBlock,
    patches: Patches,
    blurs: Array,
    strides: Indices,
    plain_steps: int,
    most_misfits: tuple[float, float],
) -> tuple[Patches, Array]:
    """Fitted disks among the patches and their blurs (n,), by some plain steps and a robust one. strides (n,): spacing
    of the sampled columns and rows, since large disks need only part of their pixels; most_misfits: allowed before and
    after the steps."""
    found, blurs_found = [Patches.collect(())], [np.zeros(0)]
    margins_px = np.maximum(MARGIN * patches.radii, LEAST_MARGIN_PX)
    for group in _groups(patches, strides, margins_px):
        own, fit = group, _DiskFit(block, patches.part(group), blurs[group], strides[group], margins_px[group])
        is_promising = fit.misfit() < most_misfits[0]
        if not is_promising.all():  # the outline alone rules most patches out
            own = group[is_promising]
            if not len(own):
                continue
            fit = _DiskFit(block, patches.part(own), blurs[own], strides[own], margins_px[own])
        fit.plain_steps = plain_steps
        gauss_newton(fit, fit.every, 0.0, plain_steps + 1)
        is_disk = fit.is_disk(patches.part(own), most_misfits[1])
        found.append(fit.patches().part(is_disk))
        blurs_found.append(fit.blur[is_disk])
    return concatenate(*found), np.concatenate(blurs_found)


def place_disks(block: ScanBlock, patches: Patches, margins_px: Array) -> list[MarkFit]:
    """Fit many disks at once to convergence, each with margins_px (n,) of background."""
    strides, blurs = np.ones(len(patches.radii), np.intp), np.full(len(patches.radii), _FIRST_BLUR_PX)
    placed: dict[int, MarkFit] = {}
    for group in _groups(patches, strides, margins_px):
        own = patches.part(group)
        fit = _DiskFit(block, own, blurs[group], strides[group], margins_px[group], is_censored=True)
        gauss_newton(fit, fit.every, _SETTLED_PX, _MOST_STEPS)
        fit.refuse(np.flatnonzero(~fit.is_disk(own, 1.0)), _NO_DISK)
        placed |= zip(group.tolist(), fit.placed(), strict=True)
    return [placed[number] for number in range(len(blurs))]


def _groups(patches: Patches, strides: Indices, margins_px: Array) -> Iterator[Indices]:
    """Indices of patches with windows of similar size, in groups of limited pixel count."""
    sides = 2 * _half_sides(patches, strides, margins_px) + 1
    rest = np.argsort(-sides, kind="stable")
    while len(rest):
        own = rest[: max(_GROUP_PIXELS // int(sides[rest[0]]) ** 2, 1)]
        own = own[2 * sides[own] >= sides[rest[0]]]
        yield own
        rest = rest[len(own) :]


def _half_sides(patches: Patches, strides: Indices, margins_px: Array) -> Indices:
    """(n,) sampled pixels on either side of the window's centre."""
    longest = np.linalg.norm(patches.shapes, 2, axis=(1, 2))
    return np.asarray(np.ceil((longest + margins_px + 0.5) / strides), np.intp)


class _DiskFit(FitModel):
    """State of the fit of n disks. centers (n, 2) relative to the window centres, px; shapes (n, 2, 2); blur (n,), px;
    greys (n, 4): gain, offset, slopes. Windows of side * side pixels: col, row (n, pixels) relative to their centres,
    grey (n, pixels), used (n, pixels): inside the ellipse and its margin, informative (n, pixels): and not clipped;
    scale (n,): robust one of the residuals; plain_steps: left before robust ones. is_censored: whether grey values at
    the ends of the range may stand for any beyond."""

    damping = _DAMPING

    def __init__(
        self,
        block: ScanBlock,
        patches: Patches,
        blurs: Array,
        strides: Indices,
        margins_px: Array,
        is_censored: bool = False,
    ) -> None:
        super().__init__(len(blurs))
        half, stride = int(_half_sides(patches, strides, margins_px).max()), strides[:, None]
        middles = np.rint(patches.centers).astype(np.intp)
        corners, self.side = middles - half * stride, 2 * half + 1
        along = stride * np.arange(self.side)
        col, row = np.tile(along, self.side), np.repeat(along, self.side, axis=1)
        inside = block.holds(corners[..., None] + along[:, None])
        self.grey = block.grey_values(corners, col, row)
        self.ends = block.clipped_ends(corners, col, row) if is_censored else np.zeros((len(blurs), 1), np.int8)
        self.col, self.row = (np.asarray(one - half * stride, np.float32) for one in (col, row))
        self.middles, self.radius = middles, patches.radii
        self.centers, self.shapes, self.blur = patches.centers - middles, patches.shapes.copy(), blurs.copy()
        edges = _Edges(self, self.every)
        near = edges.distance >= -margins_px[:, None]
        self.used = near & (inside[:, 0, None] & inside[:, 1, :, None]).reshape(near.shape)
        self.design = edges.design(self)
        greys = gauss_newton_step(self.design[:, 6:], self.grey, self.used.astype(np.float32), _DAMPING)
        self.greys = np.nan_to_num(greys)  # without pixels
        self.residuals, self.informative = np.empty_like(self.grey), np.empty_like(self.used)
        self.scale, self.plain_steps = np.empty(len(blurs)), _PLAIN_STEPS
        self.linearise(self.every, self.design)

    def linearise(self, fits: Indices, design: Single) -> None:
        """Set the design matrix of m fits from that by unit gain, their residuals, and the robust scale of these."""
        greys, used = self.greys[fits].astype(np.float32), self.used[fits]
        residuals = self.grey[fits] - (greys[:, None] @ design[:, 6:])[:, 0]
        design[:, :6] *= greys[:, :1, None]
        # A clipped grey value says nothing where the model lies beyond the end of the range as well.
        informative = used & (self.ends[fits] * residuals >= 0)
        middle, count = informative.shape[1] // 2, informative.sum(axis=1)
        # Other pixels are put below and above all of these in equal numbers, so that the median stays the median.
        beyond = np.where(np.cumsum(~informative, axis=1) % 2, np.float32(np.inf), np.float32(-1))
        off = np.where(informative, np.abs(residuals), beyond)
        off.partition(middle, axis=1)
        unbiased = np.sqrt(count / np.maximum(count - _UNKNOWNS, 1))
        self.scale[fits] = SIGMA_OF_DEVIATION * np.where(count > 0, off[:, middle], np.inf) * unbiased
        self.design[fits], self.residuals[fits], self.informative[fits] = design, residuals, informative

    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply steps, shortened to the range of the linearisation. Returns (m,) movements of the centres in px."""
        form = steps[:, :5] / np.maximum(np.abs(steps[:, :5]).max(axis=1, keepdims=True) / _LONGEST_STEP, 1.0)
        moves = (self.shapes[fits] @ form[:, :2, None])[..., 0]
        size, stretch, shear = form[:, 2:].T
        forms = np.array([[1 + size + stretch, shear], [shear, 1 + size - stretch]]).transpose(2, 0, 1)
        self.centers[fits] += moves
        self.shapes[fits] = self.shapes[fits] @ forms
        blur = self.blur[fits]
        self.blur[fits] = np.clip(blur + np.clip(steps[:, 5], -0.5 * blur, blur), *_BLUR_PX)
        self.greys[fits] += steps[:, 6:]
        self.linearise(fits, _Edges(self, fits).design(self))
        self.plain_steps -= 1
        return np.where(self.plain_steps < 0, np.linalg.norm(moves, axis=1), np.inf)

    def pixel_weights(self, fits: Indices) -> Single:
        """(m, pixels), Tukey's against dust and neighbours after plain steps."""
        informative: Mask = np.asarray(self.informative[fits])
        if self.plain_steps > 0:
            return informative.astype(np.float32)
        scale = np.maximum(self.scale[fits], _SCALE_FLOOR * np.abs(self.greys[fits, 0]) + 1e-6)
        return np.asarray(informative * tukey_weights(self.residuals[fits] / scale[:, None].astype(np.float32), 1.0))

    def placed(self) -> Iterator[MarkFit]:
        """The disks in scan pixels, with covariances."""
        weights, found = self.pixel_weights(self.every), self.patches()
        counted = weights > _UNDAMAGED
        influence = self.shapes.astype(np.float32) @ place_influences(self.design, weights)
        size = len(weights), -1, self.side, self.side
        covariances, variances = influence_covariances(
            influence.reshape(size), self.residuals.reshape(size)[:, 0], counted.reshape(size)[:, 0], _UNKNOWNS
        )
        blurs_px = np.sqrt(np.maximum(self.blur**2 - PIXEL_VARIANCE_PX2, 0.0))
        damaged = 1 - weights.sum(axis=1) / np.maximum(self.informative.sum(axis=1), 1)
        for number, (center_px, shape) in enumerate(zip(found.centers, found.shapes, strict=True)):
            yield MarkFit(
                converged=not self.reasons[number],
                reason=self.reasons[number],
                center_px=center_px,
                place_covariance=Covariance.from_noise(covariances[number]),
                pixel_from_mark=np.column_stack([shape, center_px]),
                contrast_dn=float(found.contrasts[number]),
                noise_dn=float(np.sqrt(variances[number])),
                blur_px=float(blurs_px[number]),
                damaged_fraction=float(damaged[number]),
            )

    def misfit(self) -> Array:
        """(n,) residual scale over its limit, which is lower where neighbouring residuals are correlated."""
        left = (self.residuals * self.informative).reshape(-1, self.side, self.side)
        neighbours = (left[:, :, 1:] * left[:, :, :-1]).sum(axis=(1, 2))
        neighbours += (left[:, 1:] * left[:, :-1]).sum(axis=(1, 2))
        correlation = neighbours / np.maximum(2 * (left * left).sum(axis=(1, 2)), 1e-6)
        allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
        return np.asarray(self.scale / np.maximum(allowed * np.abs(self.greys[:, 0]), 1e-6), float)

    def patches(self) -> Patches:
        """Fitted disks as patches, in pixels of the scan."""
        return Patches(self.middles + self.centers, self.shapes, self.greys[:, 0])

    def is_disk(self, starts: Patches, most_misfit: float) -> Mask:
        """(n,) whether the misfit is small and the disk is still the object that the fit started from."""
        found = self.patches()
        moved = np.hypot(*(found.centers - starts.centers).T) / starts.radii
        grown = np.abs(np.log(np.maximum(found.radii, 1e-6) / starts.radii))
        same = found.contrasts * starts.contrasts > 0
        return np.asarray((self.misfit() < most_misfit) & (moved < _FARTHEST) & (grown < _MOST_GROWN) & same)


class _Edges:
    """Position of pixels (n, pixels) relative to their ellipse. radius: normalised, 1 on the ellipse; col, row:
    direction in the unit disk; px: length of a radius across the edge; distance: to the edge, px, positive inside."""

    def __init__(self, fit: _DiskFit, fits: Indices) -> None:
        inverse, self.fits = np.linalg.inv(fit.shapes[fits]).astype(np.float32), fits
        center = fit.centers[fits].astype(np.float32)
        unit = inverse @ np.stack([fit.col[fits] - center[:, :1], fit.row[fits] - center[:, 1:]], axis=1)
        self.radius: Single = np.maximum(np.sqrt(unit[:, 0] ** 2 + unit[:, 1] ** 2), np.float32(1e-6))
        direction = unit / self.radius[:, None]
        self.col, self.row = direction[:, 0], direction[:, 1]
        across = inverse.swapaxes(1, 2) @ direction
        self.px: Single = 1 / np.maximum(np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2), np.float32(1e-6))
        self.distance = (1 - self.radius) * self.px

    def design(self, fit: _DiskFit) -> Single:
        """(n, unknowns, pixels) derivatives with respect to centre, size, stretch and shear (in units of the ellipse)
        and blur (px), all divided by the gain; then with respect to gain, offset and slopes."""
        blur, size = (one[self.fits, None].astype(np.float32) for one in (fit.blur, fit.radius))
        place = self.distance / blur
        density = np.exp(-place * place / 2) / (np.float32(np.sqrt(2 * np.pi)) * blur)
        moved = density * self.px
        grown = moved * self.radius
        ellipse = [moved * self.col, moved * self.row, grown, grown * (self.col**2 - self.row**2)]
        ellipse.append(2 * grown * self.col * self.row)
        greys = [-density * place, ndtr(place), np.ones_like(place), fit.col[self.fits] / size]
        greys.append(fit.row[self.fits] / size)
        return np.stack([*ellipse, *greys], axis=1).astype(np.float32, copy=False)
