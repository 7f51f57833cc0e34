"""Patches of a picture tested for disks, many at once, by some steps of a fit of blurred ellipses in closed form.

The picture of a disk is `gain * Phi(distance / blur) + offset + slopes`. A patch's outline is right to a few per cent;
from there four steps place a disk to a tenth of a pixel, and what they leave tells disks from landscape. The edge is
taken for straight where it is blurred, which changes a disk's size by a few hundredths of a pixel and its place by
nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from measure.noise.robust_estimation import SIGMA_OF_DEVIATION, gauss_newton_step, tukey_weights
from measure.targets.block_search import Block, Patches, concatenate

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_GROUP_PIXELS = 1 << 16  # of the windows of disks that are fitted together: with their derivatives they take 10 MiB
_FIRST_BLUR_PX, _BLUR_PX = 1.0, (0.5, 8.0)  # standard deviations, pixels' own width included
_FIRST_STEPS_ROBUST = False, False, True  # in some of the pixels; one robust step in all of them comes after
_HOPELESS = 1.5  # times the misfit that is allowed: an outline is right to a few percent
_LONGEST_STEP = 0.3  # of the radius: beyond it the picture is not linear
_DAMPING = 1e-4  # of the step: a disk that hardly shows has unknowns that depend on one another
_UNKNOWNS = 10  # place (2), size, stretch, shear, blur, gain, offset, slopes (2)
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast: texture and stains are no disks
SMOOTH = 0.5  # correlation of neighbouring residuals, from which on they are no noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # of its radius: the ground is not plain for long, where a target's pad ends, say
_COARSE_PX = 3.0  # radius in pixels that are enough
_EDGE_SAMPLES = 16  # likewise, of a disk's edge, four pixels wide
_FARTHEST, _MOST_GROWN = 0.5, float(np.log(1.5))  # radii from the outline's middle, log of its size: beyond is another


def disks_among(block: Block, patches: Patches) -> Patches:
    """Those patches that a disk explains, the strongest first, as fitted: a place within a tenth of a pixel or so."""
    first = np.full(len(patches.radii), _FIRST_BLUR_PX)
    promising, blurs = _fitted_disks(
        block, patches, first, _strides(patches), _FIRST_STEPS_ROBUST, (_HOPELESS, _HOPELESS)
    )
    whole = np.ones(len(blurs), np.intp)
    return _fitted_disks(block, promising, blurs, whole, (True,), (np.inf, 1.0))[0].strongest_first()


def _fitted_disks(
    block: Block,
    patches: Patches,
    blurs: Array,
    strides: Indices,
    steps_robust: Sequence[bool],
    most_misfits: tuple[float, float],
) -> tuple[Patches, Array]:
    """The disks among patches, and their blurs (n,), by some steps of a fit in pixels strides (n,) apart.
    most_misfits: before and after these."""
    found, blurs_found = [Patches.collect(())], [np.zeros(0)]
    for group in _groups(patches, strides):
        own, fit = group, _Fit(block, patches.part(group), blurs[group], strides[group])
        is_promising = fit.misfit() < most_misfits[0]
        if not is_promising.all():  # most of what is no disk is so by its outline already
            own = group[is_promising]
            if not len(own):
                continue
            fit = _Fit(block, patches.part(own), blurs[own], strides[own])
        for is_robust in steps_robust:
            fit.step(is_robust)
        is_disk = fit.is_disk(patches.part(own), most_misfits[1])
        found.append(fit.patches().part(is_disk))
        blurs_found.append(fit.blur[is_disk])
    return concatenate(*found), np.concatenate(blurs_found)


def _groups(patches: Patches, strides: Indices) -> Iterator[Indices]:
    """Numbers of those with windows of about one size, so few that these are not too many pixels."""
    sides = 2 * _half_sides(patches, strides) + 1
    rest = np.argsort(-sides, kind="stable")
    while len(rest):
        own = rest[: max(_GROUP_PIXELS // int(sides[rest[0]]) ** 2, 1)]
        own = own[2 * sides[own] >= sides[rest[0]]]
        yield own
        rest = rest[len(own) :]


def _strides(patches: Patches) -> Indices:
    """(n,) columns and rows from one pixel that is used to the next: large disks show enough in some of theirs."""
    radius = patches.radii
    of_edge = np.sqrt(8 * np.pi * radius / _EDGE_SAMPLES)
    return np.maximum(np.minimum(radius / _COARSE_PX, of_edge), 1.0).astype(np.intp)


def _margins_px(patches: Patches) -> Array:
    return np.maximum(MARGIN * patches.radii, LEAST_MARGIN_PX)


def _half_sides(patches: Patches, strides: Indices) -> Indices:
    """(n,) pixels that are used on either side of a window's middle."""
    longest = np.linalg.norm(patches.shapes, 2, axis=(1, 2))
    return np.asarray(np.ceil((longest + _margins_px(patches) + 0.5) / strides), np.intp)


