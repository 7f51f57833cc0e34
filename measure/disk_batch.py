"""Many disks fitted at once, to tell them from patches of a landscape and to say nearly where they are. Disks of about
one size are adjusted together, pixel by pixel, in the same few steps: first with some of their pixels, which most
patches do not outlast, then with all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from measure.block import Block
from measure.disk_model import GREYS, UNKNOWNS, DiskModel, DiskStates, each, radius_px, solved
from measure.disk_patches import Candidate, strength
from measure.robust import tukey_weights
from measure.scan import Scan

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast: texture and stains are no disks
SMOOTH = 0.5  # correlation of neighbouring residuals, from which on they are no noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # of its radius: the ground is not plain for long, where a target's pad ends, say
SIZE_STEP, COARSE_SIZE_STEP = 1.3, 2.0  # largest over smallest that are fitted together, in all pixels and in a few
TOGETHER_PIXELS = 1 << 16  # of all windows: with their derivatives they take some 10 MiB
COARSE_PX = 3.0  # radius in pixels that are enough for a first look and its steps
EDGE_SAMPLES = 8  # likewise, of a disk's edge, two blurs wide
COARSE_STEPS = 2  # before one that is robust
SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
FIRST_BLUR_PX = 1.0
HOPELESS = 1.5  # times the misfit that is allowed, before all steps: an outline is right to a few percent


@dataclass(frozen=True, eq=False)
class _Disk:
    patch: Candidate
    blur_px: float


def disks_among(block: Block, patches: Sequence[Candidate]) -> list[Candidate]:
    """Those patches that a disk explains, the strongest first, as fitted: a place within a tenth of a pixel or so."""
    starts = [_Disk(patch, FIRST_BLUR_PX) for patch in patches]
    coarse = _alike(starts, _every(starts), COARSE_SIZE_STEP)
    hopeful = [disk for group, every in coarse for disk in _hopeful(block, group, every)]
    fine = _alike(hopeful, np.ones(len(hopeful), dtype=np.intp), SIZE_STEP)
    fitted = [disk.patch for group, _ in fine for disk in _fitted(block, group)]
    return sorted(fitted, key=strength)


def _every(disks: Sequence[_Disk]) -> NDArray[np.intp]:
    """(n,) how many pixels apart those are that tell enough of a disk: of its area, and of its edge."""
    radius = radius_px(_shapes(disks))
    of_edge = np.sqrt(4 * np.pi * FIRST_BLUR_PX * radius / EDGE_SAMPLES)
    return np.maximum(np.minimum(radius / COARSE_PX, of_edge), 1.0).astype(np.intp)


def _alike(disks: Sequence[_Disk], every: NDArray[np.intp], size_step: float) -> Iterator[tuple[list[_Disk], int]]:
    """Disks that differ in size by so much at most and are looked at in every so many columns and rows (n,), and how
    many these are; so many disks that their windows are not too large. Each is sampled by its own size, whatever it is
    together with."""
    reach = _reach_px(_shapes(disks))
    rest = np.lexsort((reach, every)).tolist()
    while rest:
        largest, step = reach[rest[0]] * size_step, int(every[rest[0]])
        count = max(int(TOGETHER_PIXELS * step**2 / (2 * largest + 1) ** 2), 1)
        chosen = [index for index in rest[:count] if reach[index] <= largest and every[index] == step]
        yield [disks[index] for index in chosen], step
        rest = rest[len(chosen) :]


def _shapes(disks: Sequence[_Disk]) -> Array:
    return np.array([disk.patch.pixel_from_disk for disk in disks]).reshape(-1, 2, 2)


def _reach_px(shapes: Array) -> Array:
    """(n,) how far from the middle grey values are used: to the margin about the longer half axis."""
    squares, area = (shapes**2).sum(axis=(1, 2)), radius_px(shapes) ** 2
    longer = np.sqrt((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0.0))) / 2)
    return np.asarray(longer + _margin_px(shapes) + 1.0)


def _margin_px(shapes: Array) -> Array:
    return np.maximum(MARGIN * radius_px(shapes), LEAST_MARGIN_PX)


def _hopeful(block: Block, disks: list[_Disk], every: int) -> list[_Disk]:
    """Those of about one size that look like disks in every so many pixels, as their outlines have them and still after
    some steps."""
    group = _Group.of(block, disks, every)
    group = group.part(group.misfit() < HOPELESS)
    if not len(group.disks):
        return []
    for step in range(COARSE_STEPS + 1):
        group = group.stepped(is_robust=step == COARSE_STEPS)
    return group.part((group.misfit() < HOPELESS) & group.is_sane()).disks_now()


def _fitted(block: Block, disks: list[_Disk]) -> list[_Disk]:
    """Those of about one size that are disks, after one step more with all pixels."""
    group = _Group.of(block, disks, 1).stepped(is_robust=True)
    return group.part((group.misfit() < 1.0) & group.is_sane()).disks_now()


@dataclass(frozen=True, eq=False)
class _Group:
    """n disks of about one size: their windows' first pixels' places corners (n, 2), grey values (n, rows, cols), which
    of these are used, and what the disks are by now."""

    disks: list[_Disk]
    corners: NDArray[np.int64]
    grey: Image
    used: Mask
    model: DiskModel

    @classmethod
    def of(cls, block: Block, disks: list[_Disk], every: int) -> "_Group":
        """With every so many columns and rows of their windows."""
        shapes = _shapes(disks)
        half = int(np.ceil(_reach_px(shapes).max()))
        side = 2 * half + 1
        places = np.array([disk.patch.center_px for disk in disks])
        inside = np.array(block.size_px) - side
        corners = np.clip(np.rint(places).astype(np.int64) - half - block.place_px, 0, inside) + block.place_px
        grey = block.windows(corners, side, every)
        blur = np.array([disk.blur_px for disk in disks])
        model = DiskModel(DiskStates(places - corners, shapes, blur, np.zeros((len(disks), GREYS))), side, every)
        used = model.distance > -_margin_px(shapes)[:, None, None]
        used &= _in_scan(block.scan, corners[..., None] + np.arange(0, side, every))
        greys = solved(model.grey_design(), grey, used.astype(np.float32))
        return cls(disks, corners, grey, used, model.with_greys(greys))

    @property
    def state(self) -> DiskStates:
        return self.model.state

    @cached_property
    def residuals(self) -> Image:
        return self.grey - self.model.grey()

    @cached_property
    def scale(self) -> Array:
        """(n,) the standard deviation that most residuals of each window have."""
        count = len(self.used)
        rising = np.sort(np.where(self.used, np.abs(self.residuals), np.float32(np.inf)).reshape(count, -1), axis=1)
        pixels = self.used.reshape(count, -1).sum(axis=1)
        unbiased = np.sqrt(pixels / np.maximum(pixels - UNKNOWNS, 1))
        return np.asarray(1.4826 * rising[np.arange(count), pixels // 2] * unbiased, float)

    def part(self, chosen: Mask) -> "_Group":
        disks = [disk for disk, is_chosen in zip(self.disks, chosen.tolist(), strict=True) if is_chosen]
        model = self.model.at(self.state.part(chosen))
        return _Group(disks, self.corners[chosen], self.grey[chosen], self.used[chosen], model)

    def stepped(self, is_robust: bool) -> "_Group":
        """After one step of the adjustment, a robust one being little moved by dust and neighbours."""
        weights = self.used.astype(np.float32)
        if is_robust:
            scale = np.maximum(self.scale, SCALE_FLOOR * np.abs(self.state.greys[:, 0]) + 1e-6)
            weights *= tukey_weights(self.residuals / each(scale), 1.0)
        step = solved(self.model.design(), self.residuals, weights)
        return replace(self, model=self.model.at(self.state.stepped(step)))

    def misfit(self) -> Array:
        """(n,) what a disk leaves unexplained, over what is allowed; a picture of something else is alike in
        neighbouring pixels."""
        left = self.residuals * self.used
        beside = (left[:, :, 1:] * left[:, :, :-1]).sum(axis=(1, 2))
        below = (left[:, 1:] * left[:, :-1]).sum(axis=(1, 2))
        correlation = (beside + below) / np.maximum(2 * (left**2).sum(axis=(1, 2)), 1e-6)
        allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
        return np.asarray(self.scale / np.maximum(allowed * np.abs(self.state.greys[:, 0]), 1e-6), float)

    def is_sane(self) -> Mask:
        """(n,) whether the disks are still about what they started from."""
        starts = _shapes(self.disks)
        places = np.array([disk.patch.center_px for disk in self.disks]) - self.corners
        moved = np.hypot(*(self.state.centers - places).T) / radius_px(starts)
        grown = self.state.radius / radius_px(starts)
        same = np.sign(self.state.greys[:, 0]) == np.sign([disk.patch.contrast_dn for disk in self.disks])
        return np.asarray(np.isfinite(moved) & (moved < 0.5) & (np.abs(np.log(grown)) < np.log(1.5)) & same)

    def disks_now(self) -> list[_Disk]:
        """As adjusted."""
        state = self.state
        patches = map(Candidate, state.centers + self.corners, state.shapes, state.greys[:, 0].tolist())
        return [_Disk(patch, blur) for patch, blur in zip(patches, state.blur.tolist(), strict=True)]


def _in_scan(scan: Scan, along: NDArray[np.int64]) -> Mask:
    """(n, rows, cols): which pixels are the scan's; along (n, 2, side): their columns, and their rows."""
    inside = (along >= 0) & (along < np.array([[scan.width_px], [scan.height_px]]))
    return np.asarray(inside[:, 1, :, None] & inside[:, 0, None, :])
