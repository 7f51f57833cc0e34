"""The one sharp picture that all pictures of a mark are blurs of, by least squares.

Scans of one camera are not alike in sharpness. Under more blur the edges of a mark that is not symmetric seem to lie
elsewhere, so that neither a mean of unlike pictures nor what is measured with it tells where the mark is. Each picture
therefore is the shared one under a Gaussian blur of its own, moved, with gain and offset; the shared one is as sharp as
the sharpest of them. It, the moves and the blurs are adjusted together: by itself the sharpest picture would be
compared with little but itself, and stay where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import dctn, idctn
from scipy.sparse.linalg import LinearOperator, lsmr

from measure.array_types import Array, Mask
from measure.noise.robust_estimation import robust_scale, tukey_weights

_GAIN, _OFFSET, _COL, _ROW, _BLUR = range(5)  # what is estimated of each picture
_REWEIGHTINGS = 5  # of the pixels by Tukey's function
NOISE_FLOOR = 0.002  # of the picture's range: under a picture's noise, for clean pictures have none
_LEAST_WEIGHT = 1e-6  # of a pixel that lies off in all pictures
_LEAST_REDUNDANCY = 0.1  # of a picture: below it residuals do not tell its noise
_ALIKE_PX = 0.7  # about a pixel, that tell whether pictures are alike there
_LEAST_GAIN = 0.01  # of a picture that hardly shows the mark
SMOOTHED_PX2 = 0.7**2  # variance of a blur of all that is compared: as sharp as pixels, edges are sampled falsely
_CORRELATED = 4 * np.pi * SMOOTHED_PX2  # pixels that are one observation, after it
_LONGEST_PX = 1.0  # of a move: beyond it the linearisation tells nothing
_MOST_BLURRED = 2.0  # times the blur, likewise
_SEEN_PX2 = 1.0  # variance of the blur of a sharp scan, the pixel's share and the smoothing included
_SURELY = 3.0  # standard deviations: the shared picture is no sharper than one of them surely is
_HELD = 0.1  # times one picture's weight: what no picture tells of the shared one stays as it was
_ITERATIONS, _TOLERANCE = 12, 1e-3  # of one adjustment: the next round goes on


@dataclass(frozen=True, eq=False)
class SharedPicture:
    """image (side, side): what n pictures share. variances_px2 (n,): how much more blur than that each of them has.

    Of the pictures that it was adjusted to: weights (n, side, side) of their pixels and residuals (n, side, side), in
    the image's units; moves (n, 2) px by column and row, how far each shows the mark off its middle, their sum being
    none; alike (side, side): where more of them are alike than not."""

    image: Array
    variances_px2: Array
    weights: Array
    residuals: Array
    moves: Array
    alike: Mask

    @property
    def shares(self) -> Array:
        """(n,) how much of the image is each picture's own, of as fine a detail as a fit sees."""
        side = len(self.image)
        information = self.weights.mean(axis=(1, 2))[:, None, None] * _transfers(side, 2 * self.variances_px2)
        visible = _transfers(side, np.array([2 * SMOOTHED_PX2]))
        return np.asarray((visible * information / information.sum(axis=0)).sum(axis=(1, 2)) / visible.sum())

    @property
    def slope_noise(self) -> float:
        """Standard deviation of noise in the image's slopes, per pixel, as a fit sees them: by those of the residuals,
        in which a picture's own share is missing."""
        shares = self.shares
        noise = np.array([robust_scale(np.diff(residuals)) for residuals in self.residuals])
        return float(np.sqrt(np.sum(shares**2 * noise**2 / np.maximum(1 - shares, _LEAST_REDUNDANCY))))


def first_picture(stack: Array) -> SharedPicture:
    """What pictures (n, side, side) share, as long as they are taken to be alike."""
    levelled = [_line(picture, stack[0]) for picture in stack]
    return SharedPicture(
        np.median(levelled, axis=0),
        np.zeros(len(stack)),
        np.ones_like(stack),
        np.zeros_like(stack),
        np.zeros((len(stack), 2)),
        np.ones(stack[0].shape, dtype=bool),
    )