class _Fit:
    """n disks about patches: centers (n, 2) from the middles of their windows, shapes (n, 2, 2), blur (n,), px; greys
    (n, 4): gain, offset, slopes. Windows have side * side pixels: col, row (n, pixels) from their middles, grey (n,
    pixels), and used (n, pixels), those in the ellipse and its margin."""

    def __init__(self, block: Block, patches: Patches, blurs: Array, strides: Indices) -> None:
        half, stride = int(_half_sides(patches, strides).max()), strides[:, None]
        middles = np.rint(patches.centers).astype(np.intp)
        corners, self.side = middles - half * stride, 2 * half + 1
        along = stride * np.arange(self.side)
        col, row = np.tile(along, self.side), np.repeat(along, self.side, axis=1)
        inside = block.holds(corners[..., None] + along[:, None])
        self.grey = block.grey_values(corners, col, row)
        self.col, self.row = (np.asarray(one - half * stride, np.float32) for one in (col, row))
        self.middles, self.radius = middles, patches.radii
        self.centers, self.shapes = patches.centers - middles, patches.shapes
        self.blur = blurs
        near = _Edges.from_fit(self).distance >= -_margins_px(patches)[:, None]
        self.used = near & (inside[:, 0, None] & inside[:, 1, :, None]).reshape(near.shape)
        design = _Edges.from_fit(self).design(self)
        self.greys = gauss_newton_step(design[:, 6:], self.grey, self.used.astype(np.float32), _DAMPING)
        self.linearise(design)

    def linearise(self, design: Image) -> None:
        """Design (n, unknowns, pixels) at the present state, and residuals (n, pixels) with their scale (n,)."""
        self.design = design
        self.residuals = self.grey - (self.greys[:, None].astype(np.float32) @ self.design[:, 6:])[:, 0]
        self.design[:, :6] *= self.greys[:, :1, None].astype(np.float32)
        self.scale = _masked_scales(self.residuals, self.used)

    def step(self, is_robust: bool) -> None:
        """A step of the adjustment, a robust one being little moved by dust and neighbours."""
        weights = self.used.astype(np.float32)
        if is_robust:
            scale = np.maximum(self.scale, _SCALE_FLOOR * np.abs(self.greys[:, 0]) + 1e-6)
            weights *= tukey_weights(self.residuals / scale[:, None].astype(np.float32), 1.0)
        change = gauss_newton_step(self.design, self.residuals, weights, _DAMPING)
        form = change[:, :5] / np.maximum(np.abs(change[:, :5]).max(axis=1, keepdims=True) / _LONGEST_STEP, 1.0)
        self.centers = self.centers + (self.shapes @ form[:, :2, None])[..., 0]
        size, stretch, shear = form[:, 2:].T
        forms = np.array([[1 + size + stretch, shear], [shear, 1 + size - stretch]]).transpose(2, 0, 1)
        self.shapes = self.shapes @ forms
        self.blur = np.clip(self.blur + np.clip(change[:, 5], -0.5 * self.blur, self.blur), *_BLUR_PX)
        self.greys = self.greys + change[:, 6:]
        self.linearise(_Edges.from_fit(self).design(self))

    def misfit(self) -> Array:
        """(n,) what disks leave unexplained, over what is allowed; a picture of something else leaves what is alike in
        neighbouring pixels."""
        left = (self.residuals * self.used).reshape(-1, self.side, self.side)
        neighbours = (left[:, :, 1:] * left[:, :, :-1]).sum(axis=(1, 2))
        neighbours += (left[:, 1:] * left[:, :-1]).sum(axis=(1, 2))
        correlation = neighbours / np.maximum(2 * (left * left).sum(axis=(1, 2)), 1e-6)
        allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
        return np.asarray(self.scale / np.maximum(allowed * np.abs(self.greys[:, 0]), 1e-6), float)

    def patches(self) -> Patches:
        """In the scan."""
        return Patches(self.middles + self.centers, self.shapes, self.greys[:, 0])

    def is_disk(self, starts: Patches, most_misfit: float) -> Mask:
        """(n,) whether a disk explains them so well, and is still about what it started from."""
        found = self.patches()
        moved = np.hypot(*(found.centers - starts.centers).T) / starts.radii
        grown = np.abs(np.log(np.maximum(found.radii, 1e-6) / starts.radii))
        same = found.contrasts * starts.contrasts > 0
        return np.asarray((self.misfit() < most_misfit) & (moved < _FARTHEST) & (grown < _MOST_GROWN) & same)


