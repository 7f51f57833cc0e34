"""Many disks fitted at once, to tell them from patches of a landscape and to say nearly where they are.

The model is an edge round an ellipse as a Gaussian blurs it, `gain * Phi(distance / blur) + offset + slopes`, in closed
form: the edge is taken for straight where it is blurred, which changes a disk's size by a few hundredths of a pixel and
its place by nothing. Disks of about one size are adjusted together, pixel by pixel, in the same few steps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from measure.block import Block
from measure.disk_patches import Candidate, strength
from measure.robust import tukey_weights
from measure.scan import Scan

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast: texture and stains are no disks
SMOOTH = 0.5  # correlation of neighbouring residuals, from which on they are no noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # of its radius: the ground is not plain for long, where a target's pad ends, say
SIZE_STEP = 1.3  # from the smallest to the largest that are fitted together
TOGETHER_PIXELS = 1 << 15  # of all windows: with their derivatives they stay in the processor's cache
STEPS, ROBUST_STEPS = 3, 1
SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
FIRST_BLUR_PX, BLUR_PX = 1.0, (0.5, 8.0)  # pixels' own width included
LONGEST_STEP = 0.3  # of the radius
DAMPING = 1e-4
COARSE_PX = 6.0  # radius from which on every fourth pixel is enough for a first look
HOPELESS = 1.5  # times the misfit that is allowed, before any step: an outline is right to a few percent
GREYS = 4
_GENERATORS = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])


@dataclass(frozen=True, eq=False)
class _State:
    """Of n disks: centers (n, 2) in their windows, shapes (n, 2, 2), blur (n,), greys (n, 4): gain, offset, slopes."""

    centers: Array
    shapes: Array
    blur: Array
    greys: Array

    @property
    def radius(self) -> Array:
        return _radius_px(self.shapes)


def disks_among(block: Block, patches: Sequence[Candidate]) -> list[Candidate]:
    """Those patches that a disk explains, in their order, as fitted: a place within a tenth of a pixel or so."""
    hopeful = [patches[index] for group in _alike(patches) for index in _hopeful(block, patches, group)]
    fitted = [patch for group in _alike(hopeful) for patch in _fitted(block, hopeful, group)]
    return sorted(fitted, key=strength)


def _alike(patches: Sequence[Candidate]) -> Iterator[list[int]]:
    """Patches (by index) of about one size, so many that their windows are not too large."""
    reach = _reach_px(_shapes(patches))
    rest = np.argsort(reach, kind="stable").tolist()
    while rest:
        largest = reach[rest[0]] * SIZE_STEP
        count = max(int(TOGETHER_PIXELS / (2 * largest + 1) ** 2), 1)
        chosen = [index for index in rest[:count] if reach[index] <= largest]
        yield chosen
        rest = rest[len(chosen) :]


def _shapes(patches: Sequence[Candidate]) -> Array:
    return np.array([patch.pixel_from_disk for patch in patches]).reshape(-1, 2, 2)


def _reach_px(shapes: Array) -> Array:
    """(n,) how far from the middle grey values are used."""
    return np.asarray(np.sqrt((shapes**2).sum(axis=(1, 2))) + _margin_px(shapes) + 1.0)


def _margin_px(shapes: Array) -> Array:
    return np.maximum(MARGIN * _radius_px(shapes), LEAST_MARGIN_PX)


def _radius_px(shapes: Array) -> Array:
    """(n,) of the circles of the same area."""
    return np.asarray(np.sqrt(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0])))


def _hopeful(block: Block, patches: Sequence[Candidate], chosen: list[int]) -> list[int]:
    """Those of the chosen patches, of about one size, that already look like disks as their outlines have them."""
    group = _Group.of(block, [patches[index] for index in chosen], COARSE_PX)
    misfit = _misfit(
        _residuals(group.grey, _Model(group.grey, group.start).design, group.start), group.used, group.start
    )
    return [chosen[index] for index in np.flatnonzero(misfit < HOPELESS)]


def _fitted(block: Block, patches: Sequence[Candidate], chosen: list[int]) -> list[Candidate]:
    """The disks among the chosen patches, of about one size."""
    group = _Group.of(block, [patches[index] for index in chosen])
    state = _adjusted(group.grey, group.start, group.used)
    residuals = _residuals(group.grey, _Model(group.grey, state).design, state)
    is_disk = (_misfit(residuals, group.used, state) < 1.0) & _is_sane(state, group.start)
    gain = state.greys[:, 0]
    same = np.sign(gain) == np.sign([patches[index].contrast_dn for index in chosen])
    return [
        Candidate(state.centers[index] + group.corners[index], state.shapes[index], float(gain[index]))
        for index in np.flatnonzero(is_disk & same)
    ]


@dataclass(frozen=True, eq=False)
class _Group:
    """Windows (n, side, side) of patches of about one size, their first pixels' places corners (n, 2), which pixels are
    used, and what the patches are as disks."""

    corners: NDArray[np.int64]
    grey: Image
    used: Mask
    start: _State

    @classmethod
    def of(cls, block: Block, patches: list[Candidate], coarse_px: float = np.inf) -> "_Group":
        """With patches whose radii are all so large, only every other column and row."""
        shapes = _shapes(patches)
        half = int(np.ceil(_reach_px(shapes).max()))
        side, every = 2 * half + 1, 2 if _radius_px(shapes).min() >= coarse_px else 1
        places = np.array([patch.center_px for patch in patches])
        inside = np.array(block.size_px) - side
        corners = np.clip(np.rint(places).astype(np.int64) - half - block.place_px, 0, inside) + block.place_px
        windows = [block.window(col, row, side, side)[::every, ::every] for col, row in corners.tolist()]
        grey, blur = np.stack(windows), np.full(len(patches), FIRST_BLUR_PX / every)
        state = _State((places - corners) / every, shapes / every, blur, np.zeros((len(patches), GREYS)))
        model = _Model(grey, state)
        used = model.distance > -_margin_px(shapes)[:, None, None] / every
        used &= _in_scan(block.scan, corners, side)[:, ::every, ::every]
        greys = _solved(model.design[:, -GREYS:], grey, used.astype(np.float32))
        return cls(corners, grey, used, replace(state, greys=greys))


def _in_scan(scan: Scan, corners: NDArray[np.int64], side: int) -> Mask:
    """(n, side, side): which pixels of the windows are the scan's."""
    along = corners[:, :, None] + np.arange(side)
    inside = (along >= 0) & (along < np.array([[scan.width_px], [scan.height_px]]))
    return np.asarray(inside[:, 1, :, None] & inside[:, 0, None, :])