def adjust_picture(shared: SharedPicture, stack: Array, steady: Mask) -> SharedPicture:
    """The shared picture adjusted once more to pictures (n, side, side), moves and blurs by the steady pixels."""
    smoothed = _blur_images(stack, np.full(len(stack), SMOOTHED_PX2))
    designs = _designs(shared.image, shared.variances_px2, steady)
    fits = [_fit(*each) for each in zip(smoothed, designs, shared.weights, strict=True)]
    alike, weights = np.array([fit.alike for fit in fits]), _weights(fits, shared.shares)
    variances = _excess_variances(shared.variances_px2, fits)
    together = _Together(shared.image, variances, weights, steady)
    image, more = together.solved(np.array([fit.levelled for fit in fits]))
    moves = np.clip(-more[:, [_COL, _ROW]], -_LONGEST_PX, _LONGEST_PX)
    return SharedPicture(
        image,
        np.maximum(_bounded(variances, more[:, _BLUR]), 0.0),
        weights,
        np.array([fit.residuals for fit in fits]),
        moves - moves.mean(axis=0),
        cv2.GaussianBlur(alike.mean(axis=0), (0, 0), _ALIKE_PX) > 0.5,
    )


def _squares(side: int) -> Array:
    """(side, side) the squared frequency of each cosine."""
    square = (np.pi * np.arange(side) / side) ** 2
    return np.asarray(square[:, None] + square)


def _transfers(side: int, variances_px2: Array) -> Array:
    """(n, side, side) what Gaussian blurs leave of each cosine."""
    return np.asarray(np.exp(-0.5 * variances_px2[:, None, None] * _squares(side)))


def _blur_images(images: Array, variances_px2: Array) -> Array:
    """(n, side, side) one image, or n, under blurs (n,); mirrored at its borders, so that a blur is its own adjoint."""
    cosines = _transfers(images.shape[-1], variances_px2) * _cosines(images)
    return np.asarray(idctn(cosines, axes=(1, 2), norm="ortho"))


def _cosines(images: Array) -> Array:
    return np.asarray(dctn(images, axes=(-2, -1), norm="ortho"))