@dataclass(frozen=True, eq=False)
class _Edges:
    """Of pixels (n, pixels) about ellipses: radius: from the centre, 1 on the ellipse; col, row: its direction in the
    unit disk; px: of a radius there, across the edge; distance: from the edge, px, positive inside."""

    radius: Image
    col: Image
    row: Image
    px: Image
    distance: Image

    @classmethod
    def from_fit(cls, fit: _Fit) -> "_Edges":
        inverse = np.linalg.inv(fit.shapes).astype(np.float32)
        center = fit.centers.astype(np.float32)
        unit = inverse @ np.stack([fit.col - center[:, :1], fit.row - center[:, 1:]], axis=1)
        radius = np.maximum(np.sqrt(unit[:, 0] ** 2 + unit[:, 1] ** 2), np.float32(1e-6))
        direction = unit / radius[:, None]
        across = inverse.swapaxes(1, 2) @ direction
        px = 1 / np.maximum(np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2), np.float32(1e-6))
        return cls(radius, direction[:, 0], direction[:, 1], px, (1 - radius) * px)

    def design(self, fit: _Fit) -> Image:
        """(n, unknowns, pixels) derivatives by place, size, stretch and shear in units of the ellipse and by the blur,
        px, all over the gain; by gain, offset and slopes."""
        blur, size = (one[:, None].astype(np.float32) for one in (fit.blur, fit.radius))
        place = self.distance / blur
        density = np.exp(-place * place / 2) / (np.float32(np.sqrt(2 * np.pi)) * blur)
        moved = density * self.px
        grown = moved * self.radius
        ellipse = [moved * self.col, moved * self.row, grown, grown * (self.col**2 - self.row**2)]
        ellipse.append(2 * grown * self.col * self.row)
        greys = [-density * place, ndtr(place), np.ones_like(place), fit.col / size, fit.row / size]
        return np.stack([*ellipse, *greys], axis=1).astype(np.float32, copy=False)


def _masked_scales(residuals: Image, used: Mask) -> Array:
    """(n,) the standard deviation that most of the used residuals have."""
    middle, count = used.shape[1] // 2, used.sum(axis=1)
    # Those that are not used lie half below all others and half above, so that the middle one stays the middle one.
    beyond = np.where(np.cumsum(~used, axis=1) % 2, np.float32(np.inf), np.float32(-1))
    off = np.where(used, np.abs(residuals), beyond)
    off.partition(middle, axis=1)
    unbiased = np.sqrt(count / np.maximum(count - _UNKNOWNS, 1))
    return np.asarray(SIGMA_OF_DEVIATION * np.where(count > 0, off[:, middle], np.inf) * unbiased, float)
