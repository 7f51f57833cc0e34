"""Where in a mark's window the ground has a border, by what a fit that knows of none leaves.

Straight borders of all directions are tried, with a contrast of the mark of its own beyond each, in a linear fit beside
all that the mark's unknowns change. The best counts if the noise that is left is hardly able to feign it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.special import fdtrc

from measure.fitting.picture_model import GREY, PictureModel
from measure.noise.noise import REACH_PX, NoiseModel, autocovariance, correlated
from measure.noise.pixel_sums import products, to_orthonormal
from measure.probabilities import BORDER_FEIGNED

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TURN, _APART = np.pi / 15, 2.0  # rad and blurs: between the borders that are tried first
_FINER = 4  # times as close are those that are tried about the best of these
_POWERS = 3  # of the picture that an edge is summed with: 0 to 2
_LEAST_SIDE = 0.05  # of the area: a smaller one is no ground beyond a border
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
    search = _Search(model, tells)
    best = search.best(*search.coarse())
    if best is None:
        return None
    best = search.best(*search.about(best)) or best
    return best if search.stands_out(best, floor_dn) else None


def is_overwhelming(chi_square: float, greys: int, noise: NoiseModel, redundancy: int) -> bool:
    """Whether noise hardly ever makes so many grey values of a border together so large.

    redundancy: of the fit whose residuals showed the noise. Where these are alike from pixel to pixel they tell less of
    it than as many others would, by the sum of their squared correlations (Bartlett).
    """
    alike = float(np.sum(noise.autocovariance_dn2**2)) / max(noise.variance_dn2**2, 1e-300)
    return _is_rare(chi_square, greys, redundancy / max(alike, 1.0))


def _is_rare(chi_square: float, greys: int, redundancy: float) -> bool:
    return bool(fdtrc(greys, max(redundancy, 1.0), chi_square / greys) < BORDER_FEIGNED)


class _Search:
    """used (height, width): n pixels that tell their grey value; place (2, n): where these are, from the mark's start,
    px; design (unknowns, n): what the mark's unknowns change there; left (n,): what they leave of the grey values;
    shown (n,): the mark's picture; soft_px: as wide a step is about as soft as the mark.

    What borders gain is summed up from squares about as wide as such a step."""

    def __init__(self, model: PictureModel, used: Mask) -> None:
        self.used = used
        rows, cols = np.nonzero(used)
        self.place = np.stack([cols - model.start[0, 2], rows - model.start[1, 2]])
        self.design = model.design[:, used] / model.steadiness[used]
        self.orthonormal = to_orthonormal(self.design @ self.design.T)
        self.left = self._beside((model.residuals[used] / model.steadiness[used])[None])[0]
        self.shown = self.design[-GREY]
        self.blur_px = model.seen_blur_px
        self.soft_px = np.sqrt(2 * np.pi) * self.blur_px
        side_px = max(round(self.soft_px), 1)
        self._squares(rows // side_px * (used.shape[1] // side_px + 1) + cols // side_px)

    def _squares(self, square: NDArray[np.intp]) -> None:
        """Sum up the pixels, of which each lies in a square of that number: an orthonormal base of the design and what
        this leaves, both times the picture, and the picture's powers."""
        of_pixels = csr_array((np.ones(len(square)), square, np.arange(len(square) + 1))).T
        both = np.concatenate([self.design, self.left[None]])
        powers = np.stack([np.ones_like(self.shown), self.shown, self.shown**2])
        sums = of_pixels @ np.concatenate([both, both * self.shown, powers, self.place]).T
        sums = sums[sums[:, -_POWERS - 2] > 0]
        by_unknown, by_change = (sums[:, at : at + len(self.design)] @ self.orthonormal.T for at in (0, len(both)))
        left, left_by_change = (sums[:, [at]] for at in (len(self.design), 2 * len(both) - 1))
        powers, place = sums[:, -_POWERS - 2 : -2], sums[:, -2:]
        self._rows = np.concatenate([by_unknown, left, by_change, left_by_change, powers], axis=1)
        self._places = (place / powers[:, :1]).T

    def coarse(self) -> tuple[Array, Array]:
        """off_px and turn_rad of borders everywhere."""
        reach_px = float(np.hypot(*self.place).max())
        return np.arange(-reach_px, reach_px, _APART * self.blur_px), np.arange(0.0, np.pi, _TURN)

    def about(self, best: LikelyBorder) -> tuple[Array, Array]:
        """off_px and turn_rad of borders about one, closer together."""
        steps = np.arange(1 - _FINER, _FINER) / _FINER
        return best.off_px + steps * _APART * self.blur_px, best.turn_rad + steps * _TURN

    def best(self, offs_px: Array, turns_rad: Array) -> LikelyBorder | None:
        """Which border of any of the distances in any of the directions takes most from the squares; None where none
        divides the area."""
        gained = self._gained(offs_px, turns_rad)
        turn, off = np.unravel_index(int(np.argmax(gained)), gained.shape)
        return LikelyBorder(offs_px[off], turns_rad[turn]) if gained[turn, off] > 0 else None

    def stands_out(self, border: LikelyBorder, floor_dn: float) -> bool:
        """Whether step and change of contrast by a linear fit are more than noise makes that is as alike from pixel to
        pixel as what this fit leaves."""
        edge = self._edge(border)
        columns = self._beside(np.stack([edge, edge * self.shown]))
        scores, normal = columns @ self.left, columns @ columns.T
        # Where the border passes beside the mark, the change is none, or one of the whole contrast.
        inverse = np.linalg.pinv(normal, rcond=_LEAST_LEFT, hermitian=True)
        left = self.left - inverse @ scores @ columns
        redundancy = len(self.left) - len(self.orthonormal) - 2
        variance_dn2 = max(float(np.mean(left**2)), floor_dn**2)
        if not _is_rare(float(scores @ inverse @ scores) / max(variance_dn2, 1e-300), 2, redundancy):
            return False
        images = np.zeros((3, *self.used.shape))
        images[:2, self.used], images[2, self.used] = columns, left
        lags = autocovariance(images[2], self.used, REACH_PX)
        noise = NoiseModel(float(lags[REACH_PX, REACH_PX]), lags, 0.0).at_least(floor_dn**2)
        alike, white = products(images[:2], correlated(images[:2], noise)), noise.variance_dn2 * normal
        chi_square = min(
            float(scores @ np.linalg.pinv(each, rcond=_LEAST_LEFT, hermitian=True) @ scores)
            for each in (alike, white)
            if np.all(np.linalg.eigvalsh(each) > -_LEAST_LEFT * np.trace(each))
        )
        return is_overwhelming(chi_square, 2, noise, redundancy)

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
        side = weighted[..., -_POWERS] / len(self.left)
        return np.where((side > _LEAST_SIDE) & (side < 1 - _LEAST_SIDE), gained, 0.0)

    def _edge_sums(self, offs_px: Array, turns_rad: Array) -> tuple[Array, Array]:
        """(turns, offs, columns) the sums of all rows, each pixel by the step of 1 beyond the edge at each distance in
        each direction; and those of the powers of the picture by the step's square.

        The step rises in a straight line from one bound to another: it is the difference of how far a pixel lies beyond
        each, and what lies beyond a bound is summed up for all of them at once.
        """
        across = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=1) @ self._places
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
            sums[:, order] = np.cumsum((moments @ rows).reshape(*shape, -1)[:, ::-1], axis=1)[:, -2::-1]
            return sums

        at = bounds[:, None]
        count, first = beyond(0, self._rows), beyond(1, self._rows)
        far = first - at * count
        squares = slice(-_POWERS, None)
        square = beyond(2, self._rows[:, squares]) - at * (far + first)[..., squares]
        begin, end = slice(len(offs_px)), slice(len(offs_px), None)
        of_squares = (square[:, begin] - square[:, end]) / self.soft_px - 2 * far[:, end, squares]
        return (far[:, begin] - far[:, end]) / self.soft_px, of_squares / self.soft_px

    def _edge(self, border: LikelyBorder) -> Array:
        """(n,) a step of 1 beyond it."""
        across = np.array([np.cos(border.turn_rad), np.sin(border.turn_rad)]) @ self.place - border.off_px
        return np.asarray(np.clip(across / self.soft_px + 0.5, 0.0, 1.0))

    def _beside(self, rows: Array) -> Array:
        """What the mark's unknowns leave of rows (m, n)."""
        factors = rows @ self.design.T @ self.orthonormal.T @ self.orthonormal
        return np.asarray(rows - factors @ self.design)