def _designs(image: Array, variances_px2: Array, steady: Mask) -> Array:
    """(n, 5, side, side) of each picture: the shared one as it shows it, one, and how that changes by column, row and
    variance of the blur, where pixels are steady."""
    views = _blur_images(image, variances_px2 + SMOOTHED_PX2)
    by_row, by_col = np.gradient(views, axis=(1, 2))
    by_variance = idctn(-0.5 * _squares(len(image)) * _cosines(views), axes=(1, 2), norm="ortho")
    return np.stack([views, np.ones_like(views), *(part * steady for part in (by_col, by_row, by_variance))], axis=1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """One picture beside the shared one: levelled (side, side) to its grey values; residuals and alike (side, side), by
    what each pixel differs, and what Tukey's function makes of that; scale: the residuals' standard deviation.
    blur_px2: how much more its blur's variance is than was taken, and blur_sigma_px2, the standard deviation of that.
    """

    levelled: Array
    residuals: Array
    alike: Array
    scale: float
    blur_px2: float
    blur_sigma_px2: float


def _fit(picture: Array, design: Array, weights: Array) -> _Fit:
    """Robust against dust and the landscape behind the mark. What a pixel changes by while the picture is moved and
    blurred is no damage: the next round shows it."""
    columns, grey = design.reshape(len(design), -1), picture.ravel()
    floor = NOISE_FLOOR * float(np.ptp(design[_GAIN]))
    weights = weights.ravel()
    for _ in range(_REWEIGHTINGS):
        weighed = columns * weights
        inverse = np.linalg.pinv(weighed @ columns.T, hermitian=True)
        factors = inverse @ (weighed @ grey)
        gain = max(float(factors[_GAIN]), _LEAST_GAIN)
        residuals = (grey - factors @ columns) / gain
        scale = max(robust_scale(residuals), floor)
        changes = factors[_COL:] @ columns[_COL:] / gain
        alike = tukey_weights(residuals / np.hypot(scale, changes), 1.0)
        weights = (alike + _LEAST_WEIGHT) / scale**2
    return _Fit(
        (picture - factors[_OFFSET]) / gain,
        residuals.reshape(picture.shape),
        alike.reshape(picture.shape),
        scale,
        float(factors[_BLUR]) / gain,
        float(np.sqrt(_CORRELATED * inverse[_BLUR, _BLUR])),
    )


def _weights(fits: Sequence[_Fit], shares: Array) -> Array:
    """(n, side, side) of the pixels. shares (n,): of the image that each picture was fitted to. What is mostly a
    picture's own leaves little of its noise; and none counts by more than most of them do."""
    noise = np.array([fit.scale for fit in fits]) / np.sqrt(np.maximum(1 - shares, _LEAST_REDUNDANCY))
    noise = np.maximum(noise, np.median(noise))
    return (np.array([fit.alike for fit in fits]) + _LEAST_WEIGHT) / noise[:, None, None] ** 2


def _excess_variances(variances_px2: Array, fits: Sequence[_Fit]) -> Array:
    """(n,) variances as fits have them, less that of the sharpest picture: 0 where pictures are as sharp as it, as far
    as is known."""
    found = _bounded(variances_px2, np.array([fit.blur_px2 for fit in fits]))
    sharpest = float((found + _SURELY * np.array([fit.blur_sigma_px2 for fit in fits])).min())
    return np.maximum(found - sharpest, 0.0)


def _bounded(variances_px2: Array, change_px2: Array) -> Array:
    """Variances after a change that a linearisation allows."""
    total = variances_px2 + _SEEN_PX2
    return np.clip(total + change_px2, total / _MOST_BLURRED**2, total * _MOST_BLURRED**2) - _SEEN_PX2


class _Together:
    """The adjustment of the image and of all pictures' unknowns together, where they are linear.

    The pictures that are as sharp as the image have no more blur: they say how sharp it is. Of the other unknowns all
    pictures together have no sum, for a move of all of them would be one of the image. What no picture tells of the
    image stays as it was. Unknowns and equations are scaled to a weight of about one."""

    def __init__(self, image: Array, variances_px2: Array, weights: Array, steady: Mask) -> None:
        self.image, self.roots = image, np.sqrt(weights)
        self.designs = _designs(image, variances_px2, steady)
        self.transfers = _transfers(len(image), variances_px2 + SMOOTHED_PX2)
        weighted = self.roots[:, None] * self.designs
        weighted[variances_px2 == 0, _BLUR] = 0.0
        self.lengths = np.sqrt((weighted**2).sum(axis=(2, 3)))
        self.lengths[self.lengths == 0] = np.inf
        self.columns = weighted / self.lengths[:, :, None, None]
        self.held = float(np.sqrt(_HELD * np.median(weights.mean(axis=(1, 2)))))
        self.scale = 1 / np.sqrt(weights.sum(axis=0) + self.held**2)

    def solved(self, levelled: Array) -> tuple[Array, Array]:
        """The image adjusted to pictures (n, side, side), and what is to be added (n, 5) to their unknowns."""
        wanted = (self.roots * (levelled - self.designs[:, _GAIN])).ravel()
        rest = self.image.size + _BLUR
        shape = (wanted.size + rest, self.image.size + self.lengths.size)
        operator = LinearOperator(shape, matvec=self._forward, rmatvec=self._adjoint, dtype=float)
        wanted = np.concatenate([wanted, np.zeros(rest)])
        found = lsmr(operator, wanted, atol=_TOLERANCE, btol=_TOLERANCE, maxiter=_ITERATIONS)[0]
        image, factors = self._parted(found)
        return self.image + self.scale * image, factors / self.lengths

    def _parted(self, unknowns: Array) -> tuple[Array, Array]:
        return unknowns[: self.image.size].reshape(self.image.shape), unknowns[self.image.size :].reshape(-1, _BLUR + 1)

    def _forward(self, unknowns: Array) -> Array:
        """What changes of the unknowns change: in the pictures, in the image, and in the sums."""
        image, factors = self._parted(unknowns)
        change = self.scale * image
        pictures = idctn(self.transfers * _cosines(change), axes=(1, 2), norm="ortho")
        pictures = self.roots * pictures + np.einsum("nk,nkij->nij", factors, self.columns)
        return np.concatenate([pictures.ravel(), self.held * change.ravel(), factors[:, :_BLUR].sum(axis=0)])

    def _adjoint(self, rows: Array) -> Array:
        """The adjoint of it."""
        pictures, change, sums = np.split(rows, [self.roots.size, self.roots.size + self.image.size])
        pictures = pictures.reshape(self.roots.shape)
        back = idctn((self.transfers * _cosines(self.roots * pictures)).sum(axis=0), norm="ortho")
        image = self.scale * (back + self.held * change.reshape(self.image.shape))
        factors = np.einsum("nkij,nij->nk", self.columns, pictures)
        factors[:, :_BLUR] += sums
        return np.concatenate([image.ravel(), factors.ravel()])


def _line(picture: Array, like: Array) -> Array:
    """A picture with the gain and offset that make it most like another."""
    off = picture - picture.mean()
    gain = float((off * like).sum()) / max(float((off**2).sum()), 1e-12)
    return np.asarray(like.mean() + gain * off)
