"""Where in a mark's window the ground has a border, by what a fit that knows of none leaves.

Straight borders of all directions are tried, with a contrast of the mark of its own beyond each, in a linear fit beside
all that the mark's unknowns change: first on sums over wide squares, where hardly any mark has one, and then more
closely. The best counts if the noise that is left is hardly able to feign it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.special import chdtri, fdtrc

from measure.matching.models import GREY, PictureModel
from measure.noise.noise_model import (
    REACH_PX,
    NoiseModel,
    autocovariance,
    combined,
    correlated,
    products,
    to_orthonormal,
)
from measure.probabilities import BORDER_FEIGNED

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TURN, _APART = np.pi / 15, 0.8  # rad and widths: between the borders that are tried first
_FINER = 4  # times as close are those that are tried about the best of these
_POWERS = 3  # of the picture that an edge is summed with: 0 to 2
_LEAST_SIDE = 0.05  # of the area: a smaller one is no ground beyond a border
_APART_PX = 8  # squares as wide hardly share any grain
_MISSED = 2.0  # times what borders in these explain is as much as any border does, at most
_SQUARES = 100  # so many, or smaller ones: fewer do not tell noise from a strong border
_FEWEST = 3  # pixels to an unknown
_LEAST_LEFT = 1e-4  # of a change of contrast, beside the step: less cannot be told from it


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
    left = _Left(model, tells)
    side_px = max(min(int(np.sqrt(tells.sum() / _SQUARES)), _APART_PX), 1)
    if not left.in_squares(side_px, max(side_px, left.soft_px)).may_have_border(left.reach_px):
        return None
    squares = left.in_squares(max(round(left.soft_px), 1), left.soft_px)
    best = squares.best(*squares.everywhere(left.reach_px))
    if best is None:
        return None
    best = squares.best(*squares.about(best)) or best
    return best if left.stands_out(best, floor_dn) else None


def is_overwhelming(chi_square: float, greys: int, noise: NoiseModel, redundancy: int) -> bool:
    """Whether noise hardly ever makes so many grey values of a border together so large.

    redundancy: of the fit whose residuals showed the noise. Where these are alike from pixel to pixel they tell less of
    it than as many others would, by the sum of their squared correlations (Bartlett).
    """
    alike = float(np.sum(noise.autocovariance_dn2**2)) / max(noise.variance_dn2**2, 1e-300)
    return _is_rare(chi_square, greys, redundancy / max(alike, 1.0))


def _is_rare(chi_square: float, greys: int, redundancy: float) -> bool:
    return bool(fdtrc(greys, max(redundancy, 1.0), chi_square / greys) < BORDER_FEIGNED)


class _Left:
    """What a fit leaves. used (height, width): n pixels that tell their grey value; place (2, height, width): where
    these are, from the mark's start, px; design (unknowns, height, width): what the mark's unknowns change there; left
    (height, width): what they leave of the grey values; both 0 where not used; soft_px: as wide a step is about as soft
    as the mark; reach_px: how far off the farthest pixel is."""

    def __init__(self, model: PictureModel, used: Mask) -> None:
        self.used, even = used, used / model.steadiness
        self.place = np.indices(used.shape)[::-1] - model.start[:, 2, None, None]
        self.reach_px = float(np.hypot(*self.place)[used].max())
        self.design = model.design * even
        self.orthonormal = to_orthonormal(products(self.design, self.design))
        self.left = self._beside((model.residuals * even)[None])[0]
        self.soft_px = float(np.sqrt(2 * np.pi) * model.seen_blur_px)

    def in_squares(self, side_px: int, soft_px: float) -> "_Squares":
        """Summed up in squares, for borders of a width of soft_px."""
        shown, both = self.design[-GREY], np.concatenate([self.design, self.left[None]])
        images = [both, both * shown, np.stack([self.used, shown, shown**2]), self.place * self.used]
        sums = np.concatenate([_summed(image, side_px) for image in images]).T
        sums = sums[sums[:, -_POWERS - 2] > 0]
        by_unknown, by_change = (sums[:, at : at + len(self.design)] @ self.orthonormal.T for at in (0, len(both)))
        left, left_by_change = (sums[:, [at]] for at in (len(self.design), 2 * len(both) - 1))
        powers, place = sums[:, -_POWERS - 2 : -2], sums[:, -2:]
        rows = np.concatenate([by_unknown, left, by_change, left_by_change, powers], axis=1)
        return _Squares(rows, (place / powers[:, :1]).T, soft_px)

    def stands_out(self, border: LikelyBorder, floor_dn: float) -> bool:
        """Whether step and change of contrast by a linear fit are more than noise makes that is as alike from pixel to
        pixel as what this fit leaves."""
        edge = _beyond(border, self.place, self.soft_px) * self.used
        columns = self._beside(np.stack([edge, edge * self.design[-GREY]]))
        scores, normal = products(columns, self.left[None])[:, 0], products(columns, columns)
        # Where the border passes beside the mark, the change is none, or one of the whole contrast.
        inverse = np.linalg.pinv(normal, rcond=_LEAST_LEFT, hermitian=True)
        left, count = self.left - combined(inverse @ scores, columns), int(self.used.sum())
        redundancy = count - len(self.orthonormal) - 2
        variance_dn2 = max(float(np.sum(left**2)) / count, floor_dn**2)
        if not _is_rare(float(scores @ inverse @ scores) / max(variance_dn2, 1e-300), 2, redundancy):
            return False
        lags = autocovariance(left, self.used, REACH_PX)
        noise = NoiseModel(float(lags[REACH_PX, REACH_PX]), lags, 0.0).at_least(floor_dn**2)
        alike, white = products(columns, correlated(columns, noise)), noise.variance_dn2 * normal
        chi_square = min(
            float(scores @ np.linalg.pinv(each, rcond=_LEAST_LEFT, hermitian=True) @ scores)
            for each in (alike, white)
            if np.all(np.linalg.eigvalsh(each) > -_LEAST_LEFT * np.trace(each))
        )
        return is_overwhelming(chi_square, 2, noise, redundancy)

    def _beside(self, images: Array) -> Array:
        """What the mark's unknowns leave of images (m, height, width) that are 0 where not used."""
        shares = products(images, self.design) @ self.orthonormal.T @ self.orthonormal
        return images - combined(shares, self.design)


