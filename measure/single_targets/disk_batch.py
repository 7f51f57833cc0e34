"""Many disks fitted at once, to tell them from patches of a landscape and to say nearly where they are. Disks of about
as many pixels are adjusted together, in the same few steps: first with some of their pixels, which most patches do not
outlast, then with all."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import SIGMA_OF_DEVIATION, gauss_newton_step, tukey_weights
from measure.single_targets.block import Block, joined
from measure.single_targets.disk_model import DAMPING, GREYS, UNKNOWNS, DiskModel, DiskStates, each
from measure.single_targets.disk_patches import Patches
from measure.single_targets.disk_pixels import Areas, DiskPixels

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast: texture and stains are no disks
SMOOTH = 0.5  # correlation of neighbouring residuals, from which on they are no noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # of its radius: the ground is not plain for long, where a target's pad ends, say
_COARSE_PX = 3.0  # radius in pixels that are enough for a first look and its steps
_EDGE_SAMPLES = 8  # likewise, of a disk's edge, two blurs wide
_COARSE_STEPS = 2  # before one that is robust
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
_FIRST_BLUR_PX = 1.0
_HOPELESS = 1.5  # times the misfit that is allowed, before all steps: an outline is right to a few percent


def disks_among(block: Block, patches: Patches) -> Patches:
    """Those patches that a disk explains, the strongest first, as fitted: a place within a tenth of a pixel or so."""
    starts = _states(patches)
    none = starts.part(np.zeros(0, np.intp))
    promising = joined(none, *map(_promising, _groups(block, starts, _every(starts.radius))))
    fitted = joined(none, *map(_fitted, _groups(block, promising, np.ones(len(promising.blur), np.intp))))
    return Patches(fitted.centers, fitted.shapes, fitted.greys[:, 0]).by_strength()


def _states(patches: Patches) -> DiskStates:
    greys = np.zeros((len(patches.contrasts), GREYS))
    greys[:, 0] = patches.contrasts
    return DiskStates(patches.centers, patches.shapes, np.full(len(greys), _FIRST_BLUR_PX), greys)


def _every(radius: Array) -> NDArray[np.intp]:
    """(n,) how many pixels apart those are that tell enough of disks (n,): of their area, and of their edge."""
    of_edge = np.sqrt(4 * np.pi * _FIRST_BLUR_PX * radius / _EDGE_SAMPLES)
    return np.maximum(np.minimum(radius / _COARSE_PX, of_edge), 1.0).astype(np.intp)


def _groups(block: Block, disks: DiskStates, every: NDArray[np.intp]) -> Iterator["_Group"]:
    """The disks with every (n,) so many columns and rows: each is sampled by its own size, whatever it is together
    with."""
    margin = np.maximum(MARGIN * disks.radius, LEAST_MARGIN_PX)
    areas = Areas.about(disks.centers, disks.shapes, margin, every)
    for chosen in areas.alike():
        yield _Group.of(block, disks.part(chosen), areas.part(chosen).pixels(block))


def _promising(group: "_Group") -> DiskStates:
    """Those that look like disks, as their outlines have them and still after some steps."""
    group = group.part(group.misfit() < _HOPELESS)
    if not len(group.grey):
        return group.disks
    for step in range(_COARSE_STEPS + 1):
        group = group.stepped(is_robust=step == _COARSE_STEPS)
    return group.part((group.misfit() < _HOPELESS) & group.is_sane()).disks_now()


def _fitted(group: "_Group") -> DiskStates:
    """Those that are disks, after one step more."""
    group = group.stepped(is_robust=True)
    return group.part((group.misfit() < 1.0) & group.is_sane()).disks_now()


@dataclass(frozen=True, eq=False)
class _Group:
    """n disks, by their places in the scan, as they were at first, their pixels and the grey values of these
    (n, pixels), and what the disks are by now."""

    disks: DiskStates
    pixels: DiskPixels
    grey: Image
    model: DiskModel

    @classmethod
    def of(cls, block: Block, disks: DiskStates, pixels: DiskPixels) -> "_Group":
        grey, model = pixels.grey(block), DiskModel(disks.moved(-pixels.corners), *pixels.places)
        greys = gauss_newton_step(model.grey_design(), grey, pixels.used.astype(np.float32), DAMPING)
        return cls(disks, pixels, grey, model.with_greys(greys))

    @property
    def state(self) -> DiskStates:
        return self.model.state

    @cached_property
    def residuals(self) -> Image:
        return self.grey - self.model.grey()

    @cached_property
    def scale(self) -> Array:
        """(n,) the standard deviation that most residuals of each disk have."""
        used = self.pixels.used
        middle, count = used.shape[1] // 2, used.sum(axis=1)
        beyond = np.where(np.arange(used.shape[1]) % 2, np.float32(np.inf), np.float32(-1))  # as many on either side
        off = np.where(used, np.abs(self.residuals), beyond)
        off.partition(middle, axis=1)
        unbiased = np.sqrt(count / np.maximum(count - UNKNOWNS, 1))
        return np.asarray(SIGMA_OF_DEVIATION * off[:, middle] * unbiased, float)

    def part(self, chosen: Mask) -> "_Group":
        disks, pixels = self.disks.part(chosen), self.pixels.part(chosen)
        return _Group(disks, pixels, self.grey[chosen], DiskModel(self.state.part(chosen), *pixels.places))

    def stepped(self, is_robust: bool) -> "_Group":
        """After one step of the adjustment, a robust one being little moved by dust and neighbours."""
        weights = self.pixels.used.astype(np.float32)
        if is_robust:
            scale = np.maximum(self.scale, _SCALE_FLOOR * np.abs(self.state.greys[:, 0]) + 1e-6)
            weights *= tukey_weights(self.residuals / each(scale), 1.0)
        step = gauss_newton_step(self.model.design(), self.residuals, weights, DAMPING)
        return replace(self, model=self.model.at(self.state.stepped(step)))

    def misfit(self) -> Array:
        """(n,) what a disk leaves unexplained, over what is allowed; a picture of something else is alike in
        neighbouring pixels."""
        correlation = self.pixels.correlation(self.residuals)
        allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
        return np.asarray(self.scale / np.maximum(allowed * np.abs(self.state.greys[:, 0]), 1e-6), float)

    def is_sane(self) -> Mask:
        """(n,) whether the disks are still about what they started from."""
        starts, radius = self.disks, self.disks.radius
        moved = np.hypot(*(self.disks_now().centers - starts.centers).T) / radius
        grown = self.state.radius / radius
        same = np.sign(self.state.greys[:, 0]) == np.sign(starts.greys[:, 0])
        return np.asarray(np.isfinite(moved) & (moved < 0.5) & (np.abs(np.log(grown)) < np.log(1.5)) & same)

    def disks_now(self) -> DiskStates:
        """As adjusted, in the scan."""
        return self.state.moved(self.pixels.corners)