class _Model:
    """The design (n, unknowns, height, width) at a state: columns and rows of the centres, the shapes' scale, stretch
    and shear, in radii, the blur, the greys; distance (n, height, width) from the edge, positive inside."""

    def __init__(self, grey: Image, state: _State) -> None:
        count, height, width = grey.shape
        col = (np.arange(width) - state.centers[:, :1]).astype(np.float32)[:, None, :]
        row = (np.arange(height) - state.centers[:, 1:]).astype(np.float32)[:, :, None]
        inverse = np.linalg.inv(state.shapes).astype(np.float32)[..., None, None]
        x = inverse[:, 0, 0] * col + inverse[:, 0, 1] * row
        y = inverse[:, 1, 0] * col + inverse[:, 1, 1] * row
        radius = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
        by_col = (inverse[:, 0, 0] * x + inverse[:, 1, 0] * y) / radius
        by_row = (inverse[:, 0, 1] * x + inverse[:, 1, 1] * y) / radius
        slope = np.sqrt(by_col * by_col + by_row * by_row)
        self.distance = (1 - radius) / slope
        blur = state.blur.astype(np.float32)[:, None, None]
        place = self.distance / blur
        edge = np.exp(-0.5 * place * place) / (np.float32(np.sqrt(2 * np.pi)) * blur)
        gain = state.greys[:, 0].astype(np.float32)[:, None, None]
        moved = gain * edge / slope
        outward_col, outward_row = moved * by_col, moved * by_row
        size = state.radius.astype(np.float32)[:, None, None]
        self.design = np.empty((count, 6 + GREYS, height, width), np.float32)
        self.design[:, 0], self.design[:, 1] = outward_col, outward_row
        for index, ((xx, xy), (yx, yy)) in enumerate(_GENERATORS.astype(np.float32)):
            along_col, along_row = xx * col + xy * row, yx * col + yy * row
            self.design[:, 2 + index] = (outward_col * along_col + outward_row * along_row) / size
        self.design[:, 5] = -gain * edge * place
        self.design[:, 6], self.design[:, 7] = ndtr(place), 1
        self.design[:, 8], self.design[:, 9] = col / size, row / size