class _Squares:
    """What a fit leaves, summed up in squares of pixels. rows (n, columns): of each square the sums of an orthonormal
    base of the design and of what this leaves, both times the picture, and of the picture's powers; places (2, n): its
    middle; soft_px: how wide a border is."""

    def __init__(self, rows: Array, places: Array, soft_px: float) -> None:
        self.rows, self.places, self.soft_px = rows, places, soft_px
        self.pixels = float(rows[:, -_POWERS].sum())

    def may_have_border(self, reach_px: float) -> bool:
        """Whether some border explains so much that noise hardly feigns it. In squares wider than grain reaches, noise
        is as good as independent: what varies from one to the next is all that it does to a border."""
        gained = float(self._gained(*self.everywhere(reach_px)).max())
        left = self.rows[:, (self.rows.shape[1] - _POWERS) // 2 - 1] ** 2 / self.rows[:, -_POWERS]
        variance = (float(left.sum()) - gained) / len(left)
        return bool(_MISSED * gained > variance * chdtri(2, BORDER_FEIGNED))

    def everywhere(self, reach_px: float) -> tuple[Array, Array]:
        """off_px and turn_rad of borders as far as the reach."""
        return np.arange(-reach_px, reach_px, _APART * self.soft_px), np.arange(0.0, np.pi, _TURN)

    def about(self, best: LikelyBorder) -> tuple[Array, Array]:
        """off_px and turn_rad of borders about one, closer together."""
        steps = np.arange(1 - _FINER, _FINER) / _FINER
        return best.off_px + steps * _APART * self.soft_px, best.turn_rad + steps * _TURN

    def best(self, offs_px: Array, turns_rad: Array) -> LikelyBorder | None:
        """Which border of any of the distances in any of the directions takes most from the squares; None where none
        divides the area."""
        gained = self._gained(offs_px, turns_rad)
        turn, off = np.unravel_index(int(np.argmax(gained)), gained.shape)
        return LikelyBorder(offs_px[off], turns_rad[turn]) if gained[turn, off] > 0 else None

    def _gained(self, offs_px: Array, turns_rad: Array) -> Array:
        """(turns, offs) by how much the edge at each distance in each direction, with a change of contrast, lessens the
        sum of squares: 0 where it does not divide the area."""
        weighted, squares = self._edge_sums(offs_px, turns_rad)
        by_edge, by_change = np.split(weighted[..., :-_POWERS], 2, axis=2)
        explained = by_edge[..., :-1], by_change[..., :-1]
        first = np.maximum(squares[..., 0] - (explained[0] ** 2).sum(axis=2), 1e-6)
        both = squares[..., 1] - (explained[0] * explained[1]).sum(axis=2)
        own = squares[..., 2] - (explained[1] ** 2).sum(axis=2) - both**2 / first
        of_edge, of_change = by_edge[..., -1], by_change[..., -1]
        further = (of_change - both / first * of_edge) ** 2 / np.maximum(own, 1e-6)
        gained = of_edge**2 / first + np.where(own > _LEAST_LEFT * squares[..., 0], further, 0.0)
        side = weighted[..., -_POWERS] / self.pixels
        return np.where((side > _LEAST_SIDE) & (side < 1 - _LEAST_SIDE), gained, 0.0)

    def _edge_sums(self, offs_px: Array, turns_rad: Array) -> tuple[Array, Array]:
        """(turns, offs, columns) the sums of all rows, each pixel by the step of 1 beyond the edge at each distance in
        each direction; and those of the powers of the picture by the step's square.

        The step rises in a straight line from one bound to another: it is the difference of how far a pixel lies beyond
        each, and what lies beyond a bound is summed up for all of them at once.
        """
        across = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=1) @ self.places
        bounds = np.concatenate([offs_px - self.soft_px / 2, offs_px + self.soft_px / 2])
        order = np.argsort(bounds)
        shape = len(turns_rad), len(bounds) + 1
        cells = np.searchsorted(bounds[order], across) + shape[1] * np.arange(shape[0])[:, None]
        of_pixel = np.arange(0, cells.size + 1, shape[0])

        def beyond(power: int, rows: Array) -> Array:
            moments = csc_array(
                ((across.T**power).ravel(), cells.T.ravel(), of_pixel), shape=(shape[0] * shape[1], len(rows))
            )
            sums = np.empty((shape[0], len(bounds), rows.shape[1]))
            sums[:, order] = np.cumsum(np.asarray(moments @ rows).reshape(*shape, -1)[:, ::-1], axis=1)[:, -2::-1]
            return sums

        at = bounds[:, None]
        count, first = beyond(0, self.rows), beyond(1, self.rows)
        far = first - at * count
        squares = slice(-_POWERS, None)
        square = beyond(2, self.rows[:, squares]) - at * (far + first)[..., squares]
        begin, end = slice(len(offs_px)), slice(len(offs_px), None)
        of_squares = (square[:, begin] - square[:, end]) / self.soft_px - 2 * far[:, end, squares]
        return (far[:, begin] - far[:, end]) / self.soft_px, of_squares / self.soft_px


def _beyond(border: LikelyBorder, place: Array, soft_px: float) -> Array:
    """(height, width) a step of 1 beyond a border, at places (2, height, width)."""
    across = np.cos(border.turn_rad) * place[0] + np.sin(border.turn_rad) * place[1] - border.off_px
    return np.asarray(np.clip(across / soft_px + 0.5, 0.0, 1.0))


def _summed(images: Array, side_px: int) -> Array:
    """(n, squares) the sums of images (n, height, width) in the squares that they divide into."""
    rows, cols = (np.arange(0, size, side_px) for size in images.shape[1:])
    return np.add.reduceat(np.add.reduceat(images, rows, axis=1), cols, axis=2).reshape(len(images), -1)
