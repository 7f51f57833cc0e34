"""Many disks fitted at once as blurred ellipses in closed form, to tell disks from landscape and to place them to a
tenth of a pixel."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import SIGMA_OF_DEVIATION, gauss_newton_step, tukey_weights
from measure.targets.block_search import Block, Patches, concatenate

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_TOGETHER_PIXELS = 1 << 16  # of all disks: with their derivatives they take some 10 MiB
_TOGETHER_CELLS = 1 << 18  # of the windows in which these lie
_LENGTHS_STEP = 2.0  # longest over shortest list among them
_BLUR_PX = (0.5, 8.0)  # pixels' own width included
_LONGEST_STEP = 0.3  # of the radius
DAMPING = 1e-4  # of a step: a disk that hardly shows has unknowns that are not told apart
GREYS, UNKNOWNS = 4, 10
_TAIL = 0.2316419, np.array([1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.319381530]) / np.sqrt(2 * np.pi)
_GENERATORS = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast: texture and stains are no disks
SMOOTH = 0.5  # correlation of neighbouring residuals, from which on they are no noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # of its radius: the ground is not plain for long, where a target's pad ends, say
_COARSE_PX = 3.0  # radius in pixels that are enough for a first look and its steps
_EDGE_SAMPLES = 8  # likewise, of a disk's edge, two blurs wide
_COARSE_STEPS = 2  # before one that is robust
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
_FIRST_BLUR_PX = 1.0
_HOPELESS = 1.5  # times the misfit that is allowed, before all steps: an outline is right to a few percent


@dataclass(frozen=True, eq=False)
class DiskPixels:
    """Of n disks, each in every (n,) so many columns and rows, in windows of side x side of these that begin at columns
    and rows of the scan corners (n, 2): numbers (n, pixels) of the pixels by rows; used (n, pixels): those that only
    fill a list up are not, and have the number of the last pixel. The last column and row of a window are never used.
    """

    corners: Indices
    every: Indices
    side: int
    numbers: Indices
    used: Mask

    def part(self, chosen: Mask) -> "DiskPixels":
        of_disks = self.corners[chosen], self.every[chosen]
        return DiskPixels(*of_disks, self.side, self.numbers[chosen], self.used[chosen])

    @cached_property
    def places(self) -> tuple[Indices, Indices]:
        """Columns and rows (n, pixels) from the corners on."""
        row = self.numbers // self.side
        return (self.numbers - row * self.side) * self.every[:, None], row * self.every[:, None]

    def grey(self, block: Block) -> Image:
        """(n, pixels)"""
        return block.grey_values(self.corners, *self.places)

    def correlation(self, residuals: Image) -> Array:
        """(n,) of residuals (n, pixels) with those beside and below."""
        left = residuals * self.used
        cells = self.side**2
        at = self.numbers + cells * np.arange(len(left))[:, None]
        window = np.zeros(len(left) * cells, np.float32)
        window[at] = left
        neighbours = window.take(at + 1, mode="clip") + window.take(at + self.side, mode="clip")
        return np.asarray((left * neighbours).sum(axis=1) / np.maximum(2 * (left * left).sum(axis=1), 1e-6), float)


@dataclass(frozen=True, eq=False)
class Areas:
    """Of n disks: places (n, 2) of their middles in the scan; ellipses, by their half axes, axes (n, 2), the longer
    one last, and directions (n, 2, 2); every (n,) so many columns and rows are used."""

    places: Array
    axes: Array
    directions: Array
    every: Indices

    @classmethod
    def surround(cls, places: Array, shapes: Array, margin_px: Array, every: Indices) -> "Areas":
        """Of ellipses of shapes (n, 2, 2) and the ground beside them, margin_px (n,) wide."""
        squares, directions = np.linalg.eigh(shapes @ shapes.swapaxes(1, 2))
        return cls(places, np.sqrt(np.maximum(squares, 0.0)) + margin_px[:, None], directions, every)

    def part(self, chosen: Indices) -> "Areas":
        return Areas(self.places[chosen], self.axes[chosen], self.directions[chosen], self.every[chosen])

    def alike(self) -> Iterator[Indices]:
        """Numbers of those that hold about as many pixels, and that are so few that these are not too many."""
        pixels = np.pi * self.axes.prod(axis=1) / self.every**2
        rest = np.argsort(-pixels, kind="stable")
        while len(rest):
            most = pixels[rest[0]]
            first = rest[: max(int(_TOGETHER_PIXELS / most), 1)]
            cells = np.arange(len(first)) * (2 * np.maximum.accumulate(self._half[first]) + 2) ** 2
            chosen = first[(cells < _TOGETHER_CELLS) & (pixels[first] * _LENGTHS_STEP >= most)]
            yield chosen
            rest = rest[len(chosen) :]

    @property
    def _half(self) -> Indices:
        """(n,) used columns on either side of the middle one."""
        return np.asarray(np.ceil((self.axes[:, 1] + 0.5) / self.every), np.intp)

    def pixels(self, block: Block) -> DiskPixels:
        """Those of them that are the scan's, and the block's."""
        half = int(self._half.max())
        corners = np.rint(self.places).astype(np.intp) - half * self.every[:, None]
        along = self.every[:, None] * np.arange(2 * half + 2)
        off = (along[:, None] - (self.places - corners)[..., None]).astype(np.float32)
        inside = block.holds(corners[..., None] + along[:, None])
        held = self._hold(off[:, 0, None], off[:, 1, :, None]) & (inside[:, 0, None] & inside[:, 1, :, None])
        held = held.reshape(len(held), -1)
        counts, cells = np.count_nonzero(held, axis=1), held.shape[1]
        used = np.arange(max(counts.max(), 1)) < counts[:, None]
        numbers = np.full(used.shape, cells - 1)
        numbers[used] = np.flatnonzero(held) - np.repeat(cells * np.arange(len(held)), counts)
        return DiskPixels(corners, self.every, along.shape[1], numbers, used)

    def _hold(self, col: Image, row: Image) -> Mask:
        """Which places, px from the middles, lie within the ellipses."""
        forms = (self.directions / self.axes[:, None] ** 2) @ self.directions.swapaxes(1, 2)
        by_col, by_both, by_row = (
            forms[:, i, j].astype(np.float32)[:, None, None] for i, j in ((0, 0), (0, 1), (1, 1))
        )
        return np.asarray((by_col * col + 2 * by_both * row) * col + by_row * row * row <= 1)


# Many disks as blurred edges round ellipses, `gain * Phi(distance / blur) + offset + slopes`, in closed form: the edge
# is taken for straight where it is blurred, which changes a disk's size by a few hundredths of a pixel and its place by
# nothing.


@dataclass(frozen=True, eq=False)
class DiskStates:
    """Of n disks: centers (n, 2) in their windows, shapes (n, 2, 2), blur (n,), all px; greys (n, 4): gain, offset,
    slopes."""

    centers: Array
    shapes: Array
    blur: Array
    greys: Array

    @property
    def radius(self) -> Array:
        return _radius_px(self.shapes)

    def shifted(self, by: NDArray[np.intp]) -> "DiskStates":
        """By (n, 2) columns and rows."""
        return replace(self, centers=self.centers + by)

    def part(self, chosen: Mask | NDArray[np.intp]) -> "DiskStates":
        return DiskStates(self.centers[chosen], self.shapes[chosen], self.blur[chosen], self.greys[chosen])

    def stepped(self, step: Array) -> "DiskStates":
        """After a step (n, unknowns); one beyond what the linearisation tells is shortened."""
        relative = step[:, :5] / self.radius[:, None]
        relative /= np.maximum(np.abs(relative).max(axis=1, keepdims=True) / _LONGEST_STEP, 1.0)
        return DiskStates(
            self.centers + relative[:, :2] * self.radius[:, None],
            self.shapes + np.tensordot(relative[:, 2:], _GENERATORS, axes=1) @ self.shapes,
            np.clip(self.blur + np.clip(step[:, 5], -0.5 * self.blur, self.blur), *_BLUR_PX),
            self.greys + step[:, -GREYS:],
        )


def _radius_px(shapes: Array) -> Array:
    """(n,) of the circles of the same area."""
    return np.asarray(np.sqrt(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0])))


class _Edges(NamedTuple):
    """Each (n, pixels): col, row: px from the centres; along_col, along_row, length: a vector at right angles to the
    ellipse, and its length; distance: from the edge, px, positive inside; place: distance in blurs; density: of the
    normal distribution there, over its largest; share: of the disk in the pixel.
    """

    col: Image
    row: Image
    along_col: Image
    along_row: Image
    length: Image
    distance: Image
    place: Image
    density: Image
    share: Image


class DiskModel:
    """n disks at a state, in pixels whose columns and rows are col, row (n, pixels)."""

    def __init__(self, state: DiskStates, col: NDArray[np.intp], row: NDArray[np.intp]) -> None:
        self.state = state
        self._col, self._row = col, row

    def relinearised(self, state: DiskStates) -> "DiskModel":
        return DiskModel(state, self._col, self._row)

    def replace_greys(self, greys: Array) -> "DiskModel":
        model = copy(self)
        model.state = replace(self.state, greys=greys)
        return model

    @cached_property
    def _edges(self) -> _Edges:
        state = self.state
        col = (self._col - state.centers[:, :1]).astype(np.float32)
        row = (self._row - state.centers[:, 1:]).astype(np.float32)
        inverse = np.linalg.inv(state.shapes)
        form = (inverse.swapaxes(1, 2) @ inverse).astype(np.float32)[..., None]  # col, row: squares of radii
        along_col = form[:, 0, 0] * col + form[:, 0, 1] * row
        along_row = form[:, 1, 0] * col + form[:, 1, 1] * row
        radius = np.sqrt(np.maximum(along_col * col + along_row * row, np.float32(0)))
        length = np.maximum(np.sqrt(along_col * along_col + along_row * along_row), np.float32(1e-12))
        distance = (1 - radius) * radius / length
        place = distance / each(state.blur)
        density = np.exp(np.float32(-0.5) * place * place)
        return _Edges(col, row, along_col, along_row, length, distance, place, density, _normal_share(place, density))

    def grey(self) -> Image:
        """(n, pixels) as modelled."""
        gain, offset, by_col, by_row = (each(greys) for greys in self.state.greys.T)
        size, edges = each(self.state.radius), self._edges
        return np.asarray(gain * edges.share + (offset + by_col / size * edges.col + by_row / size * edges.row))

    def design(self) -> Image:
        """(n, unknowns, pixels): columns and rows of the centres, the shapes' scale, stretch and shear in radii,
        the blur, the greys."""
        gain, blur, size = (each(of) for of in (self.state.greys[:, 0], self.state.blur, self.state.radius))
        edges = self._edges
        design = np.empty((len(gain), UNKNOWNS, edges.share.shape[1]), np.float32)
        steepness = gain / (np.float32(np.sqrt(2 * np.pi)) * blur) * edges.density
        moved = steepness / edges.length
        outward_col = np.multiply(moved, edges.along_col, out=design[:, 0])
        outward_row = np.multiply(moved, edges.along_row, out=design[:, 1])
        col, row = edges.col / size, edges.row / size
        along_col, along_row = outward_col * col, outward_row * row
        np.add(along_col, along_row, out=design[:, 2])
        np.subtract(along_col, along_row, out=design[:, 3])
        np.add(outward_col * row, outward_row * col, out=design[:, 4])
        np.multiply(steepness, -edges.place, out=design[:, 5])
        design[:, -GREYS:] = self.grey_design()
        return design

    def grey_design(self) -> Image:
        """(n, GREYS, pixels): that of the greys alone."""
        size, edges = each(self.state.radius), self._edges
        design = np.empty((len(size), GREYS, edges.share.shape[1]), np.float32)
        design[:, 0], design[:, 1], design[:, 2], design[:, 3] = edges.share, 1, edges.col / size, edges.row / size
        return design


def _normal_share(place: Image, density: Image) -> Image:
    """Of a normal distribution below a place in its sigmas, to some 1e-7, for its density there over the largest
    (Abramowitz and Stegun, 1964, 26.2.17): in single precision ten times as fast as the error function."""
    falling, (first, *others) = _TAIL
    near = 1 / (1 + np.float32(falling) * np.abs(place))
    tail = np.float32(first) * near
    for coefficient in others:
        tail += np.float32(coefficient)
        tail *= near
    tail *= density
    return np.asarray(np.copysign(np.float32(0.5) - tail, place) + np.float32(0.5))


def each(values: Array) -> Image:
    """(n, 1)"""
    return np.asarray(values, np.float32)[:, None]


# Many disks fitted at once, to tell them from patches of a landscape and to say nearly where they are. Disks of about
# as many pixels are adjusted together, in the same few steps: first with some of their pixels, which most patches do
# not outlast, then with all.


def disks_among(block: Block, patches: Patches) -> Patches:
    """Those patches that a disk explains, the strongest first, as fitted: a place within a tenth of a pixel or so."""
    starts = _states(patches)
    none = starts.part(np.zeros(0, np.intp))
    promising = concatenate(none, *map(_promising, _groups(block, starts, _every(starts.radius))))
    fitted = concatenate(none, *map(_final_fit, _groups(block, promising, np.ones(len(promising.blur), np.intp))))
    return Patches(fitted.centers, fitted.shapes, fitted.greys[:, 0]).strongest_first()


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
    areas = Areas.surround(disks.centers, disks.shapes, margin, every)
    for chosen in areas.alike():
        yield _Group.begin(block, disks.part(chosen), areas.part(chosen).pixels(block))


def _promising(group: "_Group") -> DiskStates:
    """Those that look like disks, as their outlines have them and still after some steps."""
    group = group.part(group.misfit() < _HOPELESS)
    if not len(group.grey):
        return group.disks
    for step in range(_COARSE_STEPS + 1):
        group = group.stepped(is_robust=step == _COARSE_STEPS)
    return group.part((group.misfit() < _HOPELESS) & group.is_sane()).disks_now()


def _final_fit(group: "_Group") -> DiskStates:
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
    def begin(cls, block: Block, disks: DiskStates, pixels: DiskPixels) -> "_Group":
        grey, model = pixels.grey(block), DiskModel(disks.shifted(-pixels.corners), *pixels.places)
        greys = gauss_newton_step(model.grey_design(), grey, pixels.used.astype(np.float32), DAMPING)
        return cls(disks, pixels, grey, model.replace_greys(greys))

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
        return replace(self, model=self.model.relinearised(self.state.stepped(step)))

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
        return self.state.shifted(self.pixels.corners)
