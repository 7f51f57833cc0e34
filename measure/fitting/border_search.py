"""Where in a mark's window the ground has a border, by what a fit that knows of none leaves.

Straight borders of all directions are tried, with a contrast of the mark of its own beyond each, in a linear fit beside
all that the mark's unknowns change. The best counts if the noise that is left is hardly able to feign it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from measure.fitting.picture_model import GREY, PictureModel
from measure.noise.noise import REACH_PX, NoiseModel, autocovariance, correlated
from measure.noise.pixel_sums import products

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

_TURN, _APART = np.pi / 15, 2.0  # rad and blurs: between the borders that are tried first
_FINER = 4  # times as close are those that are tried about the best of these
_LEAST_SIDE = 0.05  # of the area: a smaller one is no ground beyond a border
_FEWEST = 3  # pixels to an unknown
_LEAST_LEFT = 1e-4  # of a change of contrast, beside the step: less cannot be told from it
_CHANCE = 1e-12  # that noise feigns a border: the luckiest of some hundred, in one of many million marks


class LikelyBorder(NamedTuple):
    """A straight border that passes off_px from where the mark is expected, its normal in the direction turn_rad."""

    off_px: float
    turn_rad: float


def likely_border(model: PictureModel, area: Mask, floor_dn: float) -> LikelyBorder | None:
    """The border that explains most of what the model in its present state leaves in the area (height, width); None
    where noise may do the same. floor_dn: standard deviation below which what is left may be the drawing's own."""
    tells = area & (model.clipped == 0)
    if tells.sum() < _FEWEST * len(model.design):
        return None
    search = _Search(model, tells)
    best = search.best(search.coarse())
    if best is None:
        return None
    best = search.best(search.about(best)) or best
    return best if search.stands_out(best, floor_dn) else None


def is_overwhelming(chi_square: float, greys: int, noise: NoiseModel, redundancy: int) -> bool:
    """Whether noise hardly ever makes so many grey values of a border together so large.

    redundancy: of the fit whose residuals showed the noise. Where these are alike from pixel to pixel they tell less of
    it than as many others would, by the sum of their squared correlations (Bartlett).
    """
    alike = float(np.sum(noise.autocovariance_dn2**2)) / max(noise.variance_dn2**2, 1e-300)
    return bool(fdtrc(greys, max(redundancy / max(alike, 1.0), 1.0), chi_square / greys) < _CHANCE)