def _adjusted(grey: Image, state: _State, used: Mask) -> _State:
    """The disks after all steps; in the last ones dust and neighbours count less."""
    weights = used.astype(np.float32)
    for step in range(STEPS + ROBUST_STEPS):
        design = _Model(grey, state).design
        residuals = _residuals(grey, design, state)
        if step >= STEPS:
            scale = np.maximum(_scale(residuals, used), SCALE_FLOOR * np.abs(state.greys[:, 0]) + 1e-6)
            weights = (used * tukey_weights(residuals / scale[:, None, None], 1.0)).astype(np.float32)
        state = _stepped(state, _solved(design, residuals, weights))
    return state


def _misfit(residuals: Image, used: Mask, state: _State) -> Array:
    """(n,) what a disk leaves unexplained, over what is allowed; a picture of something else is alike in neighbouring
    pixels."""
    left = residuals * used
    beside = (left[:, :, 1:] * left[:, :, :-1]).sum(axis=(1, 2))
    below = (left[:, 1:] * left[:, :-1]).sum(axis=(1, 2))
    correlation = (beside + below) / np.maximum(2 * (left**2).sum(axis=(1, 2)), 1e-6)
    allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
    return np.asarray(_scale(residuals, used) / np.maximum(allowed * np.abs(state.greys[:, 0]), 1e-6), float)


def _residuals(grey: Image, design: Image, state: _State) -> Image:
    modelled = np.einsum("nu,nurc->nrc", state.greys.astype(np.float32), design[:, -GREYS:])
    return np.asarray(grey - modelled, np.float32)


def _scale(residuals: Image, used: Mask) -> Array:
    """(n,) the standard deviation that most residuals of each window have."""
    rising = np.sort(np.where(used, np.abs(residuals), np.float32(np.inf)).reshape(len(used), -1), axis=1)
    middle = used.reshape(len(used), -1).sum(axis=1) // 2
    return np.asarray(1.4826 * rising[np.arange(len(used)), middle], float)


def _solved(design: Image, residuals: Image, weights: Image) -> Array:
    """(n, unknowns) of weighted least squares."""
    flat = design.reshape(*design.shape[:2], -1)
    weighted = flat * weights.reshape(len(weights), 1, -1)
    normal = (weighted @ flat.swapaxes(1, 2)).astype(float)
    right = (weighted @ residuals.reshape(len(residuals), -1, 1)).astype(float)
    size = np.sqrt(np.maximum(np.einsum("nuu->nu", normal), 1e-12))
    scaled = normal / (size[:, :, None] * size[:, None]) + DAMPING * np.eye(normal.shape[1])
    return np.asarray(np.linalg.solve(scaled, right / size[..., None])[..., 0] / size)


def _stepped(state: _State, step: Array) -> _State:
    """Steps beyond what the linearisation tells are shortened."""
    radius = state.radius
    moves = np.concatenate([step[:, :2] / radius[:, None], step[:, 2:5] / radius[:, None]], axis=1)
    shorter = np.maximum(np.abs(moves).max(axis=1) / LONGEST_STEP, 1.0)[:, None]
    linear = np.tensordot(step[:, 2:5] / radius[:, None] / shorter, _GENERATORS, axes=1)
    return _State(
        state.centers + step[:, :2] / shorter,
        state.shapes + linear @ state.shapes,
        np.clip(state.blur + np.clip(step[:, 5], -0.5 * state.blur, state.blur), *BLUR_PX),
        state.greys + step[:, -GREYS:],
    )


def _is_sane(state: _State, start: _State) -> Mask:
    """Whether the fits are still about what they started from."""
    moved = np.hypot(*(state.centers - start.centers).T) / start.radius
    grown = state.radius / start.radius
    return np.asarray(np.isfinite(moved) & (moved < 0.5) & (np.abs(np.log(grown)) < np.log(1.5)))