class _Search:
    """used (height, width): n pixels that tell their grey value; place (2, n): where these are, from the mark's start,
    px; base (unknowns, n): orthonormal rows that span what the mark's unknowns change there; left (n,): what they leave
    of the grey values; shown (n,): the mark's picture."""

    def __init__(self, model: PictureModel, used: Mask) -> None:
        self.used = used
        rows, cols = np.nonzero(used)
        self.place = np.stack([cols - model.start[0, 2], rows - model.start[1, 2]])
        self.base = np.linalg.qr(model.design[:, used].T)[0].T
        self.left = self._beside(model.grey[used][None])[0]
        self.shown = model.design[-GREY][used]
        self.blur_px = model.seen_blur_px

    def coarse(self) -> Array:
        """(tried, 2) off_px and turn_rad of borders everywhere."""
        reach_px = float(np.hypot(*self.place).max())
        offs, turns = np.arange(-reach_px, reach_px, _APART * self.blur_px), np.arange(0.0, np.pi, _TURN)
        return np.stack(np.meshgrid(offs, turns), axis=-1).reshape(-1, 2)

    def about(self, best: LikelyBorder) -> Array:
        """(tried, 2) off_px and turn_rad of borders about one, closer together."""
        steps = np.arange(1 - _FINER, _FINER) / _FINER
        offs, turns = best.off_px + steps * _APART * self.blur_px, best.turn_rad + steps * _TURN
        return np.stack(np.meshgrid(offs, turns), axis=-1).reshape(-1, 2)

    def best(self, tried: Array) -> LikelyBorder | None:
        """Which of the borders takes most from the squares; None where none divides the area."""
        edges = self._edges(tried)
        sides = edges.mean(axis=1)
        divides = (sides > _LEAST_SIDE) & (sides < 1 - _LEAST_SIDE)
        if not divides.any():
            return None
        gained = np.where(divides, self._gained(edges), 0.0)
        return LikelyBorder(*tried[int(np.argmax(gained))])

    def stands_out(self, border: LikelyBorder, floor_dn: float) -> bool:
        """Whether step and change of contrast by a linear fit are more than noise makes that is as alike from pixel to
        pixel as what this fit leaves."""
        edge = self._edges(np.array([border]))[0].astype(float)
        columns = self._beside(np.stack([edge, edge * self.shown]))
        scores, normal = columns @ self.left, columns @ columns.T
        # Where the border passes beside the mark, the change is none, or one of the whole contrast.
        inverse = np.linalg.pinv(normal, rcond=_LEAST_LEFT, hermitian=True)
        images = np.zeros((3, *self.used.shape))
        images[:2, self.used], images[2, self.used] = columns, self.left - inverse @ scores @ columns
        lags = autocovariance(images[2], self.used, REACH_PX)
        noise = NoiseModel(float(lags[REACH_PX, REACH_PX]), lags, 0.0).at_least(floor_dn**2)
        alike, white = products(images[:2], correlated(images[:2], noise)), noise.variance_dn2 * normal
        chi_square = min(
            float(scores @ np.linalg.pinv(each, rcond=_LEAST_LEFT, hermitian=True) @ scores)
            for each in (alike, white)
            if np.all(np.linalg.eigvalsh(each) > -_LEAST_LEFT * np.trace(each))
        )
        return is_overwhelming(chi_square, 2, noise, len(self.left) - len(self.base) - 2)

    def _gained(self, edges: Single) -> Array:
        """(tried,) by how much each edge (tried, n), with a change of contrast, lessens the sum of squares."""
        base, left, shown = (each.astype(np.float32) for each in (self.base, self.left, self.shown))
        squares = (edges**2) @ np.stack([np.ones_like(shown), shown, shown**2], axis=1)
        by_edge = edges @ np.concatenate([base, left[None]]).T
        by_change = edges @ (np.concatenate([base, left[None]]) * shown).T
        explained = by_edge[:, :-1], by_change[:, :-1]
        first = squares[:, 0] - (explained[0] ** 2).sum(axis=1)
        both = squares[:, 1] - (explained[0] * explained[1]).sum(axis=1)
        second = squares[:, 2] - (explained[1] ** 2).sum(axis=1)
        own = second - both**2 / np.maximum(first, 1e-6)
        of_edge, of_change = by_edge[:, -1], by_change[:, -1]
        gained = of_edge**2 / np.maximum(first, 1e-6)
        further = (of_change - both / np.maximum(first, 1e-6) * of_edge) ** 2 / np.maximum(own, 1e-6)
        return np.asarray(gained + np.where(own > _LEAST_LEFT * squares[:, 0], further, 0.0), float)

    def _edges(self, tried: Array) -> Single:
        """(tried, n) a step of 1 beyond each, about as soft as the mark."""
        turns = np.stack([np.cos(tried[:, 1]), np.sin(tried[:, 1]), -tried[:, 0]], axis=1)
        places = np.concatenate([self.place, np.ones_like(self.place[:1])]) / (np.sqrt(2 * np.pi) * self.blur_px)
        across = turns.astype(np.float32) @ places.astype(np.float32)
        return np.asarray(np.clip(across + np.float32(0.5), 0.0, 1.0), np.float32)

    def _beside(self, rows: Array) -> Array:
        """What the mark's unknowns leave of rows (m, n)."""
        return np.asarray(rows - rows @ self.base.T @ self.base)
